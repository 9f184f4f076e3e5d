"""Training runs for measuring: one built as ``neurad fit`` builds it, without evaluations, checkpoints or a run folder,
and a whole fit in a process of its own.
"""

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import lightning.pytorch as pl
from jsonargparse import ArgumentError

from datamodules.scene_data import SceneData
from neurad.core.errors import InputError
from neurad.runs.child import run_neurad
from neurad.runs.configs import load_config, only_trusted_classes, overlay, resolve
from neurad.runs.lightning import NeuradCLI
from neurad.runs.messages import setting_error, silence_lightning
from neurad.runtime.tables import numbers, read_csv
from neurad.training.inverse import InverseRenderer


class _Prepared(NeuradCLI):
    """Builds trainer, module and data, and runs nothing."""

    def _run_subcommand(self, subcommand: str) -> None:
        return None


def prepare(options: argparse.Namespace, steps: int) -> tuple[pl.Trainer, InverseRenderer, SceneData]:
    """What ``neurad fit`` would run for ``steps`` iterations; the trainer has no callbacks.

    Args:
        options: with ``config`` and ``set`` of :func:`benchmarks.bench.options.add_settings`, perhaps ``device``.
        steps: length of the run.

    Raises:
        InputError: the settings are wrong.
    """
    silence_lightning()
    only_trusted_classes()
    values: dict[str, str] = {}
    for word in options.set:
        key, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"--set {word}: it is not KEY=VALUE")
        values[key] = value
    values |= {
        "trainer.max_time": "null",
        "trainer.max_steps": str(steps),
        "trainer.enable_progress_bar": "false",
        "trainer.default_root_dir": tempfile.gettempdir(),
        "trainer.logger": "false",
    }
    if getattr(options, "device", "auto") != "auto":
        values["trainer.accelerator"] = "gpu" if options.device.startswith("cuda") else options.device
    names = options.config or [options.default_config]
    layers = [layer for name in names for layer in load_config(name)]
    overlay(layers, values)
    parsed = [f"--config={json.dumps(tree)}" for tree in resolve(layers, values)]
    rest = [f"--{key}={value}" for key, value in values.items()]
    known: list[str] = []
    try:
        made = _Prepared("fit", None, InverseRenderer, SceneData, ["fit", *parsed, *rest], known)
    except ArgumentError as error:
        raise InputError(setting_error(str(error), names, values, known)) from error
    trainer = cast(Any, made.trainer)
    trainer.callbacks = []
    return trainer, cast(InverseRenderer, made.model), cast(SceneData, made.datamodule)


def watched_fit(
    benchmark: str, watch: type[pl.Callback], arguments: dict[str, float], words: Sequence[str]
) -> list[dict[str, float]]:
    """The table that a callback writes during a fit in a process of its own.

    Args:
        benchmark: that wants it, for the sentence.
        watch: the callback's class, which gets the path of the table as ``out``.
        arguments: further ones of the callback.
        words: settings of the fit.

    Raises:
        InputError: the fit failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "watch.csv"
        name = f"{watch.__module__}.{watch.__qualname__}"
        callback = json.dumps({"class_path": name, "init_args": {"out": str(out), **arguments}})
        fit = ["fit", "--trust=benchmarks", *words, f"--trainer.default_root_dir={folder}"]
        ended = run_neurad([*fit, f"--trainer.callbacks+={callback}"], Path(folder) / "log")
        if ended.code != 0:
            raise InputError(f"{benchmark}: the fit failed: {ended.message}")
        return [numbers(row) for row in read_csv(out)[1]]
