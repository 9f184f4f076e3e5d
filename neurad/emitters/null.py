"""An emitter that sends nothing."""

import torch
from torch import Tensor, nn

from neurad.core.records import EmitterSample, SurfaceInteraction


class NullEmitter(nn.Module):
    """An :class:`~neurad.core.protocols.Emitter` that sends nothing."""

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """Any direction, with density 0."""
        wi = torch.zeros_like(p)
        wi[:, 2] = 1.0
        return EmitterSample(wi, torch.ones_like(p[:, 0]), torch.zeros_like(p), torch.zeros_like(p[:, 0]))

    def eval(self, si: SurfaceInteraction) -> Tensor:  # type: ignore[override]
        """Zeros [n, 3]."""
        return torch.zeros_like(si.p)

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Zeros [n]."""
        return torch.zeros_like(p[:, 0])
