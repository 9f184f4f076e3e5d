"""GGX microfacets: Fresnel factors, value, density and sampling of reflection, what it reflects in all; isotropic."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from neurad.core.frame import dot
from neurad.core.sampling import INV_PI, concentric_disk

MIN_ALPHA = 0.001
"""Smallest GGX width; Mitsuba's ``principled`` has the same."""
_MIN_HALF = 1e-6  # smallest z of wo + wi, so that two opposite grazing directions still have a half-vector


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


def fresnel_conductor(cos: Tensor, eta: Tensor, k: Tensor) -> Tensor:
    """Reflectance [n, channels] of a smooth conductor for unpolarised light from a vacuum.

    Args:
        cos: cosine of the angle of incidence, in [0, 1] [n].
        eta: real part of the refractive index [channels].
        k: its imaginary part [channels].
    """
    cos = cos.unsqueeze(-1)
    cos2 = cos * cos
    sin2 = 1.0 - cos2
    real = eta * eta - k * k - sin2
    size = (real * real + 4.0 * k * k * eta * eta).sqrt()
    twice = 2.0 * cos * (0.5 * (size + real)).clamp_min(0.0).sqrt()
    s = (size + cos2 - twice) / (size + cos2 + twice)
    p = s * (size * cos2 + sin2 * sin2 - twice * sin2) / (size * cos2 + sin2 * sin2 + twice * sin2)
    return 0.5 * (s + p)


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


def mirror(wo: Tensor, normal: Tensor) -> Tensor:
    """``wo`` [n, 3] reflected about unit normals [n, 3]."""
    return 2.0 * dot(wo, normal).unsqueeze(-1) * normal - wo


def ggx_reflection(
    wo: Tensor, wi: Tensor, alpha: Tensor, correlated: Tensor | float = 0.0
) -> tuple[Tensor, Tensor, Tensor]:
    """Reflection by GGX microfacets that reflect everything, and the density of drawing it by visible normals.

    ``g = D G1(wo) G1(wi) / (4 cos(wo))``, cosine of ``wi`` included, and ``pdf = G1(wo) D / (4 cos(wo))``. With Smith's
    ``G1 = 2 z / A`` every division by a cosine cancels. That is Mitsuba's ``principled``, where masking and shadowing
    are independent. In Cycles and glTF they are correlated by height (Heitz 2014, "Understanding the Masking-Shadowing
    Function in Microfacet-Based BRDFs", Eq. 99), which divides g by ``G1(wo) + G1(wi) - G1(wo) G1(wi)``.

    Args:
        wo: towards the viewer, local [n, 3].
        wi: towards the light, local [n, 3].
        alpha: GGX width [n].
        correlated: part of the reflection that is correlated, of all lanes or of each [n].

    Returns:
        g [n], which is differentiable in ``alpha``, the detached pdf [n], and the cosine [n] between ``wo`` and the
        half-vector. g and pdf are 0 where ``wo`` or ``wi`` lies below the surface.
    """
    (xo, yo, zo), (xi, yi, zi) = wo.unbind(-1), wi.unbind(-1)
    zi = torch.where(zo > 0, zi.clamp_min(0.0), 0.0)  # g is proportional to it
    zo = zo.clamp_min(0.0)
    hx, hy, hz = xo + xi, yo + yi, (zo + zi).clamp_min(_MIN_HALF)
    flat, up = hx * hx + hy * hy, hz * hz
    length = flat + up  # 4 cos^2

    alpha2 = alpha * alpha
    ratio = length / (flat + alpha2 * up)
    density = alpha2 * ratio * ratio * INV_PI  # D
    toward_viewer, toward_light = smith_sum(zo, alpha2), smith_sum(zi, alpha2)
    reflection = density * zi / (toward_viewer * toward_light)
    if isinstance(correlated, Tensor) or correlated > 0.0:
        separable_over_correlated = _separable_over_correlated(2.0 * zo / toward_viewer, 2.0 * zi / toward_light)
        reflection = reflection * (1.0 + correlated * (1.0 / separable_over_correlated.clamp_min(_MIN_HALF) - 1.0))
    pdf = torch.where(zi > 0, 0.5 * density.detach() / toward_viewer.detach(), 0.0)
    return reflection, pdf, 0.5 * length.sqrt()


def reflectance(
    cosine: Tensor, alpha: float, fresnel: Callable[[Tensor], Tensor], nodes: int = 32, correlated: bool = False
) -> Tensor:
    """What GGX microfacets reflect in all directions towards viewers at ``cosine`` [c] from the normal: [c, channels].

    Args:
        fresnel: cosines [n] to reflectances [n, channels].
        nodes: of the quadrature, in each dimension.
        correlated: whether masking and shadowing are, see :func:`ggx_reflection`.
    """
    wo, normal, weights = _quadrature(cosine, alpha, nodes)
    shadowing = _shadowing(mirror(wo, normal)[:, 2], alpha)
    if correlated:
        shadowing = shadowing / _separable_over_correlated(_shadowing(wo[:, 2], alpha), shadowing)
    seen = fresnel(dot(wo, normal).clamp(1e-6, 1.0)) * shadowing
    return (seen.view(len(cosine), -1, seen.shape[-1]) * weights).sum(1)


def transmittance(cosine: Tensor, alpha: float, eta: float, nodes: int = 32) -> Tensor:
    """What a GGX surface transmits of light that arrives at ``cosine`` [c] from the normal at a dielectric of index
    ``eta``, that of the far side over the near one: [c, 1].
    """
    wo, normal, weights = _quadrature(cosine, alpha, nodes)
    cos = dot(wo, normal).clamp(1e-6, 1.0)
    cos_t = (1.0 - (1.0 - cos * cos) / (eta * eta)).clamp_min(0.0).sqrt()
    down = wo[:, 2] / eta - (cos / eta - cos_t) * normal[:, 2]  # cosine of the refracted direction, on the far side
    through = (1.0 - fresnel_dielectric(cos, eta)).unsqueeze(-1) * _shadowing(down, alpha)
    return (through.view(len(cosine), -1, 1) * weights).sum(1)


def _quadrature(cosine: Tensor, alpha: float, nodes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Directions towards viewers and visible normals, both [c * nodes^2, 3], and their weights [nodes^2, 1].

    A product of Gauss-Legendre rules over the numbers that visible normals are drawn from, as Mitsuba has it.
    """
    at, weight = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(nodes))
    u = torch.cartesian_prod(0.5 + 0.5 * at, 0.5 + 0.5 * at).repeat(len(cosine), 1)
    cosine = cosine.clamp_min(1e-6).repeat_interleave(nodes * nodes)
    wo = torch.stack(((1.0 - cosine * cosine).clamp_min(0.0).sqrt(), torch.zeros_like(cosine), cosine), -1)
    normal = visible_normal(wo, torch.full_like(wo[:, :1], alpha), u)
    return wo, normal, (0.25 * weight[:, None] * weight).view(-1, 1)


def _shadowing(z: Tensor, alpha: float) -> Tensor:
    """Smith's G1 [n, 1] of directions at cosine ``z`` [n]; 0 below the horizon."""
    z = z.clamp_min(0.0)
    return (2.0 * z / smith_sum(z, torch.full_like(z, alpha * alpha))).unsqueeze(-1)


def _separable_over_correlated(masking: Tensor, shadowing: Tensor) -> Tensor:
    """Product of Smith's two G1 over the G2 of height-correlated masking and shadowing, any shape."""
    return masking + shadowing - masking * shadowing


def interpolated(table: Tensor, x: Tensor) -> Tensor:
    """Rows of ``table`` [c, channels], evenly over 0 to 1, linear at ``x`` [n] in between: [n, channels]."""
    place = x.clamp(0.0, 1.0) * (len(table) - 1)
    low = place.floor().clamp_max(len(table) - 2)
    index = low.long()
    return torch.lerp(table[index], table[index + 1], (place - low).unsqueeze(-1))
