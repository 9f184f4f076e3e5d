"""Coefficients and variances of a map's random effects from what photographs ask for: empirical Bayes.

Places ask for values ``y`` with information ``F`` (1 / variance). With the effects' rows ``A`` and coefficients
``z ~ N(0, diag(s^2))`` the posterior mean solves

    (s A' W A s + 1) u = s A' W y,      z = s u,      W = F / (1 + F MODEL_ERROR^2),

and ``s`` of each effect maximises the marginal likelihood (MacKay 1992): its square is multiplied by
``sum u^2 / gamma`` with ``gamma = n - trace of the posterior covariance of u``, the number of coefficients that the
data determine. The trace is Hutchinson's, ``mean of p (p - C p)`` for signs ``p``, which is exact where the data say
nothing. ``W`` of places that lie farther from the map than they should is lowered as by Student's t errors (iteratively
reweighted least squares), and raised everywhere so that normal errors keep their mean square: else small details are
taken for outliers, round after round. Deviations of the posterior are solves with perturbed data and prior
(perturb-and-MAP, Papandreou and Yuille 2011).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from neurad.core.records import Float64Array, IntArray
from neurad.fields.hierarchy import Coefficients, Effect, Places, keyed

MODEL_ERROR = 0.02
"""Standard deviation of what no effect says: below it a highlight is narrower than a pixel."""
ROUNDS = 10
"""Rounds of finding the variances."""
VARIANCE = 1.0 / 12.0
"""Of the map before anything is known, all effects together: that of a value which may be anything from 0 to 1."""
LARGEST, SMALLEST = 0.5, 1e-3
"""Ends of the standard deviation of an effect."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t."""
NORMAL = 0.766
"""Mean square of normal errors of variance 1 with weights ``min((FREEDOM + 1) / (FREEDOM + square), 1)``."""
DRAWN = 1.0
"""Coefficients by which a variance is drawn to what it was: it stays where nothing is known."""
PROBES, SAMPLES = 2, 8
"""Signs for the traces, and posterior samples."""
TOLERANCE, MAX_ITERATIONS = 1e-4, 500
"""Relative residual at which conjugate gradients stop, and their iterations at most."""


def fit_effects(
    effects: Sequence[Effect],
    places: Places,
    asked: Callable[[Float64Array | None], tuple[Float64Array, Float64Array]],
    seed: int = 0,
) -> Coefficients:
    """What places say of the effects.

    Args:
        places: the points [m].
        asked: values that they ask for [m], and their information, 1 / variance, not negative [m], where these depend
            on the map about its values [m], None at first; all values less what is expected where nothing is known.
    """
    rng = np.random.default_rng(seed)
    target, weight = _weighed(*asked(None))
    model = _Model(effects, places, weight)
    signs = [rng.choice([-1.0, 1.0], model.count) for _ in range(PROBES)]
    mean, spread = np.zeros(model.count), [sign.copy() for sign in signs]
    for _ in range(ROUNDS):
        model.scale()
        mean = model.solved(model.data(target), mean)
        spread = [model.solved(sign, before) for sign, before in zip(signs, spread, strict=True)]
        determined = np.mean([sign * (sign - x) for sign, x in zip(signs, spread, strict=True)], 0)
        values = model.values(mean)
        model.update_variances(mean, determined)
        target, weight = _weighed(*asked(values))
        residual = target - values
        outlying = (FREEDOM + weight * np.square(residual)) / (FREEDOM + 1.0)
        model.weight = weight / (NORMAL * np.maximum(outlying, 1.0))
    model.scale()
    mean = model.solved(model.data(target), mean)
    noise = [
        model.data(rng.standard_normal(len(target)) / np.sqrt(np.maximum(model.weight, 1e-30)))
        + rng.standard_normal(model.count)
        for _ in range(SAMPLES)
    ]
    columns = [mean, *(model.solved(sample) for sample in noise)]
    values = np.stack([model.std * column for column in columns], -1)
    return Coefficients(
        torch.from_numpy(model.keys), torch.from_numpy(values).float(), torch.from_numpy(model.stds).float()
    )


def _weighed(target: Float64Array, information: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Targets, and their weights with what no effect says."""
    return target, information / (1.0 + information * MODEL_ERROR**2)


class _Model:
    """The normal equations."""

    def __init__(self, effects: Sequence[Effect], places: Places, weight: Float64Array) -> None:
        from scipy import sparse  # imported where it is needed: it loads slowly

        self.weight = weight
        self.blocks: list[slice] = []
        """Coefficients of each effect among those of all."""
        matrices: list[Any] = []
        keys: list[IntArray] = []
        begin = 0
        for index, effect in enumerate(effects):
            key, values = (x.numpy() for x in effect.rows(places))
            used, place = np.unique(key, return_inverse=True)
            starts = np.arange(len(key) + 1) * key.shape[1]
            shape = len(key), len(used)
            matrices.append(sparse.csr_matrix((values.ravel().astype(np.float64), place.ravel(), starts), shape))
            self.blocks.append(slice(begin, begin + len(used)))
            keys.append(keyed(index, torch.from_numpy(used)).numpy())
            begin += len(used)
        self.keys, self.count = np.concatenate(keys), begin
        self._rows = sparse.hstack(matrices).tocsr()
        self._columns, self._squares = self._rows.T.tocsr(), self._rows.power(2).T.tocsr()
        squares = self._squares.sum() / max(len(weight), 1)  # of a place's weights, all effects together
        self.stds = np.full(len(effects), np.sqrt(VARIANCE / max(squares, 1.0)))
        self.std = self._inverse = np.ones(begin)

    def scale(self) -> None:
        """Take the present variances and weights."""
        for block, std in zip(self.blocks, self.stds, strict=True):
            self.std[block] = std
        self._inverse = 1.0 / (np.square(self.std) * (self._squares @ self.weight) + 1.0)

    def data(self, target: Float64Array) -> Float64Array:
        """Right side of the equations."""
        return np.asarray(self.std * (self._columns @ (self.weight * target)))

    def values(self, u: Float64Array) -> Float64Array:
        """The map at the places."""
        return np.asarray(self._rows @ (self.std * u))

    def solved(self, right: Float64Array, start: Float64Array | None = None) -> Float64Array:
        """Scaled coefficients ``u`` of a right side."""
        from scipy.sparse.linalg import LinearOperator, cg

        def product(u: Float64Array) -> Float64Array:
            return np.asarray(self.std * (self._columns @ (self.weight * self.values(u))) + u)

        shape = self.count, self.count
        left = LinearOperator(shape, matvec=product, dtype=np.float64)
        inverse = LinearOperator(shape, matvec=lambda u: self._inverse * u, dtype=np.float64)
        found, _ = cg(left, right, x0=start, rtol=TOLERANCE, maxiter=MAX_ITERATIONS, M=inverse)
        return np.asarray(found)

    def update_variances(self, u: Float64Array, determined: Float64Array) -> None:
        """One step to the largest marginal likelihood, by how much of each coefficient the data determine."""
        for index, block in enumerate(self.blocks):
            square, count = float(np.square(u[block]).sum()), float(determined[block].sum())
            change = (square + DRAWN) / (max(count, 0.0) + DRAWN)
            self.stds[index] = np.clip(self.stds[index] * np.sqrt(change), SMALLEST, LARGEST)
