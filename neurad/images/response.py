"""Response curves of cameras, undone: from codes in a file to linear values."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, Float64Array, FloatArray
from neurad.images.image_io import from_srgb
from neurad.runtime.reading import expanded, read_text, shown

LINEAR, SRGB, FIT = "linear", "srgb", "fit"
_GAMMA = "gamma="
_STEEPEST = 10.0
"""Largest gamma, and one over the smallest."""
_ROWS = 1 << 16  # of a curve in a file


def check_response(text: str) -> None:
    """Refuse what is no response.

    Args:
        text: ``linear``, ``srgb``, ``gamma=G``, ``fit`` or the name of a file with a curve.

    Raises:
        InputError: it is none of these, G is no exponent, or the curve of the file cannot be undone.
    """
    if text == "emor":
        raise InputError(
            "--data.response emor: the published table of EMoR is not part of neurad; fit recovers a monotone curve, "
            "and a calibrated one may be given as a file"
        )
    if text not in (LINEAR, SRGB, FIT):
        _gamma(text) if text.startswith(_GAMMA) else _curve(text)


@lru_cache(16)
def linear_values(response: str, levels: int) -> FloatArray:
    """Linear value of every code [levels + 1], from 0 to 1, read-only, of a response as in :func:`check_response`;
    ``fit`` begins at the sRGB curve.
    """
    codes = np.arange(levels + 1, dtype=np.float64) / levels
    table: FloatArray = _undone(response, codes).astype(np.float32)
    table.flags.writeable = False
    return table


def linear_value(response: str, value: float) -> float:
    """Linear value of one code, as a fraction of the largest; itself where there is no ``response``."""
    return value if not response else float(_undone(response, np.array([value]))[0])


def _undone(response: str, codes: Array) -> Array:
    if response == LINEAR:
        return codes
    if response in (SRGB, FIT):
        return from_srgb(codes)
    if response.startswith(_GAMMA):
        found: Float64Array = codes ** _gamma(response)
        return found
    known, values = _curve(response)
    linear: Float64Array = np.interp(codes, known, values)
    return linear


def _gamma(text: str) -> float:
    try:
        gamma = float(text.removeprefix(_GAMMA))
    except ValueError:
        gamma = float("nan")
    if not 1.0 / _STEEPEST <= gamma <= _STEEPEST:
        raise InputError(
            f"--data.response {shown(text)}: the exponent has to be a number from {1.0 / _STEEPEST:g} to "
            f"{_STEEPEST:g}, such as gamma=2.2"
        )
    return gamma


@lru_cache(4)
def _curve(name: str) -> tuple[Float64Array, Float64Array]:
    """Codes and linear values of a file, both scaled to [0, 1]."""
    if "." not in Path(name).name:
        raise InputError(
            f"--data.response {shown(name)}: it is unknown, choose linear, srgb, gamma=G, fit, or a file of a curve"
        )
    path = expanded(name, "--data.response")
    lines = [line.replace(",", " ").split() for line in read_text(path, "there is no such response").splitlines()]
    rows = [line for line in lines if line and not line[0].startswith("#")]
    try:
        points = np.array([[float(x) for x in row] for row in rows[:_ROWS]], np.float64)
    except ValueError:
        points = np.zeros(0)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2 or not np.isfinite(points).all():
        raise InputError(f"{shown(path)}: a response has two numbers a line: code, linear value")
    codes, values = points.T
    wrong = np.flatnonzero((np.diff(codes) <= 0) | (np.diff(values) <= 0))
    if len(wrong):
        raise InputError(
            f"{shown(path)}: the response is not monotone: after code {codes[wrong[0]]:g} (linear value "
            f"{values[wrong[0]]:g}) code and value have to rise, so it cannot be undone"
        )
    if values[0] < 0:
        raise InputError(f"{shown(path)}: the response begins at the linear value {values[0]:g}, below 0")
    return codes / codes[-1], values / values[-1]
