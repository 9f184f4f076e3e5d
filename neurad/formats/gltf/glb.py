"""The container of glTF 2.0: lists of JSON records around one buffer, in one binary file."""

import json
import shutil
import struct
from pathlib import Path
from typing import IO, Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import FloatArray

Json = dict[str, Any]
LARGEST = 2**32 - 1
"""Bytes of the largest file: its length is a number of 32 bits."""
_FLOAT, _SHORT, _INT = 5126, 5123, 5125
_VERTICES, _TRIANGLES = 34962, 34963
_LINEAR, _MIPMAPS, _CLAMP = 9729, 9987, 33071
SAMPLER = {"magFilter": _LINEAR, "minFilter": _MIPMAPS, "wrapS": _CLAMP, "wrapT": _CLAMP}
"""How pictures are looked up."""
_LISTS = ("nodes", "meshes", "materials", "cameras", "textures", "images", "accessors", "bufferViews")


class GlbWriter:
    """A binary glTF file in the making: its buffer goes to a file as it grows.

    Args:
        buffer: a file opened for writing bytes.
        json: of a file that is taken over, without what its buffers hold.
    """

    def __init__(self, buffer: IO[bytes], json: Json | None = None) -> None:
        self.buffer = buffer
        self.length = 0
        self.json: Json = {name: [] for name in _LISTS} | (json or {})
        self.extensions: set[str] = set(self.json.get("extensionsUsed", ()))

    def add(self, kind: str, item: Json) -> int:
        """Append to one of the lists of the file; returns its number."""
        self.json[kind].append(item)
        return len(self.json[kind]) - 1

    def append(self, data: bytes) -> int:
        """Append to the buffer; returns where that begins."""
        begin = self.length
        self.buffer.write(data + b"\0" * (-len(data) % 4))
        self.length += len(data) + -len(data) % 4
        return begin

    def view(self, data: bytes, target: int | None = None) -> int:
        """Append to the buffer; returns the number of the view."""
        item: Json = {"buffer": 0, "byteOffset": self.append(data), "byteLength": len(data)}
        if target is not None:
            item["target"] = target
        return self.add("bufferViews", item)

    def vertices(self, values: FloatArray, bounds: bool = False) -> int:
        """Append vertex values [v, 2 or 3]; returns the number of the accessor."""
        values = np.ascontiguousarray(values, "<f4")
        view = self.view(values.tobytes(), _VERTICES)
        item: Json = {"bufferView": view, "componentType": _FLOAT, "count": len(values)}
        item["type"] = f"VEC{values.shape[1]}"
        if bounds:
            item["min"], item["max"] = ([float(x) for x in f(0)] for f in (values.min, values.max))
        return self.add("accessors", item)

    def triangles(self, faces: np.ndarray, vertices: int) -> int:
        """Append corner numbers [f, 3]; returns the number of the accessor."""
        short = vertices < 65535
        data = np.ascontiguousarray(faces, "<u2" if short else "<u4")
        kind = _SHORT if short else _INT
        view = self.view(data.tobytes(), _TRIANGLES)
        return self.add("accessors", {"bufferView": view, "componentType": kind, "count": data.size, "type": "SCALAR"})

    def texture(self, png: bytes, name: str) -> Json:
        """Append a picture; returns what refers to it."""
        image = self.add("images", {"bufferView": self.view(png), "mimeType": "image/png", "name": name})
        if SAMPLER not in self.json.setdefault("samplers", []):
            self.json["samplers"].append(SAMPLER)
        sampler = self.json["samplers"].index(SAMPLER)
        return {"index": self.add("textures", {"source": image, "sampler": sampler})}

    def finish(self, path: Path, buffer: Path) -> None:
        """Write the file around the buffer, which has been closed.

        Raises:
            OSError: it cannot be written.
            InputError: it would be larger than any such file.
        """
        document = {name: value for name, value in self.json.items() if value != []}
        document["buffers"] = [{"byteLength": self.length}]
        if self.extensions:
            document["extensionsUsed"] = sorted(self.extensions)
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        if 28 + len(text) + self.length > LARGEST:
            size = (28 + len(text) + self.length) / 1e9
            raise InputError(f"{path}: it would have {size:.1f} GB, glTF files 4.2 at most; ask for fewer --texels")
        with path.open("wb") as file, buffer.open("rb") as body:
            file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + self.length))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            file.write(struct.pack("<I4s", self.length, b"BIN\0"))
            shutil.copyfileobj(body, file, 1 << 20)
