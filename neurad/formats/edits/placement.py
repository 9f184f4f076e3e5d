"""Where things stand that are put into a scene, and ways for a camera to move: round a scene, round itself, and through
given cameras.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from neurad.core.camera import facing
from neurad.core.errors import InputError
from neurad.core.records import Array, Float64Array
from neurad.core.scene_records import Camera, EnvironmentMap, Mesh
from neurad.formats.axes import axis, held_up, turned
from neurad.runtime.numbers import LENGTH, within
from neurad.scene.description import Scene
from neurad.scene.origin import in_scene

Kind = Literal["turntable", "pan", "fly"]
"""Round a point, looking at it; round itself; through all cameras, one after the other."""
_DENSE = 64  # places in a stretch between two cameras, among which frames are spaced evenly


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


# ---- paths of cameras


def path_of(kind: str, cameras: Sequence[Camera], count: int, up: npt.ArrayLike, middle: npt.ArrayLike) -> list[Camera]:
    """Cameras along a path.

    Args:
        kind: one of :data:`Kind`.
        cameras: the first one begins a turntable or a pan; a flight passes all of them.
        count: number of frames. A full turn comes back to where it began after the last one.
        up: unit vector about which cameras turn.
        middle: what a turntable goes round, in scene units.

    Raises:
        InputError: a flight through a single camera, or a turntable that is right above what it goes round.
    """
    if kind == "fly":
        if len(cameras) < 2:
            raise InputError("--path fly: it needs two cameras or more (--camera, --views)")
        return _flight(cameras, count)
    first = cameras[0]
    axis = np.asarray(up, np.float64)
    if kind == "turntable":
        first = _facing(first, axis, np.asarray(middle, np.float64))
    about = np.asarray(middle, np.float64) if kind == "turntable" else np.asarray(first.to_world, np.float64)[:3, 3]
    made = []
    for index in range(count):
        turn = turned_about(axis, 360.0 * index / count)
        turn[:3, 3] = about - turn[:3, :3] @ about
        made.append(_posed(first, turn @ np.asarray(first.to_world, np.float64)))
    return made


def _facing(camera: Camera, up: Array, target: Array) -> Camera:
    """The camera at its place, upright and looking at a point."""
    eye = np.asarray(camera.to_world, np.float64)[:3, 3]
    back = eye - target
    if np.linalg.norm(np.cross(up, back)) <= 1e-6 * max(float(np.linalg.norm(back)), 1e-30):
        raise InputError("--path turntable: the first camera is right above or below the middle of the scene")
    return _posed(camera, facing(eye, back, up))


def _posed(camera: Camera, pose: Any) -> Camera:
    """The camera at another place; poses keep their digits."""
    return replace(camera, to_world=pose)


def _flight(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """A smooth path through cameras at an even pace: Catmull-Rom splines of places, turns (unit quaternions) and
    angles of view. Lens and size are those of the first one.
    """
    from scipy.interpolate import CubicHermiteSpline  # imported where they are needed: they load slowly
    from scipy.spatial.transform import Rotation

    turns: list[Any] = []
    for camera in cameras:
        q = Rotation.from_matrix(np.asarray(camera.to_world, np.float64)[:3, :3]).as_quat()
        turns.append(-q if turns and float(q @ turns[-1]) < 0.0 else q)
    places = np.array([np.asarray(camera.to_world, np.float64)[:3, 3] for camera in cameras])
    knots = np.concatenate((places, np.array(turns), np.array([[camera.fov_x] for camera in cameras])), 1)
    spline = CubicHermiteSpline(np.arange(len(knots)), knots, np.gradient(knots, axis=0))
    dense = spline(np.arange((len(knots) - 1) * _DENSE + 1) / _DENSE)
    extent = max(float(np.linalg.norm(np.ptp(places, axis=0))), 1e-30)
    steps = np.diff(dense, axis=0)
    # Half a turn takes as long as the way across all places.
    pace = np.linalg.norm(steps[:, :3], axis=1) / extent + np.linalg.norm(steps[:, 3:7], axis=1) / math.sqrt(2.0)
    along = np.concatenate(([0.0], np.cumsum(pace)))
    wanted = np.linspace(0.0, along[-1], count)
    values = np.stack([np.interp(wanted, along, column) for column in dense.T], 1)
    made = []
    for row in values:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_quat(row[3:7]).as_matrix(), row[:3]
        made.append(replace(_posed(cameras[0], pose), fov_x=float(row[7])))
    return made
