"""``neurad check``: whether a scene folder is sound, before a fit learns from it."""
