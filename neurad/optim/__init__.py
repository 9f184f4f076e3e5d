"""Optimizers and averages of parameters."""
