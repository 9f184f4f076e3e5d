"""``last.ckpt`` and ``previous.ckpt``: written at intervals, at the end and when a run is stopped, always whole."""

import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
import torch.distributed as dist
from lightning.fabric.plugins import CheckpointIO
from lightning.pytorch.callbacks import Checkpoint

from neurad.callbacks.run_folder import run_folder
from neurad.checkpoints.file import read_checkpoint, write_checkpoint
from neurad.checkpoints.find import LAST, PREVIOUS
from neurad.core.errors import InputError
from neurad.runtime.files import make_folder
from neurad.runtime.progress import say
from neurad.runtime.streams import silence_gone_terminals
from neurad.training.guard import NotFinite

EVERY_SECONDS = 60.0
"""Wall-clock seconds between two checkpoints."""


class CheckpointFiles(CheckpointIO):
    """Checkpoints of :mod:`neurad.checkpoints.file` for Lightning's trainer.

    Of ``storage_options``, 'previous' is the path that keeps the checkpoint which is replaced.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """See :func:`write_checkpoint`."""
        make_folder(Path(path).parent)
        write_checkpoint(checkpoint, Path(path), (storage_options or {}).get("previous"))

    def load_checkpoint(self, path: Any, map_location: Any = None, weights_only: bool | None = None) -> dict[str, Any]:
        """See :func:`read_checkpoint`; only plain types and tensors are ever read."""
        return read_checkpoint(Path(path), f"--ckpt_path {path}", stay_on_disk=False)

    def remove_checkpoint(self, path: Any) -> None:
        """Remove a file."""
        Path(path).unlink(missing_ok=True)


class LastCheckpoint(Checkpoint):
    """Keeps ``checkpoints/last.ckpt`` in the run folder, and the one before it as ``checkpoints/previous.ckpt``.

    A checkpoint is taken between iterations only, since one in the middle (one optimizer stepped, another not, or a
    stage half done) could not be continued exactly. Ctrl-C therefore lets the iteration finish; a second one does not
    wait. A terminal that goes (SIGHUP) ends a fit as SIGTERM does, which lets the iteration finish, too. Of several
    processes all stop after the same iteration, whichever got Ctrl-C; where one fails alone nothing is saved, since
    saving would have to wait for the others.
    """

    def __init__(self) -> None:
        super().__init__()
        self._inside = False
        self._stop_requested = False
        self._agreed = False
        self._written = 0.0
        self._handlers: dict[int, Any] = {}
        self._last_is_good = True
        self._saved = -1
        self._optimizers: int | None = None

    def path(self, trainer: pl.Trainer) -> Path | None:
        """The checkpoint's path, or None if the run keeps no files."""
        folder = run_folder(trainer)
        return folder / LAST if folder else None

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Let the trainer write and read checkpoints with checksums."""
        trainer.strategy.checkpoint_io = CheckpointFiles()

    def on_load_checkpoint(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Refuse loops that Lightning would leave as they are, or stumble over in the middle of the run."""
        self._optimizers = len(checkpoint["optimizer_states"])
        if trainer.training and not _covers(checkpoint["loops"].get("fit_loop"), trainer.fit_loop.state_dict()):
            raise InputError(f"--ckpt_path {trainer.ckpt_path}: its loops are not those of a fit")

    def on_fit_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Refuse a checkpoint with too few or too many optimizers: Lightning would take those that there are."""
        if self._optimizers not in (None, len(trainer.optimizers)):
            raise InputError(
                f"--ckpt_path {trainer.ckpt_path}: it has the state of {self._optimizers} optimizers, but these "
                f"settings need {len(trainer.optimizers)}"
            )

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock, and handle Ctrl-C and a terminal that goes, unless whoever started the process wants them
        ignored (a background job, nohup).
        """
        path = self.path(trainer)
        began = trainer.ckpt_path
        # A run that continues from the one before has a damaged last one, which must not take the place of the good.
        previous = None if path is None else path.with_name(PREVIOUS.name).resolve()
        self._last_is_good = previous is None or began is None or Path(began).resolve() != previous
        self._written = time.monotonic()
        self._stop_requested = self._agreed = False
        for name, handler in (("SIGINT", self._on_interrupt), ("SIGHUP", _on_hangup)):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is None or signal.getsignal(number) is signal.SIG_IGN:
                continue
            if threading.current_thread() is threading.main_thread():
                self._handlers[number] = signal.signal(number, handler)

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """From here to the end of the iteration the weights may belong to no iteration."""
        self._inside = True

    def on_train_batch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: Any) -> None:
        """Save if it is time, and stop after Ctrl-C."""
        self._inside = False
        late = trainer.is_global_zero and time.monotonic() - self._written >= EVERY_SECONDS
        stop, save = _anywhere(trainer, self._stop_requested, late)
        if stop:
            self._agreed = True
            raise KeyboardInterrupt
        if save:
            self.save(trainer)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Save the last iteration; the evaluation of the same iteration has just been written."""
        self.save(trainer)

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Save unless an iteration was in progress."""
        # Nothing was trained if the exception came from setting up, and there is no folder to write into then.
        if not trainer.training or self._written == 0.0:
            return
        path = self.path(trainer)
        if isinstance(exception, NotFinite):  # its weights are kept apart: this file stays one that can be used
            return
        alone = trainer.world_size > 1 and not self._agreed
        if not self._inside and not alone:
            try:
                self.save(trainer)
            except InputError as error:  # the sentence that ends the run is that of the first failure
                if str(error) != str(exception):
                    say(f"no further checkpoint: {error}")
        elif path is not None and path.is_file() and trainer.is_global_zero:
            say("stopped in the middle of an iteration, the last checkpoint stays as it is")
        interrupted = isinstance(exception, KeyboardInterrupt) and trainer.is_global_zero
        if interrupted and path is not None and path.is_file():
            say(f"interrupted; `--ckpt_path last` continues from {path}")
        if self._agreed:  # the others stop by themselves; Lightning would kill them, and this process for their end
            getattr(trainer.strategy.launcher, "procs", []).clear()

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Restore the handlers."""
        while self._handlers:
            signal.signal(*self._handlers.popitem())

    def save(self, trainer: pl.Trainer) -> None:
        """Write the checkpoint; the last good one stays as it is, or goes on as the previous one."""
        path = self.path(trainer)
        if path is None:
            return
        keep = self._last_is_good and trainer.global_step != self._saved  # twice the same would be no second one
        trainer.save_checkpoint(path, storage_options={"previous": path.with_name(PREVIOUS.name) if keep else None})
        self._last_is_good, self._saved = True, trainer.global_step
        trainer.strategy.barrier()  # a process that ends before the file is in its place would take this one with it
        self._written = time.monotonic()

    def _on_interrupt(self, signum: int, frame: Any) -> None:
        if self._stop_requested:
            raise KeyboardInterrupt
        self._stop_requested = True
        print("\nneurad: stopping after this iteration (Ctrl-C again: at once)", file=sys.stderr)


def _on_hangup(signum: int, frame: Any) -> None:
    """End the fit as SIGTERM does, without a word to the terminal that is gone."""
    silence_gone_terminals()
    signal.raise_signal(signal.SIGTERM)


def _covers(value: Any, form: Any) -> bool:
    """Whether nested mappings have all keys of ``form``, with whole numbers where it has such."""
    if isinstance(form, dict):
        return isinstance(value, dict) and all(key in value and _covers(value[key], form[key]) for key in form)
    return not isinstance(form, int) or (isinstance(value, int) and value >= 0)


def _anywhere(trainer: pl.Trainer, *requests: bool) -> list[bool]:
    """Which requests any process has, the same answer in all: one that stopped alone would leave the others waiting."""
    if trainer.world_size == 1:
        return list(requests)
    flags = torch.tensor(requests, dtype=torch.int32, device=trainer.strategy.root_device)
    dist.all_reduce(flags, op=dist.ReduceOp.MAX)
    return flags.bool().tolist()
