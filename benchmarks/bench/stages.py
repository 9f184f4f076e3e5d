"""Where the time of a training step goes: the library's own functions, wrapped while the benchmark runs."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.bench.machine import wait
from datamodules.scene_data import SceneData
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.records import Rays
from neurad.fields import dense_grid, hash_grid, mlp
from neurad.integrators import vertex_diffuse, vertex_principled
from neurad.integrators.estimator import Estimator
from neurad.integrators.guide import Guide
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.world import World
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
    (LAYERS := "fields: grids and networks"),
    "fields: rest",
    (BACKWARD := "backward: grids and networks"),
    "backward: rest",
    "optimizers",
)
"""In the order of a step. Time counts where it is spent: rays cast for primary hits are tracing."""
GRIDS = (hash_grid.HashGrid, dense_grid.DenseGrid)


@dataclass
class Work:
    """Work of a stage in one step."""

    lanes: int = 0
    bytes: float = 0.0
    """Bytes that must be read or written at least once."""
    operations: float = 0.0
    """Floating-point operations of matrix products."""


@dataclass
class Recorder:
    """Times of the stages of one step after the other."""

    device: torch.device
    counting: bool = False
    """Count work rather than time."""
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    extra_bounce_seconds: float = 0.0
    """Seconds that the prior takes at hits of one more bounce, before its backward pass; part of the stages."""
    work: dict[str, Work] = field(default_factory=lambda: defaultdict(Work))
    closest: list[Rays] = field(default_factory=list)
    shadow: list[tuple[Rays, Tensor]] = field(default_factory=list)
    _stack: list[str] = field(default_factory=list)
    _last: float = 0.0
    _thread: int = field(default_factory=threading.get_ident)

    def take(self) -> tuple[dict[str, float], float]:
        """Seconds by stage, and those of the extra bounce, since the last call."""
        found, second = dict(self.seconds), self.extra_bounce_seconds
        self.seconds.clear()
        self.extra_bounce_seconds = 0.0
        return found, second

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
                out = function(*args, **kwargs)
            if self.counting and not name.startswith("backward"):  # counted with the forward stage
                self._count(name, args, out)
            return out

        return inner

    def wrap_extra_bounce(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, its time added to :attr:`extra_bounce_seconds`."""

        def inner(*args: Any, **kwargs: Any) -> Any:
            begin = self._now()
            out = function(*args, **kwargs)
            self.extra_bounce_seconds += self._now() - begin
            return out

        return inner

    def _count(self, name: str, args: tuple[Any, ...], out: Any) -> None:
        work = self.work[name]
        values = [t for part in (args[1:], out) for t in tensors(part)]
        work.lanes += len(values[0]) if values else 0
        work.bytes += sum(t.nbytes for t in {t.data_ptr(): t for t in values}.values())
        owner = args[0] if args else None
        if name == "tracing: closest":
            self.closest.append(args[1].detach())
        elif name == "tracing: shadow":
            self.shadow.append((args[1].detach(), args[2].detach()))
        elif name == LAYERS:
            back = self.work[BACKWARD]
            back.lanes += len(out) if out.requires_grad else 0
            if isinstance(owner, mlp.MLP):
                count = 2.0 * len(out) * sum(p.numel() for p in owner.parameters() if p.dim() == 2)
                work.operations += count
                if out.requires_grad:  # gradients of the inputs and of the weights
                    back.operations += 2 * count
            behind = (getattr(part, "grid", None) for part in args[1:])  # of a network that reads an encoding itself
            for grid in (part for part in (owner, *behind) if isinstance(part, GRIDS)):
                touched = table_bytes(grid, len(out))
                work.bytes += touched
                if out.requires_grad:  # entries are found again, and their gradients written
                    back.bytes += touched + values[0].nbytes + out.nbytes
        elif name == "optimizers":
            assert isinstance(owner, SparseRowAdam)
            for p in (p for group in owner.param_groups for p in group["params"] if p.grad is not None):
                entries = p.grad._values().numel() if p.grad.is_sparse else p.numel()
                work.bytes += 7.0 * 4 * entries  # gradient read; value and two moments read and written
                work.lanes += entries
        elif name in ("bsdf", "emitters", "geometry", "primary hits") and any(t.requires_grad for t in tensors(out)):
            self.work["backward: rest"].bytes += sum(t.nbytes for t in values)


def table_bytes(grid: nn.Module, lanes: int) -> float:
    """Bytes of entries that a lookup must read: eight corners a level and lane, each entry at most once."""
    if isinstance(grid, hash_grid.HashGrid):
        entries = grid.level_table[:, 3].clamp(max=8 * lanes).sum()
        return float(entries) * hash_grid.FEATURES * 4
    assert isinstance(grid, dense_grid.DenseGrid)
    return float(min(8 * lanes, len(grid.table))) * grid.channels * 4


def tensors(value: Any) -> list[Tensor]:
    """Every tensor in arguments, tuples and records."""
    if isinstance(value, Tensor):
        return [] if value.is_sparse else [value]
    if isinstance(value, (tuple, list)):
        return [t for part in value for t in tensors(part)]
    if is_dataclass(value) and not isinstance(value, type):
        return [t for f in fields(value) for t in tensors(getattr(value, f.name))]
    return []


@contextmanager
def instrumented(module: InverseRenderer, recorder: Recorder) -> Iterator[None]:
    """Wrap what a training step calls, and restore it at the end."""
    world: World = module.assembly.world
    fitted = module.assembly.materials
    parts: list[Any] = [
        *(fitted.recovered.values() if isinstance(fitted, FittedMaterials) else ()),
        module.assembly.radiance,
    ]
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
        *((grid, "forward", LAYERS) for grid in GRIDS),
        *((mlp.MLP, name, LAYERS) for name in ("_fused", "reference")),  # with the encoding before them, and without
        *((operation, "backward", BACKWARD) for operation in (hash_grid._Encode, mlp._Layers)),
    }
    before = []
    try:
        for owner, name, stage in plan:
            before.append((owner, name, owner.__dict__.get(name)))
            wrapped = recorder.wrap(stage, getattr(owner, name))
            setattr(owner, name, staticmethod(wrapped) if name == "backward" else wrapped)
        before.append((Estimator, "reflected", Estimator.__dict__["reflected"]))
        Estimator.reflected = recorder.wrap_extra_bounce(Estimator.reflected)  # type: ignore[method-assign]
        yield
    finally:
        for owner, name, original in before:
            if original is None:
                delattr(owner, name)
            else:
                setattr(owner, name, original)
