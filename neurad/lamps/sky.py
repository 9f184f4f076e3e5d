"""What photographs say of an unknown sky before a fit: what they show of it, and where the sun stands that shines in
through windows.

Within a patch of sunlight a surface is several times as bright as beside it. So the logarithms of two pixels near each
other on one surface differ where the sun reaches one of them alone, and the direction is searched for in which that is
so: the one whose visibility correlates best with what photographs show. No material enters, and no other light.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.frame import Frame, dot, faceforward
from neurad.core.records import Float64Array, PixelBatch, Rays, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import uniform_cone
from neurad.emitters.fitted import FittedEnvironment
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.world import World
from neurad.runtime.progress import phase, say

PIXELS, NEIGHBOURS = 1 << 14, 8
"""Pixels that are looked at, and how many near ones each is compared with."""
POSITIONS = 8
"""In a pixel that shows nothing but sky: one at the edge of a window would begin the sky too dark."""
BESIDE_SUN = 2.0
"""Texels around the sun that the map does not begin with."""
SKY = 3000
"""Directions of the whole sphere among which the first search chooses."""
ROUNDS = 6
"""Searches around the best direction so far, each at half the spacing of the one before; half as many for a disk."""
RADII = (0.0047, 0.0094, 0.019, 0.038)
"""Angular radii of a sun, in radians: as it is, and blurred by haze, a pane or a map."""
DISK = 16
"""Directions within a disk."""
MIN_CONTRAST = math.log(2.0)
"""How much brighter a patch of sun is than what lies beside it."""
MIN_PAIRS = 50
"""Pairs of pixels, one in a patch and one beside it, that are needed in each half of the photographs."""
MAX_DISAGREEMENT = math.radians(2.0)
"""Angle between the directions that two halves of the photographs say, beyond the radius of the sun: within a wide one
no direction explains its blurred patches better than others."""
MAX_LOG = 3.0
"""Largest difference of logarithms that counts: black objects are no shadows."""
ALBEDO = 0.5
"""Albedo by which the first guess of the sun's strength is made."""
MIN_ALIKE, MAX_BESIDE = 0.95, 0.1
"""Cosine between normals of one surface, and how far a point may lie off the other's plane, over their distance."""
_STREAM, _CHUNK = 53, 1 << 18


@dataclass(frozen=True)
class Sun:
    """A disk at infinity."""

    towards: Float64Array
    """Direction of it [3], of length 1."""
    radius: float
    """Angular radius in radians."""
    irradiance: Float64Array
    """On a surface that faces it [3]: a first guess."""
    contrast: float
    """How many times as bright photographs are in its light as beside it, the median."""


@dataclass(frozen=True)
class _Pairs:
    """Pixels near each other on one surface."""

    si: SurfaceInteraction
    """What pixels show."""
    n: Tensor
    """Normals that face the camera [p, 3]."""
    color: Tensor
    """Photographed radiance [p, 3]."""
    pair: Tensor
    """Two pixels each [k, 2]."""
    difference: Tensor
    """Difference of the logarithms of their luminance [k]."""
    half: Tensor
    """Whether the photograph is of the second half [k], bool."""


def begin_sky(environment: FittedEnvironment, primary: PrimaryHits, sample: PixelBatch, seed: int) -> None:
    """Begin with what photographs show of the sky itself, and where it shines in through openings let the sun rise if
    they show its light, and say so; once in a fit.
    """
    if bool(environment.begun):
        return
    sun = None if environment.openings is None else find_sun(primary, sample, environment.openings.d, seed)
    if not primary.world.hide_environment:
        d, radiance = seen_sky(primary, sample, seed)
        if sun is not None:  # it stands apart from the map, which would blur what photographs show of it
            towards = torch.from_numpy(sun.towards).to(d)
            beside = d @ towards < math.cos(sun.radius + BESIDE_SUN * 2.0 * math.pi / environment.width)
            d, radiance = d[beside], radiance[beside]
        environment.begin(d, radiance)
    if sun is not None:
        environment.sun.rise(sun.towards, sun.radius, sun.irradiance)
        x, y, z = sun.towards
        say(
            f"the sun shines in from ({x:.3f}, {y:.3f}, {z:.3f}): surfaces are {sun.contrast:.2g} times as "
            "bright in its light as beside it"
        )
    environment.begun.fill_(True)
    environment.refresh()


@torch.no_grad()
def seen_sky(primary: PrimaryHits, sample: PixelBatch, seed: int) -> tuple[Tensor, Tensor]:
    """Unclipped pixels that show no surface at any of some positions, but for panes: their directions and the radiance
    behind these [n, 3] each.
    """
    pixels = sample.to(primary.origin.device)
    with primary.world.tracer.uncounted():
        si = primary(pixels, POSITIONS, Stream(seed, 2, _STREAM, device=primary.origin.device)).si
    shows = ~si.valid.view(-1, POSITIONS).any(-1) & (pixels.color > 0.0).all(-1)
    if pixels.clipped is not None:
        shows &= ~pixels.clipped.any(-1)
    d = -si.wo.view(-1, POSITIONS, 3)[shows, 0]
    rays = Rays(primary.origin[pixels.view[shows]], d)
    with primary.world.tracer.uncounted():
        through = primary.world.visibility(rays, torch.full_like(d[:, 0], math.inf))
    clear = through > 0
    return d[clear], (pixels.color[shows] / through[:, None])[clear]


@torch.no_grad()
def find_sun(primary: PrimaryHits, sample: PixelBatch, leaving: Tensor, seed: int) -> Sun | None:
    """The sun by the photographs of a scene that rays leave in some directions [n, 3]; None where they show none."""
    world = primary.world
    with phase("finding the sun"), world.tracer.uncounted():
        pairs = _pairs(primary, sample, seed)
        if pairs is None:
            return None
        spacing = math.sqrt(4.0 * math.pi / SKY)
        sky = _sphere(SKY).to(leaving)
        open_ = torch.cat([(part @ leaving.T).amax(-1) > math.cos(spacing) for part in torch.split(sky, 256)])
        sky = sky[open_]
        if len(sky) == 0:
            return None
        every = torch.ones_like(pairs.half)
        first = sky[int(_score(world, pairs, sky[:, None], every).argmax())]
        halves = [_closer(world, pairs, first, spacing, half) for half in (pairs.half, ~pairs.half)]
        best = _closer(world, pairs, first, spacing, every)
        disks = torch.stack([_disk(best, radius, seed) for radius in RADII])  # [radii, DISK, 3]
        radius = RADII[int(_score(world, pairs, disks, every).argmax())]
        if float(dot(halves[0], halves[1])) < math.cos(MAX_DISAGREEMENT + radius):
            return None
        if radius > RADII[0]:
            best = _closer(world, pairs, best, radius, every, radius)
        return _sun(world, pairs, best, radius)


def _pairs(primary: PrimaryHits, sample: PixelBatch, seed: int) -> _Pairs | None:
    from scipy.spatial import KDTree

    device = primary.origin.device
    chosen = torch.unique(Stream(seed, _STREAM).integers(len(sample.view), PIXELS))
    pixels = sample[chosen].to(device)
    si = primary(pixels, 1, Stream(seed, 0, _STREAM, device=device)).si
    good = si.valid & (pixels.color.mean(-1) > 0)
    si, color, view = si[good], pixels.color[good], pixels.view[good]
    if len(si) <= NEIGHBOURS:
        return None
    size = float((si.p.amax(0) - si.p.amin(0)).norm())
    apart = torch.cat((si.p, 2.0 * size * view[:, None]), -1).double().cpu().numpy()  # of one photograph
    near = torch.from_numpy(KDTree(apart).query(apart, NEIGHBOURS + 1)[1][:, 1:]).to(device)
    pair = torch.stack((torch.arange(len(si), device=device)[:, None].expand_as(near), near), -1).view(-1, 2)
    n = faceforward(si)
    a, b = pair.T
    off, distance = si.p[b] - si.p[a], (si.p[b] - si.p[a]).norm(dim=-1)
    one = (view[a] == view[b]) & (dot(n[a], n[b]) > MIN_ALIKE) & (dot(off, n[a]).abs() < MAX_BESIDE * distance)
    pair = pair[one]
    level = color.mean(-1).log()
    difference = (level[pair[:, 0]] - level[pair[:, 1]]).clamp(-MAX_LOG, MAX_LOG)
    return _Pairs(si, n, color, pair, difference, view[pair[:, 0]] % 2 == 1)


def _sphere(count: int) -> Tensor:
    """Directions of about even spacing [count, 3]: a Fibonacci lattice."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z, phi = 1.0 - 2.0 * i / count, math.pi * (1.0 + math.sqrt(5.0)) * i
    r = (1.0 - z * z).sqrt()
    return torch.stack((r * phi.cos(), r * phi.sin(), z), -1)


def _disk(direction: Tensor, radius: float, seed: int) -> Tensor:
    """Directions [DISK, 3] within an angle of one."""
    u = Stream(seed, 1, _STREAM).uniform(DISK, 2).to(direction)
    local = uniform_cone(u, 2.0 * math.sin(0.5 * radius) ** 2)
    return Frame.around(direction[None].expand(DISK, 3)).to_world(local)


def _reached(world: World, pairs: _Pairs, towards: Tensor) -> Tensor:
    """Part of some directions [d, 3] in which each pixel's surface sees the sky [p]."""
    total = torch.zeros(len(pairs.si), device=pairs.n.device)
    for d in towards:
        wi = d.expand(len(pairs.si), 3)
        lit = (dot(pairs.n, wi) > 0).nonzero().squeeze(-1)
        for part in torch.split(lit, _CHUNK):
            rays = world.geometry.spawn(pairs.si[part], wi[part])
            total[part] += world.visibility(rays, torch.full_like(rays.d[:, 0], math.inf))
    return total / len(towards)


def _score(world: World, pairs: _Pairs, candidates: Tensor, which: Tensor) -> Tensor:
    """Correlation of what candidates [c, d, 3], directions of a disk each, reach with what photographs show [c]."""
    found = []
    for towards in candidates:
        reached = _reached(world, pairs, towards)
        step = (reached[pairs.pair[:, 0]] - reached[pairs.pair[:, 1]])[which]
        found.append((step * pairs.difference[which]).sum() / step.square().sum().sqrt().clamp_min(1.0))
    return torch.stack(found)


def _closer(world: World, pairs: _Pairs, best: Tensor, spacing: float, which: Tensor, radius: float = 0.0) -> Tensor:
    """The best direction [3] around one, of a point or of the middle of a disk, which takes :data:`DISK` times as long:
    it is looked for at fewer places.
    """
    reach, rounds = (1, ROUNDS // 2) if radius > 0.0 else (2, ROUNDS)
    for _ in range(rounds):
        frame = Frame.around(best[None].expand((2 * reach + 1) ** 2, 3))
        grid = torch.arange(-reach, reach + 1, device=best.device, dtype=best.dtype) * (spacing / 2)
        x, y = (v.reshape(-1) for v in torch.meshgrid(grid, grid, indexing="ij"))
        around = frame.to_world(torch.stack((x, y, torch.ones_like(x)), -1))
        around = around / around.norm(dim=-1, keepdim=True)
        towards = torch.stack([_disk(d, radius, 0) for d in around]) if radius > 0.0 else around[:, None]
        best = around[int(_score(world, pairs, towards, which).argmax())]
        spacing /= 2
    return best


def _sun(world: World, pairs: _Pairs, direction: Tensor, radius: float) -> Sun | None:
    """The sun in a direction, if its patches are bright in both halves of the photographs."""
    reached = _reached(world, pairs, direction[None])
    crossing = reached[pairs.pair[:, 0]] > reached[pairs.pair[:, 1]]
    a, b = pairs.pair[crossing].T
    for half in (pairs.half, ~pairs.half):
        brighter = pairs.difference[crossing & half]
        if len(brighter) < MIN_PAIRS or float(brighter.median()) < MIN_CONTRAST:
            return None
    cos = dot(pairs.n[a], direction[None].expand(len(a), 3))
    more = (pairs.color[a] - pairs.color[b]) * (math.pi / ALBEDO) / cos[:, None]
    return Sun(
        direction.double().cpu().numpy(), radius, more.median(0).values.clamp_min(0.0).double().cpu().numpy(),
        math.exp(float(pairs.difference[crossing].median())),
    )  # fmt: skip
