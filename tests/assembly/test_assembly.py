"""How fine a grid is that follows the photographs."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers.tiny_fit import fails
from helpers.tiny_fit import fit as train
from helpers.trainer_fit import fit

from benchmarks.stress.fit import photographs, resized
from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.assembly.build import build_world
from neurad.assembly.exposure import sentence_if_far
from neurad.assembly.fitted_materials import build_materials
from neurad.assembly.gains import shared_gains
from neurad.assembly.region import finest_cells, resolve_finest
from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED
from neurad.fields.hash_grid import HashGrid
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.fields.unit_cube import MARGIN
from neurad.formats.load import load_scene
from neurad.integrators.primary_hits import PrimaryHits
from neurad.scene.builtin import build_cornell, build_cube
from neurad.scene.builtin.shapes import look_at
from neurad.scene.textures import TrueMaterials
from neurad.training import training_views


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
    for config in (FieldConfig(), FieldConfig(kind="dense")):
        assert resolve_finest(config, cells) == config
    left = FieldConfig(grid=GridConfig(finest=None, coarsest=4))
    assert resolve_finest(left, cells).grid == replace(left.grid, finest=cells())
    with pytest.raises(ValueError, match="finest is not set"):
        HashGrid.from_config(left.grid)


# ---- the warning about photographs that do not belong to the lights says what is true


def never():
    raise AssertionError("it takes a while and is not needed")


def test_only_what_is_so_is_said():
    assert sentence_if_far(1.0, never, never) == ""
    assert sentence_if_far(40.0, never, never) == ""
    assert "nearly black" in sentence_if_far(0.001, never, never)
    assert "materials cannot explain that" in sentence_if_far(100.0, lambda: 30.0, list)
    explained = sentence_if_far(104.0, lambda: 1.1, list)
    assert "cannot" not in explained
    assert "a mean albedo of about 0.99 in a closed room" in explained
    assert "lamp bulb faces away from the room" in sentence_if_far(104.0, never, lambda: ["bulb"])


@pytest.mark.parametrize(("factor", "said"), [(1.0, ""), (100.0, "materials cannot explain that")])
def test_photographs_in_other_units_are_noticed(factor, said):
    scene = resized(build_cornell(), 8)
    printed = fit(scene, photographs(scene, 8) * factor, 1)[1]
    assert ("times as bright" in printed) == bool(said)
    assert said in printed


def test_photographs_that_tell_nothing_are_refused():
    """Black ones, and ones of a lamp alone."""
    scene = resized(build_cornell(), 8)
    with pytest.raises(InputError, match="every training photograph is black"):
        fit(scene, torch.zeros(len(scene.train), 64, 3))
    up = look_at((0.0, 0.5, 0.0), (0.0, 1.0, 0.001), 20.0, 8)
    scene = replace(scene, train=[replace(scene.train[0], camera=up)])
    with pytest.raises(InputError, match="every pixel of every training view shows an emitter"):
        fit(scene, photographs(scene, 4))


# ---- gains of photographs by the surface points that they share


def test_gains_show_in_surfaces_that_photographs_share():
    """Within some per cent: the walls are matt, the photographs have noise."""
    data = SceneData(DataSettings(scene="cornell"))
    views = data.scene.train
    log = torch.from_numpy(np.random.default_rng(4).uniform(-0.7, 0.7, (len(views), 3))).float()
    log = log - log.mean(0)
    data._pixels = data._pixels.clone()
    data._pixels[..., :3] *= log.exp().unsqueeze(1)
    primary = PrimaryHits(build_world(data.scene), [view.camera for view in views], 1, 0, torch.device("cpu"))
    mask = primary.sees_emitter()
    sample = data.dataset_stats(mask).sample
    error = shared_gains(primary, data, sample, mask, 0) - log
    assert float(error.abs().max()) < 0.03
    assert float(error.mean(0).abs().max()) < 1e-5
    alone = torch.full_like(mask, True)  # nothing is shared
    assert not bool(shared_gains(primary, data, sample, alone, 0).any())


# ---- what emitters and smooth surfaces reflect is known, and is not fitted


SMALL = FieldConfig(GridConfig(levels=2, coarsest=2, finest=4, log2_size=8), width=8)


def middles(scene):
    """Geometry, fitted materials, and the middles of all triangles."""
    geometry = build_world(scene).geometry
    made = build_materials(scene, dict.fromkeys(RECOVERED, SMALL), geometry)
    prim = torch.arange(len(geometry.emission))
    third = torch.full((len(prim),), 1 / 3)
    si = geometry.interact_at(prim, third, third, torch.zeros(len(prim), 3), torch.ones(len(prim), dtype=torch.bool))
    return geometry, made, si


def test_smooth_surfaces_keep_the_materials_of_the_scene():
    scene = load_scene(None, "kitchen")
    geometry, made, si = middles(scene)
    smooth = torch.tensor([m.model.is_delta for m in scene.materials])[geometry.material]
    assert 0 < int(smooth.sum()) < len(smooth)
    found, true = made(si), TrueMaterials(scene, geometry)(si)
    assert torch.equal(found.albedo[smooth], true.albedo[smooth])
    assert torch.equal(found.roughness[smooth], true.roughness[smooth])
    rough = smooth.logical_not() & (geometry.emission.amax(-1) == 0)
    assert not torch.equal(found.albedo[rough], true.albedo[rough])


# ---- what camera rays take of the memory, said before


@pytest.mark.usefixtures("tiny")
def test_much_memory_is_announced_and_too_much_refused(monkeypatch, capfd):
    monkeypatch.setattr(training_views, "LARGE", 1000)
    train("--trainer.max_steps=1")
    assert "3 views of 64 x 64 pixels take 0.000602 GB of memory" in capfd.readouterr().err
    monkeypatch.setattr(training_views, "free_memory", lambda: 100)
    error = fails(capfd, "fit", "--config", "tiny.yaml", "--trainer.max_steps=1")
    assert "--model.sampling.cached_spp 0 --data.resident 1" in error
    train("--trainer.max_steps=1", "--model.sampling.cached_spp=0", "--data.resident=1")
