"""Cycles on ``scene.glb``, in a Python or a Blender of its own: neither is ever imported here."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, View
from neurad.export.blender import render_views_path
from neurad.formats.blender.process import Blender
from neurad.images.image_io import read_exr
from neurad.runtime.machine import usable_cores


def render_views(blender: Blender, folder: Path, views: list[View], samples: int, seed: int) -> list[FloatArray]:
    """Views of an exported folder [h, w, 3], linear, premultiplied by alpha.

    Args:
        blender: what renders.
        folder: of the room.
        views: which, of one size.
        samples: per pixel.
        seed: of its random numbers.

    Raises:
        InputError: Blender ended without the pictures.
    """
    with tempfile.TemporaryDirectory() as out:
        job = Path(out) / "job.json"
        camera = views[0].camera
        described = {
            "folder": str(folder), "views": [v.name for v in views], "width": camera.width,
            "height": camera.height, "samples": samples, "seed": seed, "threads": usable_cores(), "out": out,
        }  # fmt: skip
        job.write_text(json.dumps(described), encoding="utf-8")
        said = blender.run(render_views_path(), [str(job)])
        files = [Path(out) / f"{view.name}.exr" for view in views]
        if not all(file.is_file() for file in files):
            raise InputError(f"--blender: it rendered nothing of {folder} ({said})")
        return [read_exr(file)[..., :3] for file in files]
