"""Config files: where they are found, how they overlay each other, and how ``${...}`` is resolved.

Several files overlay each other from left to right, and the command line goes on top of all of them. Interpolations are
resolved against that final state, so ``--model.width 32`` also changes every value written ``${model.width}``.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, cast

import yaml  # type: ignore[import-untyped]
from jsonargparse import set_parsing_settings
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

import neurad
from neurad.core.errors import InputError
from neurad.core.ranges import IS_GROUP
from neurad.core.suggest import did_you_mean
from neurad.runs.trust import SHIPPED, split_words
from neurad.runtime.reading import beside, exists, expanded, regular_file, shown

Tree = dict[str, Any]
_granted: set[str] = set()
"""Modules that the parser was ever allowed to import beyond what every config may name."""


def only_trusted_classes(trusted: Iterable[str] = ()) -> None:
    """Let the parser import what every config may name, and the ``trusted`` modules, from now on; nothing else."""
    set_parsing_settings(import_path_denylist=["*", *_granted], import_path_allowlist=[*SHIPPED, *trusted])
    _granted.update(trusted)


def shipped_folders() -> list[Path]:
    """Folders of the shipped configs: inside an installed package, or beside it in a checkout."""
    package = Path(neurad.__file__).resolve().parent
    return [d for d in (package / "configs", package.parent / "configs") if (d / "scene.yaml").is_file()]


def find_config(name: str) -> Path:
    """The file that ``name`` stands for: a path, or the name of a shipped config.

    Raises:
        InputError: there is neither.
    """
    path = expanded(name, "config")
    if exists(path) and not path.is_dir():
        return regular_file(path)
    if not path.is_absolute():
        for folder in shipped_folders():
            if exists(folder / path) and (folder / path).is_file():
                return folder / path
    own = [str(path.parent / other) for other in beside(path) if other.endswith((".yaml", ".yml"))]
    names = [file.relative_to(folder).as_posix() for folder in shipped_folders() for file in folder.rglob("*.yaml")]
    near = did_you_mean(name, [*own, *names])
    raise InputError(f"config {shown(name)}: no such file, and no shipped config has this name ({_shipped()}){near}")


def _shipped() -> str:
    """Names of all shipped configs, a folder's together: ``kitchen.yaml, methods/{ours, prb}.yaml``."""
    names: dict[str, list[str]] = {}
    for folder in shipped_folders():
        for file in sorted(folder.rglob("*.yaml")):
            names.setdefault(file.parent.relative_to(folder).as_posix(), []).append(file.stem)
    groups = [f"{name}.yaml" for name in names.pop(".", [])]
    groups += [f"{folder}/{{{', '.join(stems)}}}.yaml" for folder, stems in sorted(names.items())]
    return ", ".join(groups)


def shipped_methods() -> dict[str, Tree]:
    """Class and settings of every method in ``configs/methods``, by the name of its module: path, prb, ..."""
    found: dict[str, Tree] = {}
    for folder in shipped_folders():
        for file in sorted((folder / "methods").glob("*.yaml")):
            method: Any = OmegaConf.to_container(OmegaConf.merge(*load_config(str(file))).model.method)
            found.setdefault(method["class_path"].split(".")[-2], method)
    return found


def load_config(name: str, above: tuple[Path, ...] = ()) -> list[DictConfig]:
    """The layers of a config file, lowest first: those that its key ``base`` names, then its own. Files ``above`` led
    here through theirs.

    Raises:
        InputError: the file is missing, is not a YAML mapping, or is its own base.
    """
    path = find_config(name)
    if path.resolve() in above:
        raise InputError(f"config {name}: it is its own base")
    layer = read_layer(path, f"config {name}")
    if "trainer" in layer and not _refers(layer, "trainer") and not isinstance(layer["trainer"], DictConfig):
        # the parser itself refuses what stands for another group, and drops this
        raise InputError(f"config {name}: trainer: {IS_GROUP}")
    layers: list[DictConfig] = []
    for base in _bases(layer, name):
        beside = path.parent / base
        layers += load_config(str(beside if exists(beside) and beside.is_file() else base), (*above, path.resolve()))
    return [*layers, layer]


def read_layer(path: Path, name: str) -> DictConfig:
    """One file of settings, whatever it is based on.

    Raises:
        InputError: the file is no YAML mapping.
    """
    try:
        layer = OmegaConf.load(path)
    except RecursionError as error:
        raise InputError(f"{name}: it is nested too deeply to be a config") from error
    except (yaml.YAMLError, OmegaConfBaseException, ValueError, OSError) as error:
        raise InputError(f"{name}: it is not readable YAML ({' '.join(str(error).split())})") from error
    if not isinstance(layer, DictConfig):
        raise InputError(f"{name}: it is not a mapping of keys to values")
    if "config" in layer:  # the parser would read it as --config
        raise InputError(f"{name}: config is not a known setting, did you mean base?")
    if "trust" in layer:
        raise InputError(f"{name}: trust: no file can say whom you trust, give --trust on the command line")
    return layer


def _refers(layer: DictConfig, key: str) -> bool:
    """Whether a value is ``${...}`` or left open, which reading it would raise."""
    return OmegaConf.is_interpolation(layer, key) or OmegaConf.is_missing(layer, key)


def _bases(layer: DictConfig, name: str) -> list[str]:
    """The names under ``base``, which is taken out of the layer."""
    given = None if _refers(layer, "base") else layer.pop("base", [])
    names = [given] if isinstance(given, str) else given
    if isinstance(names, ListConfig):
        names = OmegaConf.to_container(names, resolve=False)
    if not isinstance(names, list) or not all(isinstance(base, str) for base in names):
        raise InputError(f"config {name}: base must be the name of a config, or a list of names")
    return names


def split_arguments(args: Sequence[str]) -> tuple[list[str], dict[str, str], list[str]]:
    """Separate config files and values from what follows a verb.

    Returns:
        Names of the config files; values by key, of which the last one given holds; all arguments but the configs.
    """
    names: list[str] = []
    values: dict[str, str] = {}
    rest: list[str] = []
    for key, value, said in split_words(args):
        if key in ("--config", "-c"):
            if value is None:
                raise InputError("--config needs the name of a file")
            names.append(value)
        elif value is None:
            rest += said
        else:
            values[key[2:]] = value
            rest.append(f"{key}={value}")
    return names, values, rest


def overlay(layers: Sequence[DictConfig], values: dict[str, str]) -> DictConfig:
    """All layers and the command line's values in one tree, interpolations not yet resolved.

    Raises:
        InputError: the layers have different kinds of things under one key.
    """
    merged: Any = OmegaConf.create({})
    for layer in layers:
        try:
            merged = OmegaConf.merge(merged, layer)
        except (OmegaConfBaseException, TypeError) as error:
            raise InputError(f"config: one has a list where another has keys ({str(error).splitlines()[0]})") from error
    for key, text in values.items():
        if key.endswith("+"):
            continue  # the parser's way to append to a list; nothing can refer to it
        try:
            OmegaConf.update(merged, key, yaml.safe_load(text), force_add=True)
        except (yaml.YAMLError, OmegaConfBaseException, TypeError, ValueError, RecursionError):
            continue  # the parser judges values; here they only serve as targets of interpolations
    return cast(DictConfig, merged)


def resolve(layers: Sequence[DictConfig], values: dict[str, str]) -> list[Tree]:
    """The layers as plain trees, with every interpolation replaced by its value in the final overlay.

    The layers stay apart, because the parser overlays them better than a merge of trees can: a layer that changes
    ``class_path`` drops the old class's ``init_args``.

    Raises:
        InputError: an interpolation refers to nothing, or a value is left open (``???``).
    """
    final = overlay(layers, values)
    try:
        return [_plain(layer, final, "") for layer in layers]
    except OmegaConfBaseException as error:
        raise InputError(f"config: {str(error).splitlines()[0]}") from error
    except RecursionError as error:
        raise InputError("config: it is nested too deeply") from error


def _plain(node: DictConfig, final: DictConfig, path: str) -> Tree:
    """``node`` as a plain dict. Whatever refers to something is read from the same place of the ``final`` tree: if
    something above has replaced it there, the parser will replace it as well.
    """
    tree: Tree = {}
    for key in node:
        name = path + str(key)
        if OmegaConf.is_interpolation(node, str(key)) or isinstance(node._get_node(key), ListConfig):
            value = OmegaConf.select(final, name, throw_on_missing=True)
            tree[str(key)] = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
        elif OmegaConf.is_missing(node, key):
            try:
                OmegaConf.select(final, name, throw_on_missing=True)
            except MissingMandatoryValue:
                raise InputError(f"--{name} is needed: the config leaves its value open") from None
        else:
            child = node[key]
            tree[str(key)] = _plain(child, final, name + ".") if isinstance(child, DictConfig) else child
    return tree
