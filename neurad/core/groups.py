"""Sums over the members of groups, and differences from their means."""

import numpy as np

from neurad.core.records import Float64Array, IntArray


def group_sums(values: Float64Array, group: IntArray, count: int) -> Float64Array:
    """Sums of columns [n, c] over the rows of each group [count, c].

    Args:
        group: of each member [n], from 0.
    """
    return np.stack([np.bincount(group, column, count) for column in values.T], -1)


def centred(values: Float64Array, group: IntArray, weight: Float64Array | None = None) -> Float64Array:
    """Values [n] or [n, c] less their weighted mean over each group, numbered from 0 [n]."""
    weight = np.ones(len(group)) if weight is None else weight
    columns = values.reshape(len(group), -1)
    total = np.maximum(np.bincount(group, weight), 1e-30)
    means = np.zeros((len(total), columns.shape[1]))
    for k, column in enumerate(columns.T):
        means[:, k] = np.bincount(group, weight * column) / total
    return (columns - means[group]).reshape(values.shape)
