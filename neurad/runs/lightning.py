"""Lightning's verbs: ``fit``, ``validate``, ``test`` and ``predict``."""

import json
import os
import signal
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any, Literal

import lightning.pytorch as pl
import torch
from jsonargparse import ArgumentError, Namespace
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.accelerators import CPUAccelerator
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.trainer.states import TrainerStatus
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import OmegaConf

from neurad.callbacks import Bar, Evaluate, LastCheckpoint, RunFolder, RunLogger
from neurad.callbacks.run_folder import run_folder
from neurad.checkpoints.find import RUNS, named_checkpoint, newest_checkpoint, restoring, run_folder_of
from neurad.core.durations import seconds_of
from neurad.core.errors import InputError
from neurad.core.ranges import IS_GROUP, hints, internal
from neurad.formats.hints import hint_entries, hints_of
from neurad.integrators.radiometric import Radiometric
from neurad.runs.configs import find_config, load_config, only_trusted_classes, overlay, resolve, split_arguments
from neurad.runs.machine_defaults import GPU, accelerator, patches, rates_for
from neurad.runs.messages import IS_TOO_LARGE, reason, setting_error, silence_lightning, too_large
from neurad.runs.own_config import own_config
from neurad.runs.trainer_settings import TrainerSettings, complaints
from neurad.runs.trust import import_trusted, split_trust
from neurad.runtime import progress
from neurad.runtime.files import check_folder
from neurad.runtime.machine import usable_cores
from neurad.runtime.progress import say
from neurad.runtime.reading import expanded
from neurad.training.loopback import LoopbackDDP

ROOT = "--trainer.default_root_dir"


@dataclass(frozen=True)
class FitTrainerSettings(TrainerSettings):
    """All settings under ``trainer``, with those that Lightning is imported for."""

    callbacks: list[pl.Callback] | pl.Callback | None = None
    """What else accompanies the run: classes of Lightning's, such as :class:`neurad.callbacks.TrainingBudget`."""


def run(verb: str, args: Sequence[str], model: type[pl.LightningModule], data: type[pl.LightningDataModule]) -> None:
    """Parse the arguments of ``verb`` and run it.

    Raises:
        InputError: the user's mistake, in one sentence.
    """
    silence_lightning()
    trust, args = split_trust(args)
    names, values, rest = split_arguments(args)
    trusted = import_trusted(trust, [find_config(name).parent for name in names])
    only_trusted_classes(trusted)
    layers = [layer for name in names for layer in load_config(name)]
    settings = overlay(layers, values)
    tree: Any = OmegaConf.to_container(settings, resolve=False)
    if isinstance(tree.get("trainer"), dict) and tree["trainer"].get("enable_progress_bar") is False:
        progress.off()
    only_print = any(token.startswith("--print_config") for token in args)
    checkpoint = None if only_print else find_checkpoint(verb, tree)
    if checkpoint is not None and (folder := run_folder_of(checkpoint)) is not None:
        layers = [own_config(folder, trusted), *layers]  # the lowest: the user's own settings go on top
    parsed = [f"--config={_as_text(tree)}" for tree in resolve(layers, values)]
    rest = [token for token in rest if not token.startswith("--ckpt_path")]
    if checkpoint is not None:
        rest.append(f"--ckpt_path={checkpoint}")
    handler = signal.getsignal(signal.SIGINT)
    known: list[str] = []
    try:
        NeuradCLI(verb, checkpoint, model, data, [verb, *parsed, *rest], known)
    except ArgumentError as error:
        raise InputError(setting_error(str(error), names, values, known)) from error
    finally:
        # Lightning leaves Ctrl-C ignored after an interrupt.
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, handler)


def _too_large(args: Sequence[str]) -> str:
    """The setting among ``--config=JSON`` and ``--KEY=VALUE`` that :func:`too_large` finds."""
    for word in args:
        key, _, text = word.removeprefix("--").partition("=")
        with suppress(ValueError):
            if found := too_large(json.loads(text), "" if key == "config" else key):
                return found
    return "a setting"


def _as_text(tree: dict[str, Any]) -> str:
    """Settings as the parser reads them."""
    try:
        return json.dumps(tree)
    except (TypeError, ValueError) as error:
        raise InputError(f"config: it has a value that no setting can have ({error})") from error
    except RecursionError as error:
        raise InputError("config: it is nested too deeply") from error


def find_checkpoint(verb: str, settings: Any) -> Path | None:
    """The checkpoint that a verb starts from by the merged settings, or None for a fit from scratch; other verbs take
    the newest run's unless the settings name one.

    Raises:
        InputError: there is no such checkpoint, or the file is not one.
    """
    given = settings.get("ckpt_path")
    if given is None and verb == "fit":
        return None
    root = expanded(str((settings.get("trainer") or {}).get("default_root_dir") or "."), ROOT)
    if given in (None, "last"):
        newest = newest_checkpoint(root)
        if newest is None:
            raise InputError(f"--ckpt_path last: no run in {root / RUNS} has a checkpoint to start from")
        path = newest
    else:
        path = expanded(str(given), "--ckpt_path")
        path = named_checkpoint(path, root, f"--ckpt_path {path}")
    print(f"neurad: {verb} starts from {path}")
    return path


class NeuradCLI(LightningCLI):
    """LightningCLI with this project's callbacks, run folder and defaults.

    Args:
        verb: the one verb that a parser is built for; building all four takes seconds.
        model: the Lightning module; it takes its settings, and so do the others.
        args: the verb and its arguments, configs resolved.
        known: gets the names of all settings, for error messages.
    """

    def __init__(
        self,
        verb: str,
        checkpoint: Path | None,
        model: type[pl.LightningModule],
        data: type[pl.LightningDataModule],
        args: list[str],
        known: list[str],
    ) -> None:
        self.verb, self.known = verb, known
        owners: dict[str, type] = {"data": data, "model": model, "evaluation": Evaluate}
        self.settings: dict[str, type] = {"trainer": FitTrainerSettings}
        self.settings |= {name: hints(owner)["settings"] for name, owner in owners.items()}
        self.checkpoint = checkpoint
        super().__init__(
            model,
            data,
            save_config_callback=RunFolder,
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
        """Parse what :func:`run` prepared, whatever ``sys.argv`` says, and check the ranges of all numbers."""
        groups = {name: hints(owner) for name, owner in self.settings.items()}
        self.known += [action.dest for action in self._subcommand_parsers[self.verb]._actions]
        try:
            self.config = parser.parse_args(args)
        except RecursionError as error:
            raise InputError("the settings are nested too deeply") from error
        except OverflowError as error:  # a whole number where one with a fraction may stand
            raise ArgumentError(None, f'Parser key "{_too_large(args)}": {IS_TOO_LARGE}') from error
        for name in self.settings:
            if not isinstance(self.config[self.verb].get(name), Namespace):
                raise ArgumentError(None, f'Parser key "{name}": {IS_GROUP}')
        for key, text in complaints(self.config[self.verb].as_dict(), groups):
            raise ArgumentError(None, f'Parser key "{key}": {text}')
        self._follow_machine(self.config[self.verb])
        self._follow_hints(self.config[self.verb])

    def _follow_machine(self, settings: Namespace) -> None:
        """Choose the accelerator, which is chosen anew wherever a run goes on, and the batch with the rates that suit
        it, which stay with the run.
        """
        self._accelerator = accelerator(settings.trainer.accelerator, settings.model.tracer)
        data = settings.data
        data.patches = patches(data.patches, data.patch_size, self._accelerator)
        rates_for(settings.model.optimization, data.patches * data.patch_size**2)

    def _follow_hints(self, settings: Namespace) -> None:
        """Read the file of hints: its entries become settings of the run, which no later change of the file changes."""
        if settings.data.hints is None:
            return
        settings.data.hints = hint_entries(settings.data.hints)
        lighting = settings.model.lighting
        if hints_of(settings.data.hints).shines and lighting.emitters != "find":
            lighting.emitters = "find"
            say(
                "the hints say what shines, so the radiance of all lamps is recovered, and others are looked "
                "for (model.lighting.emitters find)"
            )

    def add_core_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """All groups of settings."""
        for name, owner in self.settings.items():
            parser.add_class_arguments(owner, name, sub_configs=True, skip=internal(owner))
        parser.set_defaults({"model.method": {"class_path": f"{Radiometric.__module__}.{Radiometric.__name__}"}})

    def _parse_ckpt_path(self) -> None:
        """Nothing: the run's ``config.yaml`` is the lowest layer of the config already, below the user's settings;
        Lightning would put the checkpoint's on top of them.
        """

    def instantiate_classes(self) -> None:
        """Make model, data and trainer.

        Raises:
            InputError: a class that the settings name cannot be made with them.
        """
        try:
            self.config_init = self.parser.instantiate(self.config)
        except (TypeError, ValueError) as error:
            if not any(words in str(error) for words in ("Union subtypes", "unexpected keyword argument")):
                raise
            method = self._get(self.config, "model").method.class_path
            raise InputError(f"settings: {reason(' '.join(str(error).split()), method)}") from error
        self.datamodule = self._made(self._datamodule_class, "data")
        self.model = self._made(self._model_class, "model")
        self.model.begins_from = self.checkpoint
        self.trainer = self.instantiate_trainer()

    def _made(self, owner: Callable[[Any], Any], name: str) -> Any:
        """An object of a class that takes the settings of a group, and the run's seed where they have one."""
        settings = self._get(self.config_init, name)
        seeded = {"seed": self._get(self.config, "seed_everything")} if "seed" in internal(type(settings)) else {}
        return owner(replace(settings, **seeded))

    def instantiate_trainer(self, **_: Any) -> pl.Trainer:
        """A trainer that logs to the run folder, that of the checkpoint if there is one."""
        settings: FitTrainerSettings = self._get(self.config_init, "trainer")
        logger: RunLogger | bool = False
        if settings.logger:
            found = RunLogger.of_checkpoint(self.checkpoint) if self.checkpoint else None
            logger = found or RunLogger(expanded(settings.default_root_dir or ".", ROOT), RUNS)
        if self.verb == "fit" and settings.max_steps < 0 and settings.max_time is None:
            raise InputError(
                "--trainer.max_steps or --trainer.max_time is needed, without either no fit ends; kitchen.yaml is"
                " the --config of the demo, scene.yaml that for a folder"
            )
        config = {**vars(settings), "logger": logger, "accelerator": self._accelerator}
        # Runs are measured in iterations and seconds, and the Evaluate callback keeps its own schedule.
        config |= {"max_epochs": -1, "num_sanity_val_steps": 0, "enable_model_summary": False}
        config |= {"limit_val_batches": 0} if self.verb == "fit" else {}
        if settings.max_time is not None:
            config["max_time"] = timedelta(seconds=seconds_of(settings.max_time))
        callbacks: list[pl.Callback] = [self._made(Evaluate, "evaluation"), LastCheckpoint()]
        callbacks += [Bar()] if settings.enable_progress_bar else []
        try:
            config["strategy"] = self._strategy(settings.devices)
            trainer = self._instantiate_trainer(config, callbacks)
        except (MisconfigurationException, ValueError, TypeError, ModuleNotFoundError) as error:
            raise InputError(f"trainer: {error}") from error
        except (KeyError, RuntimeError) as error:
            if not any(name.startswith("SLURM_") for name in os.environ):
                raise
            raise InputError(f"trainer: it seems to run under SLURM, but not by srun ({error}); see sbatch") from error
        if isinstance(trainer.accelerator, CPUAccelerator) and trainer.num_devices > max(2, usable_cores()):
            raise InputError(f"--trainer.devices: {trainer.num_devices} processes for {usable_cores()} processor cores")
        self._check_target(trainer)
        return trainer

    def _strategy(self, devices: int | list[int] | Literal["auto"]) -> LoopbackDDP | Literal["auto"]:
        """How processes share a fit; ``auto`` for one alone."""
        if devices == "auto":
            devices = torch.cuda.device_count() if self._accelerator in GPU else 1
        if (len(devices) if isinstance(devices, list) else devices) == 1:
            return "auto"
        objective = self._get(self.config_init, "model").objective
        # Without either term nothing trains the radiance field, and DDP waits for each gradient that it expects.
        return LoopbackDDP(find_unused_parameters=objective.prior == 0.0 and objective.lhs == 0.0)

    def _check_target(self, trainer: pl.Trainer) -> None:
        """Find out before anything is measured whether the files of this verb can be written."""
        folder = run_folder(trainer)
        if self.verb == "fit":
            for callback in _run_folders(trainer):
                callback.claim(trainer)
        elif self.verb in ("test", "predict") and folder is not None and trainer.is_global_zero:
            check_folder(folder / "images")

    def _prepare_subcommand_kwargs(self, subcommand: str) -> dict[str, Any]:
        return {**super()._prepare_subcommand_kwargs(subcommand), "weights_only": True}

    def _run_subcommand(self, subcommand: str) -> None:
        try:
            with restoring(self.checkpoint):
                super()._run_subcommand(subcommand)
        except SIGTERMException:
            raise SystemExit(128 + signal.SIGTERM) from None
        except SystemExit:
            if self.trainer.state.status == TrainerStatus.INTERRUPTED:
                raise SystemExit(130) from None
            raise
        finally:
            for callback in _run_folders(self.trainer):
                callback.release()


def _run_folders(trainer: pl.Trainer) -> list[RunFolder]:
    return [callback for callback in trainer.callbacks if isinstance(callback, RunFolder)]  # type: ignore[attr-defined]
