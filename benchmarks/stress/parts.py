"""One scene with only the parts that it needs, with the parts of ``patterns``, and with everything forced on."""

import resource
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from benchmarks.stress.fit import Fit, Plan, plan_of, resized
from neurad.core.parameters import ROUGHNESS
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, EnvironmentMap
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.integrators.delta import DeltaSurfaces
from neurad.runtime.threads import at_most
from neurad.scene import builtin
from neurad.scene.description import Features, Scene

CONFIG = "patterns.yaml"
EVERYTHING = Features(True, True, True, False, True)
"""Every part enabled, whatever the scene has."""
Form = Literal["needed", "patterns", "forced"]


@dataclass(frozen=True)
class Place:
    """Where a scene comes from; small enough to be handed to another process."""

    scene: str
    """Name of a built-in one."""
    size: int = 24
    """Pixels along a side of its training views."""

    def build(self) -> Scene:
        """The scene with views of that size and no others."""
        return replace(resized(builtin.build(self.scene), self.size), test=[])

    def plan(self) -> Plan:
        """The settings of the shipped :data:`CONFIG`."""
        return replace(plan_of(CONFIG), emitters_train=self.scene == "furnace")


def glossy(scene: Scene) -> Scene:
    """The scene with the parts that ``patterns`` has: principled BSDF and a roughness field."""
    rough = Constant(np.ones(1, np.float32))
    materials = [
        replace(m, model=PrincipledModel(), roughness=rough) if m.model.is_diffuse else m for m in scene.materials
    ]
    return replace(scene, materials=materials)


def forced(scene: Scene) -> Scene:
    """The scene for the general path: principled BSDF with a roughness field, and a black environment if it has
    none. :func:`make` adds the delta chain and the one-sided tests.
    """
    dim = EnvironmentMap(np.full((8, 16, 3), 1e-12, np.float32))
    return replace(glossy(scene), environment=scene.environment if scene.features.has_environment else dim)


def make(form: Form, scene: Scene, images: torch.Tensor, plan: Plan) -> Fit:
    """A fit of ``scene`` in one of its forms."""
    if form == "needed":
        return Fit(scene, images, plan)
    if form == "patterns":
        return Fit(glossy(scene), images, plan)
    fit = Fit(forced(scene), images, plan)
    fit.world.delta = fit.world.delta or DeltaSurfaces(fit.scene, fit.world.geometry)
    fit.world.features = EVERYTHING
    return fit


def parts(fit: Fit) -> tuple[list[str], list[str]]:
    """Names of the parts that a fit has and of those that were left out."""
    world = fit.world
    has = {
        "area lights": not isinstance(world.lights, Environment),
        "environment": not isinstance(world.lights, AreaLights),
        "specular lobe": not world.bsdf.is_diffuse,
        "roughness field": ROUGHNESS.name in fit.materials.recovered,
        "control variate": world.bsdf.varying_weight,
        "guide": world.guide is not None,
        "radiance by direction": "direction" in fit.radiance.inputs,
        "radiance by albedo": fit.radiance.reads_albedo,
        "delta chain": world.delta is not None,
        "one-sided test": world.features.has_one_sided,
    }
    return [name for name, there in has.items() if there], [name for name, there in has.items() if not there]


def parameters(fit: Fit) -> int:
    """Trained numbers of all fields."""
    return sum(p.numel() for module in (fit.materials, fit.radiance) for p in module.parameters() if p.requires_grad)


def milliseconds(fits: Sequence[Fit], steps: int) -> list[float]:
    """Processor time of the median step of each; the fits take turns, so that a busy machine slows all of them."""
    spent: list[list[float]] = [[] for _ in fits]
    with at_most(1):
        for i in range(steps + 3):
            for fit, times in zip(fits, spent, strict=True):
                begin = time.process_time()
                fit.advance(0.0)
                if i >= 3:
                    times.append(time.process_time() - begin)
    return [1e3 * statistics.median(times) for times in spent]


def memory(place: Place, form: Form, steps: int = 5) -> float | None:
    """MiB that a fit adds to the peak of a process which has read the scene; the fit runs in a new process.

    None where the system does not report it.
    """
    import multiprocessing

    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_memory, (place, form, steps))


def _memory(place: Place, form: Form, steps: int) -> float | None:
    scene, plan = place.build(), place.plan()
    camera = scene.train[0].camera
    images = torch.full((len(scene.train), camera.width * camera.height, 3), 0.5)
    before = _peak()
    fit = make(form, scene, images, plan)
    with at_most(1):
        for _ in range(steps):
            fit.advance(0.0)
    after = _peak()
    return None if before is None or after is None else after - before


def _peak() -> float | None:
    """Largest resident memory of this process in MiB. On Linux a child begins with its parent's peak by ``getrusage``,
    but not by ``/proc``.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024.0
    if sys.platform == "darwin":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2.0**20
    return None
