"""Lights without extent: what light transport can be computed with, and their units in other programs."""

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from neurad.core.camera import facing
from neurad.core.errors import InputError
from neurad.core.scene_records import PunctualKind, PunctualLight
from neurad.runtime.numbers import LENGTH, RADIANCE, within
from neurad.runtime.reading import shown

LUMENS_PER_WATT = 683.0
"""Photometric units over the radiometric ones of a scene: candela per W/sr and lux per W/m2, whatever the colour, as
Blender writes and reads glTF's lights."""
KINDS: tuple[PunctualKind, ...] = get_args(PunctualKind)


def check_punctual(light: PunctualLight, where: str) -> PunctualLight:
    """This light, if light transport can be computed with it.

    Raises:
        InputError: its intensity is negative, its direction zero, its cone none, or a value is NaN or infinite.
    """
    if light.kind not in KINDS:
        raise InputError(f"{where}: its type is {shown(light.kind)}; there are: {', '.join(KINDS)}")
    measure = "irradiance" if light.kind == "directional" else "intensity"
    within(light.intensity, f"{where}: its {measure}", 0.0, RADIANCE)
    within(light.position, f"{where}: its position", -LENGTH, LENGTH)
    direction = np.asarray(light.direction, np.float64)
    if not np.isfinite(direction).all() or not np.linalg.norm(direction) > 0:
        listed = ", ".join(f"{x:.6g}" for x in direction)
        raise InputError(f"{where}: its direction is {listed}, which points nowhere")
    if light.kind == "spot":
        if not 0.0 < light.cutoff_angle < 90.0:
            raise InputError(
                f"{where}: its cutoff_angle is {light.cutoff_angle:.6g}, which has to be between 0 and 90 degrees"
            )
        if not 0.0 <= light.beam_width <= light.cutoff_angle:
            raise InputError(
                f"{where}: its beam_width is {light.beam_width:.6g}, which has to be a number from 0 to its "
                f"cutoff_angle, {light.cutoff_angle:.6g} degrees"
            )
    return light


def moved_light(light: PunctualLight, similarity: npt.NDArray[np.float64]) -> PunctualLight:
    """A light in another frame, in which it lights surfaces as before.

    Args:
        similarity: takes its frame to the other [4, 4]. Where that has lengths times s, intensities of points and spots
            are times s squared.
    """
    linear = similarity[:3, :3]
    length = abs(float(np.linalg.det(linear))) ** (1.0 / 3.0)
    times = 1.0 if light.kind == "directional" else length**2
    position: Any = linear @ np.asarray(light.position, np.float64) + similarity[:3, 3]  # to float32 near the origin
    return replace(
        light,
        intensity=np.asarray(light.intensity * np.float32(times), np.float32),
        position=position,
        direction=(linear @ np.asarray(light.direction, np.float64) / length).astype(np.float32),
    )


def pose(light: PunctualLight, axis: float = 1.0) -> npt.NDArray[np.float64]:
    """A rotation and translation [4, 4], float64, whose Z axis, times ``axis``, is the direction of the light."""
    z = np.asarray(light.direction, np.float64)
    z = axis * z / np.linalg.norm(z)
    return facing(light.position, z, np.eye(3)[int(np.abs(z).argmin())])
