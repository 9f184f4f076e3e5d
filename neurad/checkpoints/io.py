"""How Lightning writes and reads checkpoints here."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.fabric.plugins import CheckpointIO

from neurad.checkpoints.file import read_checkpoint, write_checkpoint
from neurad.runtime.files import make_folder


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
