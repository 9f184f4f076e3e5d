"""Where a thing stands that is put into a scene: its axes, size, turn and place."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.core.records import Float64Array
from neurad.core.scene_records import EnvironmentMap, Mesh
from neurad.formats.axes import axis, held_up, turned
from neurad.runtime.numbers import LENGTH, within
from neurad.scene.description import Scene
from neurad.scene.origin import in_scene


@dataclass(frozen=True)
class Placement:
    """Where a thing goes, and how."""

    at: tuple[float, float, float]
    """Where the middle of its underside comes to stand, in scene units."""
    size: float | None = None
    """Longest side of its box in scene units; None keeps the units of the file."""
    scale: float = 1.0
    """Times as large."""
    turn: float = 0.0
    """Degrees about the vertical, counterclockwise as seen from above."""
    up: str = "y"
    """The axis of the file that points up: x, y, z, -x, -y or -z."""


def scene_axis(scene: Scene) -> str:
    """The axis that points up in a scene: as its cameras hold it, and y where they hold none."""
    try:
        return held_up([*scene.train, *scene.test]) if scene.train or scene.test else "y"
    except InputError:
        return "y"


def scene_up(scene: Scene, up: str) -> Float64Array:
    """The rotation that takes an axis to the one that points up in a scene [4, 4]."""
    return turned(up, scene_axis(scene), 1.0)


def turned_about(vector: npt.ArrayLike, degrees: float) -> Float64Array:
    """The rotation about a unit vector, counterclockwise for whom it points at [4, 4]."""
    from scipy.spatial.transform import Rotation  # imported where it is needed: it loads slowly

    made = np.eye(4)
    made[:3, :3] = Rotation.from_rotvec(math.radians(degrees) * np.asarray(vector, np.float64)).as_matrix()
    return made


def turned_environment(environment: EnvironmentMap, degrees: float) -> EnvironmentMap:
    """An environment turned about its own vertical axis, +Y before its pose, counterclockwise as seen from above."""
    pose = np.asarray(environment.to_world, np.float64) @ turned_about((0.0, 1.0, 0.0), degrees)
    return replace(environment, to_world=pose.astype(np.float32))


def placed(meshes: Sequence[Mesh], placement: Placement, scene: Scene, where: str) -> list[Mesh]:
    """Meshes of a file where they are to stand.

    Raises:
        InputError: a coordinate would be none to compute with, or a thing without extent is to get a size.
    """
    up = axis(scene_axis(scene))
    pose = turned_about(up, placement.turn) @ scene_up(scene, placement.up)
    corners = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float64) @ pose[:3, :3].T
    low, high = corners.min(0), corners.max(0)
    scale = placement.scale
    if placement.size is not None:
        side = float((high - low).max())
        if side <= 0.0:
            raise InputError(f"{where}: all its points are one, so it cannot get a size")
        scale *= placement.size / side
    middle = 0.5 * (low + high)
    foot = middle - up * (0.5 * float((high - low) @ np.abs(up)))
    made = []
    for mesh in meshes:
        there = (mesh.vertices.astype(np.float64) @ pose[:3, :3].T - foot) * scale + in_scene(placement.at, scene)
        within(there, f"{where}: its coordinates then", -LENGTH, LENGTH)
        normals = None if mesh.normals is None else (mesh.normals @ pose[:3, :3].T).astype(np.float32)
        made.append(replace(mesh, vertices=there.astype(np.float32), normals=normals))
    return made
