"""Every mutation of a scene folder by name: of scene.xml, of images where something of their form stays, and of camera
files; and a scene folder from a recipe.
"""

import io
import json
import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from helpers.fuzzing.odd import FLOATS, JSON, NAMES, NUMBERS, WORDS, change, pick
from helpers.fuzzing.seeds import VARIANTS, Files, seed_files
from helpers.fuzzing.spoil_bytes import GENERAL, write_files

# ---- scene.xml

SNIPPETS = (
    '<shape type="obj"><string name="filename" value="meshes/floor.ply"/></shape>',
    '<shape type="serialized"><string name="filename" value="scene.xml"/></shape>',
    '<shape type="shapegroup"><shape type="cube"/></shape>', '<shape type="merge"><shape type="cube"/></shape>',
    '<shape type="cube"><emitter type="area"><rgb name="radiance" value="NaN"/></emitter></shape>',
    '<shape type="cube"><emitter type="area"><spectrum name="radiance" value="400:1, 700:2"/></emitter></shape>',
    '<shape type="cube"><emitter type="area"><texture type="checkerboard" name="radiance"/></emitter></shape>',
    '<bsdf type="mask"><bsdf type="diffuse"/></bsdf>', '<bsdf type="bumpmap"><bsdf type="diffuse"/></bsdf>',
    '<bsdf type="roughconductor"><spectrum name="eta" filename="nothing.spd"/></bsdf>',
    '<bsdf type="normalmap"><texture type="bitmap" name="normalmap"/><bsdf type="diffuse"/></bsdf>',
    '<emitter type="constant"><float name="radiance" value="1e400"/></emitter>', '<include filename="scene.xml"/>',
    '<include filename="nothing.xml"/>', '<alias id="paint" as="x"/>', '<default name="depth" value="-7"/>',
    '<path value="/"/>', '<ref id="paint"/>', '<ref id="nothing"/>', "<scene/>", "<nonsense/>", "<!-- comment -->",
    '<rgb value="1e400, NaN, -1"/>', '<rgb name="radiance" value="#ff00zz"/>', '<float name="roughness" value="-1"/>',
    '<rgb name="base_color" value="2, 3, 4"/>', '<float name="alpha" value="0"/>',
    '<boolean name="flip_normals" value="perhaps"/>', '<string name="filename" value=""/>',
    '<blackbody name="radiance" temperature="5000"/>', '<transform name="to_world"><scale value="0"/></transform>',
    '<transform name="to_world"><matrix value="1 2 3"/></transform>',
    '<transform name="to_world"><matrix value="0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"/></transform>',
    '<transform name="to_world"><rotate angle="90"/></transform>',
    '<transform name="to_world"><lookat origin="0,0,0" target="0,0,0" up="0,0,0"/></transform>',
    '<transform name="to_uv"><scale value="1e30"/></transform>', '<texture type="volume" name="base_color"/>',
    '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="-1"/></film></sensor>',
    '<integrator type="path"><integer name="rr_depth" value="99999999999"/></integrator>',
    *(f'<{tag} type="{kind}"/>' for tag, kinds in {
        "shape": "sphere cube rectangle disk ply instance", "integrator": "nothing", "medium": "homogeneous",
        "bsdf": "principled null blendbsdf thindielectric measured plastic twosided hair", "volume": "gridvolume",
        "emitter": "constant envmap point sunsky",
    }.items() for kind in kinds.split()),
)  # fmt: skip
TYPES = (
    "ply", "obj", "cube", "rectangle", "sphere", "serialized", "diffuse", "principled", "roughplastic",
    "roughconductor", "conductor", "dielectric", "roughdielectric", "twosided", "blendbsdf", "bumpmap", "mask",
    "plastic", "area", "constant", "envmap", "point", "directional", "bitmap", "mesh_attribute", "checkerboard",
    "path", "volpath", "", "nothing", "../x",
)  # fmt: skip
TAGS = (
    "float", "integer", "string", "boolean", "rgb", "spectrum", "point", "vector", "ref", "shape", "bsdf", "texture",
)  # fmt: skip
NUMBER = re.compile(r"[-+]?[\d.]+(?:e[-+]?\d+)?", re.IGNORECASE)
MAIN = "scene.xml"


def _changes(change):  # a mutation of the tree as one of the files
    def changed(files: Files, i: int, j: int, k: int) -> None:
        try:
            tree = ET.fromstring(files[MAIN])
        except (ET.ParseError, LookupError, ValueError):
            return  # an earlier mutation has broken it
        change(tree, i, j, k)
        with suppress(RecursionError):  # deeper than it can be written
            files[MAIN] = ET.tostring(tree, "unicode").encode("utf-8", "surrogatepass")

    changed.__name__ = change.__name__
    return changed


@_changes
def xml_change(tree, i, j, k):
    """A value, a name, a type or an id of an element, or its tag, is another one or is not there."""
    node = pick(list(tree.iter()), i)
    key = pick([*node.attrib, "tag"], j)
    others = [other.get(key) for other in tree.iter() if other.get(key)]
    if key == "tag":
        node.tag = pick(TAGS, k)
    elif k % 7 == 0:
        del node.attrib[key]
    elif key == "value" and node.get("name") == "filename":
        node.set(key, pick(NAMES, k // 7))
    else:
        node.set(key, pick(TYPES if key == "type" else others if k % 3 else NUMBERS + WORDS, k // 7))


@_changes
def xml_number(tree, i, j, k):
    keys = [(node, key) for node in tree.iter() for key in node.attrib if key not in ("version", "name", "type", "id")]
    found = [(node, key) for node, key in keys if NUMBER.search(node.get(key))]
    if found:
        node, key = pick(found, i)
        text = node.get(key)
        place = pick(list(NUMBER.finditer(text)), j)
        node.set(key, text[: place.start()] + pick(NUMBERS, k) + text[place.end() :])


@_changes
def xml_move(tree, i, j, k):
    """An element less, once more, or in another place."""
    places = [(parent, place) for parent in tree.iter() for place in range(len(parent))]
    if places:
        parent, place = pick(places, i)
        if k % 3 == 0:
            del parent[place]
        else:
            (parent if k % 3 == 1 else pick(list(tree.iter()), j)).append(deepcopy(parent[place]))


@_changes
def xml_insert(tree, i, j, k):
    """Something new, at the top or anywhere."""
    target = tree if k % 2 else pick(list(tree.iter()), i)
    snippet = ET.fromstring(f"<x>{pick(SNIPPETS, j)}</x>")
    for place, new in enumerate(snippet):
        target.insert(place if k % 4 > 1 else len(target), new)


# ---- images

CHANNELS = (
    ("R", "G", "B"), ("R", "G", "B", "A"), ("Y",), ("Z",), ("R", "G"), ("B", "A"), ("R", "G", "B", "A", "Z"),
    ("x.R", "x.G", "x.B"), ("a.R", "b.G", "c.B"), ("r", "g", "b"), ("X" * 200,), ("R", "G", "B", "Y"), ("",), ("é",),
    ("Y", "RY", "BY"),
)  # fmt: skip
MODES = (
    ("1", "PNG"), ("L", "PNG"), ("LA", "PNG"), ("P", "PNG"), ("RGB", "PNG"), ("RGBA", "PNG"), ("I;16", "PNG"),
    ("I", "TIFF"), ("F", "TIFF"), ("CMYK", "JPEG"), ("RGB", "GIF"), ("RGB", "BMP"), ("RGB", "TGA"), ("RGB", "JPEG"),
    ("RGB", "WEBP"), ("YCbCr", "TIFF"), ("LAB", "TIFF"), ("RGB", "PPM"), ("RGB", "PDF"), ("RGB", "ICO"),
)  # fmt: skip
SIZES = ((8, 8), (4, 8), (1, 1), (8, 9), (300, 1), (64, 64))


def names_of(files: Files, endings: str | tuple[str, ...]) -> list[str]:
    """Those of the files with one of the endings that are still there."""
    return sorted(n for n in files if n.endswith(endings) and not files[n].startswith(b"KIND "))


def exr_pixels(files: Files, i: int, j: int, k: int) -> None:
    """Odd values in one pixel, one channel or all of them; other channels, numbers of other types, another size."""
    names = names_of(files, ".exr")
    if not names:
        return
    name = pick(names, i)
    pixels = np.full((*pick(SIZES, k // 5), 3), 0.5, np.float32) if k % 2 else _pixels(files[name])
    if pixels is None:
        return
    rows, _, channels = pixels.shape
    where = pick((..., (..., k // 6 % channels), (k // 6 % rows, -1)), k)
    pixels[where] = pick(FLOATS, j)
    parts = pick(CHANNELS, k // 3) if k % 2 else {1: ("Y",), 3: ("R", "G", "B")}.get(channels, CHANNELS[1])
    kind = pick((np.float32, np.float32, np.float16, np.uint32), k // 7)
    with np.errstate(all="ignore"):
        files[name] = exr({n: pixels[..., c % channels].astype(kind) for c, n in enumerate(parts)})


def bitmap_kind(files: Files, i: int, j: int, k: int) -> None:
    """A picture of another kind, whatever its ending says."""
    from PIL import Image

    names, file = names_of(files, (".png", ".hdr", ".pfm", ".exr")), io.BytesIO()
    if names:
        mode, kind = pick(MODES, j)
        try:
            Image.new("L", pick(SIZES, k), 130).convert(mode).save(file, kind)
        except (OSError, ValueError, KeyError):
            return  # the library does not write such a thing
        files[pick(names, i)] = file.getvalue()


def _pixels(data: bytes) -> np.ndarray | None:
    from neurad.core.errors import InputError
    from neurad.images.image_io import read_exr

    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.exr"
        path.write_bytes(data)
        try:
            return np.array(read_exr(path), np.float32)
        except (InputError, ValueError, MemoryError):
            return None  # an earlier mutation has broken it


def exr(channels: dict[str, np.ndarray]) -> bytes:
    """An EXR file; empty where the library does not write such channels."""
    import OpenEXR

    with TemporaryDirectory() as folder:
        try:
            OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(f"{folder}/x.exr")
        except (RuntimeError, ValueError, TypeError, OSError, UnicodeError):
            return b""
        return Path(f"{folder}/x.exr").read_bytes()


# ---- camera files

KEYS = (
    "w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "k1", "p2", "frames", "file_path",
    "transform_matrix", "albedo_path", "roughness_path", "relight_path", "aabb_scale", "camera_model", "", "a" * 3000,
)  # fmt: skip
ODD = (*JSON, *map(json.dumps, NAMES))


def json_change(files: Files, i: int, j: int, k: int) -> None:
    """An odd value in a camera file, or the name of a file; an entry less, or more."""
    name = pick(sorted(n for n in files if n.endswith(".json")), i)
    try:
        document = json.loads(files[name])
    except (ValueError, RecursionError):
        return  # an earlier mutation has broken it
    change(document, j, k, "@@odd@@", KEYS)
    text = re.sub('"@@odd@@"', lambda _: pick(ODD, j // 7 + k), json.dumps(document))
    files[name] = text.encode("utf-8", "surrogatepass")


XML = (xml_number, xml_change, xml_move, xml_insert)
IMAGES = (exr_pixels, bitmap_kind)
MUTATIONS = {**GENERAL, **{f.__name__: f for f in (*XML, *IMAGES, json_change)}}
GROUPS = (
    [*(f.__name__ for f in XML), *["xml_number"] * 5, "xml_insert", "xml_insert", "xml_change"],
    [f.__name__ for f in IMAGES],
    ["json_change"],
    list(GENERAL),
)
"""Their names, those of one kind of file together; some of them more often than others."""


def write_spoilt(folder: Path, variant: int, mutations: list[list]) -> None:
    """Write the scene folder of a recipe.

    Args:
        folder: where; its parent exists.
        variant: of the correct folder to start from.
        mutations: name and three numbers of each.
    """
    files = dict(seed_files(variant % VARIANTS))
    for name, i, j, k in mutations:
        MUTATIONS[name](files, i, j, k)
    folder.mkdir()
    write_files(files, folder)
