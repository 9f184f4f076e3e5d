"""Cameras of photographs, as NeRF and Blender write them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from neurad.core.errors import InputError
from neurad.core.records import View
from neurad.runtime.reading import exists, read_json, regular_file, shown
from neurad.scene.numbers import number
from neurad.scene.picture_headers import SIDE, check_exr
from neurad.scene.readers.intrinsics import Size, camera_of, rigid


def read_split(folder: Path) -> tuple[list[View], list[View]]:
    """Training and held-out views of ``transforms_train.json`` and ``transforms_test.json``.

    Raises:
        InputError: one of the files is missing, or as :func:`read_views`.
    """
    for name in ("transforms_train.json", "transforms_test.json"):
        regular_file(folder / name, "the scene folder lacks this file")
    train = read_views(folder / "transforms_train.json", folder)
    return train, read_views(folder / "transforms_test.json", folder)


def read_views(path: str | Path, root: str | Path) -> list[View]:
    """The views of a camera file; paths in it are relative to ``root``.

    Args:
        path: JSON with ``frames`` and, in the file or in a frame, what :func:`camera_of` reads and optionally ``w`` and
            ``h``; without them a photograph says itself how large it is.
        root: folder of the photographs.

    Raises:
        InputError: not JSON, no frames, a bad camera, or a photograph that is missing.
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
        size = _size(settings, where) or check_exr(image)
        pose = rigid(frame.get("transform_matrix"), f"{where}: its transform_matrix")
        camera = camera_of((frame, described), size, pose, where)
        mask = _listed(root, frame, "mask_path", f"the mask is missing that {path.name} lists", path)
        maps = {kind: _map(root, frame, kind, image, path) for kind in ("albedo", "roughness")}
        relit = _map(root, frame, "relight", image, path) if "relight_path" in frame else None
        views.append(View(image.stem, camera, str(image), maps["albedo"], maps["roughness"], relit, mask))
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
    return str(regular_file(root / listed, missing))


def _size(settings: dict[str, Any], where: str) -> Size | None:
    """Width and height as the file has them, or None."""
    if settings.get("w") is None and settings.get("h") is None:
        return None
    width, height = (number(settings.get(key), f"{where}: {key}", 1, SIDE) for key in ("w", "h"))
    if width != int(width) or height != int(height):
        raise InputError(f"{where}: w and h are {width:g} and {height:g}, not numbers of pixels")
    return int(width), int(height)
