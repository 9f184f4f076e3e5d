"""Cycles on ``scene.glb`` or a Blender file, in a Python or a Blender of its own: neither is ever imported here."""

import json
import tempfile
from pathlib import Path

from neurad.core.errors import InputError
from neurad.core.records import FloatArray
from neurad.core.scene_records import View
from neurad.export.blender import RENDER_VIEWS
from neurad.formats.blender.process import Blender
from neurad.images.image_io import read_exr
from neurad.runtime.machine import usable_cores


def render_views(
    blender: Blender, room: Path, views: list[View], samples: int, seed: int, transparent: bool = False
) -> list[FloatArray]:
    """Views of an exported room or of a Blender file [h, w, 3], linear, premultiplied by alpha; all have one size.
    What lies behind all surfaces of a Blender file is black where that is ``transparent``; a room says so itself.

    Raises:
        InputError: Blender ended without the pictures.
    """
    with tempfile.TemporaryDirectory() as out:
        job = Path(out) / "job.json"
        camera = views[0].camera
        described = {
            "folder": str(room), "views": [v.name for v in views], "width": camera.width,
            "height": camera.height, "samples": samples, "seed": seed, "threads": usable_cores(), "out": out,
        }  # fmt: skip
        if room.is_file():
            cameras = {v.name: {"to_world": v.camera.to_world.tolist(), "fov_x": v.camera.fov_x} for v in views}
            folder = str(RENDER_VIEWS.parent)
            described |= {"folder": folder, "blend": str(room.absolute()), "cameras": cameras}
            described["transparent"] = transparent
        job.write_text(json.dumps(described), encoding="utf-8")
        said = blender.run(RENDER_VIEWS, [str(job)])
        files = [Path(out) / f"{view.name}.exr" for view in views]
        if not all(file.is_file() for file in files):
            raise InputError(f"--blender: it rendered nothing of {room} ({said})")
        return [read_exr(file)[..., :3] for file in files]
