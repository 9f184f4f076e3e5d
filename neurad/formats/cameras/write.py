"""Camera files and photographs of a scene folder."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurad.core.parameters import BY_NAME
from neurad.core.records import PINHOLE, Camera, View
from neurad.formats.cameras.transforms import transforms
from neurad.formats.load import RELIGHT
from neurad.runtime.files import place
from neurad.scene.description import Scene

KINDS = {
    "image": "images",
    **{name: name for name in BY_NAME},
    "relight": "images_relight",
    "mask": "masks",
    "spread": "spread",
}
"""Folders of the files of a view."""
NO_LENS = "other programs' cameras have no lens distortion, square pixels and their centre in the middle"
LONGEST = 56
"""Bytes of the name of a view: Blender keeps 63 of a camera's, and adds some where two are alike."""


def shown_alike(scene: Scene) -> list[View]:
    """The views that other programs can show: of those held out, or without any of all, the ones of the first one's
    size whose cameras are pinholes over the middle of square pixels. They have no distortion.
    """
    plain = [view for view in scene.test or scene.train if is_plain(view.camera)]
    size = [(view.camera.width, view.camera.height) for view in plain[:1]]
    return [view for view in plain if [(view.camera.width, view.camera.height)] == size]


def is_plain(camera: Camera) -> bool:
    """Whether a camera is a pinhole over the middle of square pixels."""
    return camera.lens == PINHOLE


def clip_planes(scene: Scene, camera: Camera) -> tuple[float, float]:
    """Distances before and beyond which nothing is seen: whatever the unit, all of the scene lies in between.

    The near one is as far as viewers with a depth buffer want it, half a millimetre in a room of five metres.
    """
    low, high = scene.bounds.astype(np.float64)
    eye = np.asarray(camera.to_world, np.float64)[:3, 3]
    far = max(2.0 * float(np.linalg.norm(np.maximum(np.abs(low - eye), np.abs(high - eye)))), 1e-30)
    return 5e-5 * far, far


def named_apart(scene: Scene) -> Scene:
    """The scene with views whose names serve as those of files and of cameras: unique, and no longer than Blender
    keeps; if any is not, all are numbered.
    """
    names = [view.name for view in (*scene.train, *scene.test)]
    fit = all(name and len(name.encode(errors="replace")) <= LONGEST and name.isprintable() for name in names)
    if fit and len({name.lower() for name in names}) == len(names):
        return scene
    train = [replace(view, name=f"train_{i:03d}") for i, view in enumerate(scene.train)]
    return replace(scene, train=train, test=[replace(v, name=f"test_{i:03d}") for i, v in enumerate(scene.test)])


def files_of(scene: Scene) -> list[str]:
    """Photographs and true maps of all views, and the map of the second light."""
    views = (*scene.train, *scene.test)
    files = [path for view in views for path in view.files.values()]
    return [file for file in (*files, scene.relight) if file is not None]


def write_views(scene: Scene, folder: Path, copy: bool) -> list[str]:
    """Write the camera files of a scene's views, with their photographs and true maps as links or copies.

    Args:
        scene: whose views, their names unique.
        folder: the scene folder.
        copy: copy files instead of linking to them.

    Returns:
        What is missing for the folder to be fitted again: parts some of whose views have no photograph, or that have no
        view at all.

    Raises:
        OSError: a file cannot be written or read.
    """
    missing = []
    for part in ("train", "test"):
        views: list[View] = getattr(scene, part)
        if not all(view.image for view in views) or not views:
            missing.append(part)
        if not views:
            continue
        described = transforms(views, scene.origin)
        for view, frame in zip(views, described["frames"], strict=True):
            for kind, where in KINDS.items():
                key = "file_path" if kind == "image" else f"{kind}_path"
                source = view.files.get(kind)
                if source is not None:
                    ending = Path(source).suffix.lower() if kind in ("image", "mask") else ".exr"
                    frame[key] = f"{where}/{view.name}{ending}"
                    place(Path(source), folder / frame[key], copy)
        (folder / f"transforms_{part}.json").write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")
    if scene.relight is not None:
        place(Path(scene.relight), folder / RELIGHT, copy)
    return missing
