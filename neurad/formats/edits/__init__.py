"""Edits of a scene's light, materials and objects, and camera paths, from YAML."""
