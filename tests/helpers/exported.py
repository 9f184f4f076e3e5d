"""Exports without a fit: fields as they are initialised, in a scene made in Python."""

import json
import struct
from pathlib import Path

import numpy as np

from neurad.assembly.build import assemble
from neurad.assembly.model_settings import ModelSettings
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, Material
from neurad.export.run import ExportSettings, export
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.direct import Direct

GREY = Material("grey", PrincipledModel(), *(Constant(np.full(n, 0.5, np.float32)) for n in (3, 1)))
_GRID = GridConfig(levels=2, coarsest=4, finest=16, log2_size=10)
_TYPES = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def assembled(scene, hide_environment=False):
    """The parts of a run before its first step."""
    fields = {
        "albedo": FieldConfig(_GRID, 8),
        "roughness": RoughnessConfig(_GRID, 8),
        "radiance": RadianceConfig(_GRID, 8),
    }
    return assemble(scene, ModelSettings(**fields, method=Direct()), hide_environment)


def exported(scene, out, hide_environment=False, made=None, **settings):
    """``neurad export`` of a scene, or of the parts ``made``, into ``out``, which is returned; without
    verification unless it is asked for.
    """
    settings = {"size": 16, "verify": False, **settings}
    export(made or assembled(scene, hide_environment), Path("last.ckpt"), ExportSettings(out=Path(out), **settings))
    return Path(out)


class Glb:
    """A binary glTF file: its JSON, and its accessors as arrays."""

    def __init__(self, path):
        data = Path(path).read_bytes()
        magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
        assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
        self.json = json.loads(data[20 : 20 + size])
        body, kind = struct.unpack("<I4s", data[20 + size : 28 + size])
        assert kind == b"BIN\0"
        self.buffer = data[28 + size : 28 + size + body]

    def array(self, accessor):
        item = self.json["accessors"][accessor]
        start = self.json["bufferViews"][item["bufferView"]]["byteOffset"]
        width, kind = _WIDTHS[item["type"]], _TYPES[item["componentType"]]
        return np.frombuffer(self.buffer, kind, item["count"] * width, start).reshape(-1, width)

    def meshes(self):
        """Name, corners of the triangles [f, 3, 3] and material of each mesh node."""
        for node in self.json["nodes"]:
            if "mesh" in node:
                (primitive,) = self.json["meshes"][node["mesh"]]["primitives"]
                corners = self.array(primitive["attributes"]["POSITION"])[self.array(primitive["indices"]).ravel()]
                yield node["name"], corners.reshape(-1, 3, 3), self.json["materials"][primitive["material"]]
