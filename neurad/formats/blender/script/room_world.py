"""The world of a Blender scene, for ``write_room.py``: a colour, or a picture of all directions rendered by Cycles."""

import math
from pathlib import Path
from typing import Any

import bpy
from room_materials import plain_shader  # type: ignore[import-not-found]  # it lies beside this file

WIDEST = 4096
"""Pixels of the picture along the horizon, at most."""
_PROCEDURAL = 1024  # pixels where no picture says how fine the world is
_SAMPLES = 16  # a pixel, where it is not a pixel of a picture


def world_of(scene: Any, out: Path) -> tuple[dict[str, Any] | None, list[str]]:
    """What lights from all around, and what has to be said of it."""
    world = scene.world
    if world is None:
        return None, []
    if not world.use_nodes or world.node_tree is None:
        return {"color": list(world.color)}, []
    notes = []
    output = world.node_tree.get_output_node("CYCLES")
    if output is not None and output.inputs["Volume"].is_linked:
        notes.append("the world has a volume, which is left out")
    if any(node.type == "LIGHT_PATH" for node in world.node_tree.nodes):
        notes.append("the world differs by Light Path: it is taken as a camera sees it")
    background = plain_shader(world.node_tree)
    if background is None:
        return None, notes
    inputs = background.inputs
    if background.type == "BACKGROUND" and not inputs["Color"].is_linked and not inputs["Strength"].is_linked:
        strength = inputs["Strength"].default_value
        return {"color": [strength * x for x in inputs["Color"].default_value[:3]]}, notes
    _render(world, out / "world.exr")
    return {"file": "world.exr"}, notes


def _render(world: Any, file: Path) -> None:
    """A picture of all directions, +Z up, its middle the direction +Y."""
    pictures = [node.image for node in world.node_tree.nodes if node.type == "TEX_ENVIRONMENT" and node.image]
    wide = max((image.size[0] for image in pictures), default=0)
    exact = 0 < wide <= WIDEST
    scene = bpy.data.scenes.new("neurad world")
    scene.world = world
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.samples = 1 if exact else _SAMPLES
    cycles.use_denoising = cycles.use_adaptive_sampling = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.pixel_filter_type, cycles.filter_width = "BOX", 0.01 if exact else 1.0
    scene.render.film_transparent = False
    scene.render.resolution_x = min(wide, WIDEST) or _PROCEDURAL
    scene.render.resolution_y = max(scene.render.resolution_x // 2, 2)
    scene.render.resolution_percentage = 100
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGB", "32"
    lens = bpy.data.cameras.new("neurad world")
    lens.type = "PANO"
    where = lens if hasattr(lens, "panorama_type") else lens.cycles
    where.panorama_type = "EQUIRECTANGULAR"
    camera = bpy.data.objects.new("neurad world", lens)
    camera.rotation_euler = (math.pi / 2.0, 0.0, 0.0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    scene.render.filepath = str(file)
    bpy.ops.render.render(write_still=True, scene=scene.name)
