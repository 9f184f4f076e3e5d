"""Choosing a tracer by name. Libraries are imported when they are chosen."""

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.protocols import Tracer
from neurad.core.suggest import did_you_mean
from neurad.runtime.warp import is_available

TRACERS = ("embree", "open3d", "warp")


def tracer_for(name: str, device: torch.device | str) -> str:
    """The tracer called ``name``; for ``auto`` the fastest on the device that is installed."""
    if name != "auto":
        return name
    return "warp" if torch.device(device).type == "cuda" and is_available("cuda") else "embree"


def make_tracer(name: str, vertices: Tensor, faces: Tensor) -> Tracer:
    """The tracer called ``name``, ``auto`` for that of a CPU, over triangles ``faces`` [F, 3] of ``vertices`` [V, 3].

    Raises:
        InputError: there is no tracer of that name, or the package that it needs is not installed.
    """
    if name in ("auto", "embree"):
        from neurad.tracing.embree import EmbreeTracer

        return EmbreeTracer(vertices, faces)
    if name == "open3d":
        from neurad.tracing.open3d import Open3DTracer

        return Open3DTracer(vertices, faces)
    if name == "warp":
        from neurad.tracing.warp import WarpTracer

        return WarpTracer(vertices, faces)
    near = did_you_mean(name, TRACERS)
    raise InputError(f"tracer {name}: there is none of that name, choose one of auto, {', '.join(TRACERS)}{near}")
