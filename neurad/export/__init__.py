"""What was recovered as textures and scene files for other programs, and the proof that it looks the same there."""
