"""Scores in decibels as words: what has no error at all has infinitely many, and is called exact."""

import math

EXACT = "exact"
FINEST = 58.9
"""PSNR of values that differ from the truth by rounding to 8 bits alone, 1 / 255 / sqrt(12)."""


def figure(score: float, digits: int = 2) -> str:
    """A score without its unit, for the cell of a table."""
    return EXACT if score == math.inf else f"{score:.{digits}f}"


def decibels(score: float, digits: int = 2) -> str:
    """A score with its unit, for a sentence."""
    return EXACT if score == math.inf else f"{score:.{digits}f} dB"


def as_json(value: float) -> float | str | None:
    """A number as JSON can hold it, which knows neither infinity nor NaN."""
    return float(value) if math.isfinite(value) else EXACT if value == math.inf else None


def parsed(text: str) -> float:
    """The number that the cell of a table stands for.

    Raises:
        ValueError: it is none.
    """
    return math.inf if text == EXACT else float(text)
