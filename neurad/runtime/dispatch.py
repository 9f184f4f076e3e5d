"""The one rule that decides between a kernel and its reference.

What is fast has two bodies with the same result: the *reference*, plain torch that runs on any device and is there to
be read, and a *kernel*, compiled for float32 on the CPU; what is hot on a GPU has a kernel of NVIDIA Warp too. Where a
class or function has them, its flag is called ``use_kernels``, the reference ``reference`` or ``..._reference``, and
the choice reads ``if use_kernel(self.use_kernels, x):``, after ``if use_warp(self.use_kernels, x):``. Tests compare
kernels with their reference, values and gradients.
"""

import torch
from torch import Tensor

from neurad.runtime import warp

KERNEL_DEVICES = ("cpu",)
"""Kinds of device that have kernels compiled by numba. Tests of what a GPU does take the CPU out."""
WARP_DEVICES = ("cuda",)
"""Kinds of device that have Warp's kernels. Tests add the CPU, where Warp runs them too, on one thread."""


def use_kernel(enabled: bool, *tensors: Tensor, differentiable: bool = False) -> bool:
    """Whether the kernel runs, rather than its reference.

    Args:
        enabled: the flag ``use_kernels``, and whatever else the kernel depends on.
        tensors: floating-point tensors that the kernel reads. It takes float32 on the CPU.
        differentiable: the kernel finds derivatives itself; otherwise a tensor that requires a gradient is left to the
            reference.
    """
    if not enabled:
        return False
    for x in tensors:  # a hundred times a step: a generator would take twice the time
        if x.dtype is not torch.float32 or x.device.type not in KERNEL_DEVICES:
            return False
        if x.requires_grad and not differentiable:
            return False
    return True


def use_warp(enabled: bool, *tensors: Tensor) -> bool:
    """Whether the kernel of NVIDIA Warp runs: for float32 on a GPU, where the package is installed and finds it.

    Args:
        enabled: the flag ``use_kernels``, and whatever else the kernel depends on.
        tensors: floating-point tensors that the kernel reads; it finds its derivatives itself.
    """
    return enabled and all(
        x.device.type in WARP_DEVICES and x.dtype == torch.float32 and warp.is_available(x.device.type) for x in tensors
    )
