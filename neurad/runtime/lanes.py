"""Work that some lanes of a batch need: one policy for whether the others do it too.

On a CPU work costs by the lane, so those that need it are picked. On a GPU the host would have to wait for the device
to learn how many there are, and a step whose shapes change can be no CUDA graph; so all lanes do it, and what comes of
the others is dropped.
"""

from collections.abc import Callable

import torch
from torch import Tensor

FULL_DEVICES = ("cuda",)
"""Kinds of device on which all lanes work. Tests add the CPU."""


def all_lanes(device: torch.device) -> bool:
    """Whether all lanes on a device do what some need."""
    return device.type in FULL_DEVICES


def lanes_of(needed: Tensor) -> Tensor | slice | None:
    """The lanes that work for those marked in ``needed`` [n], bool: their indices [k], or a slice of all; None where
    there is nothing to do.
    """
    if all_lanes(needed.device):
        return slice(None)
    lane = needed.nonzero().squeeze(-1)
    return None if len(lane) == 0 else lane


def put(values: Tensor, needed: Tensor, lanes: Tensor | slice, new: Tensor) -> Tensor:
    """``values`` [n, ...], in the lanes that ``needed`` [n] marks replaced by what ``lanes`` have found."""
    if isinstance(lanes, Tensor):
        return values.index_copy(0, lanes, new)
    return torch.where(needed.view(-1, *[1] * (values.dim() - 1)), new, values)


def where_needed(needed: Tensor, values: Tensor, make: Callable[[Tensor | slice], Tensor]) -> Tensor:
    """``values`` with those of the lanes that need it made anew.

    Args:
        needed: those lanes [n], bool.
        values: of all lanes [n, ...]; may carry gradients.
        make: gives the new values of the lanes that it is asked for, see :func:`lanes_of`; what others get is dropped,
            but its gradients must be finite.
    """
    lanes = lanes_of(needed)
    return values if lanes is None else put(values, needed, lanes, make(lanes))
