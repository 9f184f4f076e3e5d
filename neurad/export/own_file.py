"""A file that a room came from, and what is put into it: its kinds have this in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from neurad.assembly.build import Assembly
from neurad.core.parameters import PARAMETERS
from neurad.core.records import Array, FloatArray
from neurad.core.reflection import DiffuseLobe
from neurad.core.scene_records import Material
from neurad.export.base_colour import Target, base_for
from neurad.export.copies import Copies, Matcher, Mixed
from neurad.export.images import Coded, coded, eight_bits
from neurad.export.layouts import Layout, Polygons
from neurad.images.image_io import png, to_srgb


@dataclass(frozen=True)
class Surface:
    """What a texture of a file is for."""

    name: str
    layout: int | None
    """Number of its layout; None where one value has to do."""
    copies: Copies


@dataclass(frozen=True)
class Opened:
    """What a file shows, once its parts have texture coordinates."""

    surfaces: list[Surface]
    loose: list[str]
    """Things whose material none of the textures is for."""


class RoomFile(Protocol):
    """A file that a room came from."""

    def parts(self) -> list[list[Polygons]]:
        """Parts of its meshes, those together that share a texture."""

    def opened(self, layouts: Sequence[Layout], match: Matcher, origin: Array) -> Opened:
        """What it shows with these coordinates, matched with the run."""

    def write(self, painted: Sequence[Painted | None], assembly: Assembly, part: Path) -> list[str]:
        """Write the file; returns sentences about what it cannot hold."""


@dataclass(frozen=True)
class Painted:
    """The material of a surface."""

    material: Material
    """By its model; its textures are not read."""
    texture: Mixed
    target: Target
    """Whose base colours it gets."""
    lobe: DiffuseLobe
    """Diffuse lobe that they are converted from."""
    glow: FloatArray | None = None
    """Radiance of its texels [h, w, 3], where a part of it shines."""

    def files(self, upwards: bool = False) -> Coded | None:
        """Its textures, from the lowest row if ``upwards``, else from the highest; None where one value has to do."""
        if self.texture.baked.pixels.shape[:2] == (1, 1):
            return None
        return coded(
            {key: x[::-1] if upwards else x for key, x in self.texture.baked.maps.items()}, self.target, self.lobe
        )

    def emission(self, upwards: bool = False) -> tuple[bytes, float] | None:
        """Its radiance as a picture (sRGB, 8 bits) and what that is multiplied by; None where it does not shine."""
        if self.glow is None:
            return None
        strength = float(self.glow.max())
        return png(eight_bits(to_srgb(self.glow[:: -1 if upwards else 1] / strength))), strength

    def values(self) -> tuple[list[float], float, float]:
        """Base colour, roughness and metalness of the first texel."""
        albedo, roughness, metallic = (
            self.texture.baked.maps.get(p.name, np.full((1, 1, p.channels), p.absent))[:1, :1].astype(np.float32)
            for p in PARAMETERS
        )
        base = np.clip(base_for(self.target, albedo, roughness, self.lobe), 0.0, 1.0)
        return [float(x) for x in base.ravel()], roughness.item(), metallic.item()
