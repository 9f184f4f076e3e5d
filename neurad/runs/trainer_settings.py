"""Settings of the trainer: those of Lightning's that mean something here, with their ranges.

Optimization is manual, iterations have no epochs, gradients are not clipped, light needs float32, and evaluations
keep a schedule of their own. The help reads this file, so it imports neither torch nor Lightning, which take seconds.
"""

from __future__ import annotations  # the parser then takes a number for a number, whatever its range

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from neurad.core.durations import FORMS, has_unit, seconds_of
from neurad.core.errors import InputError
from neurad.core.ranges import IS_GROUP, CountOrZero, Range, Seed, is_settings, needs_value, shown, violations

_LONGEST = 30 * 365 * 86400
_NUMBERS = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "NODE_RANK", "MASTER_PORT", "SLURM_PROCID", "SLURM_LOCALID")
"""Environment variables by which a launcher numbers processes."""


@dataclass(frozen=True)
class TrainerSettings:
    """How long a fit takes, and what it runs on."""

    max_time: str | None = None
    """How long to fit: 60s, 4m, 1h30m or DD:HH:MM:SS. Learning rates fall to their end with it, so a run that is given
    more ends better."""
    max_steps: Annotated[int, Range(-1, 2**62)] = -1
    """How many steps to fit, -1 for no limit. The run ends when either limit is reached."""
    default_root_dir: str | None = None
    """Where lightning_logs lies; the present folder by default."""
    accelerator: str = "auto"
    """``cpu``, ``gpu`` or ``auto``."""
    devices: Annotated[int, Range(1, 1 << 16)] | list[CountOrZero] | Literal["auto"] = 1
    """Number of processes or GPUs, their list, or ``auto`` for all; several share a fit."""
    enable_progress_bar: bool = True
    """``false`` prints no line of progress."""
    logger: bool = True
    """``false`` writes no run folder."""


def check_environment() -> None:
    """Refuse what a launcher of processes can not have left in the environment; Lightning reads it.

    Raises:
        InputError: a variable is not a whole number.
    """
    for name in _NUMBERS:
        if name in os.environ and not os.environ[name].isdecimal():
            raise InputError(f"the environment variable {name} is {os.environ[name]!r}, not a whole number; unset it")


def complaints(settings: Mapping[str, Any], groups: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What is wrong with the parsed tree of a verb though each setting has the right type: names, and why; ``groups``
    are the types of the settings that stand under ``trainer``, ``model``, ``data``, ... by their names.
    """
    yield from wrong_seed(settings.get("seed_everything"))
    trainer = settings["trainer"]
    if trainer["max_steps"] == 0:
        yield "trainer.max_steps", "0 is out of range, it must be at least 1, or -1 for no limit"
    if trainer["max_time"] is not None and (wrong := _wrong_limit(trainer["max_time"])):
        yield "trainer.max_time", wrong
    for name, owner in groups.items():
        for key, hint in owner.items():
            value = (settings.get(name) or {}).get(key)
            if is_settings(hint) and not isinstance(value, Mapping):
                yield f"{name}.{key}", IS_GROUP
            elif value is None and key in (settings.get(name) or {}) and needs_value(hint):
                yield f"{name}.{key}", "null is no value for it, leave it out"
            yield from violations(value, hint, f"{name}.{key}")


def wrong_seed(seed: Any) -> Iterator[tuple[str, str]]:
    """What is wrong with the value of ``seed_everything``: its name, and why."""
    if isinstance(seed, bool) or not isinstance(seed, int):
        yield "seed_everything", "it must be a whole number: runs can be repeated"
    yield from violations(seed, Seed, "seed_everything")


def _wrong_limit(text: str) -> str:
    """What is wrong with a limit of time; empty where nothing is."""
    if text.strip().isdecimal():
        return f"{shown(text)} has no unit, a time is written {FORMS}"
    if not has_unit(text) and ":" not in text:
        return f"{shown(text)} is not a time, such as {FORMS}"
    try:
        seconds = seconds_of(text)
    except InputError as error:
        return str(error)
    if seconds < 1:
        return f"{shown(text)} is too short, a limit of time is at least 1s"
    return f"{shown(text)} is out of range, it must be below 30 years" if seconds >= _LONGEST else ""
