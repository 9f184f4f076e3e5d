"""Rooms of solids and lights, as the built-in kitchens are, and the files of them that ship."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Bitmap, Constant, Material, Mesh, Texture
from neurad.scene.builtin.plain import views, with_files
from neurad.scene.builtin.shapes import Point, Solid
from neurad.scene.builtin.shipped import LEVELS, MESH_ARRAYS, MODELS
from neurad.scene.description import Scene

SINK = 0.002
"""Things stand this much inside what carries them: no coplanar faces, no slits."""


@dataclass(frozen=True)
class Item:
    """One object: a solid, its material, and the length in metres after which its texture repeats."""

    solid: Solid
    material: Material
    tile: float = 1.0


@dataclass(frozen=True)
class Light:
    """A surface that sends light, by its name."""

    name: str
    solid: Solid
    radiance: tuple[float, float, float]


@dataclass(frozen=True)
class Film:
    """Where cameras stand and what they look at, and their films."""

    train: Sequence[tuple[Point, Point]]
    test: Sequence[tuple[Point, Point]]
    fov: float
    """Degrees."""
    size: int
    """Pixels along a side."""


def furnished(name: str, items: Iterable[Item], lights: Iterable[Light], film: Film, **limits: Any) -> Scene:
    """The scene, with the photographs and material maps of its name that are shipped, where they are there; ``limits``
    are ``max_depth`` and ``rr_depth``, where they are not the usual ones.
    """
    materials: list[Material] = []
    meshes: list[Mesh] = []
    for item in items:
        meshes.append(item.solid.mesh(item.material.name, len(materials), item.tile))
        materials.append(item.material)
    for light in lights:
        radiance = np.array(light.radiance, np.float32)
        meshes.append(light.solid.mesh(light.name, len(materials), smooth_shading=False, radiance=radiance))
        materials.append(_pane(light.name))
    return Scene(
        name=name,
        meshes=meshes,
        materials=materials,
        train=with_files(name, views("train", film.train, film.fov, film.size)),
        test=with_files(name, views("test", film.test, film.fov, film.size)),
        **limits,
    )


def _pane(name: str) -> Material:
    return Material(
        name, PrincipledModel(), Constant(np.full(3, 0.5, np.float32)), Constant(np.full(1, 0.4, np.float32))
    )


def write_room(scene: Scene, film: Film, path: Path) -> None:
    """Write what :func:`neurad.scene.builtin.shipped.read_room` reads, a room of principled materials and smooth
    metals, with maps in steps of 1/1024.
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
