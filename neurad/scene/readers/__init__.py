"""Readers of scene folders, one file a format."""
