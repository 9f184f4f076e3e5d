"""Programs for Blender's Python that read a .blend file; they import nothing of neurad, nor neurad them."""

from pathlib import Path

WRITE_ROOM = Path(__file__).with_name("write_room.py")
"""Writes what is in a scene into a folder."""
