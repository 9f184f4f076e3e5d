"""PLY files, text and binary, with elements and lists of any kind; and a look at them before Mitsuba loads them.

Mitsuba trusts what a file says of sizes and indices, and crashes; it reads every list as three numbers. Binary files
are mapped, not copied, where all lists of an element have one length.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.core.records import IntArray
from neurad.runtime.numbers import LENGTH, within
from neurad.runtime.reading import TEXT_MESH_LIMIT, read_bytes, shown

Array = npt.NDArray[Any]
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
CORNERS = ("vertex_indices", "vertex_index")
"""Names that the corners of faces have."""


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
    body = _text(path, start) if order == "" else _Body(np.memmap(path, np.uint8, "r"), order)
    at, found = (0 if order == "" else start), Ply()
    for element in elements:
        found[element.name], at = _columns(path, body, element, at)
    if at < len(body.data):
        what = "bytes" if order else "numbers"
        raise InputError(f"{shown(path)}: {len(body.data) - at} {what} follow after what its PLY header announces")
    return found


def check_ply(path: Path) -> None:
    """Check a PLY file: triangles whose vertices exist and have usable coordinates, and as many as the header says.

    Raises:
        InputError: it is something else; the sentence says what.
    """
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
            if (wrong := np.flatnonzero(lists.counts != _CORNERS)).size:
                first = int(wrong[0])
                raise InputError(
                    f"{shown(path)}: {shown(name)} {first} has {int(lists.counts[first])} corners; only triangles are "
                    "supported, triangulate it"
                )


def coordinates(path: Path, ply: Ply) -> npt.NDArray[np.float64]:
    """Positions of the vertices [v, 3].

    Raises:
        InputError: they have none.
    """
    vertex = ply.get("vertex", {})
    for axis in "xyz":
        if not isinstance(vertex.get(axis), np.ndarray):
            raise InputError(f"{shown(path)}: its PLY element vertex has no property {axis}")
    return np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], -1)


def corners_of(path: Path, ply: Ply) -> Lists:
    """The corners of faces, which exist.

    Raises:
        InputError: the faces have none, or one names a vertex that there is not.
    """
    face = ply.get("face", {})
    lists = next((face[name] for name in CORNERS if isinstance(face.get(name), Lists)), None)
    if not isinstance(lists, Lists):
        raise InputError(f"{shown(path)}: its PLY element face has no list vertex_indices")
    if lists.values.dtype.kind == "f" and (lists.values != np.floor(lists.values)).any():
        raise InputError(f"{shown(path)}: the indices of its faces are not integers")
    count = len(ply["vertex"]["x"])  # type: ignore[arg-type]
    wrong = np.flatnonzero(~((lists.values >= 0) & (lists.values < count)))
    if len(wrong):
        owner = int(np.searchsorted(np.cumsum(lists.counts), wrong[0], "right"))
        raise InputError(_no_vertex(path, owner, lists.values[wrong[0]], count))
    return Lists(lists.counts, lists.values.astype(np.int64))


def check_indices(path: Path, index: Array, count: int) -> None:
    """Indices [f] of ``count`` vertices."""
    if len(index) == 0 or (index.min() >= 0 and index.max() < count):
        return
    face = int(np.flatnonzero(~((index >= 0) & (index < count)))[0])
    raise InputError(_no_vertex(path, face, index[face], count))


def _no_vertex(path: Path, face: int, index: Any, count: int) -> str:
    return (
        f"{shown(path)}: face {face} names vertex {float(index):.0f}, of {count} (they are numbered 0 to {count - 1})"
    )


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
            case ["property", "list", length, kind, name] if kind in _TYPES and elements and _is_whole(length):
                elements[-1].fields.append((name, _TYPES[kind], _TYPES[length]))
            case _:
                raise InputError(f"{shown(path)}: its PLY header has the line {shown(' '.join(words))!r}")
    for element in elements:
        if len({name for name, *_ in element.fields}) < len(element.fields) or not element.fields:
            raise InputError(f"{shown(path)}: its PLY element {shown(element.name)} has no properties, or one twice")
    if order == "?" or len({element.name for element in elements}) < len(elements):
        raise InputError(f"{shown(path)}: its PLY header has no format, or an element twice")
    return order, elements, end.end()


def _is_whole(kind: str) -> bool:
    return _TYPES.get(kind, "f")[0] in "iu"


@dataclass(frozen=True)
class _Body:
    """What follows the header: bytes, or the numbers of text. Places and widths count these."""

    data: Array
    order: str

    def width(self, kind: str) -> int:
        """Bytes of a number; 1 in a text file."""
        return np.dtype(kind).itemsize if self.order else 1

    def numbers(self, at: int, stride: int, count: int, kind: str, number: int = 1) -> Array:
        """Some ``number`` in a row, ``stride`` apart [count, number]: a view."""
        unit = self.data.itemsize
        dtype = np.dtype(self.order + kind) if self.order else self.data.dtype
        if count * number == 0:
            return np.zeros((count, number), dtype)
        return np.ndarray((count, number), dtype, self.data, at * unit, (stride * unit, dtype.itemsize))

    def gathered(self, at: IntArray, kind: str) -> Array:
        """Numbers at places [n]: a copy."""
        if not self.order:
            return np.asarray(self.data[at])
        found: Array = np.ascontiguousarray(self.data[at[:, None] + np.arange(self.width(kind))])
        return found.view(self.order + kind).reshape(-1)

    def counts(self, kinds: list[tuple[int, str, int]], after: int, at: int, rows: int) -> Iterator[tuple[int, ...]]:
        """Entries of the lists of each row as far as there are whole ones, by going from one to the next.

        Args:
            kinds: of each list, what lies before it, the kind of its count, and the width of an entry.
            after: what lies behind the last one.
            at: where the rows begin.
            rows: how many there are.
        """
        end, whole = len(self.data), "little" if self.order == "<" else "big"
        data: Any = memoryview(self.data)  # type: ignore[arg-type]
        for _ in range(rows):
            found = []
            for before, kind, entry in kinds:
                at += before
                width = self.width(kind)
                if at + width > end:
                    return
                raw = data[at] if width == 1 else int.from_bytes(data[at : at + width], whole)  # type: ignore[arg-type]
                number = int(raw) if 0 <= raw < 1 << 62 else -1
                if number < 0 or number != raw or (kind[0] == "i" and self.order and number >= 1 << (8 * width - 1)):
                    return
                at += width + number * entry
                found.append(number)
            at += after
            if at > end:
                return
            yield tuple(found)


def _text(path: Path, start: int) -> _Body:
    words = read_bytes(path, TEXT_MESH_LIMIT)[start:].split()
    try:
        values = np.array(words, np.bytes_).astype(np.float64) if words else np.zeros(0)
    except ValueError as error:
        raise InputError(f"{shown(path)}: it has something else than numbers after its PLY header ({error})") from error
    return _Body(values, "")


def _columns(path: Path, body: _Body, element: _Element, start: int) -> tuple[dict[str, Array | Lists], int]:
    """The properties of an element that begins at ``start``, and where it ends."""
    kinds, before = list[tuple[int, str, int]](), 0
    for _, kind, length in element.fields:
        if length:
            kinds.append((before, length, body.width(kind)))
        before = 0 if length else before + body.width(kind)
    first = next(body.counts(kinds, before, start, min(element.count, 1)), (0,) * len(kinds))
    fixed = sum(body.width(length or kind) for _, kind, length in element.fields)
    stride = fixed + sum(width * n for (*_, width), n in zip(kinds, first, strict=True))
    if start + stride * element.count <= len(body.data):
        columns: dict[str, Array | Lists] = {}
        at, same = start, iter(first)
        for name, kind, length in element.fields:
            if not length:
                columns[name] = body.numbers(at, stride, element.count, kind)[:, 0]
                at += body.width(kind)
                continue
            number = next(same)
            if (body.numbers(at, stride, element.count, length) != number).any():
                break
            at += body.width(length)
            values = body.numbers(at, stride, element.count, kind, number).reshape(-1)
            columns[name] = Lists(np.full(element.count, number), values)
            at += number * body.width(kind)
        else:
            return columns, start + stride * element.count
    return _ragged(path, body, element, kinds, before, start)


def _ragged(
    path: Path, body: _Body, element: _Element, kinds: list[tuple[int, str, int]], after: int, start: int
) -> tuple[dict[str, Array | Lists], int]:
    """The properties of an element whose lists differ in length."""
    found = list(body.counts(kinds, after, start, element.count))
    if len(found) < element.count:
        what = {"vertex": "vertices", "face": "faces"}.get(element.name, f"elements {shown(element.name)}")
        raise InputError(
            f"{shown(path)}: its header says {element.count} {what}, but {len(found)} are there: it is cut short or "
            "broken; save it again"
        )
    counts = np.array(found, np.int64).reshape(element.count, len(kinds))
    widths = np.array([width for *_, width in kinds], np.int64)
    fixed = sum(body.width(length or kind) for _, kind, length in element.fields)
    ends = start + np.cumsum(fixed + counts @ widths)
    at = np.concatenate(([start], ends[:-1])) if len(ends) else ends
    columns, lists = dict[str, Array | Lists](), iter(counts.T)
    for name, kind, length in element.fields:
        if not length:
            columns[name] = body.gathered(at, kind)
            at = at + body.width(kind)
            continue
        number = next(lists)
        at = at + body.width(length)
        place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        columns[name] = Lists(number, body.gathered(np.repeat(at, number) + place * body.width(kind), kind))
        at = at + number * body.width(kind)
    return columns, int(ends[-1]) if len(ends) else start
