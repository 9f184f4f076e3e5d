"""AD-Direct: light that was reflected once, and nothing further."""

from __future__ import annotations

from torch import Tensor

from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import Method, Parts, Reflected


class Direct(Method):
    """Direct illumination only, ``T E``: what is missing of the light gets baked into the albedo."""

    needs_field = False
    tells_light = False

    def reflected(self, parts: Parts, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream) -> Reflected:
        """``T_hat(E)`` at the lanes of ``si``."""
        return Reflected(bounce(parts.world, si, surface, u).direct)
