"""Fields of albedo and roughness over surfaces."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from neurad.core.parameters import ALBEDO, SurfaceParameter
from neurad.core.records import FloatArray, SurfaceInteraction
from neurad.fields.dense_grid import DenseGrid
from neurad.fields.mlp import MLP
from neurad.fields.select import evaluate_layers, make_layers
from neurad.fields.settings import FieldConfig, RoughnessConfig
from neurad.fields.unit_cube import UnitCube
from neurad.scene.textures import OnEmitters

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


class MaterialField(nn.Module):
    """A surface parameter [n, channels] at positions: hash grid -> network -> sigmoid, or dense grid -> sigmoid.

    Values lie between the parameter's ends and start near their middle.

    Args:
        parameter: what it is of.
        config: sizes of grid and network, whether the network reads the albedo, and whether a closing step corrects it.
        bounds: smallest and largest corner of what is to be resolved [2, 3].
        contracted: whether what lies outside of the bounds is contracted, not clamped.
        correction_cells: along the unit cube, of what a closing step adds.
    """

    known: OnEmitters | None
    """The values on emitting surfaces, which replace the field's there; None for none."""

    def __init__(
        self,
        parameter: SurfaceParameter,
        config: FieldConfig,
        bounds: Tensor,
        contracted: bool = False,
        correction_cells: int = CORRECTION_CELLS,
    ) -> None:
        super().__init__()
        self.parameter = parameter
        self.known = None
        self.cube = UnitCube(bounds, contracted)
        own = config if isinstance(config, RoughnessConfig) and config.has_network else None
        self.reads_albedo = own is not None and own.reads_albedo
        self.grid, self.mlp = make_layers(config, parameter.channels, ALBEDO.channels if self.reads_albedo else 0)
        self.correction: Correction | None = None
        if own is not None and own.closing_step:
            self.correction = Correction(correction_cells)

    def features(self, p: Tensor) -> Tensor:
        """What the grid says [n, k] at positions [n, 3]: what :meth:`of_features` makes values of."""
        found: Tensor = self.grid(self.cube(p))
        return found

    def of_features(self, features: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Values [n, channels] where the grid says ``features`` [n, k], uncorrected; otherwise as :meth:`at`."""
        others = self._others(albedo)
        return self._in_range(self.mlp(torch.cat((features, *others), -1) if others else features))

    def _others(self, albedo: Tensor | None) -> list[Tensor]:
        """What the network reads beside the grid."""
        if not self.reads_albedo:
            return []
        if albedo is None:
            raise ValueError(f"{self.parameter.name}: its field reads the albedo, which is not given")
        return [4.0 * (albedo.detach() - 0.5)]

    def _in_range(self, y: Tensor) -> Tensor:
        low, high = self.parameter.low, self.parameter.high
        fraction = torch.sigmoid(y)
        return fraction if (low, high) == (0.0, 1.0) else low + (high - low) * fraction

    def at(self, p: Tensor, albedo: Tensor | None = None) -> Tensor:
        """Values [n, channels] at positions [n, 3]; outside the bounds as :class:`UnitCube` has it.

        Args:
            p: positions.
            albedo: there [n, 3], for a field that reads it; no gradient flows into it.

        Raises:
            ValueError: the field reads the albedo, and none is given.
        """
        x = self.cube(p)
        values = self._in_range(evaluate_layers(self.grid, self.mlp, x, self._others(albedo)))
        if self.correction is None or not self.correction.found:
            return values
        changed: Tensor = (values + self.correction(x)).clamp(self.parameter.low, self.parameter.high)
        return changed

    def forward(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor:
        """Values [n, channels] at the lanes of ``si``; gradients reach the parameters, not the positions."""
        values = self.at(si.p, albedo)
        return values if self.known is None else self.known(si, values)

    @torch.no_grad()
    def shift(self, mean: float, to: float) -> None:
        """Move all values so that those around ``mean`` come to lie around ``to``; for a field with a network."""
        # Where a field has reached an end of its range in float32, its logarithm of odds is taken for that of 1e-6.
        low, high = self.parameter.low, self.parameter.high
        fraction = ((x - low) / (high - low) for x in (mean, to))
        before, after = (math.log(x / (1.0 - x)) for x in (min(max(x, 1e-6), 1.0 - 1e-6) for x in fraction))
        assert isinstance(self.mlp, MLP)
        bias = self.mlp.layers[-1].bias
        assert isinstance(bias, Tensor)
        bias += after - before
