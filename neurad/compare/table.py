"""One row a method: what it cost, what it reached, and when."""

import math
import statistics
from collections.abc import Sequence

from neurad.compare.runs import SCORES, Run, by_method, marks, stages
from neurad.core.decibels import figure
from neurad.runtime.tables import Cell

MIN_ITERATIONS = 100
"""Iterations from which on the scores of a fit say something of its method."""
TOO_FEW = "too few iterations"
RATES = ("ms_per_step", "rays_per_second", "samples_per_second")

TableRow = dict[str, Cell]


def columns(reach: Sequence[float]) -> list[str]:
    """Names of the columns, in order."""
    times = [f"seconds_to_albedo_{value:g}" for value in reach]
    costs = ["seconds", "iterations", "processor_seconds", "samples"]
    return ["method", "stages", "seeds", *costs, *SCORES, *times, *RATES, "peak_memory_mib", "status"]


def rates(run: Run) -> dict[str, float]:
    """Milliseconds a step, rays and path samples a training second, between the first evaluation and the last.

    Set-up and compilation lie before the first evaluation. A run with one evaluation has none of these.
    """
    if len(run.rows) < 2:
        return {}
    first, last = run.rows[0], run.rows[-1]
    seconds = last["seconds"] - first["seconds"]
    steps = last.get("iteration", 0.0) - first.get("iteration", 0.0)
    if seconds <= 0 or steps <= 0:
        return {}
    found = {"ms_per_step": 1000.0 * seconds / steps}
    for name in ("rays", "samples"):
        if name in first and name in last:
            found[f"{name}_per_second"] = (last[name] - first[name]) / seconds
    return found


def seconds_to(run: Run, albedo_psnr: float) -> float:
    """Training seconds at the first evaluation that reaches ``albedo_psnr``; infinite if none does."""
    reached = (row["seconds"] for row in run.rows if row.get("albedo_psnr", -math.inf) >= albedo_psnr)
    return next(reached, math.inf)


def table(runs: Sequence[Run], reach: Sequence[float]) -> list[TableRow]:
    """The rows: medians over the seeds of each method, then the best constant and the lookup by the true colours. They
    have the time of the albedo PSNRs ``reach`` in dB.
    """
    rows = [_row(method, group, reach) for method, group in by_method(runs).items()]
    return rows + [{"method": label, **scores} for label, scores in marks(runs).items()]


def _row(method: str, group: Sequence[Run], reach: Sequence[float]) -> TableRow:
    done = [run for run in group if not run.message]
    notes = [f"failed (seed {run.seed}): {run.message}" for run in group if run.message]
    notes += [f"{TOO_FEW} (seed {run.seed})" for run in done if run.last.get("iteration", math.inf) < MIN_ITERATIONS]
    row: TableRow = {"method": method, "seeds": float(len(done)), "status": "; ".join(notes) or "ok"}
    row["stages"] = " or ".join(dict.fromkeys(stages(run.config) for run in done))
    row["iterations"] = _median([run.last.get("iteration") for run in done])
    row["processor_seconds"] = _median([run.processor_seconds for run in done])
    for name in ("seconds", "samples", *SCORES):
        row[name] = _median([run.last.get(name) for run in done])
    for value in reach:
        middle = _median([seconds_to(run, value) for run in done])
        row[f"seconds_to_albedo_{value:g}"] = None if middle == math.inf else middle
    for name in RATES:
        row[name] = _median([rates(run).get(name) for run in done])
    row["peak_memory_mib"] = _median([run.peak_memory_mib for run in done])
    return row


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


_DIGITS = {"seeds": 0, "seconds": 1, "iterations": 0, "processor_seconds": 1, "ms_per_step": 1, "peak_memory_mib": 0}
_IN_THOUSANDS = {"samples": 1, "rays_per_second": 0, "samples_per_second": 1}
"""Digits after the point by column; in the second of thousands, while there is no million."""


def cell_text(name: str, cell: Cell) -> str:
    """A cell with the digits that matter."""
    if cell is None or isinstance(cell, str):
        return cell or ""
    if name in _IN_THOUSANDS:
        return f"{cell / 1e3:.{_IN_THOUSANDS[name]}f} k" if cell < 1e6 else f"{cell / 1e6:.2f} M"
    if name in _DIGITS or name.startswith("seconds_to_"):
        return f"{cell:.{_DIGITS.get(name, 1)}f}"
    return f"{cell:.3f}" if "mape" in name or name == "lamp_error" else figure(cell)
