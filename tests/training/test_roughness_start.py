"""Where roughness begins: only what is surely better moves it, and near mirrors are found."""

import pytest
import torch

from benchmarks.stress.fit import Fit, Plan, photographs, small_cube, small_settings, with_material
from neurad.assembly.model_settings import ModelSettings
from neurad.core.parameters import ROUGHNESS
from neurad.core.records import Surface
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.fields.material import MaterialField
from neurad.fields.settings import GridConfig, RoughnessConfig
from neurad.training.roughness_start import AFTER, LEVELS, best_level


def losses(*gains: float, noise: float = 0.01) -> torch.Tensor:
    """Losses of 12 batches: 1 as it is, and less by ``gains`` at the first levels, more at the others."""
    base = torch.tensor([1.0, *(1.0 - g for g in gains), *(1.5 for _ in LEVELS[len(gains) :])])
    return base + noise * (Stream(1).uniform(12, len(base)) - 0.5)


def test_only_what_is_surely_better_moves_the_field():
    assert best_level(losses()) is None
    assert best_level(losses(0.5, 0.2)) == LEVELS[0]
    assert best_level(losses(0.2, 0.5)) == LEVELS[1]
    assert best_level(losses(0.1, noise=2.0)) is None  # better, but by less than its noise
    assert best_level(losses(0.0005)) is None


def test_a_batch_with_a_highlight_says_no_more_than_the_others():
    bright = torch.linspace(0.0, 3.0, 12).exp().pow(2.0)[:, None]  # the last outweighs all others
    assert best_level(bright * losses(0.5, 0.2)) == LEVELS[0]
    assert best_level(bright * losses()) is None
    below_zero = losses(0.9, noise=0.3)
    below_zero[3, 1] = -0.01  # without noise on average, not in every batch
    assert best_level(below_zero) == LEVELS[0]


@pytest.fixture
def field():
    bounds = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    grid = GridConfig(levels=2, coarsest=4, finest=8, log2_size=10)
    return MaterialField(ROUGHNESS, RoughnessConfig(grid, 16), bounds)


def test_a_shift_moves_the_whole_field(field):
    p = Stream(2).uniform(500, 3)
    before = field.at(p)
    field.shift(float(before.mean()), 0.1)
    after = field.at(p)
    assert float(after.mean()) == pytest.approx(0.1, abs=0.01)
    field.shift(0.1, float(before.mean()))
    torch.testing.assert_close(field.at(p), before, atol=0.02, rtol=0)


@pytest.mark.parametrize(("bias", "mean"), [(40.0, 1.0), (-40.0, ROUGHNESS.low)])
def test_a_field_at_an_end_of_its_range_is_shifted_by_a_finite_amount(field, bias, mean):
    with torch.no_grad():
        field.mlp.layers[-1].bias.fill_(bias)
    p = Stream(2).uniform(50, 3)
    assert float(field.at(p).mean()) == pytest.approx(mean, abs=1e-6)
    field.shift(mean, 0.3)
    moved = float(field.mlp.layers[-1].bias)
    assert 1.0 < abs(moved - bias) < 20.0
    assert abs(moved) < abs(bias)
    assert bool(field.at(p).isfinite().all())


def started(roughness: float, settings: ModelSettings) -> Surface:
    """What a room of one glossy material is taken for right after the look."""
    scene = with_material(small_cube(16), PrincipledModel(), 0.3, roughness)
    made = Fit(scene, photographs(scene, 64), Plan(steps=600, settings=settings))
    for i in range(AFTER + 1):
        made.advance(i / 600)
    with torch.no_grad():
        return made.materials(made.seen(512))


def test_a_near_mirror_is_found_and_a_rough_room_is_not_taken_for_one():
    settings = small_settings()
    assert settings.roughness.begin == "best"
    assert float(started(0.02, settings).roughness.mean()) < 0.12
    assert float(started(1.0, settings).roughness.mean()) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("roughness", [1e-3, 0.02])
def test_near_mirrors_are_recovered(roughness):
    scene = with_material(small_cube(16), PrincipledModel(), 0.3, roughness)
    made = Fit(scene, photographs(scene, 64), Plan(steps=600)).run()
    found = made.surface(made.seen(2048))
    assert float((found.roughness - roughness).abs().mean()) < 0.05
    assert float((found.albedo - 0.3).square().mean().sqrt()) < 0.05
