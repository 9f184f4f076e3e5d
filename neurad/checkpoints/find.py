"""Which checkpoint a verb starts from: the newest run's last one, or the one before where that is damaged."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neurad.checkpoints.file import read_checkpoint
from neurad.core.errors import InputError
from neurad.runtime.progress import say
from neurad.runtime.reading import exists, similar

RUNS = "lightning_logs"
"""Folder of all runs, inside the root directory of the trainer."""
LAST = Path("checkpoints") / "last.ckpt"
"""A run's last checkpoint, inside its folder."""
PREVIOUS = Path("checkpoints") / "previous.ckpt"
"""The checkpoint before that."""
_STRANGE = (KeyError, TypeError, ValueError, AttributeError, IndexError, RuntimeError, AssertionError)
"""What Lightning and torch raise over entries that they do not expect."""


def newest_checkpoint(root: Path, name: str = "--ckpt_path last: ") -> Path | None:
    """A whole checkpoint of the newest run in ``root``/lightning_logs; None where there is no run.

    Raises:
        InputError: the newest run has no whole checkpoint. The sentence names the newest run that has one.
    """
    runs = _runs(root)
    if not runs:
        return None
    try:
        return run_checkpoint(runs[-1], name)
    except InputError as error:
        older = next((path for run in runs[-2::-1] if (path := _whole(run)[0])), None)
        hint = "no older run has one" if older is None else f"the newest run that has one continues from {older}"
        raise InputError(f"{error}; {hint}") from error


def run_checkpoint(folder: Path, name: str) -> Path:
    """The last checkpoint of a run or, where that is damaged, the one before, which is said."""
    path, problems = _whole(folder)
    if path is not None:
        if problems:
            say(f"{problems[0]}; {path} takes its place")
        return path
    if not any((folder / file).is_file() for file in (LAST, PREVIOUS)):
        raise InputError(f"{name}run {folder}: it has no checkpoint {LAST}, it ended before its first")
    raise InputError(f"{name}run {folder}: it has no whole checkpoint ({problems[0]})")


def named_checkpoint(path: Path, root: Path, name: str) -> Path:
    """The checkpoint that a path stands for: the file itself, or the last one of a run, which is named by its folder,
    by the name of that in ``root``/lightning_logs, or by a folder that runs lie in.

    Raises:
        InputError: there is no such run or file, or it cannot be used.
    """
    is_folder = exists(path) and path.is_dir()
    folder = path if is_folder or path.is_absolute() or len(path.parts) != 1 else root / RUNS / path
    if folder.is_dir():
        above = folder.parent if folder.name == RUNS else folder
        if (above / RUNS).is_dir() and (found := newest_checkpoint(above, f"{name}: ")) is not None:
            return found
        return run_checkpoint(folder, f"{name}: ")
    if not exists(path):
        runs = [run.name for run in _runs(root)[-8:]]
        there = f"; there are {', '.join(runs)}" if runs and len(path.parts) == 1 and not path.suffix else ""
        raise InputError(f"{name}: there is no such run folder or checkpoint{similar(path) or there}")
    try:
        read_checkpoint(path, name)
    except InputError as error:
        if path.is_file() and path.name == LAST.name and _whole(path.parent.parent)[0] is not None:
            raise InputError(f"{error}; the one before it is whole: {path.with_name(PREVIOUS.name)}") from error
        raise
    return path


def _whole(folder: Path) -> tuple[Path | None, list[str]]:
    """The last whole checkpoint of a run, and what is wrong with those after it."""
    problems = []
    for path in (folder / LAST, folder / PREVIOUS):
        try:
            read_checkpoint(path, str(path))
        except InputError as error:
            problems.append(str(error))
        else:
            return path, problems
    return None, problems


def _runs(root: Path) -> list[Path]:
    """Run folders in ``root``/lightning_logs, the newest last."""

    def version(path: Path) -> int:
        number = path.name.removeprefix("version_")
        return int(number) if number.isdecimal() else -1

    return sorted((path for path in (root / RUNS).glob("version_*") if path.is_dir()), key=version)


def run_folder_of(checkpoint: Path) -> Path | None:
    """The folder of the run that wrote ``<run>/checkpoints/NAME.ckpt``; None for a checkpoint kept elsewhere."""
    folder = checkpoint.resolve().parent
    return folder.parent if folder.name == "checkpoints" and (folder.parent / "config.yaml").is_file() else None


@contextmanager
def restoring(checkpoint: Path | None) -> Iterator[None]:
    """Turn an error over what a checkpoint holds into one sentence; errors of everything else pass."""
    try:
        yield
    except _STRANGE as error:
        codes = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
        restores = any(c.co_filename.endswith("checkpoint_connector.py") and "restore" in c.co_name for c in codes)
        if checkpoint is None or not restores:
            raise
        why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise InputError(
            f"--ckpt_path {checkpoint}: it does not hold what a run of these settings writes ({why})"
        ) from error
