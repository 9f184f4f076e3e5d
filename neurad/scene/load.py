"""Loading scenes: built-in ones, and folders with a scene file and camera files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from neurad.core.errors import InputError
from neurad.core.records import View
from neurad.runtime.reading import exists, regular_file
from neurad.runtime.reading import folder as existing_folder
from neurad.scene.description import Scene

T = TypeVar("T")

RELIGHT = "env_relight.exr"
"""Map that lights the photographs named by ``relight_path``; it replaces the scene's own, in the same frame."""


def _mitsuba(folder: Path) -> Scene:
    from neurad.scene.readers.mitsuba_xml import read_xml

    return read_xml(folder / "scene.xml")


def _nerf(folder: Path) -> tuple[list[View], list[View]]:
    from neurad.scene.readers.nerf import read_split

    return read_split(folder)


SCENE_FILES: dict[str, Callable[[Path], Scene]] = {"scene.xml": _mitsuba}
"""Readers of meshes, materials and lights, by file name; the first one in a folder is read."""
CAMERA_FILES: dict[str, Callable[[Path], tuple[list[View], list[View]]]] = {"transforms_train.json": _nerf}
"""Readers of the training and the held-out views, by file name."""


def load_scene(root: str | None, scene: str | None) -> Scene:
    """The scene of a folder or a built-in one, checked.

    Args:
        root: a scene folder (``--data.root``), or None.
        scene: name of a built-in scene (``--data.scene``), or None.

    Raises:
        InputError: not exactly one is given, the name is unknown, or the scene cannot be used.
    """
    if (root is None) == (scene is None):
        raise InputError("give exactly one of --data.root (a scene folder) and --data.scene (a built-in scene)")
    if root is not None:
        return read_folder(root).check()
    from neurad.scene.builtin import build

    assert scene is not None
    return build(scene).check()


def read_folder(root: str | Path) -> Scene:
    """The scene of a folder with one of :data:`SCENE_FILES` and one of :data:`CAMERA_FILES`.

    Only the existence of photographs and maps is checked: at most the size of the first training photograph is read.

    Raises:
        InputError: something is missing or wrong; the sentence names the file and the frame.
    """
    folder = existing_folder(root, "--data.root")
    read_surfaces, read_cameras = _reader(SCENE_FILES, folder), _reader(CAMERA_FILES, folder)
    train, test = read_cameras(folder)
    relight = None
    if any(view.relight for view in test):
        relight = str(regular_file(folder / RELIGHT, "the map is missing that lights the photographs of relight_path"))
    return replace(read_surfaces(folder), name=folder.name, train=train, test=test, relight=relight)


def _reader(readers: dict[str, Callable[[Path], T]], folder: Path) -> Callable[[Path], T]:
    """The reader of the first file that the folder has.

    Raises:
        InputError: it has none of them.
    """
    for name, reader in readers.items():
        if exists(folder / name):
            return reader
    first, *others = readers
    instead = f" (or {', '.join(others)})" if others else ""
    raise InputError(f"{folder / first}: the scene folder lacks this file{instead}")
