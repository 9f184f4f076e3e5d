"""Directional albedo of the principled model: what a surface reflects of light that is the same from everywhere.

It is the mean of the weights ``f cos / pdf`` of BSDF samples, so ``weight - directional albedo`` has mean zero: times
any estimate of the incident light it is a control variate, for the value and its derivative by the roughness. A sharp
lobe's derivative is large and of both signs, and cancels almost fully where the surroundings are even; the control
variate takes that part away before it becomes noise.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.bsdf import principled_kernels as kernels
from neurad.bsdf.burley import lobes_pdf
from neurad.core.records import Surface
from neurad.runtime.dispatch import use_kernel

ROUGHNESSES = 32
"""Rows of the table, evenly over roughness 0 to 1."""
COSINES = 32
"""Columns, evenly over the root of the viewer's cosine: close to grazing, reflection changes fast."""
SAMPLES = 2048
"""Quasi-random directions behind every entry."""


@functools.lru_cache(maxsize=16)
@torch.inference_mode(False)
def table(eta: float, device: torch.device, metallic: float = 0.0) -> Tensor:
    """Diffuse and specular part and their derivatives by the roughness [ROUGHNESSES * COSINES, 4]."""
    points = torch.quasirandom.SobolEngine(3, scramble=True, seed=1)  # type: ignore[no-untyped-call]
    u = points.draw(SAMPLES).repeat(COSINES, 1)
    cosine = (torch.arange(COSINES) / (COSINES - 1)).square().clamp_min(1e-3).repeat_interleave(SAMPLES)
    wo = torch.stack(((1.0 - cosine * cosine).sqrt(), torch.zeros_like(cosine), cosine), -1)
    wi, out, half = torch.empty_like(wo), torch.empty(5, len(wo)), np.array([0.5], np.float32)
    rows = []
    for step in range(ROUGHNESSES):
        roughness = torch.full_like(cosine, max(step / (ROUGHNESSES - 1), 1e-3)).unsqueeze(-1)
        kernels.direction(roughness.numpy(), wo.numpy(), u.numpy(), half, wi.numpy())
        if metallic == 0.0:
            kernels.lobes_pdf(roughness.numpy(), wo.numpy(), wi.numpy(), np.float32(eta), half, out.numpy())
        else:
            out = _with_derivatives(roughness, wo, wi, eta, metallic)
        inverse = torch.where(out[2] > 0, 1.0 / out[2], 0.0)
        rows.append((out[[0, 1, 3, 4]] * inverse).view(4, COSINES, SAMPLES).mean(-1).t())
    return torch.cat(rows).to(device)


@torch.enable_grad()
def _with_derivatives(roughness: Tensor, wo: Tensor, wi: Tensor, eta: float, metallic: float) -> Tensor:
    """Rows d, s, pdf and the derivatives of d and s [5, n], which no kernel finds for metals."""
    leaf = roughness.requires_grad_()
    d, s, pdf = lobes_pdf(leaf, wo, wi, eta, 0.5, metallic)
    derivatives = [torch.autograd.grad(x.sum(), leaf, retain_graph=True)[0].squeeze(-1) for x in (d, s)]
    return torch.stack((d.detach(), s.detach(), pdf, *derivatives))


def mean_lobes(
    roughness: Tensor, cosine: Tensor, eta: float, metallic: float = 0.0, use_kernels: bool = True
) -> Tensor:
    """Diffuse and specular part and their derivatives by the roughness [4, n], bilinear in the table, without a graph.

    Args:
        roughness: [n, 1].
        cosine: between viewer and normal [n].
        eta: refractive index of the specular lobe.
        metallic: 0 is a dielectric, 1 a metal.
        use_kernels: use the compiled kernel where it applies (float32 on the CPU).
    """
    entries = table(eta, roughness.device, metallic)
    if use_kernel(use_kernels, roughness, cosine, differentiable=True):
        out = torch.empty(4, len(cosine))
        rough, cos = (x.detach().contiguous().numpy() for x in (roughness, cosine))
        kernels.mean_lobes(rough, cos, entries.numpy(), ROUGHNESSES, COSINES, out.numpy())
        return out
    return _mean_lobes_reference(roughness.detach(), cosine.detach(), entries)


def _mean_lobes_reference(roughness: Tensor, cosine: Tensor, entries: Tensor) -> Tensor:
    """:func:`mean_lobes` in plain torch, on any device."""
    row = roughness.squeeze(-1).clamp(0.0, 1.0) * (ROUGHNESSES - 1)
    column = cosine.clamp(0.0, 1.0).sqrt() * (COSINES - 1)
    low, left = row.floor().clamp_max(ROUGHNESSES - 2), column.floor().clamp_max(COSINES - 2)
    index = (low * COSINES + left).long()
    down, right = (row - low).unsqueeze(-1), (column - left).unsqueeze(-1)
    above = torch.lerp(entries[index], entries[index + 1], right)
    below = torch.lerp(entries[index + COSINES], entries[index + COSINES + 1], right)
    return torch.lerp(above, below, down).t()


class _Lookup(torch.autograd.Function):
    """Bilinear value of the table, its gradient from the tabulated derivatives."""

    @staticmethod
    def forward(ctx: Any, roughness: Tensor, cosine: Tensor, eta: float, metallic: float) -> tuple[Tensor, Tensor]:
        d, s, d_by_roughness, s_by_roughness = mean_lobes(roughness, cosine, eta, metallic).unbind(0)
        ctx.save_for_backward(d_by_roughness, s_by_roughness)
        return d, s

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        d_by_roughness, s_by_roughness = ctx.saved_tensors
        return (grads[0] * d_by_roughness + grads[1] * s_by_roughness).unsqueeze(-1), None, None, None


def directional_albedo(surface: Surface, cosine: Tensor, eta: float, metallic: float = 0.0) -> Tensor:
    """``int f cos(wi) dwi`` towards viewers at ``cosine`` [n] from the normal: [n, 3], differentiable in ``surface``.

    Tabulated; the error is below 1 % of it, except for cosines under 0.01.
    """
    d, s = _Lookup.apply(surface.roughness, cosine, eta, metallic)  # type: ignore[no-untyped-call]
    return torch.addcmul(s.unsqueeze(-1), surface.albedo, d.unsqueeze(-1))
