"""``neurad bench encode``: forward, backward and update of every way to hold a field, against the machine."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from neurad.core.durations import time_option
from neurad.core.ranges import Count, CountOrZero, Positive, option

if TYPE_CHECKING:
    import torch
    from torch import Tensor, nn

    from benchmarks.bench.machine import Row


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--points", type=option(Count), default=1 << 14, help="positions in a batch")
    parser.add_argument("--levels", type=option(Count), default=8, help="levels of the hash grid")
    parser.add_argument("--finest", type=option(Count), default=256, help="cells along a side of its last level")
    parser.add_argument("--log2_size", type=option(Count), default=17, help="logarithm of the entries of a level")
    parser.add_argument("--size", type=option(Count), default=128, help="vertices along a side of the dense grid")
    parser.add_argument("--width", type=option(Count), default=64, help="neurons of a hidden layer")
    parser.add_argument("--hidden_layers", type=option(CountOrZero), default=3, help="hidden layers")
    parser.add_argument("--device", default="auto", help="cpu, cuda or auto")
    parser.add_argument("--seconds", type=time_option(Positive), default=0.5, help="time for each figure")
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Time all encodings and print the table.

    Raises:
        InputError: a size is impossible.
    """
    import torch

    from benchmarks.bench.machine import bandwidth, describe, matrix_rate, pick_device, report
    from neurad.fields.dense_grid import DenseGrid
    from neurad.fields.hash_grid import HashGrid
    from neurad.fields.mlp import MLP
    from neurad.fields.settings import FieldConfig, GridConfig

    device = pick_device(options.device)
    coarsest = min(4, options.finest)
    config = GridConfig(options.levels, coarsest, options.finest, log2_size=options.log2_size)
    field = FieldConfig(config, options.width, options.hidden_layers, size=options.size)
    torch.manual_seed(0)
    x = torch.rand(options.points, 3, device=device)
    x[:, 2] = 0.5 + 0.1 * torch.sin(6.0 * x[:, 0])  # surfaces, not volumes, are looked up
    features = torch.rand(options.points, 2 * config.levels, device=device, requires_grad=True)
    rates = bandwidth(device), matrix_rate(device)
    rows: list[Row] = []
    layers: list[tuple[str, nn.Module, Tensor]] = [
        ("hash grid", HashGrid.from_config(config), x),
        ("dense grid", DenseGrid(field.size, 3), x),
        ("network", MLP(2 * config.levels, 3, field.width, field.hidden_layers), features),
    ]
    for name, layer, points in layers:
        layer.to(device)
        for use_kernels in (True, False):
            layer.use_kernels = use_kernels  # type: ignore[assignment]
            rows += _time(f"{name}, {'kernel' if use_kernels else 'reference'}", layer, points, rates, options.seconds)
    title = (
        f"{options.points} positions on {describe(device)} "
        f"({rates[1] / 1e9:.1f} GFLOP/s, {rates[0] / 1e9:.1f} GB/s)"
    )  # fmt: skip
    report(rows, title, options.out)


def _time(name: str, layer: nn.Module, x: Tensor, rates: tuple[float, float], seconds: float) -> list[Row]:
    """Rows for lookup without gradient, lookup and backward pass, and the optimizer."""
    import torch

    from benchmarks.bench.machine import typical
    from benchmarks.bench.stages import GRIDS
    from neurad.optim.sparse_row_adam import SparseRowAdam

    device, lanes = x.device, len(x)
    tables = [layer.table] if isinstance(layer, GRIDS) else []
    optimizer = SparseRowAdam(layer.parameters(), tables=tables)
    cotangent = torch.rand(lanes, layer(x[:1]).shape[-1], device=device)

    def forward() -> None:
        with torch.no_grad():
            layer(x)

    def both() -> None:
        optimizer.zero_grad()
        layer(x).backward(cotangent)

    def update() -> None:
        optimizer.step()

    both()
    read, floats, operations, updated = _least(layer, x, cotangent)
    slow, use_kernels = rates
    floors = (
        max(read / slow, operations / use_kernels),
        max(
            3 * read / slow, 3 * operations / use_kernels
        ),  # look up, find again and write; products for inputs and weights
        4.0 * 7 * updated / slow,
    )
    limit = "matrix" if operations > 0 else "bandwidth"
    times = typical(forward, device, seconds), typical(both, device, seconds), typical(update, device, seconds)
    rows: list[Row] = []
    for what, time, floor in zip(("forward", "forward and backward", "optimizer"), times, floors, strict=True):
        rows.append(
            {
                "layer": name, "part": what, "ms": 1e3 * time, "mega_per_s": lanes / time / 1e6,
                "floor_ms": 1e3 * floor, "ratio": time / floor,
                "limit": "bandwidth" if what == "optimizer" else limit, "values": floats,
            }
        )  # fmt: skip
    return rows


def _least(layer: nn.Module, x: Tensor, out: Tensor) -> tuple[float, int, float, int]:
    """Bytes of a lookup, parameters, operations of a lookup, and parameters that a step moves."""
    from benchmarks.bench.stages import GRIDS, table_bytes

    parameters = list(layer.parameters())
    gradients: list[torch.Tensor] = [p.grad for p in parameters if p.grad is not None]
    updated = sum(g._values().numel() if g.is_sparse else g.numel() for g in gradients)
    floats = sum(p.numel() for p in parameters)
    read = float(x.nbytes + out.nbytes)
    if isinstance(layer, GRIDS):
        return read + table_bytes(layer, len(x)), floats, 0.0, updated
    return read, floats, 2.0 * len(x) * sum(p.numel() for p in parameters if p.dim() == 2), updated
