"""Checkpoints as files: whole, with a checksum, and the one before kept."""

import math
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurad.checkpoints.sealed import Sealer, check_seal
from neurad.core.errors import InputError
from neurad.runtime.files import PART, replacing, synchronise

_ENTRIES: dict[str, type] = {
    "state_dict": dict,
    "neurad": dict,
    "optimizer_states": list,
    "loops": dict,
    "callbacks": dict,
    "global_step": int,
    "epoch": int,
    "pytorch-lightning_version": str,
}
_OWN: dict[str, type | tuple[type, ...]] = {
    "scene": str,
    "geometry": str,
    "light": dict,
    "iteration": int,
    "seconds": (int, float),
    "processor_seconds": (int, float),
    "waited_seconds": (int, float),
    "rays": int,
    "samples": int,
    "photographs": int,
    "hide_environment": bool,
    "radiance_inputs": (list, type(None)),
}
"""What a run writes about itself, under 'neurad'."""


def write_checkpoint(state: dict[str, Any], path: Path, previous: Path | None = None) -> None:
    """Write a checkpoint beside its place and move it there, so that a kill at any moment leaves a whole one.

    Args:
        state: plain types and tensors.
        path: the file; its folder exists.
        previous: where the file that is at ``path`` now goes on, without a second copy of it being written.

    Raises:
        InputError: the system refused; ``path`` is as it was.
    """
    with replacing(path) as part:
        with part.open("wb", buffering=0) as file:
            sealer = Sealer(file.fileno())
            torch.save(state, sealer)  # type: ignore[arg-type]
            sealer.seal()
        if previous is not None and path.is_file():
            synchronise(part)
            _keep(path, previous)


def _keep(path: Path, previous: Path) -> None:
    """Let ``previous`` name the file at ``path`` too; at no moment is one of the two missing."""
    link = previous.with_name(previous.name + PART)
    link.unlink(missing_ok=True)
    try:
        os.link(path, link)
    except OSError:  # a file system without hard links: for a moment there is only the previous one
        os.replace(path, previous)
        return
    os.replace(link, previous)
    link.unlink(missing_ok=True)  # where both named the same file already, nothing was moved


def read_checkpoint(path: Path, name: str, stay_on_disk: bool = True) -> dict[str, Any]:
    """The content of a checkpoint, once its checksum has been compared: plain types and tensors.

    Args:
        stay_on_disk: tensors are read when they are used.

    Raises:
        InputError: there is no such file, it is damaged, or it is not a checkpoint of neurad.
    """
    if not path.is_file():
        raise InputError(f"{name}: no such file")
    check_seal(path, name)
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=stay_on_disk)
    except Exception as error:  # broken pickles raise what they like
        raise InputError(f"{name}: it is not a readable checkpoint") from error
    _check_entries(state, name)
    found: dict[str, Any] = state
    return found


def _check_entries(state: Any, name: str) -> None:
    """Refuse a checkpoint without the entries that every run writes, or with others in their place."""
    if not isinstance(state, dict):
        raise InputError(f"{name}: it is not a checkpoint of neurad")
    own = state.get("neurad")
    for place, entries, kinds in (("", state, _ENTRIES), ("neurad", own, _OWN)):
        for key, kind in kinds.items():
            value = entries.get(key) if isinstance(entries, dict) else None
            entry = f"{place}.{key}" if place else key
            if not isinstance(value, kind):
                raise InputError(f"{name}: it is not a checkpoint of neurad ({entry} is missing or wrong)")
            if isinstance(value, int | float) and not (value >= 0 and math.isfinite(value)):
                raise InputError(f"{name}: {entry} is {value}, which no run writes")
    if not all(isinstance(key, str) and isinstance(value, Tensor) for key, value in state["state_dict"].items()):
        raise InputError(f"{name}: state_dict has entries that are no tensors")
