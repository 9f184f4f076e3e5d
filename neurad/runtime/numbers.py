"""Numbers that files give: whether they are numbers at all, and in the range that light transport can compute with.

All of it is computed in float32, which ends at 3.4e38 and loses its digits below 1.2e-38. The limits leave room for the
products that are taken.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.runtime.reading import shown

RADIANCE = 1e17
"""Largest radiance of a light: what it lights may be ten times as bright in a photograph."""
PIXEL = 1e18
"""Largest value in a photograph: its square, summed over the colours, is a number."""
DIM = 1e-16
"""Smallest root mean square of the photographs: a hundredth of its square, which keeps losses from dividing by 0, is
not rounded to fewer digits."""
LENGTH = 1e12
"""Largest coordinate in scene units: ray casters multiply three of them."""
TEXEL = 2.0**24
"""Largest texture coordinate: from here on float32 has no fractions, and so no place within a picture."""
UNIT = 1.0 + 1e-3
"""Largest albedo and roughness in a texture, with what filters overshoot; a single number is at most 1."""


def within(values: npt.ArrayLike, where: str, low: float, high: float) -> None:
    """Check that values lie in a range.

    Args:
        values: of any shape.
        where: file, element and name of the values, for the sentence.

    Raises:
        InputError: one is NaN, infinite or outside; the sentence has the value, or how many there are.
    """
    array = np.asarray(values)
    if array.size == 0 or (array.min() >= low and array.max() <= high):  # both are NaN if any value is
        return
    wrong = ~((array >= low) & (array <= high))
    span = f"from {low:.7g} to {high:.7g}" if math.isfinite(low) else f"up to {high:.7g}"
    first = f"{float(array[wrong][0]):.6g}"
    if array.size <= 4:
        listed = ", ".join(f"{float(x):.6g}" for x in array.reshape(-1))
        raise InputError(f"{where} is {listed}, which has to be {'a number' if array.size == 1 else 'numbers'} {span}")
    raise InputError(
        f"{where}: {int(wrong.sum())} of {array.size} values are not numbers {span} (the first of them is {first})"
    )


def check_bright(mean_square: float, brightest: float, scene: str) -> None:
    """Check that photographs are bright enough to compute with.

    Raises:
        InputError: they are black, or so dim that float32 loses their squares.
    """
    if brightest <= 0 and mean_square <= 0:
        raise InputError(f"scene {scene}: every training photograph is black")
    if mean_square < DIM**2:
        raise InputError(
            f"scene {scene}: the training photographs are too dim for numbers of 32 bits (up to {brightest:.3g}, but "
            f"typical values must be at least {DIM:g}): multiply them and the lights by the same factor"
        )


def unit(vectors: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Vectors [n, 3] at length 1, as float64; those without a length stay zero.

    What has length 1 already, as far as files of six digits know, stays as it is: a mesh that goes through another
    program's file and comes back has the same normals to the bit.
    """
    wide = np.asarray(vectors, np.float64)
    length = np.linalg.norm(wide, axis=1, keepdims=True)
    keep = (length == 0) | (np.abs(length - 1.0) < 1e-5)
    return np.asarray(wide / np.where(keep, 1.0, length))


def number(value: Any, where: str, low: float, high: float) -> float:
    """A single number that a file gives.

    Raises:
        InputError: it is none, or NaN, infinite or outside of the range.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{where} is {shown(repr(value))}, not a number")
    if not low <= value <= high:  # also of integers that no float can hold
        text = shown(value) if isinstance(value, int) else f"{value:.6g}"
        raise InputError(f"{where} is {text}, which has to be a number from {low:.7g} to {high:.7g}")
    return float(value)


def matrix(value: Any, where: str, low: float, high: float, side: int = 4) -> npt.NDArray[Any]:
    """A matrix [side, side] that a file gives as lists of numbers, as float64.

    Raises:
        InputError: it has another form, or an entry is no number in the range.
    """
    rows = value if isinstance(value, Sequence) else ()
    for part in (rows, *rows):
        if not isinstance(part, Sequence) or isinstance(part, str) or len(part) != side:
            raise InputError(f"{where} is not {side} x {side} numbers")
    entries = [[number(x, f"{where}: row {i + 1}, column {j + 1}", low, high) for j, x in enumerate(row)]
               for i, row in enumerate(value)]  # fmt: skip
    return np.array(entries, np.float64)
