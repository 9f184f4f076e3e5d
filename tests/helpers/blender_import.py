"""For Blender's Python: import a file, and say what is there or render it with Cycles.

Its argument is a JSON file that describes the job.
"""

import json
import sys
from collections import Counter
from pathlib import Path

import bpy
import numpy as np
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector


def described(thing):
    """A mesh object: triangles, emitted radiance, which inputs have textures."""
    nodes = thing.data.materials[0].node_tree.nodes
    shader = next(node for node in nodes if node.type == "BSDF_PRINCIPLED")
    strength = shader.inputs["Emission Strength"].default_value
    return {
        "triangles": len(thing.data.polygons),
        "emission": [strength * x for x in shader.inputs["Emission Color"].default_value[:3]] if strength else [0.0],
        "textured": [name for name in ("Base Color", "Roughness") if shader.inputs[name].is_linked],
    }


def picture(scene, job):
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = job["samples"], False
    scene.camera = next(thing for thing in bpy.data.objects if thing.type == "CAMERA" and thing.name == job["view"])
    form = scene.render.image_settings
    form.file_format, form.color_mode, form.color_depth = "OPEN_EXR", "RGBA", "32"
    scene.render.filepath = job["out"]
    bpy.ops.render.render(write_still=True)


def main(job):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.world = bpy.data.worlds.new("world")  # USD's importer adds a dome to one that is there
    if job["file"].endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=job["file"])
    else:
        bpy.ops.wm.usd_import(filepath=job["file"])
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y = job["width"], job["height"]
    scene.render.resolution_percentage = 100
    if "view" in job:
        picture(scene, job)
        return
    bpy.context.view_layer.update()
    meshes = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    cameras = [thing for thing in bpy.data.objects if thing.type == "CAMERA"]
    corners = np.array([thing.matrix_world @ v.co for thing in meshes for v in thing.data.vertices])
    points = [Vector((x, -z, y)) for x, y, z in job["points"]]  # to where Blender has z up
    views = {
        thing.name: [(at.x, 1.0 - at.y, at.z) for at in (world_to_camera_view(scene, thing, point) for point in points)]
        for thing in cameras
    }
    found = {
        "meshes": [described(thing) for thing in meshes],
        "bounds": [corners.min(0).tolist(), corners.max(0).tolist()],
        "images": Counter(image.colorspace_settings.name for image in bpy.data.images),
        "cameras": views,
    }
    Path(job["out"]).write_text(json.dumps(found))


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[-1]).read_text()))
