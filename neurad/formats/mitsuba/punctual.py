"""Mitsuba's lights without extent: ``point``, ``spot`` and ``directional``."""

from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import PunctualLight
from neurad.scene.origin import ZERO
from neurad.scene.punctual import check_punctual

PARAMETERS = {
    "point": ("intensity", "position", "to_world"),
    "spot": ("intensity", "to_world", "cutoff_angle", "beam_width"),
    "directional": ("irradiance", "direction", "to_world"),
}
"""What each may set, the light that it sends first."""
_ROUND = 1e-4  # largest relative deviation of a spot's axes from orthogonal ones of one length


def read_punctual(
    props: Any, name: str, intensity: FloatArray, to_world: FloatArray, where: str, origin: Float64Array = ZERO
) -> PunctualLight:
    """A light from the properties of its element.

    Args:
        intensity: what it sends [3].
        to_world: its transform [4, 4] after ``origin`` was subtracted, the identity where it has none.
        origin: subtracted from its position [3].

    Raises:
        InputError: its place or direction is given twice, its cone is not round, or a number is out of its range.
    """
    kind = props.plugin_name()
    own = {"point": "position", "directional": "direction"}.get(kind)
    if own is not None and own in props and "to_world" in props:
        raise InputError(f"{where}: it has both {own} and to_world; give one of them")
    position, direction = to_world[:3, 3], to_world[:3, 2]
    if kind == "point" and "position" in props:
        position = _vector(props["position"], f"{where}: its position", origin)
    if kind == "directional" and "direction" in props:
        direction = _vector(props["direction"], f"{where}: its direction")
    angles = {}
    if kind == "spot":
        axes = to_world[:3, :3].astype(np.float64)
        axes /= np.linalg.norm(axes, axis=0).mean()
        if not np.abs(axes.T @ axes - np.eye(3)).max() <= _ROUND:
            raise InputError(f"{where}: its to_world stretches it, and its cone would not be round")
        cutoff = _degrees(props, "cutoff_angle", 20.0, where)
        angles = {"cutoff_angle": cutoff, "beam_width": _degrees(props, "beam_width", 0.75 * cutoff, where)}
    light = PunctualLight(name, kind, intensity, position, direction, **angles)
    return check_punctual(light, where)


def _vector(value: Any, where: str, origin: Float64Array = ZERO) -> FloatArray:
    """Three numbers [3]; those that float32 cannot hold are infinite."""
    with np.errstate(over="ignore"):
        made = np.array(value, np.float64).reshape(-1)
        if made.shape != (3,):
            raise InputError(f"{where} is not three numbers")
        return np.asarray(made - origin, np.float32)


def _degrees(props: Any, key: str, default: float, where: str) -> float:
    value = props.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where}: its {key} is not a number")
    return float(value)
