"""``neurad bench capture``: what errors of poses, mesh and photographs cost, in dB of the recovered materials."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from neurad.core.ranges import Count, Positive, option

if TYPE_CHECKING:
    from neurad.runtime.tables import Cell, Record

EXACT = "nothing"
"""The damage that the others are compared with."""
SCORES = ("albedo_psnr_seen", "roughness_psnr_seen")
FIT = ("damage", "seed", *SCORES, "pixels", "seconds")
"""Columns of a fit; ``pixels`` are those by which its cameras see surface points beside the right place, the median."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from benchmarks.bench.options import add_settings

    add_settings(parser, "scene.yaml")
    parser.add_argument("--side", type=option(Count), default=96, help="width of the training photographs in pixels")
    parser.add_argument("--steps", type=option(Count), default=1000, help="of each fit")
    parser.add_argument("--seeds", default="0,1,2", help="seeds of fits and damages, separated by commas")
    parser.add_argument("--metre", type=option(Positive), default=1.0, help="scene units in a metre")
    parser.add_argument("--only", default="", metavar="TEXT", help="damages whose names have one of these, by commas")
    parser.add_argument("--fits", metavar="FILE.csv", help="add each fit here; those it has are not made again")
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Fit the room as it is and with each damage, and print what the damage lost; pairs of fits have one seed.

    Raises:
        InputError: the settings are wrong, or the scene lacks photographs or true maps.
    """
    from benchmarks.bench.damage import DAMAGES
    from benchmarks.bench.machine import describe, report
    from neurad.core.errors import InputError
    from neurad.runtime.tables import numbers, read_csv, write_csv

    words = [word for word in options.only.split(",") if word]
    names = [name for name in DAMAGES if not words or name == EXACT or any(word in name for word in words)]
    if not options.seeds.replace(",", "").isdigit():
        raise InputError(f"--seeds {options.seeds}: these are not whole numbers separated by commas")
    seeds = [int(word) for word in options.seeds.split(",") if word]
    kept = Path(options.fits) if options.fits else None
    rows: list[Record] = []
    if kept is not None and kept.exists():
        rows = [
            {"damage": row.pop("damage"), "seed": int(row.pop("seed")), **numbers(row)} for row in read_csv(kept)[1]
        ]
    for seed in seeds:
        for name in names:
            if any((row["damage"], row["seed"]) == (name, seed) for row in rows):
                continue
            rows.append(measure(options, name, seed))
            print("neurad: " + ", ".join(f"{key} {rows[-1][key]}" for key in FIT), flush=True)
            if kept is not None:
                write_csv(kept, list(FIT), rows)
    title = f"lost by the damage, {len(seeds)} seeds, {options.steps} steps of {options.side} pixels, {describe()}"
    report(losses([row for row in rows if row["seed"] in seeds and row["damage"] in names]), title, options.out)


def measure(options: argparse.Namespace, name: str, seed: int) -> Record:
    """One fit of the damaged room, scored on its held-out views, whose cameras are right."""
    import gc
    import tempfile
    import time
    from dataclasses import replace
    from statistics import median

    import lightning.pytorch as pl

    from benchmarks.bench.damage import DAMAGES, captured
    from benchmarks.bench.session import prepare
    from neurad.evidence.camera_motion import apart

    class Scored(pl.Callback):
        """Scores of the end of a fit."""

        scores: dict[str, float]

        def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            self.scores = pl_module.evaluate(1).scores  # type: ignore[operator]

    seeded = argparse.Namespace(**{**vars(options), "set": [*options.set, f"seed_everything={seed}"]})
    gc.collect()  # the fit before this one holds itself by a circle, a gigabyte of it
    trainer, module, data = prepare(seeded, options.steps)
    capture = captured(data.scene, seed, options.metre)
    for change in DAMAGES[name]:
        change(capture)
    scored, begin = Scored(), time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        trainer.callbacks = [scored]  # type: ignore[attr-defined]
        trainer.fit(module, data.over(capture.written(Path(folder), options.side)))
    seconds, fitted = time.perf_counter() - begin, [view.camera for view in module.scene.train]
    off = [
        apart(replace(a, width=b.width, height=b.height), b, module.assembly.world)
        for a, b in zip(capture.right, fitted, strict=True)
    ]
    scores = {key: scored.scores.get(key) for key in SCORES}
    return {"damage": name, "seed": seed, **scores, "pixels": median(off), "seconds": seconds}


def losses(rows: list[Record]) -> list[Record]:
    """Mean over the seeds of what each damage lost, in dB, and its standard error; the first row has the exact scores.

    Args:
        rows: of fits, as :data:`FIT` says.
    """
    import math
    from statistics import mean, stdev

    exact = {row["seed"]: row for row in rows if row["damage"] == EXACT}
    table: list[Record] = []
    for name in dict.fromkeys(row["damage"] for row in rows):
        mine = [row for row in rows if row["damage"] == name and row["seed"] in exact]
        made: dict[str, Cell] = {"damage": name, "seeds": len(mine)}
        for key in SCORES:
            pairs = [(exact[row["seed"]][key], row[key]) for row in mine]
            known = [(float(a), float(b)) for a, b in pairs if a is not None and b is not None]
            values = [b if name == EXACT else a - b for a, b in known]
            what = key.removesuffix("_psnr_seen")
            made[what] = mean(values) if values else None
            made[f"{what}_error"] = stdev(values) / math.sqrt(len(values)) if len(values) > 1 else None
        made["pixels"] = mean(float(row["pixels"] or 0.0) for row in mine) if mine else None
        table.append(made)
    return table
