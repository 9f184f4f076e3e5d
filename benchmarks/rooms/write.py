"""Write a modelled room as the file that ships."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.rooms.furnished import Film
from neurad.core.scene_records import Bitmap, Constant, Texture
from neurad.scene.builtin.shipped import LEVELS, MESH_ARRAYS, MODELS
from neurad.scene.description import Scene


def write_room(scene: Scene, film: Film, path: Path) -> None:
    """Write what :func:`neurad.scene.builtin.shipped.read_room` reads.

    Args:
        scene: the room, of principled materials and smooth metals, with maps in steps of 1/1024.
        film: its cameras.
        path: of the file.
    """
    arrays: dict[str, Any] = {}
    for i, mesh in enumerate(scene.meshes):
        fields = {field: getattr(mesh, field) for field in MESH_ARRAYS}
        arrays |= {f"mesh{i}_{field}": values for field, values in fields.items() if values is not None}
    for i, material in enumerate(scene.materials):
        arrays[f"material{i}_albedo"] = _steps(material.albedo)
        arrays[f"material{i}_roughness"] = _steps(material.roughness)
    labels = {model: label for label, model in MODELS.items()}
    room = {
        "meshes": [{"name": mesh.name, "material": mesh.material} for mesh in scene.meshes],
        "materials": [{"name": m.name, "model": labels[m.model]} for m in scene.materials],
        "max_depth": scene.max_depth,
        "rr_depth": scene.rr_depth,
        **asdict(film),
    }
    arrays["room"] = np.frombuffer(json.dumps(room).encode(), np.uint8)
    np.savez_compressed(path, allow_pickle=False, **arrays)


def _steps(texture: Texture) -> Any:
    if isinstance(texture, Constant):
        return texture.value
    assert isinstance(texture, Bitmap)
    return np.diff(np.round(texture.pixels * LEVELS).astype(np.int16), axis=1, prepend=np.int16(0))
