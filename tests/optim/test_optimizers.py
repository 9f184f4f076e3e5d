"""Which parameters the optimizers move, and what weight decay does to them."""

import math

import pytest
import torch
from torch import nn

from neurad.assembly.build import assemble
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.settings import Optimization
from neurad.fields.hash_grid import HashGrid
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.direct import Direct
from neurad.optim.polyak_average import EVERY, PolyakAverage
from neurad.scene.builtin import build
from neurad.training.optimizers import make_optimizers

GRID = GridConfig(levels=3, coarsest=4, finest=16, log2_size=10)


def optimizers(decay, kind="hash"):
    torch.manual_seed(0)
    roughness = RoughnessConfig(GRID, 16, kind=kind)
    settings = ModelSettings(
        albedo=FieldConfig(GRID, 16), roughness=roughness, radiance=RadianceConfig(GRID, 16), method=Direct(),
        optimization=Optimization(roughness=0.1, roughness_decay=decay),
    )  # fmt: skip
    made = assemble(build("patterns"), settings)
    return made.materials, make_optimizers(made)


def step(optimizer, gradient):
    for group in optimizer.param_groups:
        for p in group["params"]:
            p.grad = gradient(p)
    optimizer.step()


def test_only_the_table_in_front_of_a_network_decays():
    materials, made = optimizers(2.0)
    before = [p.detach().clone() for p in materials.parameters()]
    for optimizer in made.values():
        step(optimizer, torch.zeros_like)
    table = materials.recovered["roughness"].grid.table
    for p, start in zip(materials.parameters(), before, strict=True):
        torch.testing.assert_close(p.detach(), start * (0.8 if p is table else 1.0))

    materials, made = optimizers(2.0, kind="dense")
    table = materials.recovered["roughness"].grid.table
    table.data.fill_(1.0)
    step(made["roughness"], torch.zeros_like)
    assert bool((table == 1.0).all())


def test_noise_adds_up_without_decay_and_fades_with_it():
    """Gradients of mean zero: entries walk ever further, as the square root of the steps; decayed ones do not."""
    spread = {}
    for decay in (0.0, 1.0):
        materials, made = optimizers(decay)
        generator = torch.Generator().manual_seed(1)
        table, sizes = materials.recovered["roughness"].grid.table, []
        for count in (400, 1200):
            for _ in range(count):
                step(made["roughness"], lambda p, g=generator: torch.randn(p.shape, generator=g))
            sizes.append(float(table.detach().std()))
        spread[decay] = sizes
    assert spread[0.0][1] > 1.7 * spread[0.0][0]
    assert spread[1.0][1] == pytest.approx(spread[1.0][0], rel=0.1)
    assert spread[1.0][1] < 0.2 * spread[0.0][1]


@pytest.mark.parametrize(("before", "after"), [(0.0, 2.0), (2.0, 0.0), (2.0, 1.0)])
def test_a_state_saved_with_one_decay_continues_with_another(before, after):
    old = optimizers(before)[1]["roughness"]
    step(old, torch.zeros_like)
    materials, made = optimizers(after)
    made["roughness"].load_state_dict(old.state_dict())
    start = materials.recovered["roughness"].grid.table.detach().clone()
    step(made["roughness"], torch.zeros_like)
    torch.testing.assert_close(materials.recovered["roughness"].grid.table.detach(), start * (1.0 - 0.1 * after))


# ---- materials averaged over the last part of a run


def test_it_is_the_moving_average_by_hand():
    part = nn.Linear(2, 1)
    average = PolyakAverage(part, 0.5)
    start = part.weight.detach().clone()
    expected = None
    for iteration in range(1, 10 * EVERY + 1):
        with torch.no_grad():
            part.weight.add_(0.01 * iteration)
        average.update(iteration)
        if iteration % EVERY == 0:
            weight = 1.0 if expected is None else min(1.0, EVERY / (0.5 * iteration))
            now = part.weight.detach().clone()
            expected = now if expected is None else expected + weight * (now - expected)
    assert int(average.updates) == 10
    last = part.weight.detach().clone()
    with average.used():
        torch.testing.assert_close(part.weight.detach(), expected)
        assert bool((part.weight < last).all())
        assert bool((part.weight > start).all())
    assert torch.equal(part.weight.detach(), last)


def test_before_the_first_update_nothing_changes_and_an_error_inside_changes_nothing():
    part = nn.Linear(3, 2)
    average = PolyakAverage(part, 0.1)
    with torch.no_grad():
        part.bias.fill_(7.0)
    with average.used():
        assert bool((part.bias == 7.0).all())
    average.update(EVERY - 1)
    assert int(average.updates) == 0
    average.update(EVERY)
    with torch.no_grad():
        part.bias.fill_(9.0)
    with pytest.raises(KeyError), average.used():
        raise KeyError(float(part.bias[0]))
    assert bool((part.bias == 9.0).all())


def test_noise_about_a_minimum_is_averaged_out():
    """Adam with noisy gradients of a quadratic: the average over a fifth of the way is more than twice as close."""
    generator = torch.Generator().manual_seed(1)
    part = nn.Linear(200, 1, bias=False)
    average = PolyakAverage(part, 0.2)
    optimizer = torch.optim.Adam(part.parameters(), lr=3e-2)
    for iteration in range(1, 6001):
        noise = torch.randn(part.weight.shape, generator=generator)
        part.weight.grad = part.weight.detach() - 1.0 + 3.0 * noise
        optimizer.step()
        average.update(iteration)
    present = float((part.weight.detach() - 1.0).norm()) / math.sqrt(200)
    with average.used():
        mean = float((part.weight.detach() - 1.0).norm()) / math.sqrt(200)
    assert mean < 0.5 * present


# ---- factors of levels: what a module has while it has its averages


def grid():
    torch.manual_seed(0)
    return torch.nn.ModuleDict({"albedo": HashGrid(3, 2, 8, log2_size=8)})


def test_levels_are_scaled_where_averages_are_shown_and_nowhere_else():
    part = grid()
    average = PolyakAverage(part, 0.1)
    average.update(EVERY)
    table = part["albedo"].table.detach().clone()
    average.levels.set([torch.tensor([1.0, 0.5, 0.0])])
    with average.used():
        shown = part["albedo"].table.detach().clone()
    with average.used(whole=True):
        assert torch.equal(part["albedo"].table.detach(), table)
    assert torch.equal(part["albedo"].table.detach(), table)
    for (_, _, first, entries), factor in zip(part["albedo"].level_table.tolist(), (1.0, 0.5, 0.0), strict=True):
        assert torch.equal(shown[first : first + entries], factor * table[first : first + entries])
    average.copy_to_module()
    assert torch.equal(part["albedo"].table.detach(), shown)


def test_training_goes_on_from_what_is_kept_and_results_stay():
    """Factors below 1 become part of tables and averages, of both fields; what is shown is what it was."""
    part = grid()
    part["roughness"] = HashGrid(2, 2, 4, log2_size=6)
    average = PolyakAverage(part, 0.1)
    average.update(EVERY)
    with torch.no_grad():
        for p in part.parameters():
            p.add_(0.1 * torch.rand_like(p))
    average.levels.set([torch.tensor([2.0, 0.5, 0.25]), torch.tensor([0.75, 1.0])])

    def shown():
        with average.used():
            return [p.detach().clone() for p in part.parameters()]

    before, trained = shown(), [p.detach().clone() for p in part.parameters()]
    average.shrink()
    assert [factors.tolist() for _, factors in average.levels.items()] == [[2.0, 1.0, 1.0], [1.0, 1.0]]
    for old, new in zip(before, shown(), strict=True):
        torch.testing.assert_close(new, old)
    for field, table, kept in zip(part.values(), trained, ((1.0, 0.5, 0.25), (0.75, 1.0)), strict=True):
        for (_, _, first, entries), factor in zip(field.level_table.tolist(), kept, strict=True):
            now = field.table.detach()[first : first + entries]
            torch.testing.assert_close(now, factor * table[first : first + entries])
    average.levels.set([torch.tensor([0.5, 0.5, 0.5])])  # of the first grid alone
    assert [factors.tolist() for _, factors in average.levels.items()] == [[0.5] * 3, [1.0] * 2]
    average.levels.set([torch.tensor([0.5, 0.5, 0.5]), torch.tensor([0.5, 0.5])])
    average.levels.set([torch.tensor([0.25, 0.5, 1.0])])
    assert [factors.tolist() for _, factors in average.levels.items()] == [[0.25, 0.5, 1.0], [1.0] * 2]
