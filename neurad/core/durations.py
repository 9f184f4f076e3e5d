"""Times as people write them: ``60s``, ``4m``, ``1h30m``, ``00:00:04:00``."""

import math
import re

from neurad.core.errors import InputError
from neurad.core.ranges import shown

UNITS = {"d": 86400, "h": 3600, "m": 60, "min": 60, "s": 1}
"""Seconds of a unit."""
FORMS = "60s, 4m, 1h30m or DD:HH:MM:SS"
"""How a time may be written, for sentences."""
_NUMBER = r"\d+(?:\.\d+)?"
_PARTS = re.compile(rf"(?:{_NUMBER}\s*(?:d|h|min|m|s)\s*)+")
_PART = re.compile(rf"({_NUMBER})\s*(d|h|min|m|s)")
_CLOCK = re.compile(r"\d+(?::\d+){1,3}")


def seconds_of(text: str) -> float:
    """Seconds of a time: a number is seconds; with units, of which each is a number followed by d, h, m, min or s, the
    sum; with colons DD:HH:MM:SS, of which those at the left may be missing.

    Raises:
        InputError: the text is no time; the sentence has no name of an option.
    """
    words = text.strip().lower()
    if _PARTS.fullmatch(words):
        return math.fsum(float(number) * UNITS[unit] for number, unit in _PART.findall(words))
    if _CLOCK.fullmatch(words):
        parts = [int(part[:15]) for part in words.split(":")]
        return float(sum(unit * part for unit, part in zip((1, 60, 3600, 86400), reversed(parts), strict=False)))
    try:
        return float(words)
    except ValueError:
        raise InputError(f"{shown(text)} is not a time, such as {FORMS}") from None


def has_unit(text: str) -> bool:
    """Whether a text is a time with units, such as ``4m``."""
    return _PARTS.fullmatch(text.strip().lower()) is not None


def clock(seconds: float) -> str:
    """Whole seconds as ``m:ss`` or ``h:mm:ss``; never less than 0:00."""
    whole = max(int(seconds), 0)
    hours, rest = divmod(whole, 3600)
    return f"{hours}:{rest // 60:02d}:{rest % 60:02d}" if hours else f"{rest // 60}:{rest % 60:02d}"


def short(seconds: float) -> str:
    """A time in one or two units, as one would type it: ``45s``, ``4m``, ``1h30m``."""
    whole = max(round(seconds), 0)
    parts = [(whole // 86400, "d"), (whole // 3600 % 24, "h"), (whole // 60 % 60, "m"), (whole % 60, "s")]
    return "".join(f"{count}{unit}" for count, unit in parts if count) or "0s"
