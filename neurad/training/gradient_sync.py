"""Training on several processes (Lightning's ``ddp``): the exchange of what DDP does not average itself.

Every process draws its own pixels and samples, and all of them step with the mean gradient, so ``n`` processes do what
one would do with ``n`` times the batch. Tables of grids have sparse gradients, which DDP's buckets cannot hold: DDP
leaves tables alone. Their touched rows, the samples for the guide, and the clock of the first process are sent
together, in one message a step (two when it outgrows its buffer): on one machine the number of messages costs more than
their length.
"""

import math
from collections.abc import Sequence

import torch
import torch.distributed as dist
from torch import Tensor, nn

from neurad.checkpoints.state import DDP_IGNORED
from neurad.fields.sparse import unique_rows

Recorded = tuple[Tensor, Tensor] | None
"""Entries of a table, and what is to be added there."""
_WORD = 8
_SPARE = 1.25
"""Length of a new buffer relative to the message that outgrew the old one."""


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
        module.get_submodule(smallest.removesuffix(".table")).use_kernels = False  # type: ignore[assignment]
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
        self._exchange = Exchange()

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
        sparse, parts = [], []
        for name, p in self._parameters:
            if p.grad is None:
                continue
            if name not in self._names:  # DDP has averaged it
                if name.endswith(".table") and p.device.type == "cpu":  # its optimizer moves touched rows only
                    rows = p.grad.abs().amax(-1).nonzero().squeeze(-1)
                    p.grad = _named(rows, p.grad[rows], p)
            elif p.grad.is_sparse:
                rows, values = unique_rows(p.grad)
                sparse.append(p)
                parts += [rows.int(), values]
            else:
                dist.all_reduce(p.grad)
                p.grad /= dist.get_world_size()
        device = self._parameters[0][1].device
        parts.append(torch.tensor([factor], dtype=torch.float64, device=device))
        for pair in recorded:
            parts += [] if pair is None else [pair[0].int(), pair[1]]
        found = self._exchange(parts)
        for index, p in enumerate(sparse):
            of_all, values_of_all = found[2 * index : 2 * index + 2]
            p.grad = _named(torch.cat(of_all).long(), torch.cat(values_of_all) / len(of_all), p)
        rest = iter(found[2 * len(sparse) :])
        first = float(next(rest)[0])
        guide, scores = (
            None if pair is None else (torch.cat(next(rest)).long(), torch.cat(next(rest))) for pair in recorded
        )
        return first, (guide, scores)


def _named(rows: Tensor, values: Tensor, p: Tensor) -> Tensor:
    """A sparse gradient of ``p``."""
    return torch.sparse_coo_tensor(rows.unsqueeze(0), values, p.shape, check_invariants=False)


class Exchange:
    """Tensors of every process to all of them, in one message."""

    def __init__(self) -> None:
        self._capacity = 0  # bytes of a message, the same in all processes

    def __call__(self, parts: Sequence[Tensor]) -> list[list[Tensor]]:
        """For each of ``parts`` the tensors of all processes, in the order of their ranks.

        Args:
            parts: tensors; between processes only their first dimension may differ.
        """
        own = _packed(parts)
        head = _WORD * len(parts)
        self._capacity = max(self._capacity, head)
        while True:
            sent = own.new_zeros(self._capacity)
            fits = min(len(own), self._capacity)
            sent[:fits] = own[:fits]
            received = own.new_empty(dist.get_world_size(), self._capacity)
            dist.all_gather(list(received.unbind()), sent)
            lengths = received[:, :head].view(torch.int64).tolist()
            longest = head + max(sum(_room(n, part) for n, part in zip(row, parts, strict=True)) for row in lengths)
            if longest <= self._capacity:
                return _unpacked(received, lengths, parts)
            self._capacity = _words(_SPARE * longest)


def _packed(parts: Sequence[Tensor]) -> Tensor:
    """Lengths and contents of ``parts`` as bytes, each of them from a whole word on."""
    pieces = [torch.tensor([len(part) for part in parts], device=parts[0].device).view(torch.uint8)]
    for part in parts:
        content = part.contiguous().view(-1).view(torch.uint8)
        pieces += [content, content.new_zeros(_room(len(part), part) - len(content))]
    return torch.cat(pieces)


def _unpacked(received: Tensor, lengths: list[list[int]], parts: Sequence[Tensor]) -> list[list[Tensor]]:
    """Tensors by part and process from the messages received [processes, bytes]."""
    found: list[list[Tensor]] = [[] for _ in parts]
    for message, row in zip(received, lengths, strict=True):
        begin = _WORD * len(parts)
        for index, (count, part) in enumerate(zip(row, parts, strict=True)):
            content = message[begin : begin + count * _row(part)].view(part.dtype)
            found[index].append(content.view(count, *part.shape[1:]))
            begin += _room(count, part)
    return found


def _row(part: Tensor) -> int:
    """Bytes of an entry of ``part``."""
    return part.element_size() * math.prod(part.shape[1:])


def _room(count: int, part: Tensor) -> int:
    """Bytes that ``count`` entries of ``part`` take in a message."""
    return _words(count * _row(part))


def _words(size: float) -> int:
    """Bytes of the whole words that hold ``size`` bytes."""
    return _WORD * math.ceil(size / _WORD)
