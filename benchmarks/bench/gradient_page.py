"""Gradient images and the loss's derivative of all methods on one page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.bench.bias import Gradients, loss_gradient
from neurad.core.records import Camera, FloatArray
from neurad.runtime.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SIGNED = "RdBu"
"""Red is negative, blue is positive, as in the paper."""


def write_page(
    path: Path,
    found: Mapping[tuple[str, int | None], Mapping[float, Gradients]],
    reference: Mapping[float, Gradients],
    targets: Mapping[float, FloatArray],
    middle: float,
    camera: Camera,
    scene: str,
) -> None:
    """Write a PNG: a column a method, the reference last; rows are the derivative of the picture by roughness and by
    albedo at ``middle``, and the derivative of the loss by roughness for every pair of state and target.

    Args:
        path: file to write.
        found: gradients by method and bounces, then by state.
        reference: gradients by state.
        targets: grey pictures by roughness.
        middle: state that the pictures show.
        camera: of the pictures.
        scene: its name.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    columns = {**{_title(key): value for key, value in found.items()}, "reference": reference}
    heats = {name: heat(gradients, targets) for name, gradients in columns.items()}
    rows = ("by roughness", "by albedo")
    limits = {row: _limit(_gradient(reference[middle], row)) for row in rows}
    figure, axes = pyplot.subplots(
        3, len(columns), figsize=(1.5 * len(columns) + 0.8, 5.4), squeeze=False, layout="constrained"
    )
    for column, (name, gradients) in enumerate(columns.items()):
        axes[0][column].set_title(name, fontsize=9)
        for row, label in enumerate(rows):
            image = _gradient(gradients[middle], label).reshape(camera.height, camera.width)
            _show(axes[row][column], image, limits[label], f"picture\n{label}" if column == 0 else "")
        largest = float(np.abs(heats["reference"]).max())
        _show(axes[2][column], heats[name], largest, "loss by roughness\nstate" if column == 0 else "")
        _label(axes[2][column], list(targets), column == 0)
    figure.suptitle(
        f"{scene}, roughness {middle:g}: red negative, blue positive; limits by roughness ±{limits[rows[0]]:.3g}, "
        f"by albedo ±{limits[rows[1]]:.3g}",
        fontsize=10,
    )
    with replacing(path) as part:
        figure.savefig(part, dpi=110, format="png")
    pyplot.close(figure)


def heat(gradients: Mapping[float, Gradients], targets: Mapping[float, FloatArray]) -> FloatArray:
    """Derivative of the loss by roughness [states, targets]; an unbiased one is 0 on the diagonal."""
    rows = [[loss_gradient(g.image, g.roughness, target) for target in targets.values()] for g in gradients.values()]
    return np.array(rows)


def _title(key: tuple[str, int | None]) -> str:
    return key[0] if key[1] is None or key[0] == "direct" else f"{key[0]} {key[1]}"


def _gradient(gradients: Gradients, row: str) -> FloatArray:
    gradient: FloatArray = (gradients.roughness if row == "by roughness" else gradients.albedo).mean(0)
    return gradient


def _limit(values: FloatArray) -> float:
    """A limit that a few noisy pixels do not set."""
    return float(np.quantile(np.abs(values), 0.98)) or 1.0


def _show(axes: Axes, values: FloatArray, limit: float, label: str) -> None:
    axes.imshow(values, cmap=SIGNED, vmin=-limit, vmax=limit, interpolation="nearest")
    axes.set_xticks([])
    axes.set_yticks([])
    if label:
        axes.set_ylabel(label, fontsize=9)


def _label(axes: Axes, states: list[float], first: bool) -> None:
    names: list[Any] = [f"{state:g}" for state in states]
    axes.set_xticks(range(len(states)), names, fontsize=7)
    axes.set_xlabel("target", fontsize=8)
    if first:
        axes.set_yticks(range(len(states)), names, fontsize=7)
