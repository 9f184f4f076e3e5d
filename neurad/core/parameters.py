"""What a surface is made of: one row for each parameter of its reflection.

Whatever treats parameters alike loops over these rows: fields, optimizers, derivatives, scores, pictures, maps, readers
and writers. What reflects light has them by name, as :class:`neurad.core.records.Surface`.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class SurfaceParameter:
    """A parameter of reflection that varies over surfaces."""

    name: str
    """Its name: of settings, of fields of :class:`~neurad.core.records.Surface` and
    :class:`~neurad.core.scene_records.Material`, of scores and maps, and of the folders in which maps lie."""
    channels: int
    low: float
    """Smallest value that is recovered."""
    high: float
    """Largest value that is recovered."""
    absent: float
    """What holds in a scene that does not have it."""
    mitsuba: str
    """Its name in Mitsuba's ``principled``."""
    blender: str
    """Its name in Blender's Principled BSDF."""
    usd: str
    """Its name in UsdPreviewSurface."""
    gltf: str
    """What glTF's ``pbrMetallicRoughness`` calls its factor, without ``Factor``."""
    ends: tuple[str, str] | None = None
    """What the ends of a scale of its values mean; None of a colour, which is shown by the sRGB curve."""
    is_recovered: bool = True
    """Whether a fit recovers it; what is not recovered is kept as files have it."""


ALBEDO = SurfaceParameter(
    "albedo", 3, 0.0, 1.0, 0.5, mitsuba="base_color", blender="Base Color", usd="diffuseColor", gltf="baseColor"
)  # fmt: skip
"""Base colour, linear; of a metal its reflectance at normal incidence."""
ROUGHNESS = SurfaceParameter(
    "roughness", 1, 0.02, 1.0, 1.0, mitsuba="roughness", blender="Roughness", usd="roughness", gltf="roughness",
    ends=("0 smooth", "1 rough"),
)  # fmt: skip
"""Burley's, alpha its square. Below 0.02 a highlight is narrower than a pixel, and its gradient is all noise."""
METALLIC = SurfaceParameter(
    "metallic", 1, 0.0, 1.0, 0.0, mitsuba="metallic", blender="Metallic", usd="metallic", gltf="metallic",
    ends=("0 dielectric", "1 metal"), is_recovered=False,
)  # fmt: skip
"""0 of a dielectric, 1 of a metal; in between both are blended."""

PARAMETERS = (ALBEDO, ROUGHNESS, METALLIC)
"""All of them: a field may read the first."""
BY_NAME = {parameter.name: parameter for parameter in PARAMETERS}
RECOVERED = tuple(parameter.name for parameter in PARAMETERS if parameter.is_recovered)
"""Names of those that a fit recovers, and that are scored."""


def split(
    values: npt.NDArray[np.floating], parameters: Sequence[SurfaceParameter]
) -> dict[str, npt.NDArray[np.floating]]:
    """Parameters that stand one after the other [..., channels], by name."""
    ends = np.cumsum([parameter.channels for parameter in parameters])[:-1]
    return dict(zip((parameter.name for parameter in parameters), np.split(values, ends, -1), strict=True))


def recovered(parameters: Iterable[SurfaceParameter]) -> tuple[SurfaceParameter, ...]:
    """Those that a fit recovers."""
    return tuple(parameter for parameter in parameters if parameter.is_recovered)
