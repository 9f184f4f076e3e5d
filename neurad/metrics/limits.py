"""What recovered materials look like as a whole: signs of light that is not what it is taken for."""

from collections.abc import Mapping, Sequence

import numpy as np

from neurad.core.records import BoolArray, FloatArray

NEAR = 0.01
"""Distance from 0 and from 1 that is no distance."""
MUCH = 0.05
"""Fraction at the upper limit from which it is said what that may mean."""


def albedo_at_limits(maps: Sequence[Mapping[str, FloatArray]], counted: Sequence[BoolArray]) -> dict[str, float]:
    """Fractions of albedo's channel values on counted pixels that lie below 0.01, ``albedo_at_0``, and above 0.99,
    ``albedo_at_1``; none without any pixel.
    """
    found = _counted(maps, counted, "albedo")
    if len(found) == 0:
        return {}
    return {"albedo_at_0": float((found < NEAR).mean()), "albedo_at_1": float((found > 1.0 - NEAR).mean())}


def roughness_spread(maps: Sequence[Mapping[str, FloatArray]], counted: Sequence[BoolArray]) -> dict[str, float]:
    """Mean of the roughness on counted pixels, ``roughness_mean``, and its standard deviation, ``roughness_spread``;
    none without any pixel. While light is wrong, surfaces turn glossy or matt for it, all alike.
    """
    found = _counted(maps, counted, "roughness").astype(np.float64)
    if len(found) == 0:
        return {}
    return {"roughness_mean": float(found.mean()), "roughness_spread": float(found.std())}


def _counted(maps: Sequence[Mapping[str, FloatArray]], counted: Sequence[BoolArray], name: str) -> FloatArray:
    """All channel values on counted pixels."""
    values = [entry[name][mask].reshape(-1) for entry, mask in zip(maps, counted, strict=True) if name in entry]
    return np.concatenate([np.zeros(0, np.float32), *values])


def sentence_of_roughness(scores: Mapping[str, float]) -> str:
    """What the end of a fit with unknown light says about it; nothing otherwise."""
    if "roughness_mean" not in scores:
        return ""
    return f"roughness found: {scores['roughness_mean']:.3f} on average, spread {scores['roughness_spread']:.3f}"


def sentence_of_limits(scores: Mapping[str, float]) -> str:
    """What the end of a fit says about it; nothing where nothing was recovered."""
    if "albedo_at_1" not in scores:
        return ""
    low, high = 100.0 * scores["albedo_at_0"], 100.0 * scores["albedo_at_1"]
    said = f"albedo at its limits: {low:.1f} % below 0.01, {high:.1f} % above 0.99"
    if scores["albedo_at_1"] < MUCH:
        return said
    return f"{said}; so much white may mean that lights are brighter than they are taken for"
