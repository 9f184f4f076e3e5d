"""A look at PLY files before Mitsuba loads them: it trusts what they say of sizes and indices, and crashes.

Its loader reads every list as three numbers, so each element has one size. Binary files are mapped, not copied.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.runtime.reading import TEXT_MESH_LIMIT, read_bytes, shown
from neurad.scene.numbers import LENGTH, within

_HEADER = 1 << 16  # bytes that the header of a PLY file may have
_END = re.compile(rb"\nend_header[ \t]*\r?\n")
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDER = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_CORNERS = 3
"""Entries of a list: Mitsuba reads triangles only."""


@dataclass(frozen=True)
class _Element:
    """An element of a PLY header: its name, how many there are, and the fields of one as numpy has them."""

    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)

    def rows(self, order: str) -> np.dtype[np.void]:
        """One element in a binary file."""
        return np.dtype([(name, order + kind) for name, kind in self.fields])


def check_ply(path: Path) -> None:
    """Check a PLY file: triangles whose vertices exist and have usable coordinates, and as many as the header says.

    Raises:
        InputError: it is something else; the sentence says what.
    """
    with path.open("rb") as stream:
        head = stream.read(_HEADER)
    order, elements, start = _header(path, head)
    by_name = {element.name: element for element in elements}
    for needed in ("vertex", "face"):
        if needed not in by_name:
            raise InputError(f"{shown(path)}: its header has no element {needed}")
    if by_name["vertex"].count == 0:
        raise InputError(f"{shown(path)}: it has no vertices")
    columns = _text_columns(path, elements, start) if order == "" else _binary_columns(path, elements, start, order)
    _check_columns(path, by_name, columns)


def _header(path: Path, head: bytes) -> tuple[str, list[_Element], int]:
    """The byte order ("" for text), the elements, and where they start."""
    end = _END.search(head)
    if not head.startswith(b"ply") or end is None:
        raise InputError(f"{shown(path)}: it is not a PLY file, or its header has no end")
    try:
        lines = [line.split() for line in head[: end.start() + 1].decode("ascii").splitlines()[1:]]
    except UnicodeDecodeError as error:
        raise InputError(f"{shown(path)}: its PLY header is not text") from error
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
                elements[-1].fields.append((name, _TYPES[kind]))
            case ["property", "list", length, kind, name] if length in _TYPES and kind in _TYPES and elements:
                elements[-1].fields.append((f"{name} count", _TYPES[length]))
                elements[-1].fields.extend((f"{name} {i}", _TYPES[kind]) for i in range(_CORNERS))
            case _:
                raise InputError(f"{shown(path)}: its PLY header has the line {shown(' '.join(words))!r}")
    for element in elements:
        if len({name for name, _ in element.fields}) < len(element.fields) or not element.fields:
            raise InputError(f"{shown(path)}: its PLY element {shown(element.name)} has no properties, or one twice")
    if order == "?" or len({element.name for element in elements}) < len(elements):
        raise InputError(f"{shown(path)}: its PLY header has no format, or an element twice")
    return order, elements, end.end()


_Columns = dict[str, dict[str, npt.NDArray[Any]]]
"""Fields by element and name, [count] each."""


def _binary_columns(path: Path, elements: list[_Element], start: int, order: str) -> _Columns:
    size, columns = path.stat().st_size, _Columns()
    for element in elements:
        rows = element.rows(order)
        if (there := (size - start) // rows.itemsize) < element.count:
            # Faces of other sizes move what follows them: say so if it is that.
            _check_columns(path, {element.name: element}, {element.name: _mapped(path, rows, start, max(there, 0))})
            raise InputError(_short(path, element))
        columns[element.name] = _mapped(path, rows, start, element.count)
        start += element.count * rows.itemsize
    if start < size:
        _check_columns(path, {e.name: e for e in elements}, columns)
        raise InputError(f"{shown(path)}: {size - start} bytes follow after what its PLY header announces")
    return columns


def _mapped(path: Path, rows: np.dtype[np.void], start: int, count: int) -> dict[str, npt.NDArray[Any]]:
    names = rows.names or ()
    if count == 0:
        return {name: np.zeros(0, rows[name]) for name in names}
    mapped = np.memmap(path, rows, "r", start, (count,))
    return {name: mapped[name] for name in names}


def _text_columns(path: Path, elements: list[_Element], start: int) -> _Columns:
    words = read_bytes(path, TEXT_MESH_LIMIT)[start:].split()
    try:
        values = np.array(words, np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise InputError(f"{shown(path)}: it has something else than numbers after its PLY header ({error})") from error
    columns, place = _Columns(), 0
    for element in elements:
        width = len(element.fields)
        part = values[place : place + width * element.count]
        whole = part[: len(part) // width * width].reshape(-1, width)
        columns[element.name] = {name: whole[:, i] for i, (name, _) in enumerate(element.fields)}
        if len(whole) < element.count:
            _check_columns(path, {element.name: element}, {element.name: columns[element.name]})
            raise InputError(_short(path, element))
        place += width * element.count
    if place < len(values):
        _check_columns(path, {e.name: e for e in elements}, columns)
        raise InputError(f"{shown(path)}: {len(values) - place} numbers follow after what its PLY header announces")
    return columns


def _short(path: Path, element: _Element) -> str:
    what = f"{element.count} elements {shown(element.name)}"
    return f"{shown(path)}: it ends before the {what} that its PLY header announces"


def _check_columns(path: Path, elements: dict[str, _Element], columns: _Columns) -> None:
    """Coordinates that are usable numbers, faces that are triangles, and vertices that exist."""
    for axis in "xyz" if "vertex" in elements else "":
        if axis not in columns["vertex"]:
            raise InputError(f"{shown(path)}: its PLY element vertex has no property {axis}")
        within(columns["vertex"][axis], f"{shown(path)}: coordinate {axis} of its vertices", -LENGTH, LENGTH)
    if "face" not in elements:
        return
    faces = columns["face"]
    name = next((name for name in ("vertex_indices", "vertex_index") if f"{name} count" in faces), None)
    if name is None:
        raise InputError(f"{shown(path)}: its PLY element face has no list vertex_indices")
    count = faces[f"{name} count"]
    if len(count) and (wrong := np.flatnonzero(np.asarray(count) != _CORNERS)).size:
        first = int(wrong[0])
        raise InputError(
            f"{shown(path)}: face {first} has {int(count[first])} corners; only triangles are supported, triangulate it"
        )
    if (
        not elements["face"]
        .fields[[n for n, _ in elements["face"].fields].index(f"{name} 0")][1]
        .startswith(("i", "u"))
    ):
        raise InputError(f"{shown(path)}: the indices of its faces are not of an integer type")
    if "vertex" in elements:
        for corner in range(_CORNERS):
            check_indices(path, faces[f"{name} {corner}"], elements["vertex"].count)


def check_indices(path: Path, index: npt.NDArray[Any], count: int) -> None:
    """Indices [f] of ``count`` vertices."""
    if len(index) == 0 or (index.min() >= 0 and index.max() < count):
        return
    face = int(np.flatnonzero(~((index >= 0) & (index < count)))[0])
    value = f"{float(index[face]):.0f}"
    raise InputError(
        f"{shown(path)}: face {face} names vertex {value}, of {count} (they are numbered 0 to {count - 1})"
    )
