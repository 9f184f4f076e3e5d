"""Settings of a config, for what needs them without the command line."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from jsonargparse import ArgumentError, ArgumentParser
from omegaconf import OmegaConf

from neurad.assembly.model_settings import ModelSettings
from neurad.core.errors import InputError
from neurad.core.ranges import internal, violations
from neurad.formats.reader import Reader
from neurad.integrators.radiometric import Radiometric
from neurad.runs.configs import load_config, only_trusted_classes
from neurad.runs.machine_defaults import patches, rates_for
from neurad.runs.messages import IS_TOO_LARGE, setting_error, too_large
from neurad.runs.trainer_settings import wrong_seed
from neurad.runs.trust import import_trusted

T = TypeVar("T")


def parse_model(model: dict[str, Any], source: str, trusted: Iterable[str] = (), seed: Any = 0) -> ModelSettings:
    """Make the settings of a ``model`` section, as the command line makes them.

    Args:
        model: values by key, classes by ``class_path``.
        source: the file that they are from; begins the error message.
        trusted: the user's own modules, whose classes they may name.
        seed: the value of ``seed_everything``.

    Raises:
        InputError: a key is unknown or a value is wrong.
    """
    for key, text in wrong_seed(seed):
        raise InputError(f"{source}: {key}: {text}")
    given = {key: value for key, value in model.items() if not (key == "method" and value is None)}
    return replace(_parse(ModelSettings, "model", given, source, trusted), seed=seed)


@dataclass(frozen=True)
class _Reading:
    """What of ``data`` names a class."""

    reader: Reader | None = None


def parse_reader(given: Any, source: str, trusted: Iterable[str] = ()) -> Reader | None:
    """Make the reader that ``data.reader`` names, None for null; otherwise as :func:`parse_model`."""
    return _parse(_Reading, "data", {"reader": given}, source, trusted).reader


def own_reader(name: str | None, trust: Iterable[str]) -> Reader | None:
    """The reader that ``--data.reader`` names on a command line, in a module that ``--trust`` does; None for None.

    Raises:
        InputError: there is no such class, or it is no reader.
    """
    if name is None:
        return None
    parser = _parser(_Reading, "data", import_trusted(trust))
    try:
        made: _Reading = parser.instantiate(parser.parse_object({"data": {"reader": name}}))["data"]
    except ArgumentError as error:
        raise InputError(setting_error(str(error), (), {"data.reader": name})) from error
    return made.reader


def _parser(kind: type, name: str, trusted: Iterable[str]) -> ArgumentParser:
    """A parser of a class's settings, which may name what the user trusts."""
    only_trusted_classes(trusted)
    parser = ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(kind, name, skip=internal(kind))
    return parser


def _parse(kind: type[T], name: str, given: dict[str, Any], source: str, trusted: Iterable[str]) -> T:
    parser = _parser(kind, name, trusted)
    try:
        parsed = parser.parse_object({name: given})
        for key, text in violations(parsed.as_dict()[name], kind, name):
            raise InputError(f"{source}: {key}: {text}")
        settings: T = parser.instantiate(parsed)[name]
    except ArgumentError as error:
        raise InputError(f"{source}: {' '.join(str(error).split())}") from error
    except OverflowError as error:
        raise InputError(f"{source}: {too_large({name: given})}: {IS_TOO_LARGE}") from error
    return settings


def model_settings(config: str, seed: int = 0) -> ModelSettings:
    """Fields, numbers of samples, objective, learning rates and lighting of a config for the paper's method.

    Raises:
        InputError: the file is missing, or its method is another one.
    """
    model = _section(config, "model")
    rates_for(model["optimization"], batch_pixels(config))
    settings = parse_model(model, f"config {config}", seed=seed)
    if not isinstance(settings.method, Radiometric):
        raise InputError(f"config {config}: its method is {type(settings.method).__name__}, not the paper's")
    return settings


def batch_pixels(config: str) -> int:
    """Pixels of a batch of a config on a CPU."""
    data = _section(config, "data")
    side = data.get("patch_size", 1)
    return patches(data["patches"], side, "cpu") * int(side) ** 2


def _section(config: str, name: str) -> dict[str, Any]:
    """One section of a config, what it takes from other sections filled in."""
    tree: Any = OmegaConf.merge(*load_config(config), {"data": {"root": None}})
    section: Any = OmegaConf.to_container(tree[name], resolve=True)
    return dict(section)
