"""glTF 2.0 scenes: ``scene.glb`` and ``scene.gltf`` with the environment map beside them, and rooms of any file."""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError, Refusals
from neurad.core.names import make_unique
from neurad.core.records import Array, IntArray
from neurad.core.scene_records import Bitmap, EnvironmentMap, Mesh, PunctualLight, View
from neurad.formats.cameras.intrinsics import SceneCamera
from neurad.formats.gltf.file import GltfFile, Json
from neurad.formats.gltf.lamps import backs_of, lit_by
from neurad.formats.gltf.materials import COLOUR, Corners, Emission, MaterialReader
from neurad.formats.gltf.nodes import Node, camera_of, instances_of, is_own, light_of, nodes_of
from neurad.formats.gltf.textures import LEVELS
from neurad.formats.meshes.triangles import MeshFile, in_world
from neurad.images.lat_long import read_map
from neurad.runtime.memory import reserve
from neurad.runtime.numbers import LENGTH, RADIANCE, TEXEL, number, within
from neurad.runtime.reading import exists, listed, shown
from neurad.scene.description import Scene
from neurad.scene.panes import closed_made_solid
from neurad.scene.polygons import check_triangle_count

ENDINGS = (".glb", ".gltf")
ENVIRONMENT = "environment.exr"
"""Map beside a scene file of glTF that lights it, +Y up."""
_UNLIMITED, _RR_DEPTH = 2**31 - 1, 5
TRIANGLES, _STRIP, _FAN = 4, 5, 6
_SETS = 8  # sets of texture coordinates that are looked for


def read_gltf(path: str | Path, lamps: bool = True) -> MeshFile:
    """Meshes, materials, cameras and lights of a file, in the frame of its scene; surfaces shine where ``lamps``. There
    is a mesh for each primitive of each node that shows it, and more where it shines unevenly.

    Raises:
        InputError: a file is missing or broken, or the scene uses what neurad cannot render; a sentence says what.
    """
    file = GltfFile(path)
    room = GltfReader(file, lamps).room()
    if not room.meshes:
        raise file.error("it has no triangle")
    return room


def read_scene(path: str | Path) -> Scene:
    """The scene of a file, lit also by :data:`ENVIRONMENT` beside it; its cameras are held-out, without pictures."""
    path = Path(path)
    room = read_gltf(path)
    environment, to_world = None, room.own.get("environment_to_world")
    if exists(path.parent / ENVIRONMENT):
        pose = np.eye(4, dtype=np.float32)
        if to_world is not None:
            where = f"{shown(path)}: environment_to_world"
            if not isinstance(to_world, list) or len(to_world) != 9:
                raise InputError(f"{where} is not 9 numbers")
            pose[:3, :3] = np.reshape([number(x, where, -1.0 - 1e-6, 1.0 + 1e-6) for x in to_world], (3, 3))
        environment = EnvironmentMap(read_map(path.parent / ENVIRONMENT), pose)
    depths = [room.own.get(key, default) for key, default in (("max_depth", _UNLIMITED), ("rr_depth", _RR_DEPTH))]
    max_depth, rr_depth = (x if type(x) is int and 1 <= x <= _UNLIMITED else _UNLIMITED for x in depths)
    views = [View(camera.names[0], camera.seen(*camera.film)) for camera in room.cameras]
    limits: Any = {"max_depth": max_depth, "rr_depth": rr_depth}
    return Scene(
        path.stem,
        room.meshes,
        list(room.materials),
        environment,
        test=_named_apart(views),
        notes=room.notes,
        punctual=room.lights,
        **limits,
    )


def _named_apart(views: list[View]) -> list[View]:
    """Views whose names serve as those of files; numbers where they do not."""
    names = [view.name for view in views]
    if len(set(names)) == len(names) and all(name.isprintable() and not set(name) & set("/\\:") for name in names):
        return views
    return [replace(view, name=f"{index:04d}") for index, view in enumerate(views)]


class GltfReader:
    """A file on its way to a room."""

    def __init__(self, file: GltfFile, lamps: bool) -> None:
        self.file = file
        self.lamps = lamps
        self.materials = MaterialReader(file, is_own(file))
        self.notes: dict[str, None] = {}
        self.names: set[str] = set()
        self.refusals = Refusals()

    def room(self) -> MeshFile:
        """Everything in the file."""
        meshes: list[Mesh] = []
        cameras: list[SceneCamera] = []
        lights: list[PunctualLight] = []
        nodes: list[Node] = []
        flat: list[str] = []
        with self.refusals.part():
            nodes.extend(nodes_of(self.file))  # those before one that is refused as well
        check_triangle_count(sum(map(self._triangles, nodes)), shown(self.file.path))
        for node in nodes:
            if "mesh" in node.item:
                with self.refusals.part():
                    meshes += self._meshes(node)
            if "camera" in node.item:
                with self.refusals.part():
                    if (camera := camera_of(self.file, node)) is not None:
                        cameras.append(camera)
                    else:
                        flat.append(node.name)
            with self.refusals.part():
                if (light := light_of(self.file, node)) is not None:
                    lights.append(light)
        self.refusals.end()
        if flat:
            self._note(f"orthographic cameras are left out: {listed(flat)}")
        if (unread := self.file.unread()) is not None:
            self._note(unread)
        if self.file.array(self.file.json, "animations", "it"):
            self._note("it is animated: everything stands as it does without the animation")
        extras = self.file.object(self.file.json, "asset", "it").get("extras") if is_own(self.file) else None
        own = extras if isinstance(extras, dict) else {}
        if own.get("base_color_for") in ("blender", "gltf"):
            self._note(
                f"its base colours were changed for {own['base_color_for']} and are some percent off neurad's; "
                "export with --for exact, or keep scene.xml"
            )
        meshes, materials = closed_made_solid(meshes, self.materials.materials)
        return MeshFile(
            self.file.path, meshes, tuple(materials), tuple(self.notes), tuple(lights), tuple(cameras), own=own
        )

    def _note(self, said: str) -> None:
        self.notes[f"{shown(self.file.path)}: {said}"] = None

    def _triangles(self, node: Node) -> int:
        """How many a node will have, at most; 0 of what cannot be read."""
        if "mesh" not in node.item:
            return 0
        count = 0
        with suppress(InputError):
            for primitive in self.file.array(self.file.item("meshes", node.item["mesh"], ""), "primitives", ""):
                mode = primitive.get("mode", TRIANGLES) if isinstance(primitive, dict) else None
                if mode in (TRIANGLES, _STRIP, _FAN):
                    of_places = self.file.object(primitive, "attributes", "").get("POSITION")
                    corners = self.file.item("accessors", primitive.get("indices", of_places), "")
                    count += self.file.count(corners, "count", None, "") // (3 if mode == TRIANGLES else 1)
            return count * instances_of(self.file, node)[0]
        return 0

    def _meshes(self, node: Node) -> Iterator[Mesh]:
        """The meshes of a node, one for each primitive that has triangles and each place where it stands."""
        about = f"node {shown(node.name)}"
        item = self.file.item("meshes", node.item["mesh"], about)
        if "skin" in node.item:
            raise self.file.error(f"{about} has a skin, which is not supported; apply its pose to the mesh")
        weights = node.item.get("weights", item.get("weights", []))
        if not isinstance(weights, list) or any(weight != 0 for weight in weights):
            raise self.file.error(f"{about} has a mesh that is morphed, which is not supported; apply its shape keys")
        poses = instances_of(self.file, node)[1]()
        there = poses[:, :3, :3].any((1, 2))
        if not there.all():
            whole = "" if len(poses) == 1 else f" in {len(poses) - there.sum()} of {len(poses)} instances, which are"
            self._note(f"{about} has a scale of 0{whole or ' and is'} left out")
        poses = poses[there]
        if len(poses) == 0:
            return
        linear = poses[:, :3, :3]
        if (np.abs(np.linalg.det(linear)) <= 1e-12 * np.linalg.norm(linear, axis=1).prod(-1)).any():
            raise self.file.error(f"{about}: its transform flattens its mesh (it cannot be inverted)")
        primitives = self.file.array(item, "primitives", about)
        for index, primitive in enumerate(primitives):
            if not isinstance(primitive, dict):
                raise self.file.error(f"{about}: primitive {index} is not an object")
            name = node.name if "name" in node.item else self.file.name(item, node.name)
            with self.refusals.part():
                yield from self._primitive(poses, primitive, name if len(primitives) == 1 else f"{name} {index + 1}")

    def _primitive(self, poses: Array, primitive: Json, name: str) -> Iterator[Mesh]:
        where = f"mesh {shown(name)}"
        mode = self.file.count(primitive, "mode", TRIANGLES, where)
        if mode not in (TRIANGLES, _STRIP, _FAN):
            if mode > _FAN:
                raise self.file.error(f"{where} has the mode {mode}, which is not known")
            self._note(f"{where} is of points or lines, which have no surface, and is left out")
            return
        attributes = self.file.object(primitive, "attributes", where)
        if "POSITION" not in attributes:
            raise self.file.error(f"{where} has no POSITION")
        if "bufferView" not in self.file.item("accessors", attributes["POSITION"], where):
            self.file.check_uncompressed(primitive, where)
        places = self.values(attributes, "POSITION", where, "VEC3")
        faces = self.faces(primitive, mode, len(places), where)
        if len(faces) == 0:
            self._note(f"{where} has no triangle and is left out")
            return
        made = len(poses) * len(faces)
        reserve(f"{shown(self.file.path)}: {where}", 200 * made, 120 * made)
        yield from self._parts(poses, primitive, attributes, name, places, faces)

    def values(self, attributes: Json, key: str, where: str, *kinds: str) -> Array:
        """An attribute of a primitive's vertices [v, width]."""
        return self.file.accessor(attributes[key], f"{where}: {key}", *kinds)

    def faces(self, primitive: Json, mode: int, count: int, where: str) -> IntArray:
        """The triangles of a primitive by the numbers of their vertices [f, 3]."""
        if "indices" in primitive:
            order = self.values(primitive, "indices", where, "SCALAR")[:, 0]
            if order.dtype != np.int64:
                raise self.file.error(f"{where}: its indices are not whole numbers")
            if order.min() < 0 or order.max() >= count:
                raise self.file.error(f"{where}: an index names vertex {order.max()}, of {count} (numbered from 0)")
        else:
            order = np.arange(count, dtype=np.int64)
        if mode == TRIANGLES:
            if len(order) % 3:
                raise self.file.error(f"{where} has {len(order)} corners, which are no whole number of triangles")
            return np.ascontiguousarray(order.reshape(-1, 3))
        first = np.arange(max(len(order) - 2, 0), dtype=np.int64)
        odd = first % 2
        corners = (first, first + 1 + odd, first + 2 - odd) if mode == _STRIP else (first + 1, first + 2, 0 * first)
        faces: IntArray = order[np.stack(corners, -1)]
        joined = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 0] == faces[:, 2])
        return faces[~joined] if mode == _STRIP else faces  # strips are joined by triangles without area

    def _parts(
        self, poses: Array, primitive: Json, attributes: Json, name: str, places: Array, faces: IntArray
    ) -> Iterator[Mesh]:
        """The meshes of a primitive in world space, one a pose, or their parts where they shine unevenly."""
        where = f"mesh {shown(name)}"
        used: Any = np.zeros(len(places), bool)
        used[faces] = True
        if used.all():
            used = slice(None)
        else:
            faces = (np.cumsum(used) - 1)[faces]
        corners = self._corners(attributes, len(places), used, where)
        normals = None
        if "NORMAL" in attributes:
            normals = self._of_vertices(attributes, "NORMAL", len(places), used, where, "VEC3")
        index = primitive.get("material")
        painted = self.materials.paint(index, corners, where)
        emission = self.materials.emission(index, where) if self.lamps else None
        reason = self.materials.materials[painted.material].model.unsupported
        if emission is not None and reason:
            raise InputError(f"{reason}; it emits light, and what a lamp reflects has to be known")
        uvs = None if painted.uv_set is None else corners.uvs[painted.uv_set]
        if uvs is None and corners.uvs:
            uvs = corners.uvs[min(corners.uvs)]
        plain = Mesh(
            name, places, faces, painted.material, None, uvs if uvs is None or np.isfinite(uvs).all() else None,
            {} if painted.colours is None else {COLOUR: painted.colours},
            None if emission is None else emission.radiance,
        )  # fmt: skip
        for count, pose in enumerate(poses, 1):
            vertices, turned, wound = in_world(pose, places[used], normals, faces)
            within(vertices, f"{shown(self.file.path)}: the coordinates of {where}", -LENGTH, LENGTH)
            made = make_unique(name if len(poses) == 1 else f"{name} {count}", self.names)
            mesh = replace(plain, name=made, vertices=vertices, faces=wound, normals=turned)
            yield from [mesh] if emission is None else self._lamp(mesh, emission, corners, where)

    def _corners(self, attributes: Json, count: int, used: Any, where: str) -> Corners:
        """Texture coordinates and colours of the vertices that are used."""
        uvs: dict[int, Array] = {}
        for uv_set in range(_SETS):
            if (key := f"TEXCOORD_{uv_set}") in attributes:
                uvs[uv_set] = self._of_vertices(attributes, key, count, used, where, "VEC2").astype(np.float32)
        colours = None
        if "COLOR_0" in attributes:
            colours = self._of_vertices(attributes, "COLOR_0", count, used, where, "VEC3", "VEC4").astype(np.float32)
            within(colours, f"{shown(self.file.path)}: {where}: COLOR_0", -TEXEL, TEXEL)
        return Corners(uvs, colours)

    def _of_vertices(self, attributes: Json, key: str, count: int, used: Any, where: str, *kinds: str) -> Array:
        """An attribute of the vertices that are used, of ``count`` in all."""
        values = self.values(attributes, key, where, *kinds)
        if len(values) != count:
            raise self.file.error(f"{where}: {key} has {len(values)} values, but there are {count} vertices")
        kept: Array = values[used]
        return kept

    def _lamp(self, mesh: Mesh, emission: Emission, corners: Corners, where: str) -> Iterator[Mesh]:
        """The parts of a surface that emits light."""
        assert mesh.radiance is not None
        within(mesh.radiance, f"{shown(self.file.path)}: the radiance of {where}", 0.0, RADIANCE)
        lit = [mesh]
        if emission.place is not None:
            uvs = corners.of(self.file, emission.place.uv_set, where)
            picture, matrix = self.materials.textures.continued(emission.place, uvs, where)
            glow = Bitmap(LEVELS[picture[..., :3]], matrix)
            lit = lit_by(glow, mesh, uvs, self.names, where, self._note)
        yield from lit
        if emission.both_sides and (sheets := backs_of(mesh, lit, self.names)):
            self._note(
                f"{where} is doubleSided and shines from both sides, as two sheets; where it should shine to the front "
                "alone, take that off its material (Backface Culling in Blender)"
            )
            yield from sheets
