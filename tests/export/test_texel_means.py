"""Compiled passes over the samples of texels against the same in numpy."""

import numpy as np
import pytest

from neurad.export import texel_means_kernels as kernels
from neurad.export.texel_means import uncertain

TEXELS, WIDTH, PER, CHANNELS = 50, 7, 3, 4


@pytest.fixture
def samples():
    """Owners [n, per * per] of samples, some texels without any; distances, numbers of texels, counts, begins."""
    rng = np.random.default_rng(3)
    owner = rng.integers(-1, 9, (TEXELS, PER * PER))
    owner[::7] = -1
    owner[1::7] = 4
    distance = np.where(rng.random(owner.shape) < 0.1, 1.0, 0.0)
    distance[1] = 0.0
    texels = np.sort(rng.choice(20 * WIDTH, TEXELS, replace=False))
    count = (owner >= 0).sum(1)
    return owner, distance, texels, count, np.cumsum(count) - count


def test_samples_are_counted(samples):
    owner, distance, _, count, _ = samples
    found, inside = np.empty(TEXELS, np.int64), np.empty(TEXELS, bool)
    kernels.count_owned(owner, distance, found, inside)
    np.testing.assert_array_equal(found, count)
    np.testing.assert_array_equal(inside, ((owner >= 0) & (distance <= 0.0)).all(1))
    assert 0 < inside.sum() < TEXELS


def test_samples_are_placed(samples):
    owner, _, texels, count, begin = samples
    face, (x, y) = np.empty(count.sum(), np.int64), np.empty((2, count.sum()))
    kernels.place(owner, texels, begin, WIDTH, PER, face, x, y)
    texel, sample = np.nonzero(owner >= 0)
    np.testing.assert_array_equal(face, owner[texel, sample])
    np.testing.assert_array_equal(x, texels[texel] % WIDTH + (sample % PER + 0.5) / PER)
    np.testing.assert_array_equal(y, texels[texel] // WIDTH + (sample // PER + 0.5) / PER)


def test_samples_are_averaged(samples):
    owner, _, _, count, begin = samples
    values = np.random.default_rng(4).random((count.sum(), CHANNELS), np.float32)
    mean, spread = np.empty((TEXELS, CHANNELS), np.float32), np.empty(TEXELS, np.float32)
    least, most = np.ones(CHANNELS, np.float32), np.zeros(CHANNELS, np.float32)
    kernels.averaged(owner, begin, values, PER, mean, spread, least, most)
    for n in range(TEXELS):
        mine = values[begin[n] : begin[n] + count[n]]
        np.testing.assert_allclose(mean[n], mine.mean(0) if count[n] else 0.0, atol=1e-6)
    np.testing.assert_array_equal(least, values.min(0))
    np.testing.assert_array_equal(most, values.max(0))
    whole = 1  # a texel all of whose samples lie on triangles: what is left of a plane fitted by least squares
    mine = values[begin[whole] : begin[whole] + count[whole]].astype(np.float64)
    row, column = np.divmod(np.arange(PER * PER), PER)
    plane = np.stack((np.ones(PER * PER), row, column), 1)
    left = mine - plane @ np.linalg.lstsq(plane, mine, rcond=None)[0]
    assert spread[whole] == pytest.approx(left.std(0).max(), rel=1e-5)


@pytest.mark.parametrize("per", [2, 7])
def test_error_of_means_where_neighbours_differ(per):
    rng = np.random.default_rng(5)
    values, covered = rng.random((9, 11, CHANNELS), np.float32), rng.random((9, 11)) < 0.7
    spread = 0.2 * rng.random((9, 11), np.float32)
    contrast = np.zeros_like(spread)
    for j, i in np.argwhere(covered):
        for y, x in ((j + 1, i), (j - 1, i), (j, i + 1), (j, i - 1)):
            if 0 <= y < 9 and 0 <= x < 11 and covered[y, x]:
                contrast[j, i] = max(contrast[j, i], np.abs(values[j, i] - values[y, x]).max())
    np.testing.assert_allclose(
        uncertain(values, covered, spread, per), np.maximum(spread, contrast / 4) / per, rtol=1e-6
    )
