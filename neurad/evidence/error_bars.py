"""Error bars of recovered albedo and roughness at any surface point, from the photographs alone.

Those of roughness are the posterior's of :mod:`neurad.fields.hierarchy`. For those of albedo a pass over some training
pixels at the final parameters collects at the nodes of a grid what :mod:`neurad.evidence.pixel_derivatives` finds in
them; nothing is kept while a fit runs. With sums over the pixels near a point, ``w`` = 1 / squared brightness, and
scaled from the pixels of the pass to all pixels:

    1 / variance = 1 / sqrt(V N) + 1 / spread^2
    N = (misfit^2 / D^2) / (pixels that see one pixel's patch of surface) + (X / A)^2 roughness variance

N is the variance that a noisy photograph leaves in what a pixel covers, the unknown roughness included (X / A is by how
much albedo makes up for roughness); V is the variance that the recovered albedo has within a pixel, the detail that
no pixel can tell. Both measure how much of the pattern at the size of a pixel is not known, each with errors of its own
that are factors, so the mean of their logarithms is taken. At a point the root of V is that of its cell, times how much
more the albedo varies around the point than in the cell (texture, edges).

A surface is called determined where its error bar is less than half of the spread, which is what the bar would be
without photographs: then they have said three quarters of what there was to say.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol, Self

import numpy as np
import torch
from torch import Tensor

from neurad.core.grid import trilinear
from neurad.core.parameters import ALBEDO, RECOVERED, ROUGHNESS
from neurad.core.records import Float64Array, FloatArray, IntArray
from neurad.evidence.pixel_derivatives import DARK, LIMIT, PixelDerivatives
from neurad.metrics.unseen import percent

CELLS = 64
"""Cells of the grid along the longest side of what the pixels see: some 10 cm of a room share their information."""
FLAT = 5e-3
"""Standard deviation that materials have around any point: what looks flat need not be."""

DETERMINED = 0.5
"""Error bar over spread below which a surface is determined."""
MAX_PLACES = 1 << 14
"""Pixels whose surfaces are asked whether they are."""

_COLUMNS = {
    "count": 1, "area": 1, "square": 3, "misfit": 3, "detail": 3, "texture": 3, "cross": 3, "weight": 3,
}  # fmt: skip
"""Sums at the nodes: of pixels, their area, D^2, squared misfit, V, :func:`texture` at a point of each, D R w and
D^2 w."""

COLUMNS = sum(_COLUMNS.values())


@dataclass(frozen=True)
class Nodes:
    """Sums at the nodes of a grid in the unit cube: scattered and read trilinearly, kept where there are any."""

    side: int
    """Cells along an edge of the unit cube; one node more."""
    index: IntArray
    """Indices of the occupied nodes, ascending [k], int64."""
    values: Float64Array
    """Sums there [k, c]."""

    @classmethod
    def scattered(cls, x: Float64Array, values: Float64Array, side: int) -> Self:
        """Spread ``values`` [n, c] at positions ``x`` [n, 3] in [0, 1] over the eight nodes around each."""
        node, weight = (found.numpy() for found in trilinear(torch.from_numpy(x), side))
        index, place = np.unique(node, return_inverse=True)
        place = place.reshape(node.shape)
        sums = np.zeros((len(index), values.shape[1]))
        for channel in range(values.shape[1]):
            spread = weight * values[:, channel, None]
            sums[:, channel] = np.bincount(place.ravel(), spread.ravel(), len(index))
        return cls(side, index, sums)

    def read(self, x: Float64Array) -> Float64Array:
        """Trilinear means [n, c] at positions ``x`` [n, 3] in [0, 1]; nodes without anything count as 0."""
        result = np.zeros((len(x), self.values.shape[1]))
        if len(self.index) == 0:
            return result
        node, weight = (found.numpy() for found in trilinear(torch.from_numpy(x), self.side))
        place = np.searchsorted(self.index, node).clip(0, len(self.index) - 1)
        weight = np.where(self.index[place] == node, weight, 0.0)
        for corner in range(8):
            result += weight[:, corner, None] * self.values[place[:, corner]]
        return result


class BarFields(Protocol):
    """What bars read of recovered materials, at positions [n, 3] in the scene on triangles [n] or on the nearest."""

    def to_unit_cube(self, p: Tensor) -> Tensor:
        """Positions on any device in the unit cube of the fields [n, 3]."""

    def albedo_at(self, p: Tensor, prim: Tensor | None = None) -> Tensor:
        """Recovered albedo [n, 3]."""

    def std(self, p: Tensor, prim: Tensor | None = None, known: bool = True) -> dict[str, Tensor]:
        """Standard deviations [n, channels] where fields know them; the prior's if photographs are not ``known``."""

    def std_by_albedo(self, p: Tensor, std: Tensor, prim: Tensor | None = None) -> dict[str, Tensor]:
        """What standard deviations [n, 3] of the albedo add to those of parameters that are read off from it."""


@dataclass(frozen=True)
class ErrorBars:
    """Standard deviations of recovered materials.

    Attributes:
        nodes: sums at the nodes of a grid in the unit cube, columns as in _COLUMNS.
        cell: side of a cell of that grid in scene units.
        spread: standard deviation of the recovered albedo over the photographs [3].
        iteration: of the fit when they were measured.
        spreads: standard deviations before photographs were looked at, by parameter; those of a colour as one.
        determined: fractions of the surface that photographs show where these have determined it, by parameter.
    """

    nodes: Nodes
    cell: float
    spread: Float64Array
    iteration: int
    spreads: Mapping[str, float] = field(default_factory=dict)
    determined: Mapping[str, float] = field(default_factory=dict)

    @property
    def sentence(self) -> str:
        """On how much of the surface photographs determine what it is; empty where that was not measured."""
        shares = [(name, self.determined[name]) for name in reversed(RECOVERED) if name in self.determined]
        if not shares:
            return ""
        (first, share), *rest = shares
        others = "".join(f", {name} on {percent(other)}" for name, other in rest)
        text = f"{first.capitalize()} is determined on {percent(share)} of the surface that photographs show{others}: "
        text += "there its error bar is less than half of what it would be without them"
        return f"{text}." if first == ALBEDO.name else f"{text}. Elsewhere {first} is its group's mean."

    def shares(self, stds: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Standard deviations [..., channels] over the spreads [..., 1]: 0 of what is sure, 1 of what is unknown."""
        return {
            name: np.sqrt(np.square(std).mean(-1, keepdims=True)) / np.float32(max(self.spreads[name], 1e-6))
            for name, std in stds.items()
        }

    def at(self, materials: BarFields, p: Tensor, prim: Tensor | None = None) -> dict[str, FloatArray]:
        """Standard deviations of ``albedo`` [n, 3] and, where its field knows it, ``roughness`` [n, 1] at positions in
        the scene [n, 3] on triangles [n], or on the nearest.
        """
        found = {name: std.cpu().numpy() for name, std in materials.std(p, prim).items()}
        p = p.cpu()
        read = self.nodes.read(_in_cube(materials, p.numpy()))
        sums = dict(zip(_COLUMNS, np.split(read, np.cumsum([*_COLUMNS.values()])[:-1], 1), strict=True))
        count = sums["count"]
        pixels = np.maximum(count, 1e-9)
        overlap = np.maximum(count * sums["area"] / pixels / self.cell**2, 1.0)  # pixels that see one pixel's patch
        side = np.sqrt(sums["area"] / pixels)[:, 0]
        noise = sums["misfit"] / np.maximum(sums["square"], 1e-30) / overlap
        if ROUGHNESS.name in found:
            trade = sums["cross"] / np.maximum(sums["weight"], 1e-30)
            noise = noise + np.minimum(np.square(trade), 1.0) * np.square(found[ROUGHNESS.name])
        deviation = np.sqrt(noise * sums["detail"] / pixels)
        # The mean of this factor over the pixels of a cell is 1.
        varies = texture(partial(materials.albedo_at, prim=prim), p, side)
        deviation *= varies / np.maximum(sums["texture"] / pixels, 1e-30)
        known = count / (count + 1.0) / np.maximum(deviation, 1e-12)
        albedo = np.sqrt(1.0 / (known + 1.0 / np.maximum(np.square(self.spread), 1e-12)))
        albedo = albedo.astype(np.float32)
        for name, more in materials.std_by_albedo(p, torch.from_numpy(albedo), prim).items():
            found[name] = np.hypot(found[name], more.cpu().numpy())
        return {ALBEDO.name: albedo, **found}


def measure(pixels: PixelDerivatives, materials: BarFields, total: int, iteration: int) -> ErrorBars:
    """Error bars from a sample of the ``total`` training pixels that the fit has seen."""
    x = _in_cube(materials, pixels.p)
    # What the pixels see may fill a part of the unit cube; a few are far away.
    low, high = np.quantile(x, (0.01, 0.99), axis=0)
    side = round(min(CELLS / max(float((high - low).max()), 1e-3), 4.0 * CELLS))
    # Stage 1: all in units of the brightness of each pixel, w = 1 / brightness^2.
    mean_square = float(np.square(pixels.predicted + pixels.misfit, dtype=np.float64).mean())
    brightness = np.sqrt(np.square(pixels.predicted, dtype=np.float64) + DARK * mean_square + 1e-30)  # [n, 3]
    by_albedo = pixels.by[ALBEDO.name] / brightness
    by_roughness = (pixels.by[ROUGHNESS.name] / brightness).clip(-2.0 * LIMIT, 2.0 * LIMIT)
    misfit = np.square((pixels.misfit / brightness).clip(-LIMIT, LIMIT) * brightness)
    times = max(total / len(pixels), 1.0)
    # Stage 2: sums at the nodes.
    d = pixels.by[ALBEDO.name][0] * pixels.by[ALBEDO.name][1]
    weighted = by_albedo[0] * by_albedo[1]
    cross = 0.5 * (by_albedo[0] * by_roughness[1] + by_albedo[1] * by_roughness[0])
    ones = np.ones((len(pixels), 1))
    cell = _cell(materials, pixels.p, float(np.sqrt(pixels.area.max())), side)
    prim = torch.from_numpy(pixels.prims[:, 0])
    varies = texture(partial(materials.albedo_at, prim=prim), torch.from_numpy(pixels.p), np.sqrt(pixels.area))
    columns = (
        times * ones, times * pixels.area[:, None], times * d, times * misfit, times * pixels.detail, times * varies,
        times * cross, times * weighted,
    )  # fmt: skip
    nodes = Nodes.scattered(x, np.concatenate(columns, 1), side)
    spread = pixels.albedo.std(0).astype(np.float64)
    some = slice(None, None, -(-len(pixels) // MAX_PLACES))
    places, prim = torch.from_numpy(pixels.p[some]), prim[some]
    prior = {name: std.cpu().numpy() for name, std in materials.std(places, prim, known=False).items()}
    spreads = {name: float(np.sqrt(np.square(std).mean())) for name, std in {ALBEDO.name: spread, **prior}.items()}
    bars = ErrorBars(nodes, cell, spread, iteration, spreads)
    # Each part of a surface counts once, in however many pixels it is.
    weight = 1.0 / nodes.read(_in_cube(materials, places.numpy()))[:, 0].clip(1e-9)
    shares = bars.shares(bars.at(materials, places, prim)).items()
    found = {name: float(np.average(share[:, 0] < DETERMINED, weights=weight)) for name, share in shares}
    return replace(bars, determined=found)


def _in_cube(materials: BarFields, p: FloatArray) -> Float64Array:
    """Positions [n, 3] in the unit cube."""
    found = materials.to_unit_cube(torch.from_numpy(np.ascontiguousarray(p, np.float32)))
    return found.cpu().numpy().astype(np.float64)


def texture(read: Callable[[Tensor], Tensor], p: Tensor, side: Float64Array | FloatArray) -> Float64Array:
    """How recovered materials, which ``read`` gives [n, c] at positions in the scene [n, 3], vary around positions on
    the CPU: their standard deviation [n, c] between the corners of a tetrahedron half as large as a pixel there, of
    which ``side`` is that in scene units [n].
    """
    corners = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=torch.float32)
    away = 0.25 * torch.from_numpy(np.asarray(side, np.float32)).unsqueeze(-1)
    with torch.no_grad():
        values = torch.stack([read(p + away * corner).cpu().double() for corner in corners])  # [4, n, c]
    return (values.var(0) + FLAT**2).sqrt().numpy()


def _cell(materials: BarFields, p: FloatArray, pixel: float, side: int) -> float:
    """Side of a cell of the grid in scene units, in the middle of what the cameras see, of pixels as large as this."""
    middle = np.median(p, 0).astype(np.float32)
    size = max(float(np.ptp(p, 0).max()), pixel)  # a pass of a tiny fit may have one pixel
    ends = middle + np.array([[0.0] * 3, [1e-2 * size, 0.0, 0.0]], np.float32)
    a, b = _in_cube(materials, ends)
    return float(np.linalg.norm(ends[1] - ends[0]) / max(float(np.linalg.norm(b - a)), 1e-20) / side)
