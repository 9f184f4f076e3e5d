"""Machine operations that numba lacks, as LLVM code that runs on every processor."""

from __future__ import annotations

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_FUSED = ("contract",)  # a product and a sum may become one operation


def _popcount(typing: Any, x: Any) -> Any:
    """Number of set bits of a uint64."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), build


def _lowest_bit(typing: Any, x: Any) -> Any:
    """Index of the lowest set bit of a uint64 other than 0."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.uint64(types.uint64), build


def _pick(b: Any, v: Any, lanes: list[int], w: Any = None) -> Any:
    """Lanes of a vector, or of two vectors in a row."""
    return b.shuffle_vector(v, v if w is None else w, ir.Constant(ir.VectorType(_INT, len(lanes)), lanes))


def _join(b: Any, v: Any, w: Any) -> Any:
    """Two vectors in a row."""
    return _pick(b, v, list(range(2 * v.type.count)), w)


def _lerp(b: Any, v: Any, w: Any, t: Any) -> Any:
    """``v + t (w - v)`` for vectors and a scalar t."""
    lanes = v.type.count
    single = b.insert_element(ir.Constant(ir.VectorType(_FLOAT, lanes), ir.Undefined), t, ir.Constant(_INT, 0))
    product = b.fmul(b.fsub(w, v, flags=_FUSED), _pick(b, single, [0] * lanes), flags=_FUSED)
    return b.fadd(v, product, flags=_FUSED)


def _interpolate(
    typing: Any, table: Any, out: Any, e0: Any, e1: Any, e2: Any, e3: Any, e4: Any, e5: Any, e6: Any, e7: Any,
    fx: Any, fy: Any, fz: Any,
) -> Any:  # fmt: skip
    """Write the trilinear mean of eight pairs of float32 to the address ``out`` (uint64).

    ``table`` is the address of entry 0, ``e0`` to ``e7`` are entries (uint32) of the corners x = c & 1,
    y = (c >> 1) & 1, z = c >> 2, and ``fx``, ``fy``, ``fz`` the fractions between them.
    """
    signature = types.void(types.uint64, types.uint64, *[types.uint32] * 8, *[types.float32] * 3)

    def build(context: Any, b: Any, signature: Any, args: Any) -> Any:
        pair = ir.VectorType(_FLOAT, 2).as_pointer()
        base = b.inttoptr(args[0], pair)
        corners = []
        for entry in args[2:10]:
            value = b.load(b.gep(base, [b.zext(entry, ir.IntType(64))]))
            value.align = 4
            corners.append(value)
        near = _join(b, _join(b, corners[0], corners[2]), _join(b, corners[4], corners[6]))
        far = _join(b, _join(b, corners[1], corners[3]), _join(b, corners[5], corners[7]))
        along_x = _lerp(b, near, far, args[10])
        along_y = _lerp(b, _pick(b, along_x, [0, 1, 4, 5]), _pick(b, along_x, [2, 3, 6, 7]), args[11])
        along_z = _lerp(b, _pick(b, along_y, [0, 1]), _pick(b, along_y, [2, 3]), args[12])
        b.store(along_z, b.inttoptr(args[1], pair)).align = 4
        return context.get_dummy_value()

    return signature, build


def _prefetch(typing: Any, address: Any) -> Any:
    """Prefetch the cache line at an address (uint64)."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = builder.inttoptr(args[0], ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, _INT, _INT, _INT])
        function = builder.module.globals.get("llvm.prefetch.p0") or ir.Function(
            builder.module, kind, "llvm.prefetch.p0"
        )
        for_reading, keep, data = ir.Constant(_INT, 0), ir.Constant(_INT, 3), ir.Constant(_INT, 1)
        builder.call(function, [pointer, for_reading, keep, data])
        return context.get_dummy_value()

    return types.void(types.uint64), build


popcount: Any = intrinsic(_popcount)
lowest_bit: Any = intrinsic(_lowest_bit)
interpolate: Any = intrinsic(_interpolate)
prefetch: Any = intrinsic(_prefetch)
