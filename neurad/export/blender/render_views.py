"""Render views of an exported room with Cycles; started by neurad with the path of a job, a JSON file.

The job has ``folder`` (of the room), ``views`` (names of cameras), ``width``, ``height``, ``samples``, ``seed``,
``threads`` and ``out`` (a folder that gets NAME.exr of each view, linear floats). It prints ``view NAME`` after each.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy


def main(job: dict[str, Any]) -> None:
    """Do the job."""
    folder = Path(job["folder"])
    sys.path.insert(0, str(folder))
    from blender_setup import setup  # type: ignore[import-not-found]  # it lies in the room's folder

    setup(folder)
    scene = bpy.context.scene
    scene.cycles.samples = job["samples"]
    scene.cycles.seed = job["seed"]
    scene.cycles.device = "CPU"
    scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.resolution_x, scene.render.resolution_y = job["width"], job["height"]
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    cameras = {thing.data.name: thing for thing in bpy.data.objects if thing.type == "CAMERA"}
    for name in job["views"]:
        scene.camera = cameras[name]
        scene.render.filepath = str(Path(job["out"]) / f"{name}.exr")
        bpy.ops.render.render(write_still=True)
        print(f"view {name}", flush=True)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8")))
