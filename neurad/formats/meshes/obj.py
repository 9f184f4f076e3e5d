"""Wavefront OBJ files and the material files (MTL) that they name."""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.names import make_unique
from neurad.core.records import Float64Array, IntArray
from neurad.core.scene_records import Mesh
from neurad.formats.meshes.triangles import MeshFile, check_corners, crossing_note, mesh_of
from neurad.runtime.reading import TEXT_LIMIT, TEXT_MESH_LIMIT, beside, listed, read_bytes, shown
from neurad.scene.polygons import triangulate_polygons

_CONTINUED = re.compile(rb"\\[ \t]*\r?\n")
_WIDTHS = {b"v": (3, 3), b"vt": (1, 2), b"vn": (3, 3)}
"""Numbers that a line of a vertex has at least, and those that are kept of it."""


@dataclass
class _Statements:
    """What the lines of a file say; numbers of many lines lie behind each other."""

    vertices: dict[bytes, array[float]] = field(default_factory=lambda: {key: array("d") for key in _WIDTHS})
    """By the keys of :data:`_WIDTHS`."""
    counts: array[int] = field(default_factory=lambda: array("q"))
    """Corners of each face."""
    corners: array[int] = field(default_factory=lambda: array("q"))
    """Position, texture coordinate and normal of each corner, numbered from 1, 0 for none."""
    runs: list[tuple[int, str, str, str]] = field(default_factory=list)
    """The first face of each material, object and group."""
    libraries: list[str] = field(default_factory=list)
    before: int = 0
    """Vertices before the last face."""

    def rows(self, key: bytes) -> Float64Array:
        """The vertices of a kind, one a row."""
        return np.array(self.vertices[key]).reshape(-1, _WIDTHS[key][1])

    def add_vertex(self, key: bytes, words: list[bytes]) -> None:
        """Read the words behind the key; what is missing is 0."""
        least, width = _WIDTHS[key]
        if len(words) < least:
            raise ValueError
        self.vertices[key].extend([float(word) for word in [*words, b"0"][:width]])

    def add_face(self, words: list[bytes]) -> None:
        """Read corners; those whose numbers are negative count back from what was read so far."""
        for word in words:
            v, vt, vn = [*word.split(b"/"), b"", b""][:3]
            numbers = int(v), int(vt or 0), int(vn or 0)
            self.corners.extend(numbers if b"-" not in word else self._counted_back(numbers))
        self.counts.append(len(words))
        self.before = len(self.vertices[b"v"]) // 3

    def _counted_back(self, numbers: tuple[int, ...]) -> list[int]:
        """A corner whose negative numbers count back from what was read so far, all counted from the first."""
        there = (len(self.vertices[key]) // width + 1 for key, (_, width) in _WIDTHS.items())
        found = [number + (count if number < 0 else 0) for number, count in zip(numbers, there, strict=True)]
        if any(was < 0 and now < 1 for was, now in zip(numbers, found, strict=True)):
            raise ValueError
        return found


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
    points, uvs, normals = map(said.rows, _WIDTHS)
    corners = np.array(said.corners).reshape(-1, 3) - 1
    check_corners(path, corners[:, 0], counts, len(points), 1)
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
    if b"\n" not in text:
        text = text.replace(b"\r", b"\n")
    said, lines = _Statements(), text.split(b"\n")
    state = {b"usemtl": "", b"o": "", b"g": ""}
    changed = True
    for index, line in enumerate(lines):
        words = line.split()
        key = words[0] if words else b""
        try:
            if key in _WIDTHS:
                said.add_vertex(key, words[1:])
            elif key == b"f":
                words = line.partition(b"#")[0].split() if b"#" in line else words
                if line is lines[-1] and not _is_whole(words):
                    raise ValueError
                if len(words) < 4:
                    continue  # a line or a point
                if changed:
                    said.runs.append((len(said.counts), state[b"usemtl"], state[b"o"], state[b"g"]))
                    changed = False
                said.add_face(words[1:])
            elif key in state:
                state[key] = b" ".join(words[1:]).decode("utf-8", "replace")
                changed = True
            elif key == b"mtllib" and words[1:]:
                said.libraries.append(line.split(None, 1)[1].strip().decode("utf-8", "replace"))
        except (ValueError, OverflowError) as error:
            said_line = shown(line.decode("ascii", "backslashreplace").strip())
            end = "; the file is cut short" if index == len(lines) - 1 else ""
            raise InputError(
                f"{shown(path)}: line {index + 1} is {said_line!r}, neither a vertex of so many numbers nor a face of "
                f"three or more corners that there are{end}"
            ) from error
    return said


def _is_whole(words: list[bytes]) -> bool:
    """Whether a face that no line end follows has three corners or more, all written alike."""
    return len(words) > 3 and len({word.count(b"/") for word in words[1:]}) == 1 and not words[-1].endswith(b"/")


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
