"""Warps from uniform numbers, and multiple importance sampling."""

from __future__ import annotations

import math

import torch
from torch import Tensor

INV_PI = 1.0 / math.pi


def mis_weight(pdf: Tensor, other: Tensor) -> Tensor:
    """Balance heuristic of a sample drawn with ``pdf`` that ``other`` could have drawn too [n]; 0 where pdf is 0."""
    return torch.where(pdf > 0, pdf / (pdf + other).clamp_min(torch.finfo(pdf.dtype).tiny), 0.0)


def concentric_disk(u: Tensor) -> Tensor:
    """Uniform points of the unit disk [n, 2] from uniform numbers [n, 2] (Shirley and Chiu 1997)."""
    a, b = (2.0 * u - 1.0).unbind(-1)
    wide = a.abs() > b.abs()
    r = torch.where(wide, a, b)
    ratio = torch.where(wide, b, a) / torch.where(r == 0, 1.0, r)
    phi = torch.where(wide, (math.pi / 4) * ratio, (math.pi / 2) - (math.pi / 4) * ratio)
    return torch.stack((r * phi.cos(), r * phi.sin()), -1)


def cosine_hemisphere(u: Tensor) -> Tensor:
    """Directions [n, 3] about +z with density cos(theta) / pi from uniform numbers [n, 2]."""
    disk = concentric_disk(u)
    z = (1.0 - (disk * disk).sum(-1, keepdim=True)).clamp_min(0.0).sqrt()
    return torch.cat((disk, z), -1)


def uniform_triangle(u: Tensor) -> Tensor:
    """Barycentrics (u, v) [n, 2], uniform over a triangle, from uniform numbers [n, 2]."""
    root = (1.0 - u[..., :1]).sqrt()
    return torch.cat((1.0 - root, root * u[..., 1:]), -1)
