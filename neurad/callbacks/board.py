"""TensorBoard's page of a run: four charts first, everything else under ``more``, pictures of views, settings."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Any

from neurad.callbacks import pictures, report
from neurad.callbacks.table import Row
from neurad.core.decibels import EXACT
from neurad.core.parameters import RECOVERED
from neurad.images.image_io import png
from neurad.lamps.unknown import rows
from neurad.metrics.marks import MARKS
from neurad.pages.chart import plot
from neurad.pages.draw import draw
from neurad.pages.sheet import Sheet

if TYPE_CHECKING:
    from neurad.callbacks.events import EventFile
    from neurad.training.inverse import InverseRenderer

FIRST = {**{f"{name}_psnr": f"fit/{name}_psnr" for name in RECOVERED}, "psnr_srgb": "fit/picture_psnr"}
"""Scores whose charts come first, and their tags."""
LOSS = "fit/loss"
CHARTS = {
    **{f"{name.capitalize()}: PSNR in dB, higher is better": FIRST[f"{name}_psnr"] for name in RECOVERED},
    "Picture: PSNR in dB (sRGB), higher is better": FIRST["psnr_srgb"],
    "Loss: lower is better": LOSS,
}
"""Charts of the tab of custom scalars."""
CARD = 165
"""Pictures are at least so many pixels wide and less than twice as many, so that TensorBoard's cards, 350 pixels wide,
show them and their words as they are."""
GROUPS = ("sampling", "objective", "optimization")
"""Settings of the model that the tab of hyperparameters has, after those with a capital: it sorts them, and shows the
first five."""


class Board:
    """What TensorBoard shows of a run. It cannot dash the lines of its charts, so what needs no fit, such as the best
    constant, stands in pictures of charts beside them.
    """

    def __init__(self, events: EventFile, module: InverseRenderer, settings: Mapping[str, Any]) -> None:
        self._events = events
        self._scene = module.scene.name
        self._settings = {"Scene": self._scene, "Method": method_name(module), "materials": module.settings.materials}
        self._settings |= {key: plain(value) for key, value in settings.items()}
        for group in GROUPS:
            values = getattr(module.settings, group)
            assert is_dataclass(values)
            self._settings |= {f"{group}.{key}": plain(value) for key, value in asdict(values).items()}  # type: ignore[arg-type]
        self._begun = False

    def scores(self, scores: Mapping[str, float], rows: Sequence[Row]) -> None:
        """Points of an evaluation, and pictures of the curves of ``metrics.csv``, whose last row is its own."""
        from torch.utils.tensorboard.summary import text

        marks = {end[1:] for end in MARKS.values()}  # scores of what needs no fit
        own = {name: value for name, value in scores.items() if not marks.intersection(name.split("_"))}
        self._begin(own)
        iteration, seconds = int(rows[-1]["iteration"]), int(rows[-1]["seconds"])
        for name, value in own.items():
            if value == math.inf:  # which no curve can show
                self._events.add(text(FIRST.get(name, f"more/{name}"), EXACT), iteration)  # type: ignore[no-untyped-call]
                continue
            self._scalar(FIRST.get(name, f"more/{name}"), value, iteration)
            if name in FIRST:
                self._scalar(f"more/by_seconds_{name}", value, seconds)
        for title, name, lines in report.curves(rows):
            self.picture(f"{FIRST[name]}_chart", plot(title, report.BETTER, report.SECONDS, lines), iteration)

    def lamps(self, module: InverseRenderer, iteration: int) -> None:
        """The radiance of lamps that are recovered."""
        for row in rows(module.assembly):
            for channel in "rgb":
                self._scalar(f"more/lamp_{row['mesh']}_{channel}", float(row[channel]), iteration)

    def losses(self, losses: Mapping[str, Any], iteration: int) -> None:
        """The sum of all losses, and each of them."""
        if losses:
            self._scalar(LOSS, sum(float(value) for value in losses.values()), iteration)
        for name, value in losses.items():
            self._scalar(f"more/loss_{name}", float(value), iteration)

    def sheets(self, views: Sequence[Mapping[str, Any]], scale: float, iteration: int) -> None:
        """The pictures of each view, a card each, radiance times ``scale``."""
        for index, view in enumerate(views):
            name = pictures.view_name(view, index)
            sheet = pictures.view_sheet(view, scale, "")
            for tile in sheet.tiles:
                card = Sheet(f"{self._scene}, {name}", {"": [tile]}, sheet.unseen, widths=(CARD, CARD))
                self.picture(f"views/{name}/{tile.key}", draw(card), iteration)

    def picture(self, tag: str, pixels: Any, iteration: int) -> None:
        """A picture [h, w, 3], packed faster than TensorBoard's own writer does."""
        from tensorboard.compat.proto.summary_pb2 import Summary  # type: ignore[import-untyped]

        height, width = pixels.shape[:2]
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=png(pixels))
        self._events.add(Summary(value=[Summary.Value(tag=tag, image=image)]), iteration)

    def _begin(self, scores: Mapping[str, float]) -> None:
        """Lay out the charts that there will be, and list the settings."""
        if self._begun:
            return
        self._begun = True
        from torch.utils.tensorboard.summary import custom_scalars, hparams

        tags = [tag for name, tag in FIRST.items() if name in scores]
        charts = {title: ["Multiline", [f"^{tag}$"]] for title, tag in CHARTS.items() if tag in (*tags, LOSS)}
        self._events.add(custom_scalars({"neurad": charts}))  # type: ignore[no-untyped-call]
        experiment, start, end = hparams(self._settings, dict.fromkeys(tags))  # type: ignore[no-untyped-call]
        for summary in (experiment, start, end):
            self._events.add(summary)

    def _scalar(self, tag: str, value: float, iteration: int) -> None:
        from tensorboard.compat.proto.summary_pb2 import Summary

        self._events.add(Summary(value=[Summary.Value(tag=tag, simple_value=value)]), iteration)


def method_name(module: InverseRenderer) -> str:
    """The method's, as its class is called."""
    return type(module.settings.method).__name__.lower()


def plain(value: Any) -> Any:
    """A setting as TensorBoard takes it."""
    return value if isinstance(value, bool | int | float | str) else str(value)
