"""Random effects: the posterior in dense matrices, variances that photographs decide, and bars that hold."""

import numpy as np
import pytest
import torch

from neurad.evidence.random_effects import MODEL_ERROR, _Model, fit_effects
from neurad.fields.hierarchy import MIDDLE, Hierarchy, Places

CELLS, PARTS = 16, 8


def room(n, seed=0):
    """Places on eight walls of four colours: each colour's walls share it."""
    rng = np.random.default_rng(seed)
    part = rng.integers(0, PARTS, n)
    x = rng.random((n, 3))
    x[:, 2] = (part + 0.5) / PARTS
    albedo = np.array([[0.8, 0.8, 0.8], [0.4, 0.2, 0.1], [0.1, 0.3, 0.6], [0.05, 0.05, 0.05]])[part // 2]
    albedo = np.clip(albedo + 0.01 * rng.standard_normal((n, 3)), 0.0, 1.0)
    return Places(torch.from_numpy(x).float(), torch.from_numpy(albedo).float(), torch.from_numpy(part))


def found(places, target, information, structure="auto", seed=0):
    hierarchy = Hierarchy(structure, CELLS, PARTS)
    hierarchy.set(fit_effects(hierarchy.effects, places, PARTS, target - MIDDLE, information, seed=seed))
    return hierarchy


def test_the_mean_is_the_posterior_of_dense_matrices():
    rng, places = np.random.default_rng(0), room(60)
    weight = rng.gamma(1.0, 50.0, 60)
    weight[5:10] = 0.0
    target = rng.random(60)
    model = _Model(Hierarchy("auto", CELLS, PARTS).effects, places, PARTS, weight)
    model.scale()
    rows = model._rows.toarray() * model.std
    right = rows.T @ (weight * target)
    expected = np.linalg.solve(rows.T @ (weight[:, None] * rows) + np.eye(model.count), right)
    np.testing.assert_allclose(rows @ model.solved(model.data(target)), rows @ expected, atol=2e-3)


def test_flat_paint_comes_out_flat_and_a_worn_floor_worn():
    """Eight walls of four paints, one of them worn in waves. Single places are known to 0.1 only."""
    places, rng = room(6000), np.random.default_rng(1)
    part, x = places.part.numpy(), places.x.numpy()
    waves = 0.15 * np.sin(2.0 * np.pi * x[:, 0]) * (part == 3)
    truth = np.array([0.6, 0.3, 0.45, 0.2])[part // 2] + waves
    hierarchy = found(places, truth + 0.1 * rng.standard_normal(6000), np.full(6000, 100.0))
    value = hierarchy(places)[:, 0].numpy()
    for index in range(PARTS):
        wall = part == index
        error = value[wall] - truth[wall]
        assert np.sqrt(np.square(error).mean()) < (0.04 if index == 3 else 0.02)
        if index != 3:
            assert value[wall].std() < 0.015
    assert hierarchy.factors[3] > 4.0 * hierarchy.factors[[0, 1, 2, 4, 5, 6, 7]].mean()


def test_what_a_colour_has_goes_to_where_no_highlight_is_seen():
    """Of each pair of walls of one paint only one tells its roughness; the other is told by its colour."""
    places, rng = room(4000), np.random.default_rng(2)
    part = places.part.numpy()
    truth = np.array([0.6, 0.3, 0.45, 0.2])[part // 2]
    information = np.where(part % 2 == 0, 400.0, 0.0)
    hierarchy = found(places, truth + 0.05 * rng.standard_normal(4000), information)
    value, std = hierarchy(places)[:, 0].numpy(), hierarchy.std(places)[:, 0].numpy()
    told = part % 2 == 1
    assert np.sqrt(np.square(value - truth)[told].mean()) < 0.05
    assert std[told].mean() > 1.5 * std[~told].mean()


def test_bars_hold_where_the_model_does():
    """Rooms drawn from the model itself: 90 % intervals cover 82 to 97 % of places, 50 % ones 40 to 60 %."""
    inside = {0.674: [], 1.645: []}
    for seed in range(6):
        rng, places = np.random.default_rng(10 + seed), room(3000, seed)
        hierarchy = Hierarchy("auto", CELLS, PARTS)
        model = _Model(hierarchy.effects, places, PARTS, np.ones(3000))
        model.stds = np.array([0.3, 0.15, 0.05, 0.02, 0.05, 0.05, 0.04, 0.04, 0.03])
        model.scale()
        truth = MIDDLE + model.values(rng.standard_normal(model.count)) + MODEL_ERROR * rng.standard_normal(3000)
        information = rng.gamma(0.3, 300.0, 3000)
        target = truth + rng.standard_normal(3000) / np.sqrt(np.maximum(information, 1e-9))
        result = found(places, target, information, seed=seed)
        off = (result(places) - torch.from_numpy(truth)[:, None]).abs() / result.std(places)
        for limit, rates in inside.items():
            rates.append(float((off < limit).double().mean()))
    assert 0.40 < np.mean(inside[0.674]) < 0.60
    assert 0.82 < np.mean(inside[1.645]) < 0.97


@pytest.mark.parametrize("information", [0.0, 1e-9])
def test_nothing_known_is_said(information):
    places = room(200)
    hierarchy = found(places, np.full(200, 0.9), np.full(200, information))
    assert bool(hierarchy(places).isfinite().all())
    assert float(hierarchy.std(places).min()) > 0.05


def test_one_wild_place_does_not_move_a_wall():
    """Student's t: a place that is sure of a wrong value counts for little."""
    places, rng = room(2000), np.random.default_rng(3)
    truth = np.array([0.6, 0.3, 0.45, 0.2])[places.part.numpy() // 2]
    target, information = truth + 0.05 * rng.standard_normal(2000), np.full(2000, 400.0)
    target[0], information[0] = 5.0, 1e6
    value = found(places, target, information, "groups")(places)[:, 0].numpy()
    assert np.abs(value - truth)[1:].max() < 0.1
