"""For Blender's Python: a small furnished room as a .blend file, and its photographs by Cycles.

Its argument is a JSON file that describes the job: ``blend`` to write, ``views``, ``size``, ``samples``, ``threads``,
and ``pictures``, a folder that gets NAME.exr of each view, with ``passes`` as layers of one file. With ``open`` the
room is Lambertian and without a ceiling, below a sky that is turned and a sun, with a spot, a point, a box that shines,
a carpet with a picture that lies askew, a pane of glass, and pots that nodes put there. With ``crowd`` there are copies
of many kinds, tiled coordinates, and a script.
"""

import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Vector

PAINTS = {
    "floor": ((0.45, 0.30, 0.18), 0.6), "walls": ((0.70, 0.68, 0.62), 0.8), "left": ((0.60, 0.20, 0.15), 0.7),
    "right": ((0.20, 0.40, 0.60), 0.7), "table": ((0.50, 0.35, 0.10), 0.5), "ball": ((0.25, 0.55, 0.25), 0.5),
}  # fmt: skip
WIDE, DEEP, HIGH = 4.0, 5.0, 2.6


def put(name, data, place=(0, 0, 0), turned=(0, 0, 0)):
    """A new object in the scene."""
    made = bpy.data.objects.new(name, data)
    made.location, made.rotation_euler = place, turned
    bpy.context.collection.objects.link(made)
    return made


def material(name):
    """A new material with its nodes, and what links them."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    return made, made.node_tree.nodes, made.node_tree.links.new


def added(nodes, *kinds):
    return [nodes.new(f"ShaderNode{kind}") for kind in kinds]


def paint(name, lambertian):
    """A Principled BSDF of a colour and a roughness, or a Diffuse BSDF of the colour."""
    made, nodes, link = material(name)
    colour, roughness = PAINTS[name]
    shader = nodes["Principled BSDF"]
    if lambertian:
        nodes.remove(shader)
        (shader,) = added(nodes, "BsdfDiffuse")
        shader.inputs["Color"].default_value = (*colour, 1.0)
        link(shader.outputs[0], nodes["Material Output"].inputs["Surface"])
        return made
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["IOR"].default_value = 1.5
    return made


def solid(name, corners, faces, paints, of_face=None):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(corners, [], faces)
    for one in paints:
        mesh.materials.append(one)
    for polygon, index in zip(mesh.polygons, of_face or [0] * len(faces), strict=True):
        polygon.material_index = index
    return put(name, mesh)


def lay(thing, name, uvs):
    """Texture coordinates of an object of one polygon."""
    for loop, uv in zip(thing.data.uv_layers.new(name=name).uv, uvs, strict=True):
        loop.vector = uv


def word(name, text, size, extrude):
    made = bpy.data.curves.new(name, "FONT")
    made.body, made.size, made.extrude = text, size, extrude
    return made


def show(group, *places_and_turns):
    """A collection, shown at some places."""
    for place, turned in places_and_turns:
        shown = put(group.name, None, place, turned)
        shown.instance_type, shown.instance_collection = "COLLECTION", group


def box(name, low, high, paints, of_face=(0,) * 6, without=()):
    """A box; its faces are those below, above, before (-y), behind, left (-x) and right."""
    (a, b, c), (d, e, f) = low, high
    corners = [(x, y, z) for z in (c, f) for y in (b, e) for x in (a, d)]
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    kept = [i for i in range(6) if i not in without]
    return solid(name, corners, [faces[i] for i in kept], paints, [of_face[i] for i in kept])


def carpet():
    """A rectangle with a picture of four colours, turned, scaled and moved."""
    made = solid("carpet", [(0.8, 0.4, 0.02), (3.2, 0.4, 0.02), (3.2, 1.8, 0.02), (0.8, 1.8, 0.02)], [(0, 1, 2, 3)], [])
    lay(made, "lie", ((0, 0), (1, 0), (1, 1), (0, 1)))
    picture = bpy.data.images.new("four", 64, 64)  # of codes, between which Cycles interpolates: so they are many
    red, green, blue, white = ((0.9, 0.1, 0.1, 1), (0.1, 0.9, 0.1, 1), (0.1, 0.1, 0.9, 1), (0.9, 0.9, 0.9, 1))
    picture.pixels = ((red * 32 + green * 32) * 32) + ((blue * 32 + white * 32) * 32)
    picture.pack()
    cloth, nodes, link = material("carpet")
    nodes.remove(nodes["Principled BSDF"])
    where, turn, image, shader = added(nodes, "UVMap", "Mapping", "TexImage", "BsdfDiffuse")
    where.uv_map, image.image = "lie", picture
    turn.inputs["Location"].default_value = (0.1, 0.2, 0.0)
    turn.inputs["Rotation"].default_value = (0.0, 0.0, 0.5)
    turn.inputs["Scale"].default_value = (1.5, 0.8, 1.0)
    link(where.outputs[0], turn.inputs["Vector"])
    link(turn.outputs[0], image.inputs["Vector"])
    link(image.outputs["Color"], shader.inputs["Color"])
    link(shader.outputs[0], nodes["Material Output"].inputs["Surface"])
    made.data.materials.append(cloth)


def pots():
    """Cubes that geometry nodes put on the corners of a square, and a collection that is shown twice."""
    tree = bpy.data.node_groups.new("pots", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="INPUT", socket_type="NodeSocketGeometry")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", "NodeGroupOutput", "GeometryNodeInstanceOnPoints", "GeometryNodeMeshCube")
    given, made, instances, cube = (tree.nodes.new(kind) for kind in kinds)
    cube.inputs["Size"].default_value = (0.2, 0.2, 0.4)
    tree.links.new(given.outputs[0], instances.inputs["Points"])
    tree.links.new(cube.outputs[0], instances.inputs["Instance"])
    tree.links.new(instances.outputs[0], made.inputs[0])
    square = solid("pots", [(2.6, 3.0, 0.2), (3.4, 3.0, 0.2), (3.4, 3.4, 0.2)], [(0, 1, 2)], [])
    square.modifiers.new("pots", "NODES").node_group = tree
    group = bpy.data.collections.new("stool")
    group.objects.link(bpy.data.objects.new("stool", word("stool", "N", 0.8, 0.1)))
    show(group, *(((x, 4.2, 0.1), (1.5, 0.0, 0.3)) for x in (0.9, 1.6)))
    box("unseen", (1.0, 1.0, 0.0), (3.0, 3.0, 2.0), []).hide_render = True


def pane():
    """A window that stands in the room: glass, and nothing at all for shadow rays."""
    made, nodes, link = material("pane")
    box("pane", (2.4, 3.2, 0.9), (3.4, 3.22, 1.7), [made])
    path, either, mix, glass, clear = added(nodes, "LightPath", "Math", "MixShader", "BsdfGlass", "BsdfTransparent")
    either.operation, glass.inputs["Roughness"].default_value, glass.inputs["IOR"].default_value = "MAXIMUM", 0.0, 1.5
    link(path.outputs["Is Shadow Ray"], either.inputs[0])
    link(path.outputs["Is Diffuse Ray"], either.inputs[1])
    for output, socket in zip((either, glass, clear), mix.inputs, strict=True):
        link(output.outputs[0], socket)
    link(mix.outputs[0], nodes["Material Output"].inputs["Surface"])


def tile(thing, times):
    """Coordinates that repeat a picture so many times over each polygon."""
    layer = thing.data.uv_layers.new(name="tiles")
    for polygon in thing.data.polygons:
        for loop, uv in zip(polygon.loop_indices, ((0, 0), (1, 0), (1, 1), (0, 1)), strict=True):
            layer.uv[loop].vector = [times * x for x in uv]


def crowd(paints, library):
    """Tiled coordinates, a mirrored bench with bevels, stools that a collection shows three times, one of them with a
    material of its own, a picture whose coordinates serve as they are, a text, and a vase of another file.
    """
    tile(bpy.data.objects["room"], 3.0)
    bench = box("bench", (0.0, 0.9, 0.0), (0.5, 1.3, 0.4), [paints["left"], paints["right"]], [0, 1, 0, 0, 0, 0], (4,))
    bench.location = (2.3, 0.0, 0.0)
    tile(bench, 0.5)
    mirror, bevel = bench.modifiers.new("half", "MIRROR"), bench.modifiers.new("round", "BEVEL")
    mirror.use_clip, bevel.width, bevel.segments = True, 0.03, 2
    group = bpy.data.collections.new("stools")
    stool = box("stool", (-0.15, -0.15, 0.0), (0.15, 0.15, 0.4), [paints["ball"]])
    bpy.context.collection.objects.unlink(stool)
    group.objects.link(stool)
    show(group, *(((x, 4.3, 0.0), (0.0, 0.0, turn)) for x, turn in ((0.8, 0.0), (1.4, 0.6), (2.9, 1.1))))
    other = put("red stool", stool.data, (3.4, 2.4, 0.0))
    other.material_slots[0].link, other.material_slots[0].material = "OBJECT", paints["left"]
    poster = solid("poster", [(1.2, 4.98, 1.0), (2.6, 4.98, 1.0), (2.6, 4.98, 2.0), (1.2, 4.98, 2.0)], [(0, 1, 2, 3)],
                   [paints["right"]])  # fmt: skip
    lay(poster, "own", ((0.1, 0.1), (0.9, 0.1), (0.9, 0.9), (0.1, 0.9)))
    text = word("word", "Hi", 0.7, 0.05)
    text.materials.append(paints["left"])
    put("word", text, (0.05, 1.2, 1.4), (1.5708, 0.0, 1.5708))
    vase = box("vase", (3.6, 0.3, 0.0), (3.8, 0.5, 0.5), [paints["table"].copy()])
    bpy.data.libraries.write(library, {vase}, fake_user=True)  # a library of its own, linked
    bpy.data.objects.remove(vase)
    with bpy.data.libraries.load(library, link=True) as (_, linked):
        linked.objects = ["vase"]
    bpy.context.collection.objects.link(linked.objects[0])
    script = bpy.data.texts.new("run.py")  # what runs by itself where scripts may run
    script.from_string("import pathlib, bpy\npathlib.Path(bpy.data.filepath).with_name('ran').touch()\n")
    script.use_module = True


def shine_more():
    """A sky, a sun, a spot, a point and a box that shines."""
    world = bpy.context.scene.world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    nodes, link = world.node_tree.nodes, world.node_tree.links.new
    picture = bpy.data.images.new("sky", 32, 16, float_buffer=True)
    picture.pixels = [x for row in range(16) for column in range(32) for x in
                      (0.1 + column / 32, 0.3 + 0.5 * (column < 8), 0.2 + row / 16, 1.0)]  # fmt: skip
    picture.pack()
    where, turn, sky = added(nodes, "TexCoord", "Mapping", "TexEnvironment")
    turn.inputs["Rotation"].default_value, sky.image = (0.3, -0.2, 1.1), picture
    link(where.outputs["Generated"], turn.inputs["Vector"])
    link(turn.outputs["Vector"], sky.inputs["Vector"])
    link(sky.outputs["Color"], nodes["Background"].inputs["Color"])
    nodes["Background"].inputs["Strength"].default_value = 0.6
    carpet()
    pots()
    for kind, energy, place, turned in (
        ("SUN", 1.5, (0, 0, 5), (0.5, 0.4, 0.0)),
        ("SPOT", 60.0, (3.2, 1.0, 2.4), (0.0, 0.0, 0.0)),
        ("POINT", 10.0, (1.0, 1.0, 1.2), (0.0, 0.0, 0.0)),
    ):
        light = bpy.data.lights.new(kind.lower(), kind)
        light.energy = energy
        if kind == "SUN":
            light.angle = 0.0
        else:
            light.shadow_soft_size = 0.0
        if kind == "SPOT":
            light.spot_size, light.spot_blend = 1.2, 0.1
        put(kind.lower(), light, place, turned)
    glow, nodes, link = material("glow")
    (emission,) = added(nodes, "Emission")
    emission.inputs["Color"].default_value, emission.inputs["Strength"].default_value = (1.0, 0.6, 0.3, 1.0), 3.0
    link(emission.outputs[0], nodes["Material Output"].inputs["Surface"])
    box("heater", (0.3, 2.0, 0.1), (0.5, 3.0, 0.6), [glow])


def furnish(is_open):
    paints = {name: paint(name, is_open) for name in PAINTS}
    walls = [paints[name] for name in ("floor", "walls", "left", "right")]
    box("room", (0, 0, 0), (WIDE, DEEP, HIGH), walls, [0, 1, 1, 1, 2, 3], without=(1,) if is_open else ())
    if is_open:
        shine_more()
        pane()
    box("table", (1.2, 2.0, 0.62), (2.6, 3.0, 0.7), [paints["table"]])
    leg = box("leg", (-0.05, -0.05, 0.0), (0.05, 0.05, 0.62), [paints["table"]])
    leg.location = (1.3, 2.1, 0.0)
    for axis, step, name in ((0, 1.2, "across"), (1, 0.8, "along")):
        array = leg.modifiers.new(name, "ARRAY")
        array.count, array.use_relative_offset, array.use_constant_offset = 2, False, True
        array.constant_offset_displace = [step if i == axis else 0.0 for i in range(3)]
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=2, radius=0.3, location=(1.7, 2.4, 1.0))
    ball = bpy.context.object
    ball.name = "ball"
    ball.data.materials.append(paints["ball"])
    ball.modifiers.new("finer", "SUBSURF").render_levels = 2
    for polygon in ball.data.polygons:
        polygon.use_smooth = True
    put("ball.001", ball.data, (3.2, 3.9, 0.4)).scale = (-1.2, 1.0, 1.3)  # shares the mesh, mirrored and squeezed
    ceiling = bpy.data.lights.new("ceiling", "AREA")
    ceiling.shape, ceiling.size, ceiling.size_y, ceiling.energy = "RECTANGLE", 1.0, 0.5, 90.0
    if is_open:  # unlike Cycles' lamps it is in the way of the sky
        ceiling.size, ceiling.size_y = 0.4, 0.25
    ceiling.color = (1.0, 0.9, 0.75)
    put("ceiling", ceiling, (2.0, 2.5, HIGH - 0.05)).scale = (1.4, 1.0, 1.0)
    bulb = bpy.data.lights.new("bulb", "POINT")
    bulb.energy, bulb.shadow_soft_size = 12.0, 0.08
    put("bulb", bulb, (0.6, 4.3, 1.4))
    return paints


def look(name, eye, target):
    """A camera, shifted and of other sensors now and then."""
    lens = bpy.data.cameras.new(name)
    lens.lens, lens.sensor_width = 18.0, 36.0
    return put(name, lens, eye, (Vector(target) - Vector(eye)).to_track_quat("-Z", "Y").to_euler())


def cameras(count):
    """Views from around the room, all to its middle and beyond."""
    made = []
    for i in range(count):
        angle = 2.0 * math.pi * (i + 0.5) / count
        eye = (2.0 + 1.65 * math.cos(angle), 2.5 + 2.15 * math.sin(angle), 1.1 + 0.9 * (0.5 + 0.5 * math.sin(5.0 * i)))
        target = (2.0 - 0.8 * math.cos(angle), 2.5 - 0.8 * math.sin(angle), 0.7 + 0.5 * (i % 3))
        made.append(look("Camera" if i == 0 else f"Camera.{i:03d}", eye, target))
    made[1].data.shift_x, made[1].data.shift_y = 0.1, -0.05
    made[2].data.sensor_fit, made[2].data.sensor_height, made[2].data.lens = "VERTICAL", 24.0, 14.0
    return made


def photograph(made, job):
    scene = bpy.context.scene
    for camera in made:
        scene.camera = camera
        scene.render.filepath = str(Path(job["pictures"]) / f"{camera.name}.exr")
        bpy.ops.render.render(write_still=True)


def settings(job):
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.seed = job["samples"], 7
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.sample_clamp_direct = scene.cycles.sample_clamp_indirect = scene.cycles.blur_glossy = 0.0
    scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 32
    scene.render.threads_mode, scene.render.threads = "FIXED", job["threads"]
    scene.render.resolution_x, scene.render.resolution_y = job["size"]
    scene.render.resolution_percentage = 100
    form = scene.render.image_settings
    form.file_format, form.color_mode, form.color_depth = "OPEN_EXR", "RGB", "32"
    if job.get("passes", False):
        form.file_format, form.color_mode, form.color_depth = "OPEN_EXR_MULTILAYER", "RGBA", "16"
        layer = bpy.context.view_layer
        layer.use_pass_z = layer.use_pass_normal = layer.use_pass_diffuse_color = True


def main(job):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    paints = furnish(job.get("open", False))
    if job.get("crowd", False):
        crowd(paints, str(Path(job["blend"]).with_name("library.blend")))
    made = cameras(job["views"])
    settings(job)
    bpy.ops.wm.save_as_mainfile(filepath=job["blend"])
    if "pictures" in job:
        photograph(made, job)


if __name__ == "__main__":
    main(json.loads(Path(sys.argv[-1]).read_text()))
