"""From positions in a scene to the unit cube that grids span."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.records import FloatArray
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import GRAIN, split

MARGIN = 0.01
"""Free space around the bounds in the unit cube, as a fraction of their longest side."""
SHELL = 0.2
"""Fraction of the unit cube on each side that holds all that lies outside of the bounds, where something does."""


class UnitCube(nn.Module):
    """Maps scene positions into the unit cube, the longest side filling it: grid cells are cubes in the scene.

    Positions outside are clamped, so that they read what lies at the side of the cube, or contracted (Barron et al.
    2022, "Mip-NeRF 360", here along each axis): the cube of the bounds takes the middle, and the infinite rest a shell
    around it, where cells grow with the square of the distance. No two positions then coincide, and near the bounds
    the map is as smooth and as fine as inside.

    The map is part of a checkpoint: a field means nothing without it.

    Args:
        bounds: smallest and largest corner of what is to be resolved [2, 3].
    """

    low: Tensor
    inverse_side: Tensor
    shell: Tensor

    def __init__(self, bounds: Tensor, contracted: bool = False) -> None:
        super().__init__()
        shell = SHELL if contracted else 0.0
        side = float((bounds[1] - bounds[0]).max()) * (1.0 + 2.0 * MARGIN) / (1.0 - 2.0 * shell)
        center = 0.5 * (bounds[0] + bounds[1]).double()
        self.register_buffer("low", (center - 0.5 * side).float())
        self.register_buffer("inverse_side", torch.tensor(1.0 / max(side, 1e-30)))
        self.register_buffer("shell", torch.tensor(shell))

    def forward(self, p: Tensor) -> Tensor:
        """Positions [n, 3] in [0, 1]^3, without gradient."""
        p = p.detach()
        if not use_kernel(True, p, self.low):
            return self.reference(p)
        out = torch.empty_like(p, memory_format=torch.contiguous_format)
        split(self.mapper(p, out.numpy()), len(p), 4 * GRAIN)  # a lane costs little
        return out

    def mapper(self, p: Tensor, out: FloatArray) -> Callable[[int, int], None]:
        """A kernel that puts ``p[low:high]`` [n, 3], mapped, to ``out[low:high]``."""
        from neurad.fields import hash_grid_kernels as kernels  # imported at first use: numba is slow to load

        inverse_side, shell = np.float32(self.inverse_side.item()), np.float32(self.shell.item())
        arrays = p.contiguous().numpy(), self.low.numpy(), inverse_side, shell, out
        return lambda low, high: kernels.unit_cube(*arrays, low, high)

    def reference(self, p: Tensor) -> Tensor:
        """Positions of :meth:`forward` in plain torch, on any device."""
        x = (p - self.low) * self.inverse_side
        square, double = self.shell * self.shell, self.shell + self.shell
        below, above = square / (double - x), 1.0 - square / (double - (1.0 - x))
        return torch.where(x < self.shell, below, torch.where(x > 1.0 - self.shell, above, x))
