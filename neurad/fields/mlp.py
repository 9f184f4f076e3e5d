"""A small fully connected network."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from neurad.core.records import FloatArray, IntArray
from neurad.fields.hash_grid import HashGrid
from neurad.fields.outputs import Output
from neurad.fields.unit_cube import UnitCube
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import split

CHUNK = 2048
"""Rows whose gradients are added up together. Fixed, so that results are the same for any number of threads."""


class MLP(nn.Module):
    """Linear layers with ReLU in between, none after the last.

    Args:
        hidden_layers: number of hidden layers; 0 is one linear map.
        use_kernels: use the compiled kernels where they apply (CPU, float32).
    """

    def __init__(self, inputs: int, outputs: int, width: int, hidden_layers: int, use_kernels: bool = True) -> None:
        super().__init__()
        sizes = [inputs, *[width] * hidden_layers, outputs]
        layers = [nn.Linear(a, b) for a, b in pairwise(sizes)]
        for i, layer in enumerate(layers):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu" if i < hidden_layers else "linear")
            nn.init.zeros_(layer.bias)
        self.layers = nn.ModuleList(layers)
        self.use_kernels = use_kernels

    def forward(self, x: Tensor) -> Tensor:
        """Values [n, outputs] for inputs [n, inputs]."""
        return self._fused(x, None) if self.has_kernel(x) else self.reference(x)

    def of_position(
        self,
        cube: UnitCube,
        grid: HashGrid,
        p: Tensor,
        output: Output,
        others: Sequence[Tensor] = (),
        key: Tensor | None = None,
    ) -> Tensor:
        """What ``output`` makes [n, outputs] of what this says of an encoding and further inputs, as one operation;
        both must have kernels.

        Args:
            p: positions in the scene [n, 3], without gradient.
            others: inputs beside the encoding [n, ...], without gradient.
            key: of the surfaces that the positions lie on [n], int32; None for 0.
        """
        return self._fused(p, _Reading(cube, grid, output, others, key))

    def has_kernel(self, x: Tensor) -> bool:
        """Whether compiled kernels take inputs like ``x``."""
        return use_kernel(self.use_kernels and len(x) > 0, x, differentiable=True)

    def _fused(self, x: Tensor, reading: _Reading | None) -> Tensor:
        table, keep = None if reading is None else reading.grid.table, torch.is_grad_enabled()
        out: Tensor = _Layers.apply(x, reading, keep, table, *self._in_order())  # type: ignore[no-untyped-call]
        return out

    def reference(self, x: Tensor) -> Tensor:
        """Outputs of :meth:`forward` in plain torch."""
        parameters = self._in_order()
        for weight, bias in zip(parameters[:-2:2], parameters[1:-2:2], strict=True):
            x = torch.relu(torch.addmm(bias, x, weight.t()))
        return torch.addmm(parameters[-1], x, parameters[-2].t())

    def _in_order(self) -> list[Tensor]:
        """Weight, bias, weight, bias, ...; ``parameters()`` searches all modules, which is slower than a layer."""
        return [p for layer in self.layers for p in layer._parameters.values()]  # type: ignore[misc]


@contextmanager
def products(precision: str) -> Iterator[None]:
    """Let networks on a GPU multiply inside the block as ``highest`` or ``high`` says; a CPU computes in float32.
    ``high`` allows TF32 to every matrix product of the block, so light transport has none.
    """
    before = torch.get_float32_matmul_precision()
    if torch.cuda.is_available():
        torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _room(flat: FloatArray, sizes: IntArray) -> FloatArray:
    """Memory for the kernels to work in, at an address that torch aligns to the processor's cache lines."""
    from neurad.fields.mlp_kernels import BLOCK

    room: FloatArray = torch.empty(len(flat) + 2 * BLOCK * int(sizes[1:].max())).numpy()
    return room


@dataclass(frozen=True)
class _Reading:
    """What stands before and behind the layers of a field, see :meth:`MLP.of_position`."""

    cube: UnitCube
    grid: HashGrid
    output: Output
    others: Sequence[Tensor]
    key: Tensor | None


class _Layers(torch.autograd.Function):
    """All layers, and what stands around them, as one operation. Threads share its rows, a chunk at a time."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        reading: _Reading | None,
        keep: bool,
        table: Tensor | None,
        *parameters: Tensor,
    ) -> Tensor:
        """Values [n, outputs].

        Args:
            x: inputs [n, inputs], or positions [n, 3] where there is an encoding.
            reading: the encoding, and what else there is.
        """
        from neurad.fields import mlp_kernels as kernels  # imported at first use: numba is slow to load

        n = len(x)
        sizes = np.array([parameters[0].shape[1], *map(len, parameters[1::2])])
        rows = kernels.rows(n)
        fill: list[Callable[[int, int], None]] = []
        if reading is not None:
            # Arrays that kernels alone read: a tensor, and the array of it, take two microseconds more.
            inputs, at = np.empty((rows, sizes[0]), np.float32), np.empty((n, 3), np.float32)
            column = reading.grid.channels
            for part in reading.others:
                inputs[:n, column : column + part.shape[1]] = part.detach().numpy()
                column += part.shape[1]
            fill = [reading.cube.mapper(x, at), reading.grid.encoder(at, reading.key, inputs)]
        else:
            at = inputs = torch.nn.functional.pad(x, (0, 0, 0, rows - n)).contiguous().numpy()
        flat, out = torch.cat([p.reshape(-1) for p in parameters]), torch.empty(n, int(sizes[-1]))
        hidden = np.empty(rows * int(sizes[1:-1].sum()) if keep else 0, np.float32)
        arrays = inputs, flat.numpy(), sizes, keep, hidden, out.numpy()

        def work(low: int, high: int) -> None:
            begin, end = CHUNK * low, min(CHUNK * high, n)
            for step in fill:
                step(begin, end)
            kernels.forward(*arrays, _room(arrays[1], sizes), begin, end)

        split(work, -(-n // CHUNK), 1)
        ctx.at, ctx.reading, ctx.shapes, ctx.kept, ctx.y = at, reading, [p.shape for p in parameters], arrays, out
        return out if reading is None else reading.output(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the input or of the encoding's table, and of every parameter."""
        from neurad.fields import mlp_kernels as kernels

        n, reading = len(ctx.y), ctx.reading
        inputs, flat, sizes, _, hidden, _ = ctx.kept
        columns = int(sizes[0]) if ctx.needs_input_grad[0] else 0
        if reading is not None:
            columns, gradient = reading.grid.channels, reading.output.vjp(ctx.y, gradient)
        by_x = np.empty((len(inputs), columns), np.float32)
        by_flat = np.zeros((-(-n // CHUNK), len(flat)), np.float32)
        arrays = gradient.contiguous().numpy(), inputs, hidden, flat, sizes, columns, by_x

        def work(low: int, high: int) -> None:
            room = _room(flat, sizes)
            for i in range(low, high):
                kernels.backward(*arrays, room, by_flat[i], CHUNK * i, min(CHUNK * (i + 1), n))

        split(work, len(by_flat), 1)
        parts = torch.split(torch.from_numpy(by_flat).sum(0), [shape.numel() for shape in ctx.shapes])
        totals = [part.view(shape) for part, shape in zip(parts, ctx.shapes, strict=True)]
        if reading is not None:
            return (None, None, None, reading.grid.table_gradient(ctx.at, reading.key, by_x), *totals)
        return (torch.from_numpy(by_x)[:n] if columns > 0 else None, None, None, None, *totals)
