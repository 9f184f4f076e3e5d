"""Mitsuba 3 with the just-in-time compiler for CPUs, or one sentence about what is missing."""

from typing import Any

from neurad.core.errors import InputError
from neurad.formats.mitsuba.plugin import COMPILED, LLVM, no_llvm
from neurad.runtime.extras import needed

HOW = f"apt-get install libllvm19, or set DRJIT_LIBLLVM_PATH to a libLLVM.so of version {LLVM[0]} or newer"


def load_mitsuba(program: str = "bench peer") -> Any:
    """The module ``mitsuba`` with the variant ``llvm_ad_rgb`` set and one thread a usable core.

    Args:
        program: that wants it, for the sentence.

    Raises:
        InputError: the package or a fitting LLVM library is missing.
    """
    with needed("mitsuba", "mitsuba", f"{program}: it"):
        import mitsuba as mi
    try:
        mi.set_variant(COMPILED)
        reason = no_llvm()
    except (ImportError, AttributeError) as error:
        reason = " ".join(str(error).split()).rstrip(".")
    if reason is not None:
        raise InputError(f"{program}: Mitsuba's {COMPILED} does not start ({reason}): {HOW}")
    return mi
