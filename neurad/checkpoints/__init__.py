"""Checkpoints: what they hold, their files, and where runs keep them."""
