"""Mutations of scene.xml."""

import re
import xml.etree.ElementTree as ET
from contextlib import suppress
from copy import deepcopy

from helpers.fuzzing.odd import NAMES, NUMBERS, WORDS, pick
from helpers.fuzzing.seeds import Files

SNIPPETS = (
    '<shape type="sphere"/>', '<shape type="cube"/>', '<shape type="rectangle"/>', '<shape type="disk"/>',
    '<shape type="ply"/>', '<shape type="obj"><string name="filename" value="meshes/floor.ply"/></shape>',
    '<shape type="serialized"><string name="filename" value="scene.xml"/></shape>', '<shape type="instance"/>',
    '<shape type="shapegroup"><shape type="cube"/></shape>', '<shape type="merge"><shape type="cube"/></shape>',
    '<shape type="cube"><emitter type="area"><rgb name="radiance" value="NaN"/></emitter></shape>',
    '<shape type="cube"><emitter type="area"><spectrum name="radiance" value="400:1, 700:2"/></emitter></shape>',
    '<shape type="cube"><emitter type="area"><texture type="checkerboard" name="radiance"/></emitter></shape>',
    '<bsdf type="principled"/>', '<bsdf type="mask"><bsdf type="diffuse"/></bsdf>', '<bsdf type="null"/>',
    '<bsdf type="bumpmap"><bsdf type="diffuse"/></bsdf>', '<bsdf type="blendbsdf"/>', '<bsdf type="thindielectric"/>',
    '<bsdf type="measured"/>', '<bsdf type="plastic"/>', '<bsdf type="twosided"/>', '<bsdf type="hair"/>',
    '<bsdf type="roughconductor"><spectrum name="eta" filename="nothing.spd"/></bsdf>',
    '<bsdf type="normalmap"><texture type="bitmap" name="normalmap"/><bsdf type="diffuse"/></bsdf>',
    '<emitter type="constant"/>', '<emitter type="envmap"/>', '<emitter type="point"/>', '<emitter type="sunsky"/>',
    '<emitter type="constant"><rgb name="radiance" value="-1"/></emitter>',
    '<emitter type="constant"><float name="radiance" value="1e400"/></emitter>', '<include filename="scene.xml"/>',
    '<include filename="nothing.xml"/>', '<include/>', '<alias id="paint" as="x"/>',
    '<default name="depth" value="-7"/>', '<default name="depth"/>', '<path value="/"/>', '<ref id="paint"/>',
    '<ref id="nothing"/>', '<ref/>', '<medium type="homogeneous"/>', '<volume type="gridvolume"/>', '<scene/>',
    '<rgb value="1e400, NaN, -1"/>', '<rgb name="radiance" value="1 2"/>', '<rgb name="radiance" value="#ff00zz"/>',
    '<float name="scale" value="NaN"/>', '<float name="radiance" value="inf"/>',
    '<integer name="max_depth" value="-2"/>', '<float name="roughness" value="-1"/>',
    '<rgb name="base_color" value="2, 3, 4"/>', '<float name="alpha" value="0"/>',
    '<boolean name="flip_normals" value="perhaps"/>', '<boolean name="face_normals" value="true"/>',
    '<string name="filename" value=""/>', '<spectrum name="reflectance" value="1"/>',
    '<blackbody name="radiance" temperature="5000"/>', '<transform name="to_world"><scale value="0"/></transform>',
    '<transform name="to_world"><scale value="1e30"/></transform>',
    '<transform name="to_world"><matrix value="1 2 3"/></transform>',
    '<transform name="to_world"><matrix value="0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"/></transform>',
    '<transform name="to_world"><rotate angle="90"/></transform>',
    '<transform name="to_world"><lookat origin="0,0,0" target="0,0,0" up="0,0,0"/></transform>',
    '<transform name="to_uv"><scale value="NaN"/></transform>',
    '<transform name="to_uv"><scale value="1e30"/></transform>', '<vector name="x" value="1"/>',
    '<point name="x" x="1" y="2" z="3"/>', '<texture type="volume" name="base_color"/>',
    '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="-1"/></film></sensor>',
    '<nonsense/>', '<integrator type="path"><integer name="max_depth" value="0"/></integrator>',
    '<integrator type="nothing"/>',
    '<integrator type="path"><integer name="rr_depth" value="99999999999"/></integrator>', '<!-- comment -->',
)  # fmt: skip
TYPES = (
    "ply", "obj", "cube", "rectangle", "sphere", "serialized", "diffuse", "principled", "roughplastic",
    "roughconductor", "conductor", "dielectric", "roughdielectric", "twosided", "blendbsdf", "bumpmap", "mask",
    "plastic", "area", "constant", "envmap", "point", "directional", "bitmap", "mesh_attribute", "checkerboard",
    "path", "volpath", "", "nothing", "../x",
)  # fmt: skip
TAGS = (
    "float",
    "integer",
    "string",
    "boolean",
    "rgb",
    "spectrum",
    "point",
    "vector",
    "ref",
    "shape",
    "bsdf",
    "texture",
)
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


def _attributes(tree: ET.Element, also: tuple[str, ...] = ()) -> list[tuple[ET.Element, str]]:
    leave = {"version", "name", "type", "id"} - set(also)
    return [(node, key) for node in tree.iter() for key in node.attrib if key not in leave]


def _inner(tree: ET.Element) -> list[tuple[ET.Element, int]]:
    """Every element as its parent and its place there."""
    return [(parent, place) for parent in tree.iter() for place in range(len(parent))]


@_changes
def xml_value(tree, i, j, k):
    """An odd value."""
    found = _attributes(tree)
    if found:
        node, key = pick(found, i)
        node.set(key, pick(NUMBERS + WORDS, j))


@_changes
def xml_number(tree, i, j, k):
    """One number of a value."""
    found = [(node, key) for node, key in _attributes(tree) if NUMBER.search(node.get(key))]
    if found:
        node, key = pick(found, i)
        text = node.get(key)
        place = pick(list(NUMBER.finditer(text)), j)
        node.set(key, text[: place.start()] + pick(NUMBERS, k) + text[place.end() :])


@_changes
def xml_file(tree, i, j, k):
    """The name of a file."""
    found = [node for node in tree.iter() if node.get("name") == "filename"]
    if found:
        pick(found, i).set("value", pick(NAMES, j))


@_changes
def xml_label(tree, i, j, k):
    """A name, type or id."""
    found = _attributes(tree, ("version", "name", "type", "id"))
    node, key = pick(found, i)
    others = [other.get(key) for other in tree.iter() if other.get(key)]
    node.set(key, pick(others or WORDS, j) if k % 3 else pick(WORDS, j))


@_changes
def xml_type(tree, i, j, k):
    """The kind of a plugin, or of an element."""
    nodes = [node for node in tree.iter() if "type" in node.attrib]
    if k % 3 == 0:
        pick(list(tree.iter()), i).tag = pick(TAGS, j)
    elif nodes:
        pick(nodes, i).set("type", pick(TYPES, j))


@_changes
def xml_drop(tree, i, j, k):
    """Leave out an element, or an attribute."""
    places = _inner(tree)
    if k % 3 == 0:
        node, key = pick(_attributes(tree, ("version", "name", "type", "id")), i)
        del node.attrib[key]
    elif places:
        parent, place = pick(places, i)
        del parent[place]


@_changes
def xml_copy(tree, i, j, k):
    """An element once more, or in another place."""
    places = _inner(tree)
    if places:
        parent, place = pick(places, i)
        target = parent if k % 3 else pick(list(tree.iter()), j)
        target.append(deepcopy(parent[place]))


@_changes
def xml_insert(tree, i, j, k):
    """Something new, at the top or anywhere."""
    target = tree if k % 2 else pick(list(tree.iter()), i)
    snippet = ET.fromstring(f"<x>{pick(SNIPPETS, j)}</x>")
    for place, new in enumerate(snippet):
        target.insert(place if k % 4 > 1 else len(target), new)


@_changes
def xml_nest(tree, i, j, k):
    """An element inside many others of its kind."""
    places = _inner(tree)
    if places:
        parent, place = pick(places, i)
        inner = parent[place]
        for _ in range(pick((1, 2, 30, 400), j)):
            outer = ET.Element(inner.tag, {"type": pick(("twosided", "bumpmap", "diffuse"), k)})
            outer.append(inner)
            inner = outer
        parent[place] = inner


XML = {
    f.__name__: f
    for f in (xml_value, xml_number, xml_file, xml_label, xml_type, xml_drop, xml_copy, xml_insert, xml_nest)
}
