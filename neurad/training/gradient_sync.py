"""Training on several processes (Lightning's ``ddp``): the exchange of what DDP does not average itself.

Every process draws its own pixels and samples, and all of them step with the mean gradient, so ``n`` processes do what
one would do with ``n`` times the batch. Tables of grids have sparse gradients, which DDP's buckets cannot hold: DDP
leaves tables alone. Their touched rows, the samples for the guide, and the clock of the first process are sent
together: on one machine the number of messages costs more than their length.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor, nn

from neurad.checkpoints.state import DDP_IGNORED
from neurad.fields.sparse import unique_rows

Recorded = tuple[Tensor, Tensor] | None
"""Entries of a table, and what is to be added there."""


def ddp_ignored(module: nn.Module) -> set[str]:
    """Names of the parameters and buffers that DDP leaves alone: tables, and buffers that are alike in all processes.

    The latter are the scene itself, a guide that records the samples of all processes, and averages of weights; DDP
    would broadcast them before every step. Where all parameters are tables, as with dense grids, the smallest is left
    to DDP, which needs at least one parameter; its gradient is dense, and :meth:`GradientSync.average` makes it sparse.
    """
    state = module.state_dict().keys()
    parameters = {name: p for name, p in module.named_parameters() if p.requires_grad}
    tables = {name for name in parameters if name.endswith(".table")}
    if len(tables) == len(parameters):
        smallest = min(sorted(tables), key=lambda name: parameters[name].numel())  # the same in every process
        module.get_submodule(smallest.removesuffix(".table")).sparse = False  # type: ignore[assignment]
        tables.remove(smallest)
    return tables | {name for name, _ in module.named_buffers() if name not in state or name.startswith(DDP_IGNORED)}


class GradientSync:
    """Averages gradients over the processes of a fit.

    Args:
        names: of its parameters that DDP leaves alone, from :func:`ddp_ignored`.
    """

    def __init__(self, module: nn.Module, names: set[str]) -> None:
        self._parameters = list(module.named_parameters())
        self._names = names

    def average(
        self, factor: float, recorded: tuple[Recorded, Recorded] = (None, None)
    ) -> tuple[float, tuple[Recorded, Recorded]]:
        """Replace the gradients that DDP leaves alone by their means over all processes.

        Args:
            factor: of the learning rates. It follows the clock, which differs between processes; the rates must not.
            recorded: entries [n] and values [n, k] that the guide, and the scores of pixels, are to record.

        Returns:
            The first process's factor, and what is to be recorded of all processes, in the order of their ranks.
        """
        tables, pairs = [], []
        for name, p in self._parameters:
            if p.grad is None:
                continue
            if name not in self._names:  # DDP has averaged it
                if name.endswith(".table") and p.device.type == "cpu":  # its optimizer moves touched rows only
                    rows = p.grad.abs().amax(-1).nonzero().squeeze(-1)
                    p.grad = _named(rows, p.grad[rows], p)
            elif p.grad.is_sparse:
                tables.append(p)
                pairs.append(unique_rows(p.grad))
            else:
                dist.all_reduce(p.grad)
                p.grad /= dist.get_world_size()
        pairs += [pair for pair in recorded if pair is not None]
        factor, joined = gathered(factor, pairs)
        for p, (rows, values) in zip(tables, joined, strict=False):
            p.grad = _named(rows, values / dist.get_world_size(), p)
        rest = iter(joined[len(tables) :])
        guide, scores = (None if pair is None else next(rest) for pair in recorded)
        return factor, (guide, scores)


def gathered(factor: float, pairs: Sequence[tuple[Tensor, Tensor]]) -> tuple[float, list[tuple[Tensor, Tensor]]]:
    """The first process's ``factor``, and ``pairs`` of all processes joined in the order of their ranks.

    Args:
        pairs: tensors of which only the first dimension may differ between processes.
    """
    of_all: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(of_all, (factor, [(rows.cpu().numpy(), values.cpu().numpy()) for rows, values in pairs]))
    joined = []
    for (rows, values), *parts in zip(pairs, *(theirs for _, theirs in of_all), strict=True):
        all_rows, all_values = (torch.from_numpy(np.concatenate(x)) for x in zip(*parts, strict=True))
        joined.append((all_rows.to(rows.device), all_values.to(values.device)))
    return of_all[0][0], joined


def _named(rows: Tensor, values: Tensor, p: Tensor) -> Tensor:
    return torch.sparse_coo_tensor(rows.unsqueeze(0), values, p.shape, check_invariants=False)
