"""Mesh files: PLY, OBJ and what edits put into a room."""
