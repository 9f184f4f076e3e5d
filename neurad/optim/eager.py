"""What neurad's optimizers share: a quick start, and learning rates that a captured step reads."""

from abc import abstractmethod
from collections.abc import Callable
from inspect import unwrap
from typing import Any

import torch
from torch import Tensor


class DeviceRates:
    """Copies of an optimizer's learning rates, a scalar a group and device.

    A CUDA graph replays what it was captured with, so a learning rate given to a kernel as a number would stay for
    ever; one in memory may be changed between replays.
    """

    def __init__(self, optimizer: torch.optim.Optimizer) -> None:
        self._optimizer = optimizer
        self.gate: Tensor | None = None
        """Scalar on the device that all copies are multiplied by in each step, 0 to leave parameters as they are."""
        self._copies: dict[tuple[int, torch.device], Tensor] = {}

    def write(self) -> None:
        """Take the rates from ``param_groups``, but not while a CUDA graph is captured."""
        for (index, device), copy in self._copies.items():
            if device.type != "cuda" or not torch.cuda.is_current_stream_capturing():
                copy.fill_(self._optimizer.param_groups[index]["lr"])

    def close(self) -> None:
        """Multiply the copies by the gate: as a part of the step, captured with it."""
        if self.gate is not None:
            for copy in self._copies.values():
                copy.mul_(self.gate)

    def of(self, index: int, device: torch.device) -> Tensor:
        """The rate of a group, float32 []."""
        if (index, device) not in self._copies:
            rate = self._optimizer.param_groups[index]["lr"]
            self._copies[index, device] = torch.full((), rate, dtype=torch.float32, device=device)
        return self._copies[index, device]


class EagerOptimizer(torch.optim.Optimizer):
    """Torch's optimizer without the wrapper that keeps ``torch.compile`` out of its methods: it imports all of that
    first, which takes a second of each start.
    """

    add_param_group = unwrap(torch.optim.Optimizer.add_param_group)
    load_state_dict = unwrap(torch.optim.Optimizer.load_state_dict)
    state_dict = unwrap(torch.optim.Optimizer.state_dict)
    zero_grad = unwrap(torch.optim.Optimizer.zero_grad)

    def __init__(self, params: Any, defaults: dict[str, Any]) -> None:
        super().__init__(params, defaults)
        self.rates = DeviceRates(self)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """One update of every parameter that has a gradient."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        self.rates.write()
        self.rates.close()
        for index, group in enumerate(self.param_groups):
            self.update(index, group, [p for p in group["params"] if p.grad is not None])
        return loss

    @abstractmethod
    def update(self, index: int, group: dict[str, Any], params: list[Tensor]) -> None:
        """Update those parameters of a group that have a gradient."""
