"""Fields of albedo and roughness over surfaces."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from neurad.core.records import Interaction
from neurad.fields.hash_grid import HashGrid, UnitCube
from neurad.fields.mlp import MLP
from neurad.fields.settings import FieldConfig

MIN_ROUGHNESS = 0.02
"""Smallest fitted roughness: below it a highlight is narrower than a pixel and its gradient is all noise."""


class _MaterialField(nn.Module):
    """Position -> hash grid -> network -> sigmoid. The last layer starts small, so values start near 0.5."""

    def __init__(self, config: FieldConfig, bounds: Tensor, channels: int) -> None:
        super().__init__()
        self.cube = UnitCube(bounds)
        self.grid = HashGrid.from_config(config.grid)
        self.mlp = MLP(self.grid.channels, channels, config.width, config.hidden_layers)

    def at(self, p: Tensor) -> Tensor:
        """Values [n, channels] at positions [n, 3]; outside the bounds, those of the nearest point of the cube."""
        return torch.sigmoid(self.mlp(self.grid(self.cube(p))))

    def forward(self, it: Interaction) -> Tensor:
        """Values [n, channels] at the lanes of ``it``; gradients reach the parameters, not the positions."""
        return self.at(it.p)


class AlbedoField(_MaterialField):
    """Base colour [n, 3] in (0, 1), near 0.5 at the start.

    Args:
        config: sizes of grid and network.
        bounds: smallest and largest corner of the scene [2, 3].
    """

    def __init__(self, config: FieldConfig, bounds: Tensor) -> None:
        super().__init__(config, bounds, 3)


class RoughnessField(_MaterialField):
    """Burley roughness [n, 1] in (0.02, 1), near 0.5 at the start.

    Args:
        config: sizes of grid and network.
        bounds: smallest and largest corner of the scene [2, 3].
    """

    def __init__(self, config: FieldConfig, bounds: Tensor) -> None:
        super().__init__(config, bounds, 1)

    def at(self, p: Tensor) -> Tensor:
        """Roughness [n, 1] at positions [n, 3]; outside the bounds, that of the nearest point of the cube."""
        return MIN_ROUGHNESS + (1.0 - MIN_ROUGHNESS) * super().at(p)
