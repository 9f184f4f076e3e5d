"""Pictures that get better sample by sample, the best mixture of several of them, and few samples made smooth."""

import math
from collections.abc import Callable, Sequence
from itertools import takewhile

import torch
from torch import Tensor
from torch.nn.functional import pad

from neurad.assembly.build import Assembly
from neurad.core.camera import camera_rays
from neurad.core.frame import dot
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
DARKEST = 0.02
"""Albedo below which light is not divided by it."""
TURN = 16.0
"""How quickly weights fall as normals turn away: to 1/e at 20 degrees."""
DEPTH = 0.01
"""Distance from a surface's plane, over that from the camera, at which weights fall to 1/e."""
COARSE = 16
"""Pixels across the picture that the widest smoothing leaves apart."""
_PLASTIC = 0.7548776662466927, 0.5698402909980532
"""Steps of the R2 sequence, which fills the unit square evenly from any point on."""
_TAPS = [(y, x, 2.0 ** -(abs(y) + abs(x))) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]


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


class Smoother:
    """Means over a surface of the light that arrives there, in steps that widen (an a-trous wavelet transform).

    Light is what a picture shows over the albedo, so that patterns stay sharp. Nothing is mixed across edges of meshes
    or creases, nothing is changed on smooth mirrors and glass and where there is no surface. Edges of shadows and
    reflections are blurred.
    """

    def __init__(self, assembly: Assembly, camera: Camera) -> None:
        world = assembly.world
        device = world.two_sided.device
        pixel = torch.arange(camera.width * camera.height, device=device)
        rays = camera_rays(camera, torch.stack((pixel % camera.width, pixel // camera.width), -1) + 0.5)
        with torch.no_grad():
            si = world.intersect(rays)
            albedo = assembly.materials.albedo(si)
        size = camera.height, camera.width
        delta = torch.tensor([m.model.is_delta for m in assembly.scene.materials], device=device)
        prim = si.prim.clamp_min(0)
        usable = si.valid & ~delta[world.geometry.material[prim]]
        mesh = torch.where(usable, world.geometry.mesh_index[prim], -1).view(size)
        away = torch.linalg.vector_norm(si.p - rays.o, dim=-1).clamp_min(1e-12).view(size)
        self._albedo = torch.where(usable[:, None], albedo, 1.0).clamp_min(DARKEST).view(*size, 3)
        self._levels = [
            (step, _weights(mesh, si.n.view(*size, 3), si.p.view(*size, 3), away, step))
            for step in (1 << level for level in range(max(1, round(math.log2(max(min(size) / COARSE, 1.0))))))
        ]

    def __call__(self, picture: Tensor) -> Tensor:
        """A picture [h, w, 3] made smooth."""
        light = picture / self._albedo
        for step, weights in self._levels:
            total = torch.ones_like(weights[0])
            summed = light.clone()
            for shifted, weight in zip(_shifted(light, step), weights, strict=True):
                summed += weight.unsqueeze(-1) * shifted
                total += weight
            light = summed / total.unsqueeze(-1)
        return light * self._albedo


def _weights(mesh: Tensor, n: Tensor, p: Tensor, away: Tensor, step: int) -> list[Tensor]:
    """Weights [h, w] of the neighbours of each pixel, ``step`` pixels away, in the order of the taps."""
    found = []
    for (_, _, weight), n2, p2, mesh2 in zip(
        _TAPS, _shifted(n, step), _shifted(p, step), _shifted(mesh.unsqueeze(-1).double(), step), strict=True
    ):
        turned = (1.0 - dot(n, n2)).clamp_min(0.0)
        off = dot(p2 - p, n).abs() / (DEPTH * away)
        same = (mesh2[..., 0] == mesh) & (mesh >= 0)
        found.append(weight * torch.where(same, (-TURN * turned - off).exp(), 0.0))
    return found


def _shifted(image: Tensor, step: int) -> list[Tensor]:
    """An image [h, w, c] as each neighbour sees it; beyond its edge it goes on as at the edge."""
    height, width, _ = image.shape
    wide = pad(image.permute(2, 0, 1)[None], (step, step, step, step), mode="replicate")[0].permute(1, 2, 0)
    return [
        wide[step * (1 + y) : step * (1 + y) + height, step * (1 + x) : step * (1 + x) + width] for y, x, _ in _TAPS
    ]
