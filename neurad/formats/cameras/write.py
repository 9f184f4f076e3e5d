"""Camera files as they are written: NeRF's and Blender's keys, with nerfstudio's for lenses; and what they name."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.parameters import BY_NAME
from neurad.core.reflection import DiffuseLobe
from neurad.core.scene_records import PINHOLE, Camera, View
from neurad.formats.cameras import RELIGHT
from neurad.formats.cameras.intrinsics import described
from neurad.runtime.files import place
from neurad.scene.description import Scene
from neurad.scene.origin import ZERO, moved_views

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


def transforms(views: Sequence[View], origin: npt.ArrayLike = ZERO, maps: Sequence[str] = ()) -> dict[str, Any]:
    """The camera file of views: what all their cameras share stands at the top, what they do not in each frame.

    Args:
        views: relative to ``origin``.
        origin: ``Scene.origin``, which is added.
        maps: surface parameters of which there are maps beside the photographs.
    """
    views = moved_views(views, origin)
    lenses = [described(view.camera) for view in views]
    shared = lenses[0] if all(lens == lenses[0] for lens in lenses) else {}
    return {
        **shared,
        "frames": [
            {
                "file_path": f"images/{view.name}.exr",
                **{f"{name}_path": f"{name}/{view.name}.exr" for name in maps},
                **({} if shared else lens),
                **({} if view.development.exposure is None else {"exposure": view.development.exposure}),
                "transform_matrix": [[float(x) for x in row] for row in view.camera.to_world],
            }
            for view, lens in zip(views, lenses, strict=True)
        ],
    }


def write_cameras(
    path: Path,
    views: Sequence[View],
    copy: bool,
    origin: npt.ArrayLike = ZERO,
    diffuse: DiffuseLobe | None = None,
) -> None:
    """Write the camera file of views, and beside it their photographs, masks and true maps as links or copies.

    Args:
        path: of the camera file; files of views that lie where they belong already stay as they are.
        views: their names unique.
        copy: copy files instead of linking to them.
        diffuse: lobe that principled surfaces have in the photographs, where that is known.
    """
    written = {**({} if diffuse is None else {"diffuse_lobe": diffuse}), **transforms(views, origin)}
    for view, frame in zip(views, written["frames"], strict=True):
        for kind, source in view.files.items():
            name = f"{KINDS[kind]}/{view.name}{Path(source).suffix.lower()}"
            frame["file_path" if kind == "image" else f"{kind}_path"] = name
            if Path(source) != path.parent / name:
                place(Path(source), path.parent / name, copy)
    path.write_text(json.dumps(written, indent=1) + "\n", encoding="utf-8")


def write_views(scene: Scene, folder: Path, copy: bool) -> list[str]:
    """Write the camera files of a scene's views, and what they name.

    Returns:
        What is missing for the folder to be fitted again: parts some of whose views have no photograph, or that have no
        view at all.
    """
    parts = {"train": scene.train, "test": scene.test}
    for part, views in parts.items():
        if views:
            write_cameras(folder / f"transforms_{part}.json", views, copy, scene.origin, scene.diffuse)
    if scene.relight is not None:
        place(Path(scene.relight), folder / RELIGHT, copy)
    return [part for part, views in parts.items() if not views or not all(view.image for view in views)]
