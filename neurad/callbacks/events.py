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

from neurad.runtime.files import append, make_folder


class EventFile:
    """One file of events, open only while it is written to; an event is in it as a whole or not at all.

    Raises:
        InputError: the system refuses to write.
    """

    def __init__(self, folder: Path) -> None:
        make_folder(folder)
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}"
        number = 0
        while (folder / f"{name}.{number}").exists():
            number += 1
        self.path = folder / f"{name}.{number}"
        self._append(Event(wall_time=time.time(), file_version="brain.Event:2"))

    def add(self, summary: Any, step: int = 0) -> None:
        """Write a summary, TensorBoard's protocol buffer."""
        self._append(Event(wall_time=time.time(), step=step, summary=summary))

    def _append(self, event: Any) -> None:
        record = io.BytesIO()
        RecordWriter(record).write(event.SerializeToString())
        append(self.path, record.getvalue())
