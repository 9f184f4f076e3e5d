"""Cameras of photographs, as NeRF and Blender write them."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.camera import fov_of
from neurad.core.errors import InputError
from neurad.core.records import Camera, FloatArray, View
from neurad.scene.image_io import read_exr

_RIGID = 1e-4  # largest deviation from orthonormal axes; the cameras of Blender have about 1e-6
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")

Size = tuple[int, int]


def read_split(folder: Path) -> tuple[list[View], list[View]]:
    """Training and held-out views of ``transforms_train.json`` and ``transforms_test.json``.

    Raises:
        InputError: one of the files is missing, or as :func:`read_views`.
    """
    for name in ("transforms_train.json", "transforms_test.json"):
        if not (folder / name).is_file():
            raise InputError(f"{folder / name}: the scene folder lacks this file")
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
    try:
        described = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: it cannot be read") from error
    except ValueError as error:
        raise InputError(f"{path}: it is not valid JSON ({error})") from error
    frames = described.get("frames") if isinstance(described, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: it has no frames")
    views: list[View] = []
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}: frame {index} has no file_path")
        image = _photograph(root, frame["file_path"], path)
        settings = {**described, **frame}
        size = _size(settings, path) or size or _size_of(image)
        camera = _camera(settings, size, f"{path}: frame {index} ({frame['file_path']})")
        if views and (camera.width, camera.height) != (views[0].camera.width, views[0].camera.height):
            raise InputError(f"{path}: frame {index} ({frame['file_path']}) differs in size from the first one")
        maps = {kind: _map(root, frame, kind, image, path) for kind in ("albedo", "roughness")}
        relit = _map(root, frame, "relight", image, path) if "relight_path" in frame else None
        views.append(View(image.stem, camera, str(image), maps["albedo"], maps["roughness"], relit))
    return views


def _photograph(root: Path, name: str, path: Path) -> Path:
    image = root / name
    if image.suffix.lower() != ".exr":  # Blender's files omit the ending
        image = image.with_name(image.name + ".exr")
    if not image.is_file():
        raise InputError(f"{image}: the photograph is missing that {path.name} lists (an EXR file)")
    return image


def _map(root: Path, frame: dict[str, Any], kind: str, image: Path, path: Path) -> str | None:
    """Path of a ground-truth map: as listed, or of the photograph's name in a folder beside the photographs."""
    listed = frame.get(f"{kind}_path")
    file = image.parent.parent / kind / image.name if listed is None else root / str(listed)
    if file.is_file():
        return str(file)
    if listed is None:
        return None
    raise InputError(f"{file}: the {kind} map is missing that {path.name} lists")


def _size(settings: dict[str, Any], path: Path) -> Size | None:
    width, height = settings.get("w"), settings.get("h")
    if width is None and height is None:
        return None
    if not all(isinstance(x, int | float) and x >= 1 and x == int(x) for x in (width, height)):
        raise InputError(f"{path}: w and h are {width} and {height}, not numbers of pixels")
    return int(width), int(height)  # type: ignore[arg-type]


def _size_of(image: Path) -> Size:
    height, width = read_exr(image).shape[:2]
    return width, height


def _number(settings: dict[str, Any], key: str, where: str) -> float | None:
    value = settings.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(f"{where}: {key} is not a number")
    return float(value)


def _camera(settings: dict[str, Any], size: Size, where: str) -> Camera:
    """A pinhole in the middle of square pixels, or an error that names what else the file describes."""
    width, height = size
    fov = _number(settings, "camera_angle_x", where)
    focal, focal_y = _number(settings, "fl_x", where), _number(settings, "fl_y", where)
    if fov is None:
        if focal is None or focal <= 0:
            raise InputError(f"{where}: neither camera_angle_x nor fl_x says how wide it sees")
        fov = fov_of(focal, width)
    if not 0 < fov < math.pi:
        raise InputError(f"{where}: camera_angle_x is {fov:g}, not an angle between 0 and pi in radians")
    if focal and focal_y and abs(focal_y / focal - 1.0) > 1e-3:
        raise InputError(f"{where}: fl_x and fl_y differ, only square pixels are supported")
    for key, middle in (("cx", 0.5 * width), ("cy", 0.5 * height)):
        centre = _number(settings, key, where)
        if centre is not None and abs(centre - middle) > 0.51:
            raise InputError(f"{where}: {key} is {centre:g}, only cameras centred at {middle:g} are supported")
    if bent := [key for key in _DISTORTION if _number(settings, key, where)]:
        raise InputError(f"{where}: lens distortion ({bent[0]}) is not supported, undistort the photographs first")
    return Camera(_pose(settings.get("transform_matrix"), where), fov, width, height)


def _pose(matrix: Any, where: str) -> FloatArray:
    """A rigid camera-to-world matrix [4, 4], float64."""
    if matrix is None:
        raise InputError(f"{where}: its transform_matrix is missing")
    try:
        pose: FloatArray = np.array(matrix, np.float64)  # a pose keeps its digits
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: its transform_matrix is not made of numbers") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise InputError(f"{where}: its transform_matrix is not 4 x 4 finite numbers")
    axes = pose[:3, :3]
    straight = np.abs(axes.T @ axes - np.eye(3)).max() <= _RIGID and np.linalg.det(axes) > 0
    if not straight or np.abs(pose[3] - (0, 0, 0, 1)).max() > _RIGID:
        raise InputError(f"{where}: its transform_matrix is not rigid (a rotation and a translation)")
    return pose
