"""A small fully connected network."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from neurad.core.records import FloatArray
from neurad.fields.hash_grid import HashGrid
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import split

CHUNK = 2048
"""Rows that pass through all layers at a time: two layers of width 64 then fit into a processor's own cache. Fixed, so
that results are the same for any number of threads."""


class MLP(nn.Module):
    """Linear layers with ReLU in between, none after the last.

    Args:
        inputs: channels read.
        outputs: channels returned.
        width: neurons of every hidden layer.
        hidden_layers: number of hidden layers; 0 is one linear map.
        use_kernels: use oneDNN's fused layers where they apply (CPU, float32); about twice as fast as plain torch.

    Inside ``products("medium")`` the fast layers, but for the last, take inputs and weights in bfloat16 and add up in
    float32; weights and what the network returns stay float32.
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
        return self._fused(x, None, ()) if self.has_kernel(x) else self.reference(x)

    def of_encoding(self, grid: nn.Module, x: Tensor, others: Sequence[Tensor] = ()) -> Tensor:
        """Values [n, outputs] for what ``grid`` says at positions and further inputs: one operation where both have
        kernels.

        Args:
            grid: encoding of positions.
            x: positions in [0, 1]^3 [n, 3].
            others: inputs beside it [n, ...], without gradient.
        """
        if isinstance(grid, HashGrid) and grid.has_kernel() and self.has_kernel(x):
            return self._fused(x.contiguous(), grid, others)
        features = grid(x)
        y: Tensor = self(torch.cat((features, *others), -1) if others else features)
        return y

    def has_kernel(self, x: Tensor) -> bool:
        """Whether oneDNN's fused layers take inputs like ``x``."""
        return use_kernel(self.use_kernels and len(x) > 0 and _has_onednn(), x, differentiable=True)

    def _fused(self, x: Tensor, grid: HashGrid | None, others: Sequence[Tensor]) -> Tensor:
        modes = _products == "medium", torch.is_grad_enabled()
        table = None if grid is None else grid.table
        out: Tensor = _Layers.apply(x, grid, others, modes, table, *self._in_order())  # type: ignore[no-untyped-call]
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


_products = "highest"


@contextmanager
def products(precision: str) -> Iterator[None]:
    """Let networks multiply inside the block as ``highest``, ``high`` or ``medium`` says.

    On a CPU this is a matter of the networks alone. On a GPU all but ``highest`` allow TF32 to every matrix product of
    the block, so light transport has none.
    """
    global _products
    before = _products, torch.get_float32_matmul_precision()
    _products = precision
    if torch.cuda.is_available():
        torch.set_float32_matmul_precision("highest" if precision == "highest" else "high")
    try:
        yield
    finally:
        _products = before[0]
        torch.set_float32_matmul_precision(before[1])


def _round_up(rows: int) -> int:
    """The next number of rows with four significant binary digits, and a multiple of 32.

    oneDNN compiles code for every new shape, in about a millisecond, and keeps it in memory. Paths end at random, so
    without rounding every bounce would have a new shape.
    """
    step = 1 << max(5, rows.bit_length() - 4)
    return -(-rows // step) * step


def _has_onednn() -> bool:
    """Whether oneDNN's fused layers exist in this torch and autocast does not change their precision."""
    return (
        not (torch.is_autocast_enabled("cpu") and torch.get_autocast_dtype("cpu") != torch.bfloat16)
        and torch.backends.mkldnn.is_available()  # type: ignore[no-untyped-call]
        and hasattr(torch.ops.mkldnn, "_linear_pointwise")
    )


@cache
def _multiplies_bfloat16() -> bool:
    return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def _linear(x: Tensor, weight: Tensor, bias: Tensor | None, after: str) -> Tensor:
    """``after(x weight^T + bias)`` by oneDNN; ``after`` is 'relu' or 'none'.

    oneDNN has no layer in bfloat16 for a processor without AVX-512: there float32 takes the rounded numbers.
    """
    if x.dtype == torch.bfloat16 and not _multiplies_bfloat16():
        return _linear(x.float(), weight.float(), None if bias is None else bias.float(), after).bfloat16()
    out: Tensor = torch.ops.mkldnn._linear_pointwise(x, weight, bias, after, [], "")
    return out


def _forward(x: Tensor, layers: Sequence[Tensor], out: FloatArray) -> list[Tensor]:
    """Input and values after every hidden layer; the last layer fills ``out``, the first [n, outputs] of its rows.

    Args:
        x: inputs [n or more, inputs].
        layers: weight, bias, weight, bias, ...; all but the last may be bfloat16, see :func:`_rounded`.
        out: filled.
    """
    from neurad.fields import mlp_kernels as kernels  # imported at first use: numba is slow to load

    values = [x]
    for i in range(0, len(layers) - 2, 2):
        values.append(_linear(values[-1], layers[i], layers[i + 1], "relu"))
    kernels.last_layer(_exact(values[-1]).numpy(), layers[-2].detach().numpy(), layers[-1].detach().numpy(), out)
    return values


def _rounded(parameters: Sequence[Tensor]) -> Sequence[Tensor]:
    """Weights and biases in bfloat16, but for the last, whose rounding would be seen in what the network returns."""
    return [*(p.bfloat16() for p in parameters[:-2]), *parameters[-2:]]


def _exact(x: Tensor) -> Tensor:
    return x if x.dtype == torch.float32 else x.float()


def _backward(
    g: Tensor, values: list[Tensor], parameters: Sequence[Tensor], columns: int, out: FloatArray
) -> Tensor | None:
    """Gradient by the first ``columns`` inputs [n or more, columns].

    Args:
        g: gradient by what the network returned [n, outputs].
        values: what :func:`_forward` returned.
        parameters: weight, bias, weight, bias, ...
        columns: inputs that have a gradient; 0 for none.
        out: gradients of weight, bias, weight, bias, ... in a row, zero before.
    """
    from neurad.fields import mlp_kernels as kernels

    end = len(out)
    for i in reversed(range(len(values))):
        x, weight, last = values[i], parameters[2 * i], i == len(values) - 1
        middle, begin = end - len(weight), end - len(weight) - weight.numel()
        gradients = out[begin:middle].reshape(weight.shape), out[middle:end]
        end = begin
        if last and i > 0:
            by_x = torch.empty(x.shape)
            kernels.last_gradient(g.numpy(), _exact(x).numpy(), weight.numpy(), by_x.numpy(), *gradients)
            g = by_x.to(x.dtype)
            continue
        if g.dtype == torch.float32:
            kernels.weight_gradient(g.numpy(), _exact(x).numpy(), *gradients)
        else:
            gradients[0][:], gradients[1][:] = (g.t() @ x).float().numpy(), g.sum(0).float().numpy()
        if i > 0:
            g = _linear(g, weight.t() if g.dtype == weight.dtype else weight.t().to(g.dtype), None, "none")
            torch.ops.aten.threshold_backward.grad_input(g, x, 0, grad_input=g)
        elif columns > 0:
            before = weight[:, :columns].t().contiguous()  # oneDNN is slow with a part of a matrix
            return _exact(_linear(g, before.to(g.dtype), None, "none"))
    return None


def _padded(x: Tensor, rows: int) -> Tensor:
    return x if len(x) == rows else torch.nn.functional.pad(x, (0, 0, 0, rows - len(x)))


class _Layers(torch.autograd.Function):
    """All layers, and an encoding before them, as one operation. Threads share its rows, a chunk at a time."""

    @staticmethod
    def forward(
        ctx: Any,
        x: Tensor,
        grid: HashGrid | None,
        others: Sequence[Tensor],
        modes: tuple[bool, bool],
        table: Tensor | None,
        *parameters: Tensor,
    ) -> Tensor:
        """Values of the last layer [n, outputs].

        Args:
            ctx: keeps what the gradient needs.
            x: inputs [n, inputs], or positions [n, 3] where there is an encoding.
            grid: the encoding.
            others: inputs beside it.
            modes: whether products are of bfloat16, and whether there will be a gradient.
            table: of the encoding.
            parameters: weight, bias, weight, bias, ...
        """
        rounded, differentiable = modes
        n = len(x)
        rows = n - n % CHUNK + (_round_up(n % CHUNK) if n % CHUNK else 0)
        if grid is None:
            inputs = _padded(x, rows)
        else:
            inputs, column = torch.empty(rows, parameters[0].shape[1]), grid.channels
            if rows > n:
                inputs[n:] = 0.0
            for part in others:
                inputs[:n, column : column + part.shape[1]] = part
                column += part.shape[1]
        chunks, out = torch.split(inputs, CHUNK), torch.empty(n, len(parameters[-1]))
        values: list[list[Tensor]] = [[] for _ in chunks]
        encode = None if grid is None else grid.encoder(x, inputs)
        layers = _rounded(parameters) if rounded else parameters

        def work(low: int, high: int) -> None:
            with torch.no_grad():  # a thread has its own mode
                for i in range(low, high):
                    begin, end = CHUNK * i, min(CHUNK * (i + 1), n)
                    if encode is not None:
                        encode(begin, end)
                    found = _forward(chunks[i].to(layers[0].dtype), layers, out.numpy()[begin:end])
                    if differentiable:
                        values[i] = found

        split(work, len(chunks), 1)
        ctx.x, ctx.grid, ctx.values = x, grid, values
        ctx.save_for_backward(*parameters)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the input or of the encoding's table, and of every parameter."""
        grid, x, values, parameters = ctx.grid, ctx.x, ctx.values, ctx.saved_tensors
        chunks = torch.split(gradients[0].contiguous(), CHUNK)
        parts: list[Any] = [None] * len(chunks)
        by_parameters = torch.zeros(len(chunks), sum(p.numel() for p in parameters))
        columns = 0
        if grid is not None:
            columns = grid.channels
        elif ctx.needs_input_grad[0]:
            columns = x.shape[1]

        def work(low: int, high: int) -> None:
            with torch.no_grad():
                for i in range(low, high):
                    parts[i] = _backward(chunks[i], values[i], parameters, columns, by_parameters[i].numpy())

        split(work, len(chunks), 1)
        flat = torch.split(by_parameters.sum(0), [p.numel() for p in parameters])
        totals = [total.view(p.shape) for total, p in zip(flat, parameters, strict=True)]
        by_input = None if columns == 0 else torch.cat(parts)
        if grid is None:
            return (None if by_input is None else by_input[: len(x)], None, None, None, None, *totals)
        return (None, None, None, None, grid.table_gradient(x, by_input), *totals)
