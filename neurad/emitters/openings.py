"""Where light from far away enters: directions are drawn towards windows, doors and holes instead of walls."""

import torch
from torch import Tensor, nn

from neurad.core.colour import luminance
from neurad.core.frame import dot
from neurad.core.records import Rays

CELLS = 32
"""Cells along each side of a face of the box."""
MIN_FRACTION = 0.1
"""Least part of the density that is uniform over the box: light may enter where no ray of the probe left."""
MAX_ESCAPING = 0.5
"""Part of the rays that leave from which on a scene stands in the open, where directions say more than places."""
MARGIN = 1e-3
"""Distance of the box from the triangles, relative to its size."""


class Openings(nn.Module):
    """Density of directions by the place where they leave the box around a scene, as its portals are in pbrt-4.

    A point of the box is drawn, its six faces cut into cells, with probability in proportion to the flux that enters
    through the cell: rays that were seen to leave by it, each times the radiance it met. From within the box a
    direction leaves it at one point only, so that the density of a direction is that of the point, turned into solid
    angle.

    Args:
        rays: some that leave the scene, from its surfaces and with cosine-distributed directions [n].
        bounds: of the triangles [2, 3].
    """

    box: Tensor
    cell: Tensor
    d: Tensor
    density: Tensor
    end: Tensor

    def __init__(self, rays: Rays, bounds: Tensor) -> None:
        super().__init__()
        margin = MARGIN * float((bounds[1] - bounds[0]).max())
        self._keep("box", torch.stack((bounds[0] - margin, bounds[1] + margin)))
        self._keep("d", rays.d)
        self._keep("cell", self._leaving(rays.o, rays.d)[0])
        self.tabulate(torch.ones(len(rays.o), 3, device=rays.d.device))

    def _keep(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    @torch.no_grad()
    def tabulate(self, radiance: Tensor) -> None:
        """Draw by the radiance [n, 3] that the rays met."""
        count = 6 * CELLS * CELLS
        flux = torch.bincount(self.cell, luminance(radiance.double()), count)
        size = (self.box[1] - self.box[0]).double()
        area = torch.stack((size[1] * size[2], size[2] * size[0], size[0] * size[1])) / CELLS**2
        area = area.repeat(2)[:, None].expand(6, CELLS * CELLS).reshape(-1)
        total = flux.sum()
        chance = MIN_FRACTION * area / area.sum()
        chance = chance + (1.0 - MIN_FRACTION) * (flux / total if total > 0 else area / area.sum())
        chance = chance / chance.sum()
        self._keep("density", (chance / area).float())
        self._keep("end", chance.cumsum(0)[:-1])

    def direction(self, p: Tensor, u: Tensor) -> Tensor:
        """Directions [n, 3] from points ``p`` [n, 3] within the box: the cell by the third of ``u`` [n, 3]."""
        cell = torch.searchsorted(self.end, u[:, 2].double(), right=True)
        face, place = cell // CELLS**2, cell % CELLS**2
        axis, high = face % 3, face // 3
        across = torch.stack((place % CELLS + u[:, 0], place // CELLS + u[:, 1]), -1) / CELLS
        inside = p.new_empty(len(p), 3)
        rows = torch.arange(len(p), device=p.device)
        inside[rows, axis] = high.to(p.dtype)
        inside[rows, (axis + 1) % 3], inside[rows, (axis + 2) % 3] = across.unbind(-1)
        towards: Tensor = torch.lerp(self.box[0], self.box[1], inside) - p
        return towards / dot(towards, towards).sqrt()[:, None]

    def pdf(self, p: Tensor, d: Tensor) -> Tensor:
        """Solid-angle density [n] of unit directions [n, 3] from points [n, 3] within the box."""
        cell, squared, cos = self._leaving(p, d)
        return self.density.index_select(0, cell) * squared / cos

    def _leaving(self, p: Tensor, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where rays leave the box: cell [n], squared distance [n] and cosine [n] to the face's normal."""
        low, high = self.box
        far = torch.where(d > 0, high, low)
        t = torch.where(d == 0, torch.inf, (far - p) / torch.where(d == 0, 1.0, d))
        t, axis = t.clamp_min(0.0).min(-1)
        inside = ((p + t[:, None] * d - low) / (high - low)).clamp(0.0, 1.0)
        along = d.gather(-1, axis[:, None]).squeeze(-1)
        u, v = ((inside.gather(-1, ((axis + k) % 3)[:, None]).squeeze(-1) * CELLS).long() for k in (1, 2))
        place = v.clamp_max(CELLS - 1) * CELLS + u.clamp_max(CELLS - 1)
        return (axis + 3 * (along > 0)) * CELLS**2 + place, t * t, along.abs()
