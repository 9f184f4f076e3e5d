"""The light that moves with the camera, as a camera file has it: ``flash``, Mitsuba's ``point`` or ``spot``."""

from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import FloatArray
from neurad.core.scene_records import PunctualLight
from neurad.runtime.numbers import LENGTH, RADIANCE, number
from neurad.runtime.reading import shown
from neurad.scene.punctual import check_punctual

PARAMETERS = {
    "point": ("type", "intensity", "position"),
    "spot": ("type", "intensity", "position", "direction", "cutoff_angle", "beam_width"),
}
"""What each kind may have."""
AHEAD = (0.0, 0.0, -1.0)


def read_flash(given: Any, where: str) -> PunctualLight | None:
    """The flash of a photograph, in the space of its camera; None where it has none.

    Args:
        given: the value of the key ``flash``.

    Raises:
        InputError: its kind is not known, it has no power, it sets what it has not, or a number is out of its range.
    """
    if given is None or given is False:
        return None
    where = f"{where}: its flash"
    if not isinstance(given, dict):
        raise InputError(f"{where} is {shown(repr(given))}, not an object with a type and an intensity")
    kind = given.get("type", "point")
    if kind not in PARAMETERS:
        raise InputError(f"{where}: its type is {shown(repr(kind))}; there are: {', '.join(PARAMETERS)}")
    if foreign := [key for key in given if key not in PARAMETERS[kind]]:
        raise InputError(f"{where}: a {kind} has no {shown(foreign[0])}, only {', '.join(PARAMETERS[kind][1:])}")
    if given.get("intensity") is None:
        raise InputError(
            f"{where} has no intensity: give its power per solid angle, a number or three; where it is not known say "
            "about how much, and let --model.lighting.flash fit find it"
        )
    cutoff = number(given.get("cutoff_angle", 20.0), f"{where}: its cutoff_angle", -RADIANCE, RADIANCE)
    light = PunctualLight(
        "flash", kind, _three(given["intensity"], f"{where}: its intensity", RADIANCE),
        _three(given.get("position", (0.0, 0.0, 0.0)), f"{where}: its position", LENGTH),
        _three(given.get("direction", AHEAD), f"{where}: its direction", LENGTH),
        cutoff, number(given.get("beam_width", 0.75 * cutoff), f"{where}: its beam_width", -RADIANCE, RADIANCE),
    )  # fmt: skip
    return check_punctual(light, where)


def described_flash(light: PunctualLight) -> dict[str, Any]:
    """The value of the key ``flash`` from which :func:`read_flash` makes it again."""
    values: dict[str, Any] = {"type": light.kind}
    for key in PARAMETERS[light.kind][1:]:
        value = getattr(light, key)
        values[key] = float(value) if isinstance(value, float) else [float(x) for x in value]
    return values


def _three(value: Any, where: str, largest: float) -> FloatArray:
    """Three numbers [3]; of one number three times that."""
    values = value if isinstance(value, list | tuple) else [value] * 3
    if len(values) != 3:
        raise InputError(f"{where} is {shown(repr(value))}, not three numbers")
    return np.array([number(x, where, -largest, largest) for x in values], np.float32)
