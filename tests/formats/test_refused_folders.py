"""Scene folders with broken or hostile files: one sentence each, never a crash, and never a wrong result.

One table: a name, the change of a correct folder, and what is said.
"""

import io
import os
import re
import struct
import zlib

import numpy as np
import pytest
from helpers.spoil import (
    PNG,
    as_floor,
    beside,
    both,
    frame,
    inside,
    photograph,
    photographs,
    removed,
    replaced,
    set_paint,
    top,
    written,
    xml,
)  # fmt: skip
from helpers.tiny_fit import fails
from helpers.tiny_scene import PLY, POSE, XML, write_scene
from PIL import Image

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.core.errors import InputError
from neurad.formats.load import load_scene
from neurad.images.image_io import read_bitmap, write_exr

pytest.importorskip("mitsuba")

LIGHT = '<rgb name="radiance" value="1, 2, 3"/>'
PAPER = '<rgb name="reflectance" value="0.1, 0.2, 0.3"/>'
FACES = "3 0 1 2\n3 0 2 3\n"
AT = '<point name="position" x="1" y="2" z="3"/>'
MOVED = '<transform name="to_world"><translate x="1"/></transform>'
WIDE = '<transform name="to_world"><scale x="2"/></transform>'
TURNED = '<transform name="to_world"><rotate x="1" angle="90"/></transform>'


def radiance(value, kind="rgb"):
    return xml(LIGHT, f'<{kind} name="radiance" value="{value}"/>')


def environment(plugin, inside, pixels=1.0):
    def spoil(folder):
        write_exr(folder / "sky.exr", np.full((2, 4, 3), pixels, np.float32), half=False)
        xml("</scene>", f'<emitter type="{plugin}">{inside}</emitter></scene>')(folder)

    return spoil


def added(elements):
    """More elements of the scene."""
    return xml("</scene>", f"{elements}</scene>")


def emitter(kind, inside):
    return f'<emitter type="{kind}" id="bulb">{inside}</emitter>'


def setting(name, value):
    return f'<float name="{name}" value="{value}"/>'


def bitmap(file, more="", kind="bitmap"):
    return f'<texture type="{kind}" name="radiance"><string name="filename" value="{file}"/>{more}</texture>'


def shining(radiance):
    """The lamp shines by this, and two pictures are there."""

    def spoil(folder):
        for name, value in (("nan", np.nan), ("dark", 0.0)):
            write_exr(folder / f"{name}.exr", np.full((2, 2, 3), value, np.float32))
        xml(LIGHT, radiance)(folder)

    return spoil


def metallic(value):
    """The floor's metalness is a picture of this value."""

    def spoil(folder):
        write_exr(folder / "metal.exr", np.full((2, 2, 1), value, np.float32))
        inside = '<string name="filename" value="metal.exr"/><boolean name="raw" value="true"/>'
        set_paint(f'<texture type="bitmap" name="metallic">{inside}</texture>')(folder)

    return spoil


def envmap(inside="", pixels=1.0, name="sky.exr"):
    return environment("envmap", f'<string name="filename" value="{name}"/>{inside}', pixels)


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


def encoded(picture):
    """The bytes of a PNG file."""
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def pipe(name):
    def spoil(folder):
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return spoil


GREY = encoded(Image.new("L", (9, 6)))
HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 4\n"
IMAGES = "images/train_1.exr"


def angle(text):
    return replaced("transforms_train.json", '"camera_angle_x": 0.9', text)


def mask(data):
    """Name a mask and write it."""
    return both(frame(mask_path="masks/a.png"), written("masks/a.png", data))


def pose(rotation):
    matrix = np.array(POSE)
    matrix[:3, :3] = rotation
    return matrix.tolist()


BAD = {
    # what is missing, and camera files
    "no scene.xml": (removed("scene.xml"), r"scene\.xml: the scene folder lacks"),
    "no camera file": (removed("transforms_train.json"), r"train\.json: .* lacks this file \(or transforms\.json\)"),
    "broken json": (written("transforms_train.json", "{"), r"transforms_train\.json: it is not valid JSON"),
    "no frames": (top(frames=[]), r"transforms_train\.json: it has no frames"),
    "frame without file": (frame(file_path=...), r"frame 1 has no file_path"),
    "frame listed twice": (frame(file_path="images/train_0.exr"), r"frame 1 .*is also that of frame 0"),
    "frame without name": (frame(file_path="/"), r"its file_path '/' is not the name of a file"),
    "no photograph": (removed("images/train_1.exr"), r"images/train_1\.exr: the photograph is missing"),
    "no matrix": (frame(transform_matrix=...), r"frame 1 \(images/train_1\.exr\): its transform_matrix is missing"),
    "matrix of words": (frame(transform_matrix="abc"), r"frame 1 .*transform_matrix is not 4 x 4 numbers"),
    "NaN in matrix": (frame(transform_matrix=pose(np.full((3, 3), np.nan))), r"frame 1 .*row 1, column 1 is nan"),
    "scaled matrix": (frame(transform_matrix=pose(np.eye(3) * 1.01)), r"frame 1 .*not rigid"),
    "no angle": (top(camera_angle_x=...), r"neither camera_angle_x nor fl_x"),
    "bad size": (top(w=0), r"w is 0, which has to be a number from 1"),
    "half a size": (frame(w=16, h=None), r"frame 1 .*h is None, not a number"),
    "two focal lengths": (top(fl_x=20.0), r"fl_x is 20, but by camera_angle_x it is 8\.28"),
    "no focal length": (top(camera_angle_x=..., fl_x=0), r"frame 0 .*fl_x is 0"),
    "negative fl_y": (frame(fl_y=-5.0), r"frame 1 .*fl_y is -5, which has to be a number from 0"),
    "NaN in a lens": (frame(k1=float("nan")), r"frame 1 .*k1 is nan, which has to be a number"),
    "a word in a lens": (frame(cx="middle"), r"frame 1 .*cx is 'middle', not a number"),
    "picture that folds over": (frame(k1=-3.0), r"frame 1 .*distortion \(k1 -3\) folds over inside the picture"),
    "unknown model": (top(camera_model="EQUIRECTANGULAR"), r"camera_model is 'EQUIRECTANGULAR', which is not one of"),
    "model that is no name": (top(camera_model=3), r"camera_model is 3, not a name"),
    "coefficient of another model": (top(k4=0.1), r"k4 is 0\.1, but a camera of model OPENCV has none"),
    "no mask": (frame(mask_path="masks/a.png"), r"masks/a\.png: the mask is missing that transforms_train\.json lists"),
    "mask that is no name": (frame(mask_path=3), r"mask_path is 3, not the name of a file"),
    "no mesh": (removed("meshes/floor.ply"), r"meshes/floor\.ply: the mesh of shape floor in scene\.xml is missing"),
    "empty mesh": (written("meshes/floor.ply", PLY.format(faces=0)), r"mesh floor is empty"),
    "NaN vertex": (ply(corner=np.nan), r"floor\.ply: coordinate x of its vertices is nan, 1, 0"),
    "no texture": (removed("textures/paint.png"), r"paint\.png: there is no such texture file"),
    "metalness above 1": (metallic(1.5), r"metal\.exr: metallic is 1\.5, .* from 0 to 1"),
    "metalness below 0": (metallic(-0.5), r"metal\.exr: metallic is -0\.5, "),
    "metalness NaN": (metallic(np.nan), r"metal\.exr: metallic is nan, "),
    "metalness of 2": (set_paint('<float name="metallic" value="2"/>'), r"the metallic of .*paint"),
    "broken texture": (written("textures/paint.png", "no picture"), r"paint\.png: it cannot be read"),
    "unknown reference": (xml('ref id="paint"', 'ref id="pain"'), r"unresolved reference to .pain"),
    "hair": (xml('shape type="rectangle"', 'shape type="bsplinecurve"'), r"lamp has type bspline"),
    "opacity mask": (inside("mask"), r"bsdf paint of shape floor has type mask, .* lets light through"),
    "transparent by a texture": (set_paint(PNG.format("spec_trans")), r"bsdf paint of shape floor sets spec_trans"),
    "glass that is rough": (beside('<bsdf type="roughdielectric"/>'), r"paint of shape floor has type roughdielectric"),
    "a mirror on one side": (
        beside('<bsdf type="conductor"/>'), r"bsdf paint of shape floor is twosided with 2 BSDFs"),
    "textured mirror": (as_floor(f'<bsdf type="conductor">{PNG.format("eta")}</bsdf>'), r"the eta of .* is textured"),
    "mirror of no metal": (
        as_floor('<bsdf type="twosided"><bsdf type="conductor"><string name="material" value="Xx"/></bsdf></bsdf>'),
        r"parameters that Mitsuba does not accept"),
    "no depth": (xml('value="6"', 'value="0"'), r"scene\.xml: its integrator has max_depth 0"),
    "roulette before the first bounce": (
        xml('"rr_depth" value="4"', '"rr_depth" value="0"'), r"its integrator has rr_depth 0"),
    "bumpy mirror": (
        as_floor(f'<bsdf type="normalmap"><bsdf type="conductor"/>{PNG.format("normalmap")}</bsdf>'),
        r"is a normalmap on a smooth surface"),
    "no attribute": (
        xml('<float name="roughness" value="0.4"/>',
                 '<texture type="mesh_attribute" name="roughness"><string name="name" value="vertex_r"/></texture>'),
        r"shape floor has no vertex attribute vertex_r"),
    # lights of scene.xml: without extent, daylight, and pictures
    "light: negative": (
        added(emitter("point", '<rgb name="intensity" value="1,-2,3"/>')), r"of the point emitter bulb is 1, -2"),
    "light: nowhere": (
        added(emitter("directional", '<vector name="direction" value="0,0,0"/>')), r"is 0, 0, 0, which points nowhere"),
    "light: far away": (
        added(emitter("point", '<point name="position" x="1e40" y="0" z="0"/>')), r"its position is inf, 0, 0"),
    "light: half sphere": (
        added(emitter("spot", setting("cutoff_angle", 90))), r"cutoff_angle is 90, which has to be between 0 and 90"),
    "light: no cone": (
        added(emitter("spot", setting("cutoff_angle", 0))), r"its cutoff_angle is 0, which has to be between 0 and 90"),
    "light: wide beam": (
        added(emitter("spot", setting("beam_width", 21))), r"its beam_width is 21, .* from 0 to its cutoff_angle, 20"),
    "light: negative beam": (
        added(emitter("spot", setting("beam_width", -1))), r"its beam_width is -1, .* from 0 to its cutoff_angle"),
    "light: angle that is a text": (
        added(emitter("spot", '<string name="beam_width" value="x"/>')), r"beam_width is not a number"),
    "light: not round": (added(emitter("spot", WIDE)), r"its to_world stretches it, and its cone would not be round"),
    "light: flat": (
        added(emitter("spot", WIDE.replace('"2"', '"0"'))), r"of the spot emitter bulb is not a transform that"),
    "light: two places": (added(emitter("point", AT + MOVED)), r"it has both position and to_world; give one of them"),
    "light: a texture": (
        added(emitter("spot", '<texture type="checkerboard" name="texture"/>')), r"texture of the spot emitter"),
    "light: other settings": (
        added(emitter("point", setting("radius", 2))), r"sets radius, which is not supported; there are: int"),
    "two environments": (
        added('<emitter type="constant"/><emitter type="constant"/>'), r"more than one environment emitter"),
    "a projector": (
        added('<emitter type="projector"/>'), r"type projector is not supported; there are: area, .*, point, spot"),
    "daylight: night": (
        added(emitter("sunsky", '<float name="hour" value="1"/>')), r"its sun is 29\.5 degrees below the horizon"),
    "daylight: nowhere": (
        added(emitter("sunsky", '<vector name="sun_direction" x="0" y="0" z="0"/>')), r"three numbers that point any"),
    "daylight: a text": (
        added(emitter("sunsky", '<string name="sun_direction" value="up"/>')), r"three numbers that point anywhere"),
    "daylight: two suns": (
        added(emitter("sunsky", '<vector name="sun_direction" x="0" y="0" z="1"/><float name="hour" value="9"/>')),
        r"it has both sun_direction and hour; give one of them"),
    "daylight: murky": (
        added(emitter("sunsky", '<float name="turbidity" value="11"/>')), r"the sunsky: Turbidity value 11"),
    "daylight: negative": (added(emitter("sky", '<float name="scale" value="-1"/>')), r"the sky: its scale is -1"),
    "daylight: unknown": (
        added(emitter("sunsky", '<float name="stretch" value="1.5"/>')), r"the sunsky sets stretch, which is not sup"),
    "daylight: ground": (
        added(emitter("sunsky", '<rgb name="albedo" value="2,3,4"/>')), r"albedo of the sunsky is not a colour in"),
    "daylight: textured": (
        added(emitter("sunsky", '<texture type="bitmap" name="albedo"/>')), r"albedo of the sunsky has no filename"),
    "daylight: stretched": (
        added(emitter("sunsky", '<transform name="to_world"><scale x="2"/></transform>')),
        r"sunsky has to be a rotation"),
    "daylight: two skies": (
        added(emitter("sky", TURNED) + '<emitter type="sun"/>'),
        r"it has more than one environment emitter"),
    "picture: missing": (shining(bitmap("fehlt.exr")), r"fehlt.exr: there is no such"),
    "picture: another kind": (shining(bitmap("x", kind="checkerboard")), r"of shape lamp is a texture of type"),
    "picture: NaN": (shining(bitmap("nan.exr")), r"nan.exr: radiance"),
    "picture: wrap": (
        shining(bitmap("dark.exr", '<string name="wrap_mode" value="clamp"/>')), r"sets wrap_mode, which is not"),
    "picture: other settings": (
        shining(bitmap("dark.exr") + '<float name="scale" value="2"/>'), r"sets scale, which is not supported"),
    # values, sizes and broken files
    "radiance inf": (radiance("inf"), r"scene\.xml: the radiance of the area light of shape lamp is inf, inf, inf"),
    "negative radiance": (radiance("1, -1, 1"), r"the radiance of the area light of shape lamp is 1, -1, 1"),
    "radiance of words": (radiance("x", "string"), r"the radiance of the area light of shape lamp is not a colour"),
    "a scale for a light": (xml(LIGHT, LIGHT + '<float name="scale" value="2"/>'), r"shape lamp sets scale"),
    "constant NaN": (environment("constant", '<rgb name="radiance" value="nan"/>'), r"of the constant emitter is nan"),
    "scale of a constant": (environment("constant", '<float name="scale" value="-1"/>'), r"emitter sets scale"),
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
    "index 4e9": (ply("binary_big_endian", (0, 1, 4 * 10**9), kind="uint"), r"names vertex 4000000000, of 3"),
    "index -1 in text": (ply("ascii", (0, 1, -1)), r"floor\.ply: face 0 names vertex -1, of 3"),
    "a quad": (ply(index=(0, 1, 2, 0), count=4), r"floor\.ply: face 0 has 4 corners; only triangles"),
    "cut": (ply(cut=-5), r"floor\.ply: its header says 1 faces, but 0 are there"),
    "too many vertices": (ply(vertices=10**12), r"floor\.ply: its header says 1000000000000 vertices, but"),
    "10^30 vertices": (ply(vertices=10**30), r"floor\.ply: its PLY header has the line"),
    "no vertices": (ply("ascii", vertices=0), r"floor\.ply: it has no vertices"),
    "noise as PLY": (written("meshes/floor.ply", np.random.default_rng(0).bytes(3000)), r"it is not a PLY file"),
    "words in PLY": (written("meshes/floor.ply", PLY.format(faces=2) + "a" + FACES), r"something else than numbers"),
    "obj 2e9": (triangle("1 2 2000000000"), r"floor\.obj: shape floor: .*invalid vertex"),
    "obj of words": (triangle("a b c"), r"floor\.obj: line 4 is 'f a b c'"),
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
    "cut hdr": (both(envmap(name="a.hdr"), written("a.hdr", HDR)), r"a\.hdr: it ends before its 4 x 2"),
    "huge hdr": (both(envmap(name="a.hdr"), written("a.hdr", HDR.replace(b"2", b"9" * 99))), r"a\.hdr: "),
    "noise as hdr": (both(envmap(name="a.hdr"), written("a.hdr", b"x" * 99)), r"a\.hdr: it is not a Rad"),
    "cut pfm": (both(envmap(name="a.pfm"), written("a.pfm", b"PF\n4 2\n-1\n0")), r"a\.pfm: it ends before"),
    "angle 10^400": (angle(f'"camera_angle_x": 1{"0" * 400}'), r"camera_angle_x is 1000.*0, which has to be"),
    "angle as text": (angle('"camera_angle_x": "0.9"'), r"camera_angle_x is '0\.9', not a number"),
    "nested brackets": (written("transforms_train.json", "[" * 10**5), r"transforms_train\.json: it is nested too"),
    "a key twice": (angle('"camera_angle_x": 0.8, "camera_angle_x": 0.9'), r"has the key 'camera_angle_x' twice"),
    "matrix of text": (frame(transform_matrix=[["1"] * 4] * 4), r"row 1, column 1 is '1', not a number"),
    "a name of 300 letters": (frame(file_path="x" * 300), r"longer than the file system allows"),
    "a surrogate": (frame(file_path="\ud800"), r"\\ud800\.exr: its name has characters"),
    "a NUL": (frame(file_path="a\0b"), r"a\\x00b\.exr: its name has a NUL"),
    "pixels of 1e30": (photographs(1e30), r"train_0\.exr: it has pixels above 1e\+18 \(64 of 64"),
    "NaN pixels": (photographs(np.nan), r"train_0\.exr: .*NaN or infinite \(64 of 64\)"),
    "infinite pixel": (photograph(np.inf), r"train_1\.exr: it has pixels that are NaN or infinite"),
    "negative pixel": (photograph(-1.0), r"train_1\.exr: it has negative pixels"),
    "another size": (photograph(height=9), r"train_1\.exr: it has 8 x 9 pixels, its camera 8 x 8"),
    "another film": (frame(w=16, h=8), r"train_1\.exr: it has 8 x 8 pixels, its camera 16 x 8.*w and h"),
    "grey": (photograph(channels=1), r"train_1\.exr: a photograph has channels RGB or RGBA"),
    "no photograph but text": (written(IMAGES, "x"), r"train_1\.exr: it cannot be read as an EXR image"),
    "an empty photograph": (written(IMAGES, ""), r"train_1\.exr: it cannot be read"),
    "a mask of another size": (mask(GREY), r"masks/a\.png: it has 9 x 6 pixels, its camera 8 x 8"),
    "alpha 2": (photographs(2.0, 4), r"train_0\.exr: its alpha is up to 2"),
    "dim photographs": (photographs(1e-30), r"scene room: the training photographs are too dim .*up to 1e-30"),
    "black photographs": (photographs(0.0), r"scene room: every training photograph is black"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_folders_get_one_sentence(tmp_path, case, capfd):
    folder = write_scene(tmp_path / "room")
    spoil, said = BAD[case]
    spoil(folder)
    with pytest.raises(InputError, match=said) as caught:
        SceneData(DataSettings(str(folder), None)).setup("fit")
    assert "\n" not in str(caught.value)
    several = re.match(r"(\d+) things stand in the way", str(caught.value))
    assert len(str(caught.value)) < 500 * (int(several[1]) if several else 1)
    assert capfd.readouterr() == ("", "")


def test_a_broken_photograph_gets_one_line(tiny, capfd):
    """EXR's library prints lines of its own."""
    folder = write_scene(tiny / "room")
    pixels = np.random.default_rng(0).random((64, 64, 3), np.float32)
    write_exr(folder / IMAGES, pixels)
    whole = (folder / IMAGES).read_bytes()
    (folder / IMAGES).write_bytes(whole[: len(whole) // 2])
    room = ["--data.scene=null", "--data.root=room", "--trainer.max_steps=1"]
    said = fails(capfd, "fit", "--config", "tiny.yaml", *room)
    assert said.endswith("train_1.exr: it cannot be read as an EXR image")


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
    monkeypatch.setattr("neurad.images.image_io._AT_ONCE", 64)
    pixels = np.random.default_rng(0).integers(0, 256, (41, 23, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    Image.fromarray(pixels[..., 0]).save(tmp_path / "b.png")
    np.testing.assert_array_equal(read_bitmap(tmp_path / "a.png", raw=True), pixels / np.float32(255.0))
    np.testing.assert_array_equal(read_bitmap(tmp_path / "b.png", raw=True)[..., 0], pixels[..., 0] / np.float32(255.0))
