"""Brackets of photographs, raw or developed, merged to linear EXR: ``neurad data hdr``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neurad.core.errors import InputError
from neurad.core.ranges import CountOrZero, checked
from neurad.core.records import Development, FloatArray
from neurad.runtime.files import writing
from neurad.runtime.progress import counted
from neurad.runtime.reading import native, regular_file, shown
from neurad.scene.bracket import merge
from neurad.scene.development import JPEG_CEILING, exif_exposure
from neurad.scene.image_io import write_exr
from neurad.scene.photographs import CODED, RAW, largest_code, read_photograph, rounding
from neurad.scene.response import FIT, check_response, linear_value

_SHORTEST, _LONGEST = 1e-9, 1e9
_WHITE = 65535.0


@dataclass(frozen=True)
class MergeSettings:
    """What to merge, and to where."""

    files: list[Path]
    """Photographs; those of one view in a row."""
    out: Path
    """Folder of the EXR files."""
    bracket: CountOrZero = 0
    """Photographs of each view; 0 where all are of one."""
    times: list[float] | None = None
    """Exposures of a view's photographs, where EXIF has none or others."""
    response: str | None = None
    """Of photographs of codes, as ``--data.response``; None takes sRGB's curve and says so."""

    def __post_init__(self) -> None:
        """Refuse what cannot be merged."""
        checked(self)
        if self.response is not None:
            check_response(self.response)
            if self.response == FIT:
                raise InputError("--response fit: a fit recovers a response, a merge has to know it")
        size = self.bracket or len(self.files)
        if len(self.files) % size:
            raise InputError(f"--bracket {size}: {len(self.files)} photographs are no whole number of brackets")
        for time in self.times or ():
            if not _SHORTEST <= time <= _LONGEST:
                raise InputError(
                    f"--times: {time:g} is no exposure, which has to be from {_SHORTEST:g} to {_LONGEST:g}"
                )
        if self.times is not None and len(self.times) != size:
            raise InputError(f"--times: there are {len(self.times)} exposures for the {size} photographs of a view")


def merge_brackets(settings: MergeSettings) -> None:
    """Write an EXR file for each view, named as the first of its photographs, and say what was taken.

    Raises:
        InputError: a photograph cannot be read, has no exposure or another size, or a file is there already.
    """
    size = settings.bracket or len(settings.files)
    brackets = [settings.files[i : i + size] for i in range(0, len(settings.files), size)]
    with writing(settings.out, "--out"):
        settings.out.mkdir(parents=True, exist_ok=True)
    places = [settings.out / f"{files[0].stem}.exr" for files in brackets]
    for place in places:
        if place.exists():
            raise InputError(f"--out: {shown(place)} is there already; name another folder, or move it")
    times = [_exposures(files, settings.times) for files in brackets]
    if any(file.suffix.lower() in CODED for file in settings.files) and settings.response is None:
        print("photographs of codes: sRGB's curve is undone, as nothing else is said (--response)")
    for files, exposures, place in counted(
        zip(brackets, times, places, strict=True), "merging", len(brackets), "views"
    ):
        radiance, spread, clipped = _merged(files, exposures, settings.response)
        write_exr(place, radiance, half=False)
        free = ~clipped
        noise = float(np.median(spread[free] / np.maximum(radiance[free], 1e-30))) if free.any() else float("nan")
        span = f"exposures {min(exposures):.3g} to {max(exposures):.3g}"
        print(
            f"{shown(place)}: {len(files)} photographs, {span}, noise {100 * noise:.2g} % (median), "
            f"{100 * float(clipped.any(-1).mean()):.2g} % clipped in all"
        )
    shortest = {min(exposures) for exposures in times}
    if len(shortest) == 1:
        level = _ceiling(settings.files, settings.response) / shortest.pop()
        print(f"from {level:.6g} on every exposure is clipped: fit with --data.ceiling {level * 0.999:.6g}")


def _ceiling(files: Sequence[Path], response: str | None) -> float:
    """Linear value from which on photographs are clipped."""
    jpeg = any(file.suffix.lower() in (".jpg", ".jpeg") for file in files)
    if not jpeg:
        return 1.0
    return linear_value(response or "srgb", JPEG_CEILING)


def _exposures(files: Sequence[Path], given: Sequence[float] | None) -> list[float]:
    """Exposures of the photographs of a view."""
    if given is not None:
        return list(given)
    found = []
    for file in files:
        exposure = exif_exposure(file)
        if exposure is None:
            raise InputError(f"{shown(file)}: its EXIF has no exposure time; give those of a view with --times")
        found.append(exposure)
    return found


def _merged(files: Sequence[Path], times: Sequence[float], response: str | None) -> tuple[FloatArray, ...]:
    pictures, squares = [], []
    for file in files:
        pixels, variance = _linear(file, response or "srgb")
        if pictures and pixels.shape != pictures[0].shape:
            raise InputError(
                f"{shown(file)}: it has {pixels.shape[1]} x {pixels.shape[0]} pixels, but {shown(files[0])} has "
                f"{pictures[0].shape[1]} x {pictures[0].shape[0]}"
            )
        pictures.append(pixels)
        squares.append(variance)
    return merge(pictures, times, _ceiling(files, response), squares)


def _linear(file: Path, response: str) -> tuple[FloatArray, FloatArray]:
    """Linear values of a photograph in units of the largest [h, w, 3], and the variance of their rounding."""
    ending = file.suffix.lower()
    if ending in RAW:
        return _raw(file)
    if ending not in CODED:
        raise InputError(f"{shown(file)}: brackets are merged from raw files, PNG, JPEG and TIFF, not from {ending}")
    levels = largest_code(file)
    pixels = read_photograph(file, Development(response, levels))[..., :3]
    values, squares = rounding(response, levels)
    return pixels, np.interp(pixels, values, squares)


def _raw(file: Path) -> tuple[FloatArray, FloatArray]:
    """A raw photograph: linear sRGB primaries in the camera's white balance; what is clipped in any colour is 1."""
    try:
        import rawpy
    except ImportError as error:
        raise InputError(f"{shown(file)}: raw files need the package rawpy: pip install 'neurad[raw]'") from error
    regular_file(file)
    with native(file, "it cannot be read as a raw photograph"), rawpy.imread(str(file)) as raw:
        white = float(min(raw.camera_white_level_per_channel or [raw.white_level]) or raw.white_level)
        full = np.asarray(raw.raw_image_visible) >= 0.995 * white
        codes = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, use_camera_wb=True, output_bps=16, user_flip=0,
            output_color=rawpy.ColorSpace.sRGB,
        )  # fmt: skip
    pixels = (codes / _WHITE).astype(np.float32)
    pixels[_around(full, pixels.shape[:2])] = 1.0
    return pixels, np.full(1, 1.0 / (12.0 * _WHITE**2)) * np.ones_like(pixels)


def _around(full: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Pixels whose colours are interpolated from a clipped one: those within two steps of it."""
    grown = np.zeros(shape, bool)
    height, width = min(shape[0], full.shape[0]), min(shape[1], full.shape[1])
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            to = grown[max(dy, 0) : height + min(dy, 0), max(dx, 0) : width + min(dx, 0)]
            to |= full[max(-dy, 0) : height + min(-dy, 0), max(-dx, 0) : width + min(-dx, 0)]
    return grown
