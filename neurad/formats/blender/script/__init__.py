"""Programs for Blender's Python that read a .blend file; they import nothing of neurad, nor neurad them."""

from pathlib import Path


def write_room_path() -> Path:
    """The program that writes what is in a scene into a folder."""
    return Path(__file__).with_name("write_room.py")
