"""How the photographs of a folder become radiance: what its files say, what ``--data`` says, and what was taken."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neurad.core.errors import InputError
from neurad.core.ranges import Ceiling, checked
from neurad.core.scene_records import View
from neurad.images.image_io import opened
from neurad.images.photographs import CODED, colour_profile, format_of, largest_code
from neurad.images.response import FIT, check_response
from neurad.runtime.reading import listed, native, regular_file

JPEG_CEILING = 250.0 / 255.0
"""Compression moves what is clipped by some codes, so that of JPEG files begins below the largest."""
_EXIF, _TIME, _APERTURE, _SPEED = 0x8769, 0x829A, 0x829D, 0x8827


@dataclass(frozen=True)
class Photography:
    """What is known of how the room was captured."""

    response: str | None = None
    """Curve of photographs of codes (PNG, JPEG, TIFF): ``linear``, ``srgb``, ``gamma=G``, a file with codes and linear
    values, or ``fit``, which recovers one; None takes sRGB's and says so."""
    ceiling: Ceiling | None = None
    """Value from which on a photograph is clipped: of codes a fraction of the largest, of EXR and Radiance pictures the
    value itself. None takes what the format says."""
    exposure: Literal["known", "fit"] = "known"
    """``fit`` recovers a gain for each photograph, beginning at what is known."""
    white_balance: Literal["known", "fit"] = "known"
    """``fit`` recovers a gain for each colour of each photograph."""
    poses: Literal["fixed", "refine"] = "fixed"
    """``refine`` moves the cameras of training photographs before a fit, see :mod:`neurad.evidence.pose_fit`."""
    mesh: Literal["fixed", "refine"] = "fixed"
    """``refine`` flattens the planes of a scan, see :mod:`neurad.scene.flatten`."""

    def __post_init__(self) -> None:
        """Refuse what does not exist."""
        checked(self)
        if self.response is not None:
            check_response(self.response)

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Photography:
        """What the settings under ``data`` of a run say."""
        return cls(**{f.name: data[f.name] for f in fields(cls) if data.get(f.name) is not None})

    @property
    def fits_gains(self) -> bool:
        """Whether some gain of a photograph is to be recovered."""
        return "fit" in (self.exposure, self.white_balance)


KNOWN = Photography()


def developed(
    train: Sequence[View], test: Sequence[View], settings: Photography
) -> tuple[list[View], list[View], tuple[str, ...]]:
    """Views that say how their photographs become radiance, and a sentence on each thing that was decided.

    Args:
        train: views to learn from; exposures that their camera file has stand in them.

    Raises:
        InputError: some views lack the exposure that others have, or a setting is about photographs that there are not.
    """
    views = [_with_format(view, settings) for view in (*train, *test)]
    notes = _of_codes(views, settings)
    views, said = _with_exposures(views, len(train), settings)
    return views[: len(train)], views[len(train) :], (*notes, *said)


def _with_format(view: View, settings: Photography) -> View:
    if view.image is None:
        return view
    path = Path(view.image)
    made = replace(view.development, ceiling=settings.ceiling)
    if path.suffix.lower() in CODED:
        made = replace(
            made,
            response=settings.response or "srgb",
            levels=largest_code(path),
            ceiling=usual_ceiling(path) if settings.ceiling is None else min(settings.ceiling, 1.0),
        )
    return replace(view, development=made)


def usual_ceiling(path: Path) -> float:
    """Fraction of the largest code from which on a photograph's format is clipped."""
    return JPEG_CEILING if path.suffix.lower() in CODED and format_of(path) == "JPEG" else 1.0


def _of_codes(views: Sequence[View], settings: Photography) -> list[str]:
    coded = [view for view in views if view.development.levels]
    if not coded:
        if settings.response is not None:
            raise InputError(
                f"--data.response {settings.response}: no photograph has codes, EXR and Radiance pictures are linear"
            )
        return []
    kinds = Counter((format_of(Path(str(view.image))), view.development.levels) for view in coded)
    listed = ", ".join(
        f"{number} {kind} of {8 if levels == 255 else 16} bits" for (kind, levels), number in kinds.items()
    )
    curve = {
        None: "sRGB's curve is undone, as nothing else is said (--data.response)",
        "srgb": "sRGB's curve is undone",
        "linear": "they are linear, as --data.response says",
        FIT: "their response is recovered, beginning at sRGB's curve",
    }.get(settings.response, f"the response {settings.response} is undone")
    ceilings = sorted({round(float(view.development.ceiling or 1.0) * view.development.levels) for view in coded})
    codes = " or ".join(str(code) for code in ceilings)
    notes = [f"photographs: {listed}: {curve}; from code {codes} on they are clipped (--data.ceiling)"]
    if said := sentence_of_profiles([Path(str(view.image)) for view in coded]):
        notes.append(f"warning: {said}")
    return notes


def sentence_of_profiles(files: Sequence[Path]) -> str | None:
    """What is wrong with photographs whose colour profile is another than sRGB's; None where none has one.

    Raises:
        InputError: a file cannot be read.
    """
    found = Counter(name for file in files if (name := colour_profile(file)) and "srgb" not in name.lower())
    if not found:
        return None
    named = ", ".join(f"'{name}'" for name in found)
    return (
        f"{sum(found.values())} of {len(files)} photographs have the colour profile {named}, but are taken as in "
        "sRGB's primaries, so that saturated colours are wrong; convert them to sRGB"
    )


def _with_exposures(views: list[View], trained: int, settings: Photography) -> tuple[list[View], list[str]]:
    """Views with all exposures, or none of them."""
    photographed = [view for view in views if view.image is not None]
    lacking = [view for view in photographed if view.development.exposure is None]
    notes: list[str] = []
    if len(lacking) == len(photographed):
        return _by_exif(views, trained, settings)
    known = [view.development.gain for view in photographed if view.development.exposure is not None]
    if lacking:
        names = listed((view.name for view in lacking), 4)
        said = f"{len(lacking)} of {len(photographed)} photographs have no exposure in the camera file ({names})"
        if settings.exposure == "known":
            raise InputError(f"{said}: give all of them one, or recover them with --data.exposure fit")
        middle = math.exp(float(np.mean(np.log(known))))
        notes.append(f"warning: {said}; they begin at the mean of the others, {middle:.3g}")
        views = [
            replace(view, development=replace(view.development, exposure=middle))
            if view.image is not None and view.development.exposure is None
            else view
            for view in views
        ]
    notes.append(_span(known, "the camera file", settings))
    return views, notes


def _by_exif(views: list[View], trained: int, settings: Photography) -> tuple[list[View], list[str]]:
    """Views with the relative exposures of their EXIF entries, if all have them; their mean logarithm is 0."""
    if not all(view.development.levels for view in views if view.image is not None):
        return views, []  # no EXIF in some of them
    found = [None if view.image is None else exif_exposure(Path(view.image)) for view in views]
    without = [view.name for view, value in zip(views, found, strict=True) if view.image is not None and value is None]
    if len(without) == sum(view.image is not None for view in views):
        return views, []
    if without:
        return views, [
            f"warning: {len(without)} photographs have no exposure in their EXIF ({listed(without, 4)}), so that of "
            "the others is not used; give all an exposure in the camera file"
        ]
    logs = [math.log(value) for value in found[:trained] if value is not None]
    unit = math.exp(float(np.mean(logs)))
    made = [
        view if value is None else replace(view, development=replace(view.development, exposure=value / unit))
        for view, value in zip(views, found, strict=True)
    ]
    relative = [value / unit for value in found if value is not None]
    return made, [_span(relative, "EXIF, relative to their mean", settings)]


def _span(exposures: Sequence[float], source: str, settings: Photography) -> str:
    done = "are where the fit of the gains begins" if settings.exposure == "fit" else "are divided out"
    return f"exposures from {min(exposures):.3g} to {max(exposures):.3g} ({source}) {done}"


def exif_exposure(path: Path) -> float | None:
    """Time x speed / (100 x aperture^2) of a photograph's EXIF; None where it has no time."""
    with native(path, "its EXIF cannot be read"), opened(regular_file(path)) as image:
        entries = image.getexif().get_ifd(_EXIF)
    time, speed = positive(entries.get(_TIME)), entries.get(_SPEED)
    if time is None:
        return None
    speed = positive(speed[0] if isinstance(speed, tuple) and speed else speed)
    return exposure_of(time, speed, positive(entries.get(_APERTURE)))


def exposure_of(time: float, speed: float | None, aperture: float | None) -> float:
    """Exposure by time in seconds, ISO speed and aperture; those that are not known count as 100 and 1."""
    stop = 1.0 if aperture is None else aperture
    return time * (100.0 if speed is None else speed) / (100.0 * stop * stop)


def positive(value: Any) -> float | None:
    """A number above 0 and not infinite; else None."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if 0.0 < number < math.inf else None
