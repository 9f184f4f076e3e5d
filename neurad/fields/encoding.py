"""Kinds of fields that are not neurad's own: an encoding of positions, which a network reads."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # settings name the class, and their help does without torch
    from torch import nn


class Encoding(ABC):
    """A kind of field: its settings, and what makes its encoding."""

    @abstractmethod
    def make(self) -> nn.Module:
        """A fresh module from positions [n, 3] in the unit cube, without gradient, to features [n, channels]; its
        attribute ``channels`` says how many there are.
        """
