"""Mesh files of a scene that lies far from the origin, written again near it: Mitsuba reads them as float32."""

import re
from pathlib import Path

import numpy as np

from neurad.core.records import Float64Array
from neurad.core.scene_records import Mesh
from neurad.formats.meshes.ply import Lists, coordinates, corners_of, read_ply, write_columns
from neurad.runtime.reading import TEXT_MESH_LIMIT, read_bytes
from neurad.scene.origin import ZERO, origin_of

_VERTEX = re.compile(rb"^([ \t]*v[ \t]+)(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.M)


def moved_file(path: Path, kind: str, target: Path) -> tuple[Path, Float64Array]:
    """The file itself if its coordinates lie near their origin, else ``target``, written with less large ones; and what
    was subtracted from them [3].
    """
    return _ply(path, target) if kind == "ply" else _obj(path, target)


def _step(points: Float64Array) -> Float64Array:
    return origin_of([Mesh("file", points, np.zeros((0, 3), np.int64), 0)])  # type: ignore[arg-type]


def _ply(path: Path, target: Path) -> tuple[Path, Float64Array]:
    """All numbers of the vertices stay, of the faces their corners."""
    ply = read_ply(path)
    points = coordinates(path, ply)
    step = _step(points)
    if not step.any():
        return path, ZERO
    columns = {name: values for name, values in ply["vertex"].items() if not isinstance(values, Lists)}
    columns |= dict(zip("xyz", (points - step).T, strict=True))
    small = {name: x.astype(np.float32) if x.dtype.kind == "f" else x for name, x in columns.items()}
    write_columns(target, small, corners_of(path, ply).values.reshape(-1, 3))
    return target, step


def _obj(path: Path, target: Path) -> tuple[Path, Float64Array]:
    text = read_bytes(path, TEXT_MESH_LIMIT)
    points = np.array([[float(x) for x in match.groups()[1:]] for match in _VERTEX.finditer(text)]).reshape(-1, 3)
    step = _step(points)
    if not step.any():
        return path, ZERO
    moved = iter((points - step).tolist())
    target.write_bytes(_VERTEX.sub(lambda match: match[1] + b"%.9g %.9g %.9g" % tuple(next(moved)), text))
    return target, step
