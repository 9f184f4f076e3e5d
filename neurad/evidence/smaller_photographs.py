"""Photographs at a fraction of their size: a level of an image pyramid, on which what is far apart lies near."""

from collections.abc import Sequence

import torch
from torch import Tensor

from neurad.core.camera import resized
from neurad.core.protocols import PhotographedPixels
from neurad.core.scene_records import Camera


def smaller(camera: Camera, by: int) -> Camera:
    """A camera whose picture has sides ``by`` times shorter."""
    return resized(camera, camera.width // by)


class SmallerPhotographs(PhotographedPixels):
    """What pixels of :func:`smaller` pictures show: the mean of ``by`` by ``by`` pixels, spread evenly where sides are
    no multiples of that. A pixel is clipped, or left out, where one of them is.

    Args:
        photographs: of the cameras.
        cameras: of all views, at full size.
        by: what sides are divided by.
    """

    def __init__(self, photographs: PhotographedPixels, cameras: Sequence[Camera], by: int) -> None:
        self.photographs, self.by = photographs, by
        small = [smaller(camera, by) for camera in cameras]
        self.full, self.small = (torch.tensor([[c.width, c.height] for c in views]) for views in (cameras, small))
        self._left_out = self._any_left_out(photographs.ignored())  # once: it is asked for every view

    def colors(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Means [n, 3] over the pixels [n] of views [n]."""
        return self.photographs.colors(*self._within(view, pixel)).view(len(view), self.by**2, 3).mean(1)

    def clipped(self, view: Tensor, pixel: Tensor) -> Tensor | None:
        """Whether one of the values in each pixel [n] of views [n] is at its ceiling [n, 3]; None without a ceiling."""
        found = self.photographs.clipped(*self._within(view, pixel))
        return None if found is None else found.view(len(view), self.by**2, 3).any(1)

    def ignored(self) -> Tensor | None:
        """Pixels in which masks leave something out [views, pixels]; None where there is no mask."""
        return self._left_out

    def _any_left_out(self, whole: Tensor | None) -> Tensor | None:
        """What :meth:`ignored` gives, by the pixels that are left out at full size."""
        if whole is None:
            return None
        whole, sizes = whole.cpu(), self.small.prod(1)
        found = torch.zeros(len(sizes), int(sizes.max()), dtype=torch.bool)
        for view, size in enumerate(sizes.tolist()):
            places = self._within(torch.full((size,), view), torch.arange(size))
            found[view, :size] = whole[places].view(size, -1).any(1)
        return found

    def _within(self, view: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor]:
        """Views and pixels at full size [n * by^2] of pixels [n]."""
        full, small = self.full[view], self.small[view]
        place = torch.stack((pixel % small[:, 0], pixel // small[:, 0]), -1)  # column, row
        inside = (torch.cartesian_prod(*[torch.arange(self.by)] * 2) + 0.5) / self.by  # [by^2, 2]
        at = ((place[:, None] + inside) * (full / small)[:, None]).long()
        return view.repeat_interleave(self.by**2), (at[..., 1] * full[:, None, 0] + at[..., 0]).view(-1)
