"""Write what is in a Blender scene into a folder, from which ``neurad data blender FOLDER --out DIR`` makes a scene.

    blender --background room.blend --python write_room.py -- FOLDER

or, with a Python that has bpy, ``python write_room.py -- FOLDER room.blend``. The folder gets ``blender.json``, written
last: cameras, lamps, objects and materials, their numbers as Blender has them; and what it names: meshes with modifiers
applied as they are rendered (.npz), pictures (.npy) and the world as Cycles shows it (world.exr).
"""

import json
import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from room_materials import Materials, plain_shader  # type: ignore[import-not-found]  # it lies beside this file
from room_world import world_of  # type: ignore[import-not-found]

FORMAT = 1
"""Version of what is written."""
FRAMES = 10_000
"""Frames of an animated camera, at most."""
_LEFT_OUT = {"CURVES": "hair curves", "POINTCLOUD": "a point cloud", "VOLUME": "a volume"}
_LEFT_OUT |= dict.fromkeys(("GPENCIL", "GREASEPENCIL"), "grease pencil")
_RAYS = ("camera", "diffuse", "glossy", "transmission", "shadow")
_CAMERA = ("type", "lens", "sensor_width", "sensor_height", "sensor_fit", "shift_x", "shift_y")
_CYCLES = (
    "diffuse_bounces", "max_bounces", "sample_clamp_direct", "sample_clamp_indirect", "film_exposure",
    "caustics_refractive",
)  # fmt: skip
_LAMP = ("type", "shape", "size", "size_y", "spread", "shadow_soft_size", "angle", "spot_size", "spot_blend")


class Room:
    """What is found, and what of it is left out."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.materials = Materials(out)
        self.objects: list[dict[str, Any]] = []
        self.lamps: list[dict[str, Any]] = []
        self.left_out: dict[str, list[str]] = {}
        self._meshes: dict[Any, Any] = {}
        self._count = 0

    def add_objects(self) -> None:
        """All instances of what has a surface or shines."""
        depsgraph = bpy.context.evaluated_depsgraph_get()
        for instance in depsgraph.object_instances:
            thing = instance.object
            if not instance.show_self:
                continue
            if thing.type == "LIGHT":
                self._add_lamp(thing, instance.matrix_world)
            elif isinstance(thing.data, bpy.types.Mesh):  # as Cycles: curves and the like come again as their meshes
                self._add_surface(thing, instance)
            elif thing.type in _LEFT_OUT:
                self.left_out.setdefault(_LEFT_OUT[thing.type], []).append(thing.name)
            for system in getattr(thing, "particle_systems", ()) if not instance.is_instance else ():
                if system.settings.type == "HAIR" and system.settings.render_type == "PATH":
                    self.left_out.setdefault("hair", []).append(thing.name)

    def _add_surface(self, thing: Any, instance: Any) -> None:
        seen = [ray for ray in _RAYS if getattr(thing, f"visible_{ray}", True)]
        if not seen:
            return
        mesh = self._mesh(thing)
        if mesh is None:
            return
        materials = list(mesh["materials"])
        for index, slot in enumerate(thing.material_slots):
            if slot.link == "OBJECT" and index < len(materials):
                materials[index] = self.materials.index(slot.material)
        special = [word for word in ("holdout", "shadow_catcher") if getattr(thing, f"is_{word}", False)]
        self.objects.append({
            "name": thing.name, "mesh": mesh["file"], "flat": mesh["flat"], "uvs": mesh["uvs"],
            "materials": materials, "to_world": rows(instance.matrix_world),
            "unseen_by": [ray for ray in _RAYS if ray not in seen], "special": special,
        })  # fmt: skip

    def _mesh(self, thing: Any) -> Any:
        """The triangles of an object, written once for all that share them; None without any."""
        key = thing.data.as_pointer()
        if key not in self._meshes:
            made = thing.to_mesh()
            try:
                self._meshes[key] = None if made is None else self._write_mesh(made)
            finally:
                thing.to_mesh_clear()
        return self._meshes[key]

    def _write_mesh(self, mesh: Any) -> Any:
        mesh.calc_loop_triangles()
        count = len(mesh.loop_triangles)
        if count == 0:
            return None
        loops = values(mesh.loop_triangles, "loops", (count, 3), np.int32)
        of_loop = values(mesh.loops, "vertex_index", (len(mesh.loops),), np.int32)
        arrays = {
            "vertices": values(mesh.vertices, "co", (len(mesh.vertices), 3), np.float32),
            "faces": of_loop[loops],
            "material": values(mesh.loop_triangles, "material_index", (count,), np.int32),
        }
        flat = mesh.normals_domain == "FACE"
        if not flat:
            arrays["normals"] = values(mesh.corner_normals, "vector", (len(mesh.loops), 3), np.float32)[loops]
        names = {}
        for index, layer in enumerate(mesh.uv_layers):
            names[layer.name] = f"uv{index}"
            arrays[f"uv{index}"] = values(layer.uv, "vector", (len(mesh.loops), 2), np.float32)[loops]
            if layer.active_render:
                names[""] = f"uv{index}"
        file = f"mesh{self._count:05d}.npz"
        self._count += 1
        np.savez(self.out / file, **arrays)
        materials = [self.materials.index(material) for material in mesh.materials] or [self.materials.index(None)]
        return {"file": file, "flat": flat, "uvs": names, "materials": materials}

    def _add_lamp(self, thing: Any, to_world: Any) -> None:
        light = thing.data
        if getattr(getattr(light, "cycles", None), "is_portal", False):
            return
        colour, unread = lamp_colour(light)
        described = {key: getattr(light, key) for key in _LAMP if hasattr(light, key)}
        described |= {"name": thing.name, "watts": colour, "unread": unread, "to_world": rows(to_world)}
        described["normalize"] = bool(getattr(light, "normalize", True))
        described["unseen_by"] = [ray for ray in _RAYS if not getattr(thing, f"visible_{ray}", True)]
        described["shadow"] = bool(getattr(light, "use_shadow", True))
        self.lamps.append(described)


def lamp_colour(light: Any) -> tuple[list[float], str]:
    """Energy times colour of a lamp [3], and what of its nodes could not be read."""
    strength = light.energy * 2.0 ** getattr(light, "exposure", 0.0)
    colour = [strength * x for x in light.color]
    if getattr(light, "use_temperature", False):
        colour = [x * y for x, y in zip(colour, light.temperature_color, strict=False)]
    if not light.use_nodes or light.node_tree is None:
        return colour, ""
    node = plain_shader(light.node_tree)
    if node is None:
        return [0.0, 0.0, 0.0], ""
    if node.type != "EMISSION" or node.inputs["Color"].is_linked or node.inputs["Strength"].is_linked:
        return colour, "its nodes are more than an Emission of one colour and strength"
    factor = node.inputs["Strength"].default_value
    return [x * factor * y for x, y in zip(colour, node.inputs["Color"].default_value[:3], strict=True)], ""


def cameras_of(scene: Any) -> Iterator[dict[str, Any]]:
    """Every camera; one that moves once for each frame."""
    now = scene.frame_current
    cameras = [thing for thing in scene.objects if thing.type == "CAMERA"]
    moving = [camera for camera in cameras if moves(camera)]
    frames = list(range(scene.frame_start, scene.frame_end + 1, scene.frame_step))[:FRAMES] if moving else []
    seen: dict[str, list[dict[str, Any]]] = {camera.name: [] for camera in moving}
    for frame in frames:
        scene.frame_set(frame)
        for camera in moving:
            numbers = {"frame": frame, **numbers_of(camera), "active": scene.camera == camera}
            seen[camera.name].append(numbers)
    scene.frame_set(now)
    for camera in cameras:
        found = seen.get(camera.name, [])
        if any(found[0][key] != other[key] for other in found[1:] for key in ("to_world", *_CAMERA)):
            for one in found:
                number = f"{one['frame']:04d}"
                names = [f"{camera.name}_{number}", *([number] if one["active"] else [])]
                yield {**one, "names": names}
            continue
        marks = [f"{mark.frame:04d}" for mark in scene.timeline_markers if mark.camera == camera]
        yield {**numbers_of(camera), "names": [camera.name, *marks]}


def numbers_of(camera: Any) -> dict[str, Any]:
    """Where a camera stands now, and how it sees."""
    there = camera.evaluated_get(bpy.context.evaluated_depsgraph_get())
    return {**{key: getattr(there.data, key) for key in _CAMERA}, "to_world": rows(there.matrix_world)}


def moves(thing: Any) -> bool:
    """Whether something may be animated: itself, its data, what it hangs on."""
    if any(part is not None and part.animation_data is not None for part in (thing, thing.data)):
        return True
    above = [thing.parent, *(getattr(constraint, "target", None) for constraint in thing.constraints)]
    return any(other is not None and moves(other) for other in above)


def as_rendered(scene: Any) -> None:
    """Show in the viewport, which Python sees, what a render shows."""
    scene.render.simplify_subdivision = scene.render.simplify_subdivision_render
    collections = [bpy.context.view_layer.layer_collection]
    while collections:
        layer = collections.pop()
        collections += layer.children
        with suppress(AttributeError, RuntimeError):  # of linked files, which may not be changed
            layer.hide_viewport, layer.collection.hide_viewport = False, layer.collection.hide_render
    for thing in scene.objects:
        with suppress(AttributeError, RuntimeError):
            thing.hide_viewport = thing.hide_render
            thing.hide_set(False)
            thing.show_instancer_for_viewport = thing.show_instancer_for_render
        for modifier in thing.modifiers:
            with suppress(AttributeError, RuntimeError):
                modifier.show_viewport = modifier.show_render
                if modifier.type in ("SUBSURF", "MULTIRES"):
                    modifier.levels = modifier.render_levels
        for system in thing.particle_systems:
            with suppress(AttributeError, RuntimeError):
                system.settings.display_percentage = 100
    bpy.context.view_layer.update()


def values(items: Any, name: str, shape: tuple[int, ...], kind: Any) -> Any:
    """An attribute of all items of a collection as an array."""
    array = np.empty(math.prod(shape), kind)
    items.foreach_get(name, array)
    return array.reshape(shape)


def rows(matrix: Any) -> list[list[float]]:
    """A matrix as lists."""
    return [list(row) for row in matrix]


def write(out: Path, blend: str | None) -> None:
    """Write the folder of the Blender file ``blend``, or of what is open."""
    if blend is not None:
        bpy.ops.wm.open_mainfile(filepath=blend, load_ui=False, use_scripts=False)
    out.mkdir(parents=True, exist_ok=True)
    scene = bpy.context.scene
    as_rendered(scene)
    room = Room(out)
    room.add_objects()
    world, said = world_of(scene, out)
    render = scene.render
    described = {
        "neurad_blender": FORMAT,
        "blender": bpy.app.version_string,
        "scene": scene.name,
        "frame": scene.frame_current,
        "film": [render.resolution_x * render.resolution_percentage // 100,
                 render.resolution_y * render.resolution_percentage // 100],
        "pixel_aspect": [render.pixel_aspect_x, render.pixel_aspect_y],
        "objects": room.objects,
        "lamps": room.lamps,
        "materials": room.materials.described,
        "world": world,
        "cameras": list(cameras_of(scene)),
        "left_out": room.left_out,
        "notes": [*said, *room.materials.notes],
        "cycles": {key: getattr(scene.cycles, key) for key in _CYCLES if hasattr(scene.cycles, key)},
    }  # fmt: skip
    part = out / "blender.json.part"
    part.write_text(json.dumps(described), encoding="utf-8")
    part.replace(out / "blender.json")
    print(f"neurad: wrote {out}", flush=True)


if __name__ == "__main__":
    given = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []
    if not given:
        raise SystemExit("write_room.py: name the folder to write: -- FOLDER [room.blend]")
    write(Path(given[0]), given[1] if len(given) > 1 else None)
