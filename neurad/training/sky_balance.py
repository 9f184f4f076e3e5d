"""What the albedo that is being recovered says of an unknown sky that shines in through openings.

Where no photograph shows a part of the sky, a brighter sky over a darker surface explains photographs as well. But what
such a part lights is a matter of place, and a surface has much the same albedo all over: where the albedo follows the
light from a part of the sky, that light is wrong (as in the Retinex of Land and McCann 1971). Of each connected part of
the surfaces

    log albedo(x) = constant + sum over k of d_k s_k(x) + texture(x),

where ``s_k(x)`` is the fraction of the irradiance at ``x`` that comes from part ``k`` of the sky, and ``exp(d_k)`` the
factor that its light lacks. Light that comes by way of surfaces is what photographs show, whatever the sky is. The
coefficients are those of a few splines (:mod:`neurad.optim.pyramid_adam`), and one of the sun. The prior's variance is
that of the largest marginal likelihood (MacKay 1992), errors are Student's t. What two halves of the surface do not
agree on is texture: the change is multiplied by the correlation of what they say. Noise of the fractions draws it to
zero, too, so it is made several times.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.core.frame import Frame, dot, faceforward
from neurad.core.parameters import ALBEDO
from neurad.core.records import Float64Array, IntArray, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere
from neurad.emitters.fitted import FittedEnvironment
from neurad.evidence.shading import parts_of_scan
from neurad.optim.polyak_average import averaged
from neurad.optim.pyramid_adam import levels
from neurad.scene.parts import SurfaceParts
from neurad.training.training_views import TrainingViews

TIMES = (0.2, 0.4, 0.6, 0.8)
"""When the sky is balanced, by the way to the end of the learning rates: what is left follows a better albedo."""
POINTS, DIRECTIONS = 4096, 32
"""Photographed points, and directions from each: towards the sky, and as many towards all else."""
LEVEL = 1
"""Of the splines: 8 rows of 16 coefficients."""
BLOCKS = 8
"""Cells along the longest side of the scene whose points are in one half of the surface."""
DARK = 0.02
"""Added to the albedo, and part of the mean irradiance that is added to it: logarithms of less are noise."""
ROUNDS = 10
"""Of weights, variance and linearisation."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t."""
START = 0.5
"""Standard deviation of the coefficients at first."""
_STREAM = 59


@dataclass(frozen=True)
class _Points:
    """Where the albedo is looked at."""

    albedo: Float64Array
    """[n, 3]."""
    part: IntArray
    """Connected part of each [n]."""
    half: IntArray
    """0 or 1 by place [n]."""
    sky: Float64Array
    """Irradiance from each part of the sky, the sun last [n, k, 3]."""
    rest: Float64Array
    """Irradiance from all else [n, 3]."""

    def light(self, channel: int) -> tuple[Float64Array, Float64Array]:
        """Irradiance in a channel from each part of the sky [n, k], and from all else [n], a floor included."""
        sky, rest = self.sky[..., channel], self.rest[..., channel]
        return sky, rest + DARK * (rest + sky.sum(1)).mean()


def balance_sky(assembly: Assembly, views: TrainingViews, iteration: int) -> float | None:
    """Multiply parts of the sky by what makes the albedo flat; the root mean square of the change of the albedo's
    logarithm that is asked for, or None where too little is seen.
    """
    environment = assembly.environment
    assert environment is not None
    rows, columns = levels(environment.height, environment.width)[LEVEL]
    with torch.no_grad(), averaged(assembly.average), assembly.world.tracer.uncounted():
        points = _look(assembly, environment, (rows, columns), views, iteration)
    if points is None:
        return None
    found = [_factors(points, channel) for channel in range(3)]
    logs = np.stack([logs for logs, _ in found], -1)  # [k, 3]
    spread = np.einsum("yi,xj,ijc->yxc", rows, columns, logs[:-1].reshape(rows.shape[1], columns.shape[1], 3))
    environment.multiply(torch.from_numpy(spread.reshape(-1, 3)), torch.from_numpy(logs[-1:]))
    return float(np.sqrt(np.mean([change**2 for _, change in found])))


def _look(
    assembly: Assembly,
    environment: FittedEnvironment,
    splines: tuple[Tensor, Tensor],
    views: TrainingViews,
    iteration: int,
) -> _Points | None:
    """Draw the points and their light; ``splines`` by rows and columns of the map, see :func:`levels`."""
    materials, world, radiance = assembly.materials, assembly.world, assembly.radiance
    assert isinstance(materials, FittedMaterials)
    assert views.sample is not None
    assert radiance is not None
    device = views.primary.origin.device
    stream = Stream(assembly.settings.seed, iteration, _STREAM, device=device)
    chosen = torch.unique(Stream(iteration, _STREAM).integers(len(views.sample.view), POINTS))
    si = views.primary(views.sample.picked(chosen).to(device), 1, stream).si
    si = si[si.valid.nonzero().squeeze(-1)]
    if len(si) == 0:
        return None
    basis = [x.float().to(device) for x in splines]
    count = basis[0].shape[1] * basis[1].shape[1]
    sky, rest = torch.zeros(len(si), count + 1, 3, device=device), torch.zeros(len(si), 3, device=device)
    n = faceforward(si)
    for _ in range(DIRECTIONS):
        # ---------------------- From the sky ----------------------
        ds = environment.sample(si.p, stream.uniform(len(si), 3))
        rays, t_max = world.geometry.spawn_towards(si, ds.wi, ds.distance)
        cos = dot(n, ds.wi).clamp_min(0.0)
        seen = torch.where(ds.pdf > 0, cos, 0.0) * world.visibility(rays, t_max)
        light = ds.radiance * (seen / (DIRECTIONS * ds.pdf.clamp_min(1e-30)))[:, None]
        row, column = environment.texel(ds.wi)
        weight = (basis[0][row][:, :, None] * basis[1][column][:, None, :]).view(len(si), count)
        of_sun = environment.sun.shows(ds.wi)
        weight = torch.where(of_sun[:, None], 0.0, weight)
        sky += torch.cat((weight, of_sun[:, None].float()), -1)[..., None] * light[:, None]
        # ---------------------- From surfaces ----------------------
        u = stream.uniform(len(si), 3)
        wi = Frame.around(n).to_world(cosine_hemisphere(u[:, :2]))
        hit = world.trace_past_delta(world.geometry.spawn(si, wi), u[:, 2])
        reflected = radiance(hit.si, materials(hit.si).albedo) + world.emitted(hit.si)
        rest += hit.attenuate(hit.si.where_hit(reflected)) * (np.pi / DIRECTIONS)
    return _Points(
        materials(si).albedo.double().cpu().numpy(), _parts(assembly, si), _halves(si),
        sky.double().cpu().numpy(), rest.double().cpu().numpy(),
    )  # fmt: skip


def _parts(assembly: Assembly, si: SurfaceInteraction) -> IntArray:
    """Connected part of each point [n], in a scan of a room with the way that it faces."""
    materials = assembly.materials
    assert isinstance(materials, FittedMaterials)
    parts = materials.recovered[ALBEDO.name].parts or SurfaceParts(assembly.world.geometry)
    found: IntArray = parts_of_scan(parts.of(si.prim), si, len(si)).cpu().numpy()
    return found


def _halves(si: SurfaceInteraction) -> IntArray:
    """Which half each point belongs to [n]: those of a chessboard of blocks."""
    p = si.p.double().cpu().numpy()
    low, high = p.min(0), p.max(0)
    block = np.floor((p - low) / (float((high - low).max()) + 1e-30) * BLOCKS).astype(np.int64)
    half: IntArray = block.sum(1) % 2
    return half


def _factors(points: _Points, channel: int) -> tuple[Float64Array, float]:
    """Logarithms of the factors of the sky's parts [k] in one channel, and the root mean square of what they change."""
    everything, (first, second) = np.ones(len(points.part)), (1.0 * (points.half == half) for half in (0, 1))
    found = _solved(points, channel, everything)
    one, other = (
        _centred(_change(points, channel, _solved(points, channel, half)), points.part) for half in (first, second)
    )
    scale = float(np.sqrt((one @ one) * (other @ other)))
    agreement = max(float(one @ other) / scale, 0.0) if scale > 0.0 else 0.0
    change = _centred(_change(points, channel, agreement * found), points.part)
    return agreement * found, float(np.sqrt(np.mean(change**2)))


def _change(points: _Points, channel: int, logs: Float64Array) -> Float64Array:
    """Change of the logarithm of the irradiance [n] by factors of the sky's parts."""
    sky, rest = points.light(channel)
    found: Float64Array = np.log(rest + sky @ np.exp(logs)) - np.log(rest + sky.sum(1))
    return found


def _solved(points: _Points, channel: int, use: Float64Array) -> Float64Array:
    """The logarithms of the factors [k] by points that are used [n], 0 or 1."""
    sky, rest = points.light(channel)
    y = np.log(points.albedo[:, channel] + DARK)
    logs, std, weight = np.zeros(sky.shape[1]), START, use
    free = max(int(use.sum()) - len(np.unique(points.part[use > 0])), 1)
    for _ in range(ROUNDS):
        lit = sky * np.exp(logs)
        residual = _centred(y - _change(points, channel, logs), points.part, weight)
        x = _centred(lit / (rest + lit.sum(1))[:, None], points.part, weight)
        level = float(np.sqrt((weight @ residual**2) / free)) + 1e-6
        weight = use * (FREEDOM + 1.0) / (FREEDOM + (residual / level) ** 2)
        # ---------------------- Normal equations ----------------------
        left = (x * weight[:, None]).T @ x / level**2
        inverse = np.linalg.inv(left + std**-2 * np.eye(len(logs)))
        logs = inverse @ (x.T @ (weight * residual) / level**2 + left @ logs)
        determined = len(logs) - float(np.trace(inverse)) / std**2
        std = float(np.sqrt((logs @ logs + START**2) / (determined + 1.0)))
    return logs


def _centred(values: Float64Array, part: IntArray, weight: Float64Array | None = None) -> Float64Array:
    """Values [n] or [n, c] less their weighted mean over each part."""
    weight = np.ones(len(part)) if weight is None else weight
    columns = values.reshape(len(part), -1)
    total = np.maximum(np.bincount(part, weight), 1e-30)
    means = np.stack([np.bincount(part, weight * column) / total for column in columns.T], -1)
    found: Float64Array = (columns - means[part]).reshape(values.shape)
    return found
