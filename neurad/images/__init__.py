"""Picture files: EXR and bitmaps, response curves, brackets, films."""
