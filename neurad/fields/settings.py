"""Settings of fields, as they are written in YAML."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from neurad.core.errors import InputError
from neurad.core.ranges import Checked, Range
from neurad.fields.encoding import Encoding

RADIANCE_INPUTS = {"direction": 3, "reflection": 3, "normal": 3, "faceforward": 3, "albedo": 3, "flash": 24}
"""What a radiance field may read beside the position, each with its number of channels."""
GLOSSY_INPUTS = ("direction", "normal", "albedo")
DIFFUSE_INPUTS = ("faceforward",)


Structure = Literal["auto", "groups", "smooth", "free"]
"""What a map is made of: groups and details of a place; groups alone; details of a place alone; what gradients say."""
Kind = Literal["hash", "dense"]
"""Kinds of fields that are neurad's own; :mod:`neurad.fields.select` makes them."""


@dataclass(frozen=True)
class GridConfig(Checked):
    """Size of a multiresolution hash grid (Mueller et al. 2022). The paper's has 16 levels from 2 to 65536 cells."""

    levels: Annotated[int, Range(1, 64)] = 8
    """Number of resolutions, growing geometrically."""
    coarsest: Annotated[int, Range(1, 1 << 20)] = 4
    """Cells along the longest side of the scene at the first level."""
    finest: Annotated[int, Range(1, 1 << 20)] | None = 256
    """Cells along the longest side of the scene at the last level, or of a dense grid; null: as fine as the photographs
    show the scene, cells as large as a pixel where the cameras are close."""
    log2_size: Annotated[int, Range(3, 24)] = 17
    """Levels of more than 2^log2_size vertices are hashed into so many entries."""

    def __post_init__(self) -> None:
        """Refuse sizes that no grid can have."""
        super().__post_init__()
        if self.finest is not None and self.coarsest > self.finest:
            raise InputError(f"grid: coarsest ({self.coarsest}) must not be above finest ({self.finest})")


@dataclass(frozen=True)
class FieldConfig(Checked):
    """Kind and size of a field: a hash grid and the network that reads it, or a dense grid of values alone."""

    grid: GridConfig = GridConfig()
    width: Annotated[int, Range(1, 1 << 14)] = 64
    """Neurons of a hidden layer."""
    hidden_layers: Annotated[int, Range(0, 64)] = 1
    """Hidden layers of the network; 0 is one linear map."""
    kind: Kind | Encoding = "hash"
    """``hash``: a hash grid and a network that reads it; ``dense``: a dense grid of values, without either, of
    ``grid.finest`` cells along a side, of which 255 take 604 MB for three channels with the moments of Adam; or a class
    of your own, an encoding that a network reads."""

    @property
    def has_network(self) -> bool:
        """Whether a network reads its encoding; otherwise the position alone counts."""
        return self.kind != "dense"

    @property
    def has_levels(self) -> bool:
        """Whether it has the levels of :attr:`grid`."""
        return self.kind == "hash"


@dataclass(frozen=True)
class AlbedoConfig(FieldConfig):
    """Size of an albedo field, and whether it knows what meshes are made of."""

    by_segments: bool = False
    """Whether each smooth piece of each mesh has a value of its own, which grid and network add to, and entries of its
    own in the hashed levels, so that what touches is not smeared over its neighbour. For hash grids."""


@dataclass(frozen=True)
class RoughnessConfig(FieldConfig):
    """Size and inputs of a roughness field."""

    reads_albedo: bool = False
    """Whether the network reads the albedo beside the position: what looks the same is then taken to shine the same,
    unless a highlight says otherwise. With a coarse grid it carries roughness from where a highlight is seen to where
    none is. A dense grid has no network to read it."""
    structure: Structure = "free"
    """What all training pixels together are asked for towards the end of a fit, which takes the place of what gradients
    have found, as these are too noisy: ``groups``, what surfaces of like colour and connected parts have in common;
    ``smooth``, what varies from place to place; ``auto``, both, each as far as the photographs tell. ``free`` asks for
    nothing. For hash grids."""
    begin: Literal["middle", "best"] = "middle"
    """Where roughness begins: at one half, or, once albedo and light are roughly known, at the one of a few values at
    which the photographs are surely explained better. From one half nothing leads to near mirrors. A dense grid begins
    at one half."""


@dataclass(frozen=True)
class RadianceConfig(FieldConfig):
    """Size and inputs of a radiance field."""

    grid: GridConfig = GridConfig(finest=64, log2_size=15)
    hidden_layers: Annotated[int, Range(0, 64)] = 3
    inputs: tuple[str, ...] | None = None
    """Read beside the position, any of: ``direction`` (wo), ``reflection`` (wo mirrored at the normal), ``normal``,
    ``faceforward`` (the normal on the viewer's side), ``albedo``. Without any given, ``direction``, ``normal`` and
    ``albedo``; in a diffuse scene ``faceforward`` alone and one hidden layer less, since a surface there looks the same
    from everywhere on its side. Where photographs have a flash, ``flash`` as well: where it is, seen from the point. A
    dense grid reads the position alone, so its radiance is the same in all directions, and whatever the flash is.
    """

    def __post_init__(self) -> None:
        """Refuse inputs that do not exist."""
        super().__post_init__()
        for name in self.inputs or ():
            if name not in RADIANCE_INPUTS:
                raise InputError(f"radiance.inputs: '{name}' is unknown, choose from {', '.join(RADIANCE_INPUTS)}")

    def resolved(self, diffuse: bool, flash: bool = False) -> RadianceConfig:
        """These settings with the inputs that a scene needs, where none are given.

        Args:
            diffuse: whether every surface of the scene is diffuse, delta surfaces aside.
        """
        if self.inputs is not None:
            return self
        if flash:  # which direct light and its shadows are read by; the rest needs no fewer layers
            return replace(self, inputs=(*(DIFFUSE_INPUTS if diffuse else GLOSSY_INPUTS), "flash"))
        if not diffuse:
            return replace(self, inputs=GLOSSY_INPUTS)
        return replace(
            self, inputs=DIFFUSE_INPUTS, hidden_layers=max(self.hidden_layers - 1, min(self.hidden_layers, 1))
        )
