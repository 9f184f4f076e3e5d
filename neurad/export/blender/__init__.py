"""Programs for Blender's Python: they import nothing of neurad, and neurad never imports them."""

from pathlib import Path


def blender_setup_path() -> Path:
    """The program that opens an exported room in Blender."""
    return Path(__file__).with_name("blender_setup.py")


def render_views_path() -> Path:
    """The program that renders views of an exported room with Cycles."""
    return Path(__file__).with_name("render_views.py")


def into_room_path() -> Path:
    """The program that puts textures into the Blender file that a room came from."""
    return Path(__file__).with_name("into_room.py")
