"""What is wrong with the settings, in one sentence for the user."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from difflib import SequenceMatcher

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from neurad.runs.configs import load_config

UNKNOWN = (
    r"unrecognized arguments: --([^\s=]+)",
    r"does not accept option '([^']+)'",
    r"Key '([^']+)' is not expected",
)
"""What the parser says of a setting that does not exist."""
_ABSENT = object()
_ALIKE = 0.6
"""Similarity of two names, in [0, 1], from which on one is suggested for the other."""


def setting_error(
    message: str, names: Sequence[str], values: Mapping[str, str], known: Iterable[str] = ()
) -> str:  # fmt: skip
    """The parser's complaint as one sentence that names the setting and where it was given.

    Args:
        message: of the parser, over several lines.
        names: the config files given.
        values: what was given on the command line, by key.
        known: names of all settings, of which the nearest is suggested for one that does not exist.
    """
    text = " ".join(message.split())
    wrong = re.search(r'Parser key "([^"]+)": (.*)', text)
    for pattern in UNKNOWN:
        if unknown := re.search(pattern, text):
            return _unknown(unknown[1], names, values, known)
    if wrong is None:
        return text
    if nested := re.search(r"NestedArg\(key='([^']+)'", wrong[2]):
        return _unknown(f"{wrong[1]}.init_args.{nested[1]}", names, values, ())
    denied = re.search(r"Importing '[^']+' is not allowed", wrong[2])
    union = re.search(r"Does not validate against any of the Union subtypes.*Given value: (.*)", wrong[2])
    group = "Unable to load config" in wrong[2]
    reason = denied[0] if denied else f"{union[1]} is not a valid value" if union else wrong[2]
    reason = "it is a group of settings, write them below it" if group else reason
    return _located(wrong[1], reason, names, values)


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The known setting that ``key`` was probably meant to be; None where none is similar.

    The last parts of the names have to be similar, so that a setting is not taken for its neighbour.
    """

    def likeness(other: str) -> tuple[float, float]:
        last, other_last = (name.rpartition(".")[2] for name in (key, other))
        return SequenceMatcher(None, last, other_last).ratio(), SequenceMatcher(None, key, other).ratio()

    best = max(known, key=lambda other: sum(likeness(other)), default=None)
    return best if best is not None and likeness(best)[0] >= _ALIKE else None


def _unknown(key: str, names: Sequence[str], values: Mapping[str, str], known: Iterable[str]) -> str:
    meant = nearest(key, known)
    hint = "" if meant is None else f", did you mean {meant}?"
    return f"{_origin(key, names, values)}: {key} is not a known setting{hint}"


def _located(key: str, text: str, names: Sequence[str], values: Mapping[str, str]) -> str:
    """A sentence about a setting: ``--data.patches: ...``, or ``config mine.yaml: data.patches: ...``."""
    origin = _origin(key, names, values)
    return f"--{key}: {text}" if origin == "command line" else f"{origin}: {key}: {text}"


def _origin(key: str, names: Sequence[str], values: Mapping[str, str]) -> str:
    """Where a setting was given: 'command line' or the config file."""
    if any(given == key or given.startswith(f"{key}.") or key.startswith(f"{given}.") for given in values):
        return "command line"
    for name in reversed(names):
        for layer in load_config(name):
            try:
                given = OmegaConf.select(layer, key, default=_ABSENT) is not _ABSENT
            except OmegaConfBaseException:  # it refers to another layer
                given = True
            if given:
                return f"config {name}"
    return "config"


def silence_lightning() -> None:
    """Hide what Lightning says about its own workings."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        ".*does not have many workers.*",
        ".*LeafSpec.*",
        ".*Checkpoint directory .* exists and is not empty.*",
        ".*resuming from a checkpoint that ended before the epoch ended.*",
        ".*The dirpath has changed.*",
        ".*`IterableDataset` has `__len__` defined.*",
        ".*GPU available but not used.*",
        ".*predict returned None.*",
        ".*Found .* module.* in eval mode at the start of training.*",
    ):
        warnings.filterwarnings("ignore", message=message)
