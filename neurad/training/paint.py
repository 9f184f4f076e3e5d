"""The search for plain paint at the end of a fit, see :mod:`neurad.evidence.paint`."""

import torch

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.parameters import ALBEDO
from neurad.core.rng import Stream
from neurad.evidence.error_bars import ErrorBars
from neurad.evidence.paint import find_paint
from neurad.fields.segments import Segments
from neurad.training.training_views import TrainingViews

POINTS = 1 << 16
"""Photographed points that are looked at."""
_STREAM = 67  # last number of the stream's key


def segments_of(assembly: Assembly) -> Segments | None:
    """What segments have of their own in the albedo; None where they have nothing."""
    materials = assembly.materials
    return materials.recovered[ALBEDO.name].segments if isinstance(materials, FittedMaterials) else None


@torch.no_grad()
def show_paint(segments: Segments, assembly: Assembly, views: TrainingViews, bars: ErrorBars, iteration: int) -> None:
    """Find the paint of the albedo's segments by photographed points, for results to show.

    Args:
        assembly: with the materials that are reported, the averaged ones if the run averages.
        iteration: iterations done, the key of the random numbers.
    """
    materials = assembly.materials
    assert isinstance(materials, FittedMaterials)
    if views.sample is None:
        return
    stream = Stream(assembly.settings.seed, iteration, _STREAM, device=segments.paint.device)
    si, _ = views.primary.some(views.sample, POINTS, stream)
    emission = assembly.world.geometry.emission.amax(-1)
    si = si[(si.valid & (emission[si.prim.clamp_min(0)] <= 0)).nonzero().squeeze(-1)]
    albedo, std = materials(si).albedo.cpu().numpy(), bars.at(materials, si.p, si.prim)[ALBEDO.name]
    segment = segments.at(si.p, si.prim).cpu().numpy()
    segments.paint.copy_(torch.from_numpy(find_paint(albedo, std, segment, len(segments.paint))))
