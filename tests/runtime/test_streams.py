"""Processes without standard streams, and with ones that cannot be written."""

import subprocess
import sys

import pytest

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


def test_streams_that_are_closed_lead_nowhere():
    code = (
        "from neurad.runtime.streams import open_closed_streams as f; f(); import os, sys; print('x', file=sys.stderr)"
    )
    check = f"{code}; os.dup(2); sys.exit(os.open('/', 0) < 3)"
    assert subprocess.run(["sh", "-c", f'exec {sys.executable} -c "{check}" 2>&- <&-'], check=False).returncode == 0
