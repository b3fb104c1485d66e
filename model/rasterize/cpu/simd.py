# SPDX-License-Identifier: GPL-3.0-or-later
"""Vectors as numba types, so that the rasteriser's inner loops are SIMD by construction.

Numba's own vectoriser turns only long plain loops into SIMD. `pixels` is LLVM's <LANES x float>, a block of ROWS x 8
pixels; `doubles` is <8 x double>, eight Gaussians. LLVM cuts them to the registers that the machine has (AVX-512, AVX,
SSE or NEON). No fast-math flags: results are the same bits on every run, and forward and backward take the same
decisions.
"""

from __future__ import annotations

import operator

from llvmlite import binding, ir
from numba import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

# With registers of sixteen floats a block is two rows: small Gaussians are as high as they are wide.
ROWS = 2 if binding.get_host_cpu_features().get("avx512f") else 1
LANES = 8 * ROWS
EIGHT = 8  # Gaussians at a time
_LLVM = {
    "pixels": ir.VectorType(ir.FloatType(), LANES),
    "pixel_mask": ir.VectorType(ir.IntType(1), LANES),
    "doubles": ir.VectorType(ir.DoubleType(), EIGHT),
    "double_mask": ir.VectorType(ir.IntType(1), EIGHT),
}


class Vector(types.Type):
    pass


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _LLVM[fe_type.name])


pixels, pixel_mask, doubles, double_mask = map(Vector, _LLVM)
_MASKS = {pixels: pixel_mask, doubles: double_mask}


def _operator(op, emit, operands, mask=False):
    """Teaches numba `op` on vectors; emit(builder, *values)."""
    arity = emit.__code__.co_argcount - 1

    @infer_global(op)
    class _Typing(ConcreteTemplate):
        cases = tuple(signature(_MASKS[x] if mask else x, *[x] * arity) for x in operands)

    for x in operands:
        lower_builtin(op, *[x] * arity)(lambda context, builder, sig, args: emit(builder, *args))


_floats = (pixels, doubles)
_operator(operator.add, lambda b, x, y: b.fadd(x, y), _floats)
_operator(operator.sub, lambda b, x, y: b.fsub(x, y), _floats)
_operator(operator.mul, lambda b, x, y: b.fmul(x, y), _floats)
_operator(operator.truediv, lambda b, x, y: b.fdiv(x, y), _floats)
_operator(operator.neg, lambda b, x: b.fneg(x), _floats)
_operator(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), _floats, mask=True)
_operator(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), _floats, mask=True)
_operator(operator.ge, lambda b, x, y: b.fcmp_ordered(">=", x, y), _floats, mask=True)
_operator(operator.eq, lambda b, x, y: b.fcmp_ordered("==", x, y), _floats, mask=True)
_operator(operator.and_, lambda b, x, y: b.and_(x, y), (pixel_mask, double_mask))


def _const(kind, value):
    return ir.Constant(kind, [value] * kind.count)


def _integers(kind):
    return ir.VectorType(ir.IntType({ir.FloatType(): 32, ir.DoubleType(): 64}[kind.element]), kind.count)


def _call(builder, name, kind, args):
    """An LLVM intrinsic that is named after its vector type."""
    name = f"llvm.{name}.v{kind.count}f{_integers(kind).element.width}"
    return builder.call(builder.module.declare_intrinsic(name, fnty=ir.FunctionType(kind, [kind] * len(args))), args)


def _shuffle(builder, x, y, index):
    index = ir.Constant(ir.VectorType(ir.IntType(32), len(index)), list(index))
    return builder.shuffle_vector(x, y, index)


def _address(context, builder, array_type, array, index, kind):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), kind.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """pixels array[index : index + LANES] of a contiguous 1D float32 array; no bounds check, no alignment asked."""

    def codegen(context, builder, sig, args):
        return builder.load(_address(context, builder, sig.args[0], *args, _LLVM["pixels"]), align=4)

    return pixels(array, types.intp), codegen


@intrinsic
def load_doubles(typingctx, array, index):
    """doubles array[index : index + 8] of a contiguous 1D float32 array."""

    def codegen(context, builder, sig, args):
        floats = ir.VectorType(ir.FloatType(), EIGHT)
        x = builder.load(_address(context, builder, sig.args[0], *args, floats), align=4)
        return builder.fpext(x, _LLVM["doubles"])

    return doubles(array, types.intp), codegen


@intrinsic
def gather(typingctx, array, ids, at, stride, offset):
    """doubles array[ids[at + lane] * stride + offset] of contiguous 1D arrays, float32 and int32."""

    def codegen(context, builder, sig, args):
        array, ids, at, stride, offset = args
        data = context.make_array(sig.args[0])(context, builder, array).data
        ids = builder.gep(context.make_array(sig.args[1])(context, builder, ids).data, [at])
        x = ir.Constant(ir.VectorType(ir.FloatType(), EIGHT), ir.Undefined)
        for lane in range(EIGHT):
            i = builder.sext(builder.load(builder.gep(ids, [ir.Constant(at.type, lane)])), at.type)
            value = builder.load(builder.gep(data, [builder.add(builder.mul(i, stride), offset)]))
            x = builder.insert_element(x, value, ir.Constant(ir.IntType(32), lane))
        return builder.fpext(x, _LLVM["doubles"])

    return doubles(array, ids, types.intp, types.intp, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + lanes] = value, rounded to float32."""

    def codegen(context, builder, sig, args):
        x = args[2]
        if sig.args[2] == doubles:
            x = builder.fptrunc(x, ir.VectorType(ir.FloatType(), EIGHT))
        builder.store(x, _address(context, builder, sig.args[0], args[0], args[1], x.type), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def prefetch(typingctx, array, index):
    """Asks for the memory of row `index` of a 2D array."""

    def codegen(context, builder, sig, args):
        a = context.make_array(sig.args[0])(context, builder, args[0])
        stride = builder.extract_value(a.strides, 0)
        at = builder.gep(builder.bitcast(a.data, ir.IntType(8).as_pointer()), [builder.mul(args[1], stride)])
        flag = ir.IntType(32)
        fn = ir.FunctionType(ir.VoidType(), [at.type, flag, flag, flag])
        fn = builder.module.declare_intrinsic("llvm.prefetch.p0", fnty=fn)
        builder.call(fn, [at, ir.Constant(flag, 0), ir.Constant(flag, 3), ir.Constant(flag, 1)])
        return context.get_dummy_value()

    return types.void(array, types.intp), codegen


@intrinsic
def splat(typingctx, x):
    """x in every lane: pixels of a float32, doubles of a float64."""
    out = pixels if x == types.float32 else doubles

    def codegen(context, builder, sig, args):
        undefined = ir.Constant(_LLVM[out.name], ir.Undefined)
        one = builder.insert_element(undefined, args[0], ir.Constant(ir.IntType(32), 0))
        return _shuffle(builder, one, undefined, [0] * _LLVM[out.name].count)

    return out(types.float32 if out == pixels else types.float64), codegen


@intrinsic
def columns(typingctx):
    """Which column of its block a pixel is in: the lanes of two rows take turns."""
    return pixels(), lambda *_: ir.Constant(_LLVM["pixels"], [float(i // ROWS) for i in range(LANES)])


@intrinsic
def rows(typingctx):
    """Which row of its block a pixel is in."""
    return pixels(), lambda *_: ir.Constant(_LLVM["pixels"], [float(i % ROWS) for i in range(LANES)])


@intrinsic
def fma(typingctx, a, b, c):
    """a * b + c, fused where the machine can."""
    return a(a, b, c), lambda context, builder, sig, args: _call(builder, "fmuladd", args[0].type, args)


@intrinsic
def sqrt(typingctx, x):
    return x(x), lambda context, builder, sig, args: _call(builder, "sqrt", args[0].type, args)


@intrinsic
def select(typingctx, mask, a, b):
    """a where mask, b elsewhere."""
    return a(mask, a, b), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def bits(typingctx, mask):
    """The mask as an integer, the first lane its lowest bit."""

    def codegen(context, builder, sig, args):
        whole = builder.bitcast(args[0], ir.IntType(args[0].type.count))
        return builder.zext(whole, ir.IntType(64))

    return types.int64(mask), codegen


@intrinsic
def total(typingctx, x):
    """The sum of the lanes, in a fixed order (a tree)."""

    def codegen(context, builder, sig, args):
        x = args[0]
        while x.type.count > 1:
            half = x.type.count // 2
            low, high = _shuffle(builder, x, x, range(half)), _shuffle(builder, x, x, range(half, 2 * half))
            x = builder.fadd(low, high)
        return builder.extract_element(x, ir.Constant(ir.IntType(32), 0))

    return types.float32(pixels), codegen


@intrinsic
def store_totals(typingctx, array, index, a, b, c, d, e, f, g, h):
    """array[index : index + 8] = the sums of the lanes of eight vectors, in a fixed order: for a third of the
    instructions of eight times `total`."""

    def codegen(context, builder, sig, args):
        vectors = list(args[2:])
        if ROWS == 2:
            vectors = [
                builder.fadd(_shuffle(builder, x, x, range(8)), _shuffle(builder, x, x, range(8, 16))) for x in vectors
            ]
        # Neighbours are added twice, within a half of a register: then each of two vectors has four sums a half.
        even, odd = (0, 2, 8, 10, 4, 6, 12, 14), (1, 3, 9, 11, 5, 7, 13, 15)
        for one, other in ((even, odd), (even, odd), ((0, 1, 2, 3, 8, 9, 10, 11), (4, 5, 6, 7, 12, 13, 14, 15))):
            vectors = [
                builder.fadd(_shuffle(builder, x, y, one), _shuffle(builder, x, y, other))
                for x, y in zip(vectors[::2], vectors[1::2], strict=True)
            ]
        to = _address(context, builder, sig.args[0], args[0], args[1], vectors[0].type)
        builder.store(vectors[0], to, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, *[pixels] * 8), codegen


# Minimax of 2^f on [-1/2, 1/2], highest power first: relative error 2e-7, float32 rounding included.
EXP2 = (1.3264727e-3, 9.671513e-3, 5.5507336e-2, 2.4022242e-1, 6.93147e-1, 1.0)


@intrinsic
def exp2(typingctx, x):
    """2^x of pixels for -126 <= x <= 126; anything at all outside (mask it)."""

    def codegen(context, builder, sig, args):
        kind = args[0].type
        magic = _const(kind, 12582912.0)  # 1.5 * 2^23: adding it leaves round(x) in the low bits
        shifted = builder.fadd(args[0], magic)
        f = builder.fsub(args[0], builder.fsub(shifted, magic))
        p = _const(kind, EXP2[0])
        for c in EXP2[1:]:
            p = _call(builder, "fmuladd", kind, [p, f, _const(kind, c)])
        integers = _integers(kind)
        exponent = builder.shl(builder.bitcast(shifted, integers), _const(integers, 23))
        return builder.bitcast(builder.add(builder.bitcast(p, integers), exponent), kind)

    return pixels(pixels), codegen


@intrinsic
def log2(typingctx, x):
    """log2 of doubles > 0 to 2e-9; anything at all for others (mask it)."""

    def codegen(context, builder, sig, args):
        kind, integers = args[0].type, _integers(args[0].type)
        whole = builder.bitcast(args[0], integers)
        origin = _const(integers, 0x3FE6A09E667F3BCD)  # the bits of sqrt(½): the mantissa is in [sqrt(½), sqrt(2))
        exponent = builder.ashr(builder.sub(whole, origin), _const(integers, 52))
        m = builder.bitcast(builder.sub(whole, builder.shl(exponent, _const(integers, 52))), kind)
        one = _const(kind, 1.0)
        s = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))  # ln m = 2 (s + s³/3 + s⁵/5 + …)
        s2 = builder.fmul(s, s)
        p = _const(kind, 1 / 9)
        for k in (7, 5, 3, 1):
            p = _call(builder, "fmuladd", kind, [p, s2, _const(kind, 1 / k)])
        scaled = builder.fmul(builder.fmul(s, p), _const(kind, 2.8853900817779268))  # 2 / ln 2
        return builder.fadd(scaled, builder.sitofp(exponent, kind))

    return doubles(doubles), codegen
