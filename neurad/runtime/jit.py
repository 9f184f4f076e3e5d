"""Decorators of compiled code: numba, cached on disk.

Numba's cache looks at the file of a function alone. What kernels call or inline therefore stands in their own file
where it can; after a change of what does not (``fields.dense_kernels`` takes cells from ``fields.kernels``) or of the
flags here, delete the caches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile at first use, cache on disk, release the interpreter lock, let divisions by zero be infinite."""
    return cast(Function, numba.njit(nogil=True, cache=True, error_model="numpy")(function))


def inlined(function: Function) -> Function:
    """Compile into the caller: a call that returns a tuple would go through memory and cost twice the time."""
    return cast(Function, numba.njit(inline="always")(function))
