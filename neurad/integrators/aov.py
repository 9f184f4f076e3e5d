"""Material maps as a camera sees them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.protocols import Materials
from neurad.core.records import Rays
from neurad.integrators.world import World


@dataclass(frozen=True)
class MaterialMap:
    """Albedo (three channels) and roughness (one) at the first hit, zero where nothing is hit: [n, 4]."""

    world: World
    materials: Materials

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Values along camera rays [n, 4]; without noise, so ``seed`` plays no part."""
        si = self.world.intersect(rays)
        surface = self.materials(si)
        return torch.cat((surface.albedo, surface.roughness), -1) * si.valid.unsqueeze(-1)
