"""An environment that is not known and gets recovered from photographs."""

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.colour import luminance
from neurad.core.records import FloatArray
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.environment import Environment, FittedSun, rotation_of
from neurad.emitters.openings import Openings
from neurad.images.lat_long import add_points, texel_directions

BY_OPENINGS, BY_SUN = 0.9, 0.3
"""Parts of the samples that are drawn towards openings and, out of those, towards the sun where there is one."""
SUN_POINTS = 4096
"""Points of the sun's disk that are shared among texels."""
START = 2.0
"""Radiance of the map at the start, in units of the photographs' typical radiance: about what grey surfaces need."""


class FittedEnvironment(Environment):
    """A lat-long map ``unit * exp(values)`` with trainable ``values``: positive, and equally quick in dim and in
    bright directions. It starts at one radiance everywhere. The sun is apart from it.

    The density of :meth:`sample` is that of the map at the last :meth:`refresh`, no gradient flows into it, and its
    floor is higher than a known map's, as a direction that seems dark may not have been fitted yet. The map
    behind the density is part of the state, so that a continued run samples as one that was never stopped.

    Args:
        frame: an environment whose ``to_world`` is used; its pixels are not read.
        width: texels across.
        height: texels from pole to pole.

    Raises:
        InputError: ``to_world`` is not a rotation.
    """

    floor = 0.05
    values: nn.Parameter
    tabulated: Tensor
    unit: Tensor
    begun: Tensor
    """Whether photographs have been asked what they show of the sky and its sun."""
    balanced: Tensor
    """How often the albedo has been asked what it says of the sky."""

    def __init__(self, frame: EnvironmentMap, width: int, height: int) -> None:
        nn.Module.__init__(self)
        self.height, self.width, self.openings = height, width, None
        self.values = nn.Parameter(torch.zeros(height * width, 3))
        self.sun = FittedSun()
        self.register_buffer("begun", torch.zeros((), dtype=torch.bool))
        self.register_buffer("balanced", torch.zeros((), dtype=torch.int64))
        self.register_buffer("unit", torch.ones(()))
        self.register_buffer("tabulated", torch.ones(height * width, 3))
        self._keep("rotation", rotation_of(frame))
        self.refresh()
        # After a checkpoint was loaded the tables belong to its map
        self.register_load_state_dict_post_hook(lambda module, _: module.tabulate())  # type: ignore[no-untyped-call]

    def set_unit(self, radiance: float) -> None:
        """Take the photographs' typical ``radiance`` as the unit; before training that also scales the start."""
        self.unit.fill_(START * radiance)

    @torch.no_grad()
    def begin(self, d: Tensor, radiance: Tensor) -> None:
        """Begin with radiance [n, 3] that was seen from directions [n, 3]; elsewhere with what was seen near there,
        weighted by the inverse 16th power of its distance (Shepard 1968): nearly the nearest alone, so that a sky which
        is seen does not shine from below the horizon. Nothing changes where there is none.
        """
        row, column = self.texel(d)
        texel = row * self.width + column
        count = torch.bincount(texel, minlength=len(self.values))
        seen = (count > 0).nonzero().squeeze(-1)
        if len(seen) == 0:
            return
        total = torch.zeros_like(self.values).index_add_(0, texel, (radiance / self.unit).log())
        level = total[seen] / count[seen, None]
        towards = torch.from_numpy(texel_directions(self.height, self.width)).to(d).view(-1, 3)
        for part, values in zip(torch.split(towards, 1024), torch.split(self.values.data, 1024), strict=True):
            squared = (2.0 - 2.0 * part @ towards[seen].T).clamp_min(1e-6)
            weight = (squared.amin(-1, keepdim=True) / squared) ** 8
            values.copy_(weight @ level / weight.sum(-1, keepdim=True))

    def texel(self, d: Tensor) -> tuple[Tensor, Tensor]:
        """Row and column [n] of the texels nearest to directions [n, 3]."""
        cell, across, down = self._cell(d)
        return cell // self.width + down.round().long(), (cell + across.round().long()) % self.width

    @torch.no_grad()
    def multiply(self, texels: Tensor, sun: Tensor) -> None:
        """Change the radiance by the logarithms of factors, of texels [height * width, 3] and of the sun [1, 3]."""
        self.values.add_(texels.to(self.values))
        self.sun.values.add_(sun.to(self.sun.values))
        self.refresh()

    @torch.no_grad()
    def refresh(self) -> None:
        """Sample by the present map from now on."""
        self.tabulated.copy_(self.unit * self.values.exp())
        self.tabulate()

    def tabulate(self) -> None:
        """Rebuild the tables from the map of the last refresh."""
        device = self.values.device
        self._tabulate(self.tabulated.detach().cpu().double().view(self.height, self.width, 3))
        self.to(device)
        if self.sun.shines:
            light = luminance(self.sun.values.detach().double().exp())
            self.integral += float(light) * self.sun.solid_angle
        self._tabulate_openings()

    @torch.no_grad()
    def map(self, times: int = 1) -> FloatArray:
        """The present map [times * height, times * width, 3], linear radiance, with the sun in it."""
        values = (self.unit * self.values.exp()).view(self.height, self.width, 3)
        if times > 1:
            towards = texel_directions(times * self.height, times * self.width).reshape(-1, 3)
            own = self._rotated(torch.from_numpy(towards).to(values), self.rotation)
            values = Environment._lookup(self, own)[0].view(times * self.height, times * self.width, 3)
        pixels = values.double().cpu().numpy()
        if self.sun.shines:
            u = torch.rand(SUN_POINTS, 3, generator=torch.Generator().manual_seed(0)).to(values)
            d = self._rotated(self.sun.direction(u, u), self.rotation.T)
            power = self.sun.values.exp() * (self.sun.solid_angle / SUN_POINTS)
            add_points(pixels, d.double().cpu().numpy(), power.double().cpu().numpy())
        return np.ascontiguousarray(pixels, np.float32)

    @property
    def draws(self) -> list[tuple[float, Openings | FittedSun]]:
        """As of any environment, and the sun."""
        sun: list[tuple[float, Openings | FittedSun]] = [(BY_SUN, self.sun)] if self.sun.shines else []
        return sun if self.openings is None else [*sun, (BY_OPENINGS - BY_SUN * len(sun), self.openings)]

    def _lookup(self, d: Tensor) -> tuple[Tensor, Tensor]:
        radiance, density = super()._lookup(d)
        return (radiance + self.sun.radiance(d) if self.sun.shines else radiance), density

    def _texel(self, index: Tensor) -> Tensor:
        """Radiance [n, 3] of texels [n], with the gradient of ``values``."""
        return self.unit * self.values.index_select(0, index).exp()
