"""Ranges of numbers: every setting has one in its type, and one function checks them.

A setting is written ``spp: Count = 2``, or with a range of its own ``guide: Annotated[int, Range(0, 32)] = 16``. The
command line, :func:`checked` for objects made in Python, and the options of verbs all read the range from there.
"""

import argparse
import math
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from neurad.core.errors import InputError


@dataclass(frozen=True)
class Range:
    """Numbers that a setting may have. NaN and infinity lie in no range."""

    low: float = -math.inf
    high: float = math.inf
    above: bool = False
    """Whether ``low`` itself is left out."""
    below: bool = False
    """Whether ``high`` itself is left out."""

    def __contains__(self, value: object) -> bool:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return False
        try:
            number = float(value)
        except OverflowError:  # a whole number of hundreds of digits
            return False
        lowest = self.low < number if self.above else self.low <= number
        highest = number < self.high if self.below else number <= self.high
        return math.isfinite(number) and lowest and highest

    def __str__(self) -> str:
        """How a sentence goes on after 'it must be'."""
        parts = []
        if self.low > -math.inf:
            parts.append(f"{'above' if self.above else 'at least'} {_written(self.low)}")
        if self.high < math.inf:
            parts.append(f"{'below' if self.below else 'at most'} {_written(self.high)}")
        return " and ".join(parts) or "finite"


INTERNAL = {"internal": True}
"""Metadata of a dataclass's field that no config says: the program fills it in."""
IS_GROUP = "it is a group of settings, write them below it"
"""What is wrong with a value in a group's place."""
_WHOLE = 2**31 - 1
"""Largest count; what is counted is indexed by 32 bits somewhere."""

Finite = Annotated[float, Range()]
"""Any number but NaN and infinity."""
Positive = Annotated[float, Range(0.0, above=True)]
NonNegative = Annotated[float, Range(0.0)]
Fraction = Annotated[float, Range(0.0, 1.0)]
"""From none to all."""
PositiveFraction = Annotated[float, Range(0.0, 1.0, above=True)]
"""More than none, up to all."""
OpenFraction = Annotated[float, Range(0.0, 1.0, above=True, below=True)]
"""Neither none nor all."""
Ceiling = Annotated[float, Range(0.0, 1e18, above=True)]
"""Where photographs are clipped."""
Count = Annotated[int, Range(1, _WHOLE)]
CountOrZero = Annotated[int, Range(0, _WHOLE)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
"""What every generator of random numbers takes."""
Texels = Annotated[int, Range(4096, 1 << 34)]
"""Texels of all textures of an export; a room has dozens of meshes, and none gets less than 8 x 8."""
TextureSide = Annotated[int, Range(8, 8192)]


def checked(settings: object) -> None:
    """Refuse an object whose settings lie outside their ranges or choices: called at the end of ``__init__``, or by
    ``__post_init__`` of a dataclass.

    Args:
        settings: its attributes have the names of the parameters of its ``__init__``.

    Raises:
        InputError: names the first setting that lies outside, its value and its range.
    """
    owner: Any = type(settings)
    kept = vars(settings)  # not getattr: a property of that name may read a scene
    for name, hint in hints(owner).items():
        for key, text in violations(kept.get(name), hint, f"{owner.__name__}.{name}"):
            raise InputError(f"{key}: {text}")


@dataclass(frozen=True)
class Checked:
    """Settings that are looked at when they are made: a base of dataclasses."""

    def __post_init__(self) -> None:
        """Refuse numbers outside their ranges and words that are no choice."""
        checked(self)


@cache
def hints(owner: type) -> Mapping[str, Any]:
    """Types of a class's settings by name: a dataclass's fields, otherwise what its ``__init__`` takes."""
    found = get_type_hints(owner if is_dataclass(owner) else owner.__init__, include_extras=True)  # type: ignore[misc]
    return {name: hint for name, hint in found.items() if name not in ("return", *internal(owner))}


def internal(owner: Any) -> set[str]:
    """Names of a dataclass's fields that are no settings; none of another class."""
    return {f.name for f in fields(owner) if "internal" in f.metadata} if is_dataclass(owner) else set()


def violations(value: Any, hint: Any, name: str) -> Iterator[tuple[str, str]]:
    """Every number outside its range and word that is no choice, in a value or a tree of parsed settings: its name, and
    what is wrong with it.

    Args:
        value: of a setting; of a group of settings a mapping, of a class its ``class_path`` and ``init_args``.
        name: of the setting, with dots.
    """
    allowed = range_of(hint)
    if value is None:
        return
    if allowed is not None and isinstance(value, (int, float)):
        if value not in allowed:
            yield name, f"{shown(value)} is out of range, it must be {allowed}"
    elif isinstance(value, str):
        choices = [choice for part in _parts(hint) if get_origin(part) is Literal for choice in get_args(part)]
        if choices and value not in choices:
            yield name, f"'{shown(value)}' is unknown, choose {' or '.join(map(str, choices))}"
    elif isinstance(value, Mapping):
        inner, path = (value.get("init_args"), value["class_path"]) if "class_path" in value else (value, "")
        owner = _class(path) if path else next((part for part in _parts(hint) if is_settings(part)), None)
        if owner is not None and isinstance(inner, Mapping):
            prefix = f"{name}.init_args" if path else name
            for key, part in hints(owner).items():
                if key in inner and inner[key] is None and needs_value(part):
                    yield f"{prefix}.{key}", "null is no value for it, leave it out"
                elif key in inner and is_settings(part) and not isinstance(inner[key], Mapping):
                    yield f"{prefix}.{key}", IS_GROUP
                yield from violations(inner.get(key), part, f"{prefix}.{key}")
    elif isinstance(value, (list, tuple)):
        for part in _parts(hint):
            origin = get_origin(part)  # no class where it is Annotated or Literal
            for index, entry in enumerate(value if isinstance(origin, type) and issubclass(origin, Sequence) else ()):
                yield from violations(entry, (get_args(part) or (Any,))[0], f"{name}[{index}]")


def range_of(hint: Any) -> Range | None:
    """The range in a type, also where None is allowed beside the number; None where there is none."""
    for part in _parts(hint):
        if get_origin(part) is Annotated:
            return next((extra for extra in get_args(part)[1:] if isinstance(extra, Range)), None)
    return None


def needs_value(hint: Any) -> bool:
    """Whether a type leaves no room for None, which the parser lets through for every setting."""
    return hint is not Any and hint is not None and type(None) not in _parts(hint)


def is_settings(hint: Any) -> bool:
    """Whether a type is a group of settings, which have ranges themselves."""
    return isinstance(hint, type) and is_dataclass(hint)


def option(hint: Any, parse: Callable[[str], float] | None = None) -> Callable[[str], Any]:
    """The ``type=`` of an argparse option with a range: ``parser.add_argument("--spp", type=option(Count))``.

    Args:
        parse: makes a number of the text, such as :func:`neurad.core.durations.seconds_of`; None reads a plain one.
    """
    allowed, (kind, *_) = range_of(hint), get_args(hint)

    def read(text: str) -> Any:
        try:
            value = (parse or kind)(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(str(error)) from None
        except ValueError:
            raise argparse.ArgumentTypeError(
                f"'{shown(text)}' is not a {'whole ' if kind is int else ''}number"
            ) from None
        if allowed is not None and value not in allowed:
            said = shown(text if parse else value)
            raise argparse.ArgumentTypeError(f"{said} is out of range, it must be {allowed}")
        return value

    read.range = allowed  # type: ignore[attr-defined]
    return read


def shown(value: object) -> str:
    """A value as a sentence quotes it: numbers of hundreds of digits and long texts are cut."""
    try:
        text = str(value)
    except ValueError:  # Python writes out no number of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:50]}... ({len(text)} characters)"


def _written(number: float) -> str:
    return str(number) if isinstance(number, int) else f"{number:.16g}"


def _parts(hint: Any) -> tuple[Any, ...]:
    """The alternatives of a type: ``Count | None`` has two."""
    return get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)


def _class(path: str) -> type | None:
    """The class that a parsed ``class_path`` names, if it is one of this project's: the parser has imported it."""
    module, _, name = str(path).rpartition(".")
    found = getattr(sys.modules.get(module), name, None)
    ours = str(path).split(".")[0] in ("neurad", "datamodules")
    return found if ours and isinstance(found, type) else None
