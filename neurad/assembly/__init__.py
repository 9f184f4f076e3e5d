"""Puts a run together from what its scene has: settings, world, materials, fields."""
