"""The writer of ``scene.xml``, which Mitsuba 3 reads as neurad does.

A scene is described once, as a tree of plugins (:func:`describe`), which becomes XML (:func:`write_xml`).
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Array
from neurad.core.reflection import DielectricModel
from neurad.core.scene_records import Bitmap, Constant, EnvironmentMap, Material, Mesh, PunctualLight, Texture
from neurad.formats.meshes.ply import write_ply
from neurad.images.image_io import write_exr
from neurad.scene.description import Scene
from neurad.scene.punctual import pose

Node = dict[str, Any]
"""A plugin: its ``type``, and its parameters by name: numbers, strings, booleans, :class:`Matrix` or further nodes."""

TAGS = {
    "scene": "scene", "path": "integrator", "prb": "integrator", "perspective": "sensor", "hdrfilm": "film",
    "box": "rfilter", "independent": "sampler", "envmap": "emitter", "area": "emitter", "ply": "shape",
    "bitmap": "texture", "point": "emitter", "spot": "emitter", "directional": "emitter", "rgb": "rgb", "ref": "ref",
}  # fmt: skip
"""The XML element of each plugin that is no ``bsdf``."""
FOLDERS = ("meshes", "textures")
"""Where meshes and pictures lie beside ``scene.xml``."""


@dataclass(frozen=True)
class Matrix:
    """A transform: [4, 4], or [3, 3] of homogeneous texture coordinates."""

    values: Array
    placed: bool = False
    """Whether ``Scene.origin`` is added, by the parameters :data:`ORIGIN` of the file."""


ORIGIN = ("origin_x", "origin_y", "origin_z")
"""Parameters of a scene file of a room far from the origin: Mitsuba takes others with ``-D``, such as 0, as it computes
with float32."""


def file_names(names: Sequence[str], others: Iterable[str] = ()) -> list[str]:
    """Names of files for things of these names, no two alike and none of ``others``: letters, digits, ``-`` and ``_``.

    They have 56 characters at most, as Blender cuts off more.
    """
    taken, made = {name.lower() for name in others}, []
    for name in names:
        stem = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_")[:50] or "mesh"
        made.append(make_unique(stem, taken, "_", capitals=False))
    return made


def describe(
    scene: Scene, folder: Path, sensors: Sequence[Node] = (), integrator: Node | None = None, half: bool = True
) -> Node:
    """The tree of a scene; its meshes and pictures are written into ``folder``, whose paths it has relative to it.

    Args:
        folder: it gets the folders :data:`FOLDERS`.
        sensors: cameras, see :func:`neurad.formats.mitsuba.plugin.sensor`.
        integrator: defaults to ``path`` with the scene's ``max_depth`` and ``rr_depth``.
        half: write textures as half floats instead of floats. An environment keeps its range: it is always floats.

    Raises:
        InputError: a material that cannot be given to Mitsuba, or a file that cannot be written.
    """
    for name in FOLDERS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    pictures = Pictures(folder, half)
    tree: Node = {"type": "scene", "integrator": integrator or path_integrator(scene)}
    far = any(scene.origin)
    if far:
        tree |= dict(zip(ORIGIN, scene.origin, strict=True))
    tree |= {f"sensor_{i}": node for i, node in enumerate(sensors)}
    if scene.environment is not None:
        tree["environment"] = environment_node(scene.environment, folder)
    names = file_names([m.name for m in scene.materials])
    labels = {i: f"material-{names[i]}" for i in sorted({mesh.material for mesh in scene.meshes})}
    for i, label in labels.items():
        tree[label] = {**bsdf_node(scene.materials[i], names[i], pictures), "id": label}
    others = [*(mesh.name for mesh in scene.meshes), *(light.name for light in scene.punctual)]
    names = file_names(others, labels.values())
    for mesh, name in zip(scene.meshes, names[: len(scene.meshes)], strict=True):
        file = f"meshes/{name}.ply"
        write_ply(folder / file, mesh)
        tree[f"mesh-{name}"] = shape_node(mesh, name, file, {"type": "ref", "id": labels[mesh.material]})
        if far:
            tree[f"mesh-{name}"]["to_world"] = Matrix(np.eye(4), placed=True)
    for light, name in zip(scene.punctual, names[len(scene.meshes) :], strict=True):
        tree[f"light-{name}"] = punctual_node(light, name, far)
    return tree


def path_integrator(scene: Scene, hide_emitters: bool = False) -> Node:
    """Mitsuba's path tracer with the depths of a scene."""
    depth = -1 if scene.max_depth >= 2**31 - 1 else scene.max_depth
    return {"type": "path", "max_depth": depth, "rr_depth": scene.rr_depth, "hide_emitters": hide_emitters}


def write_xml(tree: Node, path: Path) -> None:
    """Write a tree as a scene file of Mitsuba 3."""
    root = ElementTree.Element("scene", version="3.0.0")
    for name, node in tree.items():
        if isinstance(node, dict):
            _append_node(root, node)
        elif name in ORIGIN:
            ElementTree.SubElement(root, "default", name=name, value=_number(node))
    ElementTree.indent(root, "\t")
    path.write_bytes(ElementTree.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")


class Pictures:
    """Writes bitmaps beside the scene file, each once."""

    def __init__(self, folder: Path, half: bool) -> None:
        self.folder = folder
        self.half = half
        self._written: dict[int, str] = {}

    def texture(self, texture: Texture, name: str) -> Any:
        """The node of a texture, or a plain number for a constant of one channel."""
        if isinstance(texture, Constant):
            value = [float(x) for x in texture.value]
            return {"type": "rgb", "value": value} if len(value) == 3 else value[0]
        if not isinstance(texture, Bitmap):
            raise InputError(f"{name}: a texture of vertex attributes is not written to scene.xml; bake it first")
        key = id(texture.pixels)
        if key not in self._written:
            self._written[key] = f"textures/{name}.exr"
            write_exr(self.folder / self._written[key], texture.pixels, self.half)
        node: Node = {"type": "bitmap", "filename": self._written[key], "raw": True}
        if not np.array_equal(texture.to_uv, np.eye(3)):
            node["to_uv"] = Matrix(np.asarray(texture.to_uv, np.float64))
        return node


def bsdf_node(material: Material, name: str, pictures: Pictures) -> Node:
    """The node of a material; ``name`` begins the names of its pictures."""
    textures = [pictures.texture(texture, f"{name}_{kind}") for kind, texture in material.textures.items()]
    inner = material.model.mitsuba(*textures)
    if material.two_sided and not isinstance(material.model, DielectricModel):
        return {"type": "twosided", "bsdf": inner}
    return inner


def shape_node(mesh: Mesh, name: str, file: str, bsdf: Any) -> Node:
    """The node of a mesh that lies in a PLY file."""
    shape: Node = {"type": "ply", "id": name, "filename": file, "face_normals": mesh.normals is None, "bsdf": bsdf}
    if mesh.radiance is not None:
        radiance = [float(x) for x in mesh.radiance]
        shape["emitter"] = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
    return shape


def punctual_node(light: PunctualLight, name: str, far: bool = False) -> Node:
    """The node of a light without extent; ``far`` if its place is relative to the scene's origin."""
    key = "irradiance" if light.kind == "directional" else "intensity"
    colour = {"type": "rgb", "value": [float(x) for x in light.intensity]}
    node: Node = {"type": light.kind, "id": name, key: colour, "to_world": Matrix(pose(light), far)}
    if light.kind == "spot":
        node |= {"cutoff_angle": float(light.cutoff_angle), "beam_width": float(light.beam_width)}
    return node


def environment_node(environment: EnvironmentMap, folder: Path) -> Node:
    """The node of an environment, whose map is written into ``folder``."""
    write_exr(folder / "environment.exr", environment.pixels, half=False)
    pose = np.asarray(environment.to_world, np.float64)
    return {"type": "envmap", "filename": "environment.exr", "to_world": Matrix(pose)}


def _append_node(parent: ElementTree.Element, node: Node, name: str | None = None) -> None:
    """Append a plugin to an XML element, as its parameter ``name`` where names matter."""
    tag = TAGS.get(node["type"], "bsdf")
    made = ElementTree.SubElement(parent, tag)
    if tag in ("rgb", "texture") and name is not None:
        made.set("name", name)
    if tag == "rgb":
        made.set("value", ", ".join(_number(x) for x in node["value"]))
        return
    if tag != "ref":
        made.set("type", node["type"])
    if "id" in node:
        made.set("id", node["id"])
    for key, value in node.items():
        if key in ("type", "id"):
            continue
        if isinstance(value, dict):
            _append_node(made, value, key)
        elif isinstance(value, Matrix):
            transform = ElementTree.SubElement(made, "transform", name=key)
            ElementTree.SubElement(transform, "matrix", value=" ".join(_entries(value.values)))
            if value.placed:
                step = {axis: f"${name}" for axis, name in zip("xyz", ORIGIN, strict=True)}
                ElementTree.SubElement(transform, "translate", step)
        else:
            kind, text = _literal(value)
            ElementTree.SubElement(made, kind, name=key, value=text)


def _entries(matrix: Array) -> Iterator[str]:
    """The entries of a [4, 4] transform row by row; one of texture coordinates acts on x and y alike."""
    full = np.eye(4)
    if len(matrix) == 3:
        full[np.ix_((0, 1, 3), (0, 1, 3))] = matrix
    else:
        full = np.asarray(matrix, np.float64)
    return (_number(float(x)) for x in full.ravel())


def _literal(value: Any) -> tuple[str, str]:
    """The XML element and text of a plain value."""
    if isinstance(value, bool):
        return "boolean", "true" if value else "false"
    if isinstance(value, int):
        return "integer", str(value)
    if isinstance(value, float):
        return "float", _number(value)
    return "string", str(value)


def _number(value: float) -> str:
    """A number with all the digits of a float32 or more."""
    return repr(float(value))
