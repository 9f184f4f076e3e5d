"""Compiles the kernels of a first step in a process of its own, while the fit imports, reads and traces.

With an empty cache of kernels they are two thirds of a start, and numba compiles one at a time in a process. This one
begins with what takes long and is asked for late, while the fit compiles what it comes to first; each takes from the
cache what the other has left there. Nothing waits for it: what it does not do, the fit does.
"""

import os
import subprocess
from pathlib import Path
from typing import Any

from neurad.runs.child import NEURAD
from neurad.runtime.allocator import uncollected
from neurad.runtime.machine import usable_cores

_PACKAGE = Path(__file__).resolve().parent.parent
_LAST = _PACKAGE / "fields" / "hash_grid_kernels.py", "is_ascending"
"""File and name of one of the last kernels that a first start compiles."""
_GPUS = Path("/proc/driver/nvidia/gpus")
_TYPES = {"b": "boolean", "i": "int64", "f": "float32", "d": "float64", "u": "uint32", "q": "uint64"}

_process: subprocess.Popen[bytes] | None = None


def start() -> None:
    """Begin, where the cache has no kernels and a core is left for it; a GPU has kernels of its own."""
    global _process
    if usable_cores() > 1 and not _GPUS.is_dir() and not _is_compiled(*_LAST):
        silent = subprocess.DEVNULL
        _process = subprocess.Popen([*NEURAD[:-1], __spec__.name], stdin=silent, stdout=silent, stderr=silent)


def _is_compiled(source: Path, name: str) -> bool:
    """Whether the cache has a kernel, compiled since its file was written; where it cannot lie in one of the two places
    that are looked at, True.
    """
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        found = Path(given).glob(f"{source.parent.name}_*/{source.stem}.{name}-*.nbi")
    elif os.access(source.parent, os.W_OK):
        found = source.parent.glob(f"__pycache__/{source.stem}.{name}-*.nbi")
    else:
        return True
    written = source.stat().st_mtime
    return any(index.stat().st_mtime >= written for index in found)


def kernels() -> list[tuple[Any, str]]:
    """Kernels of the first step in a room of principled surfaces in the order in which they are compiled, and what is
    given to each: a letter of a type, followed by the number of dimensions if it is an array; a record is its fields
    joined by ``+``.

    First come those of fields and losses, the longest before the others, then what a bounce needs, the last before the
    first: a fit has compiled most of that by then.
    """
    from neurad.bsdf.principled_kernels import blend_lambert, direction, lobes_pdf, mean_lobes
    from neurad.emitters.area_kernels import emitted
    from neurad.fields.hash_grid_kernels import adam_rows, encode, is_ascending, table_gradient, unit_cube
    from neurad.fields.mlp_kernels import backward, forward
    from neurad.integrators.guide_kernels import add_pdf, bin_samples, record, rows, warp
    from neurad.integrators.stratified import stratified_kernel
    from neurad.integrators.vertex_principled_kernels import (
        resolve_hits_principled,
        sample_emitter,
        spawn_rays_principled,
        vjp,
    )
    from neurad.losses.leave_one_out_kernels import leave_one_out
    from neurad.scene.geometry_kernels import interact, put_known

    vertices, local, shadow = "f2+f2+f2+f2+i1+b1", "f2+f2+f2+f2+f2+i1", "i1+f2+f2+f1+f2"
    triangles, delta, derivatives = "d1+f2+i1+f1+f2", "b1 f2", "f3+f3+f4+f2"
    return [
        (forward, "f2 f1 i1 b f1 f2 f1 i i"),
        (table_gradient, "f1 u1 f2 i2 i i i1 f2 q1 i1 u1 f1 f1"),
        (backward, "f2 f2 f1 f1 i1 i f2 f1 f1 i i"),
        (encode, "f1 u1 f2 i2 f2 u1 f1 i i"),
        (leave_one_out, "i i i d f2 f3 f2 f2 f3 f3 f3 f3"),
        (blend_lambert, "f2 f2 f2 f f2 i i f2 f2"),
        (bin_samples, "f2 f2 f2 b1 f2 f2 f1 d i i i i i1 f2"),
        (mean_lobes, "f2 f1 f2 i i f2"),
        (adam_rows, "f2 f2 f2 i1 f2 f1 i i"),
        (stratified_kernel, "i i f2 i1 f1 i f2"),
        (vjp, "f2 f2 f3 f2 f3"),
        (put_known, "i1 b1 b1 i1 f2 f2 b1"),
        (record, "i1 f2 f2 f2"),
        (is_ascending, "i1"),
        (unit_cube, "f2 f1 f f f2 i i"),
        (emitted, "i i i1 b1 f2 f2 f2 f2"),
        (resolve_hits_principled, f"{shadow} b1 f2 f2 b1 f2 f2 f2 {vertices} {delta} {triangles} {derivatives}"),
        (spawn_rays_principled, f"{vertices} b1 f1 f {local} f2 f2 f2 f2 f2 {shadow}"),
        (direction, "f2 f2 f2 f1 f2"),
        (warp, "i1 f2 f1 f2 i f2"),
        (add_pdf, "i1 f2 f1 f2 i f1"),
        (lobes_pdf, "f2 f2 f2 f f1 f2"),
        (rows, "f2 f2 f1 d i i i i1"),
        (sample_emitter, f"{vertices} f2 {triangles} {local}"),
        (interact, "i i i1 f1 f1 f2 f2 f2 f2 f2 f2"),
    ]


def types(kernel: Any, given: str) -> tuple[Any, ...]:
    """Numba's types of what a kernel is given; the classes of records are those of its annotations."""
    import numba

    known: Any = numba.types

    def one(code: str) -> Any:
        scalar = getattr(known, _TYPES[code[0]])
        return known.Array(scalar, int(code[1:]), "C") if code[1:] else scalar

    found: list[Any] = []
    for words, record in zip(given.split(), kernel.py_func.__annotations__.values(), strict=False):
        fields = [one(code) for code in words.split("+")]
        if len(fields) == 1:
            found += fields
        elif len(set(fields)) == 1:
            found.append(known.NamedUniTuple(fields[0], len(fields), record))
        else:
            found.append(known.NamedTuple(fields, record))
    return tuple(found)


def main() -> None:
    """Compile the kernels, for as long as the fit is there."""
    fit = os.getppid()
    with uncollected():
        for kernel, given in kernels():
            if os.getppid() != fit:
                break
            kernel.compile(types(kernel, given))


if __name__ == "__main__":
    main()
