"""Learning rates that lie on the device, where a captured step reads them."""

from __future__ import annotations

import torch
from torch import Tensor


class DeviceRates:
    """Copies of an optimizer's learning rates, a scalar a group and device.

    A CUDA graph replays what it was captured with, so a learning rate given to a kernel as a number would stay for
    ever; one in memory may be changed between replays.
    """

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self._optimizer = optimizer
        self._copies: dict[tuple[int, torch.device], Tensor] = {}

    def write(self) -> None:
        """Take the rates from ``param_groups``, but not while a CUDA graph is captured."""
        for (index, device), copy in self._copies.items():
            if device.type != "cuda" or not torch.cuda.is_current_stream_capturing():
                copy.fill_(self._optimizer.param_groups[index]["lr"])

    def of(self, index: int, device: torch.device) -> Tensor:
        """The rate of a group, float32 []."""
        if (index, device) not in self._copies:
            rate = self._optimizer.param_groups[index]["lr"]
            self._copies[index, device] = torch.full((), rate, dtype=torch.float32, device=device)
        return self._copies[index, device]
