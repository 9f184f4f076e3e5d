"""The glTF file that a room came from, with what was recovered on its own nodes."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurad.assembly.build import Assembly
from neurad.assembly.relight import recovered_scene
from neurad.core.errors import InputError
from neurad.core.records import Array, FloatArray, IntArray
from neurad.export.copies import Copies, Matcher, Painted, Part, Surface
from neurad.export.gltf import coat, emission
from neurad.export.layouts import Group, Layout, Polygons
from neurad.formats.gltf.file import GltfFile, Json
from neurad.formats.gltf.glb import GlbWriter
from neurad.formats.gltf.nodes import instances_of, nodes_of
from neurad.formats.gltf.read import TRIANGLES, GltfReader

_VERTICES, _SETS = 34962, 8


class GlbRoom:
    """A binary glTF file."""

    def __init__(self, source: Path, group: Group) -> None:
        self.source, self.group = source, group
        self.file = GltfFile(source)
        self.reader = GltfReader(self.file, lamps=False)
        if not self.reader.room().meshes:
            raise self.file.error("it has no triangle")
        self.poses: dict[tuple[int, int], list[tuple[str, Array]]] = {}
        """Name and places [n, 4, 4] of the nodes that show each primitive of each mesh."""
        self.members: list[list[tuple[int, int]]] = []
        self.layouts: Sequence[Layout] = ()
        self.surfaces: list[Surface] = []

    def _primitive(self, key: tuple[int, int]) -> Json:
        found: Json = self.file.json["meshes"][key[0]]["primitives"][key[1]]
        return found

    def _triangles(self, key: tuple[int, int]) -> tuple[FloatArray, IntArray]:
        """Vertices [v, 3] and triangles [t, 3] of a primitive."""
        primitive, where = self._primitive(key), f"mesh {key[0]}"
        places = self.reader.values(primitive["attributes"], "POSITION", where, "VEC3").astype(np.float32)
        return places, self.reader.faces(primitive, primitive.get("mode", TRIANGLES), len(places), where)

    def _uvs(self, key: tuple[int, int]) -> FloatArray | None:
        """The first texture coordinates of a primitive [v, 2]."""
        attributes = self._primitive(key)["attributes"]
        if "TEXCOORD_0" not in attributes:
            return None
        return self.reader.values(attributes, "TEXCOORD_0", f"mesh {key[0]}", "VEC2").astype(np.float32)

    def parts(self) -> list[list[Polygons]]:
        """Parts of its meshes, those together that share a texture."""
        groups: dict[Any, list[tuple[Polygons, tuple[int, int]]]] = {}
        for node in nodes_of(self.file):
            if "mesh" not in node.item:
                continue
            poses = instances_of(self.file, node)[1]()
            number = int(node.item["mesh"])
            for index, primitive in enumerate(self.file.item("meshes", number, node.name)["primitives"]):
                if primitive.get("mode", TRIANGLES) < TRIANGLES:
                    continue
                self.poses.setdefault((number, index), []).append((node.name, poses))
        for key, places in self.poses.items():
            vertices, faces = self._triangles(key)
            scale = max(float(np.abs(np.linalg.det(poses[:, :3, :3])).max()) for _, poses in places) ** (1.0 / 3.0)
            material, uvs = self._primitive(key).get("material"), self._uvs(key)
            of = material if self.group == "material" and material is not None else key
            corners = np.arange(3 * len(faces)).reshape(-1, 3)
            part = Polygons(
                vertices[faces.ravel()] * np.float32(scale), corners, np.arange(len(faces)),
                None if uvs is None else uvs[faces.ravel()],
            )  # fmt: skip
            groups.setdefault(of, []).append((part, key))
        self.members = [[key for _, key in group] for group in groups.values()]
        return [[part for part, _ in group] for group in groups.values()]

    def opened(self, layouts: Sequence[Layout], match: Matcher, origin: Array) -> tuple[list[Surface], list[str]]:
        """As :meth:`neurad.export.into_blend.BlendRoom.opened`."""
        self.layouts = layouts
        thing = 0
        for index, (layout, members) in enumerate(zip(layouts, self.members, strict=True)):
            found: list[Part] = []
            names: dict[str, None] = {}
            for number, key in enumerate(members):
                vertices, faces = self._triangles(key)
                uvs: FloatArray | None = None
                if layout.uvs:
                    second, first = layout.uvs[number], self._uvs(key)
                    uvs = second.reshape(-1, 3, 2) if second is not None else None if first is None else first[faces]
                for name, poses in self.poses[key]:
                    names[name] = None
                    for pose in poses:
                        found.append(match.part(vertices[faces], uvs, pose, origin, thing))
                        thing += 1
            layout_of = None if layout.side == 0 else index
            self.surfaces.append(Surface(", ".join([*names][:3]), layout_of, Copies.joined(found)))
        return self.surfaces, []

    def write(self, painted: Sequence[Painted | None], assembly: Assembly, part: Path) -> list[str]:
        """Write the file; returns sentences about what it cannot hold."""
        beside = part.with_name(f"{part.name}.bin")
        try:
            with beside.open("wb") as buffer:
                glb = GlbWriter(buffer, copy.deepcopy(self.file.json))
                self._take_over(glb)
                for layout, members, paint in zip(self.layouts, self.members, painted, strict=True):
                    if paint is not None:
                        self._put(glb, layout, members, paint)
                self._shine(glb, painted, assembly)
            glb.finish(part, beside)
        finally:
            beside.unlink(missing_ok=True)
        if assembly.environment is None:
            return []
        return ["glTF has no world: the environment that was recovered is in environment.exr of an export to a folder"]

    def _take_over(self, glb: GlbWriter) -> None:
        """The buffers of the file, as one."""
        begins = [glb.append(self.file.buffer(i, "it")) for i, _ in enumerate(glb.json.get("buffers", ()))]
        for view in glb.json["bufferViews"]:
            if "extensions" in view:
                raise InputError(f"--into {self.source}: it is compressed; save it without compression")
            view["byteOffset"] = view.get("byteOffset", 0) + begins[view["buffer"]]
            view["buffer"] = 0

    def _put(self, glb: GlbWriter, layout: Layout, members: Sequence[tuple[int, int]], paint: Painted) -> None:
        """Coordinates and material of everything that a texture is on."""
        primitives = [glb.json["meshes"][mesh]["primitives"][index] for mesh, index in members]
        placed = [] if all(uvs is None for uvs in layout.uvs) else layout.uvs
        free = 0
        if placed:
            free = next(i for i in range(_SETS) if not any(f"TEXCOORD_{i}" in p["attributes"] for p in primitives))
        old = primitives[0].get("material")
        before = glb.json["materials"][old] if old is not None else {}
        material = glb.add("materials", _material(glb, before, paint, free))
        for primitive, key, uvs in zip(primitives, members, placed, strict=bool(placed)):
            assert uvs is not None
            self._split(glb, primitive, key, uvs, free)
        for primitive in primitives:
            primitive["material"] = material

    def _split(self, glb: GlbWriter, primitive: Json, key: tuple[int, int], uvs: FloatArray, free: int) -> None:
        """A primitive with coordinates of its corners [3 t, 2]: vertices of several become as many."""
        faces = self._triangles(key)[1].reshape(-1, 1)
        rows = np.concatenate((faces, (uvs + np.float32(0.0)).view(np.int32)), 1)
        _, first, same = np.unique(rows, axis=0, return_index=True, return_inverse=True)
        take = faces[first, 0]
        for attributes in (primitive["attributes"], *primitive.get("targets", ())):
            for name, accessor in attributes.items():
                attributes[name] = self._taken(glb, accessor, take)
        coordinates = glb.vertices(uvs[first])
        for number in range(free + 1):  # sets are numbered without gaps
            primitive["attributes"].setdefault(f"TEXCOORD_{number}", coordinates)
        primitive["indices"] = glb.triangles(same.reshape(-1, 3), len(take))
        primitive.pop("mode", None)
        primitive.get("extensions", {}).pop("KHR_draco_mesh_compression", None)  # the same without the coordinates

    def _taken(self, glb: GlbWriter, accessor: int, take: IntArray) -> int:
        """An accessor with some of its values, bit by bit."""
        item, values = self.file.stored(accessor, "a mesh", "SCALAR", "VEC2", "VEC3", "VEC4")
        chosen = np.ascontiguousarray(values[take])
        row = chosen.dtype.itemsize * chosen.shape[1]
        padded = np.zeros((len(take), row + -row % 4), np.uint8)
        padded[:, :row] = chosen.view(np.uint8).reshape(len(take), row)
        view = glb.view(padded.tobytes(), _VERTICES)
        glb.json["bufferViews"][view]["byteStride"] = padded.shape[1]
        kept: Json = {key: item[key] for key in ("componentType", "normalized", "type", "name") if key in item}
        if "min" in item and "max" in item:
            kept |= {"min": chosen.min(0).tolist(), "max": chosen.max(0).tolist()}
        return glb.add("accessors", {**kept, "bufferView": view, "count": len(take)})

    def _shine(self, glb: GlbWriter, painted: Sequence[Painted | None], assembly: Assembly) -> None:
        """Lamps as a fit found them, where it did: a material for each, as several may have had one."""
        if assembly.lamps is None:
            return
        geometry = assembly.world.geometry
        area, shown = geometry.face_area.numpy(), recovered_scene(assembly).radiance[geometry.mesh_index.numpy()]
        for surface, members, paint in zip(self.surfaces, self.members, painted, strict=True):
            prims, number = surface.copies.prims, self._primitive(members[0]).get("material")
            if paint is not None or number is None or len(prims) == 0:
                continue
            radiance = np.average(shown[prims], axis=0, weights=area[prims]).astype(np.float32)
            material = copy.deepcopy(glb.json["materials"][number])
            if radiance.max() > 0 and "emissiveTexture" not in material:
                factor, strength = emission(radiance)
                material["emissiveFactor"] = factor
                material.setdefault("extensions", {})["KHR_materials_emissive_strength"] = strength
                glb.extensions.add("KHR_materials_emissive_strength")
                new = glb.add("materials", material)
                for mesh, index in members:
                    glb.json["meshes"][mesh]["primitives"][index]["material"] = new


def _material(glb: GlbWriter, before: Json, paint: Painted, uv_set: int) -> Json:
    """The material of a texture, in place of the one that was there."""
    name = f"{before.get('name', 'surface')} recovered"
    files = paint.files()
    surface: Json
    if files is None:
        colour, roughness, metallic = paint.values()
        surface = {"baseColorFactor": [*colour, 1.0], "roughnessFactor": roughness, "metallicFactor": metallic}
    else:
        surface = {
            "baseColorTexture": glb.texture(files.base, f"{name} base color") | {"texCoord": uv_set},
            "metallicRoughnessTexture": glb.texture(files.orm, f"{name} orm") | {"texCoord": uv_set},
        }
    made: Json = {"name": name, "pbrMetallicRoughness": surface}
    if paint.material.two_sided:
        made["doubleSided"] = True
    if (lit := paint.emission()) is not None:
        made["emissiveTexture"] = glb.texture(lit[0], f"{name} emission") | {"texCoord": uv_set}
        made["emissiveFactor"] = [1.0, 1.0, 1.0]
        made["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": lit[1]}}
    if extensions := coat(paint.material.model):
        made["extensions"] = made.get("extensions", {}) | extensions
    glb.extensions |= made.get("extensions", {}).keys()
    return made
