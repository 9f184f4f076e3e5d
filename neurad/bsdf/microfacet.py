"""GGX microfacets: Fresnel factor, shadowing and the sampling of visible normals, all isotropic."""

from __future__ import annotations

import torch
from torch import Tensor

from neurad.core.sampling import concentric_disk

MIN_ALPHA = 0.001
"""Smallest GGX width; Mitsuba's ``principled`` has the same."""


def alpha_of(roughness: Tensor) -> Tensor:
    """GGX width of a Burley roughness, ``max(0.001, roughness^2)``, any shape."""
    return (roughness * roughness).clamp_min(MIN_ALPHA)


def fresnel_dielectric(cos: Tensor, eta: Tensor | float) -> Tensor:
    """Reflectance [n] of a smooth dielectric for unpolarised light that arrives from outside.

    Args:
        cos: cosine of the angle of incidence, in (0, 1] [n].
        eta: refractive index inside over outside; below 1 there is total reflection.
    """
    cos_t = (1.0 - (1.0 - cos * cos) / (eta * eta)).clamp_min(0.0).sqrt()
    s = (cos - eta * cos_t) / (cos + eta * cos_t)
    p = (eta * cos - cos_t) / (eta * cos + cos_t)
    return 0.5 * (s * s + p * p)


def smith_sum(z: Tensor, alpha2: Tensor) -> Tensor:
    """``A = z + sqrt(z^2 + alpha^2 (1 - z^2))`` [n] for a direction of cosine ``z`` >= 0: Smith's ``G1 = 2 z / A``.

    Unlike G1 itself it needs no tangent, so it is exact at normal and at grazing directions.
    """
    z2 = z * z
    return z + (z2 + alpha2 * (1.0 - z2)).sqrt()


def visible_normal(wo: Tensor, alpha: Tensor, u: Tensor) -> Tensor:
    """Unit normals [n, 3] drawn with the density of normals that are visible from ``wo`` (Heitz 2018, "Sampling the
    GGX Distribution of Visible Normals"), from the same numbers the same normals as Mitsuba.

    Args:
        wo: local directions with z >= 0 [n, 3].
        alpha: GGX width [n, 1].
        u: uniform numbers [n, 2].
    """
    stretched = torch.nn.functional.normalize(torch.cat((alpha * wo[:, :2], wo[:, 2:]), -1), dim=-1)
    x, y, cos = stretched.unbind(-1)
    sin = (x * x + y * y).sqrt()
    flat = sin < 1e-6  # looking along the normal: any azimuth will do
    inverse = 1.0 / sin.clamp_min(1e-6)
    cos_phi, sin_phi = torch.where(flat, 1.0, x * inverse), torch.where(flat, 0.0, y * inverse)

    a, b = concentric_disk(u).unbind(-1)
    chord = (1.0 - a * a).clamp_min(0.0)
    b = torch.lerp(chord.sqrt(), b, 0.5 * (1.0 + cos))
    c = (chord - b * b).clamp_min(0.0).sqrt()
    along, up = sin * c - cos * b, sin * b + cos * c
    w = alpha.squeeze(-1)
    normal = (w * (cos_phi * along + sin_phi * a), w * (sin_phi * along - cos_phi * a), up.clamp_min(1e-6))
    return torch.nn.functional.normalize(torch.stack(normal, -1), dim=-1)
