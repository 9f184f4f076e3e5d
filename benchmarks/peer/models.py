"""What the peer optimises: values at voxel vertices, held as a pyramid or produced by networks."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from benchmarks.peer.voxels import SurfaceVoxels, coarser
from neurad.core.parameters import ROUGHNESS
from neurad.fields.material import MaterialField
from neurad.optim.sparse_row_adam import SparseRowAdam

COARSEST = 4
"""Cells along the side of the coarsest level, about."""


class Pyramid(nn.Module):
    """A Laplacian pyramid: the sum of grids, each of twice the resolution of the one before, through a sigmoid.

    A gradient on one vertex also moves its whole neighbourhood on the coarse levels, and noise averages out there
    (Weier et al. 2025). Values start at 0.5 like those of the networks.

    Args:
        voxels: the finest level.
        rate: learning rate of albedo.
        roughness_rate: learning rate of roughness.
        betas: of Adam.
    """

    def __init__(
        self, voxels: SurfaceVoxels, rate: float, roughness_rate: float, betas: tuple[float, float] = (0.9, 0.99)
    ) -> None:
        super().__init__()
        vertex, resolution = voxels.vertex, voxels.resolution
        counts, self.steps = [len(vertex)], list[_Upsample]()
        while resolution % 2 == 0 and resolution // 2 >= COARSEST:
            vertex, parents = coarser(vertex, resolution)
            resolution //= 2
            counts.append(len(vertex))
            self.steps.append(_Upsample(torch.from_numpy(parents), len(vertex)))
        # Albedo and roughness have learning rates of their own, so they are parameters of their own.
        self.albedo = nn.ParameterList([nn.Parameter(torch.zeros(n, 3)) for n in counts])
        self.roughness = nn.ParameterList([nn.Parameter(torch.zeros(n, 1)) for n in counts])
        self.optimizers = [_adam(self.albedo, rate, betas), _adam(self.roughness, roughness_rate, betas)]

    def forward(self) -> Tensor:
        """Albedo and roughness at the vertices [n, 4]."""
        levels = [torch.cat((a, r), -1) for a, r in zip(self.albedo, self.roughness, strict=True)]
        value = levels[-1]
        for level, upsample in zip(levels[-2::-1], self.steps[::-1], strict=True):
            value = level + upsample(value)
        unit = torch.sigmoid(value)
        # Roughness has the range of neurad's own field.
        return torch.cat((unit[:, :3], ROUGHNESS.low + (1.0 - ROUGHNESS.low) * unit[:, 3:]), -1)


class Networks(nn.Module):
    """The hash grids and networks of ``neurad fit``, evaluated at all voxel vertices as one tensor.

    Args:
        voxels: where they are evaluated.
        albedo: the field of albedo.
        roughness: the field of roughness, or None for a Lambertian scene.
        rate: learning rate of albedo.
        roughness_rate: learning rate of roughness.
        betas: of Adam.
    """

    def __init__(
        self,
        voxels: SurfaceVoxels,
        albedo: MaterialField,
        roughness: MaterialField | None,
        rate: float,
        roughness_rate: float,
        betas: tuple[float, float] = (0.9, 0.99),
    ) -> None:
        super().__init__()
        self.albedo, self.roughness = albedo, roughness
        self.positions = torch.from_numpy(voxels.positions())
        parts = [(albedo, rate)] if roughness is None else [(albedo, rate), (roughness, roughness_rate)]
        self.optimizers = [_adam(part.parameters(), lr, betas) for part, lr in parts]

    def forward(self) -> Tensor:
        """Albedo and roughness at the vertices [n, 4]."""
        albedo = self.albedo.at(self.positions)
        rough = torch.ones_like(albedo[:, :1]) if self.roughness is None else self.roughness.at(self.positions)
        return torch.cat((albedo, rough), -1)


def _adam(parameters: Iterable[nn.Parameter], rate: float, betas: tuple[float, float]) -> SparseRowAdam:
    """Adam with a group for every parameter; its key ``rate`` is the learning rate at the top of the schedule."""
    return SparseRowAdam([{"params": [p], "rate": rate} for p in parameters], lr=rate, betas=betas)


class _Upsample:
    """Values of a grid from those of the next coarser one: the mean of eight parents each.

    Args:
        parents: places of the parents [n, 8], int64.
        count: number of parents m.
    """

    def __init__(self, parents: Tensor, count: int) -> None:
        self.parents = parents.int()
        # The transpose as a list of children for every parent: sums over lists need no atomic or sorted scatter.
        flat = parents.flatten()
        self.children = (flat.argsort(stable=True) // 8).int()
        occurrences = torch.bincount(flat, minlength=count)
        self.begin = (occurrences.cumsum(0) - occurrences).int()

    def __call__(self, values: Tensor) -> Tensor:
        """Values [n, c] from parents [m, c]."""
        out: Tensor = _Mean.apply(values, self)  # type: ignore[no-untyped-call]
        return out


class _Mean(torch.autograd.Function):
    """The mean of eight parents, with a backward pass that sums over lists of children."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, step: _Upsample) -> Tensor:
        """Values [n, c]."""
        ctx.step = step
        return embedding_bag(step.parents, values, mode="mean")

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        """Gradient of the parents [m, c]."""
        step = ctx.step
        return embedding_bag(step.children, gradients[0] * 0.125, step.begin, mode="sum"), None
