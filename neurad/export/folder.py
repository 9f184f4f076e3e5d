"""The folder of an export: what may be at its place, and what of that is replaced."""

import os
from collections.abc import Iterable
from contextlib import AbstractContextManager, suppress
from pathlib import Path

from neurad.core.errors import InputError
from neurad.runtime import folders
from neurad.runtime.files import writing
from neurad.runtime.folders import new_stage, place_of, remove_dead
from neurad.runtime.reading import read_json

MANIFEST = "room.json"
"""The file by which an exported folder is recognised."""


def check_out(out: Path, overwrite: bool) -> None:
    """Check that a folder may be written, before any work is done, and remove what killed exports to it left.

    Raises:
        InputError: something is there that is not to be replaced, or its parent is no folder that can be written to.
    """
    place = place_of(out)
    if place.exists() and not place.is_dir():
        raise InputError(f"--out: {out} is there and no folder")
    if not place.parent.is_dir():
        raise InputError(f"--out: there is no folder {place.parent}")
    if Path.cwd().is_relative_to(place):
        raise InputError(f"--out: {out} is the folder that you are in, or lies above it; give a new one")
    with writing(out, "--out"):
        remove_dead(place)
        new_stage(place).rmdir()
    _check_free(out, place, overwrite)


def _check_free(out: Path, place: Path, overwrite: bool) -> None:
    with writing(out, "--out"):
        occupied = place.exists() and (not place.is_dir() or any(place.iterdir()))
    if occupied and not overwrite:
        raise InputError(f"--out: {out} is there already; add --overwrite to replace it")
    notes = None
    with suppress(InputError):
        notes = read_json(place / MANIFEST)
    if occupied and not (isinstance(notes, dict) and "base_color_for" in notes):
        raise InputError(f"--out: {out} is no folder of an earlier export, so --overwrite does not replace it")


def check_sources(out: Path, sources: Iterable[str | Path]) -> None:
    """Check that the folder to be replaced holds nothing that the export reads: it would be gone afterwards."""
    place = place_of(out)
    for source in sources:
        for file in (os.path.abspath(source), os.path.realpath(source)):
            if Path(file).is_relative_to(place):
                raise InputError(f"--out: {out} holds {source}, which the run needs; export to another folder")


def written_beside(out: Path, overwrite: bool = True) -> AbstractContextManager[Path]:
    """A new folder beside ``out``, see :func:`neurad.runtime.folders.written_beside`.

    Args:
        out: where it is going to be.
        overwrite: replace an earlier export; nothing else is replaced, also what has come there meanwhile.

    Raises:
        InputError: a file cannot be written, or something has come to ``out``.
    """
    return folders.written_beside(out, lambda: _check_free(out, place_of(out), overwrite))
