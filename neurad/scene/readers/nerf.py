"""Cameras of photographs, as NeRF and Blender write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.camera import fov_of
from neurad.core.errors import InputError
from neurad.core.records import Camera, FloatArray, View
from neurad.runtime.reading import exists, read_json, regular_file, shown
from neurad.scene.image_io import read_exr
from neurad.scene.numbers import LENGTH, matrix, number
from neurad.scene.picture_headers import SIDE

_ANGLES = 1e-4, 3.1
"""Smallest and largest angle of view in radians: beyond them neighbouring pixels see the same in float32."""
_RIGID = 1e-4  # largest deviation from orthonormal axes; the cameras of Blender have about 1e-6
_FAR = 1e12  # largest other number: no camera has any near it
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

Size = tuple[int, int]


def read_split(folder: Path) -> tuple[list[View], list[View]]:
    """Training and held-out views of ``transforms_train.json`` and ``transforms_test.json``.

    Raises:
        InputError: one of the files is missing, or as :func:`read_views`.
    """
    for name in ("transforms_train.json", "transforms_test.json"):
        regular_file(folder / name, "the scene folder lacks this file")
    train = read_views(folder / "transforms_train.json", folder)
    camera = train[0].camera
    return train, read_views(folder / "transforms_test.json", folder, (camera.width, camera.height))


def read_views(path: str | Path, root: str | Path, size: Size | None = None) -> list[View]:
    """The views of a camera file; paths in it are relative to ``root``.

    Args:
        path: JSON with ``camera_angle_x`` (or ``fl_x``), ``frames`` and optionally ``w`` and ``h``, in the file or in
            each frame.
        root: folder of the photographs.
        size: width and height where the file has none; without it they are those of the first photograph.

    Raises:
        InputError: not JSON, no frames, a bad camera, a photograph that is missing, or sizes that differ.
    """
    path, root = Path(path), Path(root)
    described = read_json(path)
    frames = described.get("frames") if isinstance(described, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: it has no frames")
    views: list[View] = []
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}: frame {index} has no file_path")
        where = f"{path}: frame {index} ({shown(frame['file_path'])})"
        image = _photograph(root, frame["file_path"], path)
        settings = {**described, **frame}
        size = _size(settings, where) or size or _size_of(image)
        camera = _camera(settings, size, where)
        if views and (camera.width, camera.height) != (views[0].camera.width, views[0].camera.height):
            raise InputError(f"{where} differs in size from the first one")
        maps = {kind: _map(root, frame, kind, image, path) for kind in ("albedo", "roughness")}
        relit = _map(root, frame, "relight", image, path) if "relight_path" in frame else None
        views.append(View(image.stem, camera, str(image), maps["albedo"], maps["roughness"], relit))
    return views


def _photograph(root: Path, name: str, path: Path) -> Path:
    image = root / name
    if not image.name:
        raise InputError(f"{path}: its file_path {shown(repr(name))} is not the name of a file")
    if image.suffix.lower() != ".exr":  # Blender's files omit the ending
        image = image.with_name(image.name + ".exr")
    return regular_file(image, f"the photograph is missing that {path.name} lists (an EXR file)")


def _map(root: Path, frame: dict[str, Any], kind: str, image: Path, path: Path) -> str | None:
    """Path of a ground-truth map: as listed, or of the photograph's name in a folder beside the photographs."""
    listed = frame.get(f"{kind}_path")
    if listed is None:
        file = image.parent.parent / kind / image.name
        return str(regular_file(file)) if exists(file) else None
    if not isinstance(listed, str):
        raise InputError(f"{path}: {kind}_path is {shown(repr(listed))}, not the name of a file")
    return str(regular_file(root / listed, f"the {kind} map is missing that {path.name} lists"))


def _size(settings: dict[str, Any], where: str) -> Size | None:
    """Width and height as the file has them, or None."""
    if settings.get("w") is None and settings.get("h") is None:
        return None
    width, height = (number(settings.get(key), f"{where}: {key}", 1, SIDE) for key in ("w", "h"))
    if width != int(width) or height != int(height):
        raise InputError(f"{where}: w and h are {width:g} and {height:g}, not numbers of pixels")
    return int(width), int(height)


def _size_of(image: Path) -> Size:
    height, width = read_exr(image).shape[:2]
    return width, height


def _number(settings: dict[str, Any], key: str, where: str, low: float, high: float) -> float | None:
    value = settings.get(key)
    return None if value is None else number(value, f"{where}: {key}", low, high)


def _camera(settings: dict[str, Any], size: Size, where: str) -> Camera:
    """A pinhole in the middle of square pixels, or an error that names what else the file describes."""
    width, height = size
    fov = _number(settings, "camera_angle_x", where, *_ANGLES)
    focal, focal_y = (_number(settings, key, where, 0.0, _FAR) for key in ("fl_x", "fl_y"))
    if fov is None:
        if not focal:
            raise InputError(f"{where}: neither camera_angle_x nor fl_x says how wide it sees")
        fov = number(fov_of(focal, width), f"{where}: the angle of view by fl_x {focal:g}", *_ANGLES)
    if focal and focal_y is not None and abs(focal_y / focal - 1.0) > 1e-3:
        raise InputError(f"{where}: fl_x and fl_y differ, only square pixels are supported")
    for key, middle in (("cx", 0.5 * width), ("cy", 0.5 * height)):
        centre = _number(settings, key, where, -_FAR, _FAR)
        if centre is not None and abs(centre - middle) > 0.51:
            raise InputError(f"{where}: {key} is {centre:g}, only cameras centred at {middle:g} are supported")
    if bent := [key for key in _DISTORTION if _number(settings, key, where, -_FAR, _FAR)]:
        raise InputError(f"{where}: lens distortion ({bent[0]}) is not supported, undistort the photographs first")
    return Camera(_pose(settings.get("transform_matrix"), where), fov, width, height)


def _pose(value: Any, where: str) -> FloatArray:
    """A rigid camera-to-world matrix [4, 4], float64."""
    if value is None:
        raise InputError(f"{where}: its transform_matrix is missing")
    pose: FloatArray = matrix(value, f"{where}: its transform_matrix", -LENGTH, LENGTH)  # a pose keeps its digits
    axes = pose[:3, :3]
    straight = np.abs(axes.T @ axes - np.eye(3)).max() <= _RIGID and np.linalg.det(axes) > 0
    if not straight or np.abs(pose[3] - (0, 0, 0, 1)).max() > _RIGID:
        raise InputError(f"{where}: its transform_matrix is not rigid (a rotation and a translation)")
    return pose
