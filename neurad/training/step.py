"""One training step, the same for every driver: the trainer of ``neurad fit``, and :class:`TrainingRun` without one."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.fields.mlp import products
from neurad.integrators.focus import REFRESH
from neurad.losses.relative import total
from neurad.optim.eager import EagerOptimizer
from neurad.runtime.threads import torch_on_one
from neurad.training.diffuse_lobe import keep_in_range
from neurad.training.gradient_sync import GradientSync
from neurad.training.guard import Guard
from neurad.training.objective import ObjectiveStep, StepTerms
from neurad.training.replayed_step import ReplayedStep, why_not_replayed
from neurad.training.roughness_start import roughness_begins
from neurad.training.schedule import Counters, Progress, learning_rate, rate_factor
from neurad.training.stages import AFTER_STEP, BEFORE, Stage, rate_progress
from neurad.training.training_views import TrainingViews

READ_EVERY = 64
"""Iterations between two questions to a GPU whether all was finite."""


@dataclass(frozen=True)
class StepGradients:
    """What a step finds before it updates anything; the gradients stand at the parameters."""

    batch: PixelBatch
    """The pixels that it took."""
    terms: StepTerms
    loss: Tensor
    """Their weighted sum, without gradient."""
    bins: tuple[Tensor, Tensor] | None
    """Entries of the guide's histogram [n] and what is to be added there [n, 2]."""
    scores: tuple[Tensor, Tensor] | None
    """Blocks of pixels [b] and what is to be added to their scores [b, 2]."""


@dataclass
class TrainingStep:
    """Losses, one backward pass whose gradients never meet, and a step of each optimizer.

    Attributes:
        assembly: what is trained.
        views: the training views.
        photographs: of them.
        guard: stops at the first number that is not finite.
        counters: carried on by a continued run.
        rank: number of this process; each has its own random streams.
        processes: how many there are.
        sync: exchange of gradients between them; None for one process.
        optimizers: by the names of their learning rates.
    """

    assembly: Assembly
    views: TrainingViews
    photographs: PhotoSource
    guard: Guard
    counters: Counters = field(default_factory=Counters)
    rank: int = 0
    processes: int = 1
    sync: GradientSync | None = None
    optimizers: Mapping[str, EagerOptimizer] = field(default_factory=dict)
    objective: Callable[[PixelBatch, Stream], StepTerms] = field(init=False)
    """Losses of a batch, from a random stream of their own."""
    replayed: ReplayedStep | None = field(default=None, init=False)
    """The step without a question to the device, from the first call on; None where it asks."""
    losses: dict[str, Tensor] = field(default_factory=dict, init=False)
    """Values of the last step's losses by name."""
    _decided: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        settings, views = self.assembly.settings, self.views
        self.objective = ObjectiveStep(
            self.assembly.estimator, views.primary, settings.sampling, settings.objective,
            settings.objective.epsilon * views.mean_square_radiance, views.emitter_mask, self.assembly.development,
        )  # fmt: skip

    def __call__(
        self, batch: PixelBatch, progress: Progress, backward: Callable[[Tensor], None] = torch.autograd.backward
    ) -> Tensor:
        """One iteration, with the stages that are due before and after it.

        Args:
            backward: accumulates the gradients of a scalar; a trainer brings its own.

        Returns:
            The weighted sum of the losses, without gradient.

        Raises:
            NotFinite: a loss, gradient or weight is NaN or infinite; on a GPU within :data:`READ_EVERY` iterations.
        """
        if not self._decided:
            self._decide()
        self._run(BEFORE, progress)
        settings = self.assembly.settings
        with torch_on_one():
            factor = rate_factor(settings.optimization, self.counters.iteration, rate_progress(self.assembly, progress))
            if self.replayed is None:
                found = self._eager(batch, factor, backward)
            else:
                self._set_rates(factor)
                found = self.replayed(batch, backward)
            self._finish(found)
        lanes = len(found.batch.view) * settings.sampling.spp * settings.sampling.samples_per_vertex  # path samples
        self.counters.samples += self.processes * (2 if settings.objective.estimator == "two_pass" else 1) * lanes
        self._run(AFTER_STEP, progress)
        return found.loss

    def check(self) -> None:
        """Ask the device whether all steps so far were finite, where it is not asked in each.

        Raises:
            NotFinite: one was not; the counters are those of the first, and so are the weights.
        """
        bad = None if self.replayed is None else self.replayed.flag.read()
        if bad is None:
            return
        self.replayed = None  # the run is over: now each quantity is looked at
        self.counters.iteration, batch = bad
        found = self.gradients(batch, torch.autograd.backward)
        self.guard.check(self.counters.iteration, batch, found.terms.all, lambda: self.terms(batch))
        self.guard.stop(self.counters.iteration, "a loss or gradient was not finite, but is when it is repeated", batch)

    @property
    def device(self) -> torch.device:
        """Of all that it trains."""
        return self.assembly.world.geometry.vertices.device

    def _decide(self) -> None:
        """Whether steps ask the device; a line where that costs a GPU its graph."""
        self._decided, reason = True, why_not_replayed(self)
        if reason is None:
            self.replayed = ReplayedStep(self)
        elif self.device.type == "cuda" and self.rank == 0:
            print(f"neurad: a training step runs without a CUDA graph: {reason}", file=sys.stderr)

    def _run(self, stages: tuple[Stage, ...], progress: Progress) -> None:
        for stage in stages:
            if stage(self, progress) and self.replayed is not None:
                self.replayed.changed = True

    def _eager(self, batch: PixelBatch, factor: float, backward: Callable[[Tensor], None]) -> StepGradients:
        """Losses and gradients, looked at at once, and the updates."""
        found = self.gradients(self.chosen(batch), backward)
        if self.sync is not None:
            factor, (bins, scores) = self.sync.average(factor, (found.bins, found.scores))
            found = replace(found, bins=bins, scores=scores)
        again = found.batch
        self.guard.check(self.counters.iteration, again, found.terms.all, lambda: self.terms(again))
        self._set_rates(factor)
        self.update(found)
        return found

    def _set_rates(self, factor: float) -> None:
        settings, iteration = self.assembly.settings, self.counters.iteration
        for name, optimizer in self.optimizers.items():
            rate = learning_rate(settings.optimization, name, iteration, factor, roughness_begins(settings))
            for group in optimizer.param_groups:
                group["lr"] = rate

    def chosen(self, batch: PixelBatch) -> PixelBatch:
        """The pixels of a batch that the step takes."""
        return batch if self.assembly.focus is None else self.assembly.focus.choose(batch, self._stream(2))

    def gradients(self, batch: PixelBatch, backward: Callable[[Tensor], None]) -> StepGradients:
        """Losses, one backward pass, and what is to be recorded of them; nothing of the run is changed."""
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        with products(self.assembly.settings.optimization.matmul):
            terms = self.terms(batch)
            loss = total(terms.all)
            backward(loss)
        return StepGradients(batch, terms, loss.detach(), self._bins(terms), self._scores(batch, terms))

    def update(self, found: StepGradients) -> None:
        """Parameters, and what guide and scores of pixels record."""
        for optimizer in self.optimizers.values():
            optimizer.step()
        if self.assembly.lamps is not None:
            self.assembly.lamps.update()
        materials = self.assembly.materials
        if isinstance(materials, FittedMaterials) and materials.looks_for_lobe:
            keep_in_range(materials)
        if self.assembly.world.guide is not None and found.bins is not None:
            self.assembly.world.guide.record(*found.bins)
        if self.assembly.focus is not None and found.scores is not None:
            self.assembly.focus.record(*found.scores)

    def _finish(self, found: StepGradients) -> None:
        """What follows the updates from time to time."""
        done, guide, focus = self.counters.iteration + 1, self.assembly.world.guide, self.assembly.focus
        if done % READ_EVERY == 0:
            self.check()
        if guide is not None and found.bins is not None and done % guide.refresh == 0:
            guide.update()  # later directions follow what was recorded
        if focus is not None and found.scores is not None and done % REFRESH == 0:
            focus.update()
        self.counters.iteration = done
        if self.assembly.average is not None:
            self.assembly.average.update(done)
        self.losses = {name: term.value for name, (_, term) in found.terms.all.items()}

    def terms(self, batch: PixelBatch) -> StepTerms:
        """The losses of this iteration; the same ones at every call until the weights move."""
        return self.objective(batch, self._stream(1))

    def key(self, purpose: int) -> tuple[int, ...]:
        """What random numbers of this iteration depend on."""
        return self.assembly.settings.seed, self.counters.iteration, self.rank, purpose

    def _stream(self, purpose: int) -> Stream:
        """Random numbers of this iteration, the same at every call."""
        if self.replayed is not None:
            return self.replayed.streams[purpose]
        return Stream(*self.key(purpose), device=self.device)

    def _bins(self, terms: StepTerms) -> tuple[Tensor, Tensor] | None:
        """Bins [n] of the guide's histogram and what is to be added there [n, 2]; None without a guide or samples."""
        guide, samples = self.assembly.world.guide, terms.guide_samples
        if guide is None or samples is None:
            return None
        return guide.bin_samples(*samples)

    def _scores(self, batch: PixelBatch, terms: StepTerms) -> tuple[Tensor, Tensor] | None:
        """What the gradients by roughness say of where pixels are to be drawn."""
        gradient = None if terms.roughness is None else terms.roughness.grad
        return None if self.assembly.focus is None or gradient is None else self.assembly.focus.rows(batch, gradient)
