"""Common parts of the small diffuse scenes: one-colour materials, rooms and rings of views."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.parameters import BY_NAME
from neurad.core.reflection import DiffuseModel
from neurad.core.scene_records import Constant, Material, View
from neurad.scene.builtin.shapes import Point, Solid, look_at, quad

DATA = Path(__file__).parent / "data"
"""Photographs and ground truth, made by ``neurad render --scene NAME --out FOLDER --spp 256``; training views of the
kitchen with 128 samples a pixel, the noise that photographs have."""


def diffuse(name: str, albedo: float | Sequence[float]) -> Material:
    """A two-sided diffuse material of one albedo, grey or RGB.

    Raises:
        InputError: the albedo is not in [0, 1).
    """
    value = np.broadcast_to(np.asarray(albedo, np.float32), (3,)).copy()
    if not bool(((value >= 0) & (value < 1)).all()):
        raise InputError(f"material {name}: albedo {albedo} is not in [0, 1), a closed scene would never settle")
    return Material(name, DiffuseModel(), Constant(value), Constant(np.ones(1, np.float32)))


def room(low: Point, high: Point) -> dict[str, Solid]:
    """The six sides of an axis-aligned room, each facing inwards and sharing its corners with the others."""
    (x, y, z), (w, h, d) = low, np.subtract(high, low).tolist()
    return {
        "left": quad((x, y, z), (0, h, 0), (0, 0, d)),
        "right": quad((x + w, y, z), (0, 0, d), (0, h, 0)),
        "floor": quad((x, y, z), (0, 0, d), (w, 0, 0)),
        "ceiling": quad((x, y + h, z), (w, 0, 0), (0, 0, d)),
        "back": quad((x, y, z), (w, 0, 0), (0, h, 0)),
        "front": quad((x, y, z + d), (0, h, 0), (w, 0, 0)),
    }


def views(split: str, eyes: Iterable[tuple[Point, Point]], fov: float, size: int) -> list[View]:
    """Views without files, named ``train_000`` and so on, from pairs of eye and target."""
    return [View(f"{split}_{i:03d}", look_at(e, t, fov, size)) for i, (e, t) in enumerate(eyes)]


def with_files(scene: str, bare: Iterable[View]) -> list[View]:
    """Views of a built-in scene with those of their photographs and maps that are shipped."""

    def path(folder: str, view: View) -> str | None:
        file = DATA / scene / folder / f"{view.name}.exr"
        return str(file) if file.is_file() else None

    def maps(view: View) -> dict[str, str]:
        return {name: file for name in BY_NAME if (file := path(name, view)) is not None}

    return [replace(view, image=path("images", view), maps=maps(view)) for view in bare]
