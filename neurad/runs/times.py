"""Settings that are times: ``4m`` and the like become what the parser reads, wherever they are given."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from neurad.core.durations import FORMS, dd_hh_mm_ss, has_unit, seconds_of
from neurad.core.errors import InputError


def _of_trainer(text: str) -> str:
    seconds = seconds_of(text)
    if 0 < seconds < 1:
        raise InputError(f"{text} is too short, a limit of time is at least 1s")
    return dd_hh_mm_ss(seconds)


TIMES: dict[str, Callable[[str], Any]] = {
    "trainer.max_time": _of_trainer,
    "checkpoint.every_seconds": seconds_of,
}
"""Settings that are times, and what makes of a text what their type is."""


def in_tree(tree: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The settings of a config with its times read.

    Raises:
        InputError: a time cannot be read.
    """
    found = dict(tree)
    for key, read in TIMES.items():
        group, _, name = key.partition(".")
        value = found[group].get(name) if isinstance(found.get(group), Mapping) else None
        if isinstance(value, str):
            found[group] = {**found[group], name: _read(key, value, read, source)}
    return found


def in_words(words: Sequence[str]) -> list[str]:
    """``--key=value`` words of a command line with their times read.

    Raises:
        InputError: a time cannot be read.
    """
    found = []
    for word in words:
        key, equals, value = word.partition("=")
        read = TIMES.get(key.removeprefix("--"))
        if read is None or not equals:
            found.append(word)
        else:
            found.append(f"{key}={_read(key, value, read, '')}")
    return found


def _read(key: str, value: str, read: Callable[[str], Any], source: str) -> Any:
    """A time, or the text itself where it is none of ours: the parser says what is wrong with it."""
    if value == "null":
        return value
    name = f"{source}: {key}" if source else key
    if key.endswith("max_time"):
        if value.strip().isdecimal():
            raise InputError(f"{name}: {value} has no unit, a time is written {FORMS}")
        if not has_unit(value) and ":" not in value:
            raise InputError(f"{name}: {value} is not a time, such as {FORMS}")
        if value.count(":") == 3:
            return value
    elif not has_unit(value) and ":" not in value:
        return value
    try:
        return read(value)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error
