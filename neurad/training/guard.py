"""Stops a run at the first number that is not finite, names it, and stores what is needed to reproduce it.

Nothing is ever replaced: a NaN that is turned into 0 is a wrong result that looks right. The check of a step is a sum
over each loss and gradient. Only when it fails is the step repeated, which gives the same numbers since random streams
are counters, with every return value of this package's functions checked: the first bad one is the cause.
"""

import dataclasses
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from neurad import assembly, bsdf, emitters, fields, integrators, losses, training
from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray, PixelBatch
from neurad.losses.relative import Loss
from neurad.optim.eager import EagerOptimizer
from neurad.runtime.files import make_folder, replacing
from neurad.runtime.reading import listed

SCAN_EVERY = 100
"""Iterations between two checks of the weights themselves: what is NaN or grows infinite appears in loss and gradients,
but for entries of tables that no lane reads."""
SMALL = 1 << 16
"""Gradients of at most this many values are added up together."""
_WATCHED = tuple(package.__name__ for package in (integrators, bsdf, emitters, fields, assembly, training, losses))
_UNBOUNDED = ("distance", "t", "t_max")
"""Fields of records that are infinite where a ray meets nothing."""


class NotFinite(InputError):
    """A loss, gradient, weight or image holds NaN or infinity."""


class FiniteFlag:
    """The first iteration that was not finite, kept on the device, which is not asked in every step. From that one on
    nothing is updated, so what led to it is still there when the flag is read.

    Args:
        optimizers: that take no step any more then.
    """

    def __init__(self, device: torch.device | str, optimizers: Iterable[EagerOptimizer]) -> None:
        self.iteration = torch.zeros((), dtype=torch.int64, device=device)
        """Number of the step; the host writes it."""
        self.first = torch.full_like(self.iteration, -1)
        self.gate = torch.ones((), device=device)
        """1 while all was finite, then 0."""
        self.batch: PixelBatch | None = None
        """Pixels of the first step that was not, or of the last one."""
        for optimizer in optimizers:
            optimizer.rates.gate = self.gate

    def watch(self, batch: PixelBatch, losses: Sequence[Tensor], gradients: Sequence[Tensor]) -> None:
        """Look at a step, and take out its gradients if it or one before was not finite."""
        finite = torch.isfinite(torch.stack([x.sum() for x in (*losses, *gradients)])).all()
        before = self.first < 0
        assert self.batch is not None
        self.batch.copy_(batch, before)
        self.first.copy_(torch.where(before & ~finite, self.iteration, self.first))
        stopped = self.first >= 0
        self.gate.copy_((~stopped).float())
        for gradient in gradients:
            gradient.masked_fill_(stopped, 0.0)

    def kept(self, values: Tensor) -> Tensor:
        """``values`` of a step, zeros where it was the first that was not finite or came after it."""
        return torch.where(self.gate > 0, values, 0.0)

    def read(self) -> tuple[int, PixelBatch] | None:
        """The first iteration that was not finite and its batch, None if all were; the flag starts anew then."""
        first = int(self.first)
        if first < 0 or self.batch is None:
            return None
        self.first.fill_(-1)
        return first, self.batch


class Guard:
    """Checks the steps of one run.

    Args:
        keep: stores the weights and the batch, if there is one; called with the iteration and the
            cause, and returns what the message adds about it. None where nothing is stored.
    """

    def __init__(self, module: nn.Module, keep: Callable[[int, str, PixelBatch | None], str] | None = None) -> None:
        self.module = module
        self.keep = keep
        self._parameters: list[Tensor] = []

    def check(
        self, iteration: int, batch: PixelBatch, terms: Mapping[str, tuple[float, Loss]], again: Callable[[], object]
    ) -> None:
        """After the backward pass and before the optimizers: nothing of this step may be NaN or infinite.

        Args:
            again: repeats the forward pass of the step, for the diagnosis.

        Raises:
            NotFinite: with the first bad quantity, the batch, and where that is kept.
        """
        scan = not self._parameters or iteration % SCAN_EVERY == 0
        if scan:  # which takes as long as ten sums
            self._parameters = list(self.module.parameters())
        values = [_values(p.grad) for p in self._parameters if p.grad is not None]
        values += [p.detach() for p in self._parameters if scan]
        values += [x.detach() for _, loss in terms.values() for x in (loss.value, loss.surrogate)]
        small = torch.cat([x.reshape(-1) for x in values if x.numel() <= SMALL])  # one sum for all networks
        sums = [small.sum(), *(x.sum() for x in values if x.numel() > SMALL)]
        if bool(torch.isfinite(torch.stack(sums)).all()):
            return
        self.stop(iteration, self._cause(batch, terms, again), batch)

    def images(self, iteration: int, maps: list[dict[str, FloatArray]], names: list[str]) -> None:
        """Pictures of held-out views must be finite too.

        Raises:
            NotFinite: one is not; the weights are kept.
        """
        for name, entry in zip(names, maps, strict=True):
            for kind in ("render", "residual", *RECOVERED):
                picture = torch.from_numpy(entry[kind]) if kind in entry else torch.zeros(1)
                if not bool(torch.isfinite(picture).all()):
                    text = f"the picture {kind} of view {name} is not finite ({_bad_fraction(picture)} values)"
                    self.stop(iteration, self._weight() or text, None)

    # ---- diagnosis

    def _cause(self, batch: PixelBatch, terms: Mapping[str, tuple[float, Loss]], again: Callable[[], object]) -> str:
        """The first quantity that is not finite, in the order in which a step computes them."""
        if not bool(torch.isfinite(batch.color).all()):
            return f"the photographs are not finite ({_bad_fraction(batch.color)} values of the batch)"
        if weight := self._weight():
            return weight
        if first := first_bad(again):
            return first
        for name, (_, loss) in terms.items():
            if not bool(torch.isfinite(loss.value) & torch.isfinite(loss.surrogate)):
                return f"the loss {name} is not finite"
        for name, p in self.module.named_parameters():
            if p.grad is not None and not bool(torch.isfinite(_values(p.grad)).all()):
                return f"the gradient of {name} is not finite ({_bad_fraction(_values(p.grad))} values)"
        return "the sum of losses and gradients is not finite, though each of them is"

    def _weight(self) -> str | None:
        for name, p in self.module.named_parameters():
            if not bool(torch.isfinite(p.detach()).all()):
                return f"the weight {name} is not finite ({_bad_fraction(p.detach())} values)"
        return None

    # ---- the end

    def stop(self, iteration: int, cause: str, batch: PixelBatch | None) -> None:
        """Store the batch and the weights, and end the run.

        Raises:
            NotFinite: always.
        """
        kept = "" if self.keep is None else self.keep(iteration, cause, batch)
        where = "" if batch is None else f" (batch of {_pixels(batch)})"
        raise NotFinite(f"iteration {iteration}: {cause}{where}{kept}")


def keep_in_run_folder(trainer: pl.Trainer | None, iteration: int, cause: str, batch: PixelBatch | None) -> str:
    """Store ``bad.ckpt`` and ``bad_batch.pt`` in the run folder, if there is one, and return how to repeat the step."""
    # The logger's own folder: the trainer's needs a broadcast among all processes, and only this one gets here.
    place = getattr(getattr(trainer, "logger", None), "log_dir", None)
    if trainer is None or place is None:
        return ""
    folder = Path(place)
    make_folder(folder / "checkpoints")
    trainer.save_checkpoint(folder / "checkpoints" / "bad.ckpt")
    if batch is not None:
        tensors = {name: getattr(batch, name) for name in ("view", "pixel", "color", "alpha")}
        with replacing(folder / "bad_batch.pt") as part, part.open("wb") as file:
            torch.save({"iteration": iteration, "cause": cause, **tensors}, file)
    return f"; `neurad fit --ckpt_path {folder / 'checkpoints' / 'bad.ckpt'}` repeats it"


def first_bad(run: Callable[[], object]) -> str | None:
    """The first return value of this package's functions that is NaN or infinite while ``run`` is called.

    Distances of rays that meet nothing may be infinite. The call is slow: it runs with gradients and a profiler.
    """
    found: list[str] = []

    def watch(frame: FrameType, event: str, value: Any) -> None:
        if event != "return" or found or value is None:
            return
        module = str(frame.f_globals.get("__name__", ""))
        if not module.startswith(_WATCHED):
            return
        for part, tensor in _tensors(value, ""):
            bad = ~torch.isfinite(tensor.detach())
            if bool(bad.any()):
                name = f"{module.partition('.')[2]}.{frame.f_code.co_qualname}{part}"
                found.append(f"what {name} returned is not finite ({_bad_fraction(tensor.detach())} values)")
                return

    before = sys.getprofile()
    sys.setprofile(watch)
    try:
        run()
    finally:
        sys.setprofile(before)
    return found[0] if found else None


def _tensors(value: Any, path: str) -> list[tuple[str, Tensor]]:
    """Floating-point tensors in a return value, and where in it they are."""
    if isinstance(value, Tensor):
        return [(path, value)] if value.is_floating_point() and not value.is_sparse else []
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        inside = [(f.name, getattr(value, f.name, None)) for f in dataclasses.fields(value) if f.name not in _UNBOUNDED]
        return [pair for name, x in inside if not isinstance(x, nn.Module) for pair in _tensors(x, f"{path}.{name}")]
    if isinstance(value, tuple):
        return [pair for i, x in enumerate(value) for pair in _tensors(x, f"{path}[{i}]")]
    return []


def _values(gradient: Tensor) -> Tensor:
    return gradient._values() if gradient.is_sparse else gradient


def _bad_fraction(x: Tensor) -> str:
    """How many of a tensor's values are NaN or infinite, in words."""
    return f"{int((~torch.isfinite(x)).sum())} of {x.numel()}"


def _pixels(batch: PixelBatch) -> str:
    views = sorted(set(batch.view.tolist()))
    first = f"view {int(batch.view[0])} pixel {int(batch.pixel[0])}"
    return f"{len(batch.view)} pixels of views {listed(views)}, the first {first}"
