"""A scene folder of views and meshes that come from elsewhere: links to photographs, one camera file, ``scene.xml``."""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.parameters import BY_NAME
from neurad.core.records import (
    Constant,
    EnvironmentMap,
    Float64Array,
    FloatArray,
    Material,
    Mesh,
    PunctualLight,
    VertexAttribute,
    View,
    constant,
)
from neurad.core.reflection import PrincipledModel
from neurad.formats.cameras.nerf import Split
from neurad.formats.cameras.transforms import transforms
from neurad.formats.meshes.files import MeshFile
from neurad.formats.meshes.ply import write_ply
from neurad.formats.mitsuba.write import append_node, environment_node, punctual_node
from neurad.runtime.files import place, writing
from neurad.runtime.numbers import number
from neurad.runtime.reading import listed, shown
from neurad.scene.description import is_dielectric
from neurad.scene.origin import origin_of
from neurad.scene.punctual import moved_light

UP = {f"{sign}{axis}": i * 2 + (sign == "-") for i, axis in enumerate("xyz") for sign in ("", "-")}
"""Axes that may point up."""
_PAINT = "paint"
"""Id of the material that is to be recovered."""
_ROUNDED = 1e-2  # what matrices written with three digits have too much or too little
_TILT = 0.8  # smallest cosine between the mean of what cameras hold up and an axis


@dataclass(frozen=True)
class RoomParts:
    """What a scene folder is made of."""

    views: Split
    meshes: list[MeshFile]
    to_cameras: Float64Array
    """Takes the meshes to the frame of the cameras [4, 4]."""
    lamps: dict[str, tuple[float, float, float]]
    """Radiance of meshes by their names, besides that which files give."""
    environment: Path | None = None
    copy: bool = False
    """Copy photographs and meshes instead of linking to them."""

    @property
    def lights(self) -> list[PunctualLight]:
        """Lights without extent of the mesh files, in the frame of the cameras."""
        return [moved_light(light, self.to_cameras) for file in self.meshes for light in file.lights]

    @property
    def sky(self) -> EnvironmentMap | None:
        """The environment of a mesh file, in the frame of the cameras."""
        found = next((file.environment for file in self.meshes if file.environment is not None), None)
        return None if found is None else turned_map(found, self.to_cameras)


def axis(name: str) -> Float64Array:
    """The unit vector of one of :data:`UP`."""
    index = UP[name]
    vector = np.zeros(3)
    vector[index // 2] = -1.0 if index % 2 else 1.0
    return vector


def held_up(views: Sequence[View]) -> str:
    """The axis that cameras hold up on average.

    Raises:
        InputError: there is no such axis.
    """
    mean = np.mean([view.camera.to_world[:3, 1] for view in views], axis=0)
    name = max(UP, key=lambda name: float(axis(name) @ mean))
    if axis(name) @ mean < _TILT * np.linalg.norm(mean) or np.linalg.norm(mean) < 0.1:
        raise InputError(
            f"--up: the cameras hold no axis up (on average {', '.join(f'{x:.2f}' for x in mean)}), so the mesh cannot "
            "be turned to theirs; turn it in the program that it comes from"
        )
    return name


def turned(up: str, to: str, scale: float) -> Float64Array:
    """The similarity that takes an axis to another by the shortest way and scales [4, 4]."""
    a, b = axis(up), axis(to)
    matrix = np.eye(4)
    if a @ b < -0.5:  # straight down: half a turn about an axis beside it
        side = axis("x" if abs(a[0]) < 0.5 else "y")
        matrix[:3, :3] = 2.0 * np.outer(side, side) - np.eye(3)
    elif a @ b < 0.5:
        cross = np.cross(a, b)
        matrix[:3, :3] = np.outer(b, a) - np.outer(a, b) + np.outer(cross, cross)
    matrix[:3, :3] *= scale
    return matrix


def axes(words: str) -> Float64Array:
    """The rotation [4, 4] by which axes of a mesh become those of the cameras.

    Args:
        words: the mesh's axes that become X, Y and Z, such as ``zxy`` or ``x,-z,y``; or the nine numbers of the matrix,
            row by row.

    Raises:
        InputError: they are neither, or no rotation.
    """
    parts = re.sub(r"[\[\],;\s]+", " ", words).split()
    letters = re.findall(r"[-+]?[xyz]", "".join(parts))
    made = np.eye(4)
    if len(letters) == 3 and "".join(letters) == "".join(parts):
        made[:3, :3] = [axis(name.lstrip("+")) for name in letters]
    else:
        try:
            made[:3, :3] = np.array([number(float(x), "--axes: a number", -1.01, 1.01) for x in parts]).reshape(3, 3)
        except ValueError as error:
            raise InputError(
                f"--axes {shown(words)}: it is neither three axes such as zxy or x,-z,y, nor a matrix of nine numbers"
            ) from error
    u, stretch, v = np.linalg.svd(made[:3, :3])
    if np.abs(stretch - 1.0).max() > _ROUNDED or np.linalg.det(made[:3, :3]) < 0:
        why = "it mirrors" if np.linalg.det(made[:3, :3]) < -0.5 else "its rows are not of length 1 and perpendicular"
        raise InputError(f"--axes {shown(words)}: it is no rotation ({why}); --scale is for the size")
    made[:3, :3] = u @ v
    return made


def turned_map(environment: EnvironmentMap, similarity: Float64Array) -> EnvironmentMap:
    """An environment in another frame, to which ``similarity`` takes its own [4, 4]."""
    axes = similarity[:3, :3] / np.linalg.norm(similarity[:3, 0])
    pose = np.array(environment.to_world, np.float64)
    pose[:3, :3] = axes @ pose[:3, :3]
    return replace(environment, to_world=pose.astype(np.float32))


def write_room(room: RoomParts, out: Path) -> list[Mesh]:
    """Write the folder.

    Args:
        room: what it is made of.
        out: a folder that is there and empty.

    Returns:
        The meshes as they are in it, with their names and the radiance of lamps.

    Raises:
        InputError: a name of a lamp is none of a mesh, or the system refused to write.
    """
    meshes = _named_apart(room)
    shining = {mesh.name for mesh in meshes}
    if unknown := [name for name in room.lamps if name not in shining]:
        raise InputError(f"--lamp: there is no mesh {shown(unknown[0])}, there are {listed(sorted(shining))}")
    meshes = [
        replace(mesh, radiance=np.array(room.lamps[mesh.name], np.float32)) if mesh.name in room.lamps else mesh
        for mesh in meshes
    ]
    with writing(out, "--out"):
        write_views(room, out)
        _write_surfaces(room, meshes, out)
    return meshes


def _named_apart(room: RoomParts) -> list[Mesh]:
    """All meshes, no two of one name, and none that ``scene.xml`` cannot have: Mitsuba takes ``$`` for a parameter."""
    taken = {_PAINT}
    plain = re.compile(r"[$\x00-\x1f\x7f]")
    return [
        replace(mesh, name=make_unique(plain.sub("_", mesh.name), taken))
        for file in room.meshes
        for mesh in file.meshes
    ]


def file_name(name: str, taken: set[str]) -> str:
    """A name for a file that XML, shells and other systems take, none of ``taken``, to which it is added."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    stem = re.sub(r"[^A-Za-z0-9_-]+", "_", plain).strip("_")[:60] or "part"
    return make_unique(stem, taken, "_", capitals=False)


def write_views(room: RoomParts, out: Path, only: str | None = None) -> None:
    """Camera files, and what they name.

    Args:
        room: whose views.
        out: the scene folder; files of views that lie in it already stay as they are.
        only: name of the one camera file, in place of those that a fit reads.
    """
    taken: set[str] = set()
    parts = {"": room.views.train}
    if room.views.stated:
        parts = {"_train": room.views.train, "_test": room.views.test}
    for part, views in parts.items():
        if not views:
            continue
        named = [replace(view, name=file_name(view.name, taken)) for view in views]
        described = transforms(named)
        for view, frame in zip(named, described["frames"], strict=True):
            files = {"file_path": ("images", view.image), "mask_path": ("masks", view.mask)}
            files |= {f"{name}_path": (name, view.maps.get(name)) for name in BY_NAME}
            files |= {"spread_path": ("spread", view.spread)}
            for key, (folder, source) in files.items():
                if source is not None:
                    frame[key] = f"{folder}/{view.name}{Path(source).suffix.lower()}"
                    if Path(source) != out / frame[key]:
                        place(Path(source), out / frame[key], room.copy)
            if view.image is None:  # its name stays, for pictures to come
                frame["file_path"] = view.name
        (out / (only or f"transforms{part}.json")).write_text(json.dumps(described, indent=1) + "\n", encoding="utf-8")


def _write_surfaces(room: RoomParts, meshes: Sequence[Mesh], out: Path) -> None:
    """``scene.xml`` and the meshes: one PLY file for each, or a link where the file is one already."""
    tree = ElementTree.Element("scene", version="3.0.0")
    _child(_child(tree, "integrator", type="path"), "integer", name="max_depth", value="-1")
    paint = _child(_child(tree, "bsdf", type="twosided", id=_PAINT), "bsdf", type="principled")
    _child(paint, "rgb", name="base_color", value="0.5")
    _child(paint, "float", name="roughness", value="0.5")
    if room.environment is not None:
        place(room.environment, out / f"environment{room.environment.suffix.lower()}", room.copy)
        sky = _child(tree, "emitter", type="envmap")
        _child(sky, "string", name="filename", value=f"environment{room.environment.suffix.lower()}")
    elif room.sky is not None:
        append_node(tree, environment_node(room.sky, out))
    sources = [file for file in room.meshes for _ in file.meshes]
    known = [_known(file, mesh) for file in room.meshes for mesh in file.meshes]
    taken: set[str] = set()
    step = origin_of(meshes)  # of coordinates that files of float32 cannot hold: it goes into the transform
    pose = room.to_cameras.copy()
    pose[:3, 3] += pose[:3, :3] @ step
    for mesh, source, material in zip(meshes, sources, known, strict=True):
        path = f"meshes/{file_name(mesh.name, taken)}.ply"
        (out / "meshes").mkdir(exist_ok=True)
        if source.linkable and not step.any():
            place(source.path, out / path, room.copy)
        else:
            write_ply(out / path, replace(mesh, vertices=(mesh.vertices - step).astype(np.float32)))
        shape = _child(tree, "shape", type="ply", id=mesh.name)
        _child(shape, "string", name="filename", value=path)
        if mesh.normals is None:  # flat, as the file has it: without this Mitsuba rounds all edges
            _child(shape, "boolean", name="face_normals", value="true")
        if not np.array_equal(pose, np.eye(4)):
            values = " ".join(f"{x:.17g}" for x in pose.ravel())
            _child(_child(shape, "transform", name="to_world"), "matrix", value=values)
        if material is None:
            _child(shape, "ref", id=_PAINT)
        else:
            _add_known(shape, material)
        if mesh.radiance is not None:
            lamp = _child(shape, "emitter", type="area")
            _child(lamp, "rgb", name="radiance", value=", ".join(f"{float(x):.9g}" for x in mesh.radiance))
    names = {mesh.name for mesh in meshes}
    for light in room.lights:
        append_node(tree, punctual_node(light, make_unique(light.name, names)))
    ElementTree.indent(tree)
    text = ElementTree.tostring(tree, encoding="unicode") + "\n"
    (out / "scene.xml").write_text(text, encoding="utf-8")


def _known(file: MeshFile, mesh: Mesh) -> Material | None:
    """The material of a mesh if a fit keeps it and one line says it: smooth ones, and lamps of one colour; of others
    how much of a metal they are, the mean where that varies.
    """
    if not file.materials:
        return None
    material = file.materials[mesh.material]
    plain = all(isinstance(texture, Constant) for texture in material.textures.values())
    if plain and (material.model.is_delta or mesh.radiance is not None):
        return material
    metallic = material.metallic
    if is_dielectric(metallic) or isinstance(metallic, VertexAttribute):
        return None
    value = metallic.value if isinstance(metallic, Constant) else metallic.pixels
    mean = constant(float(value.mean()))
    return Material(material.name, PrincipledModel(), constant(0.5, 3), constant(0.5), metallic=mean)


def _add_known(shape: ElementTree.Element, material: Material) -> None:
    """The BSDF of a material without textures."""
    values = {name: texture.value for name, texture in material.textures.items() if isinstance(texture, Constant)}
    through = material.model.delta is not None and material.model.delta.transmits
    around = shape if through else _child(shape, "bsdf", type="twosided")
    colour, *scalars = ([float(x) for x in values[name]] for name in BY_NAME)
    described = material.model.mitsuba({"value": colour}, *(value for (value,) in scalars))
    bsdf = _child(around, "bsdf", type=described.pop("type"))
    for key, value in described.items():
        if isinstance(value, dict):
            _child(bsdf, "rgb", name=key, value=", ".join(f"{x:.9g}" for x in value["value"]))
        else:
            _child(bsdf, "string" if isinstance(value, str) else "float", name=key, value=str(value))


def _child(parent: ElementTree.Element, tag: str, **attributes: str) -> ElementTree.Element:
    return ElementTree.SubElement(parent, tag, attributes)


def bounds_of(room: RoomParts) -> FloatArray:
    """Smallest and largest corner of the meshes in the frame of the cameras [2, 3]."""
    corners = np.concatenate([mesh.vertices for file in room.meshes for mesh in file.meshes]).astype(np.float64)
    there = corners @ room.to_cameras[:3, :3].T + room.to_cameras[:3, 3]
    box: FloatArray = np.stack((there.min(0), there.max(0)))
    return box
