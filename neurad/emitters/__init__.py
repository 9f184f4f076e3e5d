"""Emitters: emitting triangles, an environment map, known or fitted, and both kinds together."""
