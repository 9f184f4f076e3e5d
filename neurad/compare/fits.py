"""The fits of a comparison: planned and checked as a whole, then made one after the other, each in its own process."""

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

from neurad.compare.runs import FACTS, STAGES, Run, by_method, read_run, samples_per_step
from neurad.core.decibels import decibels
from neurad.core.errors import InputError
from neurad.runs import child
from neurad.runs.configs import find_config
from neurad.runtime.files import check_folder, make_folder, write_text
from neurad.runtime.progress import phase, say

EVALUATION_FRACTION = 0.5
"""Fraction of the training time that evaluations may take here: they do not count, and curves need points."""
WARM_UP = '--trainer.callbacks+={"class_path": "WarmUp"}'
"""Argument of every fit: what comes before the end of the first iteration is left out of its seconds."""
POINTS = 20
"""Evaluations of a fit that its samples limit, however few steps these are."""


PLAIN = tuple(f"--{key}={value}" for key, (_, value) in STAGES.items())
"""Arguments of fits without any stage."""


@dataclass(frozen=True)
class Fit:
    """One run to be made."""

    method: str
    seed: int
    folder: Path
    arguments: tuple[str, ...]
    """Command-line arguments of ``neurad fit``."""


def fit_all(options: argparse.Namespace) -> list[Run]:
    """Fit every method with every seed."""
    fits = plan(options)
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


def plan(options: argparse.Namespace) -> list[Fit]:
    """Every fit with its arguments, checked before the first one starts."""
    _check(options)
    seeds = _seeds(options.seeds)
    overlays = {Path(name).stem: name for name in options.methods.split(",") if name.strip()}
    if len(overlays) < len(options.methods.split(",")):
        raise InputError(f"--methods {options.methods}: two of them have the same name, or one has none")
    for name in options.config:
        find_config(name)
    check_free(options.out, options.overwrite)
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


def check_free(out: Path, overwrite: bool) -> None:
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


def predict(runs: Sequence[Run], spp: int, trust: Sequence[str] = ()) -> list[Run]:
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


def _check(options: argparse.Namespace) -> None:
    if not options.config:
        raise InputError("--config NAME.yaml is needed to fit, or the folders of finished runs")
    if not options.methods:
        raise InputError("--methods is needed: names of overlays in configs/methods, separated by commas")
    if (options.budget is None) == (options.samples is None):
        raise InputError("one of --budget SECONDS and --samples N is needed")


def _common(options: argparse.Namespace, name: str) -> list[str]:
    """Arguments of a method's fits that do not depend on budget and seed: configs, and the user's settings."""
    overlay = name if name.endswith((".yaml", ".yml")) else f"{name if '/' in name else f'methods/{name}'}.yaml"
    find_config(overlay)
    chosen = any("evaluation.fraction" in word for word in options.settings)
    fraction = [] if chosen else [f"--evaluation.fraction={EVALUATION_FRACTION}"]
    trust = [f"--trust={name}" for name in options.trust]
    configs = [f"--config={config}" for config in [*options.config, overlay]]
    return [*trust, *configs, *(PLAIN if options.plain else ()), *fraction, *options.settings]


def _seeds(text: str) -> list[int]:
    if not re.fullmatch(r"\d+(,\d+)*", text):
        raise InputError(f"--seeds {text}: it is not a list of whole numbers separated by commas")
    return list(dict.fromkeys(int(part) for part in text.split(",")))


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
