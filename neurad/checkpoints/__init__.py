"""Checkpoints: what they hold, their sealed file, and where runs keep them."""
