"""A tracer that counts the rays which it casts."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import Tensor

from neurad.core.protocols import Tracer
from neurad.core.records import Hit, Rays


class CountingTracer:
    """Passes every query on to another tracer and counts its rays, nearest hits and shadow rays alike."""

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer
        self.rays_cast = 0
        """Rays cast so far, outside of :meth:`uncounted`."""
        self._counts = True

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit of every ray [n]."""
        self._count(rays)
        return self.tracer.closest(rays)

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether anything lies before ``t_max`` [n]: bool [n]."""
        self._count(rays)
        return self.tracer.occluded(rays, t_max)

    @contextmanager
    def uncounted(self, when: bool = True) -> Iterator[None]:
        """A block whose rays are not counted, if ``when``: evaluations, and set-up that a continued run does again."""
        before, self._counts = self._counts, self._counts and not when
        try:
            yield
        finally:
            self._counts = before

    def _count(self, rays: Rays) -> None:
        if self._counts:
            count = len(rays)  # before the sum is read: between the two no other thread may come
            self.rays_cast += count
