"""Scene folders with broken or hostile files: one sentence each, never a crash, and never a wrong result."""

import os
import re
import struct
import zlib

import numpy as np
import pytest
from helpers.tiny_fit import fails
from helpers.tiny_scene import PLY, XML, read_json, write_json, write_scene
from PIL import Image

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.core.errors import InputError
from neurad.formats.load import load_scene
from neurad.images.image_io import read_bitmap, write_exr

pytest.importorskip("mitsuba")

LIGHT = '<rgb name="radiance" value="1, 2, 3"/>'
PAPER = '<rgb name="reflectance" value="0.1, 0.2, 0.3"/>'
PAINT = XML[XML.index("<texture") : XML.index("</texture>") + 10]
FACES = "3 0 1 2\n3 0 2 3\n"


def xml(old, new):
    def spoil(folder):
        text = (folder / "scene.xml").read_text()
        assert old in text
        (folder / "scene.xml").write_text(text.replace(old, new, 1))

    return spoil


def radiance(value, kind="rgb"):
    return xml(LIGHT, f'<{kind} name="radiance" value="{value}"/>')


def environment(plugin, inside, pixels=1.0):
    def spoil(folder):
        write_exr(folder / "sky.exr", np.full((2, 4, 3), pixels, np.float32), half=False)
        xml("</scene>", f'<emitter type="{plugin}">{inside}</emitter></scene>')(folder)

    return spoil


def envmap(inside="", pixels=1.0, name="sky.exr"):
    return environment("envmap", f'<string name="filename" value="{name}"/>{inside}', pixels)


def written(name, data):
    def spoil(folder):
        (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())

    return spoil


def ply(form="binary_little_endian", index=(0, 1, 2), count=3, vertices=3, corner=0.0, cut=None, kind="int"):
    """A mesh of one triangle, or what is said to be one."""
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n" + "".join(f"property float {c}\n" for c in "xyz")
    head += f"element face 1\nproperty list uchar {kind} vertex_indices\nend_header\n"
    corners = [(corner, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)]
    if form == "ascii":
        body = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in corners) + " ".join(map(str, (count, *index))) + "\n"
        return written("meshes/floor.ply", head + body)
    order = "<" if "little" in form else ">"
    body = struct.pack(f"{order}9f", *np.ravel(corners)) + bytes([count])
    body += struct.pack(f"{order}{len(index)}{'I' if kind == 'uint' else 'i'}", *index)
    return written("meshes/floor.ply", (head.encode() + body)[:cut])


def other_mesh(kind, data):
    def spoil(folder):
        xml('type="ply" id="floor"', f'type="{kind}" id="floor"')(folder)
        xml("floor.ply", f"floor.{kind}")(folder)
        written(f"meshes/floor.{kind}", data)(folder)

    return spoil


def serialized(index):
    body = struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", 3, 1) + struct.pack("<9f", *range(9))
    packed = zlib.compress(body + struct.pack("<3I", *index))
    return other_mesh("serialized", struct.pack("<HH", 0x041C, 4) + packed + struct.pack("<QI", 0, 1))


def triangle(face):
    return other_mesh("obj", f"v 0 0 0\nv 1 0 0\nv 0 0 1\nf {face}\n")


def window(name, attribute, side):
    """Enlarge a window in the header of an EXR file."""

    def spoil(folder):
        data = bytearray((folder / name).read_bytes())
        place = data.index(attribute + b"\0box2i\0") + len(attribute) + 11
        struct.pack_into("<4i", data, place, 0, 0, side - 1, side - 1)
        (folder / name).write_bytes(data)

    return spoil


def said_size(width, height):
    """Let the header of the texture say another size."""

    def spoil(folder):
        data = bytearray((folder / "textures/paint.png").read_bytes())
        struct.pack_into(">II", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(bytes(data[12:29])))
        (folder / "textures/paint.png").write_bytes(data)

    return spoil


def pipe(name):
    def spoil(folder):
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return spoil


def top(text):
    def spoil(folder):
        file = folder / "transforms_train.json"
        file.write_text(file.read_text().replace('"camera_angle_x": 0.9', text, 1))

    return spoil


def frame(**changes):
    def spoil(folder):
        described = read_json(folder, "train")
        described["frames"][1].update(changes)
        write_json(folder, "train", described)

    return spoil


def photographs(value, channels=3):
    def spoil(folder):
        pixels = np.full((8, 8, channels), 0.5, np.float32)
        pixels[..., -1] = value
        for i in range(3):
            write_exr(folder / f"images/train_{i}.exr", pixels, half=False)

    return spoil


def every_pixel(value):
    def spoil(folder):
        for i in range(3):
            write_exr(folder / f"images/train_{i}.exr", np.full((8, 8, 3), value, np.float32), half=False)

    return spoil


HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n"
IMAGES = "images/train_1.exr"

BAD = {
    "radiance inf": (radiance("inf"), r"scene\.xml: the radiance of the area light of shape lamp is inf, inf, inf"),
    "radiance NaN": (radiance("1, nan, 1"), r"shape lamp is 1, nan, 1, which has to be numbers from 0 to 1e\+17"),
    "radiance 1e39": (radiance("1e39", "float"), r"the radiance of the area light of shape lamp is inf"),
    "radiance 1e38": (radiance("1e38"), r"the radiance of the area light of shape lamp is 1e\+38"),
    "negative radiance": (radiance("1, -1, 1"), r"the radiance of the area light of shape lamp is 1, -1, 1"),
    "radiance of words": (radiance("x", "string"), r"the radiance of the area light of shape lamp is not a colour"),
    "a scale for a light": (xml(LIGHT, LIGHT + '<float name="scale" value="2"/>'), r"shape lamp sets scale"),
    "constant NaN": (environment("constant", '<rgb name="radiance" value="nan"/>'), r"of the constant emitter is nan"),
    "scale of a constant": (environment("constant", '<float name="scale" value="-1"/>'), r"emitter sets scale"),
    "envmap of -1": (envmap('<float name="scale" value="-1"/>'), r"scene\.xml: the scale of the envmap is -1"),
    "envmap of NaN": (envmap('<float name="scale" value="nan"/>'), r"scene\.xml: the scale of the envmap is nan"),
    "bright times a scale": (
        envmap('<float name="scale" value="1e9"/>', 1e9), r"sky\.exr: radiance times the scale 1e\+09 .* 24 of 24"),
    "envmap moved by NaN": (
        envmap('<transform name="to_world"><translate x="nan"/></transform>'), r"to_world of the envmap is not"),
    "envmap stretched": (
        envmap('<transform name="to_world"><scale x="2"/></transform>'), r"of the envmap has to be a rotation"),
    "floor without size": (
        xml('<ref id="paint"/>', '<ref id="paint"/><transform name="to_world"><scale value="0"/></transform>'),
        r"to_world of shape floor is not a transform that can be inverted"),
    "far floor": (
        xml('<ref id="paint"/>', '<ref id="paint"/><transform name="to_world"><scale value="1e30"/></transform>'),
        r"world coordinates of shape floor: 8 of 12 values"),
    "roughness 2": (xml('value="0.4"', 'value="2"'), r"roughness of bsdf paint of shape floor is 2, .* 0 to 1"),
    "roughness NaN": (xml('value="0.4"', 'value="nan"'), r"the roughness of bsdf paint of shape floor is nan"),
    "reflectance 65504": (
        xml(PAPER, '<float name="reflectance" value="65504"/>'), r"the reflectance of .* shape lamp is 65504"),
    "reflectance NaN": (xml("0.1, 0.2, 0.3", "nan"), r"the reflectance of .* shape lamp is nan, nan, nan"),
    "negative specular": (
        xml('<float name="roughness" value="0.4"/>', '<float name="specular" value="-0.5"/>'),
        r"the specular of bsdf paint of shape floor is -0\.5"),
    "two BSDFs": (xml('<ref id="paint"/>', '<ref id="paint"/><bsdf type="diffuse"/>'), r"floor has more than one bsdf"),
    "depth of words": (
        xml('<integer name="rr_depth" value="4"/>', '<string name="rr_depth" value="x"/>'), r"rr_depth x, .*integer"),
    "index -1": (ply(index=(0, 1, -1)), r"floor\.ply: face 0 names vertex -1, of 3"),
    "index 2e9": (ply(index=(0, 1, 2 * 10**9)), r"floor\.ply: face 0 names vertex 2000000000, of 3"),
    "index 4e9": (ply("binary_big_endian", (0, 1, 4 * 10**9), kind="uint"), r"names vertex 4000000000, of 3"),
    "index -1 in text": (ply("ascii", (0, 1, -1)), r"floor\.ply: face 0 names vertex -1, of 3"),
    "index 2e9 in text": (ply("ascii", (0, 1, 2 * 10**9)), r"floor\.ply: face 0 names vertex 2000000000"),
    "a quad": (ply(index=(0, 1, 2, 0), count=4), r"floor\.ply: face 0 has 4 corners; only triangles"),
    "a quad in text": (ply("ascii", (0, 1, 2, 0), count=4), r"floor\.ply: face 0 has 4 corners; only triangles"),
    "cut": (ply(cut=-5), r"floor\.ply: its header says 1 faces, but 0 are there"),
    "too many vertices": (ply(vertices=10**12), r"floor\.ply: its header says 1000000000000 vertices, but"),
    "10^30 vertices": (ply(vertices=10**30), r"floor\.ply: its PLY header has the line"),
    "no vertices": (ply("ascii", vertices=0), r"floor\.ply: it has no vertices"),
    "coordinates of 3e38": (ply(corner=3e38), r"floor\.ply: coordinate x of its vertices is 3e\+38, 1, 0"),
    "coordinates of infinity": (ply("ascii", corner=np.inf), r"floor\.ply: coordinate x of its vertices is inf"),
    "noise as PLY": (written("meshes/floor.ply", np.random.default_rng(0).bytes(3000)), r"it is not a PLY file"),
    "words in PLY": (written("meshes/floor.ply", PLY.format(faces=2) + "a" + FACES), r"something else than numbers"),
    "obj 2e9": (triangle("1 2 2000000000"), r"floor\.obj: shape floor: .*invalid vertex"),
    "obj of words": (triangle("a b c"), r"floor\.obj: line 4 is 'f a b c'"),
    "obj from the end": (triangle("-3 -2 -1"), r"floor\.obj: line 4 is 'f -3 -2 -1'"),
    "serialized 2e9": (serialized((0, 1, 2 * 10**9)), r"floor\.serialized: face 0 names vertex 2000000000, of 3"),
    "deep": (xml("<ref", '<bsdf type="twosided">' * 10**5 + "</bsdf>" * 10**5 + "<ref"), r"nested more than 64 levels"),
    "laughs": (written("scene.xml", f'<!DOCTYPE a [<!ENTITY b "c">]>{XML}'), r"scene\.xml: it defines entities"),
    "includes itself": (xml("</scene>", '<include filename="scene.xml"/></scene>'), r"which includes it again"),
    "an encoding that is not declared": (written("scene.xml", XML.replace("lamp", "l\xe4mp").encode("latin-1")),
                                         r"scene\.xml: it is not well-formed XML"),
    "a pipe as photograph": (pipe(IMAGES), r"train_1\.exr: it is a named pipe"),
    "a pipe as scene": (pipe("scene.xml"), r"scene\.xml: it is a named pipe"),
    "a pipe as texture": (pipe("textures/paint.png"), r"paint\.png: it is a named pipe"),
    "200 000 pixels": (window(IMAGES, b"displayWindow", 200000), r"train_1\.exr: it says that it has 200000 x 200000"),
    "60 000 pixels": (window(IMAGES, b"dataWindow", 60000), r"train_1\.exr: "),
    "200 000 texels": (said_size(200000, 200000), r"paint\.png: it says that it has 200000 x 200000 pixels"),
    "cut hdr": (lambda f: (envmap(name="a.hdr")(f), written("a.hdr", HDR)(f)), r"a\.hdr: it ends before its 4 x 2"),
    "huge hdr": (lambda f: (envmap(name="a.hdr")(f), written("a.hdr", HDR.replace(b"2", b"9" * 99))(f)), r"a\.hdr: "),
    "noise as hdr": (lambda f: (envmap(name="a.hdr")(f), written("a.hdr", b"x" * 99)(f)), r"a\.hdr: it is not a Rad"),
    "cut pfm": (lambda f: (envmap(name="a.pfm")(f), written("a.pfm", b"PF\n4 2\n-1\n0")(f)), r"a\.pfm: it ends before"),
    "angle 1e400": (top('"camera_angle_x": 1e400'), r"camera_angle_x is inf, which has to be a number from 0\.0001"),
    "angle 10^400": (top(f'"camera_angle_x": 1{"0" * 400}'), r"camera_angle_x is 1000.*0, which has to be"),
    "angle as text": (top('"camera_angle_x": "0.9"'), r"camera_angle_x is '0\.9', not a number"),
    "nested brackets": (written("transforms_train.json", "[" * 10**5), r"transforms_train\.json: it is nested too"),
    "a key twice": (top('"camera_angle_x": 0.8, "camera_angle_x": 0.9'), r"has the key 'camera_angle_x' twice"),
    "matrix of text": (frame(transform_matrix=[["1"] * 4] * 4), r"row 1, column 1 is '1', not a number"),
    "a name of 300 letters": (frame(file_path="x" * 300), r"longer than the file system allows"),
    "a surrogate": (frame(file_path="\ud800"), r"\\ud800\.exr: its name has characters"),
    "a NUL": (frame(file_path="a\0b"), r"a\\x00b\.exr: its name has a NUL"),
    "pixels of 1e30": (photographs(1e30), r"train_0\.exr: it has pixels above 1e\+18 \(64 of 64"),
    "NaN pixels": (photographs(np.nan), r"train_0\.exr: .*NaN or infinite \(64 of 64\)"),
    "alpha 2": (photographs(2.0, 4), r"train_0\.exr: its alpha is up to 2"),
    "dim photographs": (every_pixel(1e-30), r"scene room: the training photographs are too dim .*up to 1e-30"),
    "black photographs": (every_pixel(0.0), r"scene room: every training photograph is black"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_hostile_files_get_one_sentence(tmp_path, case, capfd):
    folder = write_scene(tmp_path / "room")
    spoil, said = BAD[case]
    spoil(folder)
    with pytest.raises(InputError, match=said) as caught:
        SceneData(DataSettings(str(folder), None)).setup("fit")
    assert "\n" not in str(caught.value)
    several = re.match(r"(\d+) things stand in the way", str(caught.value))
    assert len(str(caught.value)) < 500 * (int(several[1]) if several else 1)
    assert capfd.readouterr() == ("", "")


ROOM = ("--data.scene", "null", "--data.root", "room", "--trainer.max_steps", "1")


@pytest.mark.main
def test_a_broken_photograph_gets_one_line(tiny, capfd):
    """EXR's library prints lines of its own."""
    folder = write_scene(tiny / "room")
    pixels = np.random.default_rng(0).random((64, 64, 3), np.float32)
    write_exr(folder / IMAGES, pixels)
    whole = (folder / IMAGES).read_bytes()
    (folder / IMAGES).write_bytes(whole[: len(whole) // 2])
    said = fails(capfd, "fit", "--config", "tiny.yaml", *ROOM)
    assert said.endswith("train_1.exr: it cannot be read as an EXR image")


@pytest.mark.main
def test_light_that_is_no_number_gets_one_line(tiny, capfd):
    folder = write_scene(tiny / "room")
    radiance("inf")(folder)
    said = fails(capfd, "fit", "--config", "tiny.yaml", *ROOM)
    assert "the radiance of the area light of shape lamp is inf, inf, inf" in said


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["int", "uint"])
def test_good_ply_files_are_read(tmp_path, form, kind):
    folder = write_scene(tmp_path / "room")
    ply(form, kind=kind)(folder)
    assert load_scene(str(folder), None).meshes[0].faces.tolist() == [[0, 1, 2]]


def test_good_files_of_other_kinds_are_read(tmp_path):
    for number, spoil in enumerate((triangle("1 2 3"), triangle("1/ 2// 3 # end"), serialized((0, 1, 2)))):
        folder = write_scene(tmp_path / str(number))
        spoil(folder)
        assert load_scene(str(folder), None).meshes[0].faces.tolist() == [[0, 1, 2]]
    folder = write_scene(tmp_path / "hdr")
    envmap(name="a.hdr")(folder)
    written("a.hdr", HDR + bytes([128, 128, 128, 129] * 8))(folder)
    np.testing.assert_array_equal(load_scene(str(folder), None).environment.pixels, np.ones((2, 4, 3)))


def test_large_textures_are_read(tmp_path, monkeypatch):
    """More pixels than Pillow opens by itself, and more than are decoded at once."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    monkeypatch.setattr("neurad.images.image_io._ROWS", 64)
    pixels = np.random.default_rng(0).integers(0, 256, (41, 23, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(pixels[..., 0]).save(tmp_path / "b.png")
    np.testing.assert_array_equal(read_bitmap(tmp_path / "a.png", raw=True), pixels / np.float32(255.0))
    np.testing.assert_array_equal(read_bitmap(tmp_path / "b.png", raw=True)[..., 0], pixels[..., 0] / np.float32(255.0))
