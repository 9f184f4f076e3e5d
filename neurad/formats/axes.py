"""Which way is up: axes by their names, and the rotations that turn one to another."""

import re
from collections.abc import Sequence
from typing import Literal, cast

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, Float64Array
from neurad.core.scene_records import View
from neurad.runtime.numbers import number
from neurad.runtime.reading import shown
from neurad.scene.description import Scene

UP = {f"{sign}{axis}": i * 2 + (sign == "-") for i, axis in enumerate("xyz") for sign in ("", "-")}
"""Axes that may point up."""
_ROUNDED = 1e-2  # what matrices written with three digits have too much or too little
_TILT = 0.8  # smallest cosine between the mean of what cameras hold up and an axis
Up = Literal["x", "y", "z", "-x", "-y", "-z"]


def axis(name: str) -> Float64Array:
    """The unit vector of one of :data:`UP`."""
    index = UP[name]
    vector = np.zeros(3)
    vector[index // 2] = -1.0 if index % 2 else 1.0
    return vector


def most_up(views: Sequence[View]) -> tuple[str, Float64Array]:
    """The axis that comes closest to what cameras hold up on average, and that direction [3]."""
    mean = np.mean([view.camera.to_world[:3, 1] for view in views], axis=0)
    return max(UP, key=lambda name: float(axis(name) @ mean)), mean


def held_up(views: Sequence[View]) -> str:
    """The axis that cameras hold up on average.

    Raises:
        InputError: there is no such axis.
    """
    name, mean = most_up(views)
    if axis(name) @ mean < _TILT * np.linalg.norm(mean) or np.linalg.norm(mean) < 0.1:
        raise InputError(
            f"--up: the cameras hold no axis up (on average {', '.join(f'{x:.2f}' for x in mean)}), so the mesh cannot "
            "be turned to theirs; turn it in the program that it comes from"
        )
    return name


def turned(up: str, to: str, scale: float) -> Float64Array:
    """The similarity that takes an axis to another by the shortest way and scales [4, 4]."""
    a, b = axis(up), axis(to)
    matrix = np.eye(4)
    if a @ b < -0.5:  # straight down: half a turn about an axis beside it
        side = axis("x" if abs(a[0]) < 0.5 else "y")
        matrix[:3, :3] = 2.0 * np.outer(side, side) - np.eye(3)
    elif a @ b < 0.5:
        cross = np.cross(a, b)
        matrix[:3, :3] = np.outer(b, a) - np.outer(a, b) + np.outer(cross, cross)
    matrix[:3, :3] *= scale
    return matrix


def axes(words: str) -> Float64Array:
    """The rotation [4, 4] by which axes of a mesh become those of the cameras.

    Args:
        words: the mesh's axes that become X, Y and Z, such as ``zxy`` or ``x,-z,y``; or the nine numbers of the matrix,
            row by row.

    Raises:
        InputError: they are neither, or no rotation.
    """
    parts = re.sub(r"[\[\],;\s]+", " ", words).split()
    letters = re.findall(r"[-+]?[xyz]", "".join(parts))
    made = np.eye(4)
    if len(letters) == 3 and "".join(letters) == "".join(parts):
        made[:3, :3] = [axis(name.lstrip("+")) for name in letters]
    else:
        try:
            made[:3, :3] = np.array([number(float(x), "--axes: a number", -1.01, 1.01) for x in parts]).reshape(3, 3)
        except ValueError as error:
            raise InputError(
                f"--axes {shown(words)}: it is neither three axes such as zxy or x,-z,y, nor a matrix of nine numbers"
            ) from error
    u, stretch, v = np.linalg.svd(made[:3, :3])
    if np.abs(stretch - 1.0).max() > _ROUNDED or np.linalg.det(made[:3, :3]) < 0:
        why = "it mirrors" if np.linalg.det(made[:3, :3]) < -0.5 else "its rows are not of length 1 and perpendicular"
        raise InputError(f"--axes {shown(words)}: it is no rotation ({why}); --scale is for the size")
    made[:3, :3] = u @ v
    return made


def up_axis(scene: Scene) -> Up:
    """The axis that the cameras of a scene hold up on average; ``y`` without cameras."""
    views = (*scene.train, *scene.test)
    return cast(Up, most_up(views)[0]) if views else "y"


def rotation(up: Up) -> Array:
    """The matrix [3, 3] that turns an up axis to +Y."""
    return turned(up, "y", 1.0)[:3, :3]
