"""Information about roughness: the Schur complement, and products of halves that take noise for nothing."""

import numpy as np
import pytest

from neurad.evidence import bar_calibration
from neurad.evidence.bar_calibration import PRIOR, RoughnessBars, calibrate
from neurad.evidence.fisher import FLOOR, profile

CHANNELS = 3


def test_information_is_the_schur_complement_of_a_dense_matrix():
    """Of several patches with an albedo each and one roughness: 1 / F is the roughness's entry of the dense inverse."""
    rng = np.random.default_rng(0)
    n, patches = 60, 4
    patch = rng.integers(0, patches, n)
    d, r = rng.uniform(0.5, 2.0, (n, CHANNELS)), rng.standard_normal((n, CHANNELS))
    rows = np.zeros((n * CHANNELS, patches * CHANNELS + 1))
    for i in range(n):
        for c in range(CHANNELS):
            rows[i * CHANNELS + c, patch[i] * CHANNELS + c] = d[i, c]
            rows[i * CHANNELS + c, -1] = r[i, c]
    dense = rows.T @ rows
    dense[:-1, :-1] += FLOOR * np.eye(patches * CHANNELS)
    d2, r2 = np.stack([d, d]), np.stack([r, r])
    residual = rng.standard_normal((n, CHANNELS))
    found = profile(d2, r2, np.stack([residual, residual]), patch, patches)
    assert found.information().sum() == pytest.approx(1.0 / np.linalg.inv(dense)[-1, -1], rel=0.02)  # up to the floor
    change = np.linalg.solve(dense, rows.T @ residual.ravel())[-1]
    assert found.gradient().sum() / found.information().sum() == pytest.approx(change, rel=0.05, abs=0.01)


def test_a_steady_sheen_says_nothing_and_a_changing_one_does():
    """R in proportion to D, whatever the light: another albedo explains it. Only its change is information."""
    rng = np.random.default_rng(1)
    d, patch = rng.uniform(0.5, 2.0, (40, CHANNELS)), np.zeros(40, int)
    halves = np.stack([d, d])
    steady = profile(halves, 0.3 * halves, halves, patch, 1).information().sum()
    moving = profile(halves, halves * rng.uniform(0.0, 0.6, (1, 40, 1)), halves, patch, 1).information().sum()
    raw = float(np.square(0.3 * d).sum())
    assert abs(steady) < 0.01 * raw
    assert moving > 0.1 * raw


def test_pure_noise_is_no_information():
    """Derivatives that are noise alone: the products of halves have mean 0, within 4 standard errors of 400 trials,
    while the square of the mean of both halves is far above."""
    rng = np.random.default_rng(2)
    n, trials = 50, 400
    patch = rng.integers(0, 5, n)
    d = rng.uniform(0.5, 2.0, (n, CHANNELS))
    found, naive = [], []
    for _ in range(trials):
        noise = rng.standard_normal((2, n, CHANNELS))
        noisy = np.stack([d, d]) + 0.1 * rng.standard_normal((2, n, CHANNELS))
        found.append(profile(noisy, noise, noisy, patch, 5).information().sum())
        mean = np.repeat(noise.mean(0, keepdims=True), 2, 0)
        naive.append(profile(np.stack([d, d]), mean, noisy, patch, 5).information().sum())
    error = np.std(found) / np.sqrt(trials)
    assert abs(np.mean(found)) < 4.0 * error
    assert np.mean(naive) > 20.0 * error


def synthetic(gain, seed, cells=1500, per=24, noise=0.1, samples_noise=0.05):
    """Pixels of cells with a fit whose error follows ``gain``: derivatives, residuals, halves and places."""
    rng = np.random.default_rng(seed)
    n = cells * per
    cell = np.repeat(np.arange(cells), per)
    strength = np.exp(rng.uniform(-4.0, 0.5, cells))[cell]
    d = rng.uniform(0.5, 1.5, (n, CHANNELS))
    r = strength[:, None] * rng.standard_normal((n, 1)) * np.ones(CHANNELS)
    halves = np.stack([d, d])
    whole = profile(halves, np.stack([r, r]), halves, cell, cells).information()
    information = np.bincount(cell, whole) / noise**2
    error = rng.standard_normal(cells) * np.sqrt(RoughnessBars(gain, PRIOR).variance(information))
    residual = -r * error[cell, None] + noise * rng.standard_normal((n, CHANNELS))
    both = residual + samples_noise * rng.standard_normal((2, n, CHANNELS))
    return halves, np.stack([r, r]), both, whole / noise**2, rng.random(n) < 0.5, (cell, cell), noise**2


@pytest.mark.parametrize("gain", [0.003, 0.02, 0.2])
def test_calibration_finds_the_gain_of_a_fit_without_its_truth(gain, monkeypatch):
    """Simulated fits that made use of a known part of the information: found within a factor of 2."""
    monkeypatch.setattr(bar_calibration, "FACTOR", 30.0)  # what is usual shall not help
    found = calibrate(*synthetic(gain, seed=int(1000 * gain)))
    assert gain / 2.0 < found.gain < gain * 2.0


def test_gain_is_of_what_all_pixels_know_together(monkeypatch):
    """Few pixels a patch: halves profile the albedo out twice and know half of what all know together, so a gain by
    their sum is too large by a half. Mean logarithm over 16 fits, within 4 standard errors (0.2)."""
    monkeypatch.setattr(bar_calibration, "FACTOR", 30.0)  # what is usual shall not help
    found = [np.log(calibrate(*synthetic(0.1, seed, cells=4000, per=4)).gain / 0.1) for seed in range(16)]
    assert abs(np.mean(found)) < 4.0 * np.std(found) / np.sqrt(len(found))


def test_without_information_the_usual_scales_stay():
    d = np.ones((2, 8, CHANNELS))
    places = np.zeros(8, int), np.zeros(8, int)
    found = calibrate(d, 0.0 * d, 0.0 * d, np.zeros(8), np.arange(8) % 2 == 0, places, 1e-9)
    assert found.variance(np.zeros(1))[0] == pytest.approx(PRIOR**2)
    assert found.gain == pytest.approx(bar_calibration.USUAL_GAIN, rel=0.1)
