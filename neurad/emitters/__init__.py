"""Things that send light: emitting triangles, an environment map, and both together."""
