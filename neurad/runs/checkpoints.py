"""Checkpoints: the newest run's, and how one is read."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from neurad.core.errors import InputError

RUNS = "lightning_logs"
"""Folder of all runs, inside the root directory of the trainer."""
LAST = Path("checkpoints") / "last.ckpt"
"""A run's last checkpoint, inside its folder."""


def newest_checkpoint(root: Path) -> Path | None:
    """The last checkpoint of the newest run in ``root``/lightning_logs that has one; None where no run has."""
    found = sorted((root / RUNS).glob(f"version_*/{LAST.as_posix()}"), key=_version)
    return found[-1] if found else None


def _version(path: Path) -> int:
    """N of ``version_N/checkpoints/last.ckpt``; -1 where it is no number."""
    number = path.parent.parent.name.removeprefix("version_")
    return int(number) if number.isdecimal() else -1


def run_folder_of(checkpoint: Path) -> Path | None:
    """The folder of the run that wrote ``<run>/checkpoints/NAME.ckpt``; None for a checkpoint kept elsewhere."""
    folder = checkpoint.resolve().parent
    return folder.parent if folder.name == "checkpoints" and (folder.parent / "config.yaml").is_file() else None


def read_checkpoint(path: Path, name: str) -> dict[str, Any]:
    """The content of a checkpoint: plain types, and tensors that stay on disk until they are used.

    Args:
        path: the file.
        name: begins the error message.

    Raises:
        InputError: there is no such file, or it is not a checkpoint.
    """
    if not path.is_file():
        raise InputError(f"{name}: no such file")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise InputError(f"{name}: it is not a readable checkpoint") from error
    if not isinstance(state, dict) or "state_dict" not in state:
        raise InputError(f"{name}: it is not a checkpoint of neurad")
    return state
