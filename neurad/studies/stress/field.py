"""The radiance field alone: no photographs, true materials, zero output at the start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.assembly.build import build_radiance, build_world
from neurad.core.frame import Frame
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere, uniform_triangle
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import GridConfig, RadianceConfig
from neurad.integrators.bounce import bounce
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World
from neurad.losses.relative import relative_weight
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.studies.stress.level import Level

START = 0.01
"""Output at the start in units of the field: near enough to zero, and the network still feels its gradient."""
EPSILON = 0.01
CHECK = 10
"""Steps between two looks at the error."""


@dataclass(frozen=True)
class Settings:
    """How the field is trained."""

    steps: int = 400
    rate: float = 5e-3
    decay: bool = False
    """Cosine decay of the rate to 2 %; without it the rate is constant."""
    points: int = 1024
    bounces: int = 1
    """Bounces of the target before the field is read."""
    level: bool = False
    """Whether the target is corrected by :class:`neurad.studies.stress.level.Level`."""
    unit: float | None = None
    """Unit of the field's output; None takes the level that one bounce of a constant field points to."""


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

    def open_points(self, count: int, stream: Stream, clearance: float = 0.02) -> SurfaceInteraction:
        """Points with free space above them: not those in the dark between a light's back and the ceiling."""
        parts: list[SurfaceInteraction] = []
        while sum(map(len, parts)) < count:
            si = self.points(count + count // 8, stream)
            above = self.world.geometry.spawn(si, si.ng)
            parts.append(si[~self.world.tracer.occluded(above, torch.full_like(si.p[:, 0], clearance))])
        return SurfaceInteraction.cat(*parts)[:count]

    @torch.no_grad()
    def level(self, count: int = 4096) -> Tensor:
        """Mean reflected radiance that one bounce of a constant field points to, ``<T E> / (1 - <T 1>)`` [3]."""
        stream = Stream(11)
        si = self.open_points(count, stream)
        step = bounce(self.world, si, self.materials(si), stream.uniform(count, DIMENSIONS))
        return step.direct.mean(0) / (1.0 - step.weight.mean(0)).clamp_min(1e-5)

    @torch.no_grad()
    def direct(self, count: int = 4096) -> Tensor:
        """Mean radiance that surfaces reflect of direct light [3]."""
        stream = Stream(11)
        si = self.open_points(count, stream)
        return bounce(self.world, si, self.materials(si), stream.uniform(count, DIMENSIONS)).direct.mean(0)

    @torch.no_grad()
    def traced(self, si: SurfaceInteraction, samples: int, seed: int) -> Tensor:
        """Reflected radiance at the lanes of ``si`` by path tracing without a depth limit [n, 3]."""
        at_once = 16
        total = torch.zeros(len(si), 3)
        for done in range(0, samples, at_once):
            stream = Stream(seed, done)
            here = si.repeat(at_once)
            lane = torch.arange(len(here))
            through, sums = torch.ones(len(here), 3), torch.zeros(len(here), 3)
            depth = 0
            while len(here):
                step = bounce(self.world, here, self.materials(here), stream.uniform(len(here), DIMENSIONS))
                sums.index_add_(0, lane, through * step.direct)
                through = through * step.weight
                alive = step.next.valid & (through.amax(-1) > 0)
                if depth > 4:  # the chance to go on is what a bounce keeps, so weights stay near 1
                    keep = step.weight.amax(-1).clamp(0.05, 0.999)
                    alive &= stream.uniform(len(here)) < keep
                    through = through / keep.unsqueeze(-1)
                index = alive.nonzero().squeeze(-1)
                here, lane, through = step.next[index], lane[index], through[index]
                depth += 1
            total.add_(sums.view(len(si), at_once, 3).sum(1))
        return total / math.ceil(samples / at_once) / at_once


def relative_error(value: Tensor, truth: Tensor, other: Tensor | None = None) -> float:
    """Root mean square of ``value - truth`` over that of ``truth`` [n, 3].

    With ``other``, a second independent estimate of the truth, the noise of both drops out of the mean.
    """
    second = truth if other is None else other
    square = ((value - truth) * (value - second)).mean()
    return float((square.clamp_min(0.0) / (truth * second).mean()).sqrt())


def zero_field(lab: Lab, unit: float) -> RadianceField:
    """A field in units of ``unit`` whose output is next to nothing everywhere."""
    torch.manual_seed(0)
    grid = GridConfig(levels=5, coarsest=2, finest=32, log2_size=14)
    field = build_radiance(lab.scene, RadianceConfig(grid=grid, hidden_layers=2))
    field.set_scale(unit)
    with torch.no_grad():
        last = list(field.mlp.parameters())[-1]
        last.add_(math.log(math.expm1(START)) - math.log(math.expm1(0.2)))
    return field


def settle(
    lab: Lab, settings: Settings, error: Callable[[RadianceField], float] | None = None
) -> tuple[RadianceField, list[tuple[int, float]]]:
    """Train a field from zero by the prior alone.

    Args:
        lab: the scene.
        settings: of the training.
        error: looked at every :data:`CHECK` steps.

    Returns:
        The field, and its error after so many steps.
    """
    unit = float(lab.level().mean()) if settings.unit is None else settings.unit
    field = zero_field(lab, unit)
    optimizer, level, history = SparseRowAdam(field.parameters(), lr=settings.rate), Level(), []
    for i in range(settings.steps):
        if settings.decay:
            share = 0.5 * (1.0 + math.cos(math.pi * i / settings.steps))
            optimizer.param_groups[0]["lr"] = settings.rate * (0.02 + 0.98 * share)
        stream = Stream(1, i)
        si = lab.open_points(settings.points, stream)
        surface = lab.materials(si)
        direct, carried = _target(lab, field, si, settings.bounces, stream)
        value = field(si, surface.albedo)
        factor = level(value, direct, carried, si.valid) if settings.level else torch.ones(3)
        residual = value - (direct + factor * carried)
        optimizer.zero_grad()
        (relative_weight(value, EPSILON * unit * unit) * residual * residual).mean().backward()
        optimizer.step()
        if error is not None and (i + 1) % CHECK == 0:
            with torch.no_grad():
                history.append((i + 1, error(field)))
    return field, history


@torch.no_grad()
def _target(
    lab: Lab, field: RadianceField, si: SurfaceInteraction, bounces: int, stream: Stream
) -> tuple[Tensor, Tensor]:
    """Samples of ``sum_{i <= k} T^i E`` without i = 0, and of ``T^k L``, [n, 3] each."""
    direct, through = torch.zeros_like(si.p), torch.ones_like(si.p)
    here = si
    for _ in range(bounces):
        step = bounce(lab.world, here, lab.materials(here), stream.uniform(len(here), DIMENSIONS))
        direct = direct + through * step.direct
        through = through * step.weight
        here = step.next
    return direct, through * here.where_hit(field(here, lab.materials.albedo(here)))


def steps_to(history: list[tuple[int, float]], bar: float) -> int | None:
    """The step from which the error stays at or below ``bar`` to the end of the history, or None."""
    found = None
    for step, error in reversed(history):
        if error > bar:
            break
        found = step
    return found
