"""Directional albedo of the principled model: what a surface reflects of light that is the same from everywhere.

It is the mean of the weights ``f cos / pdf`` of BSDF samples, so ``weight - directional albedo`` has mean zero: times
any estimate of the incident light it is a control variate, for the value and its derivative by the roughness. A sharp
lobe's derivative is large and of both signs, and cancels almost fully where the surroundings are even; the control
variate takes that part away before it becomes noise.
"""

import functools
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from neurad.bsdf import principled_kernels as kernels
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
def table(eta: float, device: torch.device, metal: bool = False, lambert: bool = False) -> Tensor:
    """Diffuse and specular part and their derivatives by the roughness, with Burley's or Lambert's lobe; with ``metal``
    also those of the two parts by the metalness, and what these are by the roughness: [ROUGHNESSES * COSINES, 4 or 8].
    """
    points = torch.quasirandom.SobolEngine(3, scramble=True, seed=1)  # type: ignore[no-untyped-call]
    u = points.draw(SAMPLES).repeat(COSINES, 1)
    cosine = (torch.arange(COSINES) / (COSINES - 1)).square().clamp_min(1e-3).repeat_interleave(SAMPLES)
    wo = torch.stack(((1.0 - cosine * cosine).sqrt(), torch.zeros_like(cosine), cosine), -1)
    wi, out, half = torch.empty_like(wo), torch.empty(7, len(wo)), np.array([0.5], np.float32)
    view, towards = wo.numpy(), wi.numpy()
    all_of_it, none, by_part = np.float32(lambert), np.zeros((4, 4), np.float32), np.empty((2, 0), np.float32)
    rows = []
    for step in range(ROUGHNESSES):
        rough = torch.full_like(cosine, max(step / (ROUGHNESSES - 1), 1e-3)).unsqueeze(-1).numpy()
        kernels.direction(rough, view, u.numpy(), half, towards)
        kernels.lobes_pdf(rough, view, towards, np.float32(eta), half, out[:5].numpy())
        if lambert:
            kernels.blend_lambert(rough, view, towards, all_of_it, none, 2, 2, out.numpy(), by_part)
        values = out[[0, 1, 3, 4]]
        if metal:  # d + m dd/dm for every metalness m, so the derivatives at 0 and 1 tell all
            ones = np.ones_like(rough)
            kernels.add_metal(rough, ones, view, towards, all_of_it, out.numpy(), by_part, out[5:].numpy())
            values = torch.cat((values, out[5:], out[3:5] - values[2:]))
        inverse = torch.where(out[2] > 0, 1.0 / out[2], 0.0)
        means = (values * inverse).view(len(values), COSINES, SAMPLES).mean(-1)
        if lambert:  # it sends back all that the coat does not
            exact = torch.stack((1.0 - means[1], -means[3]))
            if metal:
                means[[4, 6]] += means[[0, 2]] - exact
            means[[0, 2]] = exact
        rows.append(means.t())
    return torch.cat(rows).contiguous().to(device)


def mean_lobes(surface: Surface, cosine: Tensor, eta: float, lambert: float = 0.0, use_kernels: bool = True) -> Tensor:
    """Diffuse and specular part and their derivatives by the scalars of ``surface``, the roughness first: [4, 6 or 8,
    n], bilinear in the table, without a graph.

    Args:
        surface: its roughness [n, 1], and part of Lambert's lobe and metalness [n, 1] if it has them.
        cosine: between viewer and normal [n].
        lambert: part that has Lambert's lobe, of a surface that has none of its own.
    """
    metal = None if surface.metallic is None else surface.metallic.detach().squeeze(-1)
    searched = None if surface.lambert is None else surface.lambert.detach().squeeze(-1)

    def read(of_lambert: bool) -> Tensor:
        """[4, n], of a metal too [8, n]."""
        entries = table(eta, cosine.device, metal is not None, of_lambert)
        return _read(entries, surface.roughness.detach(), cosine, use_kernels)

    def with_metal(values: Tensor) -> Tensor:
        """[4, n]."""
        return values if metal is None else values[:4] + metal * values[4:]

    out, by_scalars = read(lambert == 1.0 and searched is None), []
    if searched is not None or 0.0 < lambert < 1.0:
        change = read(True) - out
        out = out + (lambert if searched is None else searched) * change
        if searched is not None:
            by_scalars += list(with_metal(change)[:2])
    if metal is not None:
        by_scalars += list(out[4:6])
    values = with_metal(out)
    return torch.cat((values, torch.stack(by_scalars))) if by_scalars else values


def _read(entries: Tensor, roughness: Tensor, cosine: Tensor, use_kernels: bool) -> Tensor:
    """Bilinear values [k, n] of a table."""
    if not use_kernel(use_kernels, roughness, cosine, differentiable=True):
        return _mean_lobes_reference(roughness, cosine.detach(), entries)
    out = torch.empty(entries.shape[1], len(cosine))
    rough, cos = (x.detach().contiguous().numpy() for x in (roughness, cosine))
    kernels.mean_lobes(rough, cos, entries.numpy(), ROUGHNESSES, COSINES, out.numpy())
    return out


def coat_albedo(roughness: Tensor, cosine: Tensor, eta: float) -> Tensor:
    """What the coat over Lambert's lobe sends back [n] towards viewers at ``cosine`` [n], by tables of its value and
    its derivative by the roughness [n, 1], in which it is differentiable once.
    """
    entries = table(eta, roughness.device, lambert=True)[:, [1, 3]].to(roughness.dtype)
    value, slope = _mean_lobes_reference(roughness.detach(), cosine, entries)
    r = roughness.squeeze(-1)
    albedo: Tensor = value + slope * (r - r.detach())
    return albedo


def _mean_lobes_reference(roughness: Tensor, cosine: Tensor, entries: Tensor) -> Tensor:
    """Bilinear values of the table in plain torch, on any device."""
    row = roughness.squeeze(-1).clamp(0.0, 1.0) * (ROUGHNESSES - 1)
    column = cosine.clamp(0.0, 1.0).sqrt() * (COSINES - 1)
    low, left = row.floor().clamp_max(ROUGHNESSES - 2), column.floor().clamp_max(COSINES - 2)
    index = (low * COSINES + left).long()
    down, right = (row - low).unsqueeze(-1), (column - left).unsqueeze(-1)
    above = torch.lerp(entries[index], entries[index + 1], right)
    below = torch.lerp(entries[index + COSINES], entries[index + COSINES + 1], right)
    return torch.lerp(above, below, down).t()


class _ByScalars(torch.autograd.Function):
    """Lobes [2, n] whose derivatives [2 * scalars, n] are known; of the scalars only the graph is read."""

    @staticmethod
    def forward(ctx: Any, lobes: Tensor, derivatives: Tensor, *scalars: Tensor) -> tuple[Tensor, ...]:
        ctx.save_for_backward(derivatives)
        return lobes.unbind()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (by,) = ctx.saved_tensors
        return (None, None, *((grads[0] * d + grads[1] * s).unsqueeze(-1) for d, s in by.unflatten(0, (-1, 2))))


def by_scalars(lobes: Tensor, derivatives: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    """Lobes d and s [2, n] with a graph to the scalars x of a surface, differentiable once, by the rows dd/dx and ds/dx
    of each in turn [2 * scalars, n].
    """
    d, s = _ByScalars.apply(lobes, derivatives, *surface.scalars)  # type: ignore[no-untyped-call]
    return d, s


def directional_albedo(surface: Surface, cosine: Tensor, eta: float, lambert: float = 0.0) -> Tensor:
    """``int f cos(wi) dwi`` towards viewers at ``cosine`` [n] from the normal: [n, 3], differentiable in ``surface``.

    Tabulated; the error is below 1 % of it, except for cosines under 0.01.
    """
    rows = mean_lobes(surface, cosine, eta, lambert)
    d, s = by_scalars(rows[:2], rows[2:], surface)
    return torch.addcmul(s.unsqueeze(-1), surface.albedo, d.unsqueeze(-1))
