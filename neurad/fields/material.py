"""Fields of albedo and roughness over surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from neurad.core.records import FloatArray, SurfaceInteraction
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.mlp import MLP
from neurad.fields.select import make_layers
from neurad.fields.settings import FieldConfig, RoughnessConfig
from neurad.fields.unit_cube import UnitCube
from neurad.scene.textures import OnEmitters

MIN_ROUGHNESS = 0.02
"""Smallest fitted roughness: below it a highlight is narrower than a pixel and its gradient is all noise."""

CORRECTION_CELLS, CORRECTION_FACTOR = 64, 8
"""Cells along the region of what a closing step adds to the roughness, and how many times as many they are as on the
coarsest of the grids that it looks on."""


class Correction(nn.Module):
    """What is added to a field [n, 1] at positions in the unit cube [n, 3]: nothing at first. No optimizer has it.

    Args:
        cells: along the unit cube.
    """

    made: Tensor
    information: Tensor
    """1 / variance that the photographs leave to the roughness in the cells [cells, cells, cells], the axes those of
    positions; 0 where they tell nothing, and everywhere before the step."""
    scales: Tensor
    """Gain, prior and power by which it becomes error bars, see :mod:`neurad.evidence.bar_calibration`; 0 like it."""

    def __init__(self, cells: int = CORRECTION_CELLS) -> None:
        super().__init__()
        self.cells = cells
        self.grid = DenseGrid(cells + 1, 1)
        self.grid.table.requires_grad_(False)
        self.register_buffer("made", torch.zeros((), dtype=torch.int64))
        self.register_buffer("information", torch.zeros((cells,) * 3))
        self.register_buffer("scales", torch.zeros(3))
        self.done = False
        """Whether the step that adds to it was made."""
        self.found = False
        """Whether any found something; the table is 0 otherwise."""
        self.register_load_state_dict_post_hook(lambda module, _: module._refresh_flags())  # type: ignore[no-untyped-call]

    def forward(self, x: Tensor) -> Tensor:
        """The correction [n, 1] at positions [n, 3] in the unit cube."""
        found: Tensor = self.grid(x)
        return found

    @torch.no_grad()
    def add(
        self,
        values: FloatArray | None,
        information: FloatArray | None = None,
        scales: tuple[float, float, float] | None = None,
    ) -> None:
        """The step was made, and asks for these changes at the nodes [cells + 1, cells + 1, cells + 1], the axes those
        of the positions; for none if None. What it found pixels to tell of the cells [cells, cells, cells], and the
        scales of that, take the place of what was known.
        """
        if information is not None:
            self.information.copy_(torch.from_numpy(information))
        if scales is not None:
            self.scales.copy_(torch.tensor(scales))
        if values is not None:
            self.grid.table.add_(torch.from_numpy(values.transpose(2, 1, 0).reshape(-1, 1).copy()).to(self.grid.table))
        self.made.fill_(1)
        self._refresh_flags()

    @torch.no_grad()
    def reopen(self) -> None:
        """Another step is to be made, from where this one went."""
        self.made.zero_()
        self._refresh_flags()

    def _refresh_flags(self) -> None:
        self.done, self.found = bool(self.made), bool((self.grid.table != 0).any())


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

    def with_known(self, si: SurfaceInteraction, values: Tensor) -> Tensor:
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
        return self.with_known(si, self.at(si.p))


class RoughnessField(_MaterialField):
    """Burley roughness [n, 1] in (0.02, 1), near 0.5 at the start.

    Args:
        config: sizes of grid and network, and whether the network reads the albedo.
        bounds: smallest and largest corner of what is to be resolved [2, 3].
        known: the values on emitting surfaces, which replace the field's there; None for none.
        contracted: whether what lies outside of the bounds is contracted, not clamped.
        correction_cells: along the unit cube, of what a closing step adds.
    """

    def __init__(
        self,
        config: FieldConfig,
        bounds: Tensor,
        known: OnEmitters | None = None,
        contracted: bool = False,
        correction_cells: int = CORRECTION_CELLS,
    ) -> None:
        reads_albedo = isinstance(config, RoughnessConfig) and config.reads_albedo and config.kind == "hash"
        super().__init__(config, UnitCube(bounds, contracted), 1, 3 if reads_albedo else 0, known)
        self.reads_albedo = reads_albedo
        self.correction: Correction | None = None
        if isinstance(config, RoughnessConfig) and config.closing_step and config.kind == "hash":
            self.correction = Correction(correction_cells)

    def at(self, p: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Roughness [n, 1] at positions [n, 3]; outside the bounds as :class:`UnitCube` has it.

        Args:
            p: positions.
            albedo: there [n, 3], for a field that reads it; no gradient flows into it.

        Raises:
            ValueError: the field reads the albedo, and none is given.
        """
        roughness = self.of_features(self.features(p), albedo)
        if self.correction is None or not self.correction.found:
            return roughness
        changed: Tensor = (roughness + self.correction(self.cube(p))).clamp(MIN_ROUGHNESS, 1.0)
        return changed

    def of_features(self, features: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Roughness [n, 1] where the grid says ``features`` [n, k], uncorrected; otherwise as :meth:`at`."""
        if self.reads_albedo and albedo is None:
            raise ValueError("RoughnessField: it reads the albedo, which is not given")
        extra = (4.0 * (albedo.detach() - 0.5),) if self.reads_albedo and albedo is not None else ()
        return MIN_ROUGHNESS + (1.0 - MIN_ROUGHNESS) * self._values(features, *extra)

    @torch.no_grad()
    def shift(self, mean: float, to: float) -> None:
        """Move all values so that those around ``mean`` come to lie around ``to``; for a field with a network."""
        # Where a field has reached an end of its range in float32, its logarithm of odds is taken for that of 1e-6.
        fraction = ((x - MIN_ROUGHNESS) / (1.0 - MIN_ROUGHNESS) for x in (mean, to))
        before, after = (math.log(x / (1.0 - x)) for x in (min(max(x, 1e-6), 1.0 - 1e-6) for x in fraction))
        assert isinstance(self.mlp, MLP)
        bias = self.mlp.layers[-1].bias
        assert isinstance(bias, Tensor)
        bias += after - before

    def forward(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor:
        """Roughness [n, 1] at the lanes of ``si``; gradients reach the parameters, not the positions."""
        return self.with_known(si, self.at(si.p, albedo))
