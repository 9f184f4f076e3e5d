"""Mutations of scene.xml."""

import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from copy import deepcopy

from helpers.fuzzing.odd import NAMES, NUMBERS, WORDS, pick
from helpers.fuzzing.seeds import Files

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
    """One number of a value."""
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


XML = {f.__name__: f for f in (xml_number, xml_change, xml_move, xml_insert)}
