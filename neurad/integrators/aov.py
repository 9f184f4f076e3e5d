"""Material maps as a camera sees them."""

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.parameters import SurfaceParameter
from neurad.core.protocols import Materials
from neurad.core.records import Rays
from neurad.integrators.world import World


@dataclass(frozen=True)
class MaterialMap:
    """Surface parameters at the first hit, one after the other [n, channels]; zero where nothing is hit."""

    world: World
    materials: Materials
    parameters: tuple[SurfaceParameter, ...]
    """Those of the scene."""

    @torch.no_grad()
    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """Values along camera rays [n, channels]; without noise, so ``seed`` plays no part."""
        si = self.world.intersect(rays)
        return self.materials(si).stacked(self.parameters) * si.valid.unsqueeze(-1)
