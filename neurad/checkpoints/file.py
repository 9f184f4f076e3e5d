"""Checkpoints as files: whole, with a checksum, and the one before kept.

The checksum (SHA-256) is the zip archive's comment, at the very end of the file, and covers all bytes before it, so
that a single changed bit is found. Programs that read zip files, torch among them, do not mind it, and it goes wherever
the file is copied.
"""

import hashlib
import math
import os
import struct
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.runtime.files import PART, replacing, synchronise, write_all

_MARK = b"neurad sha256 "
_DIGITS = 64
_CHUNK = 1 << 20
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
    """The content of a checkpoint, once its checksum has been compared: plain types and tensors, which may
    ``stay_on_disk`` until they are used.

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


class Sealer:
    """Takes a zip file as it is written, from its first byte to its last, and adds the checksum.

    A writer in C++ may end the process over an exception in the middle, so the first refusal of the system is kept for
    :meth:`seal`.
    """

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._hash = hashlib.sha256()
        self._held = b""  # the last two bytes say how long the comment is
        self._error: OSError | None = None

    def write(self, data: bytes | memoryview) -> int:
        """Write the next bytes."""
        view = memoryview(data).cast("B")
        if len(view) < 2:
            view = memoryview(self._held + bytes(view))
        else:
            self._put(self._held)
        self._put(view[:-2])
        self._held = bytes(view[-2:])
        return len(data)

    def flush(self) -> None:
        """Nothing is kept back that could be written yet."""

    def seal(self) -> None:
        """Add the checksum.

        Raises:
            OSError: the system refused to write, here or before.
        """
        self._put(struct.pack("<H", len(_MARK) + _DIGITS) + _MARK)
        digest = self._hash.hexdigest().encode()
        self._put(digest)
        if self._error is not None:
            raise self._error

    def _put(self, data: bytes | memoryview) -> None:
        if self._error is None:
            try:
                write_all(self._handle, data)
            except OSError as error:
                self._error = error
            self._hash.update(data)


def check_seal(path: Path, name: str) -> None:
    """Compare a file with the checksum that it carries.

    Raises:
        InputError: it differs, or the file has none.
    """
    try:
        with path.open("rb", buffering=0) as file:
            left = os.fstat(file.fileno()).st_size - _DIGITS
            found, tail = hashlib.sha256(), b""
            while left > 0 and (chunk := file.read(min(left, _CHUNK))):
                found.update(chunk)
                left -= len(chunk)
                tail = (tail + chunk)[-len(_MARK) :]
            digest = file.read(_DIGITS)
    except OSError as error:
        raise InputError(f"{name}: it cannot be read ({error.strerror})") from error
    if tail != _MARK:
        raise InputError(
            f"{name}: it is not a readable checkpoint (it has no checksum at its end: it was cut short or changed)"
        )
    if digest != found.hexdigest().encode():
        raise InputError(f"{name}: it is damaged, its content does not agree with its checksum")
