"""What the camera rays and photographs of a run take of the memory, said before it is taken."""

from collections.abc import Sequence

import torch

from neurad.core.errors import InputError
from neurad.core.scene_records import Camera
from neurad.runtime.memory import free_memory, resident_memory
from neurad.runtime.progress import say

LARGE = 1 << 30
"""Bytes from which on it is said what is taken."""
_HIT, _DIRECTION, _MASK = 12, 6, 1


def announce_camera_rays(
    cameras: Sequence[Camera], cached_spp: int, has_environment: bool, device: torch.device | str
) -> None:
    """One line about what kept camera rays and the emitter mask take, if it is much: for each pixel a byte, and for
    each kept ray a triangle and barycentrics, in a scene with an environment its direction too.

    Args:
        cached_spp: kept rays of a pixel.
        device: that they are kept on; only a CPU's memory is compared with what is free.

    Raises:
        InputError: the machine does not have as much.
    """
    pixels = sum(camera.width * camera.height for camera in cameras)
    needed = pixels * (_MASK + cached_spp * (_HIT + (_DIRECTION if has_environment else 0)))
    if cached_spp == 0 or needed < LARGE:
        return
    size = " or ".join(dict.fromkeys(f"{camera.width} x {camera.height}" for camera in cameras))
    what = f"the camera rays of {len(cameras)} views of {size} pixels take {needed / 1e9:.3g} GB of memory"
    free = free_memory() if torch.device(device).type == "cpu" else None
    stream = "--model.sampling.cached_spp 0 --data.resident 1"
    if free is not None and needed > free:
        raise InputError(f"{what}, and {free / 1e9:.3g} GB are free: stream them with {stream}")
    whole = "" if free is None else f", so the process has {(resident_memory() + needed) / 1e9:.3g} GB then"
    minutes = max(1, round(cached_spp * pixels / 5e6 / 60))  # five million rays a second are usual on a core
    say(f"{what} (about {minutes} min to trace){whole}; {stream} keeps none")
