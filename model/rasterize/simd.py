# SPDX-License-Identifier: GPL-3.0-or-later
"""Eight float32 lanes as a numba type, so that the rasteriser's inner loops are SIMD by construction.

Numba's own vectoriser turns only long loops into SIMD, and the pixel spans of small Gaussians are about eight
pixels wide. `f32x8` is LLVM's <8 x float>: one AVX register, two SSE or NEON ones. No fast-math flags:
results are the same bits on every run, and forward and backward take the same decisions.
"""

from __future__ import annotations

import operator

from llvmlite import ir
from numba import types
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 8
_F = ir.VectorType(ir.FloatType(), LANES)
_I = ir.VectorType(ir.IntType(32), LANES)
_M = ir.VectorType(ir.IntType(1), LANES)


class F32x8(types.Type):
    def __init__(self):
        super().__init__(name="f32x8")


class Mask8(types.Type):
    def __init__(self):
        super().__init__(name="mask8")


f32x8, mask8 = F32x8(), Mask8()


@register_model(F32x8)
class _F32x8Model(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _F)


@register_model(Mask8)
class _Mask8Model(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, _M)


def _operator(op, lane, out, emit):
    """Teaches numba `lane op lane -> out`."""

    @infer_global(op)
    class _Typing(ConcreteTemplate):
        cases = (signature(out, lane, lane),)

    @lower_builtin(op, lane, lane)
    def _lower(context, builder, sig, args):
        return emit(builder, *args)


_operator(operator.add, f32x8, f32x8, lambda b, x, y: b.fadd(x, y))
_operator(operator.sub, f32x8, f32x8, lambda b, x, y: b.fsub(x, y))
_operator(operator.mul, f32x8, f32x8, lambda b, x, y: b.fmul(x, y))
_operator(operator.truediv, f32x8, f32x8, lambda b, x, y: b.fdiv(x, y))
_operator(operator.gt, f32x8, mask8, lambda b, x, y: b.fcmp_ordered(">", x, y))
_operator(operator.lt, f32x8, mask8, lambda b, x, y: b.fcmp_ordered("<", x, y))
_operator(operator.ge, f32x8, mask8, lambda b, x, y: b.fcmp_ordered(">=", x, y))
_operator(operator.and_, mask8, mask8, lambda b, x, y: b.and_(x, y))


@infer_global(operator.neg)
class _Neg(ConcreteTemplate):
    cases = (signature(f32x8, f32x8),)


@lower_builtin(operator.neg, f32x8)
def _neg(context, builder, sig, args):
    return builder.fneg(args[0])


def _const(value):
    return ir.Constant(_F, [value] * LANES)


def _iconst(value):
    return ir.Constant(_I, [value] * LANES)


def _call(builder, name, out, args):
    fn = ir.FunctionType(out, [a.type for a in args])
    return builder.call(builder.module.declare_intrinsic(name, fnty=fn), args)


def _fma(builder, a, b, c):
    return _call(builder, "llvm.fmuladd.v8f32", _F, [a, b, c])


def _pointer(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _F.as_pointer())


@intrinsic
def load(typingctx, array, index):
    """Lanes array[index : index + 8] of a contiguous 1D float32 array; no bounds check, no alignment asked."""

    def codegen(context, builder, sig, args):
        return builder.load(_pointer(context, builder, sig.args[0], *args), align=4)

    return f32x8(array, types.intp), codegen


@intrinsic
def store(typingctx, array, index, value):
    """array[index : index + 8] = value."""

    def codegen(context, builder, sig, args):
        builder.store(args[2], _pointer(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x8), codegen


@intrinsic
def splat(typingctx, x):
    """x in every lane."""

    def codegen(context, builder, sig, args):
        one = builder.insert_element(ir.Constant(_F, ir.Undefined), args[0], ir.Constant(ir.IntType(32), 0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
        return builder.shuffle_vector(one, ir.Constant(_F, ir.Undefined), zeros)

    return f32x8(types.float32), codegen


@intrinsic
def ramp(typingctx):
    """0, 1, … 7."""
    return f32x8(), lambda context, builder, sig, args: ir.Constant(_F, [float(i) for i in range(LANES)])


@intrinsic
def fma(typingctx, a, b, c):
    """a * b + c, fused where the machine can."""
    return f32x8(f32x8, f32x8, f32x8), lambda context, builder, sig, args: _fma(builder, *args)


@intrinsic
def select(typingctx, mask, a, b):
    """a where mask, b elsewhere."""
    return f32x8(mask8, f32x8, f32x8), lambda context, builder, sig, args: builder.select(*args)


@intrinsic
def any_lane(typingctx, mask):
    """Whether any lane is set."""

    def codegen(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(mask8), codegen


@intrinsic
def total(typingctx, x):
    """The sum of the lanes, in a fixed order (a tree)."""

    def codegen(context, builder, sig, args):
        x, undefined = args[0], ir.Constant(_F, ir.Undefined)
        for step in (4, 2, 1):
            index = ir.Constant(_I, [(i + step) % LANES for i in range(LANES)])
            x = builder.fadd(x, builder.shuffle_vector(x, undefined, index))
        return builder.extract_element(x, ir.Constant(ir.IntType(32), 0))

    return types.float32(f32x8), codegen


# Minimax of 2^f on [-1/2, 1/2], highest power first: relative error 2e-7, float32 rounding included.
EXP2 = (1.3264727e-3, 9.671513e-3, 5.5507336e-2, 2.4022242e-1, 6.93147e-1, 1.0)


@intrinsic
def exp2(typingctx, x):
    """2^x for -126 <= x <= 126; anything at all outside (mask it)."""

    def codegen(context, builder, sig, args):
        magic = _const(12582912.0)  # 1.5 * 2^23: adding it leaves round(x) in the low bits
        shifted = builder.fadd(args[0], magic)
        f = builder.fsub(args[0], builder.fsub(shifted, magic))
        p = _const(EXP2[0])
        for c in EXP2[1:]:
            p = _fma(builder, p, f, _const(c))
        exponent = builder.shl(builder.bitcast(shifted, _I), _iconst(23))
        return builder.bitcast(builder.add(builder.bitcast(p, _I), exponent), _F)

    return f32x8(f32x8), codegen
