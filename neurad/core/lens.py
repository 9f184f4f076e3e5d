"""Lenses: centres that are not the film's, pixels that are not square, and distortion with its inverse.

Distortion is OpenCV's. It moves points of a plane, x to the right and y down: those at distance 1 before a perspective
lens, or for a fisheye those whose distance from the middle is the angle from the axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Self

import numpy as np
import numpy.typing as npt
import torch
from numpy.polynomial import Polynomial
from torch import Tensor

Array = npt.NDArray[np.float64]

STEPS = 20
"""Newton steps at most; two are usual."""
SMALL = 1e-9
"""Size of a step after which there is no other: the number of right digits doubles, and float64 has no more of them."""
_TINY = 1e-14  # coefficients that move nothing on any film
_TABLE = 512  # cells of the first guess
_AT_ONCE = 1 << 16  # positions that are looked at together
_SAMPLES = 33  # positions along a side of the film at which a lens is checked; the corners are among them
_MARGIN = 1.02  # of the film's farthest corner: what lies beyond is not seen


@dataclass(frozen=True)
class Lens:
    """What a camera has beyond a pinhole over the middle of square pixels; nothing of it hangs on the film's size.

    A point at ``r`` from the middle of the plane comes to ``r N(r^2) / D(r^2)``, ``N(q) = 1 + k1 q + k2 q^2 + ...``.
    """

    aspect: float = 1.0
    """``fl_y / fl_x``."""
    centre: tuple[float, float] = (0.5, 0.5)
    """``cx / width`` and ``cy / height``."""
    numerator: tuple[float, ...] = ()
    """Coefficients of the radial distortion, up to four: k1 k2 k3 of a perspective lens, k1 k2 k3 k4 of a fisheye."""
    denominator: tuple[float, ...] = ()
    """Up to three: k4 k5 k6 of a perspective lens."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1 and p2 of a perspective lens."""
    fisheye: bool = False

    @property
    def bends(self) -> bool:
        """Whether straight lines do not stay straight."""
        return self.fisheye or any((*self.numerator, *self.denominator, *self.tangential))

    def profile(self, r: Array) -> Array:
        """Where the radial part moves points at distance ``r`` from the middle."""
        above, below = (Polynomial((1.0, *k)) for k in (self.numerator, self.denominator))
        return np.asarray(r * above(r * r) / below(r * r))

    @property
    def reach(self) -> float:
        """Distance from the middle up to which the radial part grows: beyond, the picture folds over. May be infinite;
        of a fisheye it is at most pi, straight behind it.
        """
        above, below = (Polynomial((1.0, *k)) for k in (self.numerator, self.denominator))
        slope = above * below + Polynomial((0.0, 2.0)) * (above.deriv() * below - above * below.deriv())
        roots = np.concatenate([part.trim(_TINY).roots() for part in (slope, below)])
        real = roots[(np.abs(roots.imag) <= 1e-9 * np.abs(roots)) & (roots.real > 0)].real
        return min(math.sqrt(real.min()) if len(real) else math.inf, math.pi if self.fisheye else math.inf)


@dataclass(frozen=True)
class Bending:
    """The distortion of the lenses of several cameras, on tensors of float64."""

    numerator: Tensor
    """[v, 4]."""
    denominator: Tensor
    """[v, 3]."""
    tangential: Tensor
    """[v, 2]."""
    fisheye: Tensor
    """[v], bool."""
    start: Tensor
    """First guesses: where the radial part comes from, at equal steps up to ``far`` [lenses, cells + 1]."""
    far: Tensor
    """[v]."""
    limit: Tensor
    """Distance from the middle of the plane beyond which nothing is on the film [v]."""
    row: Tensor
    """Row of each in ``start`` [v], int64."""
    folds: Tensor
    """Whether some place on the film has no point of the plane of its own [v], bool."""

    @classmethod
    def of(cls, lenses: list[tuple[Lens, float, int, int]], device: torch.device | str) -> Self:
        """Tables of lenses, each with the side of a pixel on the plane and its film's width and height in pixels."""
        rows = [_solved(*lens)[0] for lens in lenses]
        joined = {name: torch.cat([getattr(row, name) for row in rows]).to(device) for name in vars(rows[0])}
        return cls(**joined | {"row": torch.arange(len(rows), device=device)})

    def __getitem__(self, view: Tensor | slice) -> Bending:
        """Those of cameras, a row each."""
        return Bending(**{name: part if name == "start" else part[view] for name, part in vars(self).items()})

    def bend(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Where points of the plane come to lie."""
        return self._moved(x, y, self._ratio(x * x + y * y)[0])

    def unbend(self, xd: Tensor, yd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The points of the plane that come to (xd, yd) [n], by Newton's method, and how much larger than there an area
        is around them: the determinant of the derivative.

        Where a picture folds over there are none: those get one near the last of their direction, and 1 for the area.
        """
        x, y, area = self._newton(xd, yd)
        if bool(self.folds.any()):
            lost = self.folds & ~self._found(xd, yd, x, y, area)
            scale = self.limit / (_MARGIN * torch.hypot(xd, yd))
            x, y = torch.where(lost, xd * scale, x), torch.where(lost, yd * scale, y)
            area = torch.where(lost, 1.0, area)
        return x, y, area

    def _found(self, xd: Tensor, yd: Tensor, x: Tensor, y: Tensor, area: Tensor) -> Tensor:
        """Whether (x, y) comes to (xd, yd), and what is around it lies there as it does on the plane [n], bool."""
        again_x, again_y = self.bend(x, y)
        error = torch.hypot(again_x - xd, again_y - yd)
        return (error <= SMALL) & (area > 0) & (torch.hypot(x, y) < self.limit)

    def _newton(self, xd: Tensor, yd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """What :meth:`unbend` gives where there is such a point."""
        x, y = self._first_guess(xd, yd)
        p1, p2 = self.tangential.unbind(-1)
        for _ in range(STEPS):
            ratio, slope = self._ratio(x * x + y * y)
            fx, fy = self._moved(x, y, ratio)
            across = 2.0 * (x * y * slope + p1 * x + p2 * y)  # the derivative is symmetric
            xx = ratio + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            yy = ratio + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            area = xx * yy - across * across
            dx, dy = (yy * (fx - xd) - across * (fy - yd)) / area, (xx * (fy - yd) - across * (fx - xd)) / area
            x, y = x - dx, y - dy
            if not bool(((dx.abs() > SMALL) | (dy.abs() > SMALL)).any()):
                break
        return x, y, area

    def direction(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Directions that points of the plane stand for: right, up and towards the viewer, of any length."""
        theta = torch.hypot(x, y)
        scale = torch.where(self.fisheye, torch.sinc(theta / math.pi), 1.0)
        return x * scale, -y * scale, -torch.where(self.fisheye, theta.cos(), 1.0)

    def plane(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Points of the plane for points in the camera's space; NaN where nothing of them is on the film."""
        side = torch.hypot(x, y)
        theta = torch.atan2(side, -z)
        ahead = torch.where(z < 0, -z, torch.nan)
        scale = torch.where(self.fisheye, torch.where(side > 0, theta / side, 1.0 / ahead), 1.0 / ahead)
        x, y = x * scale, -y * scale
        seen = torch.hypot(x, y) <= self.limit
        return torch.where(seen, x, torch.nan), torch.where(seen, y, torch.nan)

    def _moved(self, x: Tensor, y: Tensor, ratio: Tensor) -> tuple[Tensor, Tensor]:
        """What :meth:`bend` gives, with ``N / D`` there."""
        p1, p2 = self.tangential.unbind(-1)
        xy = 2.0 * x * y
        return (
            x * ratio + p1 * xy + p2 * (3.0 * x * x + y * y),
            y * ratio + p1 * (x * x + 3.0 * y * y) + p2 * xy,
        )

    def _ratio(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """``N / D`` at squared distances ``q``, and its derivative by them."""
        k1, k2, k3, k4 = self.numerator.unbind(-1)
        k5, k6, k7 = self.denominator.unbind(-1)
        above, below = 1.0 + q * (k1 + q * (k2 + q * (k3 + q * k4))), 1.0 + q * (k5 + q * (k6 + q * k7))
        above_slope, below_slope = k1 + q * (2.0 * k2 + q * (3.0 * k3 + q * 4.0 * k4)), k5 + q * (2 * k6 + q * 3 * k7)
        ratio = above / below
        return ratio, (above_slope - ratio * below_slope) / below

    def _first_guess(self, xd: Tensor, yd: Tensor) -> tuple[Tensor, Tensor]:
        """The solution as if there was no tangential part, from the table."""
        rd = torch.hypot(xd, yd)
        place = (rd / self.far).clamp(0.0, 1.0) * _TABLE
        cell = place.floor().clamp(max=_TABLE - 1)
        low, high = (self.start[self.row, cell.long() + i] for i in (0, 1))
        scale = torch.where(rd > 0, torch.lerp(low, high, place - cell) / rd, 1.0)
        return xd * scale, yd * scale


def _padded(coefficients: tuple[float, ...], count: int) -> tuple[float, ...]:
    return (*coefficients, *[0.0] * (count - len(coefficients)))


def fold(lens: Lens, side: float, width: int, height: int) -> tuple[float, float] | None:
    """A place on the film, in pixels, where the distortion folds over: it has no direction of its own. None if there is
    no such place. ``side`` is that of a pixel on the plane at distance 1, along x.
    """
    return _solved(lens, side, width, height)[1] if lens.bends else None


@lru_cache(maxsize=1024)
@torch.inference_mode(False)
def _solved(lens: Lens, side: float, width: int, height: int) -> tuple[Bending, tuple[float, float] | None]:
    """The distortion of one lens, and a place on the film as :func:`fold` gives it."""
    columns, rows = np.linspace(0.0, width, _SAMPLES), np.linspace(0.0, height, _SAMPLES)
    u, v = (x.ravel() for x in np.meshgrid(columns, rows))
    xd = (u - lens.centre[0] * width) * side
    yd = (v - lens.centre[1] * height) * side / lens.aspect
    far, reach = float(np.hypot(xd, yd).max()), lens.reach
    largest = reach
    if math.isinf(reach):
        largest = 1.0
        while lens.profile(np.array(largest)) < far and largest < 1e6:
            largest *= 2.0
    radii = largest * np.linspace(0.0, 1.0, 4097) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = lens.profile(radii)
    if not np.isfinite(moved[-1]):  # the end of the reach is a pole
        radii, moved = radii[:-1], moved[:-1]
    far = min(far, float(moved[-1]))
    start = np.interp(np.linspace(0.0, far, _TABLE + 1), moved, radii)
    make = partial(torch.tensor, dtype=torch.float64, device="cpu")
    row = Bending(
        make([_padded(lens.numerator, 4)]),
        make([_padded(lens.denominator, 3)]),
        make([lens.tangential]),
        torch.tensor([lens.fisheye], device="cpu"),
        torch.from_numpy(start[None]),
        make([far]),
        make([reach]),
        torch.zeros(1, dtype=torch.int64, device="cpu"),
        torch.tensor([False], device="cpu"),
    )
    there = torch.from_numpy(xd), torch.from_numpy(yd)
    x, y, area = row._newton(*there)
    good = row._found(*there, x, y, area)
    seen = _MARGIN * float(torch.hypot(x, y)[good].max()) if bool(good.any()) else 0.0
    if bool(good.all()):
        return replace(row, limit=make([min(seen, reach)])), None
    index = int((~good).nonzero()[0])
    limit = make([reach if math.isfinite(reach) else seen])
    return replace(row, limit=limit, folds=~row.folds), (float(u[index]), float(v[index]))


@lru_cache(maxsize=16)
def folded(lens: Lens, side: float, width: int, height: int) -> npt.NDArray[np.bool_]:
    """Pixels of which a corner has no point of the plane of its own [height, width]. Arguments as in :func:`fold`."""
    bending = Bending.of([(lens, side, width, height)], "cpu")
    xd = (torch.arange(width + 1, dtype=torch.float64) - lens.centre[0] * width) * side
    yd = (torch.arange(height + 1, dtype=torch.float64) - lens.centre[1] * height) * (side / lens.aspect)
    rows = []
    for part in torch.tensor_split(yd, -(-len(xd) * len(yd) // _AT_ONCE)):
        x, y = xd.expand(len(part), -1).reshape(-1), part.repeat_interleave(len(xd))
        rows.append(~bending._found(x, y, *bending._newton(x, y)).view(len(part), -1))
    lost = torch.cat(rows).numpy()
    found: npt.NDArray[np.bool_] = lost[1:, 1:] | lost[1:, :-1] | lost[:-1, 1:] | lost[:-1, :-1]
    return found
