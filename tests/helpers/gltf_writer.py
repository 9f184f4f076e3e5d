"""A writer of glTF 2.0 for tests, by the specification and without a line of the reader's."""

import base64
import io
import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
WIDTHS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
QUAD = np.array([[-1, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]], np.float32)
"""A square that faces +Y."""
FACES = np.array([[0, 1, 2], [0, 2, 3]])
UVS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)


class Document:
    """A file in the making."""

    def __init__(self):
        self.json = {"asset": {"version": "2.0", "generator": "tests"}, "scenes": [{"nodes": []}], "scene": 0}
        self.body = b""

    def add(self, kind, item):
        self.json.setdefault(kind, []).append(item)
        return len(self.json[kind]) - 1

    def view(self, data, **more):
        self.body += b"\0" * (-len(self.body) % 4)
        self.body += data
        return self.add("bufferViews", {"buffer": 0, "byteOffset": len(self.body) - len(data), "byteLength": len(data),
                                        **more})  # fmt: skip

    def accessor(self, values, kind="f4", **more):
        values = np.asarray(values)
        values = (values[:, None] if values.ndim == 1 else values).astype("<" + kind)
        item = {"componentType": COMPONENTS[kind], "count": len(values), "type": WIDTHS[values.shape[1]]}
        return self.add("accessors", {"bufferView": self.view(values.tobytes()), **item, **more})

    def interleaved(self, columns):
        """Accessors of float columns side by side in one view."""
        rows = np.concatenate([np.asarray(c, "<f4") for c in columns], 1)
        view, start, made = self.view(b"pad!" + rows.tobytes(), byteStride=rows.shape[1] * 4), 4, []
        for column in columns:
            width = np.shape(column)[1]
            made.append(self.add("accessors", {
                "bufferView": view, "byteOffset": start, "componentType": 5126, "count": len(rows),
                "type": WIDTHS[width]}))  # fmt: skip
            start += 4 * width
        return made

    def sparse(self, values):
        """An accessor without a view of its own, all of whose values are given as exceptions from 0."""
        values = np.asarray(values, "<f4")
        where = np.arange(len(values), dtype="<u1")
        about = {
            "count": len(values),
            "indices": {"bufferView": self.view(where.tobytes()), "componentType": COMPONENTS["u1"]},
            "values": {"bufferView": self.view(values.tobytes())},
        }
        item = {"componentType": 5126, "count": len(values), "type": WIDTHS[values.shape[1]], "sparse": about}
        return self.add("accessors", item)

    def mesh(self, attributes, indices=None, **more):
        primitive = {"attributes": attributes, **({} if indices is None else {"indices": indices}), **more}
        return self.add("meshes", {"primitives": [primitive]})

    def node(self, root=True, **item):
        index = self.add("nodes", item)
        if root:
            self.json["scenes"][0]["nodes"].append(index)
        return index

    def quad(self, uvs=UVS, material=None, **node):
        attributes = {"POSITION": self.accessor(QUAD)}
        if uvs is not None:
            attributes["TEXCOORD_0"] = self.accessor(uvs)
        more = {} if material is None else {"material": self.add("materials", material)}
        mesh = self.mesh(attributes, self.accessor(FACES.ravel(), "u2"), **more)
        return self.node(**{"mesh": mesh, "name": "square", **node})

    def texture(self, pixels, sampler=None, **info):
        """What refers to a picture of bytes [h, w, c]."""
        out = io.BytesIO()
        Image.fromarray(np.asarray(pixels, np.uint8)).save(out, "PNG")
        image = self.add("images", {"bufferView": self.view(out.getvalue()), "mimeType": "image/png"})
        item = {"source": image, **({} if sampler is None else {"sampler": self.add("samplers", sampler)})}
        return {"index": self.add("textures", item), **info}

    def use(self, *names, required=False):
        for kind in ("extensionsUsed", *(["extensionsRequired"] if required else [])):
            self.json[kind] = [*self.json.get(kind, []), *names]

    def glb(self, path):
        described = {**self.json, "buffers": [{"byteLength": len(self.body)}]} if self.body else self.json
        text = json.dumps(described).encode()
        text += b" " * (-len(text) % 4)
        body = self.body + b"\0" * (-len(self.body) % 4)
        data = struct.pack("<I4s", len(text), b"JSON") + text
        data += struct.pack("<I4s", len(body), b"BIN\0") + body if body else b""
        Path(path).write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(data)) + data)
        return Path(path)

    def gltf(self, path, buffer=None):
        """Write JSON with the buffer in it, or beside it under a name."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(self.body).decode()
        if buffer is not None:
            (Path(path).parent / buffer).parent.mkdir(parents=True, exist_ok=True)
            (Path(path).parent / buffer).write_bytes(self.body)
            uri = buffer
        Path(path).write_text(json.dumps({**self.json, "buffers": [{"byteLength": len(self.body), "uri": uri}]}))
        return Path(path)
