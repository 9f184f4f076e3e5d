"""Triangle meshes as binary PLY files, to the bit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import IntArray, Mesh

_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
          "f8": "double"}  # fmt: skip
_COLUMNS = {"vertices": ("x", "y", "z"), "normals": ("nx", "ny", "nz"), "uvs": ("u", "v")}


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write positions, triangles and, where there are any, normals and texture coordinates as 32-bit floats.

    Raises:
        OSError: the file cannot be written.
    """
    columns: dict[str, npt.NDArray[Any]] = {}
    for field, names in _COLUMNS.items():
        if (values := getattr(mesh, field)) is not None:
            columns |= dict(zip(names, values.astype(np.float32).T, strict=True))
    write_columns(path, columns, mesh.faces)


def write_columns(path: Path, columns: Mapping[str, npt.NDArray[Any]], faces: IntArray) -> None:
    """Write vertices and triangles.

    Args:
        path: of the file.
        columns: values of the vertices by the names of their properties, each [v].
        faces: [f, 3].

    Raises:
        OSError: the file cannot be written.
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
