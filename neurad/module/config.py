"""Settings of an inverse rendering run, as they stand in YAML."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Sampling:
    """How many random decisions a training pixel gets."""

    positions: int = 2
    """Independent positions in every pixel of a batch; leave-one-out needs at least 2."""
    secondary: int = 4
    """Samples of the transport operator at every position: as many emitter as BSDF samples."""
    cached: int = 4
    """Stratified positions in each pixel whose camera ray is traced once, at the start of a run."""
    second_hits: float = 0.5
    """Share of the positions at which the prior is also taken at the second hit; 0 leaves it out."""


@dataclass(frozen=True)
class Objective:
    """Terms of the loss and the form of their gradients."""

    estimator: Literal["leave_one_out", "two_pass"] = "leave_one_out"
    """Unbiased photometric gradient: in one pass, or with a second rendering as in the paper."""
    normaliser: Literal["photograph", "prediction"] = "prediction"
    """What the photometric term is relative to: noisy photographs, or the field's own noise-free prediction."""
    prior: float = 1.0
    """Weight of the radiometric prior; 0 leaves it out."""
    prior_gradient: Literal["semi", "full"] = "semi"
    """Gradient of the prior through its left side only, or through both sides."""
    lhs: float = 1.0
    """Weight of the radiance field's own photometric term; 0 leaves it out."""
    epsilon: float = 0.01
    """Floor of the relative losses, in units of the mean squared training radiance."""
    roughness_pull: float = 0.0
    """Weight of a mild quadratic pull of roughness towards its mean, for surfaces whose highlight nobody sees; 0 leaves
    it out."""


@dataclass(frozen=True)
class Optimization:
    """Learning rates of the three optimizers and the schedule that they share."""

    albedo: float = 5e-3
    roughness: float = 5e-3
    radiance: float = 5e-3
    schedule: Literal["constant", "cosine"] = "cosine"
    """Cosine decay over the run: by iterations (``max_steps``) or time (``max_time``), whichever ends first."""
    warmup: int = 20
    """Iterations over which the rates rise from zero."""
    final: float = 0.02
    """Share of the rates left at the end of the cosine."""
