"""PLY files: read, text and binary, with elements and lists of any kind, looked at before Mitsuba loads them, written.

Mitsuba trusts what a file says of sizes and indices, and crashes; it reads every list as three numbers. Binary files
are mapped, not copied, where all lists of an element have one length.
"""

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, Float64Array, IntArray
from neurad.core.scene_records import Mesh
from neurad.formats.meshes.triangles import check_corners
from neurad.runtime.numbers import LENGTH, within
from neurad.runtime.reading import TEXT_MESH_LIMIT, read_bytes, shown

_HEADER = 1 << 16  # bytes that the header of a PLY file may have
_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {_TYPES[name]: name for name in ("char", "uchar", "short", "ushort", "int", "uint", "float", "double")}
_COLUMNS = {"vertices": ("x", "y", "z"), "normals": ("nx", "ny", "nz"), "uvs": ("u", "v")}
_NUMBER, _WIDE = "<f8", 8
"""What the numbers of text become, and its bytes."""
_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_MAX_ROW = 1 << 30  # bytes


@dataclass(frozen=True)
class Lists:
    """The lists of a property, one after the other."""

    counts: IntArray
    """Entries of each [n]."""
    values: Array
    """All entries [sum of counts]."""


Ply = dict[str, dict[str, Array | Lists]]
"""Properties by element and name: numbers [n], or lists."""


@dataclass(frozen=True)
class _Element:
    """An element of a PLY header: its name, how many there are, and the properties of one: name, kind of number, and
    kind of the number of entries of a list, "" where it is none.
    """

    name: str
    count: int
    fields: list[tuple[str, str, str]] = field(default_factory=list)


def read_ply(path: Path) -> Ply:
    """Everything in a file; the numbers of text are float64.

    Raises:
        InputError: it is no PLY file, or has another number of elements than its header says.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEADER)
    order, elements, start = _header(path, head)
    if any(element.name == "vertex" and element.count == 0 for element in elements):
        raise InputError(f"{shown(path)}: it has no vertices")
    data: Array = np.memmap(path, np.uint8, "r") if order else _text(path, start)
    at, found = (start if order else 0), Ply()
    for element in elements:
        found[element.name], at = _columns(path, data, element, at)
    if at < len(data):
        left = f"{len(data) - at} bytes" if order else f"{(len(data) - at) // _WIDE} numbers"
        raise InputError(f"{shown(path)}: {left} follow after what its PLY header announces")
    return found


def check_ply(path: Path) -> None:
    """Check a PLY file: triangles whose vertices exist and have usable coordinates, and as many as the header says."""
    ply = read_ply(path)
    for needed in ("vertex", "face"):
        if needed not in ply:
            raise InputError(f"{shown(path)}: its header has no element {needed}")
    vertices = coordinates(path, ply)
    for axis, values in zip("xyz", vertices.T, strict=True):
        within(values, f"{shown(path)}: coordinate {axis} of its vertices", -LENGTH, LENGTH)
    corners_of(path, ply)
    for name, columns in ply.items():
        for lists in (x for x in columns.values() if isinstance(x, Lists)):
            if (wrong := np.flatnonzero(lists.counts != 3)).size:  # Mitsuba reads every list as three numbers
                first = int(wrong[0])
                raise InputError(
                    f"{shown(path)}: {shown(name)} {first} has {int(lists.counts[first])} corners; only triangles are "
                    "supported, triangulate it"
                )


def coordinates(path: Path, ply: Ply) -> Float64Array:
    """Positions of the vertices [v, 3]."""
    vertex = ply.get("vertex", {})
    for axis in "xyz":
        if not isinstance(vertex.get(axis), np.ndarray):
            raise InputError(f"{shown(path)}: its PLY element vertex has no property {axis}")
    return np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], -1)


def corners_of(path: Path, ply: Ply) -> Lists:
    """The corners of faces, which exist."""
    face = ply.get("face", {})
    names = "vertex_indices", "vertex_index"
    lists = next((face[name] for name in names if isinstance(face.get(name), Lists)), None)
    if not isinstance(lists, Lists):
        raise InputError(f"{shown(path)}: its PLY element face has no list vertex_indices")
    if lists.values.dtype.kind == "f" and (lists.values != np.floor(lists.values)).any():
        raise InputError(f"{shown(path)}: the indices of its faces are not integers")
    check_corners(path, lists.values, lists.counts, len(ply["vertex"]["x"]))  # type: ignore[arg-type]
    return Lists(lists.counts, lists.values.astype(np.int64))


def _header(path: Path, head: bytes) -> tuple[str, list[_Element], int]:
    """The byte order ("" for text), the elements, and where they start."""
    end = _END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{shown(path)}: it is not a PLY file, or its header has no end")
    lines = [line.split() for line in head[: end.start() + 1].decode("utf-8", "replace").splitlines()[1:]]
    order, elements = "?", list[_Element]()
    for words in lines:
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, "1.0"] if name in _ORDER:
                order = _ORDER[name]
            case ["element", name, count] if count.isdecimal() and len(count) < 19:
                elements.append(_Element(name, int(count)))
            case ["property", kind, name] if kind in _TYPES and elements:
                elements[-1].fields.append((name, _TYPES[kind], ""))
            case ["property", "list", length, kind, name] if (
                kind in _TYPES and elements and _TYPES.get(length, "f")[0] in "iu"
            ):
                elements[-1].fields.append((name, _TYPES[kind], _TYPES[length]))
            case _:
                raise InputError(f"{shown(path)}: its PLY header has the line {shown(' '.join(words))!r}")
    for element in elements:
        if len({name for name, *_ in element.fields}) < len(element.fields) or not element.fields:
            raise InputError(f"{shown(path)}: its PLY element {shown(element.name)} has no properties, or one twice")
    if order == "?" or len({element.name for element in elements}) < len(elements):
        raise InputError(f"{shown(path)}: its PLY header has no format, or an element twice")
    for element in elements:
        element.fields[:] = [
            (name, f"{order}{kind}" if order else _NUMBER, length and (f"{order}{length}" if order else _NUMBER))
            for name, kind, length in element.fields
        ]
    return order, elements, end.end()


def _text(path: Path, start: int) -> Array:
    """The numbers of a text file as bytes."""
    words = read_bytes(path, TEXT_MESH_LIMIT)[start:].split()
    try:
        values = np.array(words, np.bytes_).astype(_NUMBER) if words else np.zeros(0)
    except ValueError as error:
        raise InputError(f"{shown(path)}: it has something else than numbers after its PLY header ({error})") from error
    return values.view(np.uint8)


def _rows(data: Array, element: _Element, at: int, count: int) -> Iterator[tuple[tuple[int, ...], int]]:
    """Entries of the lists of each row and where it ends, as far as there are whole ones."""
    kinds = [
        (struct.Struct(length[0] + np.dtype(length).char) if length else None, np.dtype(kind).itemsize)
        for _, kind, length in element.fields
    ]
    for _ in range(count):
        found = []
        for length, width in kinds:
            if length is None:
                at += width
                continue
            if at + length.size > len(data):
                return
            (number,) = length.unpack_from(data, at)  # type: ignore[arg-type]
            if not 0 <= number < 1 << 62 or number != int(number):
                return
            found.append(int(number))
            at += length.size + int(number) * width
        if at > len(data):
            return
        yield tuple(found), at


def _columns(path: Path, data: Array, element: _Element, start: int) -> tuple[dict[str, Array | Lists], int]:
    """The properties of an element that begins at ``start``, and where it ends."""
    count = element.count
    for lengths, end in _rows(data, element, start, min(count, 1)):
        if not (end - start) * count <= len(data) - start or end - start > _MAX_ROW:
            break
        same, layout = iter(lengths), list[Any]()
        for name, kind, length in element.fields:
            layout += [(f"{name} ", length), (name, kind, (next(same),))] if length else [(name, kind)]
        rows = np.frombuffer(data, layout, count, start)
        alike = {name: rows[name].shape[1] for name, _, length in element.fields if length}
        if all((rows[f"{name} "] == number).all() for name, number in alike.items()):
            columns: dict[str, Array | Lists] = {
                name: Lists(np.full(count, alike[name]), rows[name].reshape(-1)) if name in alike else rows[name]
                for name, *_ in element.fields
            }
            return columns, start + (end - start) * count
    return _ragged(path, data, element, start)


def _ragged(path: Path, data: Array, element: _Element, start: int) -> tuple[dict[str, Array | Lists], int]:
    """The properties of an element whose lists differ in length."""
    found = list(_rows(data, element, start, element.count))
    if len(found) < element.count:
        what = {"vertex": "vertices", "face": "faces"}.get(element.name, f"elements {shown(element.name)}")
        raise InputError(
            f"{shown(path)}: its header says {element.count} {what}, but {len(found)} are there: it is cut short or "
            "broken; save it again"
        )
    lists = sum(bool(length) for *_, length in element.fields)
    counts = iter(np.array([lengths for lengths, _ in found], np.int64).reshape(element.count, lists).T)
    ends = [start, *(end for _, end in found)]
    at, columns = np.array(ends[:-1], np.int64), dict[str, Array | Lists]()
    for name, kind, length in element.fields:
        number, width = next(counts) if length else np.ones_like(at), np.dtype(kind).itemsize
        at = at + (np.dtype(length).itemsize if length else 0)
        place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        where = np.repeat(at, number) + place * width
        values = np.stack([data[where + k] for k in range(width)], -1).view(kind).reshape(-1)
        columns[name] = Lists(number, values) if length else values
        at = at + number * width
    return columns, ends[-1]


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write positions, triangles and, where there are any, normals and texture coordinates as 32-bit floats."""
    columns: dict[str, Array] = {}
    for part, names in _COLUMNS.items():
        if (values := getattr(mesh, part)) is not None:
            columns |= dict(zip(names, values.astype(np.float32).T, strict=True))
    write_columns(path, columns, mesh.faces)


def write_columns(path: Path, columns: Mapping[str, Array], faces: IntArray) -> None:
    """Write vertices and triangles.

    Args:
        columns: values of the vertices by the names of their properties, each [v].
        faces: [f, 3].
    """
    kinds = {name: values.dtype.str[1:] for name, values in columns.items()}
    rows = np.empty(len(next(iter(columns.values()))), [(name, f"<{kind}") for name, kind in kinds.items()])
    for name, values in columns.items():
        rows[name] = values
    corners = np.empty(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, faces
    header = [
        "ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}",
        *(f"property {_NAMES[kind]} {name}" for name, kind in kinds.items()),
        f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode() + rows.tobytes() + corners.tobytes())
