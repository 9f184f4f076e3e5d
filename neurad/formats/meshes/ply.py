"""Triangle meshes as binary PLY files, to the bit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from neurad.core.records import Mesh

_COLUMNS = {"vertices": ("x", "y", "z"), "normals": ("nx", "ny", "nz"), "uvs": ("u", "v")}


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write positions, triangles and, where there are any, normals and texture coordinates as 32-bit floats.

    Raises:
        OSError: the file cannot be written.
    """
    names: list[str] = []
    columns = []
    for field, channels in _COLUMNS.items():
        values = getattr(mesh, field)
        if values is not None:
            names += channels
            columns.append(np.asarray(values, np.float32))
    rows = np.ascontiguousarray(np.concatenate(columns, 1), "<f4")
    faces = np.empty(len(mesh.faces), np.dtype([("count", "u1"), ("corners", "<i4", 3)]))
    faces["count"], faces["corners"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(rows)}",
        *(f"property float {name}" for name in names),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(rows.tobytes())
        file.write(faces.tobytes())
