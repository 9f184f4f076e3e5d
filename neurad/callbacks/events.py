"""TensorBoard events, written where they arise.

TensorBoard's own writer has a thread for it, in which a full disk ends in a traceback, and which holds a queue besides.
"""

import io
import os
import socket
import time
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event  # type: ignore[import-untyped]
from tensorboard.summary.writer.record_writer import RecordWriter  # type: ignore[import-untyped]
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.writer import FileWriter

from neurad.runtime.files import append, make_folder


class EventWriter(SummaryWriter):
    """A SummaryWriter whose events are in the file when a call returns.

    Every call that adds something raises :class:`InputError` where the system refuses to write.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._files: FileWriter | None = None
        super().__init__(folder)

    def _get_file_writer(self) -> FileWriter:
        if self._files is None:
            self._files = self.file_writer = _Files(self._folder)  # type: ignore[assignment]
            self.all_writers = {self._folder: self._files}  # type: ignore[assignment]
        return self._files


class _Files(FileWriter):
    """What SummaryWriter writes to."""

    def __init__(self, folder: str) -> None:
        self.event_writer = EventFile(Path(folder))


class EventFile:
    """One file of events, with the methods that FileWriter calls."""

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}"
        number = 0
        while (folder / f"{name}.{number}").exists():
            number += 1
        self.path = folder / f"{name}.{number}"
        self.add_event(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def get_logdir(self) -> str:
        """The folder."""
        return str(self.path.parent)

    def add_event(self, event: Any) -> None:
        """Write an event, all of it or nothing."""
        record = io.BytesIO()
        RecordWriter(record).write(event.SerializeToString())
        append(self.path, record.getvalue())

    def flush(self) -> None:
        """Nothing is kept back."""

    def close(self) -> None:
        """The file is open only while it is written to."""

    def reopen(self) -> None:
        """The file is open only while it is written to."""
