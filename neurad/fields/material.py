"""Fields of albedo and roughness over surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from neurad.core.records import SurfaceInteraction
from neurad.fields.mlp import MLP
from neurad.fields.select import make_layers
from neurad.fields.settings import FieldConfig, RoughnessConfig
from neurad.fields.unit_cube import UnitCube
from neurad.scene.textures import OnEmitters

MIN_ROUGHNESS = 0.02
"""Smallest fitted roughness: below it a highlight is narrower than a pixel and its gradient is all noise."""


class _MaterialField(nn.Module):
    """Position -> hash grid -> network -> sigmoid, or position -> dense grid -> sigmoid. Values start near 0.5."""

    def __init__(
        self, config: FieldConfig, cube: UnitCube, channels: int, extra: int = 0, known: OnEmitters | None = None
    ) -> None:
        super().__init__()
        self.known = known
        self.cube = cube
        self.grid, self.mlp = make_layers(config, channels, extra)

    def features(self, p: Tensor) -> Tensor:
        """What the grid says [n, k] at positions [n, 3]: what :meth:`of_features` makes values of."""
        found: Tensor = self.grid(self.cube(p))
        return found

    def _values(self, features: Tensor, *extra: Tensor) -> Tensor:
        """Sigmoid outputs [n, c] of features [n, k] and the ``extra`` inputs [n, e]."""
        return torch.sigmoid(self.mlp(torch.cat((features, *extra), -1) if extra else features))

    def _with_known(self, si: SurfaceInteraction, values: Tensor) -> Tensor:
        """``values`` [n, c], but the known ones on emitting surfaces."""
        return values if self.known is None else self.known(si, values)


class AlbedoField(_MaterialField):
    """Base colour [n, 3] in (0, 1), near 0.5 at the start.

    Args:
        config: sizes of grid and network.
        bounds: smallest and largest corner of what is to be resolved [2, 3].
        known: the values on emitting surfaces, which replace the field's there; None for none.
        contracted: whether what lies outside of the bounds is contracted, not clamped.
    """

    def __init__(
        self, config: FieldConfig, bounds: Tensor, known: OnEmitters | None = None, contracted: bool = False
    ) -> None:
        super().__init__(config, UnitCube(bounds, contracted), 3, known=known)

    def at(self, p: Tensor) -> Tensor:
        """Albedo [n, 3] at positions [n, 3]; outside the bounds as :class:`UnitCube` has it."""
        return self.of_features(self.features(p))

    def of_features(self, features: Tensor) -> Tensor:
        """Albedo [n, 3] where the grid says ``features`` [n, k]."""
        return self._values(features)

    def forward(self, si: SurfaceInteraction) -> Tensor:
        """Albedo [n, 3] at the lanes of ``si``; gradients reach the parameters, not the positions."""
        return self._with_known(si, self.at(si.p))


class RoughnessField(_MaterialField):
    """Burley roughness [n, 1] in (0.02, 1), near 0.5 at the start.

    Args:
        config: sizes of grid and network, and whether the network reads the albedo.
        bounds: smallest and largest corner of what is to be resolved [2, 3].
        known: the values on emitting surfaces, which replace the field's there; None for none.
        contracted: whether what lies outside of the bounds is contracted, not clamped.
    """

    def __init__(
        self, config: FieldConfig, bounds: Tensor, known: OnEmitters | None = None, contracted: bool = False
    ) -> None:
        reads_albedo = isinstance(config, RoughnessConfig) and config.reads_albedo and config.kind == "hash"
        super().__init__(config, UnitCube(bounds, contracted), 1, 3 if reads_albedo else 0, known)
        self.reads_albedo = reads_albedo

    def at(self, p: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Roughness [n, 1] at positions [n, 3]; outside the bounds as :class:`UnitCube` has it.

        Args:
            p: positions.
            albedo: there [n, 3], for a field that reads it; no gradient flows into it.

        Raises:
            ValueError: the field reads the albedo, and none is given.
        """
        return self.of_features(self.features(p), albedo)

    def of_features(self, features: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Roughness [n, 1] where the grid says ``features`` [n, k]; otherwise as :meth:`at`."""
        if self.reads_albedo and albedo is None:
            raise ValueError("RoughnessField: it reads the albedo, which is not given")
        extra = (4.0 * (albedo.detach() - 0.5),) if self.reads_albedo and albedo is not None else ()
        return MIN_ROUGHNESS + (1.0 - MIN_ROUGHNESS) * self._values(features, *extra)

    @torch.no_grad()
    def shift(self, mean: float, to: float) -> None:
        """Move all values so that those around ``mean`` come to lie around ``to``; for a field with a network."""
        low, span = MIN_ROUGHNESS, 1.0 - MIN_ROUGHNESS
        before, after = (math.log(x / (1.0 - x)) for x in ((mean - low) / span, (to - low) / span))
        assert isinstance(self.mlp, MLP)
        bias = self.mlp.layers[-1].bias
        assert isinstance(bias, Tensor)
        bias += after - before

    def forward(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor:
        """Roughness [n, 1] at the lanes of ``si``; gradients reach the parameters, not the positions."""
        return self._with_known(si, self.at(si.p, albedo))
