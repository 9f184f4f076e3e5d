"""Freed arrays stay with the process."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, resource, sys
import numpy as np
from neurad.runtime.allocator import keep_freed_memory
if sys.argv[1] == "keep":
    keep_freed_memory()
ctypes.CDLL(None).prctl(41, 1, 0, 0, 0)  # PR_SET_THP_DISABLE: every page of 4 KiB is a fault of its own
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def cycle():
    arrays = [np.ones(1 << 20, np.float64) for _ in range(6)]  # 8 MiB each, all alive, then all freed
cycle()
before = faults()
for _ in range(20):
    cycle()
print(faults() - before)
"""


def _faults(mode: str, **environment: str) -> int:
    variables = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_"))}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, mode],
        env={**variables, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return int(done.stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_freed_arrays_are_used_again() -> None:
    """Arrays that a step frees are not cleared anew by the system in the next one; by itself glibc gives them back."""
    assert _faults("leave") > 10_000  # 20 rounds of 12288 pages
    assert _faults("keep") < 1_000


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_what_the_user_has_set_stays() -> None:
    """Variables of glibc's allocator win."""
    assert _faults("keep", MALLOC_TRIM_THRESHOLD_="131072") > 10_000


def test_what_is_imported_for_a_fit_is_kept_and_garbage_is_collected_again_afterwards():
    program = """
import gc
from neurad.runtime.allocator import imports_kept
with imports_kept():
    assert not gc.isenabled()
    import json
assert gc.isenabled() and gc.get_freeze_count() > 1000
gc.disable()
with imports_kept():
    pass
assert not gc.isenabled()  # the user's own choice stays
"""
    subprocess.run([sys.executable, "-c", program], check=True)
