"""Training on several processes (Lightning's ``ddp``): what its own averaging of gradients leaves to do.

Every process draws its own pixels and samples, and all of them step with the mean gradient, so ``n`` processes do what
one would do with ``n`` times the batch. Tables of grids have sparse gradients, which DDP's buckets cannot hold: DDP
leaves tables alone and :func:`average_tables` exchanges the touched rows.
"""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import Tensor, nn

from neurad.module.checkpoint import ASIDE


def set_aside(module: nn.Module) -> set[str]:
    """Names of what DDP shall not look after: tables, and buffers that are no state and so the same everywhere.

    Such buffers are the scene itself, a guide that all processes teach alike (:func:`gather`), or averages of weights,
    which are alike; DDP would send them around before every step. Where there are tables and nothing else, as with
    dense grids, the smallest is left to DDP, which refuses to look after nothing; its gradient travels dense, and
    :func:`average_tables` makes it sparse again.
    """
    state = module.state_dict().keys()
    parameters = dict(module.named_parameters())
    tables = {name for name in parameters if name.endswith(".table")}
    if len(tables) == len(parameters):
        smallest = min(sorted(tables), key=lambda name: parameters[name].numel())  # the same in every process
        module.get_submodule(smallest.removesuffix(".table")).fast = False  # type: ignore[assignment]
        tables.remove(smallest)
    return tables | {name for name, _ in module.named_buffers() if name not in state or name.startswith(ASIDE)}


def average_tables(module: nn.Module, names: set[str]) -> None:
    """Replace the gradient of every parameter of ``names`` by its mean over all processes."""
    for name, p in module.named_parameters():
        if p.grad is None:
            continue
        if name not in names:  # DDP has averaged it
            if name.endswith(".table") and p.device.type == "cpu":  # its optimizer moves touched rows only
                rows = p.grad.abs().amax(-1).nonzero().squeeze(-1)
                p.grad = torch.sparse_coo_tensor(rows.unsqueeze(0), p.grad[rows], p.shape, check_invariants=False)
        elif p.grad.is_sparse:
            rows, values = gather(p.grad._indices()[0], p.grad._values())
            values /= dist.get_world_size()
            p.grad = torch.sparse_coo_tensor(rows.unsqueeze(0), values, p.shape, check_invariants=False)
        else:
            dist.all_reduce(p.grad)
            p.grad /= dist.get_world_size()


def agreed(value: float, device: torch.device) -> float:
    """What the first process says: clocks differ, and learning rates that follow them must not."""
    shared = torch.tensor([value], dtype=torch.float64, device=device)
    dist.broadcast(shared, 0)
    return float(shared)


def gather(rows: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
    """Rows [k] and values [k, c] of all processes, one after the other; a row may stand several times."""
    world = dist.get_world_size()
    count = torch.tensor([len(rows)], device=rows.device)
    counts = [torch.empty_like(count) for _ in range(world)]
    dist.all_gather(counts, count)
    lengths = [int(c) for c in counts]
    longest = max(lengths)  # what is exchanged must have one size

    def exchange(x: Tensor) -> Tensor:
        padded = x.new_zeros(longest, *x.shape[1:])
        padded[: len(x)] = x
        found = [torch.empty_like(padded) for _ in range(world)]
        dist.all_gather(found, padded)
        return torch.cat([part[:n] for part, n in zip(found, lengths, strict=True)])

    return exchange(rows), exchange(values)
