"""The contracts between the floors. YAML ``class_path`` picks implementations; there is no registry."""

from collections.abc import Callable
from typing import Protocol

from torch import Tensor

from neurad.core.records import (
    BSDFSample,
    DatasetStats,
    EmitterSample,
    Hit,
    PixelBatch,
    Rays,
    Surface,
    SurfaceInteraction,
)


class Tracer(Protocol):
    """Casts rays against a fixed set of triangles. Results lie on the device of the rays and carry no gradients."""

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit of every ray with t > 0, dense."""

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether anything lies in 0 < t < t_max [n] (infinity allowed): bool [n].

        A triangle that the ray's origin lies exactly on counts too; spawned rays start off it.
        """


class Materials(Protocol):
    """Whatever says what surfaces are made of: fitted fields or a scene's own textures."""

    def __call__(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3], where no more is needed."""


class LobeKernels(Protocol):
    """Compiled lobes of a model ``f cos = albedo d + s`` with scalars d and s, for float32 on the CPU."""

    @property
    def takes_any_lanes(self) -> bool:
        """Whether it may be asked for a part of the lanes; False where it holds values of its own for all of them."""

    def lobes(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """Rows d, s, pdf, then dd/dx and ds/dx for each scalar parameter x of ``surface``, the roughness first and the
        metalness where there is one: [5 or 7, n] without a graph.
        """

    def direction(self, surface: Surface, wo: Tensor, u: Tensor) -> Tensor:
        """The directions ``wi`` [n, 3] that ``sample`` draws from ``u`` [n, 3]."""

    def mean_lobes(self, surface: Surface, cosine: Tensor) -> Tensor:
        """Integrals over wi of d and s, then of their derivatives as in :meth:`lobes`, [4 or 6, n] for viewers at
        ``cosine`` [n].
        """


class SampledBSDF(Protocol):
    """What one bounce needs of reflection, in the shading frame: z is the normal on the viewer's side, so wo.z >= 0."""

    varying_weight: bool
    """Whether weights of :meth:`sample` differ from their mean: where they do not, as at Lambertian surfaces, there is
    nothing for a control variate to take away."""

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value f * cos(wi) [n, 3], differentiable in ``surface``, and the detached density [n] with which
        :meth:`sample` draws ``wi``; both are 0 where wi.z <= 0 or wo.z <= 0.
        """

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` from three uniform numbers ``u`` [n, 3]. The weight is differentiable in ``surface`` with the
        direction and the pdf held fixed (detached sampling).
        """

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights of :meth:`sample`, the directional albedo [n, 3], differentiable in ``surface``."""


class BSDF(SampledBSDF, Protocol):
    """A reflection model; implementations extend it for what is the same in most."""

    is_diffuse: bool
    """``f = albedo / pi`` on every lane, drawn by the cosine: the bounce made for Lambertian scenes applies."""

    def eval(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """The value of :meth:`eval_pdf` alone [n, 3]."""
        return self.eval_pdf(surface, wo, wi)[0]

    def pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> Tensor:
        """The density of :meth:`eval_pdf` alone [n]."""
        return self.eval_pdf(surface.detach(), wo, wi)[1]

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> float | Tensor:
        """Probability that :meth:`sample` draws by the cosine [n]: it does where the first number lies below."""

    def kernels(self, surface: Surface) -> LobeKernels | None:
        """Compiled lobes that do all lanes of ``surface``; None where there are none."""
        return None


class Emitter(Protocol):
    """Something that sends light."""

    def sample(self, p: Tensor, u: Tensor) -> EmitterSample:
        """Draw a direction towards light for reference points ``p`` [n, 3] from three uniform numbers ``u`` [n, 3]."""

    def eval(self, si: SurfaceInteraction) -> Tensor:
        """Radiance [n, 3] sent towards ``si.wo`` from where a ray ended: from surfaces where ``si.valid``, from the
        environment where not (its direction is ``-si.wo``). A tensor of its own, which the caller may write to.
        """

    def pdf(self, p: Tensor, si: SurfaceInteraction) -> Tensor:
        """Density [n], seen from ``p``, with which :meth:`sample` draws the direction that ended at ``si``."""


class Integrator(Protocol):
    """Estimates the radiance that comes back along camera rays."""

    def __call__(self, rays: Rays, seed: int) -> Tensor:
        """One-sample estimate of the radiance [n, 3]."""


class PhotographedPixels(Protocol):
    """What single pixels of training photographs show."""

    def ignored(self) -> Tensor | None:
        """Pixels that masks leave out [views, pixels], bool; None where there is no mask."""
        return None

    def colors(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Photographed radiance [n, 3] of row-major pixels [n] of views [n], on the CPU, premultiplied by alpha."""

    def clipped(self, view: Tensor, pixel: Tensor) -> Tensor | None:
        """Whether values of row-major pixels [n] of views [n] are at their photograph's ceiling [n, 3], bool; None
        where no photograph has one.
        """
        return None


class PhotoSource(PhotographedPixels, Protocol):
    """Training photographs, as a fit sees them: facts about all of them, and batches of their pixels."""

    @property
    def has_alpha(self) -> bool:
        """Whether alpha is below 1 in some pixel of the photographs."""

    def dataset_stats(self, left_out: Tensor | None = None) -> DatasetStats:
        """Statistics of all pixels but those ``left_out`` [views, pixels], bool."""

    @property
    def has_photographs(self) -> bool:
        """Whether there are photographs at all."""
        return True

    def spread_fireflies(self, left_out: Tensor, beyond: Callable[[], Tensor] | None = None) -> float:
        """Spread single pixels that outshine all around them, if there is much light in them; part of the set-up.

        Args:
            left_out: pixels that take no part [views, pixels], bool.
            beyond: finds pixels that may show small lights indeed [views, pixels], bool; asked where there is much
                light in single pixels, and left out as well.

        Returns:
            Fraction of the light that was in them; 0 where the photographs stay as they are.
        """

    def request_blurred(self) -> None:
        """From now on every batch has ``blurred``. Part of the set-up, before the first batch."""

    def request_candidates(self, fraction: float, times: int) -> None:
        """From now on batches have fewer pixels drawn without replacement by ``fraction``, and ``times`` as many
        candidates for each that is missing. A source that ignores this has no candidates. Part of the set-up, before
        the first batch.
        """
        return

    def batch(self, iteration: int, rank: int = 0) -> PixelBatch:
        """The batch of an iteration in process ``rank``, on the CPU; the same one at every call."""

    def validation_batch(self) -> PixelBatch | None:
        """Pixels that no other batch draws, whose noise a fit cannot have learnt; None where all are drawn."""
        return None
