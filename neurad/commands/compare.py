"""``neurad compare``: several methods on one scene with one budget, and a report of error against cost."""

from __future__ import annotations

import argparse
import json
import math
import re
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from neurad.core.errors import InputError

if TYPE_CHECKING:
    from neurad.studies.report.runs import Run

SHARE = 0.5
"""Share of the training time that evaluations may take here: they do not count, and curves need points."""

EPILOG = """Settings of `neurad fit` such as --data.root DIR are passed on to every fit.

  neurad compare --config kitchen.yaml --methods ours,no_prior,direct,path,prb --budget 120
  neurad compare ours=lightning_logs/version_3 prb=lightning_logs/version_4 --out report
"""


@dataclass(frozen=True)
class Fit:
    """One run to be made."""

    method: str
    seed: int
    folder: Path
    arguments: tuple[str, ...]
    """Of ``neurad fit``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.usage = (
        "neurad compare --config NAME.yaml --methods A,B,... (--budget SECONDS | --samples N) [--KEY VALUE ...]\n"
        "       neurad compare [NAME=]RUN ..."
    )
    parser.add_argument("runs", nargs="*", metavar="[NAME=]RUN", help="finished runs, or the folder of a report")
    parser.add_argument("--config", "-c", action="append", default=[], help="config of the scene; may be repeated")
    parser.add_argument("--methods", help="names of overlays in configs/methods, or YAML files, separated by commas")
    parser.add_argument("--budget", type=float, help="training seconds of every fit, evaluations not counted")
    parser.add_argument("--samples", type=float, help="path samples of every fit instead")
    parser.add_argument("--seeds", default="0", help="seeds separated by commas; several give bands (default: 0)")
    parser.add_argument("--out", type=Path, default=Path("report"), help="folder of the report (default: report)")
    parser.add_argument("--overwrite", action="store_true", help="write over a report that is there")
    parser.add_argument("--views", type=int, default=3, help="held-out views to show, 0 for none (default: 3)")
    parser.add_argument("--view-spp", type=int, default=16, help="samples a pixel of the renders shown (default: 16)")
    parser.add_argument(
        "--reach", default="20,22,24,26,28,30", help="albedo PSNRs in dB whose time is reported (default: %(default)s)"
    )


def parse(parser: argparse.ArgumentParser, words: Sequence[str]) -> argparse.Namespace:
    """The verb's own options, and in ``settings`` those of ``neurad fit`` as ``--key=value``."""
    own, settings = [], []
    queue = list(words)
    while queue:
        word = queue.pop(0)
        key = word.partition("=")[0]
        if not key.startswith("--") or not ("." in key or key == "--seed_everything"):
            own.append(word)
            continue
        if "=" not in word and queue and not queue[0].startswith("--"):
            word = f"{word}={queue.pop(0)}"
        settings.append(word)
    options = parser.parse_args(own)
    options.settings = settings
    options.words = list(words)
    return options


def run(options: argparse.Namespace) -> None:
    """Run what is to be compared, one fit after the other, and write the report.

    Raises:
        InputError: the user's mistake, before anything is written.
        SystemExit: with 1 if a fit failed; the report then has the others.
    """
    reach = sorted(_numbers("--reach", options.reach))
    if options.views < 0 or options.view_spp < 1:
        raise InputError("--views and --view-spp: they have to be positive numbers")
    runs = _finished(options) if options.runs else _fitted(options)
    failed = [run for run in runs if run.message]
    budget = _budget(options)
    if options.views:
        failed += _predict(runs, options.view_spp)
    from neurad.studies.report.write import write_report

    command = ["neurad", "compare", *options.words]
    write_report(options.out, runs, reach, options.views, command, budget)
    print(f"neurad: report {options.out / 'index.html'}")
    if failed:
        names = ", ".join(f"{run.method} (seed {run.seed})" for run in failed)
        print(f"neurad: error: not everything was made: {names}", file=sys.stderr)
        raise SystemExit(1)


def _numbers(option: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(f"{option} {text}: it is not a list of numbers separated by commas") from None
    if not all(math.isfinite(value) for value in values):
        raise InputError(f"{option} {text}: its numbers have to be finite")
    return values


def _budget(options: argparse.Namespace) -> str:
    """The budget in words."""
    if options.budget is not None:
        return f"Every fit had {options.budget:g} training seconds"
    return f"Every fit drew {options.samples:g} path samples" if options.samples is not None else ""


def _check_free(out: Path, overwrite: bool) -> None:
    """Refuse a folder that has anything in it."""
    if out.exists() and not out.is_dir():
        raise InputError(f"--out {out}: it is no folder")
    if not overwrite and out.is_dir() and any(out.iterdir()):
        raise InputError(f"--out {out}: it is there already; add --overwrite to write over it")


# ---- finished runs


def _finished(options: argparse.Namespace) -> list[Run]:
    """The runs named on the command line."""
    from neurad.studies.report.runs import read_run

    given = [
        name
        for name, value in (
            ("--config", options.config),
            ("--methods", options.methods),
            ("--budget", options.budget),
            ("--samples", options.samples),
            *((word.partition("=")[0], word) for word in options.settings),
        )
        if value
    ]
    if given:
        raise InputError(f"{given[0]}: finished runs are compared as they are; name runs or methods, not both")
    folders: list[tuple[str | None, Path]] = []
    for word in options.runs:
        label, _, path = ("", "", word) if Path(word).is_dir() else word.partition("=")
        folders += [(label or None, folder) for folder in _run_folders(Path(path or word))]
    if not _is_own(options.out, folders):
        _check_free(options.out, options.overwrite)
    runs = [read_run(folder, label) for label, folder in folders]
    names = {path.resolve().name for _, path in folders}
    if len(names) < len(folders):  # version_0 of two folders would pass for two seeds of one method
        for run, (label, path) in zip(runs, folders, strict=True):
            if label is None and run.method == path.resolve().name:
                run.method = str(path)
    return runs


def _run_folders(path: Path) -> list[Path]:
    """The run folder itself, or those in the folder of a report."""
    from neurad.studies.report.runs import runs_in

    if not path.is_dir():
        raise InputError(f"{path}: no such run folder")
    if (path / "runs").is_dir() and not (path / "metrics.csv").is_file():
        return runs_in(path)
    return [path]


def _is_own(out: Path, folders: Sequence[tuple[str | None, Path]]) -> bool:
    """Whether the report is to be made anew from the very runs in its folder."""
    return bool(folders) and all(folder.resolve().parent == (out / "runs").resolve() for _, folder in folders)


# ---- runs to be made


def _fitted(options: argparse.Namespace) -> list[Run]:
    """Fit every method with every seed."""
    fits = _plan(options)
    runs = []
    for number, fit in enumerate(fits, 1):
        print(f"neurad: {fit.method}, seed {fit.seed} ({number} of {len(fits)}) ...", flush=True)
        run = _make(fit, number)
        runs.append(run)
        scores = f"albedo {run.last['albedo_psnr']:.2f} dB" if "albedo_psnr" in run.last else "done"
        seconds = f"{run.last.get('seconds', 0.0):.1f} s, "
        print(f"neurad: {fit.method}, seed {fit.seed}: {'failed: ' + run.message if run.message else seconds + scores}")
    return runs


def _plan(options: argparse.Namespace) -> list[Fit]:
    """Every fit with its arguments, checked before the first one starts.

    Raises:
        InputError: the user's mistake.
    """
    from neurad.runs.child import resolved_configs
    from neurad.runs.configs import find_config
    from neurad.studies.report.runs import samples_per_step

    if not options.config:
        raise InputError("--config NAME.yaml is needed to fit, or the folders of finished runs")
    if not options.methods:
        raise InputError("--methods is needed: names of overlays in configs/methods, separated by commas")
    if (options.budget is None) == (options.samples is None):
        raise InputError("one of --budget SECONDS and --samples N is needed")
    amount = options.budget if options.samples is None else options.samples
    if not (amount > 0 and math.isfinite(amount)):
        raise InputError(f"--{'budget' if options.samples is None else 'samples'}: {amount:g} is not a positive number")
    seeds = _seeds(options.seeds)
    overlays = {Path(name).stem: name for name in options.methods.split(",") if name.strip()}
    if len(overlays) < len(options.methods.split(",")):
        raise InputError(f"--methods {options.methods}: two of them have the same name, or one has none")
    for name in options.config:
        find_config(name)
    _check_free(options.out, options.overwrite)
    common: dict[str, list[str]] = {}
    for method, name in overlays.items():
        overlay = name if name.endswith((".yaml", ".yml")) else f"{name if '/' in name else f'methods/{name}'}.yaml"
        find_config(overlay)
        configs = [f"--config={config}" for config in [*options.config, overlay]]
        share = (
            []
            if any("evaluation.fraction" in word for word in options.settings)
            else [f"--evaluation.fraction={SHARE}"]
        )
        common[method] = [*configs, *share, *options.settings]
    configs_of = dict(zip(common, resolved_configs(list(common.values())), strict=True))
    fits = []
    for method, arguments in common.items():
        limits = _time_limit(options.budget) if options.samples is None else None
        if limits is None:
            per_step = samples_per_step(configs_of[method])
            if not per_step:
                raise InputError(f"--samples: the settings of {method} do not tell how many samples a step draws")
            limits = ["--trainer.max_time=null", f"--trainer.max_steps={max(1, round(options.samples / per_step))}"]
        for seed in seeds:
            folder = options.out / "runs" / f"{method}_{seed}"
            place = [f"--trainer.default_root_dir={folder}", "--trainer.enable_progress_bar=false"]
            fits.append(Fit(method, seed, folder, (*arguments, *limits, *place, f"--seed_everything={seed}")))
    # Seeds take turns, so that a machine that slows down does so for every method.
    return sorted(fits, key=lambda fit: seeds.index(fit.seed))


def _seeds(text: str) -> list[int]:
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise InputError(f"--seeds {text}: it is not a list of whole numbers separated by commas")
    return list(dict.fromkeys(int(part) for part in text.split(",")))


def _time_limit(seconds: float) -> list[str]:
    """Arguments that end a fit after training ``seconds``; ``max_time`` stands there so that the fit has a limit."""
    whole = math.ceil(seconds)
    days, hours, minutes = whole // 86400, whole // 3600 % 24, whole // 60 % 60
    budget = {"class_path": "neurad.callbacks.budget.TrainingBudget", "init_args": {"seconds": seconds}}
    return [
        f"--trainer.max_time={days:02d}:{hours:02d}:{minutes:02d}:{whole % 60:02d}",
        "--trainer.max_steps=-1",
        f"--trainer.callbacks+={json.dumps(budget)}",
    ]


def _make(fit: Fit, order: int) -> Run:
    """Fit in a process of its own; whatever goes wrong there is this run's alone."""
    from neurad.runs.child import run_neurad
    from neurad.studies.report.runs import FACTS, read_run

    if fit.folder.exists():
        shutil.rmtree(fit.folder)
    fit.folder.mkdir(parents=True)
    log = fit.folder / "output.txt"
    facts = {"method": fit.method, "seed": fit.seed, "order": order, "command": ["neurad", "fit", *fit.arguments]}
    (fit.folder / FACTS).write_text(json.dumps(facts | {"message": "it did not end"}, indent=1) + "\n")
    ended = run_neurad(["fit", *fit.arguments], log)
    # Lightning numbers its runs; here the folder is the run.
    made = fit.folder / "lightning_logs" / "version_0"
    if made.is_dir():
        for path in made.iterdir():
            path.rename(fit.folder / path.name)
        shutil.rmtree(fit.folder / "lightning_logs")
    message = ended.message
    if not message and not (fit.folder / "metrics.csv").is_file():
        message = "it wrote no metrics.csv"
    facts |= {
        "message": message,
        "exit_code": ended.code,
        "wall_seconds": round(ended.seconds, 2),
        "peak_memory_mib": ended.peak_memory_mib,
    }
    (fit.folder / FACTS).write_text(json.dumps(facts, indent=1) + "\n")
    return read_run(fit.folder)


def _predict(runs: Sequence[Run], spp: int) -> list[Run]:
    """Let every method's first finished run write its held-out views, unless it has; returns those that failed."""
    from neurad.runs.child import run_neurad
    from neurad.studies.report.runs import by_method

    failed = []
    for group in by_method([run for run in runs if not run.message]).values():
        run = group[0]
        checkpoint = run.folder / "checkpoints" / "last.ckpt"
        if any((run.folder / "images").glob("*.exr")) or not checkpoint.is_file():
            continue
        print(f"neurad: {run.method}: held-out views ...", flush=True)
        words = [f"--ckpt_path={checkpoint}", f"--evaluation.test_spp={spp}", "--trainer.enable_progress_bar=false"]
        ended = run_neurad(["predict", *words], run.folder / "predict.txt")
        if ended.code != 0:
            print(f"neurad: {run.method}: no pictures: {ended.message}", file=sys.stderr)
            failed.append(run)
    return failed
