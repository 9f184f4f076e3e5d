"""Textures as 8-bit PNG files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neurad.core.parameters import ALBEDO, METALLIC, ROUGHNESS
from neurad.core.records import Bytes, FloatArray
from neurad.core.reflection import DiffuseLobe
from neurad.export.base_colour import Target, base_for, over_angles
from neurad.images.image_io import png, to_srgb, write_exr

ROWS = 1024
"""Rows of texels at once: bounds the memory."""


@dataclass(frozen=True)
class Coded:
    """The textures of a mesh as files."""

    base: bytes
    """Base colour, sRGB, 8 bits."""
    orm: bytes
    """Occlusion (1), roughness and metalness, linear, 8 bits."""
    clipped: int
    """Texels whose base colour would have left [0, 1]."""


def coded(maps: Mapping[str, FloatArray], target: Target, lobe: DiffuseLobe = "burley") -> Coded:
    """Textures of a mesh [h, w, channels], by the name of the surface parameter, as the two files that glTF and USD
    read; ``lobe`` is the diffuse one of the maps.
    """
    albedo = maps[ALBEDO.name]
    base = np.empty((*albedo.shape[:2], 3), np.uint8)
    orm = np.full(base.shape, 255, np.uint8)
    clipped = 0
    for top in range(0, len(albedo), ROWS):
        part = slice(top, top + ROWS)
        roughness, metallic = (
            maps[p.name][part].astype(np.float32) if p.name in maps else np.full(1, p.absent, np.float32)
            for p in (ROUGHNESS, METALLIC)
        )
        wanted = base_for(target, albedo[part].astype(np.float32), roughness, lobe)
        clipped += int(((wanted > 1.0) | (wanted < 0.0)).any(-1).sum())
        base[part] = eight_bits(to_srgb(wanted))
        orm[part, :, 1], orm[part, :, 2] = eight_bits(roughness[..., 0]), eight_bits(metallic[..., 0])
    return Coded(png(base), png(orm), clipped)


def texture_files(name: str) -> tuple[str, str]:
    """Where the two files of a mesh lie in a folder."""
    return f"textures/{name}_base_color.png", f"textures/{name}_orm.png"


def write_over_angles(path: Path) -> None:
    """Write what :func:`neurad.export.base_colour.over_angles` says as a picture for Blender, grey and linear."""
    table = np.repeat(over_angles()[::-1, :, None], 3, -1)  # the lowest row of a picture is v = 0 in Blender
    write_exr(path, np.ascontiguousarray(table), half=False)


def eight_bits(values: FloatArray | float) -> Bytes:
    """Values in [0, 1] as the nearest of 256 steps."""
    return np.asarray(np.rint(np.clip(values, 0.0, 1.0) * 255.0), np.uint8)
