"""Lightning's verbs: ``fit``, ``validate``, ``test`` and ``predict``."""

from __future__ import annotations

import json
import logging
import pickle
import re
import signal
import threading
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from jsonargparse import ArgumentError, set_parsing_settings
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.trainer.states import TrainerStatus
from omegaconf import OmegaConf

from neurad.callbacks import Bar, Evaluate, LastCheckpoint, RunFolder, RunLogger
from neurad.core.errors import InputError
from neurad.runs.configs import load_config, overlay, resolve, split_arguments

RUNS = "lightning_logs"
SHARED_KEYS = ("seed_everything", "trainer", "model", "data", "evaluation", "checkpoint", "bar")
"""Parts of a config that every verb understands."""
TRUSTED = ["neurad", "datamodules", "lightning", "torch.optim", "torch.nn", "datetime"]
"""Packages whose classes a config may name: configs are passed around, and naming a class runs it."""


def run(verb: str, args: Sequence[str], model: type[pl.LightningModule], data: type[pl.LightningDataModule]) -> None:
    """Parse the arguments of ``verb`` and run it.

    Args:
        verb: 'fit', 'validate', 'test' or 'predict'.
        args: what follows the verb on the command line.
        model: the Lightning module.
        data: the data module.

    Raises:
        InputError: the user's mistake, in one sentence.
    """
    _quiet()
    set_parsing_settings(import_path_denylist=["*"], import_path_allowlist=TRUSTED)
    names, values, rest = split_arguments(args)
    layers = [layer for name in names for layer in load_config(name)]
    settings = overlay(layers, values)
    only_print = any(token.startswith(("-h", "--help", "--print_config")) for token in args)
    checkpoint = None if only_print else find_checkpoint(verb, OmegaConf.to_container(settings, resolve=False))
    if checkpoint is not None:
        layers = [*_config_of_run(checkpoint), *layers]
    parsed = [f"--config={json.dumps(tree)}" for tree in resolve(layers, values)]
    rest = [token for token in rest if not token.startswith("--ckpt_path")]
    if checkpoint is not None:
        rest.append(f"--ckpt_path={checkpoint}")
    handler = signal.getsignal(signal.SIGINT)
    try:
        NeuradCLI(verb, checkpoint, model, data, [verb, *parsed, *rest])
    except ArgumentError as error:
        raise InputError(_sentence(str(error), names, values)) from error
    finally:
        # Lightning leaves Ctrl-C ignored after an interrupt.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


def find_checkpoint(verb: str, settings: Any) -> Path | None:
    """The checkpoint that a verb starts from, or None for a fit from scratch.

    Args:
        verb: 'fit' may do without; the others take the newest run's unless told otherwise.
        settings: the merged settings, of which ``ckpt_path`` and ``trainer.default_root_dir`` count.

    Raises:
        InputError: there is no such checkpoint, or it is none.
    """
    asked = settings.get("ckpt_path")
    if asked is None and verb == "fit":
        return None
    if asked in (None, "last"):
        root = Path((settings.get("trainer") or {}).get("default_root_dir") or ".")
        found = sorted((root / RUNS).glob("version_*/checkpoints/last.ckpt"), key=_version)
        if not found:
            raise InputError(f"--ckpt_path last: no run in {root / RUNS} has a checkpoint to start from")
        path = found[-1]
    else:
        path = Path(str(asked)).expanduser()
    if not path.is_file():
        raise InputError(f"--ckpt_path {path}: no such file")
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise InputError(f"--ckpt_path {path}: it is not a readable checkpoint") from error
    if not isinstance(state, dict) or "state_dict" not in state:
        raise InputError(f"--ckpt_path {path}: it is not a checkpoint of neurad")
    print(f"neurad: {verb} starts from {path}")
    return path


def _version(path: Path) -> int:
    number = path.parent.parent.name.removeprefix("version_")
    return int(number) if number.isdecimal() else -1


def _config_of_run(checkpoint: Path) -> list[Any]:
    """The settings of the run that wrote the checkpoint, as the lowest layer: whatever the user says goes on top."""
    path = checkpoint.parent.parent / "config.yaml"
    if checkpoint.parent.name != "checkpoints" or not path.is_file():
        return []
    layers = load_config(str(path.resolve()))
    return [OmegaConf.create({key: layer[key] for key in SHARED_KEYS if key in layer}) for layer in layers]


class NeuradCLI(LightningCLI):
    """LightningCLI with this project's callbacks, run folder and defaults.

    Args:
        verb: the one verb that a parser is built for; building all four takes seconds.
        checkpoint: what the run starts from.
        model: the Lightning module.
        data: the data module.
        args: the verb and its arguments, configs resolved.
    """

    def __init__(
        self,
        verb: str,
        checkpoint: Path | None,
        model: type[pl.LightningModule],
        data: type[pl.LightningDataModule],
        args: list[str],
    ) -> None:
        self.verb = verb
        self.checkpoint = checkpoint
        super().__init__(
            model,
            data,
            save_config_callback=RunFolder,
            trainer_defaults={
                "devices": 1,
                "max_epochs": -1,  # runs are measured in iterations and seconds
                "num_sanity_val_steps": 0,
                "enable_model_summary": False,
            },
            seed_everything_default=0,
            args=args,
            auto_configure_optimizers=False,
            load_from_checkpoint_support=False,  # it stores classes by name; checkpoints hold plain types only
        )

    def subcommands(self) -> dict[str, set[str]]:  # type: ignore[override]
        """The verb in use only."""
        return {self.verb: LightningCLI.subcommands()[self.verb]}

    def init_parser(self, **kwargs: Any) -> LightningArgumentParser:
        """A parser that raises instead of printing its usage and leaving."""
        return super().init_parser(**kwargs, exit_on_error=False, allow_abbrev=False)

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Parse what :func:`run` prepared, whatever ``sys.argv`` says."""
        self.config = parser.parse_args(args)

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """The callbacks that every run has, under keys of their own."""
        parser.add_lightning_class_args(Evaluate, "evaluation")
        parser.add_lightning_class_args(LastCheckpoint, "checkpoint")
        parser.add_lightning_class_args(Bar, "bar")

    def _parse_ckpt_path(self) -> None:
        """Nothing: the run's ``config.yaml`` is the lowest layer of the config already, so that what the user says
        beats it; Lightning would let the checkpoint win.
        """

    def instantiate_trainer(self, **kwargs: Any) -> pl.Trainer:
        """A trainer that logs to the run folder, that of the checkpoint if there is one."""
        settings = self._get(self.config_init, "trainer")
        if settings["logger"] in (None, True):
            logger = RunLogger.of_checkpoint(self.checkpoint) if self.checkpoint else None
            kwargs["logger"] = logger or RunLogger(settings["default_root_dir"] or ".", RUNS)
        if self.verb == "fit":
            if settings["max_steps"] < 0 and settings["max_time"] is None and not settings["fast_dev_run"]:
                raise InputError("--trainer.max_steps or --trainer.max_time is needed: without either no fit ends")
            kwargs["limit_val_batches"] = 0  # the Evaluate callback keeps its own schedule
        if settings["enable_progress_bar"] is False:
            self.config_init[self.verb].pop("bar", None)
        return super().instantiate_trainer(**kwargs)

    def _instantiate_trainer(self, config: dict[str, Any], callbacks: list[pl.Callback]) -> pl.Trainer:
        kept = [callback for callback in callbacks if callback is not None]
        try:
            return super()._instantiate_trainer(config, kept)
        except (MisconfigurationException, ValueError) as error:
            raise InputError(f"trainer: {error}") from error

    def _prepare_subcommand_kwargs(self, subcommand: str) -> dict[str, Any]:
        return {**super()._prepare_subcommand_kwargs(subcommand), "weights_only": True}

    def _run_subcommand(self, subcommand: str) -> None:
        try:
            super()._run_subcommand(subcommand)
        except SystemExit:
            if self.trainer.state.status == TrainerStatus.INTERRUPTED:
                raise SystemExit(130) from None
            raise


def _quiet() -> None:
    """Silence what says nothing to somebody who only has photographs."""
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


def _sentence(message: str, names: Sequence[str], values: Mapping[str, str]) -> str:
    """The parser's complaint as one sentence that says where the fault stands.

    Args:
        message: what the parser said, over several lines.
        names: the config files given.
        values: what was given on the command line, by key.
    """
    text = " ".join(message.split())
    unknown = re.search(r"does not accept option '([^']+)'", text) or re.search(r"Key '([^']+)' is not expected", text)
    wrong = re.search(r'Parser key "([^"]+)": (.*)', text)
    if unknown:
        return f"{_origin(unknown[1], names, values)}: {unknown[1]} is not a known setting"
    if wrong:
        denied = re.search(r"Importing '[^']+' is not allowed", wrong[2])
        union = re.search(r"Does not validate against any of the Union subtypes.*Given value: (.*)", wrong[2])
        reason = denied[0] if denied else f"{union[1]} is not a valid value" if union else wrong[2]
        return f"{_origin(wrong[1], names, values)}: {wrong[1]}: {reason}"
    return text


def _origin(key: str, names: Sequence[str], values: Mapping[str, str]) -> str:
    """Where a setting was given: 'command line' or the config file."""
    if any(given == key or given.startswith(f"{key}.") or key.startswith(f"{given}.") for given in values):
        return "command line"
    for name in reversed(names):
        for layer in load_config(name):
            if OmegaConf.select(layer, key) is not None:
                return f"config {name}"
    return "config"
