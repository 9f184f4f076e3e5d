"""Cameras of photographs, as NeRF and Blender write them."""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError, Refusals
from neurad.core.names import make_unique
from neurad.core.parameters import BY_NAME
from neurad.core.records import BoolArray, FloatArray
from neurad.core.reflection import LOBES, DiffuseLobe
from neurad.core.scene_records import Camera, Development, View
from neurad.formats.cameras import HOLD_OUT
from neurad.formats.cameras.intrinsics import Kept, Size, camera_of, rigid
from neurad.formats.cameras.photograph_files import expected_photograph, listed_file, listed_photograph
from neurad.images.image_io import read_mask
from neurad.images.photographs import picture_size
from neurad.images.picture_headers import SIDE
from neurad.runtime.numbers import LENGTH, matrix, number
from neurad.runtime.reading import exists, listed, read_json, regular_file, shown

FILM = 512, 512
"""Width and height of a picture whose size nothing says."""
EXPOSURE = 1e-9, 1e9
"""Smallest and largest exposure."""
POLYCAM = [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]
"""What ns-process-data does to the cameras of Polycam: their Z, X and Y become X, Y and Z."""
Finder = Callable[[str, str], Path]
_LISTS = {"train_filenames": "train", "val_filenames": "test", "test_filenames": "test"}


@dataclass(frozen=True)
class Split:
    """The views of a folder."""

    train: list[View]
    test: list[View]
    """Held out; perhaps none."""
    notes: tuple[str, ...] = ()
    """What was decided for the user, a sentence each."""
    stated: bool = False
    """Whether the source says which views are held out."""
    diffuse: DiffuseLobe | None = None
    """Diffuse lobe that principled surfaces have in the photographs, where the source says it."""


def read_split(
    folder: Path, hold_out: int = HOLD_OUT, pictures: bool = True, photograph: Finder | None = None
) -> Split:
    """Training and held-out views of ``transforms_train.json`` and, where it is there, ``transforms_test.json`` or
    ``transforms_val.json``. ``hold_out`` is not read: such a folder says itself what is held out.

    Raises:
        InputError: as :func:`read_views`.
    """
    path = folder / "transforms_train.json"
    train = read_views(path, folder, None, photograph, pictures)
    diffuse = _diffuse(read_json(path), path)
    sizes = {(view.camera.width, view.camera.height) for view in train}
    size = sizes.pop() if len(sizes) == 1 else None  # so that held-out photographs stay closed
    for name in ("transforms_test.json", "transforms_val.json"):
        if exists(folder / name):
            views = told_apart([*train, *read_views(folder / name, folder, size, photograph, pictures)])
            return Split(views[: len(train)], views[len(train) :], stated=True, diffuse=diffuse)
    return Split(told_apart(train), [], stated=True, diffuse=diffuse)


def read_one(folder: Path, hold_out: int = HOLD_OUT, pictures: bool = True, photograph: Finder | None = None) -> Split:
    """Training and held-out views of ``transforms.json``, nerfstudio's one file for both.

    Args:
        hold_out: every so many-th photograph by name is held out where the file does not say which; 0 for none, not 1.
        pictures: as in :func:`read_views`, and so is ``photograph``.

    Raises:
        InputError: as :func:`read_views`; or the lists of the file name what it does not have, or a frame twice.
    """
    path = folder / "transforms.json"
    views = told_apart(read_views(path, folder, None, photograph, pictures))
    said = f"{path}: its cameras are Polycam's as ns-process-data turns them; they are turned back, to Polycam's mesh"
    described = read_json(path)
    notes = (said,) if _is_polycam(described) else ()
    named, diffuse = _named(described, path), _diffuse(described, path)
    if named is None:
        split = held_out_every(hold_out, views, path)
        return replace(split, notes=(*notes, *split.notes), diffuse=diffuse)
    pairs = list(zip(views, named, strict=True))
    train, test = ([view for view, kind in pairs if kind == part] for part in ("train", "test"))
    if not train:
        raise InputError(f"{path}: its train_filenames leave no photograph to learn from")
    left = len(views) - len(train) - len(test)
    said = f"{path}: {left} of {len(views)} photographs are in none of its lists of names, and are left out"
    return Split(train, test, (*notes, said) if left else notes, stated=True, diffuse=diffuse)


def _diffuse(described: dict[str, Any], path: Path) -> DiffuseLobe | None:
    """What a camera file says of the diffuse lobe of surfaces in its photographs: who renders them knows it."""
    found = described.get("diffuse_lobe")
    if found is None or found in LOBES:
        return found
    raise InputError(f"{path}: its diffuse_lobe is {shown(repr(found))}; there are {listed(LOBES)}")


def told_apart(views: Sequence[View]) -> list[View]:
    """Views no two of which have one name: where photographs of several folders do, the folder's goes before."""
    alike = Counter(view.name for view in views)
    taken: set[str] = set()
    made = []
    for view in views:
        name = view.name if alike[view.name] == 1 else f"{Path(str(view.image)).parent.name}_{view.name}"
        made.append(replace(view, name=make_unique(name, taken, "_")))
    return made


def held_out_every(hold_out: int, views: list[View], path: Path) -> Split:
    """Views of which every so many-th by name is held out, and the sentence that says so."""
    if hold_out == 0 or len(views) < 2:
        return Split(views, [])
    order = sorted(range(len(views)), key=lambda i: str(views[i].image))
    held = set(order[::hold_out])
    train, test = ([view for i, view in enumerate(views) if (i in held) == part] for part in (False, True))
    every = {2: "second", 3: "third"}.get(hold_out, f"{hold_out}th")
    said = f"{path} does not say which photographs are held out: every {every} by name is"
    return Split(train, test, (f"{said}, {len(test)} of {len(views)} (--data.hold_out 0 for none)",))


def _named(described: dict[str, Any], path: Path) -> list[str] | None:
    """For each frame 'train', 'test' or '', by the lists in a file; None where it has no lists."""
    lists = {key: described[key] for key in _LISTS if described.get(key) is not None}
    if not lists:
        return None
    place = {_key(frame["file_path"]): index for index, frame in enumerate(described["frames"])}
    kinds = [""] * len(described["frames"])
    for key, names in lists.items():
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: {key} is not a list of names")
        for name in names:
            index = place.get(_key(name))
            if index is None:
                raise InputError(f"{path}: {key} has {shown(repr(name))}, which is the file_path of no frame")
            kind = _LISTS[key]
            if kinds[index] not in ("", kind):
                raise InputError(f"{path}: {shown(repr(name))} is both in train_filenames and in {key}")
            kinds[index] = kind
    if "train_filenames" not in lists:
        kinds = [kind or "train" for kind in kinds]
    return kinds


def _key(name: str) -> str:
    """What is the same for two ways to write the name of a photograph."""
    return os.path.normpath(name.replace("\\", "/").removesuffix(".exr"))


def read_views(
    path: str | Path,
    root: str | Path,
    size: Size | None = None,
    photograph: Finder | None = None,
    pictures: bool = True,
) -> list[View]:
    """The views of a camera file; paths in it are relative to ``root``.

    Args:
        path: JSON with ``frames`` and, in the file or in a frame, what :func:`camera_of` reads and optionally ``w`` and
            ``h``; without them a photograph says itself how large it is.
        size: width and height where the file has none, in place of what the photograph says.
        photograph: finds the photograph of a name, its second argument begins the sentence if there is none; None
            takes that of :func:`listed_photograph`.
        pictures: whether photographs, masks and maps are wanted. Otherwise none of them has to be there, and views have
            their cameras and the name of the file where the photograph would be.

    Raises:
        InputError: not JSON, no frames, a bad camera, or a photograph that is missing.
    """
    path, root = Path(path), Path(root)
    described, frames = frames_of(path)
    undo = _applied(described, path)
    find = photograph or (lambda name, where: listed_photograph(root, name, where, path.name))
    views: list[View] = []
    refusals, by_file = Refusals(), dict[Path, int]()
    for index, frame in enumerate(frames):
        with refusals.part():
            if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
                raise InputError(f"{path}: frame {index} has no file_path")
            where = f"{path}: frame {index} ({shown(frame['file_path'])})"
            name = frame["file_path"]
            image = find(name, where) if pictures else expected_photograph(root, name)
            if (other := by_file.setdefault(image, index)) != index:
                raise InputError(f"{where}: its photograph is also that of frame {other}; list each once")
            settings = {**described, **frame}
            film = _size(settings, where) or size
            if film is None:
                film = picture_size(image) if pictures or exists(image) else _unsaid(settings, where)
            pose = undo(rigid(frame.get("transform_matrix"), f"{where}: its transform_matrix"))
            missing = f"the mask is missing that {path.name} lists"
            mask = _listed(root, frame, "mask_path", missing, path) if pictures else None
            kept = _kept_of(mask if pictures else _mask_name(root, frame))
            camera = camera_of((frame, described), film, pose, where, kept)
            if not pictures:
                views.append(View(image.stem, camera, str(image)))
                continue
            maps = {kind: file for kind in BY_NAME if (file := _map(root, frame, kind, image, path)) is not None}
            spread = _map(root, frame, "spread", image, path)
            relit = _map(root, frame, "relight", image, path) if "relight_path" in frame else None
            exposure = settings.get("exposure")
            if exposure is not None:
                exposure = number(exposure, f"{where}: its exposure", *EXPOSURE)
            made = Development(exposure=exposure)
            views.append(View(image.stem, camera, str(image), maps, relit, mask, made, spread))
    refusals.end()
    return views


def read_cameras(path: str | Path, size: Size) -> list[View]:
    """The cameras of a camera file, of ``size`` where it says none, as views without photographs: none has to be there,
    and frames need no name.

    Returns:
        Views with the names of the photographs, or with numbers where not all frames have one of their own.

    Raises:
        InputError: not JSON, no frames, or a bad camera.
    """
    path = Path(path)
    described, frames = frames_of(path)
    undo = _applied(described, path)
    views = []
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise InputError(f"{path}: frame {index} is {shown(repr(frame))}, not an object with a transform_matrix")
        name = frame.get("file_path")
        where = f"{path}: frame {index}" + (f" ({shown(name)})" if isinstance(name, str) else "")
        film = _size({**described, **frame}, where) or size
        pose = undo(rigid(frame.get("transform_matrix"), f"{where}: its transform_matrix"))
        stem = Path(name).name.removesuffix(".exr") if isinstance(name, str) else ""
        kept = _kept_of(_mask_name(path.parent, frame))
        views.append(View(stem, camera_of((frame, described), film, pose, where, kept)))
    if not all(view.name for view in views) or len({view.name for view in views}) < len(views):
        return [replace(view, name=f"{index:04d}") for index, view in enumerate(views)]
    return views


def _kept_of(mask: str | Path | None) -> Kept | None:
    """What reads a mask; one that is not there keeps nothing. None without a mask."""
    if mask is None:
        return None

    def kept(camera: Camera) -> BoolArray:
        if not Path(mask).is_file():
            return np.zeros((camera.height, camera.width), np.bool_)
        return read_mask(View("", camera, mask=str(mask)))

    return kept


def _mask_name(root: Path, frame: dict[str, Any]) -> Path | None:
    """Where the mask that a frame lists would be."""
    listed = frame.get("mask_path")
    return root / listed.replace("\\", "/") if isinstance(listed, str) else None


def frames_of(path: Path) -> tuple[dict[str, Any], list[Any]]:
    """What a camera file describes, and its frames."""
    described = read_json(path)
    frames = described.get("frames") if isinstance(described, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: it has no frames")
    return described, frames


def _applied(described: dict[str, Any], path: Path) -> Callable[[FloatArray], FloatArray]:
    """What takes poses back to the frame that they had before nerfstudio moved them: ``x' = scale (A x + b)``."""
    scale = number(described.get("applied_scale") or 1.0, f"{path}: applied_scale", 1e-9, 1e9)
    rows = POLYCAM if _is_polycam(described) else described.get("applied_transform")
    if rows is None and scale == 1.0:
        return lambda pose: pose
    if rows is None:
        rows = np.eye(4).tolist()
    if isinstance(rows, list) and len(rows) == 3:
        rows = [*rows, [0.0, 0.0, 0.0, 1.0]]
    moved = matrix(rows, f"{path}: applied_transform", -LENGTH, LENGTH)
    size = float(np.cbrt(max(np.linalg.det(moved[:3, :3]), 0.0)))
    if size == 0.0 or np.abs(moved[:3, :3].T @ moved[:3, :3] / size**2 - np.eye(3)).max() > 1e-4:
        raise InputError(f"{path}: applied_transform is not a rotation with a scale and a translation")
    turn = moved[:3, :3] / size

    def undo(pose: FloatArray) -> FloatArray:
        before: FloatArray = np.array(pose)
        before[:3, :3] = turn.T @ pose[:3, :3]
        before[:3, 3] = turn.T @ (pose[:3, 3] / scale - moved[:3, 3]) / size
        return before

    return undo


def _is_polycam(described: dict[str, Any]) -> bool:
    """Whether a camera file is what ns-process-data makes of Polycam's: it turns cameras and does not say so, but no
    other of its sources has these keys.
    """
    return (
        described.get("orientation_override") == "none"
        and described.get("camera_model") == "OPENCV"
        and "applied_transform" not in described
        and all(isinstance(frame, dict) and {"fl_x", "cx", "w"} <= frame.keys() for frame in described["frames"])
    )


def _unsaid(settings: dict[str, Any], where: str) -> Size:
    """The size of a picture that is not there and of which the file says nothing but how wide it sees."""
    if any(settings.get(key) is not None for key in ("fl_x", "fl_y", "cx", "cy")):
        raise InputError(f"{where}: neither w and h nor a photograph says how many pixels its picture has; add w and h")
    return FILM


def _map(root: Path, frame: dict[str, Any], kind: str, image: Path, path: Path) -> str | None:
    """Path of a ground-truth map: as listed, or of the photograph's name in a folder beside the photographs."""
    listed = _listed(root, frame, f"{kind}_path", f"the {kind} map is missing that {path.name} lists", path)
    if listed is not None:
        return listed
    file = image.parent.parent / kind / image.name
    return str(regular_file(file)) if exists(file) else None


def _listed(root: Path, frame: dict[str, Any], key: str, missing: str, path: Path) -> str | None:
    """Path of a file that a frame may list under a key."""
    listed = frame.get(key)
    if listed is None:
        return None
    if not isinstance(listed, str):
        raise InputError(f"{path}: {key} is {shown(repr(listed))}, not the name of a file")
    return str(listed_file(root / listed.replace("\\", "/"), missing))


def _size(settings: dict[str, Any], where: str) -> Size | None:
    """Width and height as the file has them, or None."""
    if settings.get("w") is None and settings.get("h") is None:
        return None
    width, height = (number(settings.get(key), f"{where}: {key}", 1, SIDE) for key in ("w", "h"))
    if width != int(width) or height != int(height):
        raise InputError(f"{where}: w and h are {width:g} and {height:g}, not numbers of pixels")
    return int(width), int(height)
