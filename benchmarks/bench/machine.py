"""The machine at hand, its memory and name, and tables on the screen."""

import os
import platform
from collections.abc import Sequence
from pathlib import Path

import torch

from neurad.core.errors import InputError
from neurad.runtime.files import make_folder
from neurad.runtime.machine import processor
from neurad.runtime.tables import Record, align, write_csv

CPU = torch.device("cpu")


def wait(device: torch.device) -> None:
    """Wait until the device has finished its queue."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def peak_bytes(device: torch.device = CPU) -> int:
    """Largest memory in use so far: of the process on a CPU, of torch's allocations on a GPU; 0 where it is unknown."""
    if device.type == "cuda":
        return int(torch.cuda.max_memory_allocated(device))
    try:
        import resource
    except ImportError:  # Windows
        return 0
    return int(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) * (1 if platform.system() == "Darwin" else 1024)


def describe(device: torch.device = CPU) -> str:
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


def report(rows: Sequence[Record], title: str, out: str | None) -> None:
    """Print a table, numbers with three digits and None as a blank, and, if there is an ``out``, write it as CSV.

    Raises:
        InputError: the file cannot be written.
    """
    print(title)
    names = list(rows[0]) if rows else []
    if rows:
        text = [i for i, name in enumerate(names) if isinstance(rows[0][name], str)]
        print("\n".join(align([names, *([_cell(row.get(name)) for name in names] for row in rows)], text)))
    if out is None:
        return
    make_folder(Path(out).parent, "--out")
    write_csv(Path(out), names, rows)
    print(f"\nneurad: {out}")


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)
