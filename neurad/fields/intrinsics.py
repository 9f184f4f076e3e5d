"""Machine operations that numba lacks, as LLVM code that runs on every processor."""

from typing import Any

from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
TILE_ROWS, TILE_COLUMNS = 4, 32
"""Size of the block of a matrix that :func:`add_products` adds to: eight registers of AVX-512, enough to hide how long
one sum takes, for which six numbers are read."""
_FUSED = ("contract",)  # a product and a sum may become one operation


def _popcount(typing: Any, x: Any) -> Any:

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
    return _pick(b, v, list(range(2 * v.type.count)), w)


def _spread(b: Any, x: Any, lanes: int) -> Any:
    single = b.insert_element(ir.Constant(ir.VectorType(x.type, lanes), ir.Undefined), x, ir.Constant(_INT, 0))
    return _pick(b, single, [0] * lanes)


def _lerp(b: Any, v: Any, w: Any, t: Any) -> Any:
    """``v + t (w - v)`` for vectors and a scalar t."""
    product = b.fmul(b.fsub(w, v, flags=_FUSED), _spread(b, t, v.type.count), flags=_FUSED)
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


def _add_products(
    typing: Any, a: Any, b: Any, out: Any, count: Any, row_a: Any, step_a: Any, step_b: Any, step_out: Any, columns: Any
) -> Any:  # fmt: skip
    """Add a product of matrices to one of ``TILE_ROWS`` x ``columns`` (at most ``TILE_COLUMNS``): ``out[r, c] +=
    sum_k a[r, k] b[k, c]`` over ``k`` below ``count``.

    ``a``, ``b`` and ``out`` are addresses (uint64) of float32, all others int64. Rows of ``a`` lie ``row_a`` apart and
    its columns ``step_a``; rows of the others ``step_b`` and ``step_out``. The sums stay in registers: numba itself
    would write them to memory for every k.
    """
    signature = types.void(*[types.uint64] * 3, *[types.int64] * 6)
    lanes, parts = 16, TILE_COLUMNS // 16
    vector, long = ir.VectorType(_FLOAT, lanes), ir.IntType(64)
    mask_type = ir.VectorType(ir.IntType(1), lanes)

    def build(context: Any, b: Any, signature: Any, args: Any) -> Any:
        def known(name: str, result: Any, *given: Any) -> Any:
            kind = ir.FunctionType(result, given)
            return b.module.globals.get(name) or ir.Function(b.module, kind, name)

        load = known("llvm.masked.load.v16f32.p0", vector, vector.as_pointer(), _INT, mask_type, vector)
        store = known("llvm.masked.store.v16f32.p0", ir.VoidType(), vector, vector.as_pointer(), _INT, mask_type)
        align, none = ir.Constant(_INT, 4), ir.Constant(vector, [0.0] * lanes)
        left = _spread(b, b.trunc(args[8], _INT), lanes)
        masks = [
            b.icmp_signed("<", ir.Constant(left.type, list(range(lanes * i, lanes * (i + 1)))), left)
            for i in range(parts)
        ]

        def place(base: Any, row: Any, step: Any, offset: Any, kind: Any) -> Any:
            entry = b.add(b.mul(row, step), offset)
            return b.inttoptr(b.add(base, b.shl(entry, ir.Constant(long, 2))), kind.as_pointer())

        offsets = [ir.Constant(long, lanes * i) for i in range(parts)]
        rows = [b.mul(args[4], ir.Constant(long, r)) for r in range(TILE_ROWS)]

        tile = [(r, i) for r in range(TILE_ROWS) for i in range(parts)]
        before, body, after = b.block, b.append_basic_block("sum"), b.append_basic_block("done")
        b.branch(body)
        b.position_at_end(body)
        k = b.phi(long)
        sums = [b.phi(vector) for _ in tile]
        across = [
            b.call(load, [place(args[1], k, args[6], offset, vector), align, mask, none])
            for offset, mask in zip(offsets, masks, strict=True)
        ]
        down = [_spread(b, b.load(place(args[0], k, args[5], row, _FLOAT)), lanes) for row in rows]
        new = [
            b.fadd(total, b.fmul(down[r], across[i], flags=_FUSED), flags=_FUSED)
            for total, (r, i) in zip(sums, tile, strict=True)
        ]
        following = b.add(k, ir.Constant(long, 1))
        for phi, then in ((k, following), *zip(sums, new, strict=True)):
            phi.add_incoming(ir.Constant(long, 0) if phi is k else none, before)
            phi.add_incoming(then, body)
        b.cbranch(b.icmp_signed("<", following, args[3]), body, after)
        b.position_at_end(after)
        for total, (r, i) in zip(new, tile, strict=True):
            to = place(args[2], ir.Constant(long, r), args[7], offsets[i], vector)
            b.call(store, [b.fadd(b.call(load, [to, align, masks[i], none]), total), to, align, masks[i]])
        return context.get_dummy_value()

    return signature, build


popcount: Any = intrinsic(_popcount)
lowest_bit: Any = intrinsic(_lowest_bit)
interpolate: Any = intrinsic(_interpolate)
prefetch: Any = intrinsic(_prefetch)
add_products: Any = intrinsic(_add_products)
