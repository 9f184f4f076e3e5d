"""Forward neural radiosity (Hadadan et al. 2021): with known materials a radiance field solves the rendering equation.

The field is trained by the prior alone. It is taken where cameras look and along random walks that go on from there, so
that every surface which sends light to a pixel has its share.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from neurad.assembly.settings import Optimization
from neurad.core.camera import camera_rays
from neurad.core.protocols import Materials
from neurad.core.records import Camera, Rays, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.fields.radiance import RadianceField
from neurad.integrators.estimator import Estimator
from neurad.integrators.method import Parts
from neurad.integrators.path import PathTracing
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World
from neurad.losses.relative import semi_gradient_prior
from neurad.optim.sparse_row_adam import SparseRowAdam
from neurad.training.schedule import rate_factor

Report = Callable[[int, float], None]
EPSILON = 0.01
"""Floor of the relative loss, in units of the squared mean radiance."""


class Radiosity:
    """Trains a radiance field to solve ``L = T(E + L)``.

    Args:
        world: the scene.
        materials: what its surfaces are made of.
        field: to be trained; its scale is set to the mean reflected radiance that the cameras see.
        cameras: where to look from.
        points: vertices a step, half of them seen by the cameras and half where walks have got to.
        samples: samples of T at each.
        rate: largest learning rate; it falls with the cosine.
        seed: of every random decision.
    """

    def __init__(
        self, world: World, materials: Materials, field: RadianceField, cameras: list[Camera], points: int = 2048,
        samples: int = 4, rate: float = 1e-2, seed: int = 0,
    ) -> None:  # fmt: skip
        self.estimator = Estimator(world, materials, field)
        self.field = field
        self.cameras = cameras
        self.points = points
        self.samples = samples
        self.rate = rate
        self.seed = seed
        self.optimizer = SparseRowAdam(field.parameters(), lr=rate)
        self.iteration = 0
        self.walks: SurfaceInteraction | None = None
        self._set_scale()

    @torch.no_grad()
    def _set_scale(self) -> None:
        world, materials = self.estimator.world, self.estimator.materials
        stream = Stream(self.seed, 1)
        si = self._seen(8192, stream)
        u = stream.uniform(len(si), DIMENSIONS)
        light = PathTracing(8).reflected(Parts(world, materials), si, materials(si), u, stream).value
        self.level = max(float(light[si.valid].mean()), 1e-30) if bool(si.valid.any()) else 1.0
        self.field.set_scale(self.level)

    def _seen(self, count: int, stream: Stream) -> SurfaceInteraction:
        """About ``count`` first vertices along random camera rays."""
        each = -(-count // len(self.cameras))
        parts = []
        for camera in self.cameras:
            size = torch.tensor([camera.width, camera.height], dtype=torch.float32)
            parts.append(camera_rays(camera, stream.uniform(each, 2) * size))
        rays = Rays.cat(*parts)[torch.randperm(each * len(parts), generator=stream.generator)[:count]]
        return self.estimator.world.trace_past_delta(rays, stream.uniform(count)).si

    def step(self, progress: float) -> float:
        """One update of the field; returns the loss, of which the noise of T is a part.

        Args:
            progress: share of the training that is over, in [0, 1].
        """
        stream = Stream(self.seed, self.iteration, 2)
        si = self._seen(self.points // 2 if self.walks is not None else self.points, stream)
        if self.walks is not None:
            si = SurfaceInteraction.cat(si, self.walks)
        with torch.no_grad():
            surface = self.estimator.materials(si)
            sample = self.estimator.image(si, surface, self.samples, stream)
            transported = sample.value.view(len(si), self.samples, 3).mean(1)
            assert sample.ends is not None
            ends = sample.ends[sample.ends.valid.nonzero().squeeze(-1)]
            chosen = stream.integers(max(len(ends), 1), self.points - self.points // 2)
            self.walks = ends[chosen] if len(ends) else None
        loss = semi_gradient_prior(self.field(si, surface.albedo), transported, EPSILON * self.level**2, si.valid)
        for group in self.optimizer.param_groups:
            group["lr"] = self.rate * rate_factor(Optimization(), self.iteration, progress)
        self.optimizer.zero_grad()
        torch.autograd.backward(loss.surrogate)
        self.optimizer.step()
        self.iteration += 1
        return float(loss.value)

    def train(
        self, steps: int, seconds: float | None = None, report: Callable[[int, float], None] | None = None
    ) -> None:
        """Steps until there were ``steps`` of them or ``seconds`` are over.

        Args:
            steps: largest number.
            seconds: longest time; the learning rate falls with whichever ends first.
            report: called with the number of steps done and the loss after every 100th.
        """
        start = time.monotonic()
        for index in range(steps):
            spent = (time.monotonic() - start) / seconds if seconds is not None else 0.0
            if spent >= 1.0:
                return
            loss = self.step(max(index / steps, spent))
            if report is not None and (index + 1) % 100 == 0:
                report(index + 1, loss)
