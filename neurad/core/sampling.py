"""Warps from uniform numbers, multiple importance sampling, and choices that are even."""

import math

import torch
from torch import Tensor

INV_PI = 1.0 / math.pi


def mis_weight(pdf: Tensor, other: Tensor) -> Tensor:
    """Balance heuristic of a sample drawn with ``pdf`` that ``other`` could have drawn too [n]; 0 where pdf is 0."""
    return torch.where(pdf > 0, pdf / (pdf + other).clamp_min(torch.finfo(pdf.dtype).tiny), 0.0)


def evenly(count: int, most: int, device: torch.device | str = "cpu") -> Tensor:
    """Indices [n] of at most so many of ``count`` things, evenly over all."""
    chosen = min(count, most)
    return torch.arange(chosen, device=device) * count // max(chosen, 1)


def concentric_disk(u: Tensor) -> Tensor:
    """Uniform points of the unit disk [n, 2] from uniform numbers [n, 2] (Shirley and Chiu 1997)."""
    a, b = (2.0 * u - 1.0).unbind(-1)
    wide = a.abs() > b.abs()
    r = torch.where(wide, a, b)
    ratio = torch.where(wide, b, a) / torch.where(r == 0, 1.0, r)
    phi = torch.where(wide, (math.pi / 4) * ratio, (math.pi / 2) - (math.pi / 4) * ratio)
    return torch.stack((r * phi.cos(), r * phi.sin()), -1)


def disk_to_square(xy: Tensor) -> Tensor:
    """The numbers [n, 2] from which :func:`concentric_disk` makes points ``xy`` [n, 2] of the unit disk."""
    x, y = xy.unbind(-1)
    radius = (x * x + y * y).sqrt()
    wide = x.abs() > y.abs()
    long, short = torch.where(wide, x, y), torch.where(wide, y, x)
    first = radius * torch.where(long > 0, 1.0, -1.0)
    second = first * (4 / math.pi) * torch.where(long == 0, 0.0, short / torch.where(long == 0, 1.0, long)).atan()
    a, b = torch.where(wide, first, second), torch.where(wide, second, first)
    return 0.5 * torch.stack((a, b), -1) + 0.5


def cosine_hemisphere(u: Tensor) -> Tensor:
    """Directions [n, 3] about +z with density cos(theta) / pi from uniform numbers [n, 2]."""
    disk = concentric_disk(u)
    z = (1.0 - (disk * disk).sum(-1, keepdim=True)).clamp_min(0.0).sqrt()
    return torch.cat((disk, z), -1)


def uniform_cone(u: Tensor, one_minus_cos: Tensor | float) -> Tensor:
    """Directions [n, 3] about +z, uniform in solid angle within a cone, from uniform numbers [n, 2].

    Args:
        one_minus_cos: 1 - cos of the cone's half angle, whose digits the cosine itself would lose.
    """
    disk = concentric_disk(u)
    down = (disk * disk).sum(-1, keepdim=True) * one_minus_cos  # the square is uniform in [0, 1]
    return torch.cat((disk * (one_minus_cos * (2.0 - down)).sqrt(), 1.0 - down), -1)


def uniform_triangle(u: Tensor) -> Tensor:
    """Barycentrics (u, v) [n, 2], uniform over a triangle, from uniform numbers [n, 2]."""
    root = (1.0 - u[..., :1]).sqrt()
    return torch.cat((1.0 - root, root * u[..., 1:]), -1)
