"""Held-out views side by side: what each method found, the truth, and maps of the error, as sheets and as a figure."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurad.compare.curves import STYLE, WIDTH, save
from neurad.compare.runs import Run, full_name
from neurad.core.decibels import decibels
from neurad.core.errors import InputError
from neurad.core.parameters import BY_NAME
from neurad.core.records import BoolArray, Bytes, Float64Array, FloatArray
from neurad.core.scene_records import View
from neurad.formats.cameras import HOLD_OUT
from neurad.formats.load import load_scene
from neurad.images.development import Photography
from neurad.images.image_io import read_bitmap, read_exr
from neurad.images.photographs import read_view
from neurad.metrics.scores import psnr
from neurad.metrics.unseen import UNSEEN
from neurad.pages.chart import new_figure
from neurad.pages.colours import BRIGHTEST, ERRORS, encode, encode_parameter, false_colour
from neurad.pages.sheet import Crop, Scale, Sheet, Tile, scale_of, worst_squares
from neurad.runs.model_settings import parse_reader
from neurad.runs.trust import import_trusted
from neurad.scene.description import Scene
from neurad.scene.exposure import scene_exposure

KINDS = {**{name: name.capitalize() for name in BY_NAME}, "render": "Picture"}
"""What a run predicts of a view, and its heading."""
CHANNELS = {**{name: parameter.channels for name, parameter in BY_NAME.items()}, "render": 3}
TRUTH = "truth"
INSET = 0.4
"""Side of the error's picture over that of the crop in whose corner it is."""

Maps = dict[str, FloatArray]


def predicted(run: Run, name: str, index: int) -> Maps:
    """What ``neurad predict`` or ``neurad test`` wrote of a held-out view, or another program; empty if none did.

    Args:
        run: with ``images/VIEW_albedo.exr`` or ``albedo/VIEW.exr`` in its folder, and so for other maps.
        index: its number among the held-out views; files may be named by either.
    """
    found: Maps = {}
    for kind, channels in CHANNELS.items():
        places = [run.folder / f for x in _stems(name, index) for f in (f"images/{x}_{kind}.exr", f"{kind}/{x}.exr")]
        path = next((place for place in places if place.is_file()), None)
        if path is not None:
            found[kind] = read_exr(path)[..., :channels]
    return found


def truth(view: View) -> Maps:
    """Photograph (as ``render``) and true materials of a held-out view, those that have a file."""
    found = {kind: read_exr(path)[..., : CHANNELS[kind]] for kind, path in view.maps.items()}
    return found if view.image is None else {**found, "render": read_view(view)[..., : CHANNELS["render"]]}


def scene_of(config: Mapping[str, Any], trust: Sequence[str]) -> Scene | None:
    """The scene that a run was fitted to; None if it cannot be read any more."""
    data = config.get("data") or {}
    try:
        held_out, hints = data.get("hold_out", HOLD_OUT), data.get("hints")
        reader = parse_reader(data.get("reader"), "the run's config.yaml", import_trusted(trust))
        return load_scene(data.get("root"), data.get("scene"), held_out, Photography.of(data), hints, reader)
    except InputError as error:
        print(f"neurad: no truth beside the pictures: {error}")
        return None


@dataclass(frozen=True)
class ComparedView:
    """A held-out view as several methods have it."""

    title: str
    columns: dict[str, Maps]
    """Maps by method, the truth under :data:`TRUTH`."""
    scale: float
    """Exposure of radiance."""
    unseen: BoolArray | None = None
    """Pixels [h, w] whose surface no training photograph shows."""


def compared(runs: Sequence[Run], count: int, trust: Sequence[str]) -> list[ComparedView]:
    """The first ``count`` held-out views of runs of one scene, one of each method; none if no run has pictures. Their
    reader may be in a module of the user's own that is one of ``trust``.
    """
    config = next((run.config for run in runs if run.config), None)  # another program's run has none
    scene = None if config is None else scene_of(config, trust)
    if scene is None:
        return []
    views, scale = scene.scored[:count], scene_exposure(scene)
    exact = [truth(view) for view in views]
    made = []
    for index, view in enumerate(views):
        columns = {run.method: predicted(run, view.name, index) for run in runs}
        columns = {method: maps for method, maps in columns.items() if maps}
        if not columns:
            continue
        mask = _unseen(runs, view.name, index)
        if mask is not None and any(maps[kind].shape[:2] != mask.shape for maps in columns.values() for kind in maps):
            mask = None
        made.append(ComparedView(f"View {index:03d}", {TRUTH: exact[index], **columns}, scale, mask))
    return made


def shown(kind: str, values: FloatArray, scale: float) -> Bytes:
    """A map, or a picture at an exposure, as people look at it [h, w, 3]."""
    return encode(values * scale) if kind == "render" else encode_parameter(BY_NAME[kind], values)


def sheet(view: ComparedView) -> Sheet:
    """The sheet of a view: the truth and the methods in columns, maps and their errors in rows."""
    columns, scale, unseen = view.columns, view.scale, view.unseen
    exact = columns[TRUTH]
    rows: dict[str, list[Tile | None]] = {}
    for kind, word in KINDS.items():
        if not any(kind in maps for name, maps in columns.items() if name != TRUTH):
            continue
        unit, parameter = scale if kind == "render" else 1.0, BY_NAME.get(kind)
        bar = None if parameter is None else scale_of(parameter)
        rows[kind] = [
            Tile(f"{kind}-{place}", f"{word}: {name}", shown(kind, maps[kind], scale), bar, _pair(kind, name, columns))
            if kind in maps
            else None
            for place, (name, maps) in enumerate(columns.items())
        ]
        if kind in exact:
            brightest = f"{100 * BRIGHTEST:g} % of white" if kind == "render" else f"{BRIGHTEST:g}"
            scales = Scale(ERRORS, "0", f"\u2265 {brightest}", "absolute error, darker is better")
            rows[f"{kind} error"] = [
                Tile(f"{kind}-error-{place}", f"Error: {name}", error_picture(maps[kind], exact[kind], unit), scales)
                if name != TRUTH and fits(maps, exact, kind)
                else None
                for place, (name, maps) in enumerate(columns.items())
            ]
    hatching = [] if unseen is None or not unseen.any() else ["Hatched: surfaces that are in no training photograph."]
    named = [f"{name}: {full_name(name)}." for name in columns if full_name(name) != name]
    notes = [*named, f"Exposure: radiance times {scale:.3g}, the same for all views.", *hatching]
    return Sheet(view.title, rows, unseen, notes=notes)


def fits(maps: Maps, exact: Maps, kind: str) -> bool:
    """Whether there is a map of this kind, as large as the truth."""
    return kind in maps and maps[kind].shape == exact[kind].shape


def _pair(kind: str, name: str, columns: Mapping[str, Maps]) -> str:
    """The key of the tile that one is to be compared with: the first method's with the truth."""
    methods = [method for method, maps in columns.items() if kind in maps and method != TRUTH]
    if kind not in columns[TRUTH] or name not in (TRUTH, methods[0]):
        return ""
    return f"{kind}-{[*columns].index(methods[0] if name == TRUTH else TRUTH)}"


def _unseen(runs: Sequence[Run], name: str, index: int) -> BoolArray | None:
    """Pixels [h, w] of a view whose surface no training photograph shows, by what the runs wrote; None if none did."""
    paths = (run.folder / "images" / f"{stem}_seen.png" for run in runs for stem in _stems(name, index))
    path = next((path for path in paths if path.is_file()), None)
    return None if path is None else np.asarray(read_bitmap(path)[..., 0] == UNSEEN)


def _stems(name: str, index: int) -> tuple[str, str]:
    """What files of a view may be named by."""
    return name.replace("/", "_"), f"{index:03d}"


def error_picture(estimate: FloatArray, exact: FloatArray, unit: float) -> Bytes:
    """The absolute error of a map times ``unit`` as colours [h, w, 3]."""
    return false_colour(np.abs(estimate - exact), unit / BRIGHTEST)


def write_crops(stem: Path, columns: Mapping[str, Maps], scale: float) -> None:
    """Draw a square of a held-out view where methods are most wrong: the truth, and each method's with its error in a
    corner and its PSNR in the square below; ``columns`` and ``scale`` are those of a :class:`ComparedView`. Draws
    nothing where there is no truth.
    """
    import matplotlib

    exact, methods = columns[TRUTH], {name: maps for name, maps in columns.items() if name != TRUTH}
    kinds = [kind for kind in KINDS if kind in exact and any(fits(maps, exact, kind) for maps in methods.values())]
    if not kinds:
        return
    crop = _square(exact, methods, kinds[0], scale)
    across = len(methods) + 2
    with matplotlib.rc_context(STYLE):
        page = new_figure(WIDTH, len(kinds) * (WIDTH / across + 0.16) + 0.3)
        cells = page.subplots(len(kinds), across, squeeze=False)
        part = np.s_[crop.y : crop.y + crop.side, crop.x : crop.x + crop.side]
        for kind, row in zip(kinds, cells, strict=True):
            whole = shown(kind, exact[kind], scale)
            row[0].imshow(whole, interpolation="none")
            box: dict[str, Any] = {"fill": False, "edgecolor": "#ff40a0", "lw": 1.0}
            row[0].add_patch(matplotlib.patches.Rectangle((crop.x - 0.5, crop.y - 0.5), crop.side, crop.side, **box))
            row[0].set_ylabel(KINDS[kind])
            row[1].imshow(whole[part], interpolation="none")
            for ax, maps in zip(row[2:], methods.values(), strict=True):
                if not fits(maps, exact, kind):
                    ax.set_axis_off()
                    continue
                unit = scale if kind == "render" else 1.0
                ax.imshow(shown(kind, maps[kind], scale)[part], interpolation="none")
                inset = ax.inset_axes((1.0 - INSET, 0.0, INSET, INSET))
                inset.imshow(error_picture(maps[kind], exact[kind], unit)[part], interpolation="none")
                inset.set(xticks=[], yticks=[])
                inset.spines[:].set(color="white", linewidth=0.8)
                one, other = (np.clip(image[part] * unit, 0.0, 1.0) for image in (maps[kind], exact[kind]))
                ax.set_xlabel(decibels(psnr(float(np.square(one - other).mean())), 1), labelpad=2)
            for ax in row:
                ax.set(xticks=[], yticks=[])
        names = ["Held-out view", "Truth", *map(full_name, methods)]
        for ax, name in zip(cells[0], names, strict=True):
            ax.set_title(textwrap.fill(name, max(12, round(100 / across))), pad=3)
        save(page, stem)


def _square(exact: Maps, methods: Mapping[str, Maps], kind: str, scale: float) -> Crop:
    """The square of a view in which the methods' errors are largest together; its middle where there are none."""
    unit = scale if kind == "render" else 1.0
    total: Float64Array = np.zeros(exact[kind].shape[:2])
    for maps in methods.values():
        if fits(maps, exact, kind):
            total = total + np.clip(np.abs(maps[kind] - exact[kind]) * unit, 0.0, 1.0).mean(-1)
    found = worst_squares([("", total.astype(np.float32))], 1)
    side = max(1, min(total.shape) // 4)
    return found[0] if found else Crop("A", (total.shape[0] - side) // 2, (total.shape[1] - side) // 2, side, "")
