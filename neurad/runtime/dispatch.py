"""The one rule that decides between a kernel and its reference.

What is fast has two bodies with the same result: the *reference*, plain torch that runs on any device and is there to
be read, and a *kernel*, compiled for float32 on the CPU. Where a class or function has both, its flag is called
``use_kernels``, the reference ``reference`` or ``..._reference``, and the choice between them reads
``if use_kernel(self.use_kernels, x):``. Tests compare the two, values and gradients.
"""

from __future__ import annotations

import torch
from torch import Tensor


def use_kernel(enabled: bool, *tensors: Tensor, differentiable: bool = False) -> bool:
    """Whether the kernel runs, rather than its reference.

    Args:
        enabled: the flag ``use_kernels``, and whatever else the kernel depends on.
        tensors: floating-point tensors that the kernel reads. It takes float32 on the CPU.
        differentiable: the kernel finds derivatives itself; otherwise a tensor that requires a gradient is left to the
            reference.
    """
    return enabled and all(
        x.device.type == "cpu" and x.dtype == torch.float32 and (differentiable or not x.requires_grad) for x in tensors
    )
