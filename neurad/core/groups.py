"""Sums over the members of groups."""

import numpy as np

from neurad.core.records import Float64Array, IntArray


def group_sums(values: Float64Array, group: IntArray, count: int) -> Float64Array:
    """Sums of columns [n, c] over the rows of each group [count, c].

    Args:
        group: of each member [n], from 0.
    """
    return np.stack([np.bincount(group, column, count) for column in values.T], -1)
