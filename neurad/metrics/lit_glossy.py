"""Pixels whose roughness the photographs determine: glossy surfaces with a highlight in some training view.

The roughness of a diffuse wall without a highlight changes no photograph, so no method can recover it; these pixels
are scored apart.
"""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neurad.core.records import BoolArray, Surface, SurfaceInteraction
from neurad.core.rng import Stream, mix
from neurad.integrators.method import Method, SceneModel
from neurad.integrators.vertex import DIMENSIONS
from neurad.metrics.held_out import HeldOut
from neurad.runtime.progress import counted

SEED = 20230808
MAX_ROUGHNESS = 0.4
"""Largest true roughness of a glossy pixel."""
MIN_SPECULAR = 0.1
"""Smallest specular fraction of the light that such a pixel reflects."""


@torch.no_grad()
def lit_glossy(held_out: HeldOut, method: Method, model: SceneModel, samples: int = 2) -> list[BoolArray]:
    """Counted pixels [h, w] of every held-out view that are glossy and visibly lit.

    A pixel belongs if its true roughness is at most :data:`MAX_ROUGHNESS` and the specular part is at least the
    fraction :data:`MIN_SPECULAR` of the light reflected towards some training view that sees it. The specular part is
    what remains with albedo 0; both are estimated with the true materials and the same random numbers, summed over a
    few sub-samples of the pixel. Views without ground truth have no such pixel.

    Args:
        method: estimates the light that surfaces of the ``model`` reflect.
        samples: such estimates for each sub-sample and training view.
    """
    masks = []
    views = len(held_out.views)
    for index in counted(range(views), "evaluating", views, "glossy pixels"):
        size = held_out.size(index)
        truth = held_out.truth(index)
        if "albedo_true" not in truth or "roughness_true" not in truth:
            masks.append(np.zeros(size, np.bool_))
            continue
        glossy = held_out.counted(index) & (truth["roughness_true"][..., 0] <= MAX_ROUGHNESS)
        albedo = torch.from_numpy(truth["albedo_true"]).view(-1, 3)
        roughness = torch.from_numpy(truth["roughness_true"]).view(-1, 1)
        result = torch.zeros(size[0] * size[1], dtype=torch.bool)
        for part, si in held_out.sub_samples(index, few=True):
            chosen = torch.from_numpy(glossy.reshape(-1)[part])
            pixel = chosen.nonzero().squeeze(-1)
            if len(pixel) == 0:
                continue
            device, per = si.p.device, len(si) // len(chosen)
            surface = Surface(albedo[part][pixel].to(device), roughness[part][pixel].to(device)).repeat(per)
            lanes = si[chosen.to(device).repeat_interleave(per)]
            visible = _highlight_visible(held_out, method, model, lanes, surface, per, samples)
            result[part.start + pixel] = visible.cpu()
        masks.append(result.view(size).numpy())
    return masks


def _highlight_visible(
    held_out: HeldOut,
    method: Method,
    model: SceneModel,
    si: SurfaceInteraction,
    surface: Surface,
    per: int,
    samples: int,
) -> Tensor:
    """Whether pixels of ``per`` lanes each [n / per] have a visible specular part in some training view: bool."""
    pixels = torch.arange(len(si), device=si.p.device) // per
    visible = torch.zeros(len(si) // per, dtype=torch.bool, device=si.p.device)
    for index in range(len(held_out.training.cameras)):
        left = (~visible[pixels]).nonzero().squeeze(-1)
        if len(left) == 0:
            break
        lanes, wo = held_out.training.by(index, si[left])
        lanes = left[lanes]
        seen = replace(si[lanes], wo=wo)
        whole = surface[lanes]
        specular = replace(whole, albedo=torch.zeros_like(whole.albedo))
        sums = torch.zeros(2, len(visible), device=si.p.device)
        for k in range(samples):
            for row, s in enumerate((specular, whole)):
                stream = Stream(mix(SEED, index, k), device=si.p.device)
                u = stream.uniform(len(seen), DIMENSIONS)
                light = method.reflected(model, seen, s, u, stream).value
                sums[row].index_add_(0, pixels[lanes], light.sum(-1))
        visible |= (sums[0] > 0) & (sums[0] >= MIN_SPECULAR * sums[1])
    return visible
