"""Blender files, by way of a script that runs inside Blender."""
