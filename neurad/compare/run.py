"""The whole of ``neurad compare``: choose runs, or make them in processes of their own; let them write pictures; write
the report.

This module and all that it imports before the report is written stay small: on Linux a child process begins with the
peak memory of its parent, and the fits' peak memory is reported.
"""

import argparse
import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from neurad.compare.runs import FACTS, STAGES, Run, by_method, read_other, read_run, runs_in, samples_per_step
from neurad.core.decibels import decibels
from neurad.core.errors import InputError
from neurad.runs import child
from neurad.runs.configs import find_config
from neurad.runtime.files import check_folder, make_folder, write_text
from neurad.runtime.progress import phase, say
from neurad.runtime.reading import similar

RUNS = Path("lightning_logs")
"""Where runs lie that are given by name, such as ``version_3``."""
EVALUATION_FRACTION = 0.5
"""Fraction of the training time that evaluations may take here: they do not count, and curves need points."""
WARM_UP = '--trainer.callbacks+={"class_path": "WarmUp"}'
"""Argument of every fit: what comes before the end of the first iteration is left out of its seconds."""
POINTS = 20
"""Evaluations of a fit that its samples limit, however few steps these are."""
PLAIN = tuple(f"--{key}={value}" for key, (_, value) in STAGES.items())
"""Arguments of fits without any stage."""


def compare(options: argparse.Namespace) -> None:
    """Run what is to be compared, one fit after the other, and write the report.

    Args:
        options: those of the verb; ``settings`` are for the fits, ``words`` is the whole command line after the verb.

    Raises:
        InputError: the user's mistake, before anything is written.
        SystemExit: with 1 if a fit failed; the report then has the others.
    """
    reach = _reach(options.reach)
    others = [read_other(word) for word in options.run]
    if len({run.method for run in others}) < len(others):
        raise InputError("--run: two of them have the same name")
    runs = [*(_finished_runs(options) if options.runs else _fit_all(options)), *others]
    failed = [run for run in runs if run.message]
    if options.views:
        failed += _predict(runs, options.view_spp, options.trust)
    from neurad.compare.page import write_report

    with phase("writing") as writing:
        writing.detail = "the report"
        write_report(options, runs, reach)
    print(f"neurad: report {options.out / 'index.html'}")
    if failed:
        names = ", ".join(f"{run.method} (seed {run.seed})" for run in failed)
        say(f"error: not everything was made: {names}")
        raise SystemExit(1)


def _finished_runs(options: argparse.Namespace) -> list[Run]:
    """The runs named on the command line.

    Raises:
        InputError: one of them is no run, or options for new fits are given too.
    """
    given = [f"--{name}" for name in ("config", "methods", "budget", "samples", "plain") if getattr(options, name)]
    given += [word.partition("=")[0] for word in options.settings]
    if given:
        raise InputError(f"{given[0]}: finished runs are compared as they are; name runs or methods, not both")
    folders: list[tuple[str | None, Path]] = []
    for word in options.runs:
        label, _, path = ("", "", word) if Path(word).is_dir() else word.partition("=")
        folders += [(label or None, folder) for folder in _run_folders(Path(path or word))]
    own = (options.out / "runs").resolve()
    if not folders or any(folder.resolve().parent != own for _, folder in folders):  # else the report is made anew
        _check_free(options.out, options.overwrite)
    runs = [read_run(folder, label) for label, folder in folders]
    names = {path.resolve().name for _, path in folders}
    if len(names) < len(folders):  # version_0 of two folders would pass for two seeds of one method
        for run, (label, path) in zip(runs, folders, strict=True):
            if label is None and run.method == path.resolve().name:
                run.method = str(path)
    return runs


def _reach(text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(f"--reach {text}: it is not a list of numbers separated by commas") from None
    if not all(math.isfinite(value) for value in values):
        raise InputError(f"--reach {text}: its numbers have to be finite")
    return sorted(values)


def _run_folders(path: Path) -> list[Path]:
    """The run folder itself, or those in the folder of a report."""
    if not path.is_dir() and len(path.parts) == 1 and (RUNS / path).is_dir():
        path = RUNS / path
    if not path.is_dir():
        raise InputError(f"{path}: no such run folder{similar(path)}")
    if (path / "runs").is_dir() and not (path / "metrics.csv").is_file():
        return runs_in(path)
    return [path]


@dataclass(frozen=True)
class Fit:
    """One run to be made."""

    method: str
    seed: int
    folder: Path
    arguments: tuple[str, ...]
    """Command-line arguments of ``neurad fit``."""


def _fit_all(options: argparse.Namespace) -> list[Run]:
    fits = _plan(options)
    expected = None if options.budget is None else options.budget * (1.0 + EVALUATION_FRACTION / 2)
    runs = []
    for number, fit in enumerate(fits, 1):
        print(f"neurad: {fit.method}, seed {fit.seed} ({number} of {len(fits)}) ...", flush=True)
        with phase(f"{fit.method} {fit.seed}", None, expected) as making:
            making.detail = f"{number} of {len(fits)}"
            run = _make(fit, number)
        runs.append(run)
        scores = f"albedo {decibels(run.last['albedo_psnr'])}" if "albedo_psnr" in run.last else "done"
        seconds = f"{run.last.get('seconds', 0.0):.1f} s, "
        print(f"neurad: {fit.method}, seed {fit.seed}: {'failed: ' + run.message if run.message else seconds + scores}")
    return runs


def _plan(options: argparse.Namespace) -> list[Fit]:
    """Every fit with its arguments, checked before the first one starts."""
    if not options.config:
        raise InputError("--config NAME.yaml is needed to fit, or the folders of finished runs")
    if not options.methods:
        raise InputError("--methods is needed: names of overlays in configs/methods, separated by commas")
    if (options.budget is None) == (options.samples is None):
        raise InputError("one of --budget SECONDS and --samples N is needed")
    if not re.fullmatch(r"\d+(,\d+)*", options.seeds):
        raise InputError(f"--seeds {options.seeds}: it is not a list of whole numbers separated by commas")
    seeds = list(dict.fromkeys(int(part) for part in options.seeds.split(",")))
    overlays = {Path(name).stem: name for name in options.methods.split(",") if name.strip()}
    if len(overlays) < len(options.methods.split(",")):
        raise InputError(f"--methods {options.methods}: two of them have the same name, or one has none")
    for name in options.config:
        find_config(name)
    _check_free(options.out, options.overwrite)
    common = {method: _common(options, name) for method, name in overlays.items()}
    resolved = dict(zip(common, resolved_configs(list(common.values())), strict=True))
    fits = []
    for method, arguments in common.items():
        if options.samples is None:
            limits = time_limit(options.budget)
        else:
            per_step = samples_per_step(resolved[method])
            if not per_step:
                raise InputError(f"--samples: the settings of {method} do not say how many samples a step draws")
            steps = max(1, round(options.samples / per_step))
            limits = ["--trainer.max_time=null", f"--trainer.max_steps={steps}"]
            if resolved[method].get("evaluation", {}).get("every_n_steps") is None:
                limits.append(f"--evaluation.every_n_steps={max(1, steps // POINTS)}")
        for seed in seeds:
            folder = options.out / "runs" / f"{method}_{seed}"
            place = [f"--trainer.default_root_dir={folder}", "--trainer.enable_progress_bar=false", WARM_UP]
            fits.append(Fit(method, seed, folder, (*arguments, *limits, *place, f"--seed_everything={seed}")))
    # Seeds take turns, so that a machine that slows down does so for every method.
    return sorted(fits, key=lambda fit: seeds.index(fit.seed))


def _check_free(out: Path, overwrite: bool) -> None:
    """Refuse what is no folder and, unless ``overwrite``, one that has anything in it."""
    check_folder(out, "--out")
    if not overwrite and out.is_dir() and any(out.iterdir()):
        raise InputError(f"--out {out}: it is there already; add --overwrite to write over it")


def time_limit(seconds: float) -> list[str]:
    """Arguments that end a fit after training ``seconds``; ``max_time`` stands there so that the fit has a limit."""
    budget = {"class_path": "TrainingBudget", "init_args": {"seconds": seconds}}
    return [
        f"--trainer.max_time={math.ceil(seconds)}s",
        "--trainer.max_steps=-1",
        f"--trainer.callbacks+={json.dumps(budget)}",
    ]


def _predict(runs: Sequence[Run], spp: int, trust: Sequence[str]) -> list[Run]:
    """Let every method's first finished run write its held-out views, unless it has; returns those that failed."""
    failed = []
    for group in by_method([run for run in runs if not run.message]).values():
        run = group[0]
        checkpoint = run.folder / "checkpoints" / "last.ckpt"
        if any((run.folder / "images").glob("*.exr")) or not checkpoint.is_file():
            continue
        print(f"neurad: {run.method}: held-out views ...", flush=True)
        words = [f"--ckpt_path={checkpoint}", f"--evaluation.test_spp={spp}", "--trainer.enable_progress_bar=false"]
        words += [f"--trust={name}" for name in trust]
        with phase("rendering") as rendering:
            rendering.detail = f"held-out views of {run.method}"
            ended = child.run_neurad(["predict", *words], run.folder / "predict.txt")
        if ended.code != 0:
            say(f"{run.method}: no pictures: {ended.message}")
            failed.append(run)
    return failed


def _common(options: argparse.Namespace, name: str) -> list[str]:
    """Arguments of a method's fits that do not depend on budget and seed: configs, and the user's settings."""
    overlay = name if name.endswith((".yaml", ".yml")) else f"{name if '/' in name else f'methods/{name}'}.yaml"
    find_config(overlay)
    chosen = any("evaluation.fraction" in word for word in options.settings)
    fraction = [] if chosen else [f"--evaluation.fraction={EVALUATION_FRACTION}"]
    trust = [f"--trust={name}" for name in options.trust]
    configs = [f"--config={config}" for config in [*options.config, overlay]]
    return [*trust, *configs, *(PLAIN if options.plain else ()), *fraction, *options.settings]


def _make(fit: Fit, order: int) -> Run:
    """Fit in a process of its own; whatever goes wrong there is this run's alone."""
    if fit.folder.exists():
        shutil.rmtree(fit.folder)
    make_folder(fit.folder)
    log = fit.folder / "output.txt"
    facts = {"method": fit.method, "seed": fit.seed, "order": order, "command": ["neurad", "fit", *fit.arguments]}
    write_text(fit.folder / FACTS, json.dumps(facts | {"message": "it did not end"}, indent=1) + "\n")
    ended = child.run_neurad(["fit", *fit.arguments], log)
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
        "processor_seconds": ended.processor_seconds,
    }
    write_text(fit.folder / FACTS, json.dumps(facts, indent=1) + "\n")
    return read_run(fit.folder)


def resolved_configs(fits: Sequence[Sequence[str]]) -> list[Mapping[str, Any]]:
    """What ``neurad fit ARGUMENTS --print_config`` prints for each of ``fits``, from one child: the parser brings
    libraries that this process must not load.

    Raises:
        InputError: the first complaint, in the words of ``neurad fit``.
    """
    text = json.dumps([list(fit) for fit in fits])
    command = [*child.NEURAD, "compare", f"--resolve={text}"]
    with child.signals_raise():
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise InputError(child.last_message(done.stderr) or f"exit code {done.returncode}")
    trees: list[Mapping[str, Any]] = json.loads(done.stdout)
    return trees


def print_configs(text: str) -> None:
    """What the child of :func:`resolved_configs` does: print fits' final settings, from their arguments; all JSON."""
    from datamodules.scene_data import SceneData
    from neurad.runs import lightning
    from neurad.training.inverse import InverseRenderer

    trees = []
    for arguments in json.loads(text):
        with redirect_stdout(StringIO()) as out, suppress(SystemExit):
            lightning.run("fit", [*arguments, "--print_config"], InverseRenderer, SceneData)
        trees.append(yaml.safe_load(out.getvalue()))
    json.dump(trees, sys.stdout, default=str)
