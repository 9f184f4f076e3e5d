"""Brackets of photographs, raw or developed, merged to linear EXR: ``neurad data hdr``."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.ranges import CountOrZero, checked
from neurad.core.records import Array, BoolArray, Float64Array, FloatArray
from neurad.core.scene_records import Development
from neurad.images.development import exif_exposure, exposure_of, positive, sentence_of_profiles, usual_ceiling
from neurad.images.image_io import write_exr
from neurad.images.photographs import CODED, RAW, largest_code, read_photograph, rounding
from neurad.images.response import FIT, check_response, linear_value
from neurad.runtime.extras import needed
from neurad.runtime.files import writing
from neurad.runtime.progress import counted
from neurad.runtime.reading import native, regular_file, shown

FULL_WELL = 20000.0
"""Electrons of a pixel at its largest value: shot noise has the variance of their number."""
READ_NOISE = 6.0
"""Standard deviation in electrons of reading a pixel: between good cameras and telephones."""
NEAR = 0.93
"""Fraction of the ceiling from which on a sample is left out: noise would be cut off on one side there."""
NOTHING_KNOWN = 1e3
"""Standard deviation, over the ceiling, where no sample says anything: a weight of next to nothing."""
_ROUNDS = 3
_SHORTEST, _LONGEST = 1e-9, 1e9
_WHITE = 65535.0
_CLIPPED = 0.995  # of a photosite's range
_SAID_RAW = "it cannot be read as a raw photograph"
_Linear = tuple[FloatArray, Array, BoolArray, BoolArray]


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
    """The camera's curve, where photographs hold codes, as ``--data.response``; None takes sRGB's and says so."""

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
    """Write an EXR file for each view, named as the first of its photographs, its standard deviation into the folder
    ``spread`` beside, and say what was taken.

    Raises:
        InputError: a photograph cannot be read, has no exposure or another size, or a file is there already.
    """
    size = settings.bracket or len(settings.files)
    brackets = [settings.files[i : i + size] for i in range(0, len(settings.files), size)]
    spreads = settings.out.absolute().parent / "spread"
    with writing(settings.out, "--out"):
        for folder in (settings.out, spreads):
            folder.mkdir(parents=True, exist_ok=True)
    places = [settings.out / f"{files[0].stem}.exr" for files in brackets]
    for index, place in enumerate(places):
        if place in places[:index]:
            first, second = (shown(brackets[i][0]) for i in (places.index(place), index))
            raise InputError(f"--out: views are named as their first photographs, and {first} and {second} are alike")
        for file in (place, spreads / place.name):
            if file.exists():
                raise InputError(f"--out: {shown(file)} is there already; name another folder, or move it")
    times = [_exposures(files, settings.times) for files in brackets]
    if any(file.suffix.lower() in CODED for file in settings.files) and settings.response is None:
        print("photographs of codes: sRGB's curve is undone, as nothing else is said (--response)")
    if said := sentence_of_profiles(settings.files):
        print(f"warning: {said}", file=sys.stderr)
    for files, exposures, place in counted(
        zip(brackets, times, places, strict=True), "merging", len(brackets), "views"
    ):
        radiance, spread, clipped = _merged(files, exposures, settings.response)
        write_exr(place, radiance, half=False)
        write_exr(spreads / place.name, spread, half=False)
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
    code = min(usual_ceiling(file) for file in files)
    return 1.0 if code == 1.0 else linear_value(response or "srgb", code)


def _exposures(files: Sequence[Path], given: Sequence[float] | None) -> list[float]:
    if given is not None:
        return list(given)
    found = []
    for file in files:
        exposure = _raw_exposure(file) if file.suffix.lower() in RAW else exif_exposure(file)
        if exposure is None:
            raise InputError(f"{shown(file)}: its EXIF has no exposure time; give those of a view with --times")
        found.append(exposure)
    return found


def _merged(
    files: Sequence[Path], times: Sequence[float], response: str | None
) -> tuple[FloatArray, FloatArray, BoolArray]:
    parts: list[_Linear] = []
    for file in files:
        parts.append(_linear(file, response or "srgb"))
        size, first = (f"{part[0].shape[1]} x {part[0].shape[0]}" for part in (parts[-1], parts[0]))
        if size != first:
            raise InputError(f"{shown(file)}: it has {size} pixels, but {shown(files[0])} has {first}")
    pictures, squares, usable, clipped = zip(*parts, strict=True)
    return merge(pictures, times, _ceiling(files, response), squares, usable, clipped)


def _linear(file: Path, response: str) -> _Linear:
    """Linear values of a photograph in units of the largest [h, w, 3], the variance of their rounding, which of them
    say something, and which are clipped, whatever they are.
    """
    ending = file.suffix.lower()
    if ending in RAW:
        return _raw(file)
    if ending not in CODED:
        raise InputError(f"{shown(file)}: brackets are merged from raw files, PNG, JPEG and TIFF, not from {ending}")
    levels = largest_code(file)
    pixels = read_photograph(file, Development(response, levels))[..., :3]
    values, squares = rounding(response, levels)
    return pixels, np.interp(pixels, values, squares), np.ones(pixels.shape, bool), np.zeros(pixels.shape, bool)


def _opened(file: Path) -> Any:
    with needed("rawpy", "raw", f"{shown(file)}: a raw file"):
        import rawpy
    regular_file(file)
    with native(file, _SAID_RAW):
        return rawpy.imread(str(file))


def _raw_exposure(file: Path) -> float | None:
    """As :func:`exif_exposure`, of raw files, most of which only their own reader reads."""
    with _opened(file) as raw:
        if (other := getattr(raw, "other", None)) is None:  # rawpy before 0.27
            return exif_exposure(file)
        time, speed, aperture = (positive(getattr(other, n)) for n in ("shutter_speed", "iso_speed", "aperture"))
    return None if time is None else exposure_of(time, speed, aperture)


def _raw(file: Path) -> _Linear:
    """A raw photograph as :func:`_linear` says: linear sRGB primaries in the camera's white balance.

    What is clipped in all colours has the value from which on it is. Where only some are, also in those that the others
    are interpolated from, the conversion to other primaries mixes them into all: such values say nothing.
    """
    with _opened(file) as raw, native(file, _SAID_RAW):
        import rawpy

        full, level = _full(raw)
        codes = raw.postprocess(
            gamma=(1, 1), no_auto_bright=True, use_camera_wb=True, output_bps=16, user_flip=0,
            output_color=rawpy.ColorSpace.sRGB, adjust_maximum_thr=0.0,
        )  # fmt: skip
    pixels = (codes / _WHITE).astype(np.float32)
    if full.ndim == 3:
        some, every = np.asarray(full.any(-1)), np.asarray(full.all(-1))
    else:
        from scipy.ndimage import binary_dilation, binary_erosion  # imported where they are needed: they load slowly

        some = binary_dilation(full, np.ones((5, 5)))
        every = binary_erosion(full, np.ones((3, 3)), border_value=1)
    some, every = (_fitted(part, pixels.shape[:2]) for part in (some, every))
    pixels[every] = level
    usable, clipped = (np.repeat(mask[..., None], 3, -1) for mask in (every | ~some, every))
    return pixels, np.full(1, 1.0 / (12.0 * _WHITE**2)) * np.ones_like(pixels), usable, clipped


def _full(raw: Any) -> tuple[BoolArray, float]:
    """Photosites [h, w], of files without a mosaic pixels and their colours [h, w, 3], that are clipped: at the
    sensor's white level, or beyond 1 in the camera's white balance, whose smallest factor is 1. And what of the range
    a surface is beyond that is clipped in all colours; a colour's own white level may lie below the range's end.
    """
    codes = np.asarray(raw.raw_image_visible)
    white = np.asarray(raw.camera_white_level_per_channel or [raw.white_level] * 4, float)
    white = np.where(white > 0, np.minimum(white, raw.white_level), raw.white_level)
    black = np.asarray(raw.black_level_per_channel, float)
    factor = np.asarray(raw.camera_whitebalance, float)
    if not (factor[:3] > 0).all():
        factor = np.asarray(raw.daylight_whitebalance, float)  # what is taken where the file has none
    factor[3] = factor[3] if factor[3] > 0 else factor[1]  # the second green
    balance = factor / factor.min() if (factor > 0).all() else np.ones(4)
    first = np.minimum((white - black) / (raw.white_level - black), 1.0 / balance)  # of the range, before balancing
    level = black + _CLIPPED * (raw.white_level - black) * first
    bound = float((first * balance).min())
    if codes.ndim == 3:
        return np.asarray(codes[..., :3] >= level[:3]), bound
    return np.asarray(codes >= level[np.asarray(raw.raw_colors_visible)]), bound


def _fitted(mask: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """A mask [h, w] as large as a picture, which may lack or have a few more rows and columns at its end."""
    more = [(0, max(want - has, 0)) for want, has in zip(shape, mask.shape, strict=True)]
    return np.pad(mask, more, mode="edge")[: shape[0], : shape[1]]


def merge(
    exposures: Sequence[FloatArray],
    times: Sequence[float],
    ceiling: float = 1.0,
    rounding: Sequence[Array] | None = None,
    usable: Sequence[BoolArray] | None = None,
    clipped: Sequence[BoolArray] | None = None,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Radiance from linear pictures of one view, each sample weighted by one over its variance.

    A sample ``y = radiance * time`` has the variance of shot and read noise, ``y / FULL_WELL + (READ_NOISE /
    FULL_WELL)^2``, with ``y`` by the present estimate: by the sample itself, those that noise made small would count
    more. Whether a sample is near its ceiling is said by the shorter exposures, and so independent of its own noise;
    where their noise decides it, the mean is up to 0.4 % too large.

    Args:
        exposures: pictures of the same size, values in units of the largest [h, w, c].
        times: their exposures, times in any unit, above 0.
        ceiling: value from which on a sample is clipped.
        rounding: variance of each picture's rounding, in squared units of the largest value; None for none.
        usable: of each picture, samples that say something [h, w, c]; colours that are interpolated from clipped ones
            do not, whatever they are. None for all.
        clipped: of each picture, samples that are clipped below the ceiling [h, w, c]; None for none.

    Returns:
        Radiance in units of the largest value over the unit of time [h, w, c], its standard deviation, and where every
        sample is clipped: there the radiance is what the shortest exposure shows, or more, and the standard
        deviation infinite. Where no sample is usable it is that of the shortest exposure, below the ceiling, and the
        standard deviation :data:`NOTHING_KNOWN` ceilings.
    """
    order = np.argsort(times)
    y = np.stack([np.asarray(exposures[i], np.float64) for i in order])  # [n, h, w, c]
    t = np.asarray(times, np.float64)[order].reshape(-1, 1, 1, 1)
    floor = (READ_NOISE / FULL_WELL) ** 2 * np.ones_like(y[:1])
    floor = floor + (0.0 if rounding is None else np.stack([np.asarray(rounding[i]) for i in order]))
    useful = np.ones(y.shape, bool) if usable is None else np.stack([np.asarray(usable[i], bool) for i in order])
    full = y >= ceiling
    if clipped is not None:
        full |= np.stack([np.asarray(clipped[i], bool) for i in order])
    free = _free(y, t, ceiling, useful & ~full)
    none = ~np.asarray(free.any(0))
    all_clipped: BoolArray = none & full[0] & useful[0]
    alone = np.minimum(y[0], np.where(all_clipped, ceiling, NEAR * ceiling)) / t[0]
    radiance = np.where(none, alone, _ratio((y * free).sum(0), (t * free).sum(0)))
    weight = np.zeros_like(y)
    for _ in range(_ROUNDS):
        variance = np.maximum(radiance, 0.0) * t / FULL_WELL + floor
        weight = np.where(free, t * t / variance, 0.0)
        radiance = np.where(none, radiance, _ratio((weight * y / t).sum(0), weight.sum(0)))
    spread = np.sqrt(_ratio(np.ones_like(radiance), weight.sum(0)))
    spread = np.where(none, np.where(all_clipped, np.inf, NOTHING_KNOWN * ceiling / t[0]), spread)
    return np.maximum(radiance, 0.0).astype(np.float32), spread.astype(np.float32), all_clipped


def _free(y: Float64Array, t: Float64Array, ceiling: float, useful: BoolArray) -> BoolArray:
    """Which of the useful samples count [n, h, w, c], from the shortest exposure to the longest."""
    free = useful.copy()
    free[1:] &= free[:-1]  # what is clipped in a shorter exposure is so in a longer one
    value, time = y[0].copy(), np.full_like(y[0], t[0].item())
    for i in range(1, len(y)):
        free[i] &= value / time * t[i] < NEAR * ceiling
        value += np.where(free[i], y[i], 0.0)
        time += np.where(free[i], t[i], 0.0)
    return np.asarray(free)


def _ratio(a: Float64Array, b: Float64Array) -> Float64Array:
    """``a / b``, and 0 where ``b`` is 0."""
    found: Float64Array = np.divide(a, b, out=np.zeros_like(a), where=b > 0)
    return found
