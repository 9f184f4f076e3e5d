"""What the albedo that is being recovered says of an unknown sky that shines in through openings.

Where no photograph shows a part of the sky, :mod:`neurad.evidence.light_balance` tells by what factor it is wrong. The
lights are those of a few splines (:mod:`neurad.optim.pyramid_adam`), and the sun. Light that comes by way of surfaces
is what photographs show, whatever the sky is. Noise of the fractions draws the change to zero, so it is made several
times.
"""

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly, FittedMaterials
from neurad.core.frame import Frame, faceforward
from neurad.core.parameters import ALBEDO
from neurad.core.records import IntArray, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere
from neurad.emitters.fitted import FittedEnvironment
from neurad.evidence.light_balance import DARK, LitPoints, blocks, factors
from neurad.evidence.shading import parts_of_scan
from neurad.integrators.irradiance import irradiance_samples
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
_STREAM = 59


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
    logs, changed = factors(points)
    spread = np.einsum("yi,xj,ijc->yxc", rows, columns, logs[:-1].reshape(rows.shape[1], columns.shape[1], 3))
    environment.multiply(torch.from_numpy(spread.reshape(-1, 3)), torch.from_numpy(logs[-1:]))
    return changed


def _look(
    assembly: Assembly,
    environment: FittedEnvironment,
    splines: tuple[Tensor, Tensor],
    views: TrainingViews,
    iteration: int,
) -> LitPoints | None:
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
    sheet, n = torch.zeros(len(si), count + 2, 3, device=device), faceforward(si)
    for wi_em, light in irradiance_samples(world, environment, si, DIRECTIONS, stream):
        # ---------------------- From the sky ----------------------
        row, column = environment.texel(wi_em)
        weight = (basis[0][row][:, :, None] * basis[1][column][:, None, :]).view(len(si), count)
        of_sun = environment.sun.shows(wi_em)
        weight = torch.where(of_sun[:, None], 0.0, weight)
        sheet[:, :-1] += torch.cat((weight, of_sun[:, None].float()), -1)[..., None] * (light[:, None] / np.pi)
        # ---------------------- From surfaces ----------------------
        u = stream.uniform(len(si), 3)
        wi = Frame.around(n).to_world(cosine_hemisphere(u[:, :2]))
        hit = world.trace_past_delta(world.geometry.spawn(si, wi), u[:, 2])
        reflected = radiance(hit.si, materials(hit.si).albedo) + world.emitted(hit.si)
        sheet[:, -1] += hit.attenuate(hit.si.where_hit(reflected)) / DIRECTIONS
    # While a fit runs dark places are known least: floors keep them from saying much of the sky.
    sheet[:, -1] += DARK * sheet.sum(1).mean(0)
    color = (materials(si).albedo + DARK) * sheet.sum(1)
    color, lights = (x.double().cpu().numpy() for x in (color, sheet))
    return LitPoints(color, _parts(assembly, si), blocks(si), lights, np.zeros((1, *lights.shape)))


def _parts(assembly: Assembly, si: SurfaceInteraction) -> IntArray:
    """Connected part of each point [n], in a scan of a room with the way that it faces."""
    materials = assembly.materials
    assert isinstance(materials, FittedMaterials)
    parts = materials.recovered[ALBEDO.name].parts or SurfaceParts(assembly.world.geometry)
    found: IntArray = parts_of_scan(parts.of(si.prim), si, len(si)).cpu().numpy()
    return found
