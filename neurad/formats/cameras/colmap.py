"""Cameras of a COLMAP model: ``cameras`` and ``images``, and ``rigs`` and ``frames`` where it has them, as text or
binary.
"""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError, Refusals
from neurad.core.records import Float64Array, FloatArray
from neurad.core.scene_records import Camera, View
from neurad.formats.cameras.intrinsics import MODELS, make_camera
from neurad.formats.cameras.nerf import Split, told_apart
from neurad.formats.cameras.photograph_files import photographs_of
from neurad.images.picture_headers import SIDE
from neurad.runtime.numbers import LENGTH, number
from neurad.runtime.reading import exists, read_bytes, read_text, shown

PLACES = ("sparse", "colmap/sparse", "dense/sparse", ".")
"""Where models lie in a project, the most usual place first: each is in the folder itself, or in folders of it."""
_FOCALS = {"PINHOLE": 2, "OPENCV": 2, "OPENCV_FISHEYE": 2, "FULL_OPENCV": 2}  # of the models; others have one
_IDS: dict[int, tuple[str, int]] = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
}  # fmt: skip
_SENSORS = {"CAMERA": 0, "IMU": 1}  # as text has them; binary files have the numbers
_POINT = 24  # bytes of a point in a binary image
_NAME = 4096  # longest name of an image
_FLIP = np.diag([1.0, -1.0, -1.0])  # COLMAP looks along +Z with Y down
_SAME = 1e-6  # difference between the poses of frames and of images that rounding makes

Numbers = tuple[float, ...]
Rigid = tuple[Float64Array, Float64Array]
"""A rotation [3, 3] and a translation [3]."""


@dataclass(frozen=True)
class _Camera:
    """A line of ``cameras``."""

    model: str
    width: int
    height: int
    parameters: Numbers


@dataclass(frozen=True)
class _Image:
    """A line of ``images``."""

    number: int
    pose: Numbers
    """Quaternion and translation from the world to the camera [7]."""
    camera: int
    name: str


def read_project(source: Path, images: Path | None) -> Split:
    """The views of a COLMAP model, in COLMAP's own frame, by name; nothing is held out.

    Where ``frames`` say where a rig was, and ``rigs`` where on it the camera is, that is the pose, as in COLMAP itself.

    Args:
        source: a project, a folder of models or that of a model; of several models the one that has most images.
        images: folder of the photographs, None where they lie in the project.

    Raises:
        InputError: there is no model, a file is missing or broken, a camera is not supported, or a photograph is
            missing.
    """
    folder, chosen = _find_model(source)
    photograph = photographs_of(images, *_photograph_places(source, folder))
    ending = _ending(folder)
    cameras = (_binary_cameras if ending == "bin" else _text_cameras)(folder / f"cameras.{ending}")
    path = folder / f"images.{ending}"
    lines, notes = _images(path)
    if not lines:
        raise InputError(f"{path}: it has no image")
    framed = _framed(folder, ending)
    moved, views = 0, []
    by_file: dict[Path, _Image] = {}
    refusals = Refusals()
    for image in sorted(lines, key=lambda line: line.name):
        with refusals.part():
            where = f"{path}: image {image.number} ({shown(image.name)})"
            if image.camera not in cameras:
                raise InputError(f"{where}: its camera {image.camera} is not in cameras.{ending}")
            about = f"{folder / f'cameras.{ending}'}: camera {image.camera}"
            pose = _rigid(image.pose, where)
            if (said := framed.get(image.number)) is not None:
                moved += not all(np.allclose(a, b, _SAME, _SAME) for a, b in zip(said, pose, strict=True))
                pose = said
            file = photograph(image.name, where)
            if (other := by_file.setdefault(file, image)) is not image:
                raise InputError(
                    f"{where}: its photograph {shown(file)} is also that of image {other.number} "
                    f"({shown(other.name)}); put each into a folder of the name that COLMAP has"
                )
            views.append(View(Path(image.name).stem, _camera(cameras[image.camera], _to_world(pose), about), str(file)))
    refusals.end()
    if moved:
        notes.append(
            f"{folder / f'frames.{ending}'} and rigs.{ending} say otherwise than images.{ending} where {moved} of "
            f"{len(lines)} cameras are; they are taken, as COLMAP does"
        )
    return Split(told_apart(views), [], (*chosen, *notes))


def _find_model(source: Path) -> tuple[Path, list[str]]:
    """The folder of the model in ``source`` that has most images, and the sentence that says so of several."""
    for place in PLACES:
        folder = source / place
        models = [sub for sub in (*sorted(folder.iterdir()), folder) if _ending(sub)] if folder.is_dir() else []
        if len(models) == 1:
            return models[0], []
        if models:
            sizes = {model: len(_images(model / f"images.{_ending(model)}")[0]) for model in models}
            largest = max(models, key=lambda model: sizes[model])
            others = ", ".join(f"{model.name} has {sizes[model]}" for model in models if model is not largest)
            said = f"{shown(folder)}: of its {len(models)} models the one in {largest.name} is taken"
            return largest, [f"{said}, which has most images, {sizes[largest]} ({others})"]
    raise InputError(
        f"{shown(source)}: it has no COLMAP model (cameras.bin or cameras.txt, in the folder itself or in sparse/0)"
    )


def _photograph_places(source: Path, model: Path) -> list[Path]:
    """Folders where the photographs of a model may be: ``images`` beside it or above it, within the project; of a model
    that was named itself also those where projects have them.
    """
    above = [folder for folder in (model, *model.parents) if folder.is_relative_to(source)]
    if model == source:
        above += source.parents[:3]
    found = [folder / "images" for folder in above if (folder / "images").is_dir()]
    return [*found, source] if found else [source / "images", source]


def _ending(folder: Path) -> str | None:
    """``bin`` or ``txt``: what the files of a model end in, the binary ones first; None where there is no model."""
    known = [ending for ending in ("bin", "txt") if exists(folder / f"cameras.{ending}")]
    return next((ending for ending in known if exists(folder / f"images.{ending}")), known[0] if known else None)


def _framed(folder: Path, ending: str | None) -> dict[int, Rigid]:
    """Where ``frames`` and ``rigs`` say that cameras are, from the world to the camera, by the image's number."""
    frames, rigs = folder / f"frames.{ending}", folder / f"rigs.{ending}"
    if not (exists(frames) and exists(rigs)):
        return {}
    sensors: dict[int, dict[int, Rigid]] = {}
    for entry in _entries(rigs, 8):
        rig, count = (int(x) for x in entry.take("II"))
        known = sensors[rig] = {}
        if count:
            kind, sensor = entry.take("iI")
            if kind == _SENSORS["CAMERA"]:
                known[int(sensor)] = np.eye(3), np.zeros(3)
        for _ in range(count - 1):
            kind, sensor, has_pose = entry.take("iIB")
            pose = entry.take("d" * 7) if has_pose else None
            if pose is not None and kind == _SENSORS["CAMERA"]:
                known[int(sensor)] = _rigid(pose, f"{rigs}: sensor {sensor} of rig {rig}")
    found: dict[int, Rigid] = {}
    for entry in _entries(frames, 68):
        frame, rig = (int(x) for x in entry.take("II"))
        where = f"{frames}: frame {frame}"
        if rig not in sensors:
            raise InputError(f"{where}: its rig {rig} is not in {rigs.name}")
        rotation, translation = _rigid(entry.take("d" * 7), where)
        for _ in range(int(entry.take("I")[0])):
            kind, sensor, image = (int(x) for x in entry.take("iIQ"))
            if kind == _SENSORS["CAMERA"] and sensor in sensors[rig]:
                turn, shift = sensors[rig][sensor]
                found[image] = turn @ rotation, turn @ translation + shift
    return found


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


def _rigid(values: Numbers, where: str) -> Rigid:
    """The rotation and the translation of a quaternion w, x, y, z and a translation [7]."""
    from scipy.spatial.transform import Rotation  # imported where it is needed: it loads slowly

    q = np.array([number(x, f"{where}: its quaternion", -1e9, 1e9) for x in values[:4]])
    if np.linalg.norm(q) < 1e-9:
        raise InputError(f"{where}: its quaternion is 0, which is no rotation")
    rotation = Rotation.from_quat(np.roll(q, -1)).as_matrix()
    return rotation, np.array([number(x, f"{where}: its translation", -LENGTH, LENGTH) for x in values[4:]])


def _to_world(pose: Rigid) -> FloatArray:
    """Camera to world [4, 4], OpenGL axes, of what takes the world to the camera."""
    rotation, translation = pose
    made: FloatArray = np.eye(4)  # type: ignore[assignment]
    made[:3, :3] = rotation.T @ _FLIP
    made[:3, 3] = -rotation.T @ translation
    return made


def _images(path: Path) -> tuple[list[_Image], list[str]]:
    """The images of a model, and what there is to say about them."""
    return (_binary_images(path), []) if path.suffix == ".bin" else _text_images(path)


# ---- text


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; comments are left out, empty ones are not."""
    for index, line in enumerate(read_text(path).splitlines(), 1):
        if not line.lstrip().startswith("#"):
            yield index, line


class _Words:
    """A line of a text file, read from its beginning, by the letters that ``struct`` has for the binary one."""

    def __init__(self, path: Path, index: int, line: str) -> None:
        self.where, self.words = f"{path}: line {index}", iter(line.split())

    def take(self, form: str) -> Numbers:
        words = [(next(self.words, ""), kind) for kind in form]
        try:
            return tuple(float(x) if kind == "d" else _SENSORS[x] if x in _SENSORS else int(x) for x, kind in words)
        except ValueError as error:
            raise InputError(f"{self.where}: it is cut short, or a word of it is no number") from error


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


def _text_images(path: Path) -> tuple[list[_Image], list[str]]:
    """Every image has two lines. The second, its points, may be empty, and some programs leave it out then."""
    images: list[_Image] = []
    has_points = True
    for index, line in _lines(path):
        image = _text_image(line)
        if image is not None and (has_points or not _is_points(line)):
            images.append(image)
            has_points = False
        elif line.strip() and has_points:
            raise InputError(
                f"{path}: line {index} is {shown(repr(line))}, not IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            )
        else:
            has_points = True
    announced = re.search(r"^# Number of images: (\d+)", read_text(path), re.MULTILINE)
    if announced is None or int(announced[1]) == len(images):
        return images, []
    return images, [f"{path}: it announces {announced[1]} images and has {len(images)}; is it cut short?"]


def _text_image(line: str) -> _Image | None:
    words = line.split(None, 9)
    try:
        pose = tuple(float(word) for word in words[1:8])
        return _Image(int(words[0]), pose, int(words[8]), words[9].strip())
    except (ValueError, IndexError):
        return None


def _is_points(line: str) -> bool:
    """Whether a line is X Y POINT3D_ID, again and again."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and all(float(word) is not None for word in words)
    except ValueError:
        return False


# ---- binary


class _Bytes:
    """A binary file, read from its beginning."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.place = path, read_bytes(path), 0

    def take(self, form: str) -> Numbers:
        size = struct.calcsize(f"<{form}")
        self.skip(size)
        return struct.unpack_from(f"<{form}", self.data, self.place - size)

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise InputError(f"{self.path}: it ends before what it announces")

    def count(self, least: int) -> int:
        """A number of entries of ``least`` bytes each."""
        (found,) = self.take("Q")
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


def _entries(path: Path, least: int) -> Iterator[_Bytes | _Words]:
    """The entries of a file, each to be read to its end; ``least`` bytes are the fewest that a binary one has."""
    if path.suffix == ".txt":
        yield from (_Words(path, index, line) for index, line in _lines(path) if line.strip())
    else:
        data = _Bytes(path)
        for _ in range(data.count(least)):
            yield data


def _binary_cameras(path: Path) -> dict[int, _Camera]:
    data = _Bytes(path)
    cameras: dict[int, _Camera] = {}
    for _ in range(data.count(24)):
        key, kind, width, height = (int(x) for x in data.take("iiQQ"))
        if kind not in _IDS:
            raise InputError(f"{path}: camera {key}: its model has the number {kind}, which is not known")
        model, count = _IDS[kind]
        cameras[key] = _Camera(model, width, height, tuple(float(x) for x in data.take(f"{count}d")))
    return cameras


def _binary_images(path: Path) -> list[_Image]:
    data = _Bytes(path)
    images = []
    for _ in range(data.count(64)):
        key, *pose, camera = data.take("i7di")
        name = data.name()
        data.skip(_POINT * data.count(_POINT))
        images.append(_Image(int(key), tuple(pose), int(camera), name))
    return images
