"""``neurad bench bound``: how far a fit is from the best possible, a rung for each cause."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from neurad.core.ranges import Count, option
from neurad.runs.trust import add_trust

if TYPE_CHECKING:
    from benchmarks.bound.ladder import Rung

COLUMNS = ("rung", "cause", "albedo_psnr", "roughness_psnr", "albedo_psnr_lit_glossy", "roughness_psnr_lit_glossy")
HEADINGS = ("", "", "albedo PSNR", "roughness PSNR", "lit glossy: albedo", "roughness")
BOUND = "noise"
"""Rung that is the bound: what resolution and noise of the photographs leave."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--ckpt_path", metavar="RUN", help="run folder or checkpoint of a fit (default: the newest run)"
    )
    parser.add_argument("--root", metavar="DIR", help="where the scene's folder is now, if it has moved since the fit")
    add_trust(parser)
    parser.add_argument(
        "--spp", type=option(Count), default=8, help="samples a pixel behind what photographs tell (default: 8)"
    )
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Measure the ladder of a fit and print it, with the gap between the bound and the fit.

    Raises:
        InputError: there is no such run, or its scene has no true maps of its training views.
    """
    from benchmarks.bound.ladder import Ladder
    from neurad.runs.load import load_run
    from neurad.runtime.tables import align, write_csv

    begin = time.process_time()
    loaded = load_run(options.ckpt_path, options.root, other_light=False, trust=options.trust)
    found = Ladder(loaded, lambda text: print(f"neurad: {text}", flush=True)).climb(options.spp)
    rows = [[rung.name, rung.cause, *(_text(rung.scores.get(name)) for name in COLUMNS[2:])] for rung in found]
    print(f"\n{loaded.scene.name}, {loaded.iteration} steps, held-out views, dB")
    print("\n".join(align([list(HEADINGS), *rows], left=(0, 1))))
    maps = [what for what in ("albedo", "roughness") if f"{what}_psnr" in found[-1].scores]
    for what in maps:
        print(sentence(found, what))
    print(f"{time.process_time() - begin:.0f} s of processor time")
    if options.out:
        table = [dict(zip(COLUMNS, row, strict=True)) for row in rows]
        gaps = {f"{what}_gap_to_bound_db": gap(found, what) for what in maps}
        columns = [*COLUMNS, *gaps]
        write_csv(Path(options.out), columns, [*table[:-1], {**table[-1], **gaps}])


def gap(rungs: list[Rung], what: str) -> float:
    """``gap_to_bound_db``: how many dB of ``what`` the fit is below the bound."""
    bound = next(rung for rung in rungs if rung.name == BOUND)
    return bound.scores[f"{what}_psnr"] - rungs[-1].scores[f"{what}_psnr"]


def sentence(rungs: list[Rung], what: str) -> str:
    """The gap, the cause that adds the largest error, and which rungs the fit has passed: they hold for linear
    estimates, which a fit need not be.
    """
    ours = rungs[-1].error(what)
    added, above, passed = {}, 0.0, []
    for rung in rungs:
        if rung.error(what) > ours:
            passed.append(rung.name)
            continue
        added[rung.name], above = rung.error(what) - above, rung.error(what)
    largest = max(added, key=lambda name: added[name])
    said = f"{what}: gap_to_bound_db {gap(rungs, what):.2f}"
    said += f"; the largest rung is {largest}, {100 * added[largest] / ours:.0f} % of the squared error"
    return f"{said}; not counted, as the fit is better: {', '.join(passed)}" if passed else said


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
