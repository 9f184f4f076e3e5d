"""Correct scene folders to start from, as bytes by path."""

import json
import struct
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from helpers.tiny_scene import POSE, SIZE, write_scene

Files = dict[str, bytes]


RICH_XML = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="4"/></integrator>
  <sensor type="perspective"><float name="fov" value="45"/></sensor>
  <bsdf type="principled" id="paint">
    <texture type="bitmap" name="base_color"><string name="filename" value="{paint}"/>
      <transform name="to_uv"><scale x="2" y="2"/></transform></texture>
    <texture type="bitmap" name="roughness"><string name="filename" value="{gloss}"/>
      <boolean name="raw" value="true"/></texture>
    <float name="metallic" value="0.2"/><float name="specular" value="0.5"/>
  </bsdf>
  <bsdf type="roughplastic" id="plastic"><rgb name="diffuse_reflectance" value="0.2, 0.3, 0.4"/>
    <float name="alpha" value="0.2"/><string name="distribution" value="ggx"/><float name="int_ior" value="1.5"/></bsdf>
  <bsdf type="twosided" id="metal"><bsdf type="roughconductor"><string name="material" value="Cu"/>
    <float name="alpha" value="0.3"/><string name="distribution" value="ggx"/></bsdf></bsdf>
  <bsdf type="{delta}" id="smooth"/>
  <bsdf type="diffuse" id="tinted">
    <texture type="mesh_attribute" name="reflectance"><string name="name" value="vertex_color"/></texture></bsdf>
  <shape type="ply" id="floor"><string name="filename" value="meshes/floor.ply"/><ref id="paint"/></shape>
  <shape type="ply" id="wall"><string name="filename" value="meshes/binary.ply"/><ref id="tinted"/></shape>
  <shape type="obj" id="block"><string name="filename" value="meshes/block.obj"/>
    <transform name="to_world"><scale value="0.3"/><translate x="0.5" y="0.3"/></transform><ref id="plastic"/></shape>
  <shape type="cube" id="box"><transform name="to_world"><scale value="0.2"/><translate x="-0.5" y="0.5"/></transform>
    <boolean name="flip_normals" value="false"/><ref id="metal"/></shape>
  <shape type="rectangle" id="pane"><transform name="to_world"><scale value="0.3"/><translate y="1" z="1"/></transform>
    <ref id="smooth"/></shape>
  <shape type="rectangle" id="lamp">
    <transform name="to_world"><rotate x="1" angle="90"/><translate y="2"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf>
    <emitter type="area"><rgb name="radiance" value="1, 2, 3"/></emitter>
  </shape>
  {light}
</scene>
"""
ENVMAP = """<emitter type="envmap"><string name="filename" value="{sky}"/><float name="scale" value="0.5"/>
    <transform name="to_world"><rotate y="1" angle="30"/></transform></emitter>"""
CONSTANT = """<emitter type="constant"><rgb name="radiance" value="0.4, 0.5, 0.6"/></emitter>"""
OBJ = """# a wedge
v -1 -1 -1
v 1 -1 -1
v 1 -1 1
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vn 0 -1 0
vn 0 0.5 1
f 1/1/1 2/2/1 3/3/1
f 1/1/2 3/3/2 4/2/2
f 2/1/2 1/3/2 4/2/2
"""
VARIANTS = 4
"""Scene folders to start from."""


@cache
def seed_files(variant: int) -> Files:
    """A correct scene folder, by variant."""
    with TemporaryDirectory() as made:
        folder = Path(made) / "scene"
        write_scene(folder, views=2, channels=4 if variant == 2 else 3)
        if variant:
            _enrich(folder, variant)
        return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _enrich(folder: Path, variant: int) -> None:
    from neurad.images.image_io import write_exr

    rng = np.random.default_rng(variant)
    colours = rng.random((4, 8, 3), np.float32)
    write_exr(folder / "sky.exr", colours)
    write_exr(folder / "textures/gloss.exr", rng.random((4, 4, 1), np.float32))
    (folder / "textures/tint.hdr").write_bytes(hdr(colours))
    (folder / "textures/tint.pfm").write_bytes(pfm(colours))
    (folder / "meshes/binary.ply").write_bytes(binary_ply())
    (folder / "meshes/block.obj").write_text(OBJ)
    sky = {1: "sky.exr", 2: "textures/tint.hdr", 3: None}[variant]
    (folder / "scene.xml").write_text(
        RICH_XML.format(
            paint={1: "textures/paint.png", 2: "textures/tint.hdr", 3: "textures/tint.pfm"}[variant],
            gloss={1: "textures/gloss.exr", 2: "textures/gloss.exr", 3: "textures/paint.png"}[variant],
            delta={1: "conductor", 2: "dielectric", 3: "conductor"}[variant],
            light=CONSTANT if sky is None else ENVMAP.format(sky=sky),
        )
    )
    for kind, channels in (("albedo", 3), ("roughness", 1)):
        (folder / kind).mkdir()
        for part in ("train", "test"):
            for i in range(2):
                write_exr(folder / kind / f"{part}_{i}.exr", rng.random((SIZE, SIZE, channels), np.float32))
    if variant != 3:
        return
    write_exr(folder / "env_relight.exr", colours)
    write_exr(folder / "images/relit.exr", rng.random((SIZE, SIZE, 3), np.float32))
    frames = [
        {"file_path": f"images/test_{i}", "transform_matrix": POSE, "relight_path": "images/relit.exr", "w": SIZE,
         "h": SIZE, "fl_x": 8.0, "fl_y": 8.0, "cx": SIZE / 2, "cy": SIZE / 2, "k1": 0.0}
        for i in range(2)
    ]  # fmt: skip
    (folder / "transforms_test.json").write_text(json.dumps({"frames": frames}))


def binary_ply() -> bytes:
    """A square of two triangles with normals and colours, little endian."""
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 4\n"
    header += "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz", "r", "g", "b"))
    header += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    corners = [(-1, 0, -1), (1, 0, -1), (1, 2, -1), (-1, 2, -1)]
    body = b"".join(struct.pack("<9f", *corner, 0, 0, 1, 0.2, 0.5, 0.8) for corner in corners)
    return header.encode() + body + b"".join(struct.pack("<B3i", 3, *face) for face in ((0, 1, 2), (0, 2, 3)))


def hdr(pixels: np.ndarray) -> bytes:
    """Radiance's RGBE file of [h, w, 3], not run-length coded."""
    largest = pixels.max(-1)
    mantissa, exponent = np.frexp(largest)
    scale = np.where(largest > 0, mantissa * 256.0 / np.maximum(largest, 1e-38), 0.0)
    coded = np.concatenate([pixels * scale[..., None], (exponent + 128)[..., None]], -1).astype(np.uint8)
    size = f"-Y {pixels.shape[0]} +X {pixels.shape[1]}\n"
    return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size.encode() + coded.tobytes()


def pfm(pixels: np.ndarray) -> bytes:
    """A portable float map of [h, w, 3]."""
    return f"PF\n{pixels.shape[1]} {pixels.shape[0]}\n-1.0\n".encode() + pixels[::-1].astype("<f4").tobytes()
