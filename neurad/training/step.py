"""One training step, the same for every driver: the trainer of ``neurad fit``, and :class:`TrainingRun` without one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.fields.mlp import products
from neurad.losses.relative import total
from neurad.runtime.threads import torch_on_one
from neurad.training.gradient_sync import GradientSync
from neurad.training.guard import Guard
from neurad.training.objective import StepTerms, make_objective
from neurad.training.schedule import Counters, Progress, learning_rate, rate_factor
from neurad.training.stages import AFTER_STEP, BEFORE, Stage, rate_progress
from neurad.training.training_views import TrainingViews


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
        device: of the random streams.
    """

    assembly: Assembly
    views: TrainingViews
    photographs: PhotoSource
    guard: Guard
    counters: Counters = field(default_factory=Counters)
    rank: int = 0
    processes: int = 1
    sync: GradientSync | None = None
    optimizers: Mapping[str, torch.optim.Optimizer] = field(default_factory=dict)
    device: torch.device | str = "cpu"
    objective: Callable[[PixelBatch, Stream], StepTerms] = field(init=False)
    """Losses of a batch, from a random stream of their own."""
    losses: dict[str, Tensor] = field(default_factory=dict, init=False)
    """Values of the last step's losses by name."""

    def __post_init__(self) -> None:
        """Make the objective."""
        self.objective = make_objective(self.assembly, self.views)

    def __call__(
        self, batch: PixelBatch, progress: Progress, backward: Callable[[Tensor], None] = torch.autograd.backward
    ) -> Tensor:
        """One iteration, with the stages that are due before and after it.

        Args:
            batch: pixels of the training views.
            progress: how much of the run is over.
            backward: accumulates the gradients of a scalar; a trainer brings its own.

        Returns:
            The weighted sum of the losses, without gradient.

        Raises:
            NotFinite: a loss, gradient or weight is NaN or infinite.
        """
        self._run(BEFORE, progress)
        if self.assembly.focus is not None:
            batch = self.assembly.focus.choose(batch, self._stream(2))
        settings = self.assembly.settings
        lanes = len(batch.view) * settings.sampling.spp * settings.sampling.samples_per_vertex  # path samples
        with torch_on_one():
            loss = self._iterate(batch, rate_progress(self.assembly, progress), backward)
        passes = self.processes * (2 if settings.objective.estimator == "two_pass" else 1)
        self.counters.samples += passes * lanes
        self._run(AFTER_STEP, progress)
        return loss

    def _run(self, stages: tuple[Stage, ...], progress: Progress) -> None:
        for stage in stages:
            if stage.due(self, progress):
                stage.run(self, progress)

    def _iterate(self, batch: PixelBatch, progress: float, backward: Callable[[Tensor], None]) -> Tensor:
        world, optimization = self.assembly.world, self.assembly.settings.optimization
        counters, lamps = self.counters, self.assembly.lamps
        # Stage 1: losses and gradients.
        for optimizer in self.optimizers.values():
            optimizer.zero_grad()
        with products(optimization.matmul):
            terms = self.terms(batch)
            loss = total(terms.all)
            backward(loss)
        # Stage 2: what other processes found, and the finiteness check.
        factor = rate_factor(optimization, counters.iteration, progress)
        recorded = self._bins(terms), self._scores(batch, terms)
        if self.sync is not None:
            factor, recorded = self.sync.average(factor, recorded)
        self.guard.check(counters.iteration, batch, terms.all, lambda: self.terms(batch))
        # Stage 3: parameters, guide and averages.
        for name, optimizer in self.optimizers.items():
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(optimization, name, counters.iteration, factor)
        for optimizer in self.optimizers.values():
            optimizer.step()
        if lamps is not None:
            lamps.update()
        if world.guide is not None and recorded[0] is not None:
            world.guide.record(*recorded[0])
            if (counters.iteration + 1) % world.guide.refresh == 0:  # later directions follow what was recorded
                world.guide.update()
        if self.assembly.focus is not None and recorded[1] is not None:
            self.assembly.focus.record(*recorded[1], counters.iteration)
        counters.iteration += 1
        if self.assembly.average is not None:
            self.assembly.average.update(counters.iteration)
        self.losses = {name: term.value for name, (_, term) in terms.all.items()}
        return loss.detach()

    def terms(self, batch: PixelBatch) -> StepTerms:
        """The losses of this iteration; the same ones at every call until the weights move."""
        return self.objective(batch, self._stream(1))

    def _stream(self, purpose: int) -> Stream:
        """Random numbers of this iteration, the same at every call."""
        return Stream(self.assembly.settings.seed, self.counters.iteration, self.rank, purpose, device=self.device)

    def _bins(self, terms: StepTerms) -> tuple[Tensor, Tensor] | None:
        """Bins [n] of the guide's histogram and what is to be added there [n, 2]; None without a guide or samples."""
        guide, samples = self.assembly.world.guide, terms.guide_samples
        if guide is None or samples is None:
            return None
        return guide.bin_samples(samples.si, samples.wi, samples.radiance)

    def _scores(self, batch: PixelBatch, terms: StepTerms) -> tuple[Tensor, Tensor] | None:
        """What the gradients by roughness say of where pixels are to be drawn."""
        gradient = None if terms.roughness is None else terms.roughness.grad
        return None if self.assembly.focus is None or gradient is None else self.assembly.focus.rows(batch, gradient)
