"""Data modules: photographs as batches of pixels."""
