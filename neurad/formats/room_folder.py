"""A scene folder of views and meshes that come from elsewhere: links to photographs, one camera file, ``scene.xml``."""

import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Float64Array, FloatArray
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material, Mesh, PunctualLight, VertexAttribute, constant
from neurad.formats.cameras.nerf import Split
from neurad.formats.cameras.write import write_cameras
from neurad.formats.meshes.ply import write_ply
from neurad.formats.meshes.triangles import MeshFile
from neurad.formats.mitsuba.write import (
    Matrix,
    Node,
    Pictures,
    bsdf_node,
    environment_node,
    punctual_node,
    shape_node,
    write_xml,
)
from neurad.runtime.files import place, writing
from neurad.runtime.reading import listed, shown
from neurad.scene.description import is_dielectric
from neurad.scene.origin import origin_of
from neurad.scene.punctual import moved_light

_PAINT = "paint"
"""Id of the material that is to be recovered."""


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


def turned_map(environment: EnvironmentMap, similarity: Float64Array) -> EnvironmentMap:
    """An environment in another frame, to which ``similarity`` takes its own [4, 4]."""
    axes = similarity[:3, :3] / np.linalg.norm(similarity[:3, 0])
    pose = np.array(environment.to_world, np.float64)
    pose[:3, :3] = axes @ pose[:3, :3]
    return replace(environment, to_world=pose.astype(np.float32))


def write_room(room: RoomParts, out: Path) -> list[Mesh]:
    """Write the files of a room into an empty folder.

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
        write_views(room.views, out, room.copy)
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


def write_views(views: Split, out: Path, copy: bool, only: str | None = None) -> None:
    """Camera files, and what they name.

    Args:
        out: the scene folder; files of views that lie in it already stay as they are.
        copy: copy files instead of linking to them.
        only: name of the one camera file, in place of those that a fit reads.
    """
    taken: set[str] = set()
    parts = {"_train": views.train, "_test": views.test} if views.stated else {"": views.train}
    for part, of_part in parts.items():
        named = [replace(view, name=file_name(view.name, taken)) for view in of_part]
        if named:
            write_cameras(out / (only or f"transforms{part}.json"), named, copy, diffuse=views.diffuse)


def _write_surfaces(room: RoomParts, meshes: Sequence[Mesh], out: Path) -> None:
    """``scene.xml`` and the meshes: one PLY file for each, or a link where the file is one already."""
    paint: Node = {"type": "principled", "base_color": {"type": "rgb", "value": [0.5, 0.5, 0.5]}, "roughness": 0.5}
    tree: Node = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": -1},
        "paint": {"type": "twosided", "id": _PAINT, "bsdf": paint},
    }
    if room.environment is not None:
        name = f"environment{room.environment.suffix.lower()}"
        place(room.environment, out / name, room.copy)
        tree["environment"] = {"type": "envmap", "filename": name}
    elif room.sky is not None:
        tree["environment"] = environment_node(room.sky, out)
    sources = [file for file in room.meshes for _ in file.meshes]
    known = [_known(file, mesh) for file in room.meshes for mesh in file.meshes]
    taken, pictures = set[str](), Pictures(out, half=True)
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
        bsdf = {"type": "ref", "id": _PAINT} if material is None else bsdf_node(material, mesh.name, pictures)
        tree[path] = shape_node(mesh, mesh.name, path, bsdf)
        if not np.array_equal(pose, np.eye(4)):
            tree[path]["to_world"] = Matrix(pose)
    names = {mesh.name for mesh in meshes}
    for light in room.lights:
        name = make_unique(light.name, names)
        tree[f"light {name}"] = punctual_node(light, name)
    write_xml(tree, out / "scene.xml")


def _known(file: MeshFile, mesh: Mesh) -> Material | None:
    """The material of a mesh if a fit keeps it and one line says it: smooth ones, and lamps of one colour; of others
    how much of a metal they are, the mean where that varies.
    """
    if not file.materials:
        return None
    material = file.materials[mesh.material]
    plain = all(isinstance(texture, Constant) for texture in material.textures.values())
    if plain and (material.model.is_delta or mesh.radiance is not None):
        return replace(material, two_sided=True)
    metallic = material.metallic
    if is_dielectric(metallic) or isinstance(metallic, VertexAttribute):
        return None
    value = metallic.value if isinstance(metallic, Constant) else metallic.pixels
    mean = constant(float(value.mean()))
    return Material(material.name, PrincipledModel(), constant(0.5, 3), constant(0.5), metallic=mean)


def bounds_of(room: RoomParts) -> FloatArray:
    """Smallest and largest corner of the meshes in the frame of the cameras [2, 3]."""
    corners = np.concatenate([mesh.vertices for file in room.meshes for mesh in file.meshes]).astype(np.float64)
    there = corners @ room.to_cameras[:3, :3].T + room.to_cameras[:3, 3]
    box: FloatArray = np.stack((there.min(0), there.max(0)))
    return box
