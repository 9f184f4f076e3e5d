"""The two lobes of Burley's model in plain torch, also blended with those of Cycles and glTF."""

import torch
from torch import Tensor

from neurad.bsdf.directional import coat_albedo
from neurad.bsdf.microfacet import alpha_of, fresnel_dielectric, ggx_reflection
from neurad.core.sampling import INV_PI


def _schlick(z: Tensor) -> Tensor:
    """``(1 - z)^5`` [n]."""
    m = (1.0 - z).clamp_min(0.0)
    m2 = m * m
    return m2 * m2 * m


def lobes_pdf(
    roughness: Tensor,
    wo: Tensor,
    wi: Tensor,
    eta: float,
    specular_fraction: float | Tensor = 0.5,
    metallic: Tensor | None = None,
    lambert: float | Tensor = 0.0,
) -> tuple[Tensor, Tensor, Tensor]:
    """Diffuse and specular lobe and the density; any device and dtype, differentiable in roughness and
    metallic.

    With h the normalised ``wo + wi`` and ``c = h.wo = |wo + wi| / 2``:
    ``d = cos / pi ((1 - Fo/2)(1 - Fi/2) + R (Fo + Fi + Fo Fi (R - 1)))``, ``R = 2 roughness c^2`` (Burley 2012, 5.3,
    with the retro-reflection of Burley 2015), ``s = F g`` with the GGX reflection g of
    :func:`~neurad.bsdf.microfacet.ggx_reflection`, and ``pdf = (1 - p) cos / pi + p pdf_ggx``.

    A part ``lambert`` is as in Cycles and, but for the coat's Fresnel factor, in glTF: ``d = cos / pi (1 - E)``,
    Lambert's lobe under a coat with the directional albedo E towards the viewer, and g correlated by height. With
    albedo 1 both lobes then send back all light.

    Metal blends in Schlick's ``albedo + (1 - albedo) (1 - c)^5`` in place of F and of the diffuse lobe, which is linear
    in the albedo, too: ``f cos = albedo d + s`` holds for every ``metallic``.

    Args:
        roughness: [n, 1].
        wo: towards the viewer, local [n, 3].
        wi: towards the light, local [n, 3].
        eta: refractive index, inside over outside.
        specular_fraction: probability p of the specular lobe, of all lanes or of each [n].
        metallic: 0 is a dielectric, 1 a metal [n, 1]; None where all lanes are dielectrics.
        lambert: part that has Lambert's lobe, of all lanes or of each [n, 1].

    Returns:
        d [n] and s [n] with ``f cos(wi) = albedo d + s``, and the detached pdf [n].
    """
    r = roughness.squeeze(-1)
    part = lambert.squeeze(-1) if isinstance(lambert, Tensor) else lambert
    ggx, ggx_pdf, c = ggx_reflection(wo, wi, alpha_of(r), part)
    zo = wo[:, 2].clamp_min(0.0)
    zi = torch.where(wo[:, 2] > 0, wi[:, 2].clamp_min(0.0), 0.0)
    s = fresnel_dielectric(c, eta) * ggx

    fo, fi = _schlick(zo), _schlick(zi)
    both, cosine = fo * fi, zi * INV_PI
    retro = (2.0 * c * c) * r
    d = cosine * ((1.0 - 0.5 * fo) * (1.0 - 0.5 * fi) + retro * (fo + fi - both + retro * both))
    if isinstance(part, Tensor) or part > 0.0:
        d = d + part * (cosine * (1.0 - coat_albedo(roughness, zo, eta)) - d)
    if metallic is not None:
        m, grazing = metallic.squeeze(-1), _schlick(c)
        d = (1.0 - m) * d + m * (1.0 - grazing) * ggx
        s = (1.0 - m) * s + m * grazing * ggx
    pdf = torch.where(zi > 0, (1.0 - specular_fraction) * cosine + specular_fraction * ggx_pdf, 0.0)
    return d, s, pdf
