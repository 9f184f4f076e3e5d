"""Hints as files: the YAML behind ``--data.hints``, and what becomes of a scene by it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml  # type: ignore[import-untyped]

from neurad.core.errors import InputError
from neurad.core.records import BoolArray
from neurad.core.suggest import did_you_mean
from neurad.runtime.files import check_file, write_text
from neurad.runtime.numbers import LENGTH, number
from neurad.runtime.reading import exists, expanded, read_text, shown
from neurad.scene.description import Scene, leaving_out
from neurad.scene.hints import Hints, PlaceHint, Rectangle

SHINES, ONE_MATERIAL, LEAVE_OUT = KINDS = ("shines", "one_material", "leave_out")
"""The keys of entries."""
SETTING = "--data.hints"


def hint_entries(given: str | Sequence[Any]) -> list[Any]:
    """The entries of a file of hints, checked, in plain values; or those that are given.

    Raises:
        InputError: the file is missing or is no YAML, or an entry says nothing that there is; the sentence names it.
    """
    if not isinstance(given, str):
        return list(given)
    source = f"{SETTING} {shown(given)}"
    text = read_text(expanded(given, SETTING), "there is no such file of hints")
    try:
        entries = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"{source}: it is not readable YAML ({shown(' '.join(str(error).split()))})") from error
    entries = [] if entries is None else entries
    hints_of(entries, source)
    return list(entries)


def hints_of(entries: Any, source: str = SETTING) -> Hints:
    """The hints that plain values describe, a list of mappings with one of :data:`KINDS` each."""
    if not isinstance(entries, list):
        raise InputError(f"{source}: it has to be a list of entries, such as - {SHINES}: [x, y, z]")
    found: dict[str, list[Any]] = {kind: [] for kind in KINDS}
    for index, entry in enumerate(entries):
        where = f"{source}: entry {index + 1}"
        keys = ", ".join(KINDS)
        if not isinstance(entry, dict) or len(entry) != 1:
            raise InputError(f"{where}: it is {shown(repr(entry))}, but one of {keys} and its place is needed")
        ((kind, value),) = entry.items()
        if kind not in KINDS:
            raise InputError(
                f"{where}: there is no {shown(kind)}, choose one of {keys}{did_you_mean(str(kind), KINDS)}"
            )
        where = f"{where}: {kind}"
        if kind == ONE_MATERIAL:
            if not isinstance(value, list) or len(value) < 2 or not all(isinstance(place, list) for place in value):
                raise InputError(f"{where} is {shown(repr(value))}, but two or more places are needed, each a list")
            found[kind].append(tuple(_place(place, where) for place in value))
        else:
            is_rectangle = kind == LEAVE_OUT and isinstance(value, dict)
            found[kind].append(_rectangle(value, where) if is_rectangle else _place(value, where))
    return Hints(*(tuple(found[kind]) for kind in KINDS))


def _place(value: Any, where: str) -> PlaceHint:
    if not isinstance(value, list) or len(value) not in (3, 6):
        raise InputError(
            f"{where} is {shown(repr(value))}, but three numbers are needed for a point, or six for corners of a box"
        )
    return PlaceHint(where, tuple(number(x, where, -LENGTH, LENGTH) for x in value))


def _rectangle(value: dict[Any, Any], where: str) -> Rectangle:
    view, corners = value.get("view"), value.get("rectangle")
    if set(value) != {"view", "rectangle"} or not isinstance(view, str):
        raise InputError(f"{where} is {shown(repr(value))}, but a view and a rectangle are needed")
    given = corners if isinstance(corners, list) and all(type(x) is int for x in corners) else []
    if len(given) != 4 or not (0 <= given[0] < given[2] and 0 <= given[1] < given[3]):
        raise InputError(
            f"{where}: rectangle is {shown(repr(corners))}, but left, top, right and bottom are needed, whole pixels "
            "that grow to the right and down"
        )
    left, top, right, bottom = given
    return Rectangle(where, view, (left, top, right, bottom))


def hints_file(given: str) -> Path:
    """A file that hints can be added to: one of hints, or one that is not there yet.

    Raises:
        InputError: it holds something else, or cannot be written.
    """
    path = expanded(given, "--hints")
    if exists(path):
        hint_entries(str(path))
    check_file(path, "--hints")
    return path


def add_hint(path: Path, entry: dict[str, Any]) -> int:
    """Write another entry at the end of a file of hints, and count them. What stands in it stays as it is.

    Raises:
        InputError: the file is none, or has another form than a line with a dash for each entry.
    """
    before = read_text(path) if exists(path) else ""
    count = len(hint_entries(str(path))) if before else 0
    ((kind, value),) = entry.items()
    line = f"- {kind}: {yaml.safe_dump(value, default_flow_style=True, width=1 << 16).strip()}\n"
    text = f"{before}{'' if before.endswith(chr(10)) or not before else chr(10)}{line}"
    try:
        entries = yaml.safe_load(text)
    except yaml.YAMLError:
        entries = None
    if not isinstance(entries, list) or len(entries) != count + 1:
        raise InputError(f"{shown(path)}: its entries are not one a line, each after a dash; write them so, or by hand")
    hints_of(entries, shown(path))
    write_text(path, text)
    return len(entries)


def hinted(scene: Scene, given: str | Sequence[Any] | None) -> Scene:
    """The scene with what is said of it; rectangles that are left out stand in its views.

    Raises:
        InputError: as :func:`hint_entries`; or there is no such view or pixel.
    """
    if given is None:
        return scene
    hints = hints_of(hint_entries(given), SETTING if not isinstance(given, str) else f"{SETTING} {shown(given)}")
    cameras = {view.name: view.camera for view in (*scene.train, *scene.test)}
    left_out: dict[str, BoolArray] = {}
    for part in hints.leave_out:
        if isinstance(part, Rectangle):
            if part.view not in cameras:
                near = did_you_mean(part.view, list(cameras))
                raise InputError(f"{part.source}: there is no view {shown(part.view)}{near}")
            left, top, right, bottom = part.corners
            width, height = cameras[part.view].width, cameras[part.view].height
            if right > width or bottom > height:
                raise InputError(f"{part.source}: view {shown(part.view)} has {width} x {height} pixels")
            left_out.setdefault(part.view, np.zeros((height, width), bool))[top:bottom, left:right] = True
    return leaving_out(replace(scene, hints=hints), left_out)
