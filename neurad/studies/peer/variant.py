"""Mitsuba 3 with the just-in-time compiler for CPUs, or one sentence about what is missing."""

from __future__ import annotations

from typing import Any

from neurad.core.errors import InputError
from neurad.export.mitsuba import LLVM
from neurad.runtime.machine import usable_cores

VARIANT = "llvm_ad_rgb"
HOW = f"apt-get install libllvm19, or set DRJIT_LIBLLVM_PATH to a libLLVM.so of version {LLVM[0]} or newer"


def load_mitsuba() -> Any:
    """The module ``mitsuba`` with the variant ``llvm_ad_rgb`` set and one thread a usable core.

    Raises:
        InputError: the package or a fitting LLVM library is missing.
    """
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise InputError("bench peer: it needs the package mitsuba: pip install 'neurad[mitsuba]'") from error
    try:
        mi.set_variant(VARIANT)
        if dr.detail.llvm_version() < LLVM:
            raise ValueError(f"it finds no LLVM of version {LLVM[0]} or newer")
        dr.set_thread_count(usable_cores())
        dr.eval(mi.Float(0.0) + dr.opaque(mi.Float, 1.0))
    except (ImportError, RuntimeError, AttributeError, ValueError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
        raise InputError(f"bench peer: Mitsuba's {VARIANT} does not start ({reason}): {HOW}") from error
    return mi
