"""AD-Direct: light that was reflected once, and nothing further."""

from torch import Tensor

from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import Method, RadianceEstimate, SceneModel


class Direct(Method):
    """Direct illumination only, ``T E``: what is missing of the light gets baked into the albedo."""

    needs_field = False
    estimates_Li = False

    def reflected(
        self, scene: SceneModel, si: SurfaceInteraction, surface: Surface, u: Tensor, stream: Stream
    ) -> RadianceEstimate:
        """``T_hat(E)`` at the lanes of ``si``."""
        return RadianceEstimate(bounce(scene.world, si, surface, u).direct)
