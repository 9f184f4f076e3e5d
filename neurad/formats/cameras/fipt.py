"""Cameras of the data of FIPT and IRIS: rendered rooms with true materials, and photographed ones."""

from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.camera import facing
from neurad.core.errors import InputError, Refusals
from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import View
from neurad.formats.cameras.intrinsics import camera_of, make_camera, rigid
from neurad.formats.cameras.nerf import Split, frames_of
from neurad.formats.cameras.photograph_files import any_case, listed_file
from neurad.images.picture_headers import check_exr
from neurad.runtime.numbers import LENGTH, number
from neurad.runtime.reading import exists, read_text, regular_file, shown

MESH = "scene.obj"
_MAPS = {ALBEDO: "DiffCol", ROUGHNESS: "Roughness"}
"""Folders of true maps."""
_LOOKS = np.diag([-1.0, 1.0, -1.0, 1.0])
"""Rendered rooms: the camera looks along +Z with +X to the left, under the keys of NeRF."""
_STRAIGHT = 2e-2  # largest cosine between the directions that should be perpendicular


def read_room(source: Path, images: Path | None) -> Split:
    """The views of a room.

    Args:
        source: a rendered room (``train/transforms.json``, ``val/transforms.json``) or a photographed one (``cam.txt``,
            ``K_list.txt``), of which nothing is held out.
        images: ``--images``, which has no place here.

    Raises:
        InputError: it is none of them, a file is missing or broken, or there are ``images``.
    """
    if images is not None:
        raise InputError("--images: the data of FIPT say themselves where their photographs are; leave it out")
    if exists(source / "train/transforms.json"):
        held_out = exists(source / "val/transforms.json")
        return Split(_rendered(source / "train"), _rendered(source / "val") if held_out else [], stated=held_out)
    if exists(source / "cam.txt"):
        return Split(_photographed(source), [])
    raise InputError(f"{shown(source)}: it has neither train/transforms.json nor cam.txt, as the data of FIPT have")


def _rendered(folder: Path) -> list[View]:
    """The views of ``train`` or ``val``; photographs and maps go by their number."""
    path = folder / "transforms.json"
    described, frames = frames_of(path)
    views = []
    refusals = Refusals()
    for index, frame in enumerate(frames):
        with refusals.part():
            where = f"{path}: frame {index}"
            if not isinstance(frame, dict):
                raise InputError(f"{where} is not an object")
            image = listed_file(folder / f"Image/{index:03d}_0001.exr", f"the photograph of frame {index} is missing")
            pose: FloatArray = rigid(frame.get("transform_matrix"), f"{where}: its transform_matrix") @ _LOOKS
            camera = camera_of((frame, described), check_exr(image), pose, where)
            maps = {
                parameter.name: str(regular_file(file))
                for parameter, kind in _MAPS.items()
                if (file := any_case(folder / f"{kind}/{index:03d}_0001.exr")) is not None
            }
            views.append(View(f"{folder.name}_{index:03d}", camera, str(image), maps))
    refusals.end()
    return views


def _photographed(source: Path) -> list[View]:
    """The views of ``cam.txt`` and ``K_list.txt``: a number of cameras, then three lines of three numbers for each."""
    poses, inner = (_triples(source / name) for name in ("cam.txt", "K_list.txt"))
    if len(poses) != len(inner):
        raise InputError(f"{source / 'K_list.txt'}: it has {len(inner)} cameras, but cam.txt has {len(poses)}")
    views = []
    refusals = Refusals()
    for index, ((eye, target, up), k) in enumerate(zip(poses, inner, strict=True)):
        with refusals.part():
            where = f"{source / 'cam.txt'}: camera {index}"
            image = listed_file(source / f"Image/{index:03d}_0001.exr", f"the photograph of camera {index} is missing")
            about = f"{source / 'K_list.txt'}: camera {index}"
            if np.abs((k[0, 1], k[1, 0], k[2, 0], k[2, 1], k[2, 2] - 1.0)).max() > 1e-6:
                raise InputError(f"{about}: its matrix is not fx 0 cx, 0 fy cy, 0 0 1")
            values = {"fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
            pose: Any = _looking(eye, target, up, where)
            camera = make_camera(pose, check_exr(image), "PINHOLE", values, about)
            views.append(View(f"{index:03d}", camera, str(image)))
    refusals.end()
    return views


def _looking(eye: Float64Array, target: Float64Array, up: Float64Array, where: str) -> Float64Array:
    """Camera to world, OpenGL axes, of a camera that looks from a point at another."""
    forward, length = target - eye, float(np.linalg.norm(up))
    distance = float(np.linalg.norm(forward))
    if distance == 0 or length == 0 or abs(forward @ up) > _STRAIGHT * distance * length:
        raise InputError(f"{where}: the directions in which it looks and up are not perpendicular")
    return facing(eye, -forward, up / length)


def _triples(path: Path) -> list[Float64Array]:
    """Matrices [3, 3] of a text file."""
    lines = [line.split() for line in read_text(path, "a photographed room of FIPT has this file").splitlines()]
    lines = [line for line in lines if line]
    try:
        count = int(lines[0][0])
        rows = [[float(word) for word in line] for line in lines[1:]]
    except (IndexError, ValueError) as error:
        raise InputError(f"{path}: it is not a number of cameras and then numbers") from error
    if count < 1 or len(rows) != 3 * count or any(len(row) != 3 for row in rows):
        raise InputError(f"{path}: it has {len(rows)} lines of numbers, but {count} cameras have three of three each")
    for index, row in enumerate(rows):
        for value in row:
            number(value, f"{path}: a number of camera {index // 3}", -LENGTH, LENGTH)
    return list(np.array(rows, np.float64).reshape(count, 3, 3))
