"""Rooms far from the origin of their coordinates, as surveys have them (UTM): moved near it before numbers lose digits.

A float32 knows a place a thousand kilometres away to six centimetres. Readers therefore keep positions as float64, and
where a scene is put together a point within it is subtracted, ``Scene.origin``. It is added again to all that is given
back: cameras, exports, what the viewer reads out.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import Float64Array
from neurad.core.scene_records import Camera, Mesh, View
from neurad.scene.description import Scene

ZERO: Float64Array = np.zeros(3)
MAX_DISTANCE = 100.0
"""Distance from the origin, in radii of a scene, up to which it stays where it is: float32 then knows places to a
hundred-thousandth of the radius."""
_USUAL = 95.0  # percentile of the distances from the middle that counts as the radius: some lie anywhere


def origin_of(meshes: Iterable[Mesh]) -> Float64Array:
    """What is to be subtracted from the coordinates of meshes [3]: 0 where they lie near the origin, else a point among
    them in round numbers.
    """
    points = [np.asarray(mesh.vertices, np.float64) for mesh in meshes if len(mesh.vertices)]
    if not points:
        return ZERO
    places = np.concatenate(points)
    middle = np.median(places, 0)
    radius = float(np.percentile(np.linalg.norm(places - middle, axis=1), _USUAL))
    if not np.abs(middle).max() > MAX_DISTANCE * radius:
        return ZERO
    step = 10.0 ** math.floor(math.log10(radius)) if radius > 0 else 1.0
    return np.asarray(np.round(middle / step) * step)


def stored_spacing(scene: Scene) -> float:
    """Distance between two neighbouring coordinates of a scene that was moved, if its file has stored them as float32:
    then all along an axis are such numbers. 0 where none are, or where they are finer than a hundred-thousandth of the
    scene.
    """
    places = np.concatenate([mesh.vertices for mesh in scene.meshes]).astype(np.float64)
    spacing = np.spacing(np.abs(scene.origin).astype(np.float32)).astype(np.float64)
    whole = places + np.asarray(scene.origin)
    stored = (whole == whole.astype(np.float32)).all(0) & (spacing > 1e-5 * np.ptp(places, axis=0).max())
    return float(spacing[stored].max(initial=0.0))


def moved_views(views: Sequence[View], step: npt.ArrayLike) -> list[View]:
    """Views whose cameras are moved by a step [3]."""
    return [replace(view, camera=moved_camera(view.camera, step)) for view in views]


def moved_camera(camera: Camera, step: npt.ArrayLike) -> Camera:
    """A camera that is moved by a step [3]."""
    if not np.any(step):
        return camera
    pose: Any = np.array(camera.to_world, np.float64)
    pose[:3, 3] += step
    return replace(camera, to_world=pose)


def near(scene: Scene, origin: Float64Array) -> Scene:
    """A scene whose positions are float64 with ``origin`` subtracted, its meshes as float32."""
    meshes = [replace(mesh, vertices=(mesh.vertices - origin).astype(np.float32)) for mesh in scene.meshes]
    lights = [replace(light, position=(light.position - origin).astype(np.float32)) for light in scene.punctual]
    return replace(
        scene,
        meshes=meshes,
        punctual=tuple(lights),
        train=moved_views(scene.train, -origin),
        test=moved_views(scene.test, -origin),
        origin=(float(origin[0]), float(origin[1]), float(origin[2])),
    )


def in_scene(positions: npt.ArrayLike, scene: Scene) -> Float64Array:
    """Positions [..., 3] relative to ``scene.origin``, given in the coordinates of the scene's files or so already.

    A room is moved only where it lies many times its size from the origin, so that one reading alone is in it.
    """
    places, origin = np.asarray(positions, np.float64), np.asarray(scene.origin)
    moved = places - origin
    nearer = np.linalg.norm(moved, axis=-1, keepdims=True) < np.linalg.norm(places, axis=-1, keepdims=True)
    return np.where(nearer, moved, places)


def camera_in_scene(camera: Camera, scene: Scene) -> Camera:
    """A camera whose place is read as :func:`in_scene` says."""
    eye = np.asarray(camera.to_world, np.float64)[:3, 3]
    return moved_camera(camera, in_scene(eye, scene) - eye)


def place_text(place: Iterable[float], between: str = ", ") -> str:
    """A place for people: four digits, and of large numbers those to a hundredth."""
    return between.join(f"{x:.4g}" if abs(x) < 1e4 else f"{x:.2f}" for x in place)
