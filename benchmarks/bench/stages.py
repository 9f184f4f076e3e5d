"""Where the time of a training step goes: the library's own functions, wrapped while the benchmark runs."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from benchmarks.bench.machine import wait
from datamodules.scene_data import SceneData
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.fields import dense_grid, hash_grid, mlp
from neurad.integrators import vertex_diffuse, vertex_principled
from neurad.integrators.guide import Guide
from neurad.integrators.primary_hits import PrimaryHits
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.training.inverse import InverseRenderer

STAGES = (
    "batch",
    "primary hits",
    "geometry",
    "emitters",
    "bsdf",
    "tracing: closest",
    "tracing: shadow",
    "fields: grids and networks",
    "fields: rest",
    "backward: grids and networks",
    "backward: rest",
    "optimizers",
)
"""In the order of a step. Time counts where it is spent: rays cast for primary hits are tracing."""


@dataclass
class Recorder:
    """Times of the stages of one step after the other."""

    device: torch.device
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    _stack: list[str] = field(default_factory=list)
    _last: float = 0.0
    _thread: int = field(default_factory=threading.get_ident)

    def take(self) -> dict[str, float]:
        """Seconds by stage since the last call."""
        found = dict(self.seconds)
        self.seconds.clear()
        return found

    def _now(self) -> float:
        wait(self.device)
        return time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time spent here counts as ``name``, what is nested deeper as its own."""
        now = self._now()
        if self._stack:
            self.seconds[self._stack[-1]] += now - self._last
        self._stack.append(name)
        self._last = now
        try:
            yield
        finally:
            now = self._now()
            self.seconds[self._stack.pop()] += now - self._last
            self._last = now

    def wrap(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function`` as a part of stage ``name``."""

        def inner(*args: Any, **kwargs: Any) -> Any:
            if threading.get_ident() != self._thread:
                return function(*args, **kwargs)
            with self.stage(name):
                return function(*args, **kwargs)

        return inner


@contextmanager
def instrumented(module: InverseRenderer, recorder: Recorder) -> Iterator[None]:
    """Wrap what a training step calls, and restore it at the end."""
    world, fitted = module.assembly.world, module.assembly.materials
    recovered = fitted.recovered.values() if isinstance(fitted, FittedMaterials) else ()
    parts: list[Any] = [*recovered, module.assembly.radiance]
    plan: set[tuple[Any, str, str]] = {
        (SceneData, "batch", "batch"),
        (PrimaryHits, "__call__", "primary hits"),
        (type(module), "manual_backward", "backward: rest"),
        (SparseRowAdam, "step", "optimizers"),
        (type(world.tracer), "closest", "tracing: closest"),
        (type(world.tracer), "occluded", "tracing: shadow"),
        *((type(world.geometry), name, "geometry") for name in ("interact", "interact_at", "spawn", "spawn_towards")),
        *((type(world.lights), name, "emitters") for name in ("sample", "eval", "pdf")),
        *((type(world.bsdf), name, "bsdf") for name in ("eval", "pdf", "eval_pdf", "sample")),
        *((Guide, name, "bsdf") for name in ("rows", "warp", "density", "bin_samples", "record", "update")),
        (vertex_principled, "bounce_principled", "bsdf"),  # a bounce without its rays and the albedo
        (vertex_diffuse, "bounce_diffuse", "bsdf"),
        *((type(part), "forward", "fields: rest") for part in parts if isinstance(part, nn.Module)),
        *((grid, "forward", "fields: grids and networks") for grid in (hash_grid.HashGrid, dense_grid.DenseGrid)),
        # with the encoding before them, and without
        *((mlp.MLP, name, "fields: grids and networks") for name in ("_fused", "reference")),
        *((operation, "backward", "backward: grids and networks") for operation in (hash_grid._Encode, mlp._Layers)),
    }
    before = []
    try:
        for owner, name, stage in plan:
            before.append((owner, name, owner.__dict__.get(name)))
            wrapped = recorder.wrap(stage, getattr(owner, name))
            setattr(owner, name, staticmethod(wrapped) if name == "backward" else wrapped)
        yield
    finally:
        for owner, name, original in before:
            if original is None:
                delattr(owner, name)
            else:
                setattr(owner, name, original)
