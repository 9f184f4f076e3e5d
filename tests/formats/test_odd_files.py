"""Odd files of every format: each is read, or refused in one sentence; what is read can be computed with."""

import copy
import json
import math
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import layouts
from helpers.blender_dump import GREY, lamp, room, square, write_dump
from helpers.fuzzing.odd import change, pick
from helpers.fuzzing.spoil_bytes import cut, flip, four, insert, line, token, write_files
from helpers.gltf_writer import FACES, QUAD, UVS, Document
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurad.core.camera import Cameras, camera_rays
from neurad.core.errors import InputError
from neurad.core.scene_records import Bitmap
from neurad.formats.blender.read import read_blender
from neurad.formats.gltf.read import read_scene
from neurad.formats.import_room import SOURCES
from neurad.scene.geometry import Geometry

ODD = (
    None, True, False, 0, -1, 1, 2, 3, 5, 6, 7, 8, 255, 30000, 2**31, 2**70, 10**400, -0.0, 1e-300, 1e30, 1e300,
    -1e300, math.nan, math.inf, -math.inf, 0.5, 1e-9, 3.2, "", "1", "a", "x", "../a", "/", "\0", "ä b", "data:,x",
    "data:a;base64,AAAA", "data:a;base64,!", [], {}, [1], [[]], [1, 2, 3], [[1, 2], [3]], [0, 0, 0, 0], [math.nan] * 3,
    [1] * 16, [0] * 16, [[1, 0, 0, 0]] * 3, [[0] * 4] * 4, [[math.nan] * 4] * 4, "MASK", "BLEND", "VEC2", "VEC3",
    "SCALAR", 5120, 5121, 5123, 5125, 5126, 33071, 33648, 10497, "spot", "directional", "orthographic", "OPENCV",
    "OPENCV_FISHEYE", "FULL_OPENCV", "PINHOLE", "images/frame_00001.exr", ["images/frame_00001.exr"], {"unread": "x"},
    {"file": "x.npy"}, {"index": 0}, {"index": 0, "texCoord": 1},
    {"KHR_texture_transform": {"offset": [1e9, 0]}}, {"KHR_materials_transmission": {"transmissionFactor": 1}},
    {"KHR_materials_unlit": {}}, {"KHR_draco_mesh_compression": {}}, {"KHR_lights_punctual": {"light": 0}},
)  # fmt: skip
CHANGES = st.lists(st.tuples(*[st.integers(0, 2**31)] * 4), min_size=1, max_size=3)

# ---- cameras of other programs

CAMERA_KEYS = (
    "k1", "k2", "k3", "k4", "k5", "p1", "p2", "cx", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y", "camera_model",
    "w", "h", "applied_transform", "applied_scale", "mask_path", "train_filenames", "is_fisheye", "frames", "file_path",
    "transform_matrix", "width", "height", "fx", "t_00", "t_23",
)  # fmt: skip
LAYOUTS = {
    "nerfstudio": (lambda f: layouts.write_nerfstudio(f, layouts.cameras("opencv", 2)), "*.json"),
    "colmap text": (lambda f: layouts.write_colmap(f, layouts.cameras("opencv", 2), False), "*.txt"),
    "colmap binary": (lambda f: layouts.write_colmap(f, layouts.cameras("fisheye", 2), True), "*.bin"),
    "polycam": (lambda f: layouts.write_polycam(f, layouts.cameras("off-centre", 2)), "*.json"),
    "fipt rendered": (
        lambda f: layouts.write_fipt_rendered(f, layouts.one_angle(layouts.cameras(count=3)), 1), "transforms.json"),
    "fipt photographed": (lambda f: layouts.write_fipt_photographed(f, layouts.cameras(count=2)), "*.txt"),
}  # fmt: skip


def spoil_cameras(folder, pattern, changes):
    """Values of JSON are replaced, added or taken away, words and lines of text changed, or bytes."""
    kinds = {".json": (), ".txt": (token, line), ".bin": (flip, cut, insert, four)}
    files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob(pattern)}
    for file, where, what, how in changes:
        name = pick(sorted(files), file)
        if spoil := kinds[Path(name).suffix]:
            pick(spoil, how)(files, file, where, what)
            continue
        document = json.loads(files[name])
        change(document, where, how, pick(ODD, what), CAMERA_KEYS)
        files[name] = json.dumps(document).encode()
    write_files(files, folder)


def look_at_cameras(kind, folder):
    views = SOURCES[kind][0](folder, None)
    for view in views.train + views.test:
        size = torch.tensor([view.camera.width, view.camera.height], dtype=torch.float64)
        rays = camera_rays(view.camera, torch.rand(50, 2, dtype=torch.float64) * size)
        assert rays.d.isfinite().all()
        assert rays.o.isfinite().all()
    Cameras.of([view.camera for view in views.train], "cpu")


# ---- glTF

GLTF_KEYS = (
    "mode", "indices", "material", "scale", "matrix", "rotation", "translation", "children", "mesh", "camera", "skin",
    "weights", "extensions", "extras", "sparse", "normalized", "byteOffset", "byteStride", "byteLength", "bufferView",
    "uri", "count", "type", "componentType", "alphaMode", "alphaCutoff", "doubleSided", "emissiveFactor",
    "emissiveTexture", "normalTexture", "baseColorTexture", "metallicRoughnessTexture", "baseColorFactor",
    "roughnessFactor", "metallicFactor", "sampler", "source", "wrapS", "index", "texCoord", "name", "COLOR_0", "NORMAL",
    "TEXCOORD_1", "extensionsRequired", "scene", "nodes", "asset", "animations", "yfov", "aspectRatio",
)  # fmt: skip


def write_gltf(folder):
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
    folder.mkdir()
    document.glb(folder / "a.glb")
    return folder


def spoil_gltf(folder, changes):
    """Values of the JSON are replaced, added or taken away, or bytes of the buffer changed."""
    data = (folder / "a.glb").read_bytes()
    size = struct.unpack("<I", data[12:16])[0]
    described, body = json.loads(data[20 : 20 + size]), bytearray(data[28 + size :])
    for where, what, how, which in changes:
        if which % 8 == 0:
            place = where % (len(body) - 8)
            body[place : place + 4] = struct.pack("<f", pick([math.nan, math.inf, 1e38, -1.0, 0.0, 3e-40], what))
            continue
        change(described, where, how, copy.deepcopy(pick(ODD, what)), GLTF_KEYS)
    text = json.dumps(described).encode()
    text += b" " * (-len(text) % 4)
    data = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + bytes(body)
    data = struct.pack("<4sII", b"glTF", 2, 12 + len(data)) + data
    cut = changes[0][3] % 40
    (folder / "a.glb").write_bytes(data[: len(data) - cut * 7] if cut < 3 else data)


def look_at_gltf(folder):
    scene = read_scene(folder / "a.glb")
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


# ---- Blender


def write_blender(folder):
    """A room with a bit of everything, as Blender's side writes it."""
    picture = {"file": "image.npy", "coded": True, "channel": None, "uv": "", "to_uv": np.eye(3).tolist()}
    glow = {"name": "glow", "shader": "EMISSION", "emission": picture, "strength": 2.0}
    rough = {**GREY, "name": "rough", "color": picture, "roughness": {**picture, "coded": False, "channel": 1}}
    kinds = ("AREA", "POINT", "SPOT", "SUN")
    described = room(
        objects=[square(), square("a", materials=[1]), square("b", materials=[2])], materials=[GREY, rough, glow],
        lamps=[lamp(kind, name=kind) for kind in kinds], world={"color": [0.1, 0.2, 0.3]}, left_out={"hair": ["x"]},
    )  # fmt: skip
    np.save(write_dump(folder, described) / "image.npy", np.arange(24, dtype=np.uint8).reshape(2, 4, 3))
    return folder


def spoil_blender(folder, changes):
    described = json.loads((folder / "blender.json").read_text())
    odd = [x for x in ODD if not (isinstance(x, int) and 1000 < x < 50000)]  # a picture is cut where it tiles
    for where, what, how, _ in changes:
        change(described, where, how, copy.deepcopy(pick(odd, what)), ("unread", "file", "type"))
    (folder / "blender.json").write_text(json.dumps(described))


# ---- all of them


def of_cameras(layout):
    write, pattern = LAYOUTS[layout]
    return write, lambda f, changes: spoil_cameras(f, pattern, changes), lambda f: look_at_cameras(layout.split()[0], f)


FORMATS = {
    **{layout: of_cameras(layout) for layout in LAYOUTS},
    "glTF": (write_gltf, spoil_gltf, look_at_gltf),
    "Blender": (write_blender, spoil_blender, lambda f: read_blender(f, "raum.blend")),
}
"""What writes a folder, spoils it by some numbers, and reads it."""


@pytest.mark.parametrize("count", [40, pytest.param(2000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FORMATS)
def test_odd_files(name, count, tmp_path):
    write, spoil, look = FORMATS[name]
    whole, ends = write(tmp_path / "whole"), []
    look(whole)

    @settings(max_examples=count, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
    @given(CHANGES)
    def one(changes):
        folder = tmp_path / "spoilt"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(whole, folder)
        spoil(folder, changes)
        try:
            look(folder)
            ends.append("")
        except InputError as error:
            ends.append(str(error))

    one()
    assert "" in ends, "all cases were refused, which shows little of what accepted ones do"
    assert any(ends)
    assert not any("\n" in said for said in ends)
