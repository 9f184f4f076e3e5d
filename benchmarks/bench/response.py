"""``neurad bench response``: what photographs ask of a fit's roughness, beside what is wrong with it."""

from __future__ import annotations

import argparse
from pathlib import Path

from neurad.core.ranges import Count, option

COLUMNS = ("table", "row", "part", "value", "standard_error")
SLOPES = ("all patches", "best known third")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--ckpt_path", metavar="RUN", help="run folder or checkpoint of a fit (default: the newest run)"
    )
    parser.add_argument("--root", metavar="DIR", help="where the scene's folder is now, if it has moved since the fit")
    parser.add_argument(
        "--pixels", type=option(Count), default=1 << 18, help="training pixels, at most (default: 262144)"
    )
    parser.add_argument("--spp", type=option(Count), default=64, help="samples in each (default: 64)")
    parser.add_argument("--out", metavar="FILE.csv", help="write the tables here too")


def run(options: argparse.Namespace) -> None:
    """Measure and print both tables.

    Raises:
        InputError: there is no such run, it has no roughness, or its scene has no true maps of its training views.
    """
    from benchmarks.response import BINS, measure_response
    from neurad.runs.load import load_run
    from neurad.runtime.tables import align, write_csv

    loaded = load_run(options.ckpt_path, options.root, other_light=False)
    found = measure_response(loaded, options.pixels, options.spp, lambda text: print(f"neurad: {text}", flush=True))
    low, high = BINS
    bins = (f"below {low:g}", f"{low:g} to {high:g}", f"above {high:g}", f"below {high:g}, best known third")
    tables = {
        "asked for, over what is wrong": (SLOPES, found.slopes),
        "change asked for at the truth": (bins, found.displaced),
    }
    print(f"\n{loaded.scene.name}, {loaded.iteration} steps, training views, before the closing step")
    print(f"roughness is off by {found.wrong:.3f} (root mean square over pixels)")
    rows: list[dict[str, str | float]] = []
    for title, (parts, asked) in tables.items():
        print()
        print("\n".join(align([[title, *parts], *([row.name, *map(str, row.parts)] for row in asked)], left=(0,))))
        rows += [
            {"table": title, "row": row.name, "part": part, "value": x.value, "standard_error": x.error}
            for row in asked
            for part, x in zip(parts, row.parts, strict=True)
        ]
    if options.out:
        write_csv(Path(options.out), COLUMNS, rows)
