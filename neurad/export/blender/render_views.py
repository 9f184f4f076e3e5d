"""Render views of an exported room with Cycles; started by neurad with the path of a job, a JSON file.

The job has ``folder`` (of the room), ``views`` (names of cameras), ``width``, ``height``, ``samples``, ``seed``,
``threads`` and ``out`` (a folder that gets NAME.exr of each view, linear floats). It prints ``view NAME`` after each.
With ``blend``, a Blender file in place of the folder, ``cameras`` has ``to_world`` and ``fov_x`` of each view, and
``transparent`` says whether the world is left out where a camera sees it.
"""

import json
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix


def main(job: dict[str, Any]) -> None:
    """Do the job."""
    folder = Path(job["folder"])
    sys.path.insert(0, str(folder))
    import blender_setup  # type: ignore[import-not-found]  # it lies in the room's folder

    if "blend" in job:
        bpy.ops.wm.open_mainfile(filepath=job["blend"], load_ui=False, use_scripts=False)
        cameras = {name: camera(**seen) for name, seen in job["cameras"].items()}
        bpy.context.scene.render.film_transparent = job["transparent"]
    else:
        blender_setup.setup(folder)
        cameras = {thing.data.name: thing for thing in bpy.data.objects if thing.type == "CAMERA"}
    scene = bpy.context.scene
    blender_setup.pixels_alone(scene)
    scene.cycles.samples = job["samples"]
    scene.cycles.seed = job["seed"]
    scene.cycles.device = "CPU"
    scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.resolution_x, scene.render.resolution_y = job["width"], job["height"]
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    for name in job["views"]:
        scene.camera = cameras[name]
        scene.render.filepath = str(Path(job["out"]) / f"{name}.exr")
        bpy.ops.render.render(write_still=True)
        print(f"view {name}", flush=True)


def camera(to_world: list[list[float]], fov_x: float) -> Any:
    """A camera that stands there and sees so wide an angle."""
    lens = bpy.data.cameras.new("neurad")
    lens.sensor_fit, lens.angle, lens.clip_start = "HORIZONTAL", fov_x, 1e-4
    made = bpy.data.objects.new("neurad", lens)
    made.matrix_world = Matrix(to_world)
    bpy.context.scene.collection.objects.link(made)
    return made


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8")))
