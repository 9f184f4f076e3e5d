"""Settings of Lightning's trainer: their ranges, and those that mean nothing here.

Optimization is manual, iterations have no epochs, and evaluations keep a schedule of their own. An option that
Lightning would ignore, or refuse by an exception, is one sentence instead.
"""

import math
import os
import re
from collections.abc import Iterator, Mapping
from datetime import timedelta
from typing import Annotated, Any

from neurad.core.errors import InputError
from neurad.core.ranges import IS_GROUP, Count, CountOrZero, Range, Seed, is_settings, needs_value, shown, violations

RANGES: dict[str, Any] = {
    "num_nodes": Count,
    "fast_dev_run": CountOrZero,
    "log_every_n_steps": Count,
    "max_steps": Annotated[int, Range(-1, 2**62)],
    "min_steps": CountOrZero | None,
}
"""Ranges of the trainer's numbers; -1 steps are no limit."""
OURS = {"max_epochs": -1, "num_sanity_val_steps": 0, "enable_model_summary": False}
"""What this project sets for every trainer: its runs are measured in iterations and seconds."""
_LONGEST = 30 * 365 * 86400
_EPOCHS = "a fit has no epochs, its length is --trainer.max_steps or --trainer.max_time"
_ALL_VIEWS = "all held-out views are evaluated together"
_EVALUATIONS = "evaluations follow --evaluation.every_n_steps and --evaluation.fraction"
WITHOUT_EFFECT: dict[str, tuple[tuple[Any, ...], str]] = {
    "accumulate_grad_batches": ((1,), "a larger batch is --data.patches"),
    "gradient_clip_val": ((None,), "gradients are not clipped"),
    "gradient_clip_algorithm": ((None,), "gradients are not clipped"),
    "limit_train_batches": ((None, 1.0), _EPOCHS),
    "limit_val_batches": ((None, 1.0), _ALL_VIEWS),
    "limit_test_batches": ((None, 1.0), _ALL_VIEWS),
    "limit_predict_batches": ((None, 1.0), _ALL_VIEWS),
    "overfit_batches": ((0,), "few pixels are --data.patches"),
    "val_check_interval": ((None, 1.0), _EVALUATIONS),
    "check_val_every_n_epoch": ((None, 1), _EVALUATIONS),
    "num_sanity_val_steps": ((None, 0), _EVALUATIONS),
    "max_epochs": ((None, -1), _EPOCHS),
    "min_epochs": ((None, 0), _EPOCHS),
    "reload_dataloaders_every_n_epochs": ((0,), _EPOCHS),
    "sync_batchnorm": ((False,), "no network has batch normalisation"),
    "barebones": ((False,), "a fit without evaluations is --evaluation.fraction 0"),
}
"""Options that do not fit: their values that change nothing, and what to take instead."""
UNCHANGED: dict[str, Any] = {
    "fast_dev_run": False,
    "check_val_every_n_epoch": 1,
    "use_distributed_sampler": True,
    "enable_autolog_hparams": True,
} | {name: values[0] for name, (values, _) in WITHOUT_EFFECT.items() if values[0] is not None}
"""What Lightning's trainer takes where nothing is said, of the settings that are not None then and that a run's own
config does not hand on."""


_NUMBERS = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "NODE_RANK", "MASTER_PORT", "SLURM_PROCID", "SLURM_LOCALID")
"""Environment variables by which a launcher numbers processes."""


def check_environment() -> None:
    """Refuse what a launcher of processes can not have left in the environment; Lightning reads it.

    Raises:
        InputError: a variable is not a whole number.
    """
    for name in _NUMBERS:
        if name in os.environ and not os.environ[name].isdecimal():
            raise InputError(f"the environment variable {name} is {os.environ[name]!r}, not a whole number; unset it")


def complaints(settings: Mapping[str, Any], groups: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What is wrong with parsed settings though each has the right type: names, and why.

    Args:
        groups: the classes whose settings stand under ``model``, ``data``, ``evaluation``, ...
    """
    yield from violations(settings.get("seed_everything"), Seed, "seed_everything")
    if isinstance(settings.get("seed_everything"), bool):
        yield "seed_everything", "it must be a whole number: runs can be repeated"
    trainer = settings.get("trainer") or {}
    for name, hint in RANGES.items():
        value = trainer.get(name)
        if not isinstance(value, bool):
            yield from violations(value, hint, f"trainer.{name}")
    if trainer.get("max_steps") == 0:
        yield "trainer.max_steps", "0 is out of range, it must be at least 1, or -1 for no limit"
    if not _are_devices(trainer.get("devices")):
        yield "trainer.devices", f"{shown(trainer['devices'])} is neither a number of devices (at least 1) nor 'auto'"
    if (seconds := _seconds(trainer.get("max_time"))) is not None and not 0 < seconds < _LONGEST:
        yield "trainer.max_time", f"{shown(trainer['max_time'])} is out of range, it must be above 0 and below 30 years"
    for name, (harmless, instead) in WITHOUT_EFFECT.items():
        value = trainer.get(name)
        if name in trainer and value not in harmless:
            yield f"trainer.{name}", f"it has no effect here, {instead}"
    for callback in trainer.get("callbacks") or ():
        yield from violations(callback, Any, "trainer.callbacks")
    for name, owner in groups.items():
        for key, hint in owner.items():
            value = (settings.get(name) or {}).get(key)
            if is_settings(hint) and not isinstance(value, Mapping):
                yield f"{name}.{key}", IS_GROUP
            elif value is None and key in (settings.get(name) or {}) and needs_value(hint):
                yield f"{name}.{key}", "null is no value for it, leave it out"
            yield from violations(value, hint, f"{name}.{key}")


def _seconds(value: Any) -> float | None:
    """Seconds of a time limit; None where there is none, or where the trainer itself refuses it."""
    if isinstance(value, timedelta):
        return value.total_seconds()
    if isinstance(value, str) and re.fullmatch(r"\d+:\d+:\d+:\d+", value.strip()):
        words = value.split(":")
        return float(sum(unit * int(word[:15]) for unit, word in zip((86400, 3600, 60, 1), words, strict=True)))
    if isinstance(value, Mapping):
        try:
            return timedelta(**value).total_seconds()
        except (TypeError, OverflowError):
            return math.inf
    return None


def _are_devices(value: Any) -> bool:
    """Whether the trainer can count or list devices by a value: 2, "2", "auto", -1 (all there are), "0,1", [0, 1]."""
    if value is None or value == "auto":
        return True
    words = value if isinstance(value, list) else str(value).strip().rstrip(",").split(",")
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        return False
    if isinstance(value, list) or "," in str(value):
        return bool(numbers) and min(numbers) >= 0
    return numbers[0] == -1 or 1 <= numbers[0] < 1 << 16
