"""Held-out views side by side: what each method found, the truth, and maps of the error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.callbacks.pictures import encode, exposure, false_colour, grey
from neurad.core.errors import InputError
from neurad.core.records import FloatArray, View
from neurad.runtime.files import replacing
from neurad.scene.image_io import read_exr
from neurad.scene.load import load_scene
from neurad.scene.readers.nerf import HOLD_OUT
from neurad.studies.compare.runs import Run

KINDS = {"albedo": 3, "roughness": 1, "render": 3}
"""What a run predicts of a view, and its channels."""
TRUTH = "truth"
BRIGHTEST = 0.25
"""Error, in albedo, roughness or display white, that is the brightest in an error map."""

Maps = dict[str, FloatArray]
Bytes = npt.NDArray[np.uint8]


def predicted(run: Run, name: str, index: int) -> Maps:
    """What ``neurad predict`` or ``neurad test`` wrote of a held-out view; empty if they did not run.

    Args:
        run: with ``images/`` in its folder.
        name: the view's name.
        index: its number among the held-out views; files may be named by either.
    """
    found: Maps = {}
    for kind, channels in KINDS.items():
        for stem in (name.replace("/", "_"), f"{index:03d}"):
            path = run.folder / "images" / f"{stem}_{kind}.exr"
            if path.is_file():
                found[kind] = read_exr(path)[..., :channels]
                break
    return found


def truth(view: View) -> Maps:
    """Photograph (as ``render``) and true materials of a held-out view, those that have a file."""
    files = {"albedo": view.albedo, "roughness": view.roughness, "render": view.image}
    return {kind: read_exr(path)[..., : KINDS[kind]] for kind, path in files.items() if path is not None}


def held_out(config: Mapping[str, Any]) -> list[View]:
    """The held-out views of the scene that a run was fitted to; none if the scene cannot be read any more."""
    data = config.get("data") or {}
    try:
        return load_scene(data.get("root"), data.get("scene"), data.get("hold_out", HOLD_OUT)).scored
    except InputError as error:
        print(f"neurad: no truth beside the pictures: {error}")
        return []


def write_views(folder: Path, runs: Sequence[Run], count: int) -> list[Path]:
    """A PNG for each of the first ``count`` held-out views: methods in columns, maps and their errors in rows.

    Args:
        folder: where the PNGs go.
        runs: one of each method, with ``images/`` in its folder; all of one scene.
        count: how many views.

    Returns:
        The files written; none if no run has pictures.
    """
    views = held_out(runs[0].config)[:count] if runs else []
    exact = [truth(view) for view in views]
    scale = exposure([{"photograph": maps.get("render")} for maps in exact])
    written = []
    for index, view in enumerate(views):
        columns = {run.method: predicted(run, view.name, index) for run in runs}
        columns = {method: maps for method, maps in columns.items() if maps}
        if not columns:
            continue
        if all(_is_trivial(maps.get("roughness")) for maps in columns.values()):
            columns = {method: {k: maps[k] for k in maps if k != "roughness"} for method, maps in columns.items()}
        path = folder / f"view_{index:03d}.png"
        _sheet(path, grid({TRUTH: exact[index], **columns}, scale), [TRUTH, *columns])
        written.append(path)
    return written


def grid(columns: Mapping[str, Maps], scale: float) -> dict[str, list[Bytes | None]]:
    """Pictures by row, one a column; None where there is nothing to show.

    Args:
        columns: maps by column, the truth under :data:`TRUTH`.
        scale: exposure of radiance.
    """
    exact = columns[TRUTH]
    rows: dict[str, list[Bytes | None]] = {}
    for kind in KINDS:
        if not any(kind in maps for name, maps in columns.items() if name != TRUTH):
            continue
        unit = scale if kind == "render" else 1.0
        show = grey if kind == "roughness" else encode
        rows[kind] = [show(maps[kind] * unit) if kind in maps else None for maps in columns.values()]
        if kind in exact:
            rows[f"{kind} error"] = [
                _error(maps.get(kind), exact[kind], unit) if name != TRUTH else None for name, maps in columns.items()
            ]
    return rows


def _is_trivial(roughness: FloatArray | None) -> bool:
    """Whether there was no roughness to find: a Lambertian scene has 1 on its surfaces."""
    return roughness is None or bool(np.isin(roughness, (0.0, 1.0)).all())


def _error(guess: FloatArray | None, exact: FloatArray, unit: float) -> Bytes | None:
    if guess is None or guess.shape != exact.shape:
        return None
    return false_colour(np.abs(guess - exact), unit / BRIGHTEST)


def _sheet(path: Path, rows: Mapping[str, Sequence[Bytes | None]], heads: Sequence[str]) -> None:
    """Draw the grid with its headings, every picture at a whole multiple of its size."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    first = next(cell for cells in rows.values() for cell in cells if cell is not None)
    height, width = first.shape[:2]
    zoom = max(1, round(224 / width))
    w, h, gap, left, top, dpi = width * zoom, height * zoom, 6, 28, 26, 100
    size = (left + len(heads) * (w + gap), top + len(rows) * (h + gap))
    page = Figure(figsize=(size[0] / dpi, size[1] / dpi), dpi=dpi, facecolor="white")
    FigureCanvasAgg(page)
    for column, head in enumerate(heads):
        x = left + column * (w + gap)
        page.text((x + w / 2) / size[0], 1 - top / 2 / size[1], head, ha="center", va="center", fontsize=10)
    for row, (name, cells) in enumerate(rows.items()):
        y = top + row * (h + gap)
        middle = 1 - (y + h / 2) / size[1]
        page.text(left / 2 / size[0], middle, name, rotation=90, ha="center", va="center", fontsize=9)
        for column, cell in enumerate(cells):
            if cell is not None:
                x = left + column * (w + gap)
                page.figimage(np.kron(cell, np.ones((zoom, zoom, 1), np.uint8)), x, size[1] - y - h)
        if name.endswith(" error"):
            _scale(page, left + w - 20, size[1] - y - h, h, size)
    with replacing(path) as part:
        page.savefig(part, format="png")


def _scale(page: Any, x: int, y: int, h: int, size: tuple[int, int]) -> None:
    """The colours of an error map, in the truth's empty place beside it."""
    ramp = np.linspace(BRIGHTEST, 0.0, h, dtype=np.float32)[:, None, None].repeat(12, axis=1)
    page.figimage(false_colour(ramp, 1 / BRIGHTEST), x, y)
    for value, text in ((0.0, "0"), (0.5, f"{BRIGHTEST / 2:g}"), (1.0, f"\u2265 {BRIGHTEST:g}")):
        side = {0.0: "bottom", 0.5: "center", 1.0: "top"}[value]
        page.text((x - 5) / size[0], (y + value * h) / size[1], text, ha="right", va=side, fontsize=9)
