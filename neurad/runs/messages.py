"""What is wrong with the settings, in one sentence for the user."""

import logging
import re
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from difflib import SequenceMatcher
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from neurad.core.ranges import IS_GROUP, shown
from neurad.core.suggest import ALIKE
from neurad.runs.configs import load_config
from neurad.runs.trust import how_to_trust

UNKNOWN = (
    r"unrecognized arguments: --([^\s=]+)",
    r"does not accept option '([^']+)'",
    r"Key '([^']+)' is not expected",
)
"""What the parser says of a setting that does not exist."""
IS_TOO_LARGE = "the number is too large"
"""What is wrong with a whole number that no float holds."""
_ABSENT = object()


def setting_error(
    message: str, names: Sequence[str], values: Mapping[str, str], known: Iterable[str] = ()
) -> str:  # fmt: skip
    """The parser's complaint as one sentence that names the setting and where it was given.

    Args:
        message: of the parser, over several lines.
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
    nested = re.search(r"NestedArg\(key='([^']+)'", wrong[2])
    if nested and not re.search(r"Expected an? .* Got value: ", wrong[2]):
        return _unknown(f"{wrong[1]}.init_args.{nested[1]}", names, values, ())
    nested = nested or re.search(r"Problem with given class_path '[^']+': Parser key \"([^\"]+)\"", wrong[2])
    key = f"{wrong[1]}.init_args.{nested[1]}" if nested else wrong[1]
    origin = _origin(wrong[1], names, values)
    return f"--{key}: {reason(wrong[2])}" if origin == "command line" else f"{origin}: {key}: {reason(wrong[2])}"


def reason(text: str, method: str = "") -> str:
    """What the parser says is wrong with a value, without names of its own functions and types.

    Args:
        text: its complaint in one line, without the setting's name.
        method: class of the method, which is meant where the complaint names none.
    """
    given = re.search(r"Given value: (.*)$", text)
    if denied := re.search(r"Importing '([^']+)' is not allowed", text):
        return f"{denied[1]} is no class of neurad, Lightning or torch{how_to_trust(denied[1])}"
    if named := re.search(r"Problem with given class_path '([^']+)': (.*?)(?: - |  ?Given value| \(given|$)", text):
        inner = re.sub(r'^Parser key "[^"]+": ', "", named[2])
        for pattern, words in _OF_CLASSES:
            if found := re.search(pattern, inner):
                return words.format(named[1], *found.groups())
        return f"{named[1]}: {reason(inner)}" if "Got value" not in inner else reason(inner)
    if surplus := re.search(r"unexpected keyword argument '([^']+)'(?:.*class_path='([^']+)')?", text):
        return f"{surplus[2] or method} has no setting {surplus[1]}"
    for pattern, words in _OF_VALUES:
        if found := re.search(pattern, text):
            return words.format(*(shown(group) for group in found.groups()))
    if choices := re.search(r"Expected a typing\.Literal\[(.*?)\](?:\. Got|.* Given) value: (.*)", text):
        return f"{shown(choices[2])} is none of {choices[1]}".replace("'", "")
    return f"{shown(given[1])} is not a valid value" if given else text


_OF_CLASSES = (
    (r"arguments are required: (.+)", "{0} cannot be made without its init_args {1}"),
    (r"Option '([^']+)' is not accepted", "{0} has no setting {1}"),
)
"""What the parser says of a class and its settings, and how it is said here; ``{0}`` is the class."""
_OF_VALUES = (
    (r"Unable to load config", IS_GROUP),
    (r"subclass of (\w+).*Given value: (.*)$", "{1} is no {0} class"),
    (r"Expected a <class 'int'>\. Got value: (.*?)(?: - Expected|$)", "{} is not a whole number"),
    (r"Expected a <class 'float'>\. Got value: (.*?)(?: - Expected|$)", "{} is not a number"),
    (r"Expected a <class 'bool'>\. Got value: (.*?)(?: - Expected|$)", "{} is neither true nor false"),
    (r"Expected a <class 'str'>\. Got value: (.*?)(?: - Expected|$)", "{} is not a text"),
)
"""What the parser says of a value, and how it is said here."""


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The known setting that ``key`` was probably meant to be; None where none is similar.

    The last parts of the names have to be similar, so that a setting is not taken for its neighbour.
    """

    def likeness(other: str) -> tuple[float, float]:
        last, other_last = (name.rpartition(".")[2] for name in (key, other))
        return SequenceMatcher(None, last, other_last).ratio(), SequenceMatcher(None, key, other).ratio()

    best = max(known, key=lambda other: sum(likeness(other)), default=None)
    return best if best is not None and likeness(best)[0] >= ALIKE else None


def _unknown(key: str, names: Sequence[str], values: Mapping[str, str], known: Iterable[str]) -> str:
    meant = nearest(key, known)
    hint = "" if meant is None else f", did you mean {meant}?"
    return f"{_origin(key, names, values)}: {key} is not a known setting{hint}"


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


def too_large(value: Any, key: str = "") -> str | None:
    """The first setting in a tree of them whose whole number is too large for a float, which the parser would make of
    it; None for none.
    """
    if isinstance(value, Mapping):
        names = ((other, f"{key}.{name}" if key else str(name)) for name, other in value.items())
        return next((found for other, name in names if (found := too_large(other, name))), None)
    if isinstance(value, list):
        return next((found for other in value if (found := too_large(other, key))), None)
    return key if isinstance(value, int) and abs(value) > sys.float_info.max else None


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
