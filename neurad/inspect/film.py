"""Pictures that get better sample by sample, and the best mixture of several of them."""

from collections.abc import Callable, Sequence
from itertools import takewhile

import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.protocols import Integrator
from neurad.core.rng import mix
from neurad.core.scene_records import Camera
from neurad.integrators.film import box_mean
from neurad.runtime.threads import parallel_map

CHUNK = 1 << 15
"""Camera rays that a thread traces between two looks at whether somebody waits: at most some tenths of a second."""
WINDOW = 11
"""Side of the square of pixels over which noise and bias are compared."""
MIN_SAMPLES = 3
"""Samples that say how noisy a film is."""
_PLASTIC = 0.7548776662466927, 0.5698402909980532
"""Steps of the R2 sequence, which fills the unit square evenly from any point on."""


class Film:
    """The mean of samples, one in each pixel at a time, and the variance of that mean.

    The positions within the pixels are those of a sequence that fills them evenly and begins in the middle.
    """

    def __init__(self, camera: Camera, integrator: Integrator, seed: int, device: torch.device | str = "cpu") -> None:
        self.camera = camera
        self.integrator = integrator
        self.seed = seed
        self.device = device
        self.count = 0
        self._sum = self._squares = torch.zeros(())

    def add(self, stop: Callable[[], bool] = lambda: False) -> bool:
        """Another sample in every pixel; False, and nothing is added, if ``stop()`` was true on the way."""
        width, height = self.camera.width, self.camera.height
        offset = [(0.5 + self.count * step) % 1.0 for step in _PLASTIC]
        begins = range(0, width * height, CHUNK)

        def part(begin: int) -> Tensor:
            pixels = torch.arange(begin, min(begin + CHUNK, width * height), device=self.device)
            xy = torch.stack((pixels % width + offset[0], pixels // width + offset[1]), -1)
            return self.integrator(camera_rays(self.camera, xy), mix(self.seed, self.count, begin))

        parts = list(parallel_map(part, takewhile(lambda begin: not (begin and stop()), begins)))
        if len(parts) < len(begins):
            return False
        sample = torch.cat(parts).view(height, width, -1)
        self._sum = self._sum + sample
        self._squares = self._squares + sample.square()
        self.count += 1
        return True

    @property
    def mean(self) -> Tensor:
        """The picture so far [h, w, c]; there has to be a sample."""
        assert self.count > 0
        return self._sum / self.count

    @property
    def variance(self) -> Tensor:
        """Variance of :attr:`mean` [h, w, c], from the samples; there have to be two."""
        assert self.count > 1
        return ((self._squares - self._sum.square() / self.count) / (self.count - 1)).clamp_min(0.0) / self.count


def mixture(
    prior: Tensor | None, films: Sequence[Film], scales: Sequence[float], shown: Sequence[Tensor] | None = None
) -> tuple[Tensor, float]:
    """The picture ``sum_l s_l I_l`` from films of the ``I_l`` and a picture of ``sum_l I_l`` that is smooth but wrong.

    For any ``a``, ``a prior + sum_l (s_l - a) I_l`` shows the scaled sum where the prior is right. The square of its
    error is ``a^2 b^2 + sum_l (s_l - a)^2 v_l`` with the prior's error ``b`` and the films' variances ``v_l``, and
    least for ``a = sum_l s_l v_l / (b^2 + sum_l v_l)``. Both are means over :data:`WINDOW` pixels, ``b^2`` that of
    the squared difference between prior and films less the films' variance. With more samples ``a`` goes to 0, so
    whatever is wrong with the prior disappears.

    Args:
        prior: [h, w, 3], or None.
        films: of the ``I_l``. Where some have no sample, or fewer than :data:`MIN_SAMPLES`, ``a`` is :func:`common` to
            those.
        scales: ``s_l``.
        shown: what stands for the ``I_l`` of films that have samples, [h, w, 3] each, if not their means; ``a`` is made
            for the means.

    Returns:
        The picture [h, w, 3], not negative, and the mean of ``a``.
    """
    weight: Tensor | float = 0.0
    if prior is not None:
        few = [s for film, s in zip(films, scales, strict=True) if film.count == 0]
        few = few or [s for film, s in zip(films, scales, strict=True) if film.count < MIN_SAMPLES]
        weight = common(few) if few else _weight(prior, films, scales)
    drawn = [(film, s) for film, s in zip(films, scales, strict=True) if film.count > 0]
    pictures = [film.mean for film, _ in drawn] if shown is None else shown
    parts = [(s - weight) * picture for (_, s), picture in zip(drawn, pictures, strict=True)]
    if prior is not None:
        parts.append(weight * prior)
    return torch.stack(parts).sum(0).clamp_min(0.0), float(weight if isinstance(weight, float) else weight.mean())


def common(scales: Sequence[float]) -> float:
    """The value that most of some scales have; of several the largest, and 0 if there are none."""
    return max(scales, key=lambda scale: (list(scales).count(scale), scale), default=0.0)


def _weight(prior: Tensor, films: Sequence[Film], scales: Sequence[float]) -> Tensor:
    """``a`` of :func:`mixture` [h, w, 3]."""
    noise = [box_mean(film.variance, WINDOW) for film in films]
    total = torch.stack(noise).sum(0)
    difference = prior - torch.stack([film.mean for film in films]).sum(0)
    bias = (box_mean(difference.square(), WINDOW) - total).clamp_min(0.0)
    scaled = torch.stack([s * v for s, v in zip(scales, noise, strict=True)]).sum(0)
    return scaled / (bias + total).clamp_min(torch.finfo(total.dtype).tiny)
