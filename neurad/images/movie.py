"""Pictures one after the other: as a film (MP4, by imageio-ffmpeg) or as numbered PNG files."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np

from neurad.core.records import Bytes
from neurad.images.image_io import write_png
from neurad.runtime.extras import need, needed
from neurad.runtime.files import make_folder, replacing

Format = Literal["mp4", "png"]
"""A film, or its frames."""
_QUALITY = 8  # of imageio-ffmpeg, from 0 to 10
_FFMPEG = "imageio_ffmpeg", "video", "--movie mp4 (--movie png writes pictures)"


def check_movie(kind: str) -> None:
    """Find out before long work whether films can be written."""
    if kind == "mp4":
        need(*_FFMPEG)


def target_of(kind: str, folder: Path) -> Path:
    """What :func:`filming` writes in a folder."""
    return folder / ("path.mp4" if kind == "mp4" else "frames/0000.png")


@contextmanager
def filming(kind: str, folder: Path, fps: int) -> Iterator[Callable[[Bytes], None]]:
    """What takes frames [h, w, 3], all of one size; the film is there, whole, when the context ends without an error.

    Args:
        kind: one of :data:`Format`.
        folder: it gets ``path.mp4`` or ``frames/0000.png`` and so on.

    Raises:
        InputError: the package is missing, or the file cannot be written.
    """
    if kind == "png":
        make_folder(folder / "frames", "--out")
        numbers = count()
        yield lambda frame: write_png(folder / "frames" / f"{next(numbers):04d}.png", frame)
        return
    with needed(*_FFMPEG):
        import imageio_ffmpeg as ffmpeg
    make_folder(folder, "--out")
    with replacing(target_of(kind, folder), "--out") as part:
        writer: Any = None

        def add(frame: Bytes) -> None:
            nonlocal writer
            height, width = frame.shape[:2]
            even = np.ascontiguousarray(np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))
            if writer is None:
                writer = ffmpeg.write_frames(
                    str(part), even.shape[1::-1], fps=fps, quality=_QUALITY, macro_block_size=2,
                    output_params=["-f", "mp4", "-movflags", "+faststart"], ffmpeg_log_level="error",
                )  # fmt: skip
                writer.send(None)
            writer.send(even)

        try:
            yield add
        finally:
            if writer is not None:
                writer.close()
