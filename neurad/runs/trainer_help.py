"""What ``neurad fit --help-trainer`` prints: the settings of Lightning's trainer, and which have no effect here."""

from __future__ import annotations

import inspect
import re

import lightning.pytorch as pl
from docstring_parser import parse

from neurad.runs.settings_help import Setting, trainer_help
from neurad.runs.trainer_settings import OURS, WITHOUT_EFFECT


def help_trainer() -> str:
    """Every setting of the trainer, in Lightning's words."""
    words = {
        argument.arg_name: argument.description or "" for argument in parse(pl.Trainer.__init__.__doc__ or "").params
    }
    settings = []
    for name, parameter in inspect.signature(pl.Trainer.__init__).parameters.items():
        if name == "self":
            continue
        text = f"It has no effect here: {WITHOUT_EFFECT[name][1]}." if name in WITHOUT_EFFECT else words.get(name, "")
        default = OURS.get(name, parameter.default)
        plain = re.sub(r":\w+:`~?([^`]*)`", r"\1", text)
        settings.append(Setting(f"trainer.{name}", " ".join(plain.split()), _kind(parameter.annotation), default))
    return trainer_help(settings)


def _kind(annotation: object) -> str:
    """A type without the names of its modules; lists of words stand in the text."""
    text = annotation.__name__ if isinstance(annotation, type) else str(annotation)
    text = re.sub(r"\b(?:[a-z_]\w*\.)+", "", text)
    if "Literal" in text:
        return "one of those below"
    null = " or null" if "NoneType" in text or "Optional" in text else ""
    text = re.sub(r"(Optional|Union)\[(.*)\]$", r"\2", text).replace(", NoneType", "")
    return re.sub(r", (?![^\[]*\])", " or ", text) + null
