"""Odd glTF files: they are read, or end with one sentence; what is read can be computed with."""

import copy
import json
import math
import struct

import numpy as np
import pytest
from helpers.fuzzing.odd import change, pick
from helpers.gltf_writer import FACES, QUAD, UVS, Document
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurad.core.errors import InputError
from neurad.core.records import Bitmap
from neurad.formats.gltf.gltf_scene import read_scene
from neurad.scene.geometry import Geometry

ODD = (
    None, True, False, 0, -1, 1, 2, 5, 6, 7, 255, 2**31, 2**70, -0.0, 1e-300, 1e300, -1e300, math.nan, math.inf, 0.5,
    1e-9, 3.2, "", "1", "a", "../a", "/", "\0", "ä b", "data:,x", "data:a;base64,AAAA", "data:a;base64,!", [], {}, [[]],
    [1, 2, 3], [0, 0, 0, 0], [math.nan] * 3, [1] * 16, [0] * 16, "MASK", "BLEND", "VEC2", "VEC3", "SCALAR", 5120, 5121,
    5123, 5125, 5126, 33071, 33648, 10497, "spot", "directional", "orthographic", {"index": 0},
    {"index": 0, "texCoord": 1},
    {"KHR_texture_transform": {"offset": [1e9, 0]}}, {"KHR_materials_transmission": {"transmissionFactor": 1}},
    {"KHR_materials_unlit": {}}, {"KHR_draco_mesh_compression": {}}, {"KHR_lights_punctual": {"light": 0}},
)  # fmt: skip
KEYS = (
    "mode", "indices", "material", "scale", "matrix", "rotation", "translation", "children", "mesh", "camera", "skin",
    "weights", "extensions", "extras", "sparse", "normalized", "byteOffset", "byteStride", "byteLength", "bufferView",
    "uri", "count", "type", "componentType", "alphaMode", "alphaCutoff", "doubleSided", "emissiveFactor",
    "emissiveTexture", "normalTexture", "baseColorTexture", "metallicRoughnessTexture", "baseColorFactor",
    "roughnessFactor", "metallicFactor", "sampler", "source", "wrapS", "index", "texCoord", "name", "COLOR_0", "NORMAL",
    "TEXCOORD_1", "extensionsRequired", "scene", "nodes", "asset", "animations", "yfov", "aspectRatio",
)  # fmt: skip
CHANGES = st.lists(st.tuples(*[st.integers(0, 2**31)] * 4), min_size=1, max_size=3)


def whole():
    """A small scene with something of everything."""
    document, rng = Document(), np.random.default_rng(1)
    picture = rng.integers(0, 256, (3, 4, 3))
    info = document.texture(picture, {"wrapS": 33071}, extensions={"KHR_texture_transform": {"scale": [2, 1]}})
    paint = {"pbrMetallicRoughness": {"baseColorTexture": info, "metallicRoughnessTexture": info, "metallicFactor": 0}}
    document.quad(material={**paint, "alphaMode": "OPAQUE"}, scale=[2, 1, 2])
    lamp = {"emissiveFactor": [1, 0.5, 0], "emissiveTexture": document.texture(picture), "doubleSided": True,
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 3.0}},
            "pbrMetallicRoughness": {"metallicFactor": 0}}  # fmt: skip
    document.quad(material=lamp, translation=[0, 2, 0], rotation=[1, 0, 0, 0])
    attributes = dict(zip(("POSITION", "NORMAL", "TEXCOORD_0"), document.interleaved([QUAD, QUAD, UVS]), strict=True))
    attributes["COLOR_0"] = document.accessor(rng.integers(0, 255, (4, 4)), "u1", normalized=True)
    child = document.node(root=False, mesh=document.mesh(attributes, document.accessor([3, 0, 2, 1], "u1"), mode=5))
    glass = {"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 0},
             "extensions": {"KHR_materials_transmission": {"transmissionFactor": 1}}}  # fmt: skip
    sparse = document.mesh({"POSITION": document.sparse(QUAD)}, document.accessor(FACES.ravel(), "u4"),
                           material=document.add("materials", glass))  # fmt: skip
    document.node(children=[child], matrix=[1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0, 0, 1, 0, 1], mesh=sparse)
    lens = {"type": "perspective", "perspective": {"yfov": 0.7, "aspectRatio": 1.5}}
    document.node(camera=document.add("cameras", lens), name="eye")
    return document


def spoilt(document, changes):
    """The bytes of the file with values of its JSON replaced, added or taken away, or bytes of its buffer changed."""
    described = json.loads(json.dumps({**document.json, "buffers": [{"byteLength": len(document.body)}]}))
    body = bytearray(document.body)
    for where, what, how, which in changes:
        if which % 8 == 0:
            place = where % (len(body) - 8)
            body[place : place + 4] = struct.pack("<f", pick([math.nan, math.inf, 1e38, -1.0, 0.0, 3e-40], what))
            continue
        change(described, where, how, copy.deepcopy(pick(ODD, what)), KEYS)
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + bytes(body)
    data = struct.pack("<4sII", b"glTF", 2, 12 + len(data)) + data
    cut = changes[0][3] % 40
    return data[: len(data) - cut * 7] if cut < 3 else data


def look(path):
    """Read a file; whether it could be read."""
    try:
        scene = read_scene(path)
    except InputError:
        return False
    geometry = Geometry(scene)
    assert geometry.table.isfinite().all()
    assert geometry.emission.isfinite().all()
    for material in scene.materials:
        for texture in (material.albedo, material.roughness):
            if isinstance(texture, Bitmap):
                assert texture.pixels.ndim == 3
                assert np.isfinite(texture.pixels).all()
                assert np.isfinite(texture.to_uv).all()
    for view in scene.test:
        assert np.isfinite(view.camera.to_world).all()
    return True


@pytest.mark.parametrize("count", [120, pytest.param(2000, marks=pytest.mark.slow)])
def test_odd_files(count, tmp_path):
    document, ends = whole(), []

    @settings(
        max_examples=count, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None
    )
    @given(CHANGES)
    def one(changes):
        (tmp_path / "a.glb").write_bytes(spoilt(document, changes))
        ends.append(look(tmp_path / "a.glb"))

    document.glb(tmp_path / "whole.glb")
    assert look(tmp_path / "whole.glb")
    one()
    assert any(ends), "all cases were refused, which shows little of what accepted ones do"
    assert not all(ends)
