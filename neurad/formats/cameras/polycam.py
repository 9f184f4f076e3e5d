"""Cameras of a Polycam export: a JSON file a photograph."""

from pathlib import Path

from neurad.core.errors import InputError, Refusals
from neurad.core.scene_records import View
from neurad.formats.cameras.intrinsics import FAR, make_camera, rigid
from neurad.formats.cameras.nerf import Split
from neurad.formats.cameras.photograph_files import Photographs, photographs_of
from neurad.images.picture_headers import SIDE
from neurad.runtime.numbers import number
from neurad.runtime.reading import exists, read_json, shown

FOLDERS = ("corrected_cameras", "cameras")
"""Folders below ``keyframes``: cameras after Polycam's own adjustment, and before."""


def read_export(source: Path, images: Path | None) -> Split:
    """The views of an export, in the frame of Polycam's mesh: its matrices as they are.

    Args:
        images: folder of the photographs, None where they lie in the export.

    Raises:
        InputError: there are no cameras, a file is broken, or a photograph is missing.
    """
    keyframes = source / "keyframes" if exists(source / "keyframes") else source
    photograph = photographs_of(images, keyframes / "corrected_images", keyframes / "images")
    found = {keyframes / name: sorted((keyframes / name).glob("*.json")) for name in FOLDERS}
    folder, files = next(((folder, files) for folder, files in found.items() if files), (None, []))
    if folder is None:
        raise InputError(f"{shown(source)}: it has no keyframes/corrected_cameras/*.json, as Polycam's raw data have")
    views, refusals = [], Refusals()
    for path in files:
        with refusals.part():
            views.append(_view(path, photograph))
    refusals.end()
    said = f"{folder}: these are cameras before Polycam's adjustment, which may not fit the mesh"
    return Split(views, [], (said,) if folder.name == FOLDERS[1] else ())


def _view(path: Path, photograph: Photographs) -> View:
    described = read_json(path)
    if not isinstance(described, dict):
        raise InputError(f"{path}: it is not the camera of a photograph")
    rows = [[described.get(f"t_{i}{j}") for j in range(4)] for i in range(3)]
    if any(value is None for row in rows for value in row):
        raise InputError(f"{path}: it lacks one of t_00 to t_23")
    pose = rigid([*rows, [0.0, 0.0, 0.0, 1.0]], f"{path}: its matrix t_00 to t_23")
    size = (
        int(number(described.get("width"), f"{path}: width", 1, SIDE)),
        int(number(described.get("height"), f"{path}: height", 1, SIDE)),
    )
    keys = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy"}
    values = {key: number(described.get(name), f"{path}: {name}", -FAR, FAR) for key, name in keys.items()}
    camera = make_camera(pose, size, "PINHOLE", values, str(path))
    return View(path.stem, camera, str(photograph(path.stem, str(path))))
