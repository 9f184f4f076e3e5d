"""The Lightning module: fields, objective, optimizers and their schedule."""

from neurad.module.inverse import InverseRenderer

__all__ = ["InverseRenderer"]
