"""Fisher information about roughness with the albedo profiled out (the Schur complement).

A pixel's colour changes by ``D da + R dr`` with its albedo ``a`` and roughness ``r``. Over the pixels of a small patch
of surface, whose albedo nobody knows either, what they say of the roughness is, summed over the colour channels,

    F = sum R^2 w - (sum D R w)^2 / sum D^2 w,                     w = 1 / variance of a pixel,

the Schur complement of the albedo's block. A sheen that is the same from everywhere has R proportional to D: F is 0, as
another albedo explains it just as well. Only a change of R over D, of a highlight with the view, is knowledge.

Every square here is a product of two independent halves of samples. The mean of such a product is that of what the
samples estimate, while the square of an estimate has the variance of its noise on top, which would pass for
information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from neurad.core.records import Float64Array, IntArray

FLOOR = 0.05
"""Added to ``sum D^2 w`` of a patch, in pixels of relative brightness 1: keeps dark patches from dividing noise."""


@dataclass(frozen=True)
class Profiled:
    """What is left of residuals and derivatives by roughness once the albedo of every patch is free [2, n, c]."""

    by_roughness: Float64Array
    residual: Float64Array

    def information(self) -> Float64Array:
        """Parts of F that the pixels add to their patch [n], in units of ``w``; single ones may be negative."""
        return np.asarray((self.by_roughness[0] * self.by_roughness[1]).sum(-1))

    def gradient(self) -> Float64Array:
        """Parts of ``sum R (photograph - estimate) w`` [n]: over F, the change of roughness that pixels ask for."""
        first, second = self.by_roughness[0] * self.residual[1], self.by_roughness[1] * self.residual[0]
        return np.asarray(0.5 * (first + second).sum(-1))


def profile(
    by_albedo: Float64Array, by_roughness: Float64Array, residual: Float64Array, patch: IntArray, patches: int
) -> Profiled:
    """Take the part of ``by_roughness`` and ``residual`` out that some albedo of the patch explains.

    Of each half's values the part is found with the other half's ``by_albedo``, so that products of the two halves stay
    free of their noise: summed over a patch they are ``sum R1 R2 - sum R1 D2 sum R2 D1 / sum D1 D2``.

    Args:
        by_albedo: D of both halves, times the root of ``w`` [2, n, c].
        by_roughness: R of both halves, in the same unit [2, n, c].
        residual: of both halves, in the same unit [2, n, c].
        patch: that each pixel lies in, from 0 [n].
        patches: how many there are.
    """
    square = per_patch(by_albedo[0] * by_albedo[1], patch, patches).clip(0.0) + FLOOR  # [patches, c]

    def free(values: Float64Array) -> Float64Array:
        parts = []
        for half in range(2):
            slope = per_patch(values[half] * by_albedo[1 - half], patch, patches) / square  # [patches, c]
            parts.append(values[half] - slope[patch] * by_albedo[half])
        return np.stack(parts)

    return Profiled(free(by_roughness), free(residual))


def per_patch(values: Float64Array, patch: IntArray, patches: int) -> Float64Array:
    """Sums of ``values`` [n, c] over the pixels of each patch [patches, c]."""
    return np.stack([np.bincount(patch, column, patches) for column in values.T], -1)
