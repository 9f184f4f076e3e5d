"""A training step that asks its device nothing, so that on a GPU two CUDA graphs are all of it."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.emitters.area import AreaLights
from neurad.integrators.direct import Direct
from neurad.integrators.radiometric import Radiometric
from neurad.losses.relative import Loss
from neurad.runtime.lanes import all_lanes
from neurad.runtime.step_graph import StepGraph
from neurad.tracing.warp import WarpTracer
from neurad.training.guard import FiniteFlag

if TYPE_CHECKING:
    from neurad.training.step import StepGradients, TrainingStep

MAX_BOUNCES = 3
"""Bounces before the radiance field up to which a step keeps the lanes of paths that have ended."""


def why_not_replayed(step: TrainingStep) -> str | None:
    """Why a step has no fixed shape or has to ask its device; None if it can be replayed."""
    assembly = step.assembly
    method = assembly.settings.method
    if not all_lanes(step.device):
        return "a CPU works on the lanes that need it"
    if not assembly.settings.optimization.cuda_graph:
        return "model.optimization.cuda_graph is false"
    if step.processes > 1:
        return "several processes exchange gradients"
    if not (isinstance(method, Direct) or (isinstance(method, Radiometric) and method.k <= MAX_BOUNCES)):
        return "paths end at random"
    if not isinstance(assembly.world.tracer.tracer, WarpTracer):
        return "rays are cast on the CPU; model.tracer warp casts them on the GPU"
    if not isinstance(assembly.materials, FittedMaterials):
        return "materials are known, which differ in their model"
    if assembly.environment is not None:
        return "the environment is recovered, whose tables are made on the CPU"
    return None


class ReplayedStep:
    """Gradients and update of a step, each as a graph where the device has graphs.

    What changes between steps is written to tensors that stay: the batch, learning rates, seeds and the number of the
    iteration. A flag on the device takes the place of a look at every loss and gradient.
    """

    def __init__(self, step: TrainingStep) -> None:
        self.step, device = step, step.device
        self.flag = FiniteFlag(device, step.optimizers.values())
        self.streams = self._new_streams()
        """Random numbers by purpose."""
        self.changed = True
        """Whether something may be another tensor or number of the host than before."""
        generators = [stream.generator for stream in self.streams.values()]
        self._gradients: StepGraph[_Found] = StepGraph(
            device, "a training step", generators, lambda found: found.numbers(), self._give_up
        )
        self._update: StepGraph[bool] = StepGraph(device, "the update of a training step")
        self._batch: PixelBatch | None = None
        self._state: Hashable = None
        self._rays = 0

    def __call__(self, batch: PixelBatch, backward: Callable[[Tensor], None]) -> StepGradients:
        """One step but for what the host does from time to time.

        Args:
            batch: pixels, perhaps with candidates.
            backward: accumulates the gradients of a scalar.

        Returns:
            What was found; the next step overwrites its tensors.
        """
        step, tracer = self.step, self.step.assembly.world.tracer
        # ---------------------- What the host writes ----------------------
        if self._batch is None or self._batch.shapes() != batch.shapes():
            self._batch, self.changed = batch.clone(), True
        else:
            self._batch.copy_(batch)
        if self.changed:
            self._state, self.changed = self._new_state(), False
        for purpose, stream in self.streams.items():
            stream.restart(*step.key(purpose))
        self.flag.iteration.fill_(step.counters.iteration)
        for optimizer in step.optimizers.values():
            optimizer.rates.write()
        # ---------------------- What the device does ----------------------
        fixed, cast, captures = self._batch, tracer.rays_cast, self._gradients.captures
        kept = self._gradients(
            self._state,
            lambda: _Found(_without_graph(step.gradients(step.chosen(fixed), backward)), self._of_parameters()),
        )
        found = kept.step
        for p, gradient in kept.gradients:  # whatever happened to them since the capture
            p.grad = gradient
        if self.flag.batch is None or self.flag.batch.shapes() != found.batch.shapes():
            self.flag.batch = found.batch.clone()
        self._update((self._state, self._gradients.captures), lambda: self._updated(found))
        # A replay casts as many rays as a step before it was captured, and nobody counts them.
        if self._gradients.captures == captures:
            self._rays = tracer.rays_cast - cast or self._rays
        tracer.rays_cast = cast + self._rays
        return found

    @property
    def captures(self) -> tuple[int, int]:
        """Graphs so far of the gradients and of the update."""
        return self._gradients.captures, self._update.captures

    def _updated(self, found: StepGradients) -> bool:
        """Look at what was found, and take the step if it and all before were finite."""
        losses = [x for _, loss in found.terms.all.values() for x in (loss.value, loss.surrogate)]
        self.flag.watch(found.batch, losses, [gradient for _, gradient in self._of_parameters()])
        pairs = (found.bins, found.scores)
        bins, scores = (None if pair is None else (pair[0], self.flag.kept(pair[1])) for pair in pairs)
        self.step.update(replace(found, bins=bins, scores=scores))
        return True

    def _of_parameters(self) -> list[tuple[Tensor, Tensor]]:
        groups = (group for optimizer in self.step.optimizers.values() for group in optimizer.param_groups)
        return [(p, p.grad) for group in groups for p in group["params"] if p.grad is not None]

    def _give_up(self) -> None:
        """There is no graph of the gradients: an update that was captured would read others."""
        self._update.works, self.streams = False, self._new_streams()

    def _new_streams(self) -> dict[int, Stream]:
        return {purpose: Stream(*self.step.key(purpose), device=self.step.device) for purpose in (1, 2)}

    def _new_state(self) -> Hashable:
        """Addresses of all tensors and numbers of the host that a step reads, and the shape of the batch."""
        assembly = self.step.assembly
        parts = [part for _, part in assembly.modules()]
        tensors = [(x.data_ptr(), x.requires_grad) for part in parts for x in (*part.parameters(), *part.buffers())]
        bsdf, lights = assembly.world.bsdf, assembly.world.lights
        unread = {"power"} if isinstance(lights, AreaLights) else set()  # it shares samples between kinds of lights
        objects = [*(module for part in parts for module in part.modules()), bsdf, getattr(bsdf, "fitted", bsdf)]
        plain = [
            (name, value)
            for found in objects
            for name, value in vars(found).items()
            if isinstance(value, bool | int | float | str) and name not in unread
        ]
        assert self._batch is not None
        return (*tensors, *plain, self._batch.shapes())


@dataclass(frozen=True)
class _Found:
    step: StepGradients
    gradients: list[tuple[Tensor, Tensor]]

    def numbers(self) -> Tensor:
        """Losses and sizes of the gradients."""
        losses = [loss.value for _, loss in self.step.terms.all.values()]
        return torch.stack([x.float() for x in (*losses, *(gradient.norm() for _, gradient in self.gradients))])


def _without_graph(found: StepGradients) -> StepGradients:
    """What a step found without what led to it."""
    terms = found.terms

    def detached(losses: dict[str, tuple[float, Loss]]) -> dict[str, tuple[float, Loss]]:
        return {name: (w, Loss(loss.surrogate.detach(), loss.value.detach())) for name, (w, loss) in losses.items()}

    fixed = replace(terms, materials=detached(terms.materials), field=detached(terms.field))
    return replace(found, terms=replace(fixed, guide_samples=None, roughness=None))
