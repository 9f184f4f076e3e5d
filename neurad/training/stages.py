"""What happens at its times in every training, between the steps of the optimizers.

:class:`neurad.training.step.TrainingStep` runs these stages for whoever drives it, so a benchmark trains as a fit does.
A stage is a function that looks whether it is time, after the iterations that are done, and says whether it was: the
same answer in all processes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

import torch.distributed as dist
from torch import nn

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.lamps.unknown import refresh_lamps, should_refresh
from neurad.training.diffuse_lobe import DECIDED, DECIDED_AGAIN, decide, look_again
from neurad.training.light_balance import MIN_ITERATIONS, TIMES, balance_light, unsure
from neurad.training.metal import DECIDED as METAL_DECIDED
from neurad.training.metal import UNDECIDED, decide_metal
from neurad.training.objective import ObjectiveStep
from neurad.training.roughness_refinement import progress_before, refine_roughness, should_refine
from neurad.training.roughness_start import BATCHES, choose_start, roughness_begins
from neurad.training.schedule import Progress
from neurad.training.validation import EVERY as FILTER_EVERY
from neurad.training.validation import SETTLED, shrink_levels, update_levels

if TYPE_CHECKING:
    from neurad.training.step import TrainingStep

REFRESH = 20
"""Iterations after which directions are sampled by the present environment map instead of an older one."""
MEET_EVERY = 16
"""Iterations after which processes agree whether it is time."""
T = TypeVar("T")


def rate_progress(assembly: Assembly, progress: Progress) -> float:
    """What learning rates go by: 1 or more at the end of the run, or from its roughness refinement on."""
    return progress.largest if assembly.hierarchy is None else progress_before(progress)


def start_roughness(training: TrainingStep, progress: Progress) -> bool:
    """Let roughness begin where the loss is least, before the first iteration in which it is learnt, where that is not
    the first of all; see :mod:`neurad.training.roughness_start`.
    """
    begins = roughness_begins(training.assembly.settings)
    if not 0 < begins == training.counters.iteration or not isinstance(training.objective, ObjectiveStep):
        return False
    _shift_roughness(training, training.objective)
    return True


def _shift_roughness(training: TrainingStep, objective: ObjectiveStep) -> None:
    """Look at some batches, and shift the field."""
    begin, rank = training.counters.iteration, training.rank
    batches = (
        training.photographs.batch(i, rank).without_candidates().to(training.device)
        for i in range(begin, begin + BATCHES)
    )
    key = training.assembly.settings.seed, begin, rank, 3
    level = choose_start(objective, batches, key, dist.is_initialized())
    if level is not None and rank == 0:
        print(f"neurad: roughness begins at {level}", file=sys.stderr)


def find_lobe(training: TrainingStep, progress: Progress) -> bool:
    """Take one of two diffuse lobes where the first process sees that it is time, see
    :mod:`neurad.training.diffuse_lobe`.
    """
    assembly, materials = training.assembly, training.assembly.materials
    searched = isinstance(materials, FittedMaterials) and materials.looks_for_lobe
    if not searched or training.counters.iteration % MEET_EVERY != 0:
        return False
    metalness = assembly.metalness
    if metalness is not None and not metalness.done:  # what no model explains as yet tells of no lobe
        return True
    at = DECIDED_AGAIN if metalness is not None and metalness.found else DECIDED
    if broadcast(rate_progress(assembly, progress) >= at) and (said := decide(assembly)) and not training.rank:
        print(f"neurad: {said}", file=sys.stderr)
    return True


def refresh_light(training: TrainingStep, progress: Progress) -> bool:
    """Estimate anew what lamps that are recovered reflect, and sample light that is by what it is by now."""
    environment, lamps, iteration = training.assembly.environment, training.assembly.lamps, training.counters.iteration
    shown = training.views.lamps if lamps is not None and should_refresh(iteration) else None
    if shown is not None:
        refresh_lamps(training.assembly, shown, iteration)
    lights = [light for light in (environment, lamps) if light is not None and iteration % REFRESH == 0]
    for light in lights:
        light.refresh()
    return bool(lights) or shown is not None


def balance_unseen_light(training: TrainingStep, progress: Progress) -> bool:
    """Change light that photographs do not show by what the albedo says of it, some times in a run; the first process
    decides for all, see :mod:`neurad.training.light_balance`.
    """
    iteration = training.counters.iteration
    if iteration < MIN_ITERATIONS or iteration % MEET_EVERY != 0:  # now and then: a GPU is asked, and waits
        return False
    if not (lights := unsure(training.assembly)):
        return False
    times = int(lights[0].balanced)
    if not broadcast(times < len(TIMES) and rate_progress(training.assembly, progress) >= TIMES[times]):
        return False
    if training.rank == 0:
        found = balance_light(training.assembly, training.views, iteration)
        if found is not None:
            print(
                "neurad: light that no photograph shows was changed by what the albedo says of it, and light on "
                f"surfaces by {100.0 * found:.1f} % (rms)",
                file=sys.stderr,
            )
    for light in lights:
        light.balanced += 1
        share(light)
    return True


def find_roughness(training: TrainingStep, progress: Progress) -> bool:
    """Find the roughness from all training pixels, once in a run, where learning rates have come to their end; the
    first process does it for all, within the time that is left, see :mod:`neurad.training.roughness_refinement`.

    Noise is taken out of the albedo's levels first: copied by an albedo it hides what pixels say of the roughness.
    """
    hierarchy = training.assembly.hierarchy
    if hierarchy is None or not isinstance(training.objective, ObjectiveStep) or not _processes_meet(training):
        return False
    if not broadcast(should_refine(hierarchy, rate_progress(training.assembly, progress))):
        return False
    show_levels(training, progress)
    if training.rank == 0:
        found = refine_roughness(
            training.assembly, training.views, training.photographs, training.counters, training.processes,
            progress.seconds_by_time,
        )  # fmt: skip
        if found is not None:
            print(f"neurad: roughness changed by {found:.3f} (rms) from all training pixels at once", file=sys.stderr)
    share(hierarchy)
    return True


def find_metal(training: TrainingStep, progress: Progress) -> bool:
    """Decide which surfaces are metals, once in a run, halfway to where learning rates end; the first process decides
    for all, see :mod:`neurad.training.metal`.
    """
    metalness, objective = training.assembly.metalness, training.objective
    if metalness is None or metalness.done or not isinstance(objective, ObjectiveStep) or not _processes_meet(training):
        return False
    if not broadcast(rate_progress(training.assembly, progress) >= METAL_DECIDED):
        return False
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
        _shift_roughness(training, objective)
    return True


def filter_levels(training: TrainingStep, progress: Progress) -> bool:
    """Let training go on from what pixels that no batch draws confirm of the albedo's levels, from time to time until
    rates are too low to bring signal back, see :mod:`neurad.training.validation`.
    """
    iteration = training.counters.iteration
    if rate_progress(training.assembly, progress) >= 1.0 or iteration == 0 or iteration % FILTER_EVERY != 0:
        return False
    shrink_levels(training.assembly, training.views, training.photographs, iteration)
    return True


def show_levels(training: TrainingStep, progress: Progress) -> str | None:
    """Fit the factors by which results show each level of the fields; returns a sentence on what was found."""
    settled = rate_progress(training.assembly, progress) >= SETTLED
    return update_levels(training.assembly, training.views, training.photographs, training.counters.iteration, settled)


Stage = Callable[["TrainingStep", Progress], bool]
BEFORE: tuple[Stage, ...] = (start_roughness, refresh_light)
"""Stages before the optimizers' step, in their order."""
AFTER_STEP: tuple[Stage, ...] = (find_lobe, find_metal, balance_unseen_light, find_roughness, filter_levels)
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


def _processes_meet(training: TrainingStep) -> bool:
    """Whether processes ask each other after this iteration; one alone needs not wait."""
    return training.processes == 1 or training.counters.iteration % MEET_EVERY == 0
