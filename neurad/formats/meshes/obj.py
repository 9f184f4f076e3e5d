"""Wavefront OBJ files and the material files (MTL) that they name."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Float64Array, IntArray, Mesh
from neurad.formats.meshes.triangles import MeshFile, crossing_note, mesh_of
from neurad.runtime.reading import TEXT_LIMIT, TEXT_MESH_LIMIT, beside, listed, read_bytes, shown
from neurad.scene.polygons import triangulate_polygons

_CONTINUED = re.compile(rb"\\[ \t]*\r?\n")
_CORNER = re.compile(rb"-?\d+(?:/(?:-?\d+)?){0,2}")
_MIN_NUMBERS = {b"v": 3, b"vt": 1, b"vn": 3}
"""Numbers that a line of a vertex has at least."""
_BLOCK = 1 << 18  # words that become numbers at once


@dataclass
class _Rows:
    """Lines of so many numbers each, on their way to an array."""

    width: int
    count: int = 0
    words: list[bytes] = field(default_factory=list)
    parts: list[Float64Array] = field(default_factory=list)

    def add(self, words: list[bytes]) -> None:
        """One more line; what is missing is 0."""
        self.words += words[: self.width]
        self.words += [b"0"] * (self.width - len(words))
        self.count += 1
        if len(self.words) >= _BLOCK:
            self.convert()

    def convert(self) -> None:
        """Make numbers of the words so far."""
        self.parts.append(np.array([float(word) for word in self.words]))
        self.words.clear()

    def array(self) -> Float64Array:
        """All lines [count, width]."""
        self.convert()
        return np.concatenate(self.parts).reshape(-1, self.width)


@dataclass
class _Statements:
    """What the lines of a file say."""

    positions: _Rows = field(default_factory=lambda: _Rows(3))
    coordinates: _Rows = field(default_factory=lambda: _Rows(2))
    normals: _Rows = field(default_factory=lambda: _Rows(3))
    counts: list[int] = field(default_factory=list)
    """Corners of each face."""
    corners: list[IntArray] = field(default_factory=list)
    """Position, texture coordinate and normal of corners, numbered from 0, -1 for none [c, 3]."""
    runs: list[tuple[int, str, str, str]] = field(default_factory=list)
    """The first face of each material, object and group."""
    libraries: list[str] = field(default_factory=list)
    before: int = 0
    """Vertices before the last face."""


def read_obj(path: Path) -> MeshFile:
    """The meshes of a file, their vertices as float64; polygons are cut into triangles.

    There is one for each material; where the file has no two of these, one for each object (``o``) or, where it has no
    two of these either, each group (``g``).

    Raises:
        InputError: it is no such file, is cut short, or a face names a vertex that there is not.
    """
    said = _statements(path, _CONTINUED.sub(b" ", read_bytes(path, TEXT_MESH_LIMIT)))
    counts = np.array(said.counts, np.int64)
    if len(counts) == 0:
        raise InputError(f"{shown(path)}: it has no triangle")
    points, uvs, normals = said.positions.array(), said.coordinates.array(), said.normals.array()
    corners = np.concatenate(said.corners)
    wrong = np.flatnonzero((corners[:, 0] < 0) | (corners[:, 0] >= len(points)))
    if len(wrong):
        face = int(np.searchsorted(np.cumsum(counts), wrong[0], "right"))
        raise InputError(
            f"{shown(path)}: face {face + 1} names vertex {corners[wrong[0], 0] + 1}, of {len(points)} (numbered 1 to "
            f"{len(points)})"
        )
    triangles, crossing = triangulate_polygons(points[corners[:, 0]], counts)
    materials, notes = _materials(path, said)
    notes += crossing_note(path, crossing)
    if said.before < len(points) and corners[:, 0].max() < said.before:
        notes.append(
            f"{shown(path)}: {len(points) - said.before} vertices follow its last face, and none uses them: is it cut "
            "short?"
        )
    parts, part = _parts(path.stem, said.runs, len(counts))
    part = part[np.searchsorted(np.cumsum(counts), triangles[:, 0], "right")]
    ends = np.cumsum(np.bincount(part, minlength=len(parts)))[:-1]
    meshes, paints, taken = list[Mesh](), list[dict[str, Any]](), set[str]()
    for (name, material), faces in zip(parts, np.split(np.argsort(part, kind="stable"), ends), strict=True):
        if len(faces):
            paint = materials.get(material, {})
            chosen = corners[triangles[faces]]
            meshes.append(_mesh(make_unique(name, taken), points, uvs, normals, chosen, _emitted(path, paint)))
            paints.append(paint)
    return MeshFile(path, meshes, notes=tuple(notes), paints=tuple(paints))


def _statements(path: Path, text: bytes) -> _Statements:
    """Go through the lines."""
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")
    said, lines = _Statements(), text.split(b"\n")
    try:
        _go_through(lines, said)
    except ValueError as error:
        raise InputError(_wrong(path, lines)) from error
    return said


def _go_through(lines: list[bytes], said: _Statements) -> None:
    rows = {b"v": said.positions, b"vt": said.coordinates, b"vn": said.normals}
    state = {b"usemtl": "", b"o": "", b"g": ""}
    pending: list[bytes] = []
    changed = True
    for line in lines:
        words = line.split()
        key = words[0] if words else b""
        if key in rows:
            if len(words) <= _MIN_NUMBERS[key]:
                raise ValueError
            rows[key].add(words[1:])
        elif key == b"f":
            words = line.partition(b"#")[0].split() if b"#" in line else words
            if line is lines[-1] and not _is_whole(words):
                raise ValueError
            if len(words) < 4:
                continue  # a line or a point
            if changed:
                said.runs.append((len(said.counts), state[b"usemtl"], state[b"o"], state[b"g"]))
                changed = False
            said.counts.append(len(words) - 1)
            said.before = said.positions.count
            pending += [_absolute(word, said) for word in words[1:]] if b"-" in line else words[1:]
            if len(pending) >= _BLOCK:
                said.corners.append(_corners(pending))
                pending.clear()
        elif key in state:
            state[key] = b" ".join(words[1:]).decode("utf-8", "replace")
            changed = True
        elif key == b"mtllib" and words[1:]:
            said.libraries.append(line.split(None, 1)[1].strip().decode("utf-8", "replace"))
    said.corners.append(_corners(pending))
    for part in rows.values():
        part.convert()


def _is_whole(words: list[bytes]) -> bool:
    """Whether a face that no line end follows has three corners or more, all written alike."""
    return len(words) > 3 and len({word.count(b"/") for word in words[1:]}) == 1 and not words[-1].endswith(b"/")


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _absolute(word: bytes, said: _Statements) -> bytes:
    """A corner whose negative numbers count back from what was read so far, with numbers that count from the first."""
    there = said.positions.count, said.coordinates.count, said.normals.count
    numbers = [int(part) if part else 0 for part in word.split(b"/")]
    found = [number + count + 1 if number < 0 else number for number, count in zip(numbers, there, strict=False)]
    if any(was < 0 and now < 1 for was, now in zip(numbers, found, strict=False)):
        raise ValueError
    return b"/".join(b"%d" % number for number in found)


def _corners(words: list[bytes]) -> IntArray:
    """Corners as numbers from 0, -1 for none [c, 3]."""
    if not words:
        return np.zeros((0, 3), np.int64)
    text = b" ".join(words).replace(b"//", b"/0/")
    slashes = {word.count(b"/") for word in text.split()}
    per = 1 + max(slashes)
    numbers = [int(part) for part in text.replace(b"/", b" ").split()] if len(slashes) == 1 and per <= 3 else []
    if len(numbers) != per * len(words):
        numbers, per = [int(part or b"0") for word in words for part in [*word.split(b"/"), b"", b""][:3]], 3
    found = np.full((len(words), 3), -1)
    found[:, :per] = np.array(numbers).reshape(-1, per) - 1
    return found


def _wrong(path: Path, lines: list[bytes]) -> str:
    """The sentence about the first line that is broken."""
    for number, line in enumerate(lines):
        words = line.split()
        if words and words[0] in _MIN_NUMBERS:
            least = _MIN_NUMBERS[words[0]]
            good = len(words) > least and all(map(_is_number, words[1 : least + 1]))
        elif words and words[0] == b"f":
            words = line.partition(b"#")[0].split()
            good = all(map(_CORNER.fullmatch, words[1:])) and (number < len(lines) - 1 or _is_whole(words))
        else:
            continue
        if not good:
            text = shown(line.decode("ascii", "backslashreplace").strip())
            end = "; the file is cut short" if number == len(lines) - 1 else ""
            return (
                f"{shown(path)}: line {number + 1} is {text!r}, neither a vertex of so many numbers nor a face of "
                f"three or more corners{end}"
            )
    return f"{shown(path)}: a face counts back to vertices before the first one"


def _materials(path: Path, said: _Statements) -> tuple[dict[str, dict[str, Any]], list[str]]:
    """The materials of the MTL files by name, and what has to be said of files and materials that are not there."""
    from trimesh.exchange.obj import parse_mtl
    from trimesh.resolvers import FilePathResolver

    found, notes, read = dict[str, dict[str, Any]](), list[str](), False
    for line in dict.fromkeys(said.libraries):
        whole = _beside(path, line)
        for name, file in [(line, whole)] if whole else [(word, _beside(path, word)) for word in line.split()]:
            if file is None:
                notes.append(
                    f"{shown(path)}: its material file {shown(name)} is not there, so that no mesh has the radiance "
                    "(Ke) that it may say; put it beside the OBJ file, or name what shines with --lamp"
                )
                continue
            text, resolver = read_bytes(file, TEXT_LIMIT), FilePathResolver(str(file))
            found |= parse_mtl(text, resolver)  # type: ignore[no-untyped-call]
            read = True
    used = dict.fromkeys(material for _, material, *_ in said.runs if material)
    if read and (lost := [name for name in used if name not in found]):
        notes.append(f"{shown(path)}: its material files have no material {listed(lost)}")
    return found, notes


def _beside(path: Path, name: str) -> Path | None:
    """A file that an OBJ file names, whatever the case of its letters; None where there is none."""
    plain = name.strip('"').replace("\\", "/")
    folder = (path.parent / plain).parent
    wanted = Path(plain).name
    names = beside(folder / wanted)
    same = [wanted] if wanted in names else [other for other in names if other.lower() == wanted.lower()]
    return folder / same[0] if same else None


def _parts(stem: str, runs: list[tuple[int, str, str, str]], count: int) -> tuple[list[tuple[str, str]], IntArray]:
    """Name and material of each mesh, in the order of the file, and the mesh of each face."""
    if len({material for _, material, *_ in runs}) > 1:
        named = [(material or object_ or group or stem, material) for _, material, object_, group in runs]
    else:
        by = 2 if len({run[2] for run in runs}) > 1 else 3
        several = len({run[by] for run in runs}) > 1
        named = [(str(run[by]) if several and run[by] else stem, run[1]) for run in runs]
    parts = list(dict.fromkeys(named))
    place = {part: index for index, part in enumerate(parts)}
    length = np.diff([*(first for first, *_ in runs), count])
    return parts, np.repeat([place[part] for part in named], length)


def _mesh(
    name: str,
    points: Float64Array,
    uvs: Float64Array,
    normals: Float64Array,
    corners: IntArray,
    radiance: Float64Array | None,
) -> Mesh:
    """A mesh of triangles [f, 3 corners, 3 numbers]: a vertex for each corner that differs from others."""
    flat = corners.reshape(-1, 3)
    has = [bool(((flat[:, k] >= 0) & (flat[:, k] < len(x))).all()) for k, x in enumerate((points, uvs, normals))]
    key = flat[:, 0]
    for k, x in ((1, uvs), (2, normals)):
        if has[k]:
            key = np.unique(key * len(x) + flat[:, k], return_inverse=True)[1]
    _, first, vertex = np.unique(key, return_index=True, return_inverse=True)
    chosen = flat[first]
    return mesh_of(
        name,
        points[chosen[:, 0]],
        vertex.reshape(-1, 3),
        normals[chosen[:, 2]] if has[2] else None,
        uvs[chosen[:, 1]] if has[1] else None,
        None if radiance is None else radiance.astype(np.float32),
    )


def _emitted(path: Path, paint: dict[str, Any]) -> Float64Array | None:
    """What a material emits (``Ke``)."""
    words = paint.get("ke")
    if words is None:
        return None
    try:
        radiance = np.array([float(word) for word in np.atleast_1d(words)])
    except ValueError:
        radiance = np.zeros(0)
    if radiance.shape != (3,):
        raise InputError(f"{shown(path)}: the Ke of its material {shown(paint.get('name'))} is not three numbers")
    return radiance if radiance.any() else None
