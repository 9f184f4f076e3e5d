"""A run's own ``config.yaml``, and what of it counts: it may have come with a checkpoint that somebody sent.

A config that is given by name is the user's own choice. One that lies beside a checkpoint is not: it may say what was
fitted, and for how long, but not name classes, other files of settings, or places to write to.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import fields as fields_of
from pathlib import Path
from typing import Any, get_args

from omegaconf import DictConfig, OmegaConf

from neurad import fields, formats, integrators
from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED
from neurad.fields.settings import Kind
from neurad.runs.configs import read_layer
from neurad.runs.trainer_settings import TrainerSettings
from neurad.runs.trust import how_to_trust, is_trusted
from neurad.runtime.progress import say

GROUPS = ("model", "data", "evaluation")
"""Groups of settings that are taken over: numbers, texts and lists of them."""
PLACES = ("default_root_dir", "logger")
"""Settings of the trainer that are not taken over, as they choose what is written where."""
_INNER = (*RECOVERED, "radiance", "sampling", "objective", "optimization", "lighting")
"""Groups below ``model``."""
CLASSES = {
    "model.method": integrators.__name__,
    **{f"model.{name}.kind": fields.__name__ for name in (*RECOVERED, "radiance")},
    "data.reader": formats.__name__,
}
"""Settings that may name a class, and where it has to be unless the user trusts its module."""


def own_config(folder: Path, trusted: Iterable[str] = ()) -> DictConfig:
    """What counts of the settings of a run; says on stderr what was left out.

    Raises:
        InputError: the file is missing, is no config of a run, or names classes or other files of settings.
    """
    path = folder / "config.yaml"
    tree: Any = OmegaConf.to_container(read_layer(path, str(path)), resolve=False)
    if "base" in tree:
        raise InputError(f"{path}: it has a base, which the config of a run never has")
    for name in GROUPS:
        _check_group(tree, name, name, path)
    kept: dict[str, Any] = {name: tree[name] for name in (*GROUPS, "seed_everything") if name in tree}
    for name in _INNER:
        _check_group(kept.get("model", {}), name, f"model.{name}", path)
    for key in CLASSES:
        _check_class(kept, key, path, trusted)
    _refuse(kept, "", path)
    kept["trainer"], left_out = _of_trainer(tree.get("trainer", {}), path)
    if left_out:
        say(
            f"{path}: left out {', '.join(f'trainer.{name}' for name in left_out)}, since a config beside a "
            "checkpoint may come from anybody; give it again where it is wanted"
        )
    return OmegaConf.create(kept)


def _check_group(tree: Mapping[str, Any], key: str, name: str, path: Path) -> None:
    """A group has keys: its name as a text would be read as that of another file of settings."""
    group = tree.get(key, {})
    if not isinstance(group, Mapping):
        raise InputError(f"{path}: {name} is not a group of settings")
    if "grid" in group:
        _check_group(group, "grid", f"{name}.grid", path)


def _refuse(value: Any, name: str, path: Path) -> None:
    """Nothing but numbers, texts, and lists and groups of them may stand in a run's own config."""
    if isinstance(value, Mapping):
        if "class_path" in value and name not in CLASSES:
            raise InputError(f"{path}: {name} names a class, {value['class_path']}; only {', '.join(CLASSES)} may")
        for key, inner in value.items():
            _refuse(inner, f"{name}.{key}".lstrip("."), path)
    elif isinstance(value, list):
        for inner in value:
            _refuse(inner, name, path)
    elif isinstance(value, str) and "${" in value:
        raise InputError(f"{path}: {name} refers to something else ({value}), which the config of a run never does")


def _check_class(tree: Mapping[str, Any], key: str, path: Path, trusted: Iterable[str]) -> None:
    """Refuse what a setting of :data:`CLASSES` names if it is neither neurad's own nor trusted."""
    *groups, last = key.split(".")
    for group in groups:
        tree = tree.get(group, {})
    value = tree.get(last)
    if value is None or (last == "kind" and value in get_args(Kind)):
        return
    name = str(value.get("class_path")) if isinstance(value, Mapping) else str(value)
    known = re.fullmatch(rf"{re.escape(CLASSES[key])}\.\w+\.\w+", name) or is_trusted(name, trusted)
    if not isinstance(value, Mapping) or not known:
        hint = how_to_trust(name) if isinstance(value, Mapping) else ""
        raise InputError(f"{path}: {key} names {name}, which is no class of {CLASSES[key]}{hint}")


def _of_trainer(trainer: Any, path: Path) -> tuple[dict[str, Any], list[str]]:
    """Settings of the trainer that are taken over, and the names of those that say something and are not."""
    if not isinstance(trainer, dict):
        raise InputError(f"{path}: trainer is not a group of settings")
    usual = {setting.name: setting.default for setting in fields_of(TrainerSettings)}
    kept: dict[str, Any] = {}
    left_out = []
    for key, value in trainer.items():
        if value is None or value == usual.get(key):
            continue
        budgets = isinstance(value, list) and all(_is_budget(entry) for entry in value)
        if (key in usual and key not in PLACES and _is_plain(value)) or (key == "callbacks" and budgets):
            kept[key] = value
        else:
            left_out.append(str(key))
    return kept, left_out


def _is_plain(value: Any) -> bool:
    """Whether a value of the trainer's is a number, a text or a list of whole numbers."""
    if isinstance(value, list):
        return all(isinstance(x, int) for x in value)
    return isinstance(value, (bool, int, float, str)) and "${" not in str(value)


def _is_budget(entry: Any) -> bool:
    """Whether a callback is the limit of training seconds, with nothing but its seconds, or begins to count them: those
    that are taken over.
    """
    from neurad import callbacks  # few runs have one, and Lightning, which comes along, takes seconds to load

    if entry == {"class_path": f"{callbacks.__name__}.{callbacks.WarmUp.__name__}"}:
        return True
    kind = callbacks.TrainingBudget
    names = [f"{place}.{kind.__name__}" for place in (callbacks.__name__, kind.__module__)]
    arguments = entry.get("init_args") if isinstance(entry, dict) else None
    return (
        isinstance(arguments, dict)
        and set(entry) == {"class_path", "init_args"}
        and entry["class_path"] in names
        and set(arguments) == {"seconds"}
        and isinstance(arguments["seconds"], (int, float))
    )
