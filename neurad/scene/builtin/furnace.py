"""The white furnace: every surface emits and reflects the same, so radiance is E / (1 - rho) everywhere."""

from __future__ import annotations

import numpy as np

from neurad.scene.builtin.plain import diffuse, room, views
from neurad.scene.builtin.shapes import join
from neurad.scene.description import Scene


def build_furnace(albedo: float = 0.5, emission: float = 1.0) -> Scene:
    """A closed box whose sides all emit ``emission`` and reflect ``albedo``.

    Reflected radiance is ``albedo * emission / (1 - albedo)`` everywhere, its derivative
    ``emission / (1 - albedo)**2``. Paths are as long as they need: ``max_depth`` is 1000, roulette from 8.

    Raises:
        InputError: the albedo is not in [0, 1).
    """
    solid = join(*room((-1.0, -0.75, -0.5), (1.0, 0.75, 0.5)).values())
    mesh = solid.mesh("walls", 0, smooth_shading=False, radiance=np.full(3, emission, np.float32))
    train = [((0.5, 0.2, 0.1), (-1.0, 0.0, 0.0)), ((-0.5, -0.3, 0.2), (1.0, 0.3, -0.2))]
    test = [((0.0, 0.3, -0.2), (0.3, -0.75, 0.1))]
    return Scene(
        name="furnace",
        meshes=[mesh],
        materials=[diffuse("walls", albedo)],
        train=views("train", train, 70.0, 32),
        test=views("test", test, 70.0, 32),
        max_depth=1000,
    )
