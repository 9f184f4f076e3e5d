"""NVIDIA Warp beside torch: kernels that read and write torch's tensors, on the GPU or, for tests, on the CPU.

Files of kernels import Warp at their top, so they are imported where a tensor needs them and nowhere else. Warp is an
optional package; it compiles a file of kernels at first use and keeps the result on disk.
"""

import functools
from typing import Any

import torch
from torch import Tensor


def load() -> Any:
    """The package, ready to launch and silent about it.

    Raises:
        ImportError, OSError: it is not installed, or its library cannot be loaded.
    """
    import warp

    wp: Any = warp
    wp.config.log_level = getattr(warp, "LOG_WARNING", 30)  # versions before 1.14 have ``quiet`` instead
    wp.config.quiet = True
    wp.init()
    return wp


@functools.cache
def is_available(kind: str) -> bool:
    """Whether Warp is installed and has devices of a kind, ``cuda`` or ``cpu``."""
    try:
        return bool(load().is_cuda_available()) or kind == "cpu"
    except (ImportError, OSError):
        return False


def launch(kernel: Any, dim: int | tuple[int, ...], device: torch.device, *arguments: Any) -> None:
    """Run a kernel, ``dim`` threads, on the tensors' device in the order of torch's own work there.

    Nothing is copied and nobody waits, so a launch may be part of a CUDA graph once the kernel is loaded, which its
    first launch does.

    Args:
        dim: threads along each of its axes.
        arguments: what the kernel takes; a tensor is seen as an array of the type that the kernel declares, whose
            vectors are the tensor's last axis.
    """
    wp = load()
    stream = wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None

    def array(x: Any, kind: Any) -> Any:
        if not isinstance(x, Tensor):
            return x
        return wp.from_torch(x, dtype=kind.dtype, requires_grad=False, return_ctype=True)

    given = [array(x, argument.type) for x, argument in zip(arguments, kernel.adj.args, strict=True)]
    wp.launch(kernel, dim=dim, inputs=given, device=wp.device_from_torch(device), stream=stream)
