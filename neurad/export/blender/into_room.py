"""Put what was recovered into the Blender file that a room came from; started by neurad with the path of a job.

A job is a JSON file; its ``do`` names a step, each of which opens a file anew. ``read`` writes the polygons of all
objects. ``lay`` gives these texture coordinates and materials of their own, saves that, and writes what a render shows
of it. ``paint`` makes the materials, sets lamps and world, and saves the result. The file itself is only read, and no
script in it runs.
"""

import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np

JOB: dict[str, Any] = json.loads(Path(sys.argv[-1]).read_text(encoding="utf-8"))
sys.path += JOB["path"]
import blender_setup  # type: ignore[import-not-found]  # noqa: E402  # in the folders of the job's path
import write_room  # type: ignore[import-not-found]  # noqa: E402

LAYERS = 8
"""Layers of texture coordinates that a mesh may have."""
SURFACES = ("MESH", "CURVE", "SURFACE", "FONT", "META")


def read(job: dict[str, Any]) -> dict[str, Any]:
    """The polygons of every object that a render shows, and which objects belong to other files."""
    open_file(job["blend"])
    write_room.as_rendered(bpy.context.scene)
    scales: dict[str, float] = {}
    linked = set()
    for instance in bpy.context.evaluated_depsgraph_get().object_instances:
        thing = instance.object.original
        if not instance.show_self or thing.type not in SURFACES:
            continue
        if any(part.library or part.override_library for part in (thing, thing.data)):
            linked.add(thing.name)
            continue
        scale = abs(instance.matrix_world.to_3x3().determinant()) ** (1.0 / 3.0)
        scales[thing.name] = max(scales.get(thing.name, 0.0), scale)
    meshes: dict[str, dict[str, Any]] = {}
    for name, scale in scales.items():
        thing = bpy.data.objects[name, None]
        if thing.type != "MESH" or len(thing.data.polygons) == 0:
            continue
        if thing.data.name not in meshes:
            file = f"base{len(meshes):05d}.npz"
            np.savez(Path(job["out"]) / file, **polygons(thing.data))
            slots = ["" if material is None else material.name_full for material in thing.data.materials] or [""]
            full = len(thing.data.uv_layers) >= LAYERS
            meshes[thing.data.name] = {"file": file, "scale": 0.0, "slots": slots, "full": full}
        meshes[thing.data.name]["scale"] = max(meshes[thing.data.name]["scale"], scale)
    libraries = [library.filepath for library in bpy.data.libraries]
    return {"meshes": meshes, "objects": list(scales), "linked": sorted(linked), "libraries": libraries}


def polygons(mesh: Any) -> dict[str, Any]:
    """A mesh without its modifiers: places [v, 3], the place of each corner [c], and of its triangles the corners
    [t, 3], polygon [t] and slot [t]; and the coordinates of the corners that a render uses [c, 2].
    """
    mesh.calc_loop_triangles()
    count, corners = len(mesh.loop_triangles), len(mesh.loops)
    found = {
        "vertices": write_room.values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32),
        "vertex": write_room.values(mesh.loops, "vertex_index", (corners,), np.int32),
        "corners": write_room.values(mesh.loop_triangles, "loops", (count, 3), np.int32),
        "polygon": write_room.values(mesh.loop_triangles, "polygon_index", (count,), np.int32),
        "slot": write_room.values(mesh.loop_triangles, "material_index", (count,), np.int32),
    }
    if (layer := used_layer(mesh)) is not None:
        found["uv"] = write_room.values(layer.uv, "vector", (corners, 2), np.float32)
    return found


def used_layer(mesh: Any) -> Any:
    """The layer of texture coordinates that a render uses; None without any."""
    return next((layer for layer in getattr(mesh, "uv_layers", ()) if layer.active_render), None)


def lay(job: dict[str, Any]) -> dict[str, Any]:
    """A second layer of coordinates where the first does not serve, a new material for each that a texture is for, and
    what a render shows of all of it.
    """
    open_file(job["blend"])
    taken = {layer.name for name in job["meshes"] for layer in bpy.data.meshes[name, None].uv_layers}
    second = next(name for name in ("neurad", *(f"neurad {i}" for i in range(2, 1000))) if name not in taken)
    for name, entry in job["meshes"].items():
        if entry["file"] is not None:
            layer = bpy.data.meshes[name, None].uv_layers.new(name=second, do_init=False)
            layer.uv.foreach_set("vector", np.load(entry["file"]).ravel())
    made: dict[Any, dict[str, Any]] = {}
    new = set()
    for name in job["objects"]:
        thing = bpy.data.objects[name, None]
        entry = job["meshes"].get(thing.data.name) if thing.type == "MESH" else None
        if not thing.material_slots:
            thing.data.materials.append(None)
        for index, slot in enumerate(thing.material_slots):
            old = slot.material
            if old is not None and old.name in new:  # of an object that shares these polygons
                continue
            layout = None if entry is None else entry["layouts"][index]
            if entry is not None and layout is None:  # no polygon has this slot
                continue
            key = None if old is None else old.name_full, name if layout is None else layout
            if key not in made:
                material = bpy.data.materials.new(f"{name if old is None else old.name} recovered")
                used = used_layer(thing.data)
                uv = None if layout is None or job["constant"][layout] else used.name if job["own"][layout] else second
                made[key] = {"material": material.name, "old": key[0], "layout": layout, "uv": uv, "object": name}
                new.add(material.name)
                if old is not None:
                    made[key]["fake"] = old.use_fake_user
                    with suppress(AttributeError, RuntimeError):  # of a linked file, which may not be changed
                        old.use_fake_user = True
            slot.material = bpy.data.materials[made[key]["material"], None]
    save(job["part"])
    write_room.as_rendered(bpy.context.scene)
    room = write_room.Room(Path(job["out"]))
    room.add_objects()
    names = [material["name"] for material in room.materials.described]
    return {
        "made": list(made.values()), "objects": room.objects, "lamps": room.lamps, "materials": names, "second": second,
    }  # fmt: skip


def paint(job: dict[str, Any]) -> dict[str, Any]:
    """Materials, lamps and world as they were recovered."""
    open_file(job["part"])
    folder = Path(job["out"])
    table = blender_setup.over_angles(job, folder)
    back: dict[str, Any] = {}
    for entry in job["made"]:
        material = bpy.data.materials[entry["material"], None]
        if entry["surface"] is None:
            # A full name is that of a linked material with its library.
            old = next((known for known in bpy.data.materials if known.name_full == entry["old"]), None)
            back[material.name] = old
            if old is not None:
                with suppress(AttributeError, RuntimeError):
                    old.use_fake_user = entry["fake"]
                if material.name in job["emission"]:  # other lamps may have the old one
                    back[material.name] = old.copy()
                    shine(back[material.name], job["emission"][material.name])
        else:
            shade(material, entry, folder, table)
    for thing in bpy.data.objects:
        for slot in thing.material_slots if not thing.library else ():
            if slot.material is not None and slot.material.name in back:
                slot.material = back[slot.material.name]
    for name in back:
        bpy.data.materials.remove(bpy.data.materials[name, None])
    for name, entry in job["meshes"].items():
        layers = bpy.data.meshes[name, None].uv_layers
        if entry["file"] is not None and not entry["used"]:
            layers.remove(layers[job["second"]])
    for light, factor in {bpy.data.objects[name].data: factor for name, factor in job["lamps"].items()}.items():
        light.energy *= max(factor)
        light.color = [x * f / max(factor) for x, f in zip(light.color, factor, strict=True)]
    if job["environment"] is not None:
        if bpy.context.scene.world is not None:
            bpy.context.scene.world.use_fake_user = True
        blender_setup.set_world(bpy.context.scene, job, folder)
    blender_setup.light_paths(bpy.context.scene, job["max_depth"])
    for image in bpy.data.images:
        if image.library is None and not image.packed_file and image.filepath.startswith(job["out"]):
            image.pack()
            image.filepath_raw = Path(image.filepath).name
    save(job["save"])
    return {}


def shade(material: Any, entry: dict[str, Any], folder: Path, table: Any) -> None:
    """A Principled BSDF of the textures, or of one value each."""
    surface = entry["surface"]
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    inputs = blender_setup.principled(material).inputs
    inputs["IOR"].default_value = surface["ior"]
    if surface["diffuse"]:
        inputs["Specular IOR Level"].default_value = 0.0
    if "base" not in surface:
        inputs["Base Color"].default_value = (*surface["colour"], 1.0)
        inputs["Roughness"].default_value, inputs["Metallic"].default_value = surface["roughness"], surface["metallic"]
    else:
        where = nodes.new("ShaderNodeUVMap")
        where.uv_map = entry["uv"]

        def picture(key: str, space: str) -> Any:
            node = nodes.new("ShaderNodeTexImage")
            node.image = bpy.data.images.load(str(folder / surface[key]))
            node.image.colorspace_settings.name = space
            links.new(where.outputs[0], node.inputs["Vector"])
            return node

        base, others = picture("base", "sRGB"), picture("orm", "Non-Color")
        apart = nodes.new("ShaderNodeSeparateColor")
        links.new(base.outputs["Color"], inputs["Base Color"])
        links.new(others.outputs["Color"], apart.inputs[0])
        links.new(apart.outputs["Green"], inputs["Roughness"])
        links.new(apart.outputs["Blue"], inputs["Metallic"])
        for x, node in enumerate((where, base, others, apart)):
            node.location = (-300.0 * (4 - min(x, 2) - x // 3), 300.0 - 300.0 * (node == others))
        if "emission" in surface:
            shines = picture("emission", "sRGB")
            shines.location = (-600.0, -300.0)
            links.new(shines.outputs["Color"], inputs["Emission Color"])
            inputs["Emission Strength"].default_value = surface["strength"]
    if table is not None and surface["converted"]:
        blender_setup.colour_by_angle(material, table)
    if not surface["two_sided"]:
        blender_setup.black_from_behind(material)


def shine(material: Any, radiance: list[float]) -> None:
    """A material that shines with this radiance; what a picture gives stays."""
    shader = write_room.plain_shader(material.node_tree)
    inputs, before = shader.inputs, "" if shader.type == "EMISSION" else "Emission "
    if not inputs[f"{before}Color"].is_linked:
        inputs[f"{before}Strength"].default_value = max(radiance)
        inputs[f"{before}Color"].default_value = (*(x / max(radiance) for x in radiance), 1.0)


def open_file(path: str) -> None:
    """Open a file without its windows, and without running its scripts."""
    bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)


def save(path: str) -> None:
    """Save what is open under another name; pictures beside the first stay where they are."""
    bpy.ops.wm.save_as_mainfile(filepath=path, check_existing=False)


if __name__ == "__main__":
    answer = {"read": read, "lay": lay, "paint": paint}[JOB["do"]](JOB)
    Path(JOB["answer"]).write_text(json.dumps(answer), encoding="utf-8")
