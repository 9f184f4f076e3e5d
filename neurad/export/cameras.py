"""Camera files and photographs of a scene folder."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from neurad.core.camera import focal_length
from neurad.core.records import View
from neurad.scene.description import Scene
from neurad.scene.load import RELIGHT

KINDS = {"image": "images", "albedo": "albedo", "roughness": "roughness", "relight": "images_relight"}
"""Folders of the files of a view."""


def transforms(views: Sequence[View]) -> dict[str, Any]:
    """The NeRF/Blender camera file of views that share one film, their files in the folders that belong to them."""
    camera = views[0].camera
    focal = focal_length(camera)
    return {
        "camera_angle_x": camera.fov_x,
        "w": camera.width,
        "h": camera.height,
        "fl_x": focal,
        "fl_y": focal,
        "frames": [
            {
                "file_path": f"images/{view.name}.exr",
                "albedo_path": f"albedo/{view.name}.exr",
                "roughness_path": f"roughness/{view.name}.exr",
                "transform_matrix": [[float(x) for x in row] for row in view.camera.to_world],
            }
            for view in views
        ],
    }


def named_apart(scene: Scene) -> Scene:
    """The scene with views whose names are unique: a folder has one file of each name."""
    names = [view.name for view in (*scene.train, *scene.test)]
    if len({name.lower() for name in names}) == len(names):
        return scene
    train = [replace(view, name=f"train_{i:03d}") for i, view in enumerate(scene.train)]
    return replace(scene, train=train, test=[replace(v, name=f"test_{i:03d}") for i, v in enumerate(scene.test)])


def write_views(scene: Scene, folder: Path, copy: bool) -> list[str]:
    """Write the camera files of a scene's views, with their photographs and true maps as links or copies.

    Args:
        scene: whose views, their names unique.
        folder: the scene folder.
        copy: copy files instead of linking to them.

    Returns:
        What is missing for the folder to be fitted again: parts without photographs.

    Raises:
        OSError: a file cannot be written or read.
    """
    missing = []
    for part in ("train", "test"):
        views = [view for view in getattr(scene, part) if view.image is not None]
        if not views:
            missing.append(part)
            continue
        described = transforms(views)
        for view, frame in zip(views, described["frames"], strict=True):
            for kind, where in KINDS.items():
                key = "file_path" if kind == "image" else f"{kind}_path"
                source = getattr(view, kind)
                if source is None:
                    frame.pop(key, None)
                    continue
                frame[key] = f"{where}/{view.name}.exr"
                place(Path(source), folder / where / f"{view.name}.exr", copy)
        (folder / f"transforms_{part}.json").write_text(json.dumps(described, indent=1) + "\n")
    if scene.relight is not None:
        place(Path(scene.relight), folder / RELIGHT, copy)
    return missing


def place(source: Path, target: Path, copy: bool) -> None:
    """Put a file at ``target``: a link to the original, or a copy.

    Raises:
        OSError: it cannot be written or read.
    """
    target.parent.mkdir(exist_ok=True)
    if copy:
        shutil.copyfile(source, target)
    else:
        os.symlink(source.resolve(), target)
