"""What happens at its times in every training, between the steps of the optimizers.

:class:`neurad.training.step.TrainingStep` runs these stages for whoever drives it, so a benchmark trains as a fit does.
"""

import sys
from collections.abc import Callable
from typing import Protocol, TypeVar

import torch
import torch.distributed as dist
from torch import nn

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.lamps.unknown import refresh_lamps, should_refresh
from neurad.training.diffuse_lobe import DECIDED, DECIDED_AGAIN, decide, look_again
from neurad.training.light_balance import MIN_ITERATIONS, TIMES, balance_light, unsure
from neurad.training.metal import UNDECIDED, decide_metal, should_decide
from neurad.training.objective import ObjectiveStep, StepTerms
from neurad.training.roughness_refinement import EVERY as REFINEMENT_EVERY
from neurad.training.roughness_refinement import progress_before, refine_roughness, should_refine
from neurad.training.roughness_start import BATCHES, choose_start, roughness_begins
from neurad.training.schedule import Counters, Progress
from neurad.training.training_views import TrainingViews
from neurad.training.validation import SETTLED, should_filter, shrink_levels, update_levels

REFRESH = 20
"""Iterations after which directions are sampled by the present environment map instead of an older one."""
T = TypeVar("T")


class Training(Protocol):
    """What stages work on: the running :class:`neurad.training.step.TrainingStep`."""

    assembly: Assembly
    views: TrainingViews
    photographs: PhotoSource
    counters: Counters
    rank: int
    processes: int
    device: torch.device | str

    @property
    def objective(self) -> Callable[[PixelBatch, Stream], StepTerms]:
        """Losses of a batch."""


class Stage(Protocol):
    """Something that happens at its times."""

    def due(self, training: Training, progress: Progress) -> bool:
        """Whether it is time, after the iterations that are done; the same answer in all processes."""

    def run(self, training: Training, progress: Progress) -> None:
        """Do it."""


def rate_progress(assembly: Assembly, progress: Progress) -> float:
    """What learning rates go by: 1 or more at the end of the run, or from its roughness refinement on."""
    if assembly.hierarchy is None:
        return progress.largest
    return progress_before(progress)


class RoughnessStart:
    """Let roughness begin where the loss is least, see :mod:`neurad.training.roughness_start`."""

    def due(self, training: Training, progress: Progress) -> bool:
        """Before the first iteration in which roughness is learnt, where that is not the first of all."""
        begins = roughness_begins(training.assembly.settings)
        return 0 < begins == training.counters.iteration and isinstance(training.objective, ObjectiveStep)

    def run(self, training: Training, progress: Progress) -> None:
        """Look at some batches, and shift the field."""
        assert isinstance(training.objective, ObjectiveStep)
        begin, rank = training.counters.iteration, training.rank
        batches = (
            training.photographs.batch(i, rank).without_candidates().to(training.device)
            for i in range(begin, begin + BATCHES)
        )
        key = training.assembly.settings.seed, begin, rank, 3
        level = choose_start(training.objective, batches, key, dist.is_initialized())
        if level is not None and rank == 0:
            print(f"neurad: roughness begins at {level}", file=sys.stderr)


class DiffuseLobe:
    """Find which diffuse lobe surfaces have, see :mod:`neurad.training.diffuse_lobe`."""

    def due(self, training: Training, progress: Progress) -> bool:
        """From time to time until it is found."""
        materials = training.assembly.materials
        searched = isinstance(materials, FittedMaterials) and materials.looks_for_lobe
        return searched and training.counters.iteration % REFINEMENT_EVERY == 0  # when processes agree

    def run(self, training: Training, progress: Progress) -> None:
        """Take one of the two where the first process sees that it is time."""
        assembly = training.assembly
        metalness = assembly.metalness
        if metalness is not None and not metalness.done:  # what no model explains as yet tells of no lobe
            return
        at = DECIDED_AGAIN if metalness is not None and metalness.found else DECIDED
        if broadcast(rate_progress(assembly, progress) >= at) and (said := decide(assembly)) and not training.rank:
            print(f"neurad: {said}", file=sys.stderr)


class LightRefresh:
    """Sample light that is recovered by what it is by now, and estimate anew what lamps reflect."""

    def due(self, training: Training, progress: Progress) -> bool:
        """Whenever one of the two is."""
        return self._samples(training) or self._lamps(training)

    @staticmethod
    def _samples(training: Training) -> bool:
        assembly = training.assembly
        recovers = assembly.environment is not None or assembly.lamps is not None
        return recovers and training.counters.iteration % REFRESH == 0

    @staticmethod
    def _lamps(training: Training) -> bool:
        recovers = training.assembly.lamps is not None and training.views.lamps is not None
        return recovers and should_refresh(training.counters.iteration)

    def run(self, training: Training, progress: Progress) -> None:
        """Refresh what is due."""
        environment, lamps = training.assembly.environment, training.assembly.lamps
        if self._lamps(training):
            assert training.views.lamps is not None
            refresh_lamps(training.assembly, training.views.lamps, training.counters.iteration)
        if self._samples(training):
            if environment is not None:
                environment.refresh()
            if lamps is not None:
                lamps.refresh()


class LightBalance:
    """Change light that photographs do not show by what the albedo says of it, see
    :mod:`neurad.training.light_balance`.
    """

    def due(self, training: Training, progress: Progress) -> bool:
        """Some times in a run; the first process decides for all."""
        iteration = training.counters.iteration
        if iteration < MIN_ITERATIONS or iteration % REFINEMENT_EVERY != 0:  # now and then: a GPU is asked, and waits
            return False
        if not (lights := unsure(training.assembly)):
            return False
        times = int(lights[0].balanced)
        return broadcast(times < len(TIMES) and rate_progress(training.assembly, progress) >= TIMES[times])

    def run(self, training: Training, progress: Progress) -> None:
        """Look at some points, and multiply parts of the light."""
        lights = unsure(training.assembly)
        if training.rank == 0:
            found = balance_light(training.assembly, training.views, training.counters.iteration)
            if found is not None:
                print(
                    "neurad: light that no photograph shows was changed by what the albedo says of it, and light on "
                    f"surfaces by {100.0 * found:.1f} % (rms)",
                    file=sys.stderr,
                )
        for light in lights:
            light.balanced += 1
            share(light)


class RoughnessRefinement:
    """Find the roughness from all training pixels, see :mod:`neurad.training.roughness_refinement`."""

    def due(self, training: Training, progress: Progress) -> bool:
        """Once in a run, where learning rates have come to their end; the first process decides for all."""
        hierarchy = training.assembly.hierarchy
        if hierarchy is None or not isinstance(training.objective, ObjectiveStep):
            return False
        if not processes_meet(training):
            return False
        return broadcast(should_refine(hierarchy, rate_progress(training.assembly, progress)))

    def run(self, training: Training, progress: Progress) -> None:
        """Take noise out of the albedo's levels first: copied by an albedo it hides what pixels say of the roughness.
        The first process makes the step for all, within the time that is left.
        """
        hierarchy = training.assembly.hierarchy
        assert hierarchy is not None
        LevelFilter.update(training, progress)
        if training.rank == 0:
            found = refine_roughness(
                training.assembly, training.views, training.photographs, training.counters, training.processes,
                progress.seconds_by_time,
            )  # fmt: skip
            if found is not None:
                print(
                    f"neurad: roughness changed by {found:.3f} (rms) from all training pixels at once", file=sys.stderr
                )
        share(hierarchy)


class MetalDecision:
    """Decide which surfaces are metals, see :mod:`neurad.training.metal`."""

    def due(self, training: Training, progress: Progress) -> bool:
        """Once in a run, halfway to where learning rates end; the first process decides for all."""
        metalness = training.assembly.metalness
        if metalness is None or metalness.done or not isinstance(training.objective, ObjectiveStep):
            return False
        if not processes_meet(training):
            return False
        return broadcast(should_decide(metalness, rate_progress(training.assembly, progress)))

    def run(self, training: Training, progress: Progress) -> None:
        """Look at some pixels, and say what they tell."""
        metalness = training.assembly.metalness
        assert metalness is not None
        if training.rank == 0:
            found = decide_metal(
                training.assembly, training.views, training.photographs, training.counters, training.processes
            )
            print(f"neurad: {found or UNDECIDED}", file=sys.stderr)
        share(metalness)
        if metalness.found:
            look_again(training.assembly)
        # Metals that were taken for dielectrics may have drawn the roughness of all surfaces to an end of its range.
        if metalness.found and training.assembly.settings.roughness.begin != "middle":
            RoughnessStart().run(training, progress)


class LevelFilter:
    """Let training go on from what never-drawn pixels confirm, see :mod:`neurad.training.validation`."""

    def due(self, training: Training, progress: Progress) -> bool:
        """From time to time until rates are too low to bring signal back."""
        return rate_progress(training.assembly, progress) < 1.0 and should_filter(training.counters.iteration)

    def run(self, training: Training, progress: Progress) -> None:
        """Shrink the levels of the albedo."""
        shrink_levels(training.assembly, training.views, training.photographs, training.counters.iteration)

    @staticmethod
    def update(training: Training, progress: Progress) -> str | None:
        """Fit the factors by which results show each level of the fields; returns a sentence on what was found."""
        settled = rate_progress(training.assembly, progress) >= SETTLED
        return update_levels(
            training.assembly, training.views, training.photographs, training.counters.iteration, settled
        )


BEFORE: tuple[Stage, ...] = (RoughnessStart(), LightRefresh())
"""Stages before the optimizers' step, in their order."""
AFTER_STEP: tuple[Stage, ...] = (DiffuseLobe(), MetalDecision(), LightBalance(), RoughnessRefinement(), LevelFilter())
"""Stages after it."""


def broadcast(value: T) -> T:
    """The first process's value, in all of them."""
    if not dist.is_initialized():
        return value
    box = [value]
    dist.broadcast_object_list(box)
    return box[0]


def share(module: nn.Module) -> None:
    """Give the first process's state of a module to all of them."""
    module.load_state_dict(broadcast({name: value.cpu() for name, value in module.state_dict().items()}))


def processes_meet(training: Training) -> bool:
    """Whether processes ask each other after this iteration; one alone needs not wait."""
    return training.processes == 1 or training.counters.iteration % REFINEMENT_EVERY == 0
