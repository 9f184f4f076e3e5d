"""Orthonormal frames around a normal."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.records import Lanes, SurfaceInteraction


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product of vectors [n, 3]: [n]."""
    return (a * b).sum(-1)


def faceforward(si: SurfaceInteraction) -> Tensor:
    """The shading normals on the viewer's side [n, 3]."""
    return torch.where(dot(si.n, si.wo).unsqueeze(-1) < 0, -si.n, si.n)


@dataclass(frozen=True)
class Frame(Lanes):
    """Tangents and normal of a local frame; z is the normal."""

    s: Tensor
    t: Tensor
    n: Tensor

    @classmethod
    def around(cls, n: Tensor) -> Frame:
        """A frame around unit normals [n, 3], without branches (Duff et al. 2017, "Building an Orthonormal Basis")."""
        x, y, z = n.unbind(-1)
        sign = torch.where(z >= 0, 1.0, -1.0)
        a = -1.0 / (sign + z)
        b = x * y * a
        s = torch.stack((1.0 + sign * x * x * a, sign * b, -sign * x), -1)
        t = torch.stack((b, sign + y * y * a, -y), -1)
        return cls(s, t, n)

    def to_local(self, w: Tensor) -> Tensor:
        """World vectors [n, 3] in this frame."""
        return torch.stack((dot(w, self.s), dot(w, self.t), dot(w, self.n)), -1)

    def to_world(self, w: Tensor) -> Tensor:
        """Local vectors [n, 3] in the world."""
        return w[..., :1] * self.s + w[..., 1:2] * self.t + w[..., 2:] * self.n
