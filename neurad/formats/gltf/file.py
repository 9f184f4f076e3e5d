"""Files of glTF 2.0, ``.glb`` or ``.gltf`` with what lies beside it: their JSON and the numbers in their buffers.

The reader is our own: pygltflib binds the JSON alone, and trimesh drops sparse values, all UV sets but the first,
texture transforms, wrap modes and every extension that lamps and glass need.
"""

import base64
import math
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array
from neurad.runtime.memory import reserve
from neurad.runtime.numbers import number
from neurad.runtime.reading import exists, listed, parse_json, read_bytes, shown

Json = dict[str, Any]

READ = frozenset({
    "KHR_texture_transform", "KHR_mesh_quantization", "KHR_materials_emissive_strength", "KHR_materials_ior",
    "KHR_materials_transmission", "KHR_materials_specular", "KHR_materials_volume", "KHR_materials_clearcoat",
    "KHR_materials_sheen", "KHR_materials_iridescence", "KHR_materials_anisotropy", "KHR_materials_dispersion",
    "KHR_materials_diffuse_transmission", "KHR_materials_unlit", "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_variants", "KHR_lights_punctual", "KHR_node_visibility", "KHR_xmp_json_ld", "EXT_texture_webp",
    "EXT_mesh_gpu_instancing",
})  # fmt: skip
"""Extensions that a file may require: they are read, or refused where they change geometry or light."""
_COMPRESSED = frozenset({
    "KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_texture_basisu",
    "EXT_texture_avif", "MSFT_texture_dds",
})  # fmt: skip
"""Other forms of what a file that does not require them has uncompressed, too."""
_HARMLESS = frozenset({
    "KHR_animation_pointer", "KHR_audio_emitter", "KHR_collision_shapes", "KHR_implicit_shapes", "KHR_interactivity",
    "KHR_node_hoverability", "KHR_node_selectability", "KHR_physics_rigid_bodies", "KHR_xmp", "EXT_feature_metadata",
    "EXT_instance_features", "EXT_mesh_features", "EXT_mesh_manifold", "EXT_structural_metadata",
    "AGI_articulations", "AGI_stk_metadata", "CESIUM_primitive_outline", "FB_geometry_metadata", "GRIFFEL_bim_data",
    "MSFT_audio_emitter", "MSFT_lod", "MSFT_packing_normalRoughnessMetallic", "MSFT_packing_occlusionRoughnessMetallic",
    "OMI_audio_emitter", "OMI_collider", "OMI_physics_body", "OMI_physics_gravity", "OMI_physics_joint",
    "OMI_physics_shape", "OMI_seat", "OMI_spawn_point", "VRM", "VRMC_node_constraint", "VRMC_springBone", "VRMC_vrm",
})  # fmt: skip
"""Extensions that change neither the surfaces of a scene at rest nor its light."""
_UNDO = "undo it with `gltf-transform copy IN.glb OUT.glb`, or import it into Blender and export it without compression"
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_MAGIC, _JSON, _BIN = b"glTF", b"JSON", b"BIN\0"
_MAX_VALUES = 1 << 31  # values of an accessor


class GltfFile:
    """A file whose JSON has been read; buffers are read when they are needed, each once.

    Raises:
        InputError: it is missing, broken, of another version, or requires an extension that is not read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        data = read_bytes(self.path, missing="there is no such glTF file")
        self._binary: bytes | None = None
        if data[:4] != _MAGIC and self.path.suffix.lower() == ".glb":
            raise self.error(
                "it does not begin as a binary glTF file does; export it again, or name it .gltf if it is JSON"
            )
        text = self._chunks(data) if data[:4] == _MAGIC else data
        try:
            document = parse_json(text.decode("utf-8-sig"), self.path)
        except UnicodeDecodeError as error:
            raise InputError(f"{shown(self.path)}: it is neither a binary glTF file nor JSON in UTF-8") from error
        if not isinstance(document, dict):
            raise InputError(f"{shown(self.path)}: it is not a glTF file: its JSON is no object")
        self.json: Json = document
        self._buffers: dict[int, bytes] = {}
        self._check()

    # ---- the container

    def _chunks(self, data: bytes) -> bytes:
        """The JSON of a binary file; its buffer is kept."""
        if len(data) < 12:
            raise self.error("it ends within the header of a binary glTF file")
        _, version, length = struct.unpack("<4sII", data[:12])
        if version != 2:
            raise self.error(f"it is binary glTF of version {version}; only 2 is read, export it again")
        if length > len(data):
            raise self.error(f"it ends after {len(data)} of the {length} bytes that it announces")
        text, place = None, 12
        while place + 8 <= length:
            size, kind = struct.unpack("<I4s", data[place : place + 8])
            chunk = data[place + 8 : place + 8 + size]
            if len(chunk) < size:
                raise self.error("it ends within a chunk")
            if text is None and kind != _JSON:
                raise self.error("its first chunk is not JSON")
            if text is None:
                text = chunk
            elif kind == _BIN and self._binary is None:
                self._binary = chunk
            place += 8 + size
        if text is None:
            raise self.error("it has no JSON")
        return text

    def _check(self) -> None:
        """The version, and what is required."""
        asset = self.object(self.json, "asset", "it")
        version, least = asset.get("version"), asset.get("minVersion", "2.0")
        if not isinstance(version, str) or not version.startswith("2."):
            raise self.error(f"it is glTF of version {shown(version)}; only 2.0 is read, export it again")
        if least != "2.0":
            raise self.error(f"it needs a reader of glTF {shown(least)}; only 2.0 is read")
        required = [name for name in self._extensions("extensionsRequired") if name not in READ]
        compressed = [name for name in required if name in _COMPRESSED]
        others = [name for name in required if name not in _COMPRESSED]
        said = [f"it is compressed by {' and '.join(compressed)}, which is not read; {_UNDO}"] if compressed else []
        if others:
            what, verb = ("the extension", "is") if len(others) == 1 else ("extensions", "are")
            said.append(f"it requires {what} {', '.join(map(shown, others))}, which {verb} not read")
        if said:
            raise self.error("; and ".join(said))

    def _extensions(self, key: str) -> list[str]:
        return list(dict.fromkeys(str(name) for name in self.array(self.json, key, "it")))

    def unread(self) -> str | None:
        """What is to be said of extensions that the file uses and that are not read; None where none matters."""
        known = READ | _COMPRESSED | _HARMLESS
        found = [name for name in self._extensions("extensionsUsed") if name not in known]
        if not found:
            return None
        they = "it is" if len(found) == 1 else "they are"
        return f"what it says by {listed(found)} is missing here: {they} not read"

    def check_uncompressed(self, item: Json, where: str) -> None:
        """Check that what an item may have in a compressed form is there without compression, too."""
        found = next((name for name in self.object(item, "extensions", where) if name in _COMPRESSED), None)
        if found is not None:
            raise self.error(f"{where} is compressed by {found}, which is not read; {_UNDO}")

    def error(self, said: str) -> InputError:
        """A sentence about the file."""
        return InputError(f"{shown(self.path)}: {said}")

    # ---- the JSON: values of the type that they have to have

    def object(self, parent: Json, key: str, where: str) -> Json:
        """The object under a key; empty where there is none."""
        found = parent.get(key, {})
        if not isinstance(found, dict):
            raise self.error(f"{where}: {key} is {shown(repr(found))}, not an object")
        return found

    def extension(self, parent: Json, name: str, where: str) -> Json | None:
        """An extension of an item, or None."""
        extensions = self.object(parent, "extensions", where)
        return self.object(extensions, name, where) if name in extensions else None

    def array(self, parent: Json, key: str, where: str) -> list[Any]:
        """The list under a key; empty where there is none."""
        found = parent.get(key, [])
        if not isinstance(found, list):
            raise self.error(f"{where}: {key} is {shown(repr(found))}, not a list")
        return found

    def name(self, item: Json, default: str) -> str:
        """The name of an item."""
        found = item.get("name")
        return found if isinstance(found, str) and found else default

    def item(self, kind: str, index: Any, where: str, parent: Json | None = None) -> Json:
        """The item of a list of the file, or of a part of it, that something refers to."""
        items = self.array(self.json if parent is None else parent, kind, "it")
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
            raise self.error(f"{where} names number {shown(repr(index))} of {kind}, of which there are {len(items)}")
        if not isinstance(items[index], dict):
            raise self.error(f"number {index} of {kind} is not an object")
        found: Json = items[index]
        return found

    def number(self, item: Json, key: str, default: float, where: str, low: float, high: float) -> float:
        """The number under a key."""
        return number(item.get(key, default), f"{shown(self.path)}: {where}: {key}", low, high)

    def count(self, item: Json, key: str, default: int | None, where: str) -> int:
        """The whole number under a key, not below 0; None as default where it has to be there."""
        value = item.get(key, default)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _MAX_VALUES * 2:
            raise self.error(f"{where}: {key} is {shown(repr(value))}, not a whole number from 0 on")
        return value

    def vector(self, item: Json, key: str, default: list[float], where: str, low: float, high: float) -> Array:
        """As many numbers as the default has, in float64."""
        values = item.get(key, default)
        if not isinstance(values, list) or len(values) != len(default):
            raise self.error(f"{where}: {key} is {shown(repr(values))}, not {len(default)} numbers")
        return np.array([number(x, f"{shown(self.path)}: {where}: {key}", low, high) for x in values], np.float64)

    # ---- bytes

    def files(self) -> Iterator[PurePosixPath]:
        """Names of the files beside this one that it refers to."""
        for kind in ("buffers", "images"):
            for index, _ in enumerate(self.array(self.json, kind, "it")):
                item = self.item(kind, index, "it")
                if (uri := item.get("uri")) is not None and not str(uri).startswith("data:"):
                    yield self._beside(uri, f"number {index} of {kind}")

    def _beside(self, uri: Any, where: str) -> PurePosixPath:
        """The name of a file relative to this one's folder, which it may not leave."""
        if not isinstance(uri, str):
            raise self.error(f"{where}: its uri is {shown(repr(uri))}, not a text")
        plain = unquote(uri)
        name = PurePosixPath(uri if "%" in uri and exists(self.path.parent / uri) else plain)
        if name.is_absolute() or ".." in name.parts or not name.name or ":" in name.parts[0] or "\\" in uri:
            raise self.error(f"{where}: its file {shown(repr(uri))} leads out of the folder")
        return name

    def resource(self, item: Json, where: str) -> bytes:
        """The bytes that an item's ``uri`` stands for."""
        uri = item["uri"]
        if isinstance(uri, str) and uri.startswith("data:"):
            head, _, body = uri.partition(",")
            wrong = self.error(f"{where}: its data are not in base64")
            if not head.endswith(";base64"):
                raise wrong
            try:
                return base64.b64decode(body, validate=True)
            except ValueError as error:
                raise wrong from error
        name = self._beside(uri, where)
        return read_bytes(self.path.parent / name, missing=f"{self.path.name} refers to this file, which is missing")

    def buffer(self, index: Any, where: str) -> bytes:
        """The bytes of a buffer."""
        item = self.item("buffers", index, where)
        if index not in self._buffers:
            about = f"buffer {index}"
            if "uri" in item:
                data = self.resource(item, about)
            elif index == 0 and self._binary is not None:
                data = self._binary
            else:
                raise self.error(f"{about} has no data")
            if len(data) < (length := self.count(item, "byteLength", None, about)):
                raise self.error(f"{about} has {len(data)} bytes, not the {length} that it announces")
            self._buffers[index] = data
        return self._buffers[index]

    def _has_data(self, index: Any) -> bool:
        return "uri" in self.item("buffers", index, "a buffer view") or (index == 0 and self._binary is not None)

    def view(self, index: Any, where: str) -> tuple[memoryview, int]:
        """The bytes of a buffer view, and its stride or 0."""
        item, about = self.item("bufferViews", index, where), f"buffer view {shown(index)}"
        if not self._has_data(item.get("buffer")):
            self.check_uncompressed(item, about)
        data = self.buffer(item.get("buffer"), about)
        start, length = self.count(item, "byteOffset", 0, about), self.count(item, "byteLength", None, about)
        if start + length > len(data):
            raise self.error(f"{about} ends at byte {start + length} of {len(data)}")
        return memoryview(data)[start : start + length], self.count(item, "byteStride", 0, about)

    def accessor(self, index: Any, where: str, *kinds: str) -> Array:
        """The values of an accessor [count, width]: float32, or int64 of plain integers; see :meth:`stored`."""
        item, values = self.stored(index, where, *kinds)
        return _as_numbers(values, item.get("normalized") is True)

    def stored(self, index: Any, where: str, *kinds: str) -> tuple[Json, Array]:
        """An accessor, and its values [count, width] in the type that they have in the file.

        Args:
            kinds: types that it may have, such as VEC3.
        """
        item, about = self.item("accessors", index, where), f"accessor {shown(index)} ({where})"
        kind, component = item.get("type"), item.get("componentType")
        if kind not in kinds:
            raise self.error(f"{about} has the type {shown(repr(kind))}, not {' or '.join(kinds)}")
        if isinstance(component, bool) or not isinstance(component, int) or component not in _TYPES:
            raise self.error(f"{about} has the componentType {shown(repr(component))}, which is not known")
        count, width = self.count(item, "count", None, about), _WIDTHS[str(kind)]
        if count == 0 or count > _MAX_VALUES:
            raise self.error(f"{about} has the count {count}")
        dtype = np.dtype(_TYPES[component])
        if "bufferView" in item:
            values = self._strided(item, dtype, count, width, about)
        else:
            reserve(f"{shown(self.path)}: {about}", 12 * count * width, 4 * count * width)
            values = np.zeros((count, width), dtype)
        if "sparse" in item:
            values = self._sparse(self.object(item, "sparse", about), values, about)
        return item, values

    def _strided(self, item: Json, dtype: np.dtype[Any], count: int, width: int, about: str) -> Array:
        data, stride = self.view(item["bufferView"], about)
        start, row = self.count(item, "byteOffset", 0, about), width * dtype.itemsize
        stride = stride or row
        if stride < row or start + stride * (count - 1) + row > len(data):
            raise self.error(f"{about} has {count} entries of {row} bytes, more than its buffer view holds")
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))

    def _sparse(self, item: Json, values: Array, about: str) -> Array:
        """The values with some of them replaced."""
        count = self.count(item, "count", None, about)
        where, what = self.object(item, "indices", about), self.object(item, "values", about)
        kind = where.get("componentType")
        if kind not in (5121, 5123, 5125):
            raise self.error(f"{about}: its sparse indices have the componentType {shown(repr(kind))}")
        if "bufferView" not in where or "bufferView" not in what or not 1 <= count <= len(values):
            raise self.error(f"{about}: its sparse values are incomplete, or more than there are values")
        place = self._strided(where, np.dtype(_TYPES[kind]), count, 1, about)[:, 0].astype(np.int64)
        if place.max() >= len(values):
            raise self.error(f"{about}: a sparse index is {place.max()}, of {len(values)} values")
        changed = values.copy()
        changed[place] = self._strided(what, values.dtype, count, values.shape[1], about)
        return changed


def _as_numbers(values: Array, normalised: bool) -> Array:
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    if not normalised:
        return values.astype(np.int64)
    most = math.ldexp(1.0, 8 * values.dtype.itemsize - (values.dtype.kind == "i")) - 1.0
    return np.maximum(values / most, -1.0).astype(np.float32)
