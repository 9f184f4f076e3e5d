"""What settings that are ``auto`` become on this machine."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from neurad.runtime import warp
from neurad.runtime.progress import say

GPU = ("gpu", "cuda")
"""Names of the trainer's accelerator that mean a GPU."""
CPU_PIXELS, GPU_PIXELS = 512, 4096
"""Pixels of a batch for a thread of a CPU, and on a GPU. Batches 16 times as large learn as much per sample, so they
pay where a larger one takes hardly longer."""
MAX_PIXELS = 1024
"""Pixels of a batch on a CPU at most, and of the largest batch that learning rates grow for."""
_DRIVER = Path("/proc/driver/nvidia/gpus")


def accelerator(given: Any, tracer: Any) -> Any:
    """The trainer's accelerator: for ``auto`` the GPU where all of a step runs on it, otherwise the CPU, and a line on
    stderr says why if there is a GPU.
    """
    if given != "auto":
        return given
    reason = _why_not_gpu(tracer)
    if reason is None:
        return "gpu"
    if reason and os.environ.get("LOCAL_RANK", "0") == "0":
        say(f"runs on the CPU though there is a GPU: {reason}")
    return "cpu"


def _why_not_gpu(tracer: Any) -> str | None:
    """Why the GPU would not be faster; empty where there is none, None where it would."""
    if not torch.cuda.is_available():
        if torch.version.cuda is None or not _DRIVER.is_dir():
            return ""
        return f"torch is built for CUDA {torch.version.cuda}, for which its driver is too old"
    if tracer not in ("auto", "warp"):
        return f"model.tracer {tracer} casts rays on the CPU"
    if find_spec("warp") is None:
        return "NVIDIA Warp, which casts rays there, is not installed; `pip install 'neurad[gpu]'` does it"
    if not warp.is_available("cuda"):
        return "NVIDIA Warp, which casts rays there, cannot use it; it needs driver R580 or later"
    return None


def patches(given: Any, patch_size: int, accelerator: Any) -> int:
    """Patches of a batch: for ``auto`` as many as have the pixels that suit the accelerator."""
    if given != "auto":
        return int(given)
    pixels = GPU_PIXELS if accelerator in GPU else min(CPU_PIXELS * torch.get_num_threads(), MAX_PIXELS)
    return max(1, pixels // patch_size**2)


def rates_for(optimization: Any, pixels: int) -> None:
    """Let the rate of roughness, which is meant for a batch of ``batch`` pixels, be that for one of so many: the square
    root rule (Malladi et al. 2022, "On the SDEs and Scaling Rules for Adaptive Gradient Algorithms"). Entries of the
    other tables are touched by few pixels of any batch, so that as many samples make as many steps there.
    """
    if optimization["batch"] is None:
        return
    times = min(pixels, MAX_PIXELS) / optimization["batch"]
    optimization["roughness"] *= times**0.5
    optimization["batch"] = min(pixels, MAX_PIXELS)
