"""The multilevel least squares against the posterior mean of the Gaussian process that it is, in dense matrices."""

import numpy as np
import pytest

from neurad.optim.multilevel import solve

LEVELS, STDS = (2, 4, 8), (0.3, 0.2, 0.1)


def weights(x, level):
    """Trilinear weights of all nodes [m, (level + 1)^3], the last axis fastest, one axis after the other."""
    hats = np.maximum(1.0 - np.abs(x[:, :, None] * level - np.arange(level + 1)), 0.0)  # [m, 3, level + 1]
    return np.einsum("mi,mj,mk->mijk", *hats.transpose(1, 0, 2)).reshape(len(x), -1)


@pytest.fixture
def places():
    rng = np.random.default_rng(0)
    x = rng.random((40, 3))
    x[0], x[1] = 0.0, 1.0  # both ends of the cube
    information = rng.gamma(1.0, 50.0, 40)
    information[5:10] = 0.0
    return x, information, rng.standard_normal(40) * information


def test_it_is_the_posterior_mean(places):
    x, information, gradient = places
    covariance = sum(std**2 * weights(x, n) @ weights(x, n).T for n, std in zip(LEVELS, STDS, strict=True))
    # f = K (1 + F K)^-1 g, which is K (K + 1/F)^-1 g/F where F is not 0
    right = np.linalg.solve(np.eye(40) + information[:, None] * covariance, gradient)
    values = solve(x, information, gradient, LEVELS, STDS)
    assert values.shape == (9, 9, 9)
    np.testing.assert_allclose(weights(x, 8) @ values.ravel(), covariance @ right, atol=1e-3)
    # ... and anywhere else beside the places
    near = np.clip(x + 0.01, 0.0, 1.0)
    cross = sum(std**2 * weights(near, n) @ weights(x, n).T for n, std in zip(LEVELS, STDS, strict=True))
    inside = (np.floor(np.minimum(x, 0.999) * 8) == np.floor(np.minimum(near, 0.999) * 8)).all(1)
    np.testing.assert_allclose((weights(near, 8) @ values.ravel())[inside], (cross @ right)[inside], atol=1e-3)


def test_what_nothing_is_known_of_stays_at_zero(places):
    x, _, _ = places
    assert not solve(x, np.zeros(40), np.zeros(40), LEVELS, STDS).any()


def test_much_information_is_followed(places):
    x, _, _ = places
    values = solve(x[:1], np.array([1e8]), np.array([0.07e8]), LEVELS, STDS)
    assert weights(x[:1], 8) @ values.ravel() == pytest.approx(0.07, rel=1e-3)
