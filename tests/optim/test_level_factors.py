"""Factors of levels: what a module has while it has its averages."""

import torch

from neurad.fields.hash_grid import HashGrid
from neurad.optim.level_factors import LevelFactors
from neurad.optim.polyak_average import EVERY, PolyakAverage


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


def test_features_scale_with_their_level():
    part = grid()
    levels = LevelFactors(part)
    x = torch.rand(50, 3)
    before = part["albedo"](x).detach()
    levels.set([torch.tensor([2.0, 1.0, 0.25])])
    assert levels.of(part["albedo"]) is not None
    levels.scale()
    expected = before * torch.tensor([2.0, 2.0, 1.0, 1.0, 0.25, 0.25])
    torch.testing.assert_close(part["albedo"](x).detach(), expected)
    levels.set(None)
    assert all(bool((factors == 1.0).all()) for _, factors in levels.items())
    assert levels.of(torch.nn.Linear(1, 1)) is None


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
