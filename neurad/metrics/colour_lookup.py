"""What a plain lookup says of roughness, given the true colours: the mark that a roughness that is measured must pass.

In many rooms, made ones above all, one colour is one material. There a table from colour to roughness scores well
without a highlight ever being looked at, and so does every field that reads the albedo. The table's score says how much
of a result may come from there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from neurad.core.records import Float64Array, FloatArray

BINS = (24, 12, 6, 3, 1)
"""Bins along the square root of each channel, the finest table first; what is empty there is looked up in the next."""
MAX_VIEWS = 8
"""Training views whose true maps are read for it."""


@dataclass(frozen=True)
class ColourLookup:
    """Means of roughness by bins of colour."""

    tables: tuple[Float64Array, ...]
    """One a size of :data:`BINS`, [size^3] each; NaN where no pixel has such a colour."""

    @classmethod
    def of(cls, pairs: Iterable[tuple[FloatArray, FloatArray]]) -> ColourLookup | None:
        """The lookup of some pixels.

        Args:
            pairs: albedo [n, 3], in [0, 1], and roughness [n] of the same pixels; any number of such pairs.

        Returns:
            None without a pixel.
        """
        sums = [np.zeros((2, size**3)) for size in BINS]
        for albedo, roughness in pairs:
            for size, (total, count) in zip(BINS, sums, strict=True):
                index = _bin(albedo, size)
                total += np.bincount(index, roughness, size**3)
                count += np.bincount(index, minlength=size**3)
        if sums[-1][1, 0] == 0:
            return None
        return cls(tuple(np.divide(t, n, out=np.full_like(t, np.nan), where=n > 0) for t, n in sums))

    def __call__(self, albedo: FloatArray) -> FloatArray:
        """Roughness [..., 1] for colours [..., 3]."""
        flat = albedo.reshape(-1, 3)
        found = np.full(len(flat), np.nan)
        for size, table in zip(BINS, self.tables, strict=True):
            left = np.flatnonzero(np.isnan(found))
            found[left] = table[_bin(flat[left], size)]
        return found.reshape(*albedo.shape[:-1], 1).astype(np.float32)


def explained(psnr: float, psnr_constant: float) -> float:
    """R2 of a prediction: the fraction of the truth's variance that it explains, from its PSNR in dB and that of the
    best constant over the same pixels; NaN where the truth has no variance.
    """
    return 1.0 - 10.0 ** ((psnr_constant - psnr) / 10.0) if np.isfinite(psnr_constant) else np.nan


def _bin(albedo: FloatArray, size: int) -> np.ndarray:
    """Bins [n] of colours [n, 3]."""
    level = np.minimum((np.sqrt(np.clip(albedo, 0.0, 1.0)) * size).astype(np.int64), size - 1)
    return (level[:, 0] * size + level[:, 1]) * size + level[:, 2]
