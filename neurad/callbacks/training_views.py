"""``views.csv``: how well each training view agrees with the others; and the line that names those that do not."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from neurad.core.records import FloatArray
from neurad.core.scene_records import View
from neurad.evidence.view_residuals import outliers
from neurad.fields.development import FittedDevelopment
from neurad.runtime.files import write_text
from neurad.runtime.progress import say
from neurad.runtime.tables import Record, write_csv

COLUMNS = ("view", "surface", "residual", "iteration")
"""``surface`` is the fraction of its pixels that meet a surface, ``residual`` the mean relative difference between
photograph and what is recovered, both in [0, 1]."""
LEARNT = 0.1
"""Median residual below which one evaluation is enough to name a view; above, a second one in a row has to agree, since
a field that has seen little is unsure."""


class ViewTable:
    """Keeps ``views.csv`` of a run, and names views that stand out, each once."""

    def __init__(self, names: Sequence[str], surface: FloatArray) -> None:
        self.names = names
        self.surface = surface
        """Fraction of each view's pixels that meet a surface."""
        self._found: dict[int, int] = {}
        self._named: set[int] = set()

    def update(self, folder: Path | None, iteration: int, residuals: FloatArray) -> None:
        """Write the present ``residuals`` [views], and say which views are far outside the others."""
        far = outliers(residuals)
        median = float(np.nanmedian(residuals))
        self._found = {view: self._found.get(view, 0) + (1 if median > LEARNT else 2) for view in far}
        named = [view for view in far if self._found[view] > 1 and view not in self._named]
        self._named.update(named)
        if named:
            listed = ", ".join(f"{self.names[view]} ({residuals[view]:.2f})" for view in named)
            say(
                f"training view{'s' if len(named) > 1 else ''} {listed} differ{'' if len(named) > 1 else 's'} "
                f"from the photographs far more than the others (median {median:.2f}): check the pose, or leave "
                f"{'them' if len(named) > 1 else 'it'} out; views.csv has all"
            )
        if folder is not None:
            rows: list[Record] = [
                {"view": name, "surface": float(seen), "residual": float(value), "iteration": iteration}
                for name, seen, value in zip(self.names, self.surface, residuals, strict=True)
            ]
            write_csv(folder / "views.csv", COLUMNS, rows)


def write_exposures(folder: Path | None, views: Sequence[View], development: FittedDevelopment, iteration: int) -> None:
    """Write ``exposures.csv`` into a run folder, what photographs were multiplied by as far as a fit has recovered it,
    and where the response curve is recovered ``response.csv``, in the form that ``--data.response`` reads.
    """
    if folder is None:
        return
    rows: list[Record] = [
        {
            "view": view.name,
            "known": view.development.gain,
            **{colour: float(value) for colour, value in zip("rgb", found, strict=True)},
            "iteration": iteration,
        }
        for view, found in zip(views, development.exposures(), strict=True)
    ]
    write_csv(folder / "exposures.csv", ("view", "known", "r", "g", "b", "iteration"), rows)
    if development.bend is not None:
        with torch.no_grad():
            curve = development.curve().tolist()
        points = [f"{i / (len(curve) - 1):.6g},{value:.9g}\n" for i, value in enumerate(curve)]
        write_text(folder / "response.csv", "".join(points))
