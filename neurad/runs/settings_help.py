"""What ``neurad fit --help`` prints: all settings with their words.

What a setting means stands once, behind it in its dataclass or in the docstring of the method that takes it. Methods
need torch, which takes seconds to import, so theirs are shown where they are asked for.
"""

import inspect
import shutil
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pydoc import locate
from typing import Annotated, Any, Literal, get_args, get_origin

from docstring_parser import parse, parse_from_object

from neurad.assembly.settings import EvaluationSettings, RecoverySettings
from neurad.core.errors import InputError
from neurad.core.ranges import Range, hints, is_settings, range_of
from neurad.core.suggest import did_you_mean
from neurad.runs.trainer_settings import TrainerSettings

GROUPS: dict[str, type] = {
    "trainer": TrainerSettings,
    "model": RecoverySettings,
    "evaluation": EvaluationSettings,
}
"""Groups of settings, without ``data``, whose class lies above."""
METHOD, CALLBACKS = "model.method", "trainer.callbacks"
"""Settings that name classes, for which torch or Lightning is imported."""
LARGE = 1 << 31
"""Whole numbers so large are not worth saying."""
_KINDS = {int: "whole number", float: "number", bool: "true or false", str: "text"}
WIDTH = 110
"""Widest line."""
FIRST = {
    "--config NAME": "A file of settings. Several overlay each other, the last one on top; a name that is no file is "
    "looked up among the shipped configs, such as kitchen.yaml, scene.yaml and methods/prb.yaml.",
    "--data.root DIR": "A scene folder of your own: scene.xml, transforms_train.json, photographs.",
    "--ckpt_path RUN": "The run to start from: its folder, version_3 (in lightning_logs), a checkpoint, or last, which "
    "is the newest. `fit` continues it; the other verbs take the newest run by default.",
    "--seed_everything N": "Seed of every random decision, 0 by default.",
    "--trust MODULE": "A module of your own, mine for mine.py, whose classes the config may name: it is run. Several "
    "are separated by commas. No file can say it, so every verb that reads the run asks again.",
    "--print_config": "Print all settings as they would hold, and end.",
    "--help [WORD]": "This text, or of it the settings whose name has WORD in it.",
}
"""Options that are given most often."""
NOTE = (
    "The value behind a setting is what holds unless a config says otherwise, and the shipped ones say much: "
    "--print_config shows what holds. All can be given as --KEY VALUE or stand in a config, a line for each part of "
    "the key."
)


@dataclass(frozen=True)
class Setting:
    """A setting."""

    key: str
    """With dots."""
    words: str
    """What it means."""
    kind: str
    """What its value may be, with its range."""
    default: Any
    """``inspect.Parameter.empty`` where there is none."""


def all_settings(groups: Mapping[str, type]) -> dict[str, list[Setting]]:
    """Every setting by the group that it is shown in, with a heading for each; ``groups`` are classes by their key."""
    found = {f"{name}: {_about(owner)}": list(_settings(owner, name)) for name, owner in groups.items()}
    words = "What else accompanies the run, such as a TrainingBudget."
    found[f"trainer: {_about(groups['trainer'])}"].append(Setting(CALLBACKS, words, "classes and their settings", None))
    words = "How reflected light and its derivative are estimated; `--help method` shows methods and what each takes."
    found[f"model: {_about(groups['model'])}"].append(Setting(METHOD, words, "a class and its settings", "Radiometric"))
    return found


def method_settings() -> dict[str, list[Setting]]:
    """What each of the shipped methods takes, methods that take the same together."""
    from neurad.runs.configs import shipped_methods

    alike: dict[tuple[str, ...], tuple[list[str], list[Setting]]] = {}
    for path in sorted({method["class_path"] for method in shipped_methods().values()}):
        owner: Any = locate(path)
        settings = list(_settings(owner, f"{METHOD}.init_args"))
        alike.setdefault(tuple(map(str, settings)), ([], settings))[0].append(path)
    return {f"{METHOD}.class_path {' or '.join(paths)}": settings for paths, settings in alike.values()}


def help_text(verb: str, about: str, data: type, words: Sequence[str] = ()) -> str:
    """The help of one of Lightning's verbs, or of the settings alone that have one of the words in their key; ``data``
    is the class of the settings under that.

    Raises:
        InputError: no setting has any of them.
    """
    groups = all_settings({"trainer": GROUPS["trainer"], "data": data, **GROUPS})
    if words:
        wanted = [word.lstrip("-") for word in words]
        chosen = _chosen(groups, wanted)
        if not chosen or any("method".startswith(word) or METHOD in word for word in wanted):
            methods = method_settings()
            chosen |= methods if any(word in f"{METHOD}.class_path" for word in wanted) else _chosen(methods, wanted)
            groups |= methods
        if not chosen:
            parts = {part for settings in groups.values() for setting in settings for part in setting.key.split(".")}
            raise InputError(f"--help {words[0]}: no setting has that in its name{did_you_mean(wanted[0], parts)}")
        return "\n".join(_group(name, settings) for name, settings in chosen.items())
    lines = [
        f"usage: neurad {verb} {'--config NAME.yaml ...' if verb == 'fit' else '[--ckpt_path RUN]'} [--KEY VALUE ...]",
        "",
        f"{about[:1].upper()}{about[1:]}.",
        "",
        "given most often",
    ]
    for option, text in FIRST.items():
        lines += [f"  {option}", *_wrapped(text)]
    lines += ["", *textwrap.wrap(NOTE, _width()), ""]
    shown = {option.partition(" ")[0].removeprefix("--") for option in FIRST}
    rest = {name: [s for s in settings if s.key not in shown] for name, settings in groups.items()}
    return "\n".join([*lines, *(_group(name, settings) for name, settings in rest.items())])


def _chosen(groups: Mapping[str, Sequence[Setting]], words: Sequence[str]) -> dict[str, list[Setting]]:
    """The settings with one of the words in their key."""
    found = {name: [s for s in settings if any(word in s.key for word in words)] for name, settings in groups.items()}
    return {name: settings for name, settings in found.items() if settings}


def _about(owner: type) -> str:
    """What a class says of itself in its first line."""
    return (parse(owner.__doc__ or "").short_description or "").rstrip(".")


def _settings(owner: type, prefix: str, given: object = None) -> Iterator[Setting]:
    """The settings of a class and of the groups inside it."""
    words = {
        parameter.arg_name: parameter.description or ""
        for base in reversed(owner.__mro__[:-1])
        for parameter in parse_from_object(base).params
    }
    parameters = inspect.signature(owner).parameters
    for name, hint in hints(owner).items():
        default = parameters[name].default if given is None else getattr(given, name)
        if is_settings(hint):
            yield from _settings(hint, f"{prefix}.{name}", None if default is inspect.Parameter.empty else default)
        else:
            yield Setting(f"{prefix}.{name}", " ".join(words.get(name, "").split()), _kind(hint), default)


def _kind(hint: Any) -> str:
    parts = [hint] if get_origin(hint) in (None, Annotated, Literal, list, tuple) else list(get_args(hint))
    part = next(part for part in parts if part is not type(None))
    own = [x for x in parts if inspect.isclass(x) and x not in (*_KINDS, type(None))]
    null = " or null" if type(None) in parts else ""
    if part in own:
        return f"a class of your own{null}"
    optional = f"{' or a class of your own' if own else ''}{null}"
    if get_origin(part) is Literal:
        return " or ".join(map(str, get_args(part))) + optional
    if get_origin(part) in (list, tuple):
        return "list of texts" + optional
    words, allowed = _KINDS[get_args(part)[0] if get_origin(part) is Annotated else part], range_of(hint)
    if allowed is not None:
        words += f", {Range(allowed.low, above=allowed.above) if allowed.high >= LARGE - 1 else allowed}"
    return words.removesuffix(", finite") + optional


def _group(name: str, settings: Sequence[Setting]) -> str:
    lines = [name]
    for setting in settings:
        default = setting.default
        given = "null" if default is None else str(default).lower() if isinstance(default, bool) else str(default)
        value = "" if default is inspect.Parameter.empty else f" {given}"
        words = setting.words
        words = words if words.startswith("`") else words[:1].upper() + words[1:]
        lines += [f"  --{setting.key}{value}    ({setting.kind})", *_wrapped(words)]
    return "\n".join(lines) + "\n"


def _wrapped(text: str) -> list[str]:
    plain = text.replace("``", "").replace(":meth:", "").replace(":class:", "")
    return textwrap.wrap(plain, _width(), initial_indent="      ", subsequent_indent="      ")


def _width() -> int:
    return max(40, min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns - 1))
