"""For Blender's Python: what a .blend file has, as a line of JSON; its argument is the file."""

import json
import sys

import bpy
import numpy as np


def values(items, name, width):
    """A hash of what all items have under a name."""
    found = np.empty(len(items) * width, np.float32)
    items.foreach_get(name, found)
    return [len(items), float(np.abs(found).sum()), float((found * np.arange(len(found))).sum())]


def numbers(modifier):
    kinds = ("INT", "FLOAT", "BOOLEAN", "ENUM")
    return {p.identifier: str(getattr(modifier, p.identifier)) for p in modifier.bl_rna.properties
            if p.type in kinds and p.identifier != "execution_time"}  # fmt: skip


def radiance(material):
    """What the first shader of a material emits."""
    for node in material.node_tree.nodes if material and material.node_tree else ():
        if node.type == "BSDF_PRINCIPLED":
            strength = node.inputs["Emission Strength"].default_value
            return [strength * x for x in node.inputs["Emission Color"].default_value[:3]]
    return []


def main(path):
    bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)
    things = sorted(bpy.data.objects, key=lambda thing: thing.name)
    surfaces = [thing for thing in things if thing.type in ("MESH", "FONT")]
    meshes = sorted(bpy.data.meshes, key=lambda mesh: mesh.name)
    print(json.dumps({
        "objects": [[thing.name, thing.type, thing.data and thing.data.name, [list(row) for row in thing.matrix_world]]
                    for thing in things],
        "modifiers": {thing.name: [[m.name, m.type, numbers(m)] for m in thing.modifiers] for thing in things},
        "instances": [[thing.name, thing.instance_collection.name] for thing in things if thing.instance_collection],
        "vertices": {mesh.name: values(mesh.vertices, "co", 3) for mesh in meshes},
        "uvs": {mesh.name: {layer.name: [layer.active_render, *values(layer.uv, "vector", 2)]
                            for layer in mesh.uv_layers if layer.name != "neurad"} for mesh in meshes},
        "second": {mesh.name: [layer.name for layer in mesh.uv_layers if layer.name == "neurad"] for mesh in meshes},
        "materials": {thing.name: [slot.material and slot.material.name for slot in thing.material_slots]
                      for thing in surfaces},
        "shines": {thing.name: [radiance(slot.material) for slot in thing.material_slots] for thing in surfaces},
        "lamps": [[light.name, light.energy, list(light.color)] for light in bpy.data.lights],
        "scripts": [[text.name, text.as_string(), text.use_module] for text in bpy.data.texts],
    }))  # fmt: skip


main(sys.argv[-1])
