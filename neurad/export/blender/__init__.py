"""Programs for Blender's Python: they import nothing of neurad, and neurad never imports them."""

from pathlib import Path

BLENDER_SETUP = Path(__file__).with_name("blender_setup.py")
"""Opens an exported room in Blender."""
RENDER_VIEWS = Path(__file__).with_name("render_views.py")
"""Renders views of an exported room with Cycles."""
INTO_ROOM = Path(__file__).with_name("into_room.py")
"""Puts textures into the Blender file that a room came from."""
