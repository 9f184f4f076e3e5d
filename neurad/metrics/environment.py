"""Scores of a recovered environment map."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.frame import dot
from neurad.core.records import BoolArray, Float64Array, FloatArray
from neurad.core.rng import Stream
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.environment import Environment, rotation_of
from neurad.images.lat_long import texel_directions
from neurad.integrators.world import World
from neurad.metrics.scores import Pool
from neurad.metrics.seen import SeenBy

VISIBILITY_POINTS = 32
"""Surface points from which the visibility of a texel is tested."""
SEED = 20230809


class EnvironmentScores:
    """Compares maps with the true one, texel by texel, weighted by solid angle.

    Args:
        truth: the true map; one of a single texel says nothing and leaves all scores out.
        training: its cameras decide which texels could be found.
        width: texels across of the maps to score.
        height: their texels from pole to pole.
    """

    def __init__(self, truth: EnvironmentMap, world: World, training: SeenBy, width: int, height: int) -> None:
        lookup = Environment(replace(truth, to_world=np.eye(4, dtype=np.float32)))
        pixels = lookup.radiance(torch.from_numpy(texel_directions(height, width)).view(-1, 3).float()).view(
            height, width, 3
        )
        self.truth: FloatArray | None = pixels.numpy() if truth.pixels[..., 0].size > 1 else None
        edge = _angles(torch.arange(height + 1, dtype=torch.float64) - 0.5, torch.zeros(1), height, width)[0]
        band = edge[:-1].cos() - edge[1:].cos()
        self.solid_angle: Float64Array = band[:, None].expand(height, width).numpy()
        known = self.truth is not None
        self.seen = self._seen(world, training, rotation_of(truth)) if known else np.ones((height, width))

    def _seen(self, world: World, training: SeenBy, rotation: Tensor) -> BoolArray:
        """Texels [height, width] whose light reaches a surface that some training view sees.

        Each is tested from :data:`VISIBILITY_POINTS` random points on such surfaces, in random directions within it.
        """
        height, width = self.solid_angle.shape
        device = world.geometry.vertices.device
        stream = Stream(SEED, device=device)
        parts = []
        for number, camera in enumerate(training.cameras):
            u = stream.uniform(4096, 3)
            xy = u[:, :2] * torch.tensor([camera.width, camera.height], device=device)
            si = world.trace_past_delta(camera_rays(camera, xy), u[:, 2]).si
            parts.append(si[si.valid & training.in_view(number, si.p)])
        points = type(parts[0]).cat(*parts)
        if len(points) == 0:
            return np.zeros((height, width), np.bool_)
        texel = torch.arange(height * width, device=device)
        seen = torch.zeros(height * width, dtype=torch.bool, device=device)
        for _ in range(VISIBILITY_POINTS):
            u = stream.uniform(len(texel), 2)
            theta, phi = _angles(texel // width + u[:, 0] - 0.5, texel % width + u[:, 1], height, width)
            wi = _direction(theta, phi).float() @ rotation.to(device).T
            si = points[stream.integers(len(points), len(texel))]
            faces = dot(si.ng, wi) * dot(si.ng, si.wo) > 0
            index = faces.nonzero().squeeze(-1)
            shadow = world.geometry.spawn(si[index], wi[index])
            seen[texel[index]] |= world.visibility(shadow, torch.full_like(wi[index, 0], math.inf)) > 0.0
            texel = (~seen).nonzero().squeeze(-1)
        return seen.view(height, width).cpu().numpy()

    def __call__(self, found: FloatArray, factors: Mapping[str, Float64Array]) -> dict[str, float]:
        """Scores of a map [height, width, 3].

        Args:
            factors: of the albedo by their names, [3] each: what albedo is to be multiplied by, light is divided by.

        Returns:
            ``environment_mape``, with ``_constant`` that of the best constant map, with the names of ``factors`` after
            these; each also with ``_seen``, over texels whose light reaches what the training views see.
        """
        scores: dict[str, float] = {}
        if self.truth is None:
            return scores
        for region, mask in {"": np.ones_like(self.solid_angle, np.bool_), "_seen": self.seen.astype(np.bool_)}.items():
            for name, factor in {"": np.ones(3), **{f"_{key}": value for key, value in factors.items()}}.items():
                pool = Pool()
                pool.add((found / factor).astype(np.float32), self.truth, mask, self.solid_angle)
                result = pool.scores()
                if result:
                    scores[f"environment_mape{name}{region}"] = result["mape"]
                    scores[f"environment_mape_constant{region}"] = result["mape_constant"]
        return scores


def _angles(row: Tensor, column: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Polar angle and azimuth at positions in a map, rows from 0 at one pole to ``height - 1`` at the other."""
    return (math.pi / (height - 1)) * row.clamp(0.0, height - 1.0), (2.0 * math.pi / width) * column


def _direction(theta: Tensor, phi: Tensor) -> Tensor:
    """Unit directions [..., 3] in the map's frame."""
    x, z = theta.sin() * phi.sin(), -theta.sin() * phi.cos()
    return torch.stack((x, theta.cos().expand_as(x), z), -1)
