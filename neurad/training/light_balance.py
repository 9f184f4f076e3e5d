"""What the albedo that is being recovered says of light that no photograph shows.

Where no photograph shows a part of an unknown sky, or a lamp but clipped, :mod:`neurad.evidence.light_balance` tells by
what factor it is wrong. The lights are those lamps, a few splines of a sky behind openings
(:mod:`neurad.optim.pyramid_adam`), and its sun. Light that comes by way of surfaces is what photographs show, whatever
the lights are. Noise of the fractions draws the change to zero, so it is made several times.
"""

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials, one_material
from neurad.core.frame import Frame, faceforward
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere
from neurad.emitters.area import AreaLights
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.evidence.light_balance import DARK, LitPoints, blocks, factors, smooth_pieces, surfaces
from neurad.integrators.world import World
from neurad.lamps.responses import other_lights
from neurad.optim.polyak_average import averaged
from neurad.optim.pyramid_adam import levels
from neurad.scene.parts import SurfaceParts
from neurad.training.training_views import TrainingViews

TIMES = (0.2, 0.4, 0.6, 0.8)
"""When light is balanced, by the way to the end of the learning rates: what is left follows a better albedo."""
MIN_ITERATIONS = 128
"""After fewer the radiance field does not yet say what light comes by way of surfaces."""
POINTS, DIRECTIONS = 4096, 32
"""Photographed points, and directions from each: towards the sky, towards a lamp, and as many towards all else."""
MAX_DIRECTIONS = 256
"""Towards all lamps together, if each of them has one at least."""
LEVEL = 1
"""Of the splines: 8 rows of 16 coefficients."""
_STREAM = 59


def unsure(assembly: Assembly) -> list[FittedEnvironment | FittedLamps]:
    """The lights of which the albedo is asked: a sky behind openings, and lamps of which some are shown by no
    photograph, or clipped by all; none without a radiance field.
    """
    if assembly.radiance is None:
        return []
    sky, lamps = assembly.environment, assembly.lamps
    found: list[FittedEnvironment | FittedLamps] = []
    if sky is not None and sky.openings is not None:
        found.append(sky)
    if lamps is not None and lamps.values.requires_grad and bool((lamps.unclipped == 0).any()):
        found.append(lamps)
    return found


def balance_light(assembly: Assembly, views: TrainingViews, iteration: int) -> float | None:
    """Multiply parts of the light by what makes the albedo flat; the root mean square of the change of the albedo's
    logarithm that is asked for, or None where too little is seen.
    """
    with torch.no_grad(), averaged(assembly.average), assembly.world.tracer.uncounted():
        points = _look(assembly, views, iteration)
    if points is None:
        return None
    logs, changed = factors(points)
    for light in unsure(assembly):
        if isinstance(light, FittedLamps):
            radiance = light.found()
            radiance[(light.unclipped == 0).cpu().numpy()] *= np.exp(logs)
            light.set_radiance(radiance)
        else:
            rows, columns = levels(light.height, light.width)[LEVEL]
            count = rows.shape[1] * columns.shape[1] + 1
            own, logs = logs[:count], logs[count:]
            spread = np.einsum("yi,xj,ijc->yxc", rows, columns, own[:-1].reshape(rows.shape[1], columns.shape[1], 3))
            light.multiply(torch.from_numpy(spread.reshape(-1, 3)), torch.from_numpy(own[-1:]))
    return changed


def _look(assembly: Assembly, views: TrainingViews, iteration: int) -> LitPoints | None:
    materials, world, radiance = assembly.materials, assembly.world, assembly.radiance
    assert isinstance(materials, FittedMaterials)
    assert views.sample is not None
    assert radiance is not None
    device = views.primary.origin.device
    stream = Stream(assembly.settings.seed, iteration, _STREAM, device=device)
    chosen = torch.unique(Stream(iteration, _STREAM).integers(len(views.sample.view), POINTS))
    si = views.primary(views.sample[chosen].to(device), 1, stream).si
    si = si[si.valid.nonzero().squeeze(-1)]
    if len(si) == 0:
        return None
    # ---------------------- From the lights ----------------------
    lights, asked, rest = unsure(assembly), [], torch.zeros_like(si.p)
    for light in lights:
        if isinstance(light, FittedLamps):
            each = _of_lamps(world, light, si, stream)
            shown = light.unclipped > 0
            asked.append(each[:, ~shown])
            rest += each[:, shown].sum(1)
        else:
            asked.append(_of_sky(world, light, si, stream))
    if (others := other_lights(world, assembly.environment if assembly.environment in lights else None)) is not None:
        for _, arriving in world.irradiance_samples(others, si, DIRECTIONS, stream):
            rest += arriving / np.pi
    # ---------------------- From surfaces ----------------------
    around = Frame.around(faceforward(si))
    for _ in range(DIRECTIONS):
        u = stream.uniform(len(si), 3)
        hit = world.trace_past_delta(world.geometry.spawn(si, around.to_world(cosine_hemisphere(u[:, :2]))), u[:, 2])
        leaves = radiance(hit.si, materials(hit.si).albedo)
        if assembly.lamps not in lights:
            leaves = leaves + world.emitted(hit.si)
        rest += hit.attenuate(hit.si.where_hit(leaves)) / DIRECTIONS
    # While a fit runs dark places are known least: floors keep them from saying much of the light.
    sheet = torch.cat((*asked, rest[:, None]), 1)
    sheet[:, -1] += DARK * sheet.sum(1).mean(0)
    color = (materials(si).albedo + DARK) * sheet.sum(1)
    color, sheets = (x.double().cpu().numpy() for x in (color, sheet))
    # What lamps light ends where smooth pieces do; a sky shows best on walls of one colour that face many ways.
    if assembly.lamps in lights:
        part = smooth_pieces(world.geometry, si)
    else:
        joined = one_material(assembly.scene, world.geometry)
        part = surfaces(si, SurfaceParts(world.geometry, joined=joined))
    return LitPoints(color, part, blocks(si), sheets, np.zeros((1, *sheets.shape)))


def _of_sky(world: World, sky: FittedEnvironment, si: SurfaceInteraction, stream: Stream) -> Tensor:
    """Radiance of white sheets by each spline of the sky and by its sun [n, k + 1, 3]."""
    rows, columns = (x.float().to(si.p.device) for x in levels(sky.height, sky.width)[LEVEL])
    count = rows.shape[1] * columns.shape[1]
    sheet = torch.zeros(len(si), count + 1, 3, device=si.p.device)
    for wi, light in world.irradiance_samples(sky, si, DIRECTIONS, stream):
        row, column = sky.texel(wi)
        weight = (rows[row][:, :, None] * columns[column][:, None, :]).view(len(si), count)
        of_sun = sky.sun.shows(wi)
        weight = torch.where(of_sun[:, None], 0.0, weight)
        sheet += torch.cat((weight, of_sun[:, None].float()), -1)[..., None] * (light[:, None] / np.pi)
    return sheet


def _of_lamps(world: World, lamps: FittedLamps, si: SurfaceInteraction, stream: Stream) -> Tensor:
    """Radiance of white sheets by each lamp [n, k, 3]."""
    sheet = torch.zeros(len(si), len(lamps.mesh), 3, device=si.p.device)
    count = max(min(DIRECTIONS, MAX_DIRECTIONS // len(lamps.mesh)), 1)
    for k in range(len(lamps.mesh)):
        lamp = AreaLights(world.geometry, torch.where((lamps.lamp == k)[:, None], lamps.emission, 0.0))
        for _, light in world.irradiance_samples(lamp, si, count, stream):
            sheet[:, k] += light / np.pi
    return sheet
