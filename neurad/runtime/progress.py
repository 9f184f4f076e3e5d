"""What the program is doing, on one line of the terminal: named phases, each with a bar, from the first second on.

There is one line for the whole process. Whatever takes its time names itself with :func:`phase`, wherever it stands;
where standard errors is no terminal, that costs nothing and prints nothing.
"""

import os
import shutil
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO, TypeVar

from neurad.core.durations import clock

T = TypeVar("T")

COLUMNS = 80
"""Widest line; the last column stays free, since some terminals go on to the next line when it is written."""
TICK = 0.25
"""Seconds between two looks of the line at how far things are."""
_MIN_ESTIMATE_SECONDS = 2.0
"""Seconds that a phase has to take before its remaining time is estimated."""
_NAME = 11
"""Columns of a phase's name."""
_BAR = (4, 40)
"""Least and most columns of a bar."""
_MANY = 10_000
"""Steps from which on a percentage is shown in place of their number."""


def say(*sentences: str) -> None:
    """Print what the user is to know beside the result, a line each on standard errors."""
    for sentence in sentences:
        print(f"neurad: {sentence}", file=sys.stderr)


class Phase:
    """Something that takes its time.

    Args:
        total: steps that it has; None where that is not known.
        seconds: that it is to take, where there are no steps to count.
        covers: whether phases inside are not shown.
    """

    def __init__(self, name: str, total: int | None = None, seconds: float | None = None, covers: bool = False) -> None:
        self.seconds, self.covers = seconds, covers
        self.stage(name, total)

    def step(self, count: int = 1, detail: str = "") -> None:
        """So many steps are done; ``detail`` says what comes next."""
        self.done += count
        self.part, self.detail = 0.0, detail

    def stage(self, name: str, total: int | None) -> None:
        """The next stage of it begins, which has so many steps."""
        self.name, self.total, self.done, self.part, self.detail = name, total, 0, 0.0, ""
        self.begin = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since it began."""
        return time.monotonic() - self.begin

    @property
    def fraction(self) -> float | None:
        """How much of it is done, in [0, 1]; None where nobody knows."""
        if self.total:
            return min((self.done + self.part) / self.total, 1.0)
        return None if self.seconds is None else min(self.elapsed / max(self.seconds, 1e-9), 1.0)

    def text(self, width: int, full: str = "#") -> str:
        """The line, at most ``width`` columns wide; ``full`` fills the bar."""
        fraction, elapsed = self.fraction, self.elapsed
        parts = []
        if self.total:
            many = self.total >= _MANY
            parts.append(f"{100 * (fraction or 0):.0f} %" if many else f"{min(self.done, self.total)} of {self.total}")
        parts += [self.detail] if self.detail else []
        if fraction and elapsed > _MIN_ESTIMATE_SECONDS:
            parts.append(f"{clock(elapsed * (1.0 - fraction) / fraction)} left")
        else:
            parts.append(clock(elapsed))
        return with_bar(f"{self.name:<{_NAME}}", fraction, ", ".join(parts), width, full, elapsed)


def with_bar(head: str, fraction: float | None, tail: str, width: int, full: str = "#", seconds: float = 0.0) -> str:
    """A line of ``width`` columns: a bar fills what two texts leave of it, the second one cut where there is no room.

    Args:
        fraction: of the bar that is full, in [0, 1]; None lets a piece of it run to and fro with the ``seconds``.
        full: fills the bar.
    """
    tail = tail[: max(width - len(head) - 4 - _BAR[0], 0)]
    room = min(width - len(head) - len(tail) - 4, _BAR[1])
    if room < 3:
        return f"{head} {tail}"[:width].ljust(width)
    if fraction is None:
        span = room - 3
        place = int(seconds / TICK) % max(2 * span, 1)
        bar = " " * min(place, 2 * span - place) + full * 3
    else:
        bar = full * int(min(max(fraction, 0.0), 1.0) * room)
    return f"{head} |{bar:<{room}}| {tail}".ljust(width)


class _Line:
    """The last line of the terminal, painted over and over."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.stream: TextIO | None = None
        self.phases: list[Phase] = []
        self.stage: Phase | None = None
        self.text = ""
        self._painted = 0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._partial = False

    def open(self) -> None:
        """Begin to paint, if standard errors is a terminal and this is the first of several processes."""
        is_first = all(os.environ.get(name, "0") == "0" for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"))
        if self.stream is not None or not _is_terminal(sys.stderr) or not is_first:
            return
        self.stream = sys.stderr
        # Whatever else is printed must not stand in the middle of the line.
        sys.stderr = _Around(sys.stderr, self)
        if _is_terminal(sys.stdout):
            sys.stdout = _Around(sys.stdout, self)
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name="progress", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the terminal as if nothing had been painted."""
        if self._thread is None:
            return
        self._stop.set()
        self._thread.join()
        with self.lock:
            self.clear()
            if isinstance(sys.stdout, _Around):
                sys.stdout = sys.stdout.stream
            if isinstance(sys.stderr, _Around):
                sys.stderr = sys.stderr.stream
            self.stream = self._thread = self.stage = None
            self.phases, self.text = [], ""

    def _run(self) -> None:
        while not self._stop.wait(TICK):
            self.paint()

    def current(self) -> str:
        """What is to be seen now."""
        shown = next((p for p in self.phases if p.covers), self.phases[-1] if self.phases else self.stage)
        return self.text if shown is None else shown.text(width(), full())

    def paint(self) -> None:
        """Show how far things are."""
        with self.lock:
            if self.stream is not None and not self._partial:
                self._put(self.current())

    def clear(self) -> None:
        """Take the line away, until it is painted again."""
        with self.lock:
            self._put("")

    def _put(self, text: str) -> None:
        """Write a text in place of the one that is there."""
        if self.stream is None or not (text.strip() or self._painted):
            return
        try:
            self.stream.write(f"\r{text.ljust(self._painted)}" if text.strip() else f"\r{' ' * self._painted}\r")
            self.stream.flush()
        except (OSError, ValueError):  # the terminal is gone
            self.stream = None
        self._painted = len(text.rstrip())

    def print(self, stream: TextIO, text: str) -> int:
        """Print something else, above the line."""
        with self.lock:
            self.clear()
            written = stream.write(text)
            if text:
                self._partial = not text.endswith(("\n", "\r"))
            return written


class _Around:
    """A standard stream whose text goes above the line."""

    def __init__(self, stream: TextIO, line: _Line) -> None:
        self.stream, self._line = stream, line

    def write(self, text: str) -> int:
        return self._line.print(self.stream, text)

    def writelines(self, lines: Any) -> None:
        for text in lines:
            self.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


_line = _Line()


@contextmanager
def opened(name: str) -> Iterator[None]:
    """Show the line as long as this block lasts."""
    try:
        _line.open()
        stage(name)
        yield
    finally:
        _line.close()


def off() -> None:
    """Show nothing, up to the end of the process' work: the user wants no progress."""
    _line.close()


def on_terminal() -> bool:
    """Whether anybody sees the line."""
    return _line.stream is not None


def stage(name: str | None) -> None:
    """What is shown while no phase is: work that nothing counts, or nothing."""
    _line.stage = None if name is None else Phase(name)
    _line.paint()


@contextmanager
def phase(name: str, total: int | None = None, seconds: float | None = None, covers: bool = False) -> Iterator[Phase]:
    """Name what this block does, as :class:`Phase` takes it. Of blocks in each other the innermost is shown."""
    entered = Phase(name, total, seconds, covers)
    with _line.lock:
        _line.phases.append(entered)
    try:
        yield entered
    finally:
        with _line.lock:
            if entered in _line.phases:
                _line.phases.remove(entered)


def counted(items: Iterable[T], name: str, total: int, detail: str = "") -> Iterator[T]:
    """The items, one step of a phase each."""
    with phase(name, total) as entered:
        entered.detail = detail
        for item in items:
            yield item
            entered.step(detail=detail)


def partly(fraction: float) -> None:
    """How much of its present step the innermost phase that counts steps has done, in [0, 1]."""
    for entered in reversed(_line.phases):
        if entered.total:
            entered.part = min(max(fraction, 0.0), 1.0)
            return


def show(text: str) -> None:
    """A text of one's own instead of a stage, until the next one."""
    _line.stage, _line.text = None, text
    _line.paint()


def finish(text: str) -> None:
    """Leave a last text standing, and nothing after it."""
    with _line.lock:
        _line.clear()
        _line.stage, _line.text = None, ""
        if _line.stream is not None and text.strip():
            _line.print(_line.stream, f"{text.rstrip()}\n")


def width() -> int:
    """Columns of the line: those of the terminal but one, at most :data:`COLUMNS` - 1."""
    return max(min(shutil.get_terminal_size((COLUMNS, 24)).columns, COLUMNS) - 1, 20)


def full() -> str:
    """What fills bars: a block where the terminal has one."""
    encoding = getattr(_line.stream, "encoding", None) or "ascii"
    try:
        "█".encode(encoding)
    except (UnicodeError, LookupError):
        return "#"
    return "█"


def _is_terminal(stream: Any) -> bool:
    try:
        return bool(stream.isatty())
    except (AttributeError, ValueError):
        return False
