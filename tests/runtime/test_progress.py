"""The line on the terminal: its width, what it says, and what it does to other output."""

import io
import os
import subprocess
import sys
import time

import pytest

from neurad.runtime import progress
from neurad.runtime.progress import COLUMNS, Phase, with_bar


class Terminal(io.StringIO):
    """A terminal of 80 columns that keeps what a person would see."""

    def isatty(self):
        return True

    def lines(self):
        """Lines on the screen: what ``\\r`` lets later text write over."""
        shown = []
        for line in self.getvalue().split("\n"):
            cells = []
            for part in line.split("\r"):
                cells[: len(part)] = part
            shown.append("".join(cells).rstrip())
        return shown


def terminal_of(monkeypatch):
    """Standard errors and output as one terminal, without the environment of a launcher. Called in the test itself:
    pytest sets the streams anew between a fixture and its test.
    """
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setattr(sys, "stdout", screen)
    monkeypatch.setattr(progress, "TICK", 1000.0)  # nothing is painted but by the test
    for name in ("RANK", "LOCAL_RANK", "SLURM_PROCID"):
        monkeypatch.delenv(name, raising=False)
    return screen


@pytest.mark.parametrize("width", [20, 40, 79])
@pytest.mark.parametrize("tail", ["", "3 of 10, 0:04 left", "a very long account of what is going on " * 5])
@pytest.mark.parametrize("fraction", [None, 0.0, 0.37, 1.0, 1.7])
def test_a_line_has_its_width(width, tail, fraction):
    text = with_bar("evaluating ", fraction, tail, width)
    assert len(text) == width
    if width == 79 and fraction is not None:
        bar = text.split("|")[1]
        assert bar.count("#") == int(min(fraction, 1.0) * len(bar))


def test_a_phase_counts_and_estimates(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    phase = Phase("reading", 4)
    assert "0 of 4, 0:00" in phase.text(79)
    phase.step(detail="photographs")
    now[0] += 10
    assert "1 of 4, photographs, 0:30 left" in phase.text(79)
    phase.part = 0.5
    assert phase.fraction == 1.5 / 4
    phase.step(3)
    assert "4 of 4, 0:00 left" in phase.text(79)
    phase.step(9)
    assert phase.fraction == 1.0
    many = Phase("textures", 1_000_000)
    many.step(250_000)
    assert "25 %" in many.text(79)
    timed = Phase("ours", seconds=60.0)
    for seconds, left in ((45.0, "0:15 left"), (30.0, "0:00 left")):
        now[0] += seconds
        assert left in timed.text(79)


def test_phases_show_the_innermost_unless_one_covers(monkeypatch):
    terminal = terminal_of(monkeypatch)
    with progress.opened("starting"):
        assert terminal.lines()[-1].startswith("starting")
        with progress.phase("evaluating", 3):
            with progress.phase("compiling") as inner:
                inner.detail = "walk"
                progress._line.paint()
                assert terminal.lines()[-1].startswith("compiling")
                assert "walk" in terminal.lines()[-1]
            progress.partly(0.5)
            progress._line.paint()
            assert terminal.lines()[-1].startswith("evaluating")
            assert progress._line.phases[-1].fraction == 0.5 / 3
        with progress.phase("stress", 2, covers=True), progress.phase("reading"):
            progress._line.paint()
            assert terminal.lines()[-1].startswith("stress")
        assert all(len(line) < COLUMNS for line in terminal.lines())
    assert terminal.lines() == [""]


def test_other_output_stands_above_the_line(monkeypatch):
    terminal = terminal_of(monkeypatch)
    with progress.opened("starting"):
        print("a table")
        progress.show("fit  50% |####    | step 1")
        print("neurad: a warning", file=sys.stderr)
        progress._line.paint()
        progress.finish("fit 100% |########| step 2")
        print("run folder")
    assert terminal.lines() == ["a table", "neurad: a warning", "fit 100% |########| step 2", "run folder", ""]
    assert sys.stderr is terminal
    assert sys.stdout is terminal


def test_text_without_an_end_is_not_written_over(monkeypatch):
    terminal = terminal_of(monkeypatch)
    with progress.opened("starting"):
        print("so far", end="")
        progress._line.paint()
        print(" and on")
    assert terminal.lines() == ["so far and on", ""]


def test_nothing_is_painted_where_nobody_looks_or_by_other_processes(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    with progress.opened("starting"), progress.phase("reading", 3) as phase:
        phase.step()
        progress.show("text")
        progress.finish("text")
        assert not progress.on_terminal()
    assert stream.getvalue() == ""

    terminal = terminal_of(monkeypatch)
    monkeypatch.setenv("LOCAL_RANK", "1")
    with progress.opened("starting"):
        assert not progress.on_terminal()
    assert terminal.getvalue() == ""


CHILD = """
import time
from contextlib import suppress
from neurad.runtime import progress
with progress.opened("starting"):
    with suppress(ValueError), progress.phase("failing"):
        raise ValueError
    time.sleep(0.6)
    for _ in progress.counted("ab", "tracing", 2, "letters"):
        time.sleep(0.6)
    print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are Unix's")
def test_a_real_terminal_shows_a_sign_of_life_and_is_left_clean():
    import pty

    main, child = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD], stdout=child, stderr=child, env={**os.environ, "RANK": "0"}
    )
    os.close(child)
    received = b""
    try:
        while part := os.read(main, 65536):
            received += part
    except OSError:  # Linux ends a terminal so
        pass
    os.close(main)
    assert process.wait() == 0
    screen = Terminal()
    screen.write(received.decode().replace("\r\n", "\n"))
    shown = screen.getvalue()
    assert all(words in shown for words in ("starting", "tracing", "1 of 2, letters"))
    assert "failing" not in shown  # an error inside leaves no phase
    assert screen.lines() == ["done", ""]


# ---- processes without standard streams, and with ones that cannot be written


PROGRAM = f"exec {sys.executable} -m neurad --version"


@pytest.mark.parametrize(
    ("redirected", "code", "out", "error"),
    [
        ("2>&-", 0, "neurad ", ""),
        ("<&- >&- 2>&-", 0, "", ""),
        (">/dev/full", 2, "", "neurad: error: standard output: no space is left on its disk"),
        (">/dev/full 2>/dev/full", 2, "", ""),
    ],
)
def test_a_process_without_standard_streams(redirected, code, out, error):
    ended = subprocess.run(["sh", "-c", f"{PROGRAM} {redirected}"], capture_output=True, text=True, check=False)
    assert ended.returncode == code
    assert ended.stdout.startswith(out)
    assert ended.stderr.startswith(error)
    assert bool(ended.stderr) == bool(error)
