"""The radiance field alone: no photographs, true materials."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.stress.fit import small_settings
from neurad.assembly.build import build_world
from neurad.core.frame import Frame
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere, uniform_triangle
from neurad.core.scene_records import Camera
from neurad.fields.radiance import RadianceField
from neurad.integrators.method import SceneModel
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.walk import walk
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.train_radiance import radiance_run

CHECK = 10
"""Steps between two measurements of the error."""
PIXELS = 256
"""Pixels of a batch: a quarter of what ``neurad render`` takes."""


def _survival(bounces: int, throughput: Tensor, weight: Tensor) -> Tensor | None:
    """Probability to go on [n]: what the last bounce kept, so that throughputs stay near 1."""
    return weight.amax(-1).clamp(0.05, 0.999) if bounces > 5 else None


class Lab:
    """A scene with its true materials, its light and points on its surfaces."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.world: World = build_world(scene)
        self.materials = TrueMaterials(scene, self.world.geometry)
        area = self.world.geometry.face_area.double()
        self.cdf = area.cumsum(0) / area.sum()

    def points(self, count: int, stream: Stream) -> SurfaceInteraction:
        """Points uniform over the surfaces, seen from the side of the normal by the cosine."""
        geometry = self.world.geometry
        face = torch.searchsorted(self.cdf, stream.uniform(count).double()).clamp_max(len(self.cdf) - 1)
        bary = uniform_triangle(stream.uniform(count, 2))
        wo = Frame.around(geometry.face_normal[face]).to_world(cosine_hemisphere(stream.uniform(count, 2)))
        return geometry.interact_at(face, bary[:, 0], bary[:, 1], wo, torch.ones(count, dtype=torch.bool))

    def open_points(self, count: int, stream: Stream) -> SurfaceInteraction:
        """Points with free space above them: none in the gap between the back of a light and the ceiling."""
        parts: list[SurfaceInteraction] = []
        while sum(map(len, parts)) < count:
            si = self.points(count + count // 8, stream)
            above = self.world.geometry.spawn(si, si.ng)
            parts.append(si[~self.world.tracer.occluded(above, torch.full_like(si.p[:, 0], 0.02))])
        return SurfaceInteraction.cat(*parts)[:count]

    @torch.no_grad()
    def traced(self, si: SurfaceInteraction, samples: int, seed: int) -> Tensor:
        """Reflected radiance at the lanes of ``si`` by path tracing without a depth limit [n, 3]."""
        at_once, scene = 16, SceneModel(self.world, self.materials)
        total = torch.zeros(len(si), 3)
        for done in range(0, samples, at_once):
            stream = Stream(seed, done)
            first = si.repeat(at_once)
            sums, u = torch.zeros(len(first), 3), stream.uniform(len(first), DIMENSIONS)
            for v in walk(scene, first, self.materials(first), u, stream, _survival, None):
                sums.index_add_(0, v.lane, v.throughput * v.bounce.direct)
            total.add_(sums.view(len(si), at_once, 3).sum(1))
        return total / math.ceil(samples / at_once) / at_once


def relative_error(value: Tensor, truth: Tensor, other: Tensor | None = None) -> float:
    """Root mean square of ``value - truth`` over that of ``truth`` [n, 3].

    With ``other``, a second independent estimate of the truth, the noise of both drops out of the mean.
    """
    second = truth if other is None else other
    square = ((value - truth) * (value - second)).mean()
    return float((square.clamp_min(0.0) / (truth * second).mean()).sqrt())


def settle(
    lab: Lab, cameras: list[Camera], steps: int, error: Callable[[RadianceField], float] | None = None
) -> tuple[RadianceField, list[tuple[int, float]]]:
    """Train a radiance field by the prior alone, with the shipped settings and the scene's true materials.

    Args:
        lab: the scene.
        cameras: of the training views.
        steps: iterations.
        error: measured every :data:`CHECK` steps.

    Returns:
        The field, and its error after so many steps.
    """
    run = radiance_run(lab.scene, lab.world, lab.materials, cameras, small_settings(), PIXELS)
    field, history = run.assembly.radiance, []
    assert field is not None
    for i in range(steps):
        run.advance(i / steps)
        if error is not None and (i + 1) % CHECK == 0:
            with torch.no_grad():
                history.append((i + 1, error(field)))
    return field, history


def steps_to(history: list[tuple[int, float]], bar: float) -> int | None:
    """The step from which the error stays at or below ``bar`` to the end of the history, or None."""
    found = None
    for step, error in reversed(history):
        if error > bar:
            break
        found = step
    return found
