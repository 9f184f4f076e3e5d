"""Records that travel between the floors, and the conventions they follow.

Conventions
-----------
* ``wo`` points towards the viewer and ``wi`` is the direction integrated over (towards the light); both point away from
  the surface and have unit length. (Mitsuba names them the other way round.)
* Every pdf is in solid angle. An invalid lane has weight 0 and pdf 0, never NaN.
* Barycentrics follow Embree: ``p = (1 - u - v) p0 + u p1 + v p2``.
* ``n`` is the interpolated shading normal, ``ng`` the geometric one; neither is flipped towards the viewer.
* Radiance is linear scene radiance, lengths are scene units, tensors are float32 and indices int64 unless stated.
* Cameras look along -Z with +Y up and +X to the right (NeRF, Blender, OpenGL).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from neurad.core.parameters import BY_NAME, PARAMETERS, SurfaceParameter

FloatArray = npt.NDArray[np.float32]
Float64Array = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]
Bytes = npt.NDArray[np.uint8]
Array = npt.NDArray[Any]
"""Of any numbers."""


def _pick(values: Tensor, index: Tensor | slice) -> Tensor:
    """``values[index]``, at a third of its time where ``index`` names the lanes by number."""
    if isinstance(index, Tensor) and index.dtype == torch.int64 and index.dim() == 1:
        return values.index_select(0, index)
    return values[index]


def first_of(values: Tensor, count: int, of: int) -> Tensor:
    """The first ``count`` of every ``of`` rows; ``values`` itself if that is all of them."""
    return values if count == of else values.view(-1, of, *values.shape[1:])[:, :count].flatten(0, 1)


@dataclass(frozen=True)
class Lanes:
    """A record whose fields are tensors with one leading dimension, the lanes ``n``, or such records; others stay."""

    # dataclasses.fields would take longer to list them than a small tensor operation takes.

    def __len__(self) -> int:
        return int(getattr(self, next(iter(self.__dataclass_fields__))).shape[0])

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The record with every tensor passed through ``function``."""
        values = {name: getattr(self, name) for name in self.__dataclass_fields__}
        return type(self)(**{name: _mapped(x, function) for name, x in values.items()})

    def __getitem__(self, index: Tensor | slice) -> Self:
        """The lanes that a boolean mask ``[n]``, an index tensor or a slice selects."""
        return self.map(lambda x: _pick(x, index))

    def first(self, count: int, of: int) -> Self:
        """The first ``count`` of every ``of`` lanes."""
        return self.map(lambda x: first_of(x, count, of))

    def repeat(self, count: int) -> Self:
        """Every lane ``count`` times in a row: lane i becomes lanes i*count .. (i+1)*count - 1."""
        if count == 1:
            return self
        # expand: its backward is one sum, unlike repeat_interleave's
        return self.map(lambda x: x.unsqueeze(1).expand(-1, count, *x.shape[1:]).reshape(-1, *x.shape[1:]))

    def detach(self) -> Self:
        """These lanes without their autograd graph."""
        return self.map(Tensor.detach)

    def to(self, device: torch.device | str) -> Self:
        """These lanes on another device."""
        return self.map(lambda x: x.to(device))

    @classmethod
    def cat(cls, *parts: Self) -> Self:
        """The lanes of all parts, one after the other; a field is None in all of them or in none."""
        columns = {name: [getattr(p, name) for p in parts] for name in cls.__dataclass_fields__}
        return cls(**{name: _joined(x) for name, x in columns.items()})


def _mapped(x: Any, function: Callable[[Tensor], Tensor]) -> Any:
    return function(x) if isinstance(x, Tensor) else x.map(function) if isinstance(x, Lanes) else x


def _joined(parts: list[Any]) -> Any:
    first = parts[0]
    return first if first is None else torch.cat(parts) if isinstance(first, Tensor) else type(first).cat(*parts)


@dataclass(frozen=True)
class Flash(Lanes):
    """The flash of the photograph that each lane belongs to: a light that moves with the camera. Rays carry where it
    is, surface points also what of it they see.
    """

    position: Tensor
    """World place [n, 3]."""
    direction: Tensor
    """World direction in which a spot shines [n, 3]."""
    intensity: Tensor
    """Power per solid angle, of a spot along its axis [n, 3]; 0 in a photograph without a flash."""
    wi: Tensor | None = None
    """Unit direction towards it from a surface point [n, 3]."""
    arriving: Tensor | None = None
    """What its intensity is multiplied by to give the irradiance on a surface that faces it [n]: 0 where it is hidden,
    else the falloff of a spot over the squared distance."""


@dataclass(frozen=True)
class Rays(Lanes):
    """Rays, one a lane."""

    o: Tensor
    """Origins [n, 3]."""
    d: Tensor
    """Unit directions [n, 3]."""
    flash: Flash | None = None
    """That of their photographs, where these have one; rays of a camera alone carry it."""


@dataclass(frozen=True)
class Hit(Lanes):
    """Dense closest hits, one a ray, misses included. Carries no gradients."""

    t: Tensor
    """Distance along the ray [n]; infinity at a miss."""
    prim: Tensor
    """Triangle index [n], int64; -1 at a miss."""
    u: Tensor
    """First barycentric [n]; 0 at a miss."""
    v: Tensor
    """Second barycentric [n]; 0 at a miss."""
    valid: Tensor
    """True where a triangle was hit [n], bool."""


@dataclass(frozen=True)
class SurfaceInteraction(Lanes):
    """A surface point seen from a direction. Lanes that hit nothing have ``valid`` False and harmless values."""

    p: Tensor
    """Position [n, 3]."""
    ng: Tensor
    """Unit geometric normal, by the triangle's winding [n, 3]."""
    n: Tensor
    """Unit shading normal [n, 3]."""
    wo: Tensor
    """Unit direction towards the viewer [n, 3]."""
    uv: Tensor
    """Texture coordinates [n, 2]."""
    bary: Tensor
    """Barycentrics (u, v) in the triangle [n, 2]."""
    prim: Tensor
    """Triangle index [n], int64; -1 where nothing was hit."""
    valid: Tensor
    """True where there is a surface [n], bool."""
    flash: Flash | None = None
    """That of the photograph that the point belongs to, in a scene with one."""

    def where_hit(self, values: Tensor) -> Tensor:
        """``values`` [n, c], but 0 in lanes that hit nothing."""
        return values * self.valid.unsqueeze(-1)


@dataclass(frozen=True)
class Surface(Lanes):
    """The BSDF's parameters at the lanes of a SurfaceInteraction; these carry the gradients of the materials."""

    albedo: Tensor
    """Base colour in [0, 1], linear [n, 3]."""
    roughness: Tensor
    """Burley roughness in [0, 1] (alpha = roughness squared) [n, 1]."""
    model: Tensor | None = None
    """Index into ``Features.models`` [n], int64, of known materials that are not all of one model; None where all lanes
    have the model that fitted surfaces have."""
    specular_fraction: Tensor | None = None
    """Probability of the specular lobe where samples are drawn [n, 1], for models that have one to choose; None for the
    model's own."""
    metallic: Tensor | None = None
    """How much of a metal it is, in [0, 1] [n, 1]; None in a scene without metal."""
    lambert: Tensor | None = None
    """Part that has Lambert's lobe while that is being found, the same in all lanes [n, 1]; None for the
    model's own."""

    @property
    def parameters(self) -> dict[str, Tensor]:
        """What materials gave, by the names in :mod:`neurad.core.parameters`; what the scene lacks is left out."""
        values = {parameter.name: getattr(self, parameter.name) for parameter in PARAMETERS}
        return {name: value for name, value in values.items() if value is not None}

    def stacked(self, parameters: Sequence[SurfaceParameter]) -> Tensor:
        """Some of the parameters, one after the other [n, channels]."""
        return torch.cat([getattr(self, parameter.name).expand(len(self), -1) for parameter in parameters], -1)

    @property
    def scalars(self) -> list[Tensor]:
        """What lobes are differentiated by [n, 1]: the roughness, the part of Lambert's lobe while it is being found,
        and other parameters of one channel.
        """
        first, *others = (value for name, value in self.parameters.items() if BY_NAME[name].channels == 1)
        return [first, *([] if self.lambert is None else [self.lambert]), *others]


@dataclass(frozen=True)
class BSDFSample(Lanes):
    """A direction drawn from a BSDF, in the local frame of the lane."""

    wi: Tensor
    """Sampled direction, local [n, 3]."""
    pdf: Tensor
    """Solid-angle density of ``wi`` [n]; 0 where the sample is invalid."""
    weight: Tensor
    """f * cos(wi) / pdf [n, 3]; 0 where the sample is invalid."""

    @classmethod
    def of(cls, wi: Tensor, value: Tensor, pdf: Tensor) -> Self:
        """A sample of known value f * cos(wi) [n, 3] and density [n]."""
        inverse = torch.where(pdf > 0, 1.0 / pdf, 0.0)  # not value / tiny: its gradient would overflow
        return cls(wi, pdf, value * inverse.unsqueeze(-1))


@dataclass(frozen=True)
class EmitterSample(Lanes):
    """A direction towards light, drawn by an emitter for a reference point."""

    wi: Tensor
    """Unit direction towards the light, world [n, 3]."""
    distance: Tensor
    """Distance to the sampled point [n]; infinity for an environment."""
    radiance: Tensor
    """Emitted radiance towards the reference point, not divided by the pdf [n, 3]."""
    pdf: Tensor
    """Solid-angle density of ``wi`` [n]; 0 where no light can come from there. Of a light without extent: the
    probability with which it was chosen."""
    is_delta: Tensor | None = None
    """Whether the light has no extent, so that no other technique finds it and its MIS weight is 1 [n], bool; None
    where there is no such light. ``radiance`` is then the irradiance on a surface that faces it."""


@dataclass(frozen=True)
class PixelBatch(Lanes):
    """Photographed pixels, one a lane: what a training step compares with."""

    view: Tensor
    """Index of the training view [b], int64."""
    pixel: Tensor
    """Row-major pixel index, y * width + x [b], int64."""
    color: Tensor
    """Photographed linear radiance, premultiplied by alpha [b, 3]."""
    alpha: Tensor
    """Coverage in [0, 1]; ones for images without alpha [b]."""
    iteration: int
    """The iteration that this batch belongs to."""
    blurred: Tensor | None = None
    """Mean photographed radiance of the 5 x 5 pixels around [b, 3]; None unless requested from the source."""
    candidates: int = 0
    """The last so many pixels are uniform draws of which the step keeps some; 0 where it takes all pixels."""
    weight: Tensor | None = None
    """What each pixel counts for, so that means over the batch are unbiased [b]; None where all count 1."""
    highlight: Tensor | None = None
    """How much of the pixel's worth lies in highlights, in [0, 1): more of its samples follow the specular lobe [b]."""
    clipped: Tensor | None = None
    """Whether a value is at its photograph's ceiling, so that the radiance is this or more [b, 3], bool; None where no
    photograph has a ceiling."""
    variance: Tensor | None = None
    """Variance of the values by spread or rounding, in squared radiance units [b, 3]; None where it is not known."""

    def to(self, device: torch.device | str) -> PixelBatch:
        """The batch on a device; to a GPU it is copied while the host goes on."""
        if torch.device(device).type == "cuda":
            return self.map(lambda x: (x if x.is_cuda else x.pin_memory()).to(device, non_blocking=True))
        return super().to(device)

    def clone(self) -> PixelBatch:
        """The batch in memory of its own."""
        return self.map(Tensor.clone)

    def shapes(self) -> tuple[Any, ...]:
        """What batches that can be copied to each other have in common."""
        given = (getattr(self, f.name) for f in fields(self))
        return (self.candidates, *((x.shape, x.dtype) if isinstance(x, Tensor) else None for x in given))

    def copy_(self, other: PixelBatch, where: Tensor | None = None) -> None:
        """Take the values of a batch of the same :meth:`shapes` if ``where`` [] is True; the iteration stays."""
        for f in fields(self):
            own, new = getattr(self, f.name), getattr(other, f.name)
            if isinstance(own, Tensor):
                own.copy_(new if where is None else torch.where(where, new, own))

    def without_candidates(self) -> PixelBatch:
        """The batch without its candidates."""
        if self.candidates == 0:
            return self
        return replace(self[: len(self) - self.candidates], candidates=0)


@dataclass(frozen=True)
class DatasetStats:
    """Statistics of all training photographs."""

    mean_square_radiance: float
    """Mean squared radiance of the pixels that count; 0 where none does."""
    sample: PixelBatch
    """Random pixels that count, drawn from all views alike."""
    foreground: list[int]
    """Views that have any pixel with alpha above 0, in order."""
    checksums: tuple[int, ...] = ()
    """CRC-32 of each photograph, by which a changed one is found; none where they cannot change."""
    pixels: int = 0
    """How many count; 0 where that is not known."""
    covered: tuple[int, ...] = ()
    """Views whose alpha is 1 everywhere, where it is not so in all."""

    @property
    def brightest(self) -> float:
        """Largest value of the sample; 0 where it is empty."""
        return float(self.sample.color.max()) if len(self.sample.color) else 0.0
