"""What the machine at hand can do, measured, and tables that compare a stage with it."""

import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.protocols import Tracer
from neurad.core.records import Rays
from neurad.runtime.files import make_folder
from neurad.runtime.machine import processor
from neurad.runtime.tables import Record, align, write_csv

COPY = 1 << 26
"""Bytes of the array that is copied to measure bandwidth: more than caches hold."""
MATRIX = 1024
"""Side of the matrices whose product measures the matrix rate."""
LARGE = 1 << 17
"""Rays in a batch that measures a tracer."""
SECONDS, MIN_CALLS = 0.3, 3
"""How long a rate is measured, and by how many calls at least."""


def wait(device: torch.device) -> None:
    """Wait until the device has finished its queue."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def fastest(work: Callable[[], object], device: torch.device) -> float:
    """Seconds of the fastest call of ``work``, after one that does not count."""
    work()
    wait(device)
    found: list[float] = []
    end = time.perf_counter() + SECONDS
    while len(found) < MIN_CALLS or (time.perf_counter() < end and len(found) < 1000):
        begin = time.perf_counter()
        work()
        wait(device)
        found.append(time.perf_counter() - begin)
    return min(found)


def bandwidth(device: torch.device) -> float:
    """Bytes read and written per second by the copy of a large array."""
    source = torch.zeros(COPY // 4, device=device)
    target = torch.ones_like(source)
    return 2 * COPY / fastest(lambda: target.copy_(source), device)


def matrix_rate(device: torch.device) -> float:
    """Floating-point operations per second of a large float32 product."""
    a = torch.rand(MATRIX, MATRIX, device=device)
    out = torch.empty_like(a)
    return 2 * MATRIX**3 / fastest(lambda: torch.mm(a, a, out=out), device)


def ray_rates(tracer: Tracer, closest: Rays, shadow: Rays | None, t_max: Tensor | None) -> tuple[float, float]:
    """Rays per second of closest-hit and of occlusion queries, for rays of this kind in one large batch.

    The second is that of the first where there are no shadow rays.
    """
    device = closest.o.device
    index = torch.arange(LARGE, device=device)
    many = closest[index % len(closest)]
    rate = LARGE / fastest(lambda: tracer.closest(many), device)
    if shadow is None or t_max is None or len(shadow) == 0:
        return rate, rate
    blocked, far = shadow[index % len(shadow)], t_max[index % len(shadow)]
    return rate, LARGE / fastest(lambda: tracer.occluded(blocked, far), device)


def peak_bytes(device: torch.device) -> int:
    """Largest memory in use so far: of the process on a CPU, of torch's allocations on a GPU; 0 where it is unknown."""
    if device.type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if platform.system() == "Darwin" else 1024)


def describe(device: torch.device) -> str:
    """Name of the device, and cores in use."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"{processor()}, {torch.get_num_threads()} of {os.cpu_count()} cores"


def pick_device(name: str) -> torch.device:
    """The device called ``name``; 'auto' is a GPU where there is one.

    Raises:
        InputError: there is no such device.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name.startswith("cuda") and not torch.cuda.is_available():
        raise InputError(f"--device {name}: torch sees no GPU here")
    try:
        return torch.device(name)
    except RuntimeError as error:
        raise InputError(f"--device {name}: there is no such device") from error


Row = Record


def show(rows: Sequence[Row], title: str) -> str:
    """Rows as an aligned table; numbers with three digits, None as a blank."""
    if not rows:
        return title
    names = list(rows[0])
    text = [i for i, name in enumerate(names) if isinstance(rows[0][name], str)]
    return "\n".join([title, *align([names, *([_cell(row.get(name)) for name in names] for row in rows)], text)])


def report(rows: Sequence[Row], title: str, out: str | None) -> None:
    """Print a table and, if there is an ``out``, write it as CSV.

    Raises:
        InputError: the file cannot be written.
    """
    print(show(rows, title))
    if out is None:
        return
    make_folder(Path(out).parent, "--out")
    write_csv(Path(out), list(rows[0]) if rows else [], rows)
    print(f"\nneurad: {out}")


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)
