"""Reflection models in the local shading frame."""
