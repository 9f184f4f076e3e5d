"""Sparse gradients of tables: the indices of touched rows, and a gradient for each."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neurad.runtime.dispatch import use_kernel


def from_rows(parts: Sequence[tuple[Tensor, Tensor]], shape: torch.Size) -> Tensor:
    """The sparse gradient of a table.

    Args:
        parts: touched rows [k], int64, and their gradients [k, c]; rows ascend within a part and from part to part.
    """
    rows, values = parts[0]
    if len(parts) > 1:  # numpy copies on this thread, where torch would wake its own
        rows = torch.from_numpy(np.concatenate([r.numpy() for r, _ in parts]))
        values = torch.from_numpy(np.concatenate([v.numpy() for _, v in parts]))
    return torch.sparse_coo_tensor(rows.unsqueeze(0), values, shape, check_invariants=False, is_coalesced=True)


def unique_rows(gradient: Tensor) -> tuple[Tensor, Tensor]:
    """Ascending rows [k], int64, and values [k, c] of a sparse gradient, each row once.

    Autograd drops the mark that a gradient is coalesced, and appends where a table was read twice; torch's own
    ``coalesce`` sorts, which is slower than the update itself.
    """
    if not use_kernel(gradient._values().dim() == 2, gradient):
        gradient = gradient.coalesce()
        return gradient.indices()[0], gradient.values()
    from neurad.fields import hash_grid_kernels as kernels  # imported at first use: numba is slow to load

    rows, values = gradient._indices()[0].contiguous(), gradient._values().contiguous()
    if kernels.is_ascending(rows.numpy()):
        return rows, values
    merged, sums = torch.empty_like(rows), torch.empty_like(values)
    arrays = rows.numpy(), values.numpy(), merged.numpy(), sums.numpy()
    count = kernels.merge_rows(*arrays, *kernels.marks(gradient.shape[0]))
    return merged[:count], sums[:count]
