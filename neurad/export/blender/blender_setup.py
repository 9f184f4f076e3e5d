"""Open an exported room in Blender so that it looks as it was recovered.

    blender --python blender_setup.py

It imports scene.glb from the folder that it lies in, into an empty scene, and sets what importers leave wrong: a view
transform that changes colours, limits that darken indirect light, lamps that shine to both sides, and the environment.
"""

import json
import math
from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix

SAMPLES = 256


def setup(folder: Path) -> None:
    """Import the room of ``folder`` into an empty scene and set Cycles up for it."""
    room: dict[str, Any] = json.loads((folder / "room.json").read_text(encoding="utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.import_scene.gltf(filepath=str(folder / "scene.glb"))
    scene = bpy.context.scene
    if any(room["origin"]):  # Blender computes with float32: the room stands at the origin, its place is remembered
        scene["origin"] = room["origin"]
        for thing in bpy.data.objects:
            if thing.parent is None:
                thing.location = (0.0, 0.0, 0.0)
    light_paths(scene, room["max_depth"])
    pixels_alone(scene)
    scene.cycles.samples = SAMPLES
    scene.render.film_transparent = room["hide_environment"]
    scene.render.dither_intensity = 0.0
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"
    scene.view_settings.exposure, scene.view_settings.gamma = 0.0, 1.0
    set_world(scene, room, folder)
    _lights(room)
    table = over_angles(room, folder)
    for mesh in room["meshes"]:
        material = bpy.data.materials.get(mesh["name"])
        if material is None or material.node_tree is None:
            continue
        if table is not None and mesh["base_color_converted"]:
            colour_by_angle(material, table)
        if mesh["emits"]:
            _shine_to_the_front(material)
        if not mesh["two_sided"]:
            black_from_behind(material)
    cameras = [thing for thing in bpy.data.objects if thing.type == "CAMERA"]
    scene.camera = next((c for c in cameras if c.data.name == room["camera"]), cameras[0] if cameras else None)
    if room["film"] is not None:  # that of this camera; without a pinhole among them there are no cameras
        scene.render.resolution_x, scene.render.resolution_y = room["film"]
    scene.render.resolution_percentage = 100


def light_paths(scene: Any, max_depth: int) -> None:
    """Cycles with light as it is: nothing clamped, blurred or left out, and nothing twice: shadow rays pass what casts
    no shadow, as panes may, and caustics would bring the same light again.
    """
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = 0.0
    cycles.caustics_reflective = True
    cycles.caustics_refractive = all(thing.visible_shadow for thing in scene.objects if thing.type == "MESH")
    bounces = max(min(max_depth - 2, 1024), 0)
    for kind in ("max", "diffuse", "glossy", "transmission", "transparent_max"):
        setattr(cycles, f"{kind}_bounces", bounces)


def pixels_alone(scene: Any) -> None:
    """All samples for each pixel, nothing from its neighbours."""
    cycles = scene.cycles
    cycles.use_denoising = False
    cycles.use_adaptive_sampling = False
    cycles.pixel_filter_type = "BOX"
    cycles.filter_width = 1.0


def set_world(scene: Any, room: dict[str, Any], folder: Path) -> None:
    """The environment, turned as it was; black without one."""
    world = scene.world = bpy.data.worlds.new("room")
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    background = nodes["Background"]
    background.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    if room["environment"] is None:
        return
    picture = nodes.new("ShaderNodeTexEnvironment")
    picture.image = bpy.data.images.load(str(folder / room["environment"]["file"]))
    picture.interpolation = "Linear"
    # Blender is z-up: glTF's (x, y, z) is its (x, -z, y).
    to_blender = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))
    to_y, to_world = Matrix(room["to_y"]), Matrix(room["environment"]["to_world"])
    # From directions of the world in Blender to the map's frame, +Y up, and from there to Blender's way of reading it,
    # in which the left edge of the picture looks another way by a quarter turn.
    to_map = (to_blender @ to_y @ to_world).inverted()
    quarter = Matrix.Rotation(math.radians(90.0), 3, "Z")
    turned = nodes.new("ShaderNodeMapping")
    turned.vector_type = "POINT"
    turned.inputs["Rotation"].default_value = (quarter @ to_blender @ to_map).to_euler("XYZ")
    where = nodes.new("ShaderNodeTexCoord")
    links.new(where.outputs["Generated"], turned.inputs["Vector"])
    links.new(turned.outputs["Vector"], picture.inputs["Vector"])
    links.new(picture.outputs["Color"], background.inputs["Color"])


def _lights(room: dict[str, Any]) -> None:
    """Lights without extent, as bright as they are: importers may take their units another way, and soften them.

    A point of 1 W/sr has 4 pi watts here, and so has a spot, whatever its cone; a sun has its irradiance.
    """
    for light in room["lights"]:
        found = bpy.data.lights.get(light["name"])
        if found is None:
            continue
        strength = max(light["intensity"])
        found.color = [x / strength for x in light["intensity"]]
        found.energy = strength if light["type"] == "directional" else 4.0 * math.pi * strength
        if light["type"] == "directional":
            found.angle = 0.0
        else:
            found.shadow_soft_size = 0.0
        if light["type"] == "spot":
            _cone(found, math.radians(light["cutoff_angle"]), math.radians(light["beam_width"]))


def _cone(spot: Any, cutoff: float, beam: float) -> None:
    """Light that falls linearly with the angle from the axis between ``beam`` and ``cutoff``, in radians."""
    spot.spot_size, spot.spot_blend = 2.0 * cutoff, 0.0
    if beam >= cutoff:
        return
    spot.use_nodes = True
    nodes, links = spot.node_tree.nodes, spot.node_tree.links
    emission = next(node for node in nodes if node.type == "EMISSION")
    kinds = ("TexCoord", "VectorMath", "SeparateXYZ", "Math", "Math", "MapRange")
    where, unit, split, upright, angle, falloff = (nodes.new(f"ShaderNode{kind}") for kind in kinds)
    unit.operation, upright.operation, angle.operation = "NORMALIZE", "ABSOLUTE", "ARCCOSINE"
    for name, value in {"From Min": cutoff, "From Max": beam, "To Min": 0.0, "To Max": 1.0}.items():
        falloff.inputs[name].default_value = value
    falloff.clamp = True
    links.new(where.outputs["Normal"], unit.inputs[0])  # of a lamp: the direction from it, in its frame
    links.new(unit.outputs[0], split.inputs[0])
    links.new(split.outputs["Z"], upright.inputs[0])  # the axis is -Z
    links.new(upright.outputs[0], angle.inputs[0])
    links.new(angle.outputs[0], falloff.inputs["Value"])
    links.new(falloff.outputs["Result"], emission.inputs["Strength"])


def principled(material: Any) -> Any:
    """The principled node of an imported material."""
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def over_angles(room: dict[str, Any], folder: Path) -> Any:
    """What base colours are multiplied by, over the cosine to the viewer and roughness; None where they are not."""
    if room["base_color_over_angles"] is None:
        return None
    table = bpy.data.images.load(str(folder / room["base_color_over_angles"]))
    table.colorspace_settings.name = "Non-Color"
    return table


def colour_by_angle(material: Any, table: Any) -> None:
    """A base colour that sends as much light into each direction as it did where it was recovered."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    shader = principled(material)
    colour, roughness = shader.inputs["Base Color"], shader.inputs["Roughness"]
    kinds = ("NewGeometry", "VectorMath", "Math", "CombineXYZ", "TexImage", "VectorMath")
    geometry, dot, cosine, where, gain, times = (nodes.new(f"ShaderNode{kind}") for kind in kinds)
    dot.operation, cosine.operation, times.operation = "DOT_PRODUCT", "ABSOLUTE", "MULTIPLY"
    gain.image, gain.interpolation, gain.extension = table, "Linear", "EXTEND"
    links.new(geometry.outputs["Normal"], dot.inputs[0])
    links.new(geometry.outputs["Incoming"], dot.inputs[1])
    links.new(dot.outputs["Value"], cosine.inputs[0])
    links.new(cosine.outputs[0], where.inputs["X"])
    for source, value, to in (
        (roughness, roughness.default_value, where.inputs["Y"]),
        (colour, tuple(colour.default_value)[:3], times.inputs[0]),
    ):
        if source.is_linked:
            links.new(source.links[0].from_socket, to)
        else:
            to.default_value = value
    links.new(where.outputs[0], gain.inputs["Vector"])
    links.new(gain.outputs["Color"], times.inputs[1])
    links.new(times.outputs[0], colour)


def _shine_to_the_front(material: Any) -> None:
    """Light leaves by the front alone: strength times 1 - Backfacing."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    strength = principled(material).inputs["Emission Strength"]
    geometry, front = nodes.new("ShaderNodeNewGeometry"), nodes.new("ShaderNodeMath")
    front.operation = "MULTIPLY_ADD"
    links.new(geometry.outputs["Backfacing"], front.inputs[0])
    front.inputs[1].default_value, front.inputs[2].default_value = -strength.default_value, strength.default_value
    links.new(front.outputs[0], strength)
    material.cycles.emission_sampling = "FRONT"


def black_from_behind(material: Any) -> None:
    """A one-sided surface reflects nothing from behind."""
    nodes, links = material.node_tree.nodes, material.node_tree.links
    output = next(node for node in nodes if node.type == "OUTPUT_MATERIAL")
    geometry, black, mix = (nodes.new(f"ShaderNode{kind}") for kind in ("NewGeometry", "BsdfDiffuse", "MixShader"))
    black.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    links.new(geometry.outputs["Backfacing"], mix.inputs[0])
    links.new(principled(material).outputs[0], mix.inputs[1])
    links.new(black.outputs[0], mix.inputs[2])
    links.new(mix.outputs[0], output.inputs["Surface"])


if __name__ == "__main__":
    setup(Path(__file__).resolve().parent)
