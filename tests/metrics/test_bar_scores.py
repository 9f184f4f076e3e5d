"""Scores of error bars against closed forms."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from neurad.metrics.bar_scores import BarPool, ause, coverage, psnr_of_most_certain_half, spearman

N = 200_000


def test_coverage_of_errors():
    """Bars of the right size cover their level of logistic errors; bars k times too small, and normal errors, what
    closed forms say: (1 + exp(-x))^-1 and erf.
    """
    rng = np.random.default_rng(0)
    std = rng.uniform(0.01, 0.3, (N, 3))
    error = std * rng.logistic(0.0, np.sqrt(3.0) / np.pi, (N, 3))
    for level in (0.5, 0.9):
        limit = 5 * np.sqrt(level * (1.0 - level) / (3 * N))
        assert coverage(error, std, level) == pytest.approx(level, abs=limit)
    assert coverage(error, std / 2.0, 0.9) == pytest.approx(2.0 / (1.0 + np.sqrt(1.0 / 19.0)) - 1.0, abs=0.004)
    normal = std * rng.standard_normal((N, 3))
    assert coverage(normal, std, 0.5) == pytest.approx(0.4552, abs=0.004)  # erf(0.6057 / sqrt 2)
    assert coverage(np.zeros((4, 1)), np.zeros((4, 1)), 0.5) == 1.0


def test_spearman_is_that_of_scipy_also_with_equal_values():
    rng = np.random.default_rng(1)
    bar, size = rng.integers(0, 7, 500).astype(float), rng.random(500)
    assert spearman(bar, size) == pytest.approx(spearmanr(bar, size).statistic)
    assert spearman(size, size) == pytest.approx(1.0)
    assert spearman(-size, size) == pytest.approx(-1.0)
    assert spearman(np.ones(500), size) == 0.0


def test_area_under_the_sparsification_error():
    """0 in the order of the errors, 1 in a random one, more in the opposite one, and a case by hand."""
    rng = np.random.default_rng(2)
    size = np.abs(rng.standard_normal(N))
    assert ause(size, size) == pytest.approx(0.0, abs=1e-12)
    assert ause(rng.random(N), size) == pytest.approx(1.0, abs=0.02)
    assert ause(np.ones(N), size) == pytest.approx(1.0, abs=1e-9)
    assert ause(-size, size) > 1.5
    # errors 0 and 1: of one pixel, then two, the wrong order leaves 1, sqrt(1/2), the right one 0, sqrt(1/2)
    whole = np.sqrt(0.5)
    assert ause(np.array([1.0, 0.0]), np.array([0.0, 1.0])) == pytest.approx((1.0 - 0.0) / whole)


def test_area_of_two_kinds_of_normal_errors():
    """Half of the pixels with deviation s, half with 3 s, bars that say so: the curve is known in closed form."""
    rng = np.random.default_rng(3)
    std = np.repeat([0.1, 0.3], N // 2)
    size = np.abs(std * rng.standard_normal(N))
    left = np.arange(1, N + 1) / N
    curve = np.sqrt(np.where(left <= 0.5, 0.01, (0.005 + 0.09 * (left - 0.5)) / left))
    best = np.sqrt(np.cumsum(np.sort(size) ** 2) / np.arange(1, N + 1))
    expected = (curve - best).mean() / (np.sqrt(0.05) - best).mean()
    assert ause(std, size) == pytest.approx(expected, abs=0.01)


def test_the_sure_half_and_its_own_constant():
    bar = np.array([0.3, 0.1, 0.2, 0.4])
    truth = np.array([[0.0], [0.2], [0.4], [0.9]])
    predicted = truth + np.array([[0.5], [0.1], [0.1], [0.5]])
    found, constant = psnr_of_most_certain_half(bar, predicted, truth)
    assert found == pytest.approx(20.0)
    assert constant == pytest.approx(20.0)  # 0.2 and 0.4 around 0.3


def test_pool_takes_counted_pixels_alone_and_names_its_scores():
    pool = BarPool()
    assert pool.scores() == {}
    shape, mask = (2, 3, 3), np.array([[True, False, True], [False, False, True]])
    truth = np.random.default_rng(4).random(shape).astype(np.float32)
    error = np.where(mask[..., None], np.float32(0.1), np.float32(9.0))
    pool.add(truth + error, np.full(shape, 0.1, np.float32), truth, mask)
    scores = pool.scores()
    assert set(scores) == {"coverage_50", "coverage_90", "spearman", "ause", "psnr_sure", "psnr_sure_constant"}
    assert scores["coverage_50"] == 0.0
    assert scores["coverage_90"] == 1.0
    assert scores["psnr_sure"] == pytest.approx(20.0, abs=1e-4)
    with pytest.raises(ValueError, match="shapes differ"):
        pool.add(truth, np.zeros((2, 3, 1), np.float32), truth, mask)
