"""The one exposure of a scene: what radiance is multiplied with before it is shown, or compared as it is shown."""

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from neurad.core.records import FloatArray
from neurad.core.scene_records import View
from neurad.images.photographs import kept_pixels, read_view
from neurad.scene.description import Scene

LEVEL = 0.8
"""Fraction of display white that the 90th percentile of the photographs is shown at."""
MAX_VIEWS = 16
"""Training photographs that decide, evenly chosen."""
MAX_PIXELS = 1 << 16
"""Pixels of a photograph that are looked at, about."""


def exposure(photographs: Iterable[FloatArray]) -> float:
    """The factor of radiance that shows the 90th percentile of what is not black in photographs [..., 3] at
    :data:`LEVEL`; 1 without any light.
    """
    lit = [pixels[pixels > 0.0] for pixels in photographs]
    values = np.concatenate(lit) if lit else np.zeros(0)
    return LEVEL / float(np.percentile(values, 90)) if len(values) else 1.0


def scene_exposure(scene: Scene) -> float:
    """The exposure of a scene's pictures, from its training photographs: it does not follow a fit, which would hide its
    progress, and a scene in another unit of radiance looks and scores the same. Where they are gone, from those
    that are scored.
    """
    for part in (scene.train, scene.scored):
        there = [view for view in part if view.image is not None and Path(view.image).is_file()]
        if there:
            return exposure(map(_pixels, there[:: math.ceil(len(there) / MAX_VIEWS)]))
    return 1.0


def _pixels(view: View) -> FloatArray:
    """Photographed pixels of a view that count [n, 3]."""
    step = math.ceil(math.sqrt(view.camera.width * view.camera.height / MAX_PIXELS))
    picture, kept = read_view(view)[::step, ::step, :3], kept_pixels(view)
    return picture if kept is None else picture[kept[::step, ::step]]
