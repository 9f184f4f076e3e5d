"""What a stress case is, and how it is judged."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from neurad.runtime.tables import Cell


@dataclass(frozen=True)
class Outcome:
    """What a case measured."""

    error: float
    """Distance from the oracle, in the case's measure."""
    bar: float | None
    """Largest error that passes; None where a figure is only stated."""
    note: str = ""
    """Further figures: steps, the value reached, a ratio."""


@dataclass(frozen=True)
class Case:
    """One row of the table."""

    family: str
    """Group of rows, also what ``--only`` picks."""
    extreme: str
    """What is extreme about it."""
    oracle: str
    """What the answer is compared with, and how."""
    measure: Callable[[bool], Outcome]
    """Runs the case; True selects the short form."""
    quick: bool = True
    """Whether the case belongs to ``--quick``."""


def judge(case: Case, quick: bool) -> dict[str, Cell]:
    """Run a case: the row of the table, its ``verdict`` 'ok', 'FAIL' or, for a figure without a bar, 'stated'.

    One that raises has failed, with the reason in its row, and the others still run.

    Args:
        case: what to run.
        quick: run its short form.
    """
    begin = time.perf_counter()
    try:
        outcome = case.measure(quick)
    except Exception as error:
        text = " ".join(str(error).split())
        outcome = Outcome(math.nan, 0.0, f"{type(error).__name__}: {text}"[:300])
    seconds = time.perf_counter() - begin
    if not math.isfinite(outcome.error):
        verdict = "FAIL"
    elif outcome.bar is None:
        verdict = "stated"
    else:
        verdict = "ok" if outcome.error <= outcome.bar else "FAIL"
    return {
        "family": case.family,
        "extreme": case.extreme,
        "oracle": case.oracle,
        "error": outcome.error,
        "bar": outcome.bar,
        "seconds": seconds,
        "verdict": verdict,
        "note": outcome.note,
    }
