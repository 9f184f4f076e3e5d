"""How fine a grid is that follows the photographs."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from neurad.assembly.build import build_world
from neurad.assembly.resolution import finest_cells, resolve_finest
from neurad.fields.hash_grid import HashGrid
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.fields.unit_cube import MARGIN
from neurad.scene.builtin import build_cube
from neurad.scene.description import Scene


def seen_with(scene: Scene, width: int) -> int:
    train = [replace(view, camera=replace(view.camera, width=width, height=width)) for view in scene.train]
    return finest_cells(build_world(scene).tracer, replace(scene, train=train))


def test_a_cell_is_as_large_as_a_pixel_of_the_closest_tenth() -> None:
    """In the cube against distances found by brute force: rays of all cameras to the six walls."""
    scene = build_cube(0.5)
    low, high = torch.from_numpy(scene.bounds).unbind()
    sizes = []
    for view in scene.train:
        camera = view.camera
        pixel = 2.0 * math.tan(0.5 * camera.fov_x) / camera.width
        x, y = torch.meshgrid(*[(torch.arange(camera.width) + 0.5 - camera.width / 2) * pixel] * 2, indexing="ij")
        d = (
            torch.stack((x, y, -torch.ones_like(x)), -1).view(-1, 3)
            @ torch.as_tensor(camera.to_world)[:3, :3].T.float()
        )
        d = d / d.norm(dim=-1, keepdim=True)
        o = torch.as_tensor(camera.to_world)[:3, 3].float()
        sizes.append(torch.where(d > 0, (high - o) / d, (low - o) / d).amin(-1) * pixel)
    side = float((high - low).max()) * (1.0 + 2.0 * MARGIN)
    expected = side / float(torch.cat(sizes).quantile(0.1))
    cells = finest_cells(build_world(scene).tracer, scene)
    assert abs(math.log2(cells / expected)) < 0.27  # rounded to powers of 2^0.5


def test_it_follows_the_pixels() -> None:
    scene = build_cube(0.5)
    assert abs(seen_with(scene, 256) - 2 * seen_with(scene, 128)) <= 2  # figures are rounded down
    assert abs(seen_with(scene, 4096) - 32 * seen_with(scene, 128)) <= 32


def test_it_is_no_finer_than_the_coarsest_level_and_1_where_nothing_is_seen() -> None:
    scene = build_cube(0.5)
    tracer = build_world(scene).tracer
    cells = partial(finest_cells, tracer, scene)
    coarse = FieldConfig(grid=GridConfig(finest=None, coarsest=4000))
    assert resolve_finest(coarse, cells).grid.finest == 4000
    away = np.eye(4)
    away[2, 3] = 1e3 * float(np.abs(scene.bounds).max())
    away[:3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks along +Z, away from the cube
    train = [replace(scene.train[0], camera=replace(scene.train[0].camera, to_world=away))]
    assert finest_cells(tracer, replace(scene, train=train)) == 1


def test_what_is_set_stays() -> None:
    scene = build_cube(0.5)
    cells = partial(finest_cells, build_world(scene).tracer, scene)
    for config in (FieldConfig(), FieldConfig(kind="dense"), FieldConfig(kind="dense", grid=GridConfig(finest=None))):
        assert resolve_finest(config, cells) == config
    left = FieldConfig(grid=GridConfig(finest=None, coarsest=4))
    assert resolve_finest(left, cells).grid == replace(left.grid, finest=cells())
    with pytest.raises(ValueError, match="finest is not set"):
        HashGrid.from_config(left.grid)
