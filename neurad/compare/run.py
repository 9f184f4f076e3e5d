"""The whole of ``neurad compare``: choose runs or make them, let them write pictures, write the report.

This module and all that it imports before the report is written stay small: on Linux a child process begins with the
peak memory of its parent, and the fits' peak memory is reported.
"""

import argparse
import math
from pathlib import Path

from neurad.compare.fits import check_free, fit_all, predict
from neurad.compare.runs import Run, read_other, read_run, runs_in
from neurad.core.errors import InputError
from neurad.runtime.progress import phase, say
from neurad.runtime.reading import similar

RUNS = Path("lightning_logs")
"""Where runs lie that are given by name, such as ``version_3``."""


def compare(options: argparse.Namespace) -> None:
    """Run what is to be compared, one fit after the other, and write the report.

    Args:
        options: those of the verb; ``settings`` are for the fits, ``words`` is the whole command line after the verb.

    Raises:
        InputError: the user's mistake, before anything is written.
        SystemExit: with 1 if a fit failed; the report then has the others.
    """
    reach = sorted(_numbers("--reach", options.reach))
    others = [read_other(word) for word in options.run]
    if len({run.method for run in others}) < len(others):
        raise InputError("--run: two of them have the same name")
    runs = [*(finished_runs(options) if options.runs else fit_all(options)), *others]
    failed = [run for run in runs if run.message]
    if options.views:
        failed += predict(runs, options.view_spp, options.trust)
    from neurad.compare.write import write_report

    command = ["neurad", "compare", *options.words]
    with phase("writing") as writing:
        writing.detail = "the report"
        write_report(options.out, runs, reach, options.views, command, _budget(options), options.trust)
    print(f"neurad: report {options.out / 'index.html'}")
    if failed:
        names = ", ".join(f"{run.method} (seed {run.seed})" for run in failed)
        say(f"error: not everything was made: {names}")
        raise SystemExit(1)


def finished_runs(options: argparse.Namespace) -> list[Run]:
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
        check_free(options.out, options.overwrite)
    runs = [read_run(folder, label) for label, folder in folders]
    names = {path.resolve().name for _, path in folders}
    if len(names) < len(folders):  # version_0 of two folders would pass for two seeds of one method
        for run, (label, path) in zip(runs, folders, strict=True):
            if label is None and run.method == path.resolve().name:
                run.method = str(path)
    return runs


def _numbers(option: str, text: str) -> list[float]:
    try:
        values = [float(part) for part in text.split(",") if part.strip()]
    except ValueError:
        raise InputError(f"{option} {text}: it is not a list of numbers separated by commas") from None
    if not all(math.isfinite(value) for value in values):
        raise InputError(f"{option} {text}: its numbers have to be finite")
    return values


def _budget(options: argparse.Namespace) -> str:
    if options.budget is not None:
        return f"Every fit was given {options.budget:g} training seconds"
    return f"Every fit drew {options.samples:g} path samples in its steps" if options.samples is not None else ""


def _run_folders(path: Path) -> list[Path]:
    """The run folder itself, or those in the folder of a report."""
    if not path.is_dir() and len(path.parts) == 1 and (RUNS / path).is_dir():
        path = RUNS / path
    if not path.is_dir():
        raise InputError(f"{path}: no such run folder{similar(path)}")
    if (path / "runs").is_dir() and not (path / "metrics.csv").is_file():
        return runs_in(path)
    return [path]
