"""A small fully connected network."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn

from neurad.runtime.dispatch import use_kernel
from neurad.runtime.threads import split

CHUNK = 2048
"""Rows evaluated at a time without gradients: two layers of width 64 then fit into a processor's own cache."""


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
        if not use_kernel(self.use_kernels and len(x) > 0 and _has_onednn(), x, differentiable=True):
            return self.reference(x)
        parameters = self._in_order()
        rows = len(x)
        if padding := _round_up(rows) - rows:
            x = torch.nn.functional.pad(x, (0, 0, 0, padding))
        rounded = _products == "medium"
        if torch.is_grad_enabled():
            out: Tensor = _Layers.apply(x, rounded, *parameters)  # type: ignore[no-untyped-call]
        else:
            out = _evaluated(x, parameters, rounded)
        return out[:rows] if padding else out

    def reference(self, x: Tensor) -> Tensor:
        """Outputs of :meth:`forward` in plain torch."""
        parameters = self._in_order()
        for weight, bias in zip(parameters[:-2:2], parameters[1:-2:2], strict=True):
            x = torch.relu(torch.addmm(bias, x, weight.t()))
        return torch.addmm(parameters[-1], x, parameters[-2].t())

    def _in_order(self) -> list[Tensor]:
        """Weight, bias, weight, bias, ...; ``parameters()`` searches all modules, which is slower than a layer."""
        layers: list[Any] = list(self.layers)
        return [p for layer in layers for p in (layer.weight, layer.bias)]


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


def _forward(x: Tensor, parameters: list[Tensor], rounded: bool) -> list[Tensor]:
    """Input and values after every layer; ``parameters`` are weight, bias, weight, bias, ...

    With ``rounded`` all but the last are bfloat16: its rounding would be seen in what the network returns.
    """
    if rounded and len(parameters) > 2:
        x = x.bfloat16()
    values = [x]
    for i in range(0, len(parameters) - 2, 2):
        values.append(_linear(values[-1], parameters[i].to(x.dtype), parameters[i + 1].to(x.dtype), "relu"))
    return [*values, _linear(values[-1].float(), parameters[-2], parameters[-1], "none")]


def _evaluated(x: Tensor, parameters: list[Tensor], rounded: bool) -> Tensor:
    """What the network returns [n, outputs], without a gradient."""
    chunks = torch.split(x, CHUNK)
    parts = list(chunks)

    def work(low: int, high: int) -> None:
        with torch.no_grad():  # a thread has its own mode
            for i in range(low, high):
                parts[i] = _forward(chunks[i], parameters, rounded)[-1]

    split(work, len(chunks), 1)
    return parts[0] if len(parts) == 1 else torch.cat(parts)


class _Layers(torch.autograd.Function):
    """All layers as one operation: fused layers forward, and few small operations backward."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, rounded: bool, *parameters: Tensor) -> Tensor:
        """Values of the last layer [n, outputs]."""
        values = _forward(x, list(parameters), rounded)
        ctx.save_for_backward(*values[:-1], *parameters)
        return values[-1]

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of the input and of every parameter."""
        g = gradients[0]
        layers = len(ctx.saved_tensors) // 3
        inputs, parameters = ctx.saved_tensors[:layers], ctx.saved_tensors[layers:]
        out: list[Tensor | None] = []
        for i in reversed(range(layers)):
            x = inputs[i].to(g.dtype)
            out = [(g.t() @ x).float(), g.sum(0).float(), *out]
            if i > 0:
                g = _linear(g, parameters[2 * i].t().to(g.dtype), None, "none").to(inputs[i].dtype)
                g = torch.ops.aten.threshold_backward(g, inputs[i], 0)
        if not ctx.needs_input_grad[0]:
            return (None, None, *out)
        return (_linear(g, parameters[0].t().to(g.dtype), None, "none").float(), None, *out)
