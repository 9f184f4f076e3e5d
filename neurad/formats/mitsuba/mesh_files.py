"""Mesh files before Mitsuba loads them: a look for what is dangerous or would be read as something else, and those far
from the origin, which Mitsuba would read as float32, written again near it.
"""

import re
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Float64Array
from neurad.core.scene_records import Mesh
from neurad.formats.meshes.ply import Lists, check_ply, coordinates, corners_of, read_ply, write_columns
from neurad.formats.meshes.triangles import check_corners
from neurad.runtime.reading import TEXT_MESH_LIMIT, failure, read_bytes, regular_file, shown
from neurad.scene.origin import ZERO, origin_of


def check_mesh_file(path: Path, kind: str, missing: str, index: int) -> None:
    """Check a file that Mitsuba's loader for ``kind`` (ply, obj or serialized) is to read.

    Raises:
        InputError: it is no such file, ends early, names vertices that do not exist, has coordinates that are no usable
            numbers, or faces that are no triangles.
    """
    file = regular_file(path, missing)
    if file.stat().st_size == 0:
        raise InputError(f"{shown(file)}: it is empty")
    try:
        if kind == "serialized":
            _check_serialized(file, index)
        else:
            {"ply": check_ply, "obj": _check_obj}[kind](file)
    except (OSError, MemoryError) as error:
        raise failure(file, error) from error


# ---- OBJ

_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_CORNER = rb"[ \t]+\d+(?:/\d*(?:/\d*)?)?"
_WRONG = re.compile(
    rb"^[ \t]*(?=[fv][ \t])(?!f(?:%b){3,}[ \t]*\r?(?:#.*)?$)(?!v(?:[ \t]+%b){3}[ \t\r]*(?:[ \t].*)?$).*"
    % (_CORNER, _NUMBER),
    re.MULTILINE,
)
_FACE = re.compile(rb"^[ \t]*f[ \t]", re.MULTILINE)


def _check_obj(path: Path) -> None:
    """Mitsuba's loader checks the indices itself, but takes what is no number for the number before it."""
    text = read_bytes(path, TEXT_MESH_LIMIT)
    if wrong := _WRONG.search(text):
        line = text.count(b"\n", 0, wrong.start()) + 1
        said = shown(wrong.group().decode("ascii", "backslashreplace").strip())
        raise InputError(
            f"{shown(path)}: line {line} is {said!r}, neither a vertex of three numbers nor a face of three or more "
            "vertices, which are numbered from 1"
        )
    if not _FACE.search(text):
        raise InputError(f"{shown(path)}: it has no faces")


# ---- serialized

_MAGIC, _VERSIONS = 0x041C, (3, 4)
_NORMALS, _UVS, _COLOURS, _DOUBLE = 0x0001, 0x0002, 0x0008, 0x2000
_RATIO = 1032  # of deflate at most
_BLOCK = 1 << 24


def _check_serialized(path: Path, index: int) -> None:
    """The mesh ``index`` of a file of Mitsuba's own format."""
    size = path.stat().st_size
    with path.open("rb") as stream:
        version = _version(path, stream.read(4))
        stream.seek(_place(path, stream, index, version, size))
        if _version(path, stream.read(4)) != version:
            raise InputError(f"{shown(path)}: its meshes are of different versions")
        inflated = _Inflated(path, stream)
        flags = inflated.number("<I")
        while version == _VERSIONS[1] and inflated.take(1) != b"\0":  # the name
            pass
        vertices, faces = inflated.number("<Q"), inflated.number("<Q")
        values = 3 * (1 + bool(flags & _NORMALS) + bool(flags & _COLOURS)) + 2 * bool(flags & _UVS)
        skipped = vertices * values * (8 if flags & _DOUBLE else 4)
        width = 8 if vertices > 0xFFFFFFFF else 4
        if vertices == 0 or faces == 0:
            raise InputError(f"{shown(path)}: mesh {index} has {vertices} vertices and {faces} triangles")
        if skipped + 3 * width * faces > _RATIO * size:
            raise InputError(f"{shown(path)}: it is too short for {vertices} vertices and {faces} triangles")
        inflated.skip(skipped)
        found = np.frombuffer(inflated.take(3 * width * faces), f"<u{width}")
        check_corners(path, found, 3, vertices)


def _version(path: Path, head: bytes) -> int:
    magic, version = struct.unpack("<HH", head) if len(head) == 4 else (0, 0)
    if magic != _MAGIC or version not in _VERSIONS:
        raise InputError(f"{shown(path)}: it is not a serialized mesh of version 3 or 4")
    return int(version)


def _place(path: Path, stream: BinaryIO, index: int, version: int, size: int) -> int:
    """Where mesh ``index`` starts, by the table at the end of the file."""
    if index == 0:
        return 0
    width = 8 if version == _VERSIONS[1] else 4
    stream.seek(max(size - 4, 0))
    count = int.from_bytes(stream.read(4), "little")
    if not 0 <= index < count or width * count + 4 > size:
        raise InputError(f"{shown(path)}: it has no mesh {index}, of {count}")
    stream.seek(size - 4 - width * (count - index))
    return int.from_bytes(stream.read(width), "little") % (1 << 62)


class _Inflated:
    """Compressed bytes of a file, one part after the other."""

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path = path
        self.stream = stream
        self.inflate = zlib.decompressobj()
        self.ready = b""

    def number(self, kind: str) -> int:
        return int(struct.unpack(kind, self.take(struct.calcsize(kind)))[0])

    def skip(self, count: int) -> None:
        while count > 0:
            count -= len(self.take(min(count, _BLOCK)))

    def take(self, count: int) -> bytes:
        parts, missing = [self.ready[:count]], count - len(self.ready)
        self.ready = self.ready[count:]
        while missing > 0:
            waiting = self.inflate.unconsumed_tail or self.stream.read(1 << 16)
            try:
                part = self.inflate.decompress(waiting, _BLOCK)
            except zlib.error as error:
                raise InputError(f"{shown(self.path)}: its compressed part is damaged") from error
            if not part and (not waiting or self.inflate.eof):
                raise InputError(f"{shown(self.path)}: its compressed part ends early")
            parts.append(part[:missing])
            self.ready = part[missing:]
            missing -= len(parts[-1])
        return b"".join(parts)


# ---- far from the origin

_VERTEX = re.compile(rb"^([ \t]*v[ \t]+)(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.M)


def moved_file(path: Path, kind: str, target: Path) -> tuple[Path, Float64Array]:
    """The PLY or OBJ file itself if its coordinates lie near their origin, else ``target``, written with less large
    ones; and what was subtracted from them [3]. All other numbers of the vertices stay, of faces in PLY their corners.
    """
    if kind == "ply":
        ply = read_ply(path)
        points = coordinates(path, ply)
    else:
        text = read_bytes(path, TEXT_MESH_LIMIT)
        points = np.array([[float(x) for x in match.groups()[1:]] for match in _VERTEX.finditer(text)]).reshape(-1, 3)
    step = origin_of([Mesh("file", points, np.zeros((0, 3), np.int64), 0)])  # type: ignore[arg-type]
    if not step.any():
        return path, ZERO
    if kind == "ply":
        columns = {name: values for name, values in ply["vertex"].items() if not isinstance(values, Lists)}
        columns |= dict(zip("xyz", (points - step).T, strict=True))
        small = {name: x.astype(np.float32) if x.dtype.kind == "f" else x for name, x in columns.items()}
        write_columns(target, small, corners_of(path, ply).values.reshape(-1, 3))
    else:
        moved = iter((points - step).tolist())
        target.write_bytes(_VERTEX.sub(lambda match: match[1] + b"%.9g %.9g %.9g" % tuple(next(moved)), text))
    return target, step
