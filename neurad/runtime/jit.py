"""Decorators of kernels: numba, cached on disk.

Numba's cache looks at the file of a kernel alone. Kernels here share code: functions that are compiled into them,
other kernels that they call, and constants, from other files as well. Each kernel's entry in the cache therefore
carries a digest of all that it uses (:func:`digest`), and a change of any of it compiles the kernel anew.
"""

import hashlib
import re
from collections.abc import Callable, Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

from neurad.runtime.allocator import uncollected
from neurad.runtime.progress import phase

Function = TypeVar("Function", bound=Callable[..., Any])
_KNOWN = (Dispatcher, _Intrinsic, int, float, np.generic, np.ndarray)  # what a kernel reads of its globals


def kernel(function: Function) -> Function:
    """Compile at first use, cache on disk, release the interpreter lock, let divisions by zero be infinite.

    It makes no arrays, but is given the room it works in: counting references takes a third of the time of compiling.
    """
    return _cached(function)


def fastmath_kernel(function: Function) -> Function:
    """:func:`kernel` whose sums may be reordered and which may take it that no value is NaN or infinite."""
    return _cached(function, fastmath=True)


def subroutine(function: Function) -> Function:
    """:func:`kernel` that kernels alone may call: a third of compiling a small one would be its wrapper for Python."""
    return cast(Function, _compiled(function, no_cpython_wrapper=True))


def inlined(function: Function) -> Function:
    """Compile into the caller: a call that returns a tuple would go through memory and cost twice the time."""
    return cast(Function, numba.njit(inline="always")(function))


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    """Compiled with numba's ``options``, without reference counts and without the wrapper for callers in C."""
    options |= {"_nrt": False, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    return numba.njit(**options)(function)


def _cached(function: Function, **options: Any) -> Function:
    """Compiled, and kept on disk until anything that it uses changes."""
    compiled = _compiled(function, **options)
    if isinstance(compiled, Dispatcher):  # NUMBA_DISABLE_JIT gives the function itself
        make_cache: Any = FunctionCache
        cache = make_cache(function)
        file = cache._cache_file
        file._source_stamp = (file._source_stamp, digest(compiled))  # stale as soon as anything it uses changes
        vars(compiled)["_cache"] = cache
        _announce(compiled)
    return cast(Function, compiled)


def _announce(compiled: Any) -> None:
    """Let the line on the terminal say when a kernel is compiled, which takes seconds and happens once. Collecting
    garbage meanwhile would take an eighth of them.
    """
    compiler, name = compiled._compiler, compiled.__name__
    compile_now = compiler.compile

    def compile_and_say(*args: Any) -> Any:
        with phase("compiling") as entered, uncollected():
            entered.detail = name.strip("_")
            return compile_now(*args)

    compiler.compile = compile_and_say


def digest(compiled: Dispatcher) -> str:
    """A hash of a kernel's options and code, and of all functions and constants that its code names, in any file."""
    found = hashlib.sha256()
    seen: set[int] = set()
    pending: list[Any] = [compiled]
    while pending:
        value = pending.pop()
        if isinstance(value, Dispatcher):
            if id(value) not in seen:
                seen.add(id(value))
                found.update(repr(sorted(value.targetoptions.items(), key=str)).encode())
                pending += _used(value.py_func)
        elif isinstance(value, _Intrinsic):
            pending += _used(value._defn)
        elif isinstance(value, np.ndarray):
            found.update(value.tobytes())
        else:
            found.update(repr(value).encode())
    return found.hexdigest()


def _used(function: FunctionType) -> Iterator[Any]:
    """Code, constants, what global names stand for and the records it takes, of a function and those defined in it."""
    yield from _record_fields(function)
    codes = [function.__code__]
    while codes:
        code = codes.pop()
        yield code.co_code
        for constant in code.co_consts:
            if isinstance(constant, CodeType):
                codes.append(constant)
            else:
                yield constant
        for name in code.co_names:
            yield name
            value = function.__globals__.get(name)
            if isinstance(value, ModuleType):  # of kernels.name take what this code can read
                members = (getattr(value, attribute, None) for attribute in code.co_names)
                yield from (x for x in members if isinstance(x, _KNOWN))
            elif isinstance(value, tuple):
                yield from (x for x in value if isinstance(x, _KNOWN))
            elif isinstance(value, _KNOWN):
                yield value
            elif fields := getattr(value, "_fields", None):  # a record of arrays
                yield fields


def _record_fields(function: FunctionType) -> Iterator[Any]:
    """Names and fields of the records that annotations name: numba types a record by its class and element types, so
    it would not notice fields that change places.
    """
    for annotation in function.__annotations__.values():
        words = re.findall(r"\w+", annotation) if isinstance(annotation, str) else ()
        named = [function.__globals__.get(word) for word in words] if words else [annotation]
        for record in named:
            if fields := getattr(record, "_fields", None):
                yield fields
