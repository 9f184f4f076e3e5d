"""The cache of kernels notices a change of whatever they use."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

SHARED = """
from neurad.runtime.jit import inlined, kernel

SCALE = 2.0

@inlined
def inner(x):
    return x + 1.0

@kernel
def called(x):
    return 10.0 * x
"""
USER = """
import sys
from neurad.runtime.jit import kernel
import shared
from shared import SCALE, called, inner

@kernel
def total(x):
    return called(inner(x)) * SCALE

@kernel
def by_module(x):
    return shared.inner(x)

value = total(1.0), by_module(1.0)
hits = sum(sum(f.stats.cache_hits.values()) for f in (total, by_module))
print(value[0], value[1], hits)
"""


def run(folder: Path) -> tuple[float, float, int]:
    """Values of the kernels in a fresh interpreter, and how many of them came from the cache."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        [sys.executable, folder / "user.py"], env=environment, capture_output=True, text=True, check=True
    )
    total, inner, hits = done.stdout.split()
    return float(total), float(inner), int(hits)


@pytest.mark.parametrize(
    ("old", "new", "expected", "hits"),
    [
        ("x + 1.0", "x + 2.0", (60.0, 3.0), 0),  # compiled into both
        ("10.0 * x", "20.0 * x", (80.0, 2.0), 1),  # called by one
        ("SCALE = 2.0", "SCALE = 3.0", (60.0, 2.0), 1),  # a constant of one
        ("SCALE = 2.0", "SCALE = 2.0  # twice", (40.0, 2.0), 2),  # nothing that any of them uses
    ],
)
def test_a_change_in_a_shared_file_compiles_its_users_anew(
    tmp_path: Path, old: str, new: str, expected: tuple[float, float], hits: int
) -> None:
    shared = tmp_path / "shared.py"
    shared.write_text(SHARED)
    (tmp_path / "user.py").write_text(USER)
    assert run(tmp_path) == (40.0, 2.0, 0)
    shared.write_text(SHARED.replace(old, new))
    assert run(tmp_path) == (*expected, hits)


RECORDS = """
from typing import NamedTuple
import numpy as np
from neurad.runtime.jit import inlined

class Pair(NamedTuple):
    first: np.ndarray
    second: np.ndarray
"""
READER = """
from __future__ import annotations
import numpy as np
from neurad.runtime.jit import kernel
from records import Pair

@kernel
def first(pair: Pair):
    return pair.first[0]

print(first(Pair(np.array([1.0]), np.array([2.0]))), sum(first.stats.cache_hits.values()), 0)
"""


def test_fields_of_a_record_that_change_places_compile_its_users_anew(tmp_path: Path) -> None:
    records = tmp_path / "records.py"
    records.write_text(RECORDS)
    (tmp_path / "user.py").write_text(READER)
    assert run(tmp_path) == (1.0, 0.0, 0)
    assert run(tmp_path) == (1.0, 1.0, 0)  # from the cache
    swapped = RECORDS.replace("first:", "other:").replace("second:", "first:").replace("other:", "second:")
    records.write_text(swapped)
    assert run(tmp_path) == (2.0, 0.0, 0)
