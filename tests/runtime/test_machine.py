"""Threads, memory, devices and kernels: work comes back whole, and libraries are loaded as they are needed."""

import os
import platform
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from helpers.host_questions import HostQuestion, no_host_questions
from helpers.torch_threads import torch_threads

from neurad.runtime import threads
from neurad.runtime.dispatch import use_kernel


@pytest.fixture(params=[1, 3])
def count(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def test_each_keeps_the_order_whatever_takes_longest(count):
    def work(item):
        time.sleep(0.02 if item % 3 == 0 else 0.0)
        return item * item

    assert list(threads.parallel_map(work, range(20))) == [item * item for item in range(20)]
    assert torch.get_num_threads() == count


def test_each_uses_as_many_threads_as_torch_may_and_one_for_an_item(count):
    meeting, seen = threading.Barrier(count, timeout=20.0), []

    def work(item):
        meeting.wait()  # passes only where so many items are worked on at a time
        seen.append((torch.get_num_threads(), torch.is_grad_enabled()))

    with torch.enable_grad():
        list(threads.parallel_map(work, range(2 * count)))
    assert seen == [(1, False)] * (2 * count)


def test_each_draws_no_more_than_it_works_on(count):
    drawn = []

    def items():
        for k in range(50):
            drawn.append(k)
            yield k

    results = threads.parallel_map(lambda item: item, items())
    assert next(results) == 0
    assert len(drawn) <= count + 1
    results.close()


def test_what_goes_wrong_in_a_thread_is_said_and_leaves_no_thread_behind(count):
    def work(item):
        if item == 3:
            raise ValueError("item 3")
        return item

    with pytest.raises(ValueError, match="item 3"):
        list(threads.parallel_map(work, range(10)))
    assert torch.get_num_threads() == count
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("neurad-each")]


def test_what_a_part_splits_it_does_itself():
    with torch_threads(4):
        parts = threads.split(lambda low, high: (high - low, threads.split(lambda a, b: b - a, 100, 1)), 400, 1)
        assert sum(size for size, _ in parts) == 400
        assert [inner for _, inner in parts] == [[100]] * 4
        assert len(threads.split(lambda low, high: None, 400, 1)) == 4


# ---- freed arrays stay with the process


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


def faults(mode, **environment):
    variables = {k: v for k, v in os.environ.items() if not k.startswith(("MALLOC_", "GLIBC_"))} | environment
    return int(subprocess.check_output([sys.executable, "-c", PROGRAM, mode], env=variables))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="needs glibc")
def test_freed_arrays_are_used_again_unless_the_user_has_set_otherwise():
    """Arrays that a step frees are not cleared anew by the system in the next one; by itself glibc gives them back."""
    assert faults("leave") > 10_000  # 20 rounds of 12288 pages
    assert faults("keep") < 1_000
    assert faults("keep", MALLOC_TRIM_THRESHOLD_="131072") > 10_000


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


# ---- the one rule that chooses between a kernel and its reference


def test_kernels_take_plain_floats_on_the_processor_and_gradients_only_if_they_have_them():
    plain, free = torch.zeros(3), torch.zeros(3, requires_grad=True)
    assert use_kernel(True, plain, torch.zeros(2, 3))
    assert not use_kernel(False, plain)
    assert not use_kernel(True, free)
    assert use_kernel(True, free, differentiable=True)
    for other in (plain.double(), plain.bfloat16(), plain.to("meta")):
        assert not use_kernel(True, plain, other)
        assert not use_kernel(True, other, differentiable=True)


# ---- the cache of kernels notices a change of whatever they use


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


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """A folder of kernels, and a copy of the cache that they fill."""
    folder = tmp_path_factory.mktemp("kernels")
    (folder / "shared.py").write_text(SHARED)
    (folder / "user.py").write_text(USER)
    assert run(folder) == (40.0, 2.0, 0)
    shutil.copytree(folder / "cache", folder / "kept")
    return folder


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
    compiled: Path, old: str, new: str, expected: tuple[float, float], hits: int
) -> None:
    shutil.rmtree(compiled / "cache")
    shutil.copytree(compiled / "kept", compiled / "cache")
    (compiled / "shared.py").write_text(SHARED.replace(old, new))
    assert run(compiled) == (*expected, hits)


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


# ---- the guard of code for a CUDA graph sees every kind of question to the device, also where that is a CPU


X = torch.rand(5, 3)


@pytest.mark.parametrize(
    "ask",
    [
        lambda x: x.sum().item(), lambda x: bool(x.sum() > 0), lambda x: x.numpy(), lambda x: x.to("meta"),
        lambda x: x * torch.tensor(2.0), lambda x: x.nonzero(), lambda x: x[x > 0.5], lambda x: x.unique(),
        lambda x: x.clone().__setitem__(x > 0.5, X[X > 0.5]), lambda x: torch.equal(x, x),
        lambda x: torch.sparse_coo_tensor(torch.zeros(1, 5, dtype=torch.long), x, (9, 3)).coalesce(),
    ],
)  # fmt: skip
def test_a_question_to_the_device_is_refused(ask):
    with pytest.raises(HostQuestion), no_host_questions():
        ask(X)


def test_what_stays_on_the_device_is_let_through():
    with no_host_questions():
        X.clone().__setitem__(X > 0.5, 0.0)
        assert torch.where(X > 0.5, X, 0.0)[torch.arange(3)].repeat_interleave(3, 1).shape == (3, 9)


class _Asks(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        return x * 1.0

    @staticmethod
    def backward(ctx, gradient):
        return gradient * float(gradient.sum())


def test_backward_passes_are_watched_too():
    x = X.clone().requires_grad_()
    with pytest.raises(HostQuestion), no_host_questions():
        _Asks.apply(x).sum().backward()
    with pytest.raises(HostQuestion), no_host_questions():  # the gradient of a mask's rows writes by mask
        x[torch.arange(5)].square()[X > 0.5].sum().backward()
    with no_host_questions():
        x.square().sum().backward()


# ---- lightning comes without what a fit does not use, and that can be imported afterwards


CODE = """
import sys
import torch
from neurad.runtime.lean_imports import import_lightning

import_lightning()
import neurad.runs.lightning
from neurad.optim.sparse_row_adam import SparseRowAdam

p = torch.nn.Parameter(torch.ones(3))
optimizer = SparseRowAdam([p], lr=0.1)
p.sum().backward()
optimizer.step()
optimizer.zero_grad()
optimizer.load_state_dict(optimizer.state_dict())
assert p.grad is None
assert abs(float(p[0]) - 0.9) < 1e-6
names = "torch._dynamo", "scipy.signal", "matplotlib", "matplotlib.pyplot"
assert not any(name in sys.modules for name in names)

import matplotlib.colors
import scipy.signal

assert matplotlib.colors.Colormap("any").name == "any"
assert len(scipy.signal.get_window("hann", 8)) == 8
"""


def test_what_lightning_imports_in_vain_is_left_out_and_can_still_be_imported():
    found = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=120)
    assert found.returncode == 0, found.stderr
