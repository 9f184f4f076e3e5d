"""What ``neurad fit --help`` prints: our settings with their words, and how to see the trainer's."""

from __future__ import annotations

import shutil
import textwrap
from collections.abc import Sequence
from typing import Any

from neurad.core.suggest import did_you_mean
from neurad.runs.settings_source import REQUIRED, Setting, all_settings

WIDTH = 110
"""Widest line."""
FIRST = {
    "--config NAME": "A file of settings. Several overlay each other, the last one on top; a name that is no file is "
    "looked up among the shipped configs, such as kitchen.yaml, scene.yaml and methods/prb.yaml.",
    "--data.root DIR": "A scene folder of your own: scene.xml, transforms_train.json, photographs.",
    "--trainer.max_time TIME": "How long to fit: 60s, 4m, 1h30m or DD:HH:MM:SS. Learning rates fall to their end with "
    "it, so a run that is given more ends better.",
    "--trainer.max_steps N": "How many steps to fit. The run ends when either limit is reached.",
    "--ckpt_path RUN": "The run to start from: its folder, version_3 (in lightning_logs), a checkpoint, or last, which "
    "is the newest. `fit` continues it; the other verbs take the newest run unless told.",
    "--trainer.default_root_dir DIR": "Where lightning_logs lies; the present folder unless told.",
    "--trainer.accelerator NAME": "cpu, gpu or auto.",
    "--trainer.devices N": "Processes or GPUs; with several also --trainer.strategy ddp.",
    "--trainer.enable_progress_bar BOOL": "false prints no line of progress.",
    "--seed_everything N": "Seed of every random decision, 0 unless told.",
    "--trust MODULE": "A module of your own, mine for mine.py, whose classes the config may name: it is run. Several "
    "are separated by commas. No file can say it, so every verb that reads the run asks again.",
    "--print_config": "Print all settings as they would hold, and end.",
    "--help [WORD]": "This text, or of it the settings whose name has WORD in it.",
    "--help-trainer": "The settings of Lightning's trainer, all below --trainer.",
}
"""Options that are given most often."""
NOTE = (
    "The value behind a setting is what holds unless a config says otherwise, and the shipped ones say much: "
    "--print_config shows what holds. All can be given as --KEY VALUE or stand in a config, a line for each part of "
    "the key."
)


def help_text(verb: str, about: str, words: Sequence[str] = ()) -> str:
    """The help of one of Lightning's verbs.

    Args:
        verb: such as ``fit``.
        about: what it does.
        words: show only settings with one of these in their key.

    Raises:
        InputError: no setting has any of them.
    """
    from neurad.core.errors import InputError

    groups = all_settings()
    if words:
        keys = [setting.key for settings in groups.values() for setting in settings]
        groups = {
            name: [s for s in settings if any(word.lstrip("-") in s.key for word in words)]
            for name, settings in groups.items()
        }
        if not any(groups.values()):
            parts = {part for key in keys for part in key.split(".")}
            near = did_you_mean(words[0].lstrip("-"), parts)
            raise InputError(f"--help {words[0]}: no setting has that in its name{near}")
        return "\n".join(_group(name, settings) for name, settings in groups.items() if settings)
    lines = [
        f"usage: neurad {verb} --config NAME.yaml ... [--KEY VALUE ...]",
        "",
        f"{about[:1].upper()}{about[1:]}.",
        "",
        "given most often",
    ]
    for option, text in FIRST.items():
        lines += [f"  {option}", *_wrapped(text)]
    lines += ["", *textwrap.wrap(NOTE, _width()), ""]
    return "\n".join([*lines, *(_group(name, settings) for name, settings in groups.items())])


def trainer_help(settings: Sequence[Setting]) -> str:
    """The help of the trainer's own settings."""
    head = "Lightning's trainer: these settings are not ours, and neither are their words."
    return f"{head}\n\n{_group('trainer', settings)}"


def _group(name: str, settings: Sequence[Setting]) -> str:
    lines = [name]
    for setting in settings:
        value = "" if setting.default is REQUIRED else f" {_yaml(setting.default)}"
        words = setting.words
        words = words if words.startswith("`") else words[:1].upper() + words[1:]
        lines += [f"  --{setting.key}{value}    ({setting.kind})", *_wrapped(words)]
    return "\n".join(lines) + "\n"


def _wrapped(text: str) -> list[str]:
    plain = text.replace("``", "").replace(":meth:", "").replace(":class:", "")
    return textwrap.wrap(plain, _width(), initial_indent="      ", subsequent_indent="      ")


def _yaml(value: Any) -> str:
    """A value as it stands in a config."""
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _width() -> int:
    return max(40, min(WIDTH, shutil.get_terminal_size((WIDTH, 24)).columns - 1))
