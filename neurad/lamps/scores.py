"""Scores of lamps whose radiance was recovered, where the truth is given."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Float64Array
from neurad.runtime.numbers import RADIANCE
from neurad.runtime.reading import regular_file
from neurad.runtime.tables import read_csv

MIN_CHANNEL = 0.05
"""Fraction of a lamp's brightest channel that errors of the others are relative to at least."""
ERROR = "lamp_error"
"""Begins the columns of the errors."""
MISSED, EXTRA = "lamps_missed", "lamps_extra"
"""Columns of a run that finds which meshes shine: how many that do were not found, and how many found do not."""


def read_lamps_true(
    path: str, names: Sequence[str], found: bool = False, wholes: Mapping[str, str] = MappingProxyType({})
) -> tuple[Float64Array, int]:
    """True radiance of lamps [m, 3], from a table with columns ``mesh``, ``r``, ``g`` and ``b``, as ``lamps.csv`` has
    them, and how many meshes of the table shine and are none of these.

    Args:
        path: of the table.
        names: of the lamps' meshes.
        found: they were found to shine, so one that the table lacks does not: its true radiance is 0.
        wholes: the mesh that each part of a split lamp belongs to; a part that the table lacks is as bright.

    Raises:
        InputError: there is no such table, a lamp is missing in it, or a radiance is no number or negative.
    """
    option = f"--data.lamps_true {path}"
    columns, rows = read_csv(Path(regular_file(path)))
    if missing := [name for name in ("mesh", "r", "g", "b") if name not in columns]:
        raise InputError(f"{option}: it has no column {missing[0]}; a table with mesh, r, g and b is needed")
    given: dict[str, list[float]] = {}
    for row in rows:
        try:
            rgb = [float(row[channel]) for channel in "rgb"]
        except ValueError:
            rgb = [math.nan]
        if not all(0.0 <= value <= RADIANCE for value in rgb):  # neither is NaN
            raise InputError(f"{option}: the radiance of {row['mesh']} must be three numbers from 0 to {RADIANCE:g}")
        if row["mesh"] in given:
            raise InputError(f"{option}: lamp {row['mesh']} stands in it twice")
        given[row["mesh"]] = rgb
    rows_of = [name if name in given else wholes.get(name, name) for name in names]
    if not found and (left := [name for name, row in zip(names, rows_of, strict=True) if row not in given]):
        raise InputError(f"{option}: lamp {left[0]} of the scene is not in it")
    missed = sum(any(rgb) for name, rgb in given.items() if name not in rows_of and name not in wholes.values())
    return np.array([given.get(name, [0.0] * 3) for name in rows_of]).reshape(-1, 3), missed


def lamp_error(found: Float64Array, truth: Float64Array) -> Float64Array:
    """Largest relative error of a channel, for each lamp: [m, 3] and [m, 3] to [m]. It is 1 where none shines."""
    least = MIN_CHANNEL * truth.max(-1, keepdims=True)
    error: Float64Array = (np.abs(found - truth) / np.maximum(np.maximum(truth, least), 1e-30)).max(-1)
    return np.where(truth.any(-1), error, 1.0)


def lamp_scores(
    found: Float64Array, truth: Float64Array, names: Sequence[str], factors: Mapping[str, Float64Array]
) -> dict[str, float]:
    """Errors of the radiance [m, 3] of all lamps, by the columns of ``metrics.csv``: of each, and the largest. Factors
    of the albedo, by their names, are [3] each: what albedo is to be multiplied by, light is divided by.
    """
    scores = {}
    for kind, factor in {"": np.ones(3), **{f"_{key}": value for key, value in factors.items()}}.items():
        errors = lamp_error(found / factor, truth)
        if len(errors):
            scores[f"{ERROR}{kind}"] = float(errors.max())
        for name, error in zip(columns_of(names), errors, strict=True):
            scores[f"{ERROR}{kind}_{name}"] = float(error)
    return scores


def columns_of(names: Sequence[str]) -> list[str]:
    """Names of lamps as the ends of columns: without what parts columns, and each once."""
    plain = ["".join("_" if char in ',"\n\r' else char for char in name) for name in names]
    return [name if plain.count(name) == 1 else f"{name}_{index}" for index, name in enumerate(plain)]
