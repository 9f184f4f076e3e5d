"""Fields of albedo and roughness over surfaces."""

import math

import torch
from torch import Tensor, nn

from neurad.core.parameters import ALBEDO, SurfaceParameter
from neurad.core.records import SurfaceInteraction
from neurad.fields.hierarchy import Hierarchy, Places
from neurad.fields.mlp import MLP
from neurad.fields.outputs import Between, Known, Output, Unchanged
from neurad.fields.segments import Segments
from neurad.fields.select import evaluate_layers, make_layers
from neurad.fields.settings import FieldConfig, RoughnessConfig
from neurad.fields.unit_cube import UnitCube
from neurad.scene.parts import SurfaceParts
from neurad.scene.textures import KnownSurfaces

HIERARCHY_CELLS = 64
"""Cells along the region of the finest details that a roughness refinement looks for: some 10 cm of a room."""


class MaterialField(nn.Module):
    """A surface parameter [n, channels] at positions: hash grid -> network -> sigmoid, or dense grid -> sigmoid.

    Values lie between the parameter's ends and start near their middle.

    Args:
        config: sizes of grid and network, whether the network reads the albedo, and what it is refined by.
        bounds: smallest and largest corner of what is to be resolved [2, 3].
        contracted: whether what lies outside of them is contracted, not clamped.
        parts: connected parts of the scene; None in a run without a roughness refinement.
        segments: of the surfaces that have values of their own, see :class:`neurad.fields.segments.Segments`; None for
            none.
        cells: along the unit cube, of the finest details that a roughness refinement looks for.
    """

    known: KnownSurfaces | None
    """The values on emitting and smooth surfaces, which replace the field's there; None for none."""

    def __init__(
        self,
        parameter: SurfaceParameter,
        config: FieldConfig,
        bounds: Tensor,
        contracted: bool = False,
        parts: SurfaceParts | None = None,
        cells: int = HIERARCHY_CELLS,
        segments: SurfaceParts | None = None,
    ) -> None:
        super().__init__()
        self.parameter = parameter
        self.range = Between(parameter.low, parameter.high)
        self.known = None
        self.cube = UnitCube(bounds, contracted)
        own = config if isinstance(config, RoughnessConfig) and config.has_network else None
        self.reads_albedo = own is not None and own.reads_albedo
        self.grid, self.mlp = make_layers(config, parameter.channels, ALBEDO.channels if self.reads_albedo else 0)
        self.hierarchy: Hierarchy | None = None
        """What a roughness refinement has found, in place of grid and network from then on."""
        self.parts = parts
        self.segments = None if segments is None else Segments(segments, parameter.channels)
        if own is not None and parts is not None and own.structure != "free":
            self.hierarchy = Hierarchy(own.structure, cells)

    def segment_at(self, p: Tensor, prim: Tensor | None) -> Tensor | None:
        """Segment [n] at positions [n, 3] on triangles [n], or on the nearest ones; None where there are none."""
        return None if self.segments is None else self.segments.at(p, prim)

    def features(self, p: Tensor, segment: Tensor | None = None) -> Tensor:
        """What the grid says [n, k] at positions [n, 3] on segments [n]: what :meth:`of_features` makes values of."""
        x = self.cube(p)
        found: Tensor = self.grid(x) if self.segments is None else self.grid(x, self.segments.keys[segment])
        return found

    def of_features(self, features: Tensor, albedo: Tensor | None = None, segment: Tensor | None = None) -> Tensor:
        """Values [n, channels] where the grid says ``features`` [n, k] on segments [n], by the network; otherwise as
        :meth:`at`.
        """
        others = self._others(albedo)
        y = self.mlp(torch.cat((features, *others), -1) if others else features)
        return self.range(y if segment is None else self.segments(y, segment))  # type: ignore[misc]

    def _others(self, albedo: Tensor | None) -> list[Tensor]:
        if not self.reads_albedo:
            return []
        if albedo is None:
            raise ValueError(f"{self.parameter.name}: its field reads the albedo, which is not given")
        return [4.0 * (albedo.detach() - 0.5)]

    def at(self, p: Tensor, albedo: Tensor | None = None, prim: Tensor | None = None) -> Tensor:
        """Values [n, channels] at positions [n, 3]; outside the bounds as :class:`UnitCube` has it.

        Args:
            albedo: there [n, 3], for a field that reads it; no gradient flows into it.
            prim: triangle that each lies on [n]; None looks for the nearest.

        Raises:
            ValueError: the field reads the albedo, and none is given.
        """
        if (hierarchy := self._found) is None:
            return self._by_layers(p, prim, albedo, self.range)
        with torch.no_grad():
            values: Tensor = hierarchy(self.places(p, albedo, prim))
        return values.clamp(self.parameter.low, self.parameter.high)

    def _by_layers(self, p: Tensor, prim: Tensor | None, albedo: Tensor | None, output: Output) -> Tensor:
        layers, others = (self.cube, self.grid, self.mlp, p), self._others(albedo)
        if self.segments is None:
            return evaluate_layers(*layers, output, others)
        segment = self.segments.at(p, prim)
        y = evaluate_layers(*layers, Unchanged(), others, self.segments.keys[segment])
        return self.segments.shown(output(self.segments(y, segment)), segment)

    def std(
        self, p: Tensor, albedo: Tensor | None = None, prim: Tensor | None = None, known: bool = True
    ) -> Tensor | None:
        """Posterior standard deviations [n, channels] where a refinement has found them, else None; as :meth:`at`.
        Those of the prior where photographs are not ``known``.
        """
        hierarchy = self._found
        return None if hierarchy is None else hierarchy.std(self.places(p, albedo, prim), known)

    @property
    def _found(self) -> Hierarchy | None:
        return self.hierarchy if self.hierarchy is not None and self.hierarchy.found else None

    def places(self, p: Tensor, albedo: Tensor | None, prim: Tensor | None = None) -> Places:
        """Positions [n, 3] as the hierarchy reads them; otherwise as :meth:`at`."""
        if albedo is None:
            raise ValueError(f"{self.parameter.name}: its field reads the albedo, which is not given")
        assert self.parts is not None
        part = self.parts.at(p, prim)
        return Places(self.cube(p), albedo.detach(), part, self.parts.mesh_of(part))

    def forward(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor:
        """Values [n, channels] at the lanes of ``si``; gradients reach the parameters, not the positions."""
        if self.known is None:
            return self.at(si.p, albedo, si.prim)
        if self._found is None:
            return self._by_layers(si.p, si.prim, albedo, Known(self.range, self.known, si))
        return self.known(si, self.at(si.p, albedo, si.prim))  # type: ignore[no-any-return]

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
