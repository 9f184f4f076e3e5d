"""Cameras of a COLMAP model: ``cameras`` and ``images``, as text or binary."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Camera, FloatArray, View
from neurad.runtime.reading import exists, read_bytes, read_text, shown
from neurad.scene.numbers import LENGTH, number
from neurad.scene.picture_headers import SIDE
from neurad.scene.readers.intrinsics import MODELS, make_camera

PLACES = ("sparse/0", "sparse", "colmap/sparse/0", "dense/sparse", ".")
"""Where a model lies in a project, the most usual place first."""
_FOCALS = {"PINHOLE": 2, "OPENCV": 2, "OPENCV_FISHEYE": 2, "FULL_OPENCV": 2}  # of the models; others have one
_IDS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}  # fmt: skip
_POINT = 24  # bytes of a point in a binary image
_NAME = 4096  # longest name of an image
_FLIP = np.diag([1.0, -1.0, -1.0])  # COLMAP looks along +Z with Y down


@dataclass(frozen=True)
class _Camera:
    """A line of ``cameras``."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    """A line of ``images``."""

    number: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera: int
    name: str


def read_model(source: Path, photograph: Callable[[str, str], Path]) -> list[View]:
    """The views of a COLMAP model, in COLMAP's own frame, by name.

    Args:
        source: a project or the folder of a model.
        photograph: finds the photograph of a name; its second argument begins the sentence if there is none.

    Raises:
        InputError: there is no model, a file is broken, a camera is not supported, or a photograph is missing.
    """
    folder = _model(source)
    binary = exists(folder / "cameras.bin")
    ending = "bin" if binary else "txt"
    cameras = (_binary_cameras if binary else _text_cameras)(folder / f"cameras.{ending}")
    path = folder / f"images.{ending}"
    images = (_binary_images if binary else _text_images)(path)
    if not images:
        raise InputError(f"{path}: it has no image")
    views = []
    for image in sorted(images, key=lambda image: image.name):
        where = f"{path}: image {image.number} ({shown(image.name)})"
        if image.camera not in cameras:
            raise InputError(f"{where}: its camera {image.camera} is not in cameras.{ending}")
        about = f"{folder / f'cameras.{ending}'}: camera {image.camera}"
        camera = _camera(cameras[image.camera], _pose(image, where), about)
        views.append(View(Path(image.name).stem, camera, str(photograph(image.name, where))))
    return views


def _model(source: Path) -> Path:
    for place in PLACES:
        for ending in ("bin", "txt"):
            if exists(source / place / f"cameras.{ending}"):
                return source / place
    raise InputError(
        f"{shown(source)}: it has no COLMAP model (cameras.bin or cameras.txt, in the folder itself or in sparse/0)"
    )


def _camera(line: _Camera, pose: FloatArray, where: str) -> Camera:
    """The camera of an image; COLMAP's parameters are the focal lengths, the centre and the coefficients in order."""
    if line.model not in MODELS:
        raise InputError(f"{where}: its model {shown(line.model)} is not supported ({', '.join(MODELS)} are)")
    focals = _FOCALS.get(line.model, 1)
    coefficients = [k for k in MODELS[line.model] if (line.model, k) != ("OPENCV", "k3")]
    keys = [*("fl_x", "fl_y")[:focals], "cx", "cy", *coefficients]
    if len(line.parameters) != len(keys):
        raise InputError(f"{where}: it has {len(line.parameters)} parameters, but {line.model} has {len(keys)}")
    width, height = (int(number(x, f"{where}: its size", 1, SIDE)) for x in (line.width, line.height))
    values = dict(zip(keys, line.parameters, strict=True))
    return make_camera(pose, (width, height), line.model, values, where)


def _pose(image: _Image, where: str) -> FloatArray:
    """Camera to world, OpenGL axes, of a rotation and translation from the world to the camera."""
    q = np.array([number(x, f"{where}: its quaternion", -1e9, 1e9) for x in image.quaternion])
    length = float(np.linalg.norm(q))
    if length < 1e-9:
        raise InputError(f"{where}: its quaternion is 0, which is no rotation")
    w, x, y, z = q / length
    rotation = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    t = np.array([number(x, f"{where}: its translation", -LENGTH, LENGTH) for x in image.translation])
    pose: FloatArray = np.eye(4)  # type: ignore[assignment]
    pose[:3, :3] = rotation.T @ _FLIP
    pose[:3, 3] = -rotation.T @ t
    return pose


# ---- text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; comments are left out, empty ones are not."""
    for index, line in enumerate(read_text(path).splitlines(), 1):
        if not line.startswith("#"):
            yield index, line


def _text_cameras(path: Path) -> dict[int, _Camera]:
    cameras: dict[int, _Camera] = {}
    for index, line in _lines(path):
        if not (words := line.split()):
            continue
        try:
            key, model, width, height = int(words[0]), words[1], int(words[2]), int(words[3])
            cameras[key] = _Camera(model, width, height, tuple(float(word) for word in words[4:]))
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}: line {index} is {shown(repr(line))}, not CAMERA_ID MODEL WIDTH HEIGHT PARAMS"
            ) from error
    return cameras


def _text_images(path: Path) -> list[_Image]:
    """Every image has two lines, of which the second, its points, may be empty."""
    images = []
    lines = _lines(path)
    for index, line in lines:
        if not line.strip():
            continue
        words = line.split(None, 9)
        try:
            numbers = [float(word) for word in words[1:8]]
            key, camera, name = int(words[0]), int(words[8]), words[9].strip()
            images.append(_Image(key, tuple(numbers[:4]), tuple(numbers[4:]), camera, name))
        except (ValueError, IndexError) as error:
            raise InputError(
                f"{path}: line {index} is {shown(repr(line))}, not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            ) from error
        next(lines, None)
    return images


# ---- binary


class _Bytes:
    """A binary file, read from its beginning.

    Raises:
        InputError: it ends too early.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, read_bytes(path), 0

    def take(self, form: str) -> tuple[int | float, ...]:
        size = struct.calcsize(form)
        self.skip(size)
        return struct.unpack_from(form, self.data, self.place - size)

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise InputError(f"{self.path}: it ends before what it announces")

    def count(self, least: int) -> int:
        """A number of entries of ``least`` bytes each."""
        (found,) = self.take("<Q")
        if found * least > len(self.data) - self.place:
            raise InputError(f"{self.path}: it announces {found} entries, and ends before them")
        return int(found)

    def name(self) -> str:
        end = self.data.find(b"\0", self.place, self.place + _NAME)
        if end < 0:
            raise InputError(f"{self.path}: the name of an image has no end")
        word = self.data[self.place : end]
        self.place = end + 1
        try:
            return word.decode()
        except UnicodeDecodeError as error:
            raise InputError(f"{self.path}: the name {shown(repr(word))} of an image is not text in UTF-8") from error


def _binary_cameras(path: Path) -> dict[int, _Camera]:
    data = _Bytes(path)
    cameras: dict[int, _Camera] = {}
    for _ in range(data.count(24)):
        key, kind, width, height = (int(x) for x in data.take("<iiQQ"))
        if kind not in _IDS:
            raise InputError(f"{path}: camera {key}: its model has the number {kind}, which is not known")
        model, count = _IDS[kind]
        cameras[key] = _Camera(model, width, height, tuple(float(x) for x in data.take(f"<{count}d")))
    return cameras


def _binary_images(path: Path) -> list[_Image]:
    data = _Bytes(path)
    images = []
    for _ in range(data.count(64)):
        key, *numbers, camera = data.take("<i7di")
        name = data.name()
        data.skip(_POINT * data.count(_POINT))
        images.append(_Image(int(key), tuple(numbers[:4]), tuple(numbers[4:]), int(camera), name))
    return images
