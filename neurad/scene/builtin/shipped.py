"""The two kitchens, whose meshes, material maps and cameras ship as one file each.

``python -m benchmarks.rooms`` models them and writes ``data/NAME/room.npz``: a JSON text ``room`` with what has a name,
and the arrays ``mesh{i}_{field}`` and ``material{i}_{albedo|roughness}``. Maps are integers of 1/:data:`LEVELS`, for
the same floats on every machine, each less the texel to its left, which makes the file half as large.
"""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.records import FloatArray
from neurad.core.reflection import ConductorModel, PrincipledModel
from neurad.core.scene_records import Bitmap, Constant, Material, Mesh, Texture
from neurad.scene.builtin.plain import DATA, views, with_files
from neurad.scene.description import Scene

LEVELS = 1024
MODELS = {"principled": PrincipledModel(), "conductor": ConductorModel()}
MESH_ARRAYS = ("vertices", "faces", "normals", "uvs", "radiance")
"""Fields of a mesh that are arrays; those that it lacks are not in the file."""

Arrays = Mapping[str, npt.NDArray[Any]]


def read_room(name: str) -> Scene:
    """The room ``name`` with the photographs and material maps that are shipped beside it."""
    with np.load(DATA / name / "room.npz", allow_pickle=False) as file:
        arrays: Arrays = dict(file)
    room: dict[str, Any] = json.loads(arrays["room"].tobytes())
    return Scene(
        name=name,
        meshes=[_mesh(i, entry, arrays) for i, entry in enumerate(room["meshes"])],
        materials=[_material(i, entry, arrays) for i, entry in enumerate(room["materials"])],
        train=with_files(name, views("train", room["train"], room["fov"], room["size"])),
        test=with_files(name, views("test", room["test"], room["fov"], room["size"])),
        max_depth=room["max_depth"],
        rr_depth=room["rr_depth"],
    )


def _mesh(index: int, entry: dict[str, Any], arrays: Arrays) -> Mesh:
    found = {field: arrays.get(f"mesh{index}_{field}") for field in MESH_ARRAYS}
    return Mesh(**entry, **found)  # type: ignore[arg-type]  # vertices and faces are always there


def _material(index: int, entry: dict[str, Any], arrays: Arrays) -> Material:
    albedo, roughness = (_texture(arrays[f"material{index}_{map_name}"]) for map_name in ("albedo", "roughness"))
    return Material(entry["name"], MODELS[entry["model"]], albedo, roughness)


def _texture(values: npt.NDArray[Any]) -> Texture:
    """A bitmap, of differences along its rows [h, w, c], or one value [c] as it is."""
    if values.ndim == 1:
        return Constant(values)
    pixels: FloatArray = (values.cumsum(axis=1, dtype=np.int16) / LEVELS).astype(np.float32)
    return Bitmap(pixels)
