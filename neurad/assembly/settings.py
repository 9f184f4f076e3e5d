"""Settings of an inverse rendering run, as they stand in YAML. What the help reads imports neither torch nor Lightning,
which take seconds; the method, which does, is added by :mod:`neurad.assembly.model_settings`.
"""

from __future__ import annotations  # the parser then takes a number for a number, whatever its range

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from neurad.core.errors import InputError
from neurad.core.ranges import (
    INTERNAL,
    Checked,
    Count,
    CountOrZero,
    Fraction,
    NonNegative,
    OpenFraction,
    Positive,
    PositiveFraction,
    Range,
)
from neurad.fields.settings import AlbedoConfig, RadianceConfig, RoughnessConfig

FINEST_DENSE = 1023
"""Largest number of cells along a side of a dense grid."""


@dataclass(frozen=True)
class Sampling(Checked):
    """How many samples a training pixel gets, and where they go."""

    spp: Annotated[int, Range(1, 1 << 16)] = 2
    """Samples per pixel of a batch: camera rays at independent positions; leave-one-out needs at least 2."""
    samples_per_vertex: Annotated[int, Range(1, 1 << 16)] = 4
    """Samples of the transport operator at the first hit of each: as many emitter as BSDF samples."""
    cached_spp: Annotated[int, Range(0, 1 << 16)] = 4
    """Camera rays per pixel, at stratified positions, that are traced once at the start of a run; each step draws its
    ``spp`` from them. Memory: 12 bytes for each, so 16 of 50 photographs of a megapixel take 9.6 GB. 0 keeps none and
    traces new camera rays, at uniformly random positions, in each step: for large sets of photographs."""
    specular_fraction: OpenFraction = 0.25
    """Fraction of the BSDF samples that the specular lobe draws. Half of them, as in Mitsuba, is more than roughness
    needs and leaves fewer for albedo."""
    guide: Annotated[int, Range(0, 32)] = 16
    """Cells along the scene's longest side of the histogram of incident indirect light by which BSDF samples are
    drawn; 0 samples by the BSDF alone. In memory and in checkpoints it takes 4.6 KB a cell, 19 MB for 16 cells in a
    cubic scene. Diffuse scenes have none."""
    field_fraction: PositiveFraction = 1.0
    """Fraction of the samples, but no fewer than two per pixel, at whose first hits the radiance field is trained.
    First hits of one pixel lie close together, so few of them train the field as well as all, and its gradient is the
    most expensive part of a step."""
    extra_bounce_fraction: Fraction = 0.5
    """Fraction of the samples at which the prior is also taken at the hit of one more bounce; 0 leaves it out."""
    sample_groups: Annotated[int, Range(2, 1 << 16)] = 4
    """Groups of a pixel's samples: within a group samples are stratified, which leaves less noise, and groups are
    independent of each other, which unbiased gradients need. Where it does not divide ``spp``, every sample is a group
    of its own."""

    focus: Annotated[float, Range(0.0, 0.9)] = 0.0
    """Fraction of a batch's pixels that are drawn where the photometric gradient by roughness is large, highlights
    above all; the others are drawn without replacement, as all are with 0 or a ``data.patch_size`` above 1. Weights
    keep every mean, and more of the samples there follow the specular lobe."""

    @property
    def groups(self) -> int:
        """Independent groups of samples in a pixel."""
        return self.sample_groups if self.spp % self.sample_groups == 0 else self.spp


@dataclass(frozen=True)
class Objective(Checked):
    """Terms of the loss and the form of their gradients."""

    estimator: Literal["leave_one_out", "two_pass"] = "leave_one_out"
    """Unbiased photometric gradient: in one pass, or with a second rendering as in the paper."""
    normaliser: Literal["photograph", "blurred", "prediction"] = "prediction"
    """What the photometric term is relative to: noisy photographs, their mean over 5 x 5 pixels, or the field's own
    noise-free prediction. A method without a field takes ``blurred`` for ``prediction``."""
    prior: NonNegative = 1.0
    """Weight of the radiometric prior; 0 leaves it out."""
    prior_gradient: Literal["semi", "full"] = "semi"
    """Gradient of the prior through its left side only, or through both sides."""
    prior_trains: Literal["field", "both"] = "field"
    """Whether the prior moves the radiance field alone, or the materials too (worse: an ablation of the paper)."""
    lhs: NonNegative = 1.0
    """Weight of the radiance field's own photometric term; 0 leaves it out."""
    epsilon: Positive = 0.01
    """Floor of the relative losses, in units of the mean squared training radiance."""
    chroma_weight: Positive = 1.0
    """By how much more the colour channels' differences count than what they share, relative to the normaliser, in the
    terms that compare with photographs; 1 as in the paper. Noise of path-traced light is nearly grey."""
    fireflies: Literal["keep", "spread"] = "keep"
    """``spread`` lets pixels of the photographs that are more than twice as bright as all around them give what is
    beyond that to the pixels around, if more than 2 % of all light is in such pixels; otherwise photographs stay as
    they are. No light is lost. Pixels that show sky, glass or mirrors, where small lights may be, keep theirs."""


@dataclass(frozen=True)
class Lighting(Checked):
    """What is known of the light."""

    environment: Literal["known", "fit"] = "known"
    """``fit`` recovers the environment map; of the one in the scene only ``to_world`` is used then, and its pixels are
    what the result is scored against."""
    emitters: Literal["known", "photographs", "fit", "find"] = "known"
    """What is known of area lights: ``known`` takes the radiance in the scene; ``photographs`` that which the training
    photographs show of each lamp, less what it reflects, or of one that all clip what it lights says; ``fit`` goes on
    from there, also of a lamp that no photograph shows, and lets an optimizer find the radiance together with all else;
    ``find`` does the same for the meshes that the photographs show to shine, whatever the scene says of them."""
    flash: Literal["known", "fit"] = "known"
    """What is known of the power of a light that moves with the camera: ``fit`` begins with what the camera file says
    and finds a factor of it, the same in all photographs, one for each colour."""
    lamps: list[list[float]] | None = None
    """Lamps given to ``find``: a point on each, ``[x, y, z]``, whose patch of like brightness shines then, or a
    box around it, ``[x, y, z, x, y, z]``, all triangles in which do; in the coordinates of the scene's file."""
    split_lamps: bool = False
    """Whether each connected part of a lamp's mesh is a lamp by itself, as the bulbs of a chandelier are that differ;
    where radiance is recovered."""
    lamp_mismatch: Literal["refuse", "warn"] = "refuse"
    """What happens if photographs show a lamp more than three times brighter or darker than the scene says: the fit is
    refused before it begins, or goes on with a warning. From a factor of 1.2 on there is a warning in any case."""

    def __post_init__(self) -> None:
        """Refuse what does not go together."""
        super().__post_init__()
        if self.lamps and self.emitters != "find":
            raise InputError("model.lighting.lamps: it tells where lamps are to be found, so choose emitters find, too")
        if any(len(place) not in (3, 6) or not all(map(math.isfinite, place)) for place in self.lamps or []):
            raise InputError("model.lighting.lamps: give three numbers for a point, or six for two corners of a box")
        if self.split_lamps and self.emitters == "known":
            raise InputError(
                "model.lighting.split_lamps: it splits lamps whose radiance is recovered, so choose "
                "model.lighting.emitters photographs, fit or find, too"
            )

    @property
    def fits_lamps(self) -> bool:
        """Whether an optimizer moves the radiance of lamps."""
        return self.emitters in ("fit", "find")


@dataclass(frozen=True)
class Metallic(Checked):
    """Which surfaces are metals."""

    recover: Literal["auto", "none", "fit"] = "none"
    """``none`` keeps what the scene's files say of it; ``fit`` finds it in the photographs, by a look at some pixels
    halfway through the fit, whatever files say; ``auto`` keeps what files say where they name a metal, and otherwise
    looks at a quarter as many pixels, a hundredth of the fit's time."""


@dataclass(frozen=True)
class Optimization(Checked):
    """Learning rates of the optimizers and the schedule that they share."""

    albedo: NonNegative = 5e-3
    """Learning rate of the albedo field; 0 leaves it as it begins."""
    roughness: NonNegative = 5e-3
    """Learning rate of the roughness field."""
    roughness_decay: NonNegative = 0.0
    """Weight decay (AdamW's) of the table that roughness's network reads; 0 is none. Where photographs say little about
    roughness, noise writes patterns into the table that nothing else takes out again."""
    batch: Count | None = None
    """Pixels of a batch that the rate of roughness is meant for; that of a run follows its own batch, by the square
    root rule, and stands in its config.yaml with it. null: it stays as it is."""
    radiance: NonNegative = 5e-3
    """Learning rate of the radiance field."""
    light: NonNegative = 1e-2
    """Learning rate of what is recovered of the light: of the logarithms of an environment map's texels, of the
    radiance of lamps and of the power of a flash."""
    schedule: Literal["constant", "cosine"] = "cosine"
    """``cosine`` lets the rates rise from zero over 20 iterations and fall along half a cosine over the run: by
    iterations (``max_steps``) or time (``max_time``), whichever ends first."""
    roughness_warmup: CountOrZero = 0
    """Iterations over which the rate of roughness rises from zero, counted from the first in which it is learnt."""
    average: Fraction = 0.0
    """Evaluations and results show materials averaged over this fraction of the iterations so far, which takes out the
    noise that high learning rates leave; 0 shows the present ones."""
    matmul: Literal["highest", "high"] = "highest"
    """Products inside the networks while they train: ``highest`` is float32, ``high`` allows TF32 on GPUs that have it.
    Weights and all else stay float32, and so do evaluations."""
    cuda_graph: bool = True
    """Replay training steps as CUDA graphs where that can be done; on a CPU it changes nothing."""

    def __post_init__(self) -> None:
        """Refuse what does not exist."""
        super().__post_init__()
        if self.roughness * self.roughness_decay >= 1.0:
            raise InputError("model.optimization.roughness_decay: times the rate of roughness it must stay below 1")


@dataclass(frozen=True)
class RecoverySettings(Checked):
    """What is recovered, and how.

    All settings under ``model`` but the method.
    """

    albedo: AlbedoConfig
    """Size of the albedo field."""
    roughness: RoughnessConfig
    """Size of the roughness field."""
    radiance: RadianceConfig
    """Size and inputs of the radiance field; a method without one leaves it out."""
    metallic: Metallic = Metallic()
    """How it is found which surfaces are metals."""
    sampling: Sampling = Sampling()
    objective: Objective = Objective()
    optimization: Optimization = Optimization()
    tracer: str = "auto"
    """What casts rays: ``embree``, ``open3d`` or ``warp``; ``auto`` takes Warp on a GPU and Embree on a CPU."""
    seed: int = field(default=0, metadata=INTERNAL)
    """Of every random decision of the training: the run's ``seed_everything``."""
    lighting: Lighting = Lighting()
    materials: Literal["fit", "known"] = "fit"
    """``fit`` recovers albedo and roughness, ``known`` takes the scene's own and trains no material."""
    diffuse_lobe: Literal["auto", "files", "burley", "lambert"] = "auto"
    """The lobe under the coat of surfaces that are not Lambertian: ``burley`` as in Mitsuba, bright where rough
    surfaces are seen at grazing angles, or ``lambert`` as in Blender's Cycles and in glTF; ``files`` takes what
    the scene's files have, and ``auto`` lets photographs decide in the first part of a fit."""

    def __post_init__(self) -> None:
        """Refuse what does not exist, and dense grids that no memory holds."""
        super().__post_init__()
        for name, size in (("albedo", self.albedo), ("roughness", self.roughness), ("radiance", self.radiance)):
            finest = size.grid.finest
            if size.kind == "dense" and (finest is None or finest > FINEST_DENSE):
                raise InputError(
                    f"model.{name}.grid.finest: {'null' if finest is None else finest} is out of range for a dense "
                    f"grid, give at most {FINEST_DENSE}, which takes 39 GB for three channels"
                )


@dataclass(frozen=True)
class EvaluationSettings(Checked):
    """Scores and pictures of held-out views."""

    fraction: NonNegative = 0.1
    """Largest fraction of the training time that evaluations during the fit may take."""
    every_n_steps: Count | None = None
    """Evaluate at multiples of this many iterations instead, whatever it costs."""
    spp: Count = 4
    """Samples per pixel of the renderings scored during ``fit`` and ``validate``."""
    test_spp: Count = 64
    """Samples per pixel of the renderings that ``test`` and ``predict`` write."""
