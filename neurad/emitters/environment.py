"""Light from infinitely far away."""

import math

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.colour import luminance
from neurad.core.errors import InputError
from neurad.core.frame import Frame, dot
from neurad.core.records import EmitterSample, Float64Array, SurfaceInteraction
from neurad.core.sampling import uniform_cone
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.openings import Openings

FLOOR = 1e-3
"""Smallest density of a direction, relative to the mean over the map, so that every direction can be sampled."""
BY_OPENINGS = 0.5
"""Part of the samples that are drawn towards openings: the others find the sun of a map."""


class FittedSun(nn.Module):
    """The sun: a direction, a radius, and a radiance that is trained; there is none before :meth:`rise`.

    It is what a map that is kept soft cannot hold: the edges of its light would go into the materials.
    """

    towards: Tensor
    one_minus_cos: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.values = nn.Parameter(torch.zeros(1, 3))
        """Logarithms of its radiance [1, 3]."""
        self.register_buffer("towards", torch.tensor([0.0, 1.0, 0.0]))
        self.register_buffer("one_minus_cos", torch.zeros(()))

    def rise(self, towards: Float64Array, radius: float, irradiance: Float64Array) -> None:
        """Shine from now on.

        Args:
            towards: direction [3], of length 1.
            radius: angular radius in radians.
            irradiance: to begin with, on a surface that faces it [3].
        """
        self.towards.copy_(torch.from_numpy(towards))
        self.one_minus_cos.fill_(2.0 * math.sin(0.5 * radius) ** 2)
        least = max(1e-3 * float(irradiance.max()), 1e-30)
        with torch.no_grad():
            self.values.copy_(torch.from_numpy(irradiance.clip(least) / self.solid_angle).log())

    @property
    def shines(self) -> bool:
        """Whether there is one."""
        return float(self.one_minus_cos) > 0.0

    @property
    def solid_angle(self) -> float:
        """Solid angle of the disk, in sr."""
        return 2.0 * math.pi * float(self.one_minus_cos)

    def radiance(self, d: Tensor) -> Tensor:
        """What it adds to the radiance [n, 3] from unit world directions [n, 3], with the gradient of ``values``."""
        return torch.where(self.shows(d)[:, None], self.values.exp(), 0.0)

    def direction(self, p: Tensor, u: Tensor) -> Tensor:
        """Directions [n, 3] uniform within its disk, by the first two of ``u`` [n, 3]."""
        local = uniform_cone(u[:, :2], self.one_minus_cos)
        return Frame.around(self.towards[None].expand(len(p), 3)).to_world(local)

    def pdf(self, p: Tensor, d: Tensor) -> Tensor:
        """Solid-angle density [n] of unit directions [n, 3]."""
        return torch.where(self.shows(d), 1.0 / self.solid_angle, 0.0)

    def shows(self, d: Tensor) -> Tensor:
        """Directions of the disk [n], bool; by the chord, since 1 - cos has no digits left in a dot product."""
        chord = d - self.towards
        return dot(chord, chord) <= 2.0 * self.one_minus_cos * (1.0 + 1e-4)


class Environment(nn.Module):
    """A bilinear lat-long map as an :class:`~neurad.core.protocols.Emitter`; conventions of ``EnvironmentMap``.

    A cell between four texels is chosen with probability proportional to its mean luminance times its solid angle
    (rows first, then columns), then a direction uniformly in solid angle within it: the density is constant over a
    cell and finite at the poles. The radiance is differentiable in ``pixels``; the density stays as it was built.

    Args:
        environment: the map; a map of one row is constant over theta.

    Raises:
        InputError: ``to_world`` is not a rotation (or reflection), or a pixel is not finite.
    """

    floor = FLOOR
    """Smallest density of a direction, relative to the mean over the map."""
    openings: Openings | None
    """Where its light enters; None in the open."""

    pixels: Tensor
    rotation: Tensor
    density: Tensor
    row_start: Tensor
    row_width: Tensor
    column_end: Tensor
    column_width: Tensor
    cap: Tensor

    def __init__(self, environment: EnvironmentMap) -> None:
        super().__init__()
        self.openings = None
        pixels = torch.from_numpy(np.ascontiguousarray(environment.pixels, np.float32))
        if not bool(torch.isfinite(pixels).all()):
            raise InputError("environment map: it has pixels that are infinite or not a number")
        if len(pixels) == 1:
            pixels = pixels.repeat(2, 1, 1)
        self.height, self.width = pixels.shape[:2]
        self._keep("pixels", pixels.reshape(-1, 3))
        self._keep("rotation", rotation_of(environment))
        self._tabulate(pixels.double())

    def _keep(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value, persistent=False)

    def _tabulate(self, pixels: Tensor) -> None:
        """Probabilities of the cells, [H - 1, W], from the pixels [H, W, 3]; all in float64."""
        light = luminance(pixels)
        light = light + light.roll(-1, 1)
        light = (light[1:] + light[:-1]) / 4
        theta = torch.linspace(0.0, math.pi, self.height, dtype=torch.float64)
        # Solid angle of a row's cell
        angle = (2 * math.pi / self.width) * (theta[:-1].cos() - theta[1:].cos())[:, None]
        self.integral = float((light * angle).sum())
        """Luminance integrated over the sphere."""
        mean = self.integral / (4 * math.pi)
        light = light.clamp_min(self.floor * mean) if mean > 0 else torch.ones_like(light)
        mass = light * angle
        mass = mass / mass.sum()
        rows = mass.sum(1)
        columns = mass / rows[:, None]
        self._keep("density", (mass / angle).float().reshape(-1))
        self._keep("row_width", rows)
        self._keep("row_start", rows.cumsum(0) - rows)
        # One ascending table for all rows: row r, position x within it, is stored as r + x.
        end = columns.cumsum(1)
        end[:, -1] = 1.0
        self._keep("column_end", (end + torch.arange(self.height - 1)[:, None]).reshape(-1))
        self._keep("column_width", columns.reshape(-1))
        # (1 - |cos theta|) / 2 at a row's edges, from the nearer pole, where cos theta itself would lose its digits
        south = torch.arange(self.height - 1) >= self.height // 2
        edge = torch.stack((theta[:-1], theta[1:]), 1)
        edge = torch.where(south[:, None], math.pi - edge, edge)
        cap = (edge / 2).sin().square()
        self._keep("cap", torch.cat((cap, torch.where(south, -1.0, 1.0).double()[:, None]), 1))

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """A direction for each of ``p`` [n, 3] by ``u`` [n, 3]: the third chooses who draws it. The distance is
        infinite.
        """
        wi = self._rotated(self._direction(u[:, 0].double(), u[:, 1].double()), self.rotation)
        chosen = u[:, 2:]
        for share, other in self.draws:
            again = torch.cat((u[:, :2], (chosen / share).clamp(0.0, 1.0)), -1)
            wi = torch.where((chosen >= 0.0) & (chosen < share), other.direction(p, again), wi)
            chosen = chosen - share
        radiance, pdf = self._lookup(wi)
        return EmitterSample(wi, torch.full_like(pdf, math.inf), radiance, self._mixed(p, wi, pdf))

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Radiance [n, 3] from the direction ``-si.wo`` where nothing was hit; 0 on surfaces."""
        return torch.where(si.valid[:, None], 0.0, self._lookup(-si.wo)[0])

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Density [n] at ``p`` [n, 3] of the direction ``-si.wo`` where nothing was hit; 0 on surfaces."""
        cell, _, _ = self._cell(-si.wo)
        return torch.where(si.valid, 0.0, self._mixed(p, -si.wo, self.density.index_select(0, cell)))

    def _mixed(self, p: Tensor, d: Tensor, density: Tensor) -> Tensor:
        """The density [n] of directions [n, 3] at ``p`` [n, 3], of which the map's is ``density`` [n]."""
        draws = self.draws
        rest = (1.0 - sum(share for share, _ in draws)) * density if draws else density
        return sum((share * other.pdf(p, d) for share, other in draws), rest)

    @property
    def draws(self) -> list[tuple[float, Openings | FittedSun]]:
        """What else draws directions, each with its part of the samples; the map draws the others."""
        return [] if self.openings is None else [(BY_OPENINGS, self.openings)]

    def enter_by(self, openings: Openings) -> None:
        """Draw towards openings from now on."""
        self.openings = openings
        self._tabulate_openings()

    def _tabulate_openings(self) -> None:
        """Let openings be drawn by the radiance that enters through them."""
        if self.openings is not None:
            with torch.no_grad():
                self.openings.tabulate(self.radiance(self.openings.d))

    def radiance(self, d: Tensor) -> Tensor:
        """Radiance [n, 3] from unit world directions [n, 3]."""
        return self._lookup(d)[0]

    def _direction(self, u: Tensor, v: Tensor) -> Tensor:
        """Directions [n, 3] (float32) in the map's frame, rows by ``u`` and columns by ``v``, both float64 [n]."""
        row = torch.searchsorted(self.row_start[1:], u, right=True)
        rest = ((u - self.row_start[row]) / self.row_width[row]).clamp(0.0, 1.0)
        cell = torch.searchsorted(self.column_end, row + v, right=True)
        cell = torch.minimum(cell, row * self.width + self.width - 1)
        column = cell - row * self.width
        inside = ((row + v - self.column_end[cell]) / self.column_width[cell] + 1.0).clamp(0.0, 1.0)
        phi = ((2 * math.pi / self.width) * (column + 0.5 + inside)).float()
        low, high, sign = self.cap[row].unbind(-1)
        cap = torch.lerp(low, high, rest).float()
        sin = 2.0 * (cap * (1.0 - cap)).clamp_min(0.0).sqrt()
        return torch.stack((sin * phi.sin(), sign.float() * (1.0 - 2.0 * cap), -sin * phi.cos()), -1)

    @staticmethod
    def _rotated(d: Tensor, matrix: Tensor) -> Tensor:
        """``matrix d`` [n, 3]; no matrix product, which a GPU may be allowed to round."""
        return (d.unsqueeze(-2) * matrix).sum(-1)

    def _cell(self, d: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cell [n] that world directions [n, 3] lie in, and the positions [n] within it across and down."""
        x, y, z = self._rotated(d, self.rotation.T).unbind(-1)
        across = torch.atan2(x, -z) * (self.width / (2 * math.pi)) - 0.5
        down = torch.atan2(torch.hypot(x, z), y) * ((self.height - 1) / math.pi)
        column = across.floor()
        row = down.floor().clamp(0, self.height - 2)
        cell = row.long() * self.width + column.long() % self.width
        return cell, across - column, down - row

    def _lookup(self, d: Tensor) -> tuple[Tensor, Tensor]:
        """Bilinear radiance [n, 3] and density [n] of world directions [n, 3]."""
        cell, across, down = self._cell(d)
        last = cell % self.width == self.width - 1
        right = torch.where(last, cell + 1 - self.width, cell + 1)
        across, down = across[:, None], down[:, None]
        corners = torch.stack((cell, right, cell + self.width, right + self.width))
        left_top, right_top, left_bottom, right_bottom = self._texel(corners.view(-1)).view(4, -1, 3).unbind()
        top = torch.lerp(left_top, right_top, across)
        bottom = torch.lerp(left_bottom, right_bottom, across)
        return torch.lerp(top, bottom, down), self.density.index_select(0, cell)

    def _texel(self, index: Tensor) -> Tensor:
        """Radiance [n, 3] of texels [n], row by row."""
        return self.pixels.index_select(0, index)


def rotation_of(environment: EnvironmentMap) -> Tensor:
    """The rotation from the map's frame to the world [3, 3]; a uniform scale in ``to_world`` does not matter.

    Raises:
        InputError: ``to_world`` is not a rotation (or reflection).
    """
    rotation: Tensor = torch.from_numpy(np.array(environment.to_world, np.float64))[:3, :3]
    scale = rotation.norm(dim=0).mean().clamp_min(1e-30)
    rotation = rotation / scale
    if not torch.allclose(rotation.T @ rotation, torch.eye(3, dtype=torch.float64), atol=1e-4):
        raise InputError("environment map: its to_world transform has to be a rotation")
    return rotation.float()
