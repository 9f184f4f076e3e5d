"""Metalness of triangles, which is decided, not regressed: a surface is a metal or it is none."""

import torch
from torch import Tensor, nn

from neurad.core.records import SurfaceInteraction
from neurad.scene.parts import SurfaceParts

MIN_METAL = 0.5
"""Probability from which on a surface is taken for metal."""


class Metalness(nn.Module):
    """Whether each triangle is of a metal. Emitters are none, as they are known."""

    made: Tensor
    probability: Tensor

    def __init__(self, parts: SurfaceParts, triangles: int) -> None:
        super().__init__()
        self.parts = parts
        self.register_buffer("made", torch.zeros((), dtype=torch.int64))
        self.register_buffer("probability", torch.zeros(triangles))
        self.found = self.done = False
        """Whether some triangle is of a metal, and whether it was decided."""
        self.register_load_state_dict_post_hook(lambda module, _: module._refresh())  # type: ignore[no-untyped-call]

    @torch.no_grad()
    def set(self, probability: Tensor) -> None:
        """It was decided: the probability that each triangle is of a metal [f]."""
        self.probability.copy_(probability)
        self.made.fill_(1)
        self._refresh()

    def _refresh(self) -> None:
        self.done = bool(self.made)
        self.found = bool((self.probability > MIN_METAL).any())

    def forward(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor | None:
        """1 on metals, else 0, at the lanes of ``si`` [n, 1]; None where there is no metal at all."""
        return self.at(si.p, si.prim) if self.found else None

    def at(self, p: Tensor, prim: Tensor | None = None) -> Tensor:
        """1 on metals, else 0, at positions [n, 3] on triangles ``prim`` [n], or on what lies nearest."""
        return (self._probability(p, prim) > MIN_METAL).float()

    def std(self, p: Tensor, prim: Tensor | None = None) -> Tensor:
        """Its standard deviation [n, 1]: by the probability of being a metal or none."""
        probability = self._probability(p, prim)
        return (probability * (1.0 - probability)).sqrt()

    def _probability(self, p: Tensor, prim: Tensor | None) -> Tensor:
        prim = self.parts.geometry.nearest(p) if prim is None else prim.clamp_min(0)
        return self.probability[prim].unsqueeze(-1)
