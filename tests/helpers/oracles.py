"""Statistical judges that tests share. All of them return p-values; :func:`accept` decides over many at once."""

from collections.abc import Callable

import numpy as np
import torch
from scipy import stats


def accept(p_values) -> bool:
    """Whether the hypothesis behind independent p-values stands: a true one is rejected with a probability of 1 % over
    all of them together (Sidak's correction)."""
    p = np.atleast_1d(np.asarray(p_values, np.float64))
    return bool(np.isfinite(p).all() and p.min() > 1.0 - 0.99 ** (1.0 / p.size))


def z_test_samples(a, b) -> np.ndarray:
    """Two-sided p-values of "a and b have the same mean" over independent repetitions along axis 0; ``b`` may be a
    known mean without that axis. What does not vary must agree to 1e-5 relative.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    variance = np.asarray(a.var(axis=0, ddof=1) / len(a))
    if b.ndim == a.ndim:
        variance, b = variance + b.var(axis=0, ddof=1) / len(b), b.mean(axis=0)
    mean, exact = a.mean(axis=0), variance <= 0
    z = np.abs(mean - b) / np.sqrt(np.where(exact, 1.0, variance))
    same = np.isclose(mean, b, rtol=1e-5, atol=1e-12).astype(np.float64)
    return np.where(exact, same, 2.0 * stats.norm.sf(z))


def welch_test(a, b) -> np.ndarray:
    """Two-sided p-values of "a and b have the same mean" by Welch's t over independent repetitions along axis 0, of the
    entries that differ between repetitions by more than rounding.
    """
    same = np.ptp(np.concatenate((a, b)), axis=0) <= 1e-5 * np.abs(a).max()
    return stats.ttest_ind(a[:, ~same], b[:, ~same], axis=0, equal_var=False).pvalue


def half_difference(value: Callable, moves, changed: Callable = lambda: None) -> float:
    """Half of what ``value()`` changes by from one end of a step to the other: its derivative along the step.

    Gradients are enabled while it is asked, as methods may draw other numbers where they need not replay.

    Args:
        value: the function, a number.
        moves: each parameter with its step; it has its values again afterwards.
        changed: called after parameters have changed.
    """
    before, ends = [parameter.detach().clone() for parameter, _ in moves], []
    for sign in (1.0, -1.0, 0.0):
        with torch.no_grad():
            for (parameter, step), at in zip(moves, before, strict=True):
                parameter.copy_(at + sign * step)
        changed()
        if sign:
            ends.append(float(value().detach()))
    return 0.5 * (ends[0] - ends[1])


def direction(cos, phi) -> np.ndarray:
    """Unit vectors [..., 3] with the given cosine to +z and azimuth."""
    sin = np.sqrt(np.maximum(0.0, 1.0 - cos * cos))
    return np.stack((sin * np.cos(phi), sin * np.sin(phi), cos), -1)


def integrate_cells(pdf_fn: Callable, cos_edges, phi_edges, tolerance: float) -> np.ndarray:
    """Integral of a density over every cell of a (cos theta, phi) grid [rows, columns], by adaptive quadrature.

    Rectangles are split in four until 4x4 Gauss points and their four children agree to ``tolerance``.
    """
    nodes, weights = np.polynomial.legendre.leggauss(4)
    gx, gy = np.meshgrid(0.5 * (nodes + 1), 0.5 * (nodes + 1), indexing="ij")
    gw = np.outer(weights, weights) / 4

    def gauss(rect):  # [k, 4] as cos, phi, width, height
        cos = rect[:, 0, None] + rect[:, 2, None] * gx.ravel()
        phi = rect[:, 1, None] + rect[:, 3, None] * gy.ravel()
        values = np.asarray(pdf_fn(direction(cos, phi).reshape(-1, 3)), np.float64).reshape(len(rect), -1)
        return (values * gw.ravel()).sum(-1) * rect[:, 2] * rect[:, 3]

    def split(rect):
        half = rect * np.array([1, 1, 0.5, 0.5])
        parts = [half + np.stack((i * half[:, 2], j * half[:, 3], *np.zeros((2, len(rect)))), -1)
                 for i in (0, 1) for j in (0, 1)]  # fmt: skip
        return np.stack(parts, 1).reshape(-1, 4)  # the children of one parent are neighbours

    rows, columns = len(cos_edges) - 1, len(phi_edges) - 1
    cos, phi = np.meshgrid(cos_edges[:-1], phi_edges[:-1], indexing="ij")
    width, height = np.meshgrid(np.diff(cos_edges), np.diff(phi_edges), indexing="ij")
    rect, cell = np.stack((cos, phi, width, height), -1).reshape(-1, 4), np.arange(rows * columns)
    rect, cell = split(rect), np.repeat(cell, 4)  # a first look that no narrow lobe slips through
    total, estimate, levels = np.zeros(rows * columns), gauss(rect), 9
    for level in range(levels):
        children = split(rect)
        finer = gauss(children).reshape(-1, 4)
        rough = np.abs(finer.sum(1) - estimate) > tolerance
        if level == levels - 1:
            rough[:] = False
        np.add.at(total, cell[~rough], finer[~rough].sum(1))
        rect, cell = children.reshape(-1, 4, 4)[rough].reshape(-1, 4), np.repeat(cell[rough], 4)
        estimate = finer[rough].ravel()
        if not len(rect):
            break
    return total.reshape(rows, columns)


def pooled_chi2(observed, expected) -> float:
    """p-value of Pearson's chi-square; cells that expect fewer than 5 counts are merged into one."""
    order = np.argsort(expected, kind="stable")
    observed, expected = np.asarray(observed, np.float64)[order], np.asarray(expected, np.float64)[order]
    if observed[expected <= 1e-9 * expected.sum()].sum() > 0:
        return 0.0  # something fell where nothing can
    low = int((expected < 5.0).sum())
    while 0 < low < len(expected) and expected[:low].sum() < 5.0:
        low += 1
    if low:
        observed = np.concatenate(([observed[:low].sum()], observed[low:]))
        expected = np.concatenate(([expected[:low].sum()], expected[low:]))
    if len(expected) < 2:
        raise ValueError("too few cells for a test: draw more samples")
    return float(stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), len(expected) - 1))


def chi2_test(
    sample_fn: Callable,
    pdf_fn: Callable,
    count: int = 100_000,
    rows: int = 16,
    columns: int = 24,
    cos_min: float = -1.0,
) -> float:
    """p-value of "``sample_fn`` draws with density ``pdf_fn``" over the sphere.

    Args:
        sample_fn: count -> directions [count, 3] and whether each is valid [count]; invalid ones must have pdf 0, and
            what is missing in the integral of the pdf must be their fraction.
        pdf_fn: directions [m, 3] float64 -> solid-angle density [m]; float64 evaluation keeps the quadrature exact.
        count: samples to draw.
        rows: cells in cos theta.
        columns: cells in phi.
        cos_min: -1 for the sphere, 0 for the upper hemisphere (then every valid sample must lie there).
    """
    cos_edges, phi_edges = np.linspace(cos_min, 1.0, rows + 1), np.linspace(-np.pi, np.pi, columns + 1)
    wi, valid = (np.asarray(x) for x in sample_fn(count))
    wi = wi[valid]
    if len(wi) and wi[:, 2].min() < cos_min - 1e-6:
        return 0.0
    cos, phi = np.clip(wi[:, 2], cos_min, 1.0), np.arctan2(wi[:, 1], wi[:, 0])
    observed = np.histogram2d(cos, np.clip(phi, -np.pi, np.pi), (cos_edges, phi_edges))[0]
    mass = integrate_cells(pdf_fn, cos_edges, phi_edges, tolerance=1e-7)
    if mass.sum() > 1.0 + 1e-3:
        return 0.0
    rest = max(0.0, 1.0 - mass.sum()) * count  # the fraction of invalid samples
    lost = count - observed.sum()
    if rest < 1e-3 * count and lost < 1e-3 * count:  # no more than the error of the quadrature
        return pooled_chi2(observed.ravel(), mass.ravel() / mass.sum() * observed.sum())
    return pooled_chi2(np.append(observed, lost), np.append(mass * count, rest))
