"""Pictures of an evaluation: the sheet of a view, and EXR and PNG files for ``neurad test``."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.parameters import BY_NAME, SurfaceParameter
from neurad.core.records import BoolArray, Bytes, FloatArray
from neurad.evidence.error_bars import DETERMINED
from neurad.images.image_io import write_exr, write_png
from neurad.metrics.unseen import Unseen
from neurad.pages.colours import BARS, BRIGHTEST, ERRORS, encode, encode_parameter, false_colour
from neurad.pages.draw import draw
from neurad.pages.sheet import Scale, Sheet, Tile, scale_of, worst_squares
from neurad.runtime.files import make_folder
from neurad.runtime.progress import counted
from neurad.scene.exposure import LEVEL, exposure

View = Mapping[str, Any]
CROPPED = ("render", "photograph", *(f"{name}{kind}" for name in BY_NAME for kind in ("", "_true")))
"""Pictures that the crops of a sheet are taken of."""
WRITTEN = ("render", *BY_NAME, "relit", *(f"{name}_std" for name in BY_NAME))
"""Maps that are written as EXR and as PNG."""
SHARE = Scale(BARS, "0 sure", "1 unknown", "error bar over that without photographs")


def view_name(view: View, index: int) -> str:
    """The view's name, or its number."""
    return str(view.get("name") or f"{index:03d}").replace("/", "_")


def view_sheet(view: View, scale: float, title: str) -> Sheet:
    """Everything there is to see of one view.

    Args:
        view: arrays [h, w, c] by name, those that it has: render, photograph, residual, relit, photograph_relit, seen,
            and of every surface parameter its map, its true map and its error bars over what they would be without
            photographs, such as albedo, albedo_true, albedo_bars.
        scale: exposure of radiance; an error of a quarter of display white is the brightest in the error pictures.
    """
    has = {name for name in view if view[name] is not None}
    rows: dict[str, list[Tile | None]] = {
        "Picture": _light(view, has, scale, "render", "photograph", "Rendered", "Photograph"),
        **{name.capitalize(): _material(view, has, parameter) for name, parameter in BY_NAME.items()},
        "Relit": _light(view, has, scale, "relit", "photograph_relit", "Rendered in other light", "Photograph in it"),
    }
    if "residual" in has:
        bar = Scale(ERRORS, "0", f"\u2265 {100 * BRIGHTEST:g} % of white", "field minus rendering, darker is better")
        picture = false_colour(np.abs(view["residual"]), scale / BRIGHTEST)
        rows["Picture"] += [Tile("residual", "Residual of the equation", picture, bar)]
    found = Unseen.of([view])
    notes = [
        f"Exposure: radiance times {scale:.3g}, the same for all views; it shows the training photographs' 90th "
        f"percentile at {LEVEL:g} of display white. Albedo is shown by the sRGB curve, other maps by their colour bars."
    ]
    if found.fraction:
        notes.append(f"Hatched: {found.sentence('this view')}")
    if any(f"{name}_bars" in has for name in BY_NAME):
        notes.append(
            "Thin pale lines: not determined, the error bar is more than half of what it is without photographs."
        )
    crops = worst_squares(_errors(view, has, scale))
    rows = {label: tiles for label, tiles in rows.items() if tiles}
    return Sheet(title, rows, found.masks[0], crops, CROPPED, notes)


def _light(
    view: View, has: set[str], scale: float, name: str, truth: str, heading: str, other: str
) -> list[Tile | None]:
    """A rendering, its photograph, and the error."""
    if name not in has:
        return []
    tiles: list[Tile | None] = [Tile(name, heading, encode(view[name] * scale), pair=truth if truth in has else "")]
    if truth in has:
        bar = Scale(ERRORS, "0", f"\u2265 {100 * BRIGHTEST:g} % of white", "absolute error, darker is better")
        error = false_colour(np.abs(view[name] - view[truth]), scale / BRIGHTEST)
        tiles += [
            Tile(truth, other, encode(view[truth] * scale), pair=name),
            Tile(f"{name}_error", "Error", error, bar),
        ]
    return tiles


def _material(view: View, has: set[str], parameter: SurfaceParameter) -> list[Tile | None]:
    """What was found of a surface parameter or is known of it, the truth, the error, and the error bars."""
    name = parameter.name
    if name not in has:
        return _bars(view, has, name)
    truth, bar = f"{name}_true", scale_of(parameter)
    heading, pair = f"{name.capitalize()}{' found' if parameter.is_recovered else ''}", truth if truth in has else ""
    picture = encode_parameter(parameter, view[name])
    tiles: list[Tile | None] = [Tile(name, heading, picture, bar, pair, _doubts(view, name))]
    if truth in has:
        error = false_colour(np.abs(view[name] - view[truth]), 1.0 / BRIGHTEST)
        scale = Scale(ERRORS, "0", f"\u2265 {BRIGHTEST:g}", "absolute error, darker is better")
        tiles += [
            Tile(truth, f"{name.capitalize()} true", encode_parameter(parameter, view[truth]), bar, name),
            Tile(f"{name}_error", f"Error of {name}", error, scale),
        ]
    return tiles + _bars(view, has, name)


def _bars(view: View, has: set[str], name: str) -> list[Tile | None]:
    if f"{name}_bars" not in has:
        return []
    picture = false_colour(view[f"{name}_bars"], 1.0, BARS)
    return [Tile(f"{name}_bars", f"Error bars of {name}", picture, SHARE, doubtful=_doubts(view, name))]


def _doubts(view: View, name: str) -> BoolArray | None:
    """Pixels [h, w] where a parameter is not determined; None where nothing is known of that."""
    share = view.get(f"{name}_bars")
    return None if share is None else np.asarray(share[..., 0] >= DETERMINED)


def _errors(view: View, has: set[str], scale: float) -> list[tuple[str, FloatArray]]:
    """Squared errors [h, w] of surfaces that photographs show, with what they are of."""
    known = np.ones(view["render"].shape[:2], np.bool_) if "seen" not in has else view["seen"][..., 0] == 1.0
    found = []
    for name in BY_NAME:
        if {name, f"{name}_true"} <= has:
            error = np.square(view[name] - view[f"{name}_true"]).mean(-1)
            found.append((f"where {name} is most wrong on surfaces that photographs show", np.where(known, error, 0.0)))
    if {"render", "photograph"} <= has:
        off = np.clip(view["render"] * scale, 0, 1) - np.clip(view["photograph"] * scale, 0, 1)
        found.append(("where the picture is most wrong", np.square(off).mean(-1)))
    return [(meaning, error.astype(np.float32)) for meaning, error in found]


def environments(maps: Mapping[str, FloatArray]) -> dict[str, Bytes]:
    """A recovered environment map and the true one where it is there [h, w, 3], by what they are called. Their exposure
    is not the photographs', at which what lights a room is white; it is that of the true one, which no fit changes.
    """
    level = exposure([maps["truth" if "truth" in maps else "fitted"]])
    called = {"fitted": "Recovered environment", "truth": "Environment of the scene file"}
    return {heading: encode(maps[name] * level) for name, heading in called.items() if name in maps}


def environment(maps: Mapping[str, FloatArray]) -> Bytes:
    """These below each other."""
    panels = [*environments(maps).values()]
    line = np.full((2, panels[0].shape[1], 3), 255, np.uint8)
    return np.concatenate([part for panel in panels for part in (panel, line)][:-1])


def write_views(
    folder: Path, maps: Sequence[View], scale: float, sky: Mapping[str, FloatArray] | None = None, title: str = ""
) -> None:
    """Write rendering, maps of surface parameters, their error bars and relit rendering of every view, those that it
    has, as linear EXR and, radiance times ``scale``, as PNG for looking at; which surfaces photographs show, and a
    sheet of everything, as PNG; ``sky``, a recovered environment map and the true one, as ``environment``; ``title``
    begins the headings of the sheets.
    """
    make_folder(folder)
    for index, view in enumerate(counted(maps, "writing", len(maps), "pictures")):
        name = view_name(view, index)
        for kind in WRITTEN:
            image = view.get(kind)
            if image is None:
                continue
            stem = folder / f"{name}_{kind}"
            write_exr(stem.with_suffix(".exr"), image, half=False)
            if kind.endswith("_std"):
                picture = false_colour(view[kind.replace("_std", "_bars")], 1.0, BARS)
            else:
                picture = encode_parameter(BY_NAME[kind], image) if kind in BY_NAME else encode(image * scale)
            write_png(stem.with_suffix(".png"), picture)
        if view.get("seen") is not None:
            seen = np.broadcast_to(view["seen"], (*view["seen"].shape[:2], 3))
            write_png(folder / f"{name}_seen.png", np.round(seen * 255).astype(np.uint8))
        if view.get("render") is not None:
            write_png(folder / f"{name}_sheet.png", draw(view_sheet(view, scale, f"{title}, view {name}".lstrip(", "))))
    if sky:
        write_exr(folder / "environment.exr", sky["fitted"], half=False)
        write_png(folder / "environment.png", environment(sky))
