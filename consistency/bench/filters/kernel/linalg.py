"""Linear algebra of the kernels without an allocation.

There are loops over arrays, which compile fast, BLAS and LAPACK, and definiteness. NumPy's constructors are compiled
again for each kind of shape, so that kernels call those of this module. Where no value is given, an array has any.
``copy`` and ``fill`` write to the whole of their target.

``np.dot`` and ``np.linalg`` inside a kernel allocate their results, know no triangular solve and no
symmetric update, and call their BLAS through a Python-level import. So the function pointers that SciPy
exports for Cython are given to LLVM as symbols of fixed names. A kernel on disk holds those names and no
address, which is why it can be cached: a later process imports this module, which gives the names their
new addresses, before any kernel is loaded.

BLAS counts columns first: a row-major matrix is its own transpose there, a row-major upper half the lower
half. All matrices below are row-major, with any distance between rows and none between columns.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from inspect import Parameter, Signature
from typing import Any

import numba
import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from scipy.linalg import cython_blas, cython_lapack

from consistency.bench.filters.compiler.dispatch import routine
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.scenario.models import jitable
from consistency.referee.types import Array, Indices

SMALL = 512  # size up to which strips of dgemm are faster than dsyrk; measured with OpenBLAS
ROUTINES = dict.fromkeys(("dgemm", "dgemv", "dsymm", "dsyrk", "dtrsm"), cython_blas) | {"dpotrf": cython_lapack}
_intrinsic: Callable[[Any], Any] = numba.extending.intrinsic
_llvm: Any = cgutils  # untyped
_PRODUCT = "m n k alpha A lda B ldb beta C ldc"
_SYMMETRIC = "m n alpha A lda B ldb beta C ldc"
DEFICIENT = 1e-12  # pivot of a correlation matrix below which a direction carries no uncertainty
ROUNDING = 1e-24  # variance (m^2, rad^2) that rounding alone leaves behind where none is


@inner
def copy(source: Array, target: Array) -> None:
    for i in range(len(target)):
        target[i] = source[i]


@inner
def copy_matrix(source: Array, target: Array) -> None:
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@inner
def fill(target: Array, value: float) -> None:
    for i in range(len(target)):
        target[i] = value


@inner
def fill_matrix(target: Array, value: float) -> None:
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = value


@inner
def vector(n: int) -> Array:
    return np.empty(n)


@inner
def matrix(m: int, n: int) -> Array:
    return np.empty((m, n))


@inner
def blocks(count: int, m: int, n: int) -> Array:
    return np.empty((count, m, n))


@inner
def integers(n: int, value: int) -> Indices:
    new = np.empty(n, np.int64)
    for i in range(n):
        new[i] = value
    return new


@inner
def filled(n: int, value: float) -> Array:
    new = vector(n)
    fill(new, value)
    return new


@inner
def filled_matrix(m: int, n: int, value: float) -> Array:
    new = matrix(m, n)
    fill_matrix(new, value)
    return new


@inner
def filled_blocks(count: int, m: int, n: int, value: float) -> Array:
    new = blocks(count, m, n)
    for i in range(count):
        fill_matrix(new[i], value)
    return new


@inner
def sum_of(values: Array) -> float:
    """Sum of ``values`` (n,), from the first to the last."""
    result = 0.0
    for i in range(len(values)):
        result += values[i]
    return result


def _capsule(name: str, result: Any, *arguments: Any) -> Any:
    return ctypes.PYFUNCTYPE(result, *arguments)((name, ctypes.pythonapi))


def _pointer(module: Any, routine: str) -> int:
    capsule = getattr(module, "__pyx_capi__")[routine]  # noqa: B009
    signature = _capsule("PyCapsule_GetName", ctypes.c_char_p, ctypes.py_object)(capsule)
    if b"int *" not in signature:  # a BLAS of 64-bit integers would read past ours
        raise ImportError(f"SciPy's {routine} does not take 32-bit integers: {signature.decode()}")
    pointer = _capsule("PyCapsule_GetPointer", ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)
    return int(pointer(capsule, signature))


for _routine, _module in ROUTINES.items():
    binding.add_symbol(f"consistency_{_routine}", _pointer(_module, _routine))


def _signature_and_code(routine: str, flags: bytes, arguments: tuple[Any, ...]) -> Any:
    """Of a call by reference: flags, then arrays as pointers, numbers through the stack; LAPACK also gives ``info``."""
    has_info = ROUTINES[routine] is cython_lapack

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        slots = [_llvm.alloca_once_value(builder, ir.Constant(ir.IntType(8), flag)) for flag in flags]
        for kind, value in zip(signature.args, values, strict=True):
            if isinstance(kind, types.Array):
                slots.append(context.make_array(kind)(context, builder, value).data)
            else:
                to = types.float64 if isinstance(kind, types.Float) else types.int32
                slots.append(_llvm.alloca_once_value(builder, context.cast(builder, value, kind, to)))
        info = _llvm.alloca_once_value(builder, ir.Constant(ir.IntType(32), 0))
        slots += [info] if has_info else []
        kind = ir.FunctionType(ir.VoidType(), [_llvm.voidptr_t] * len(slots))
        function = _llvm.get_or_insert_function(builder.module, kind, f"consistency_{routine}")
        builder.call(function, [builder.bitcast(slot, _llvm.voidptr_t) for slot in slots])
        if has_info:
            return builder.load(info)
        return context.get_dummy_value()

    return (types.int32 if has_info else types.void)(*arguments), generate


def _call(name: str, flags: bytes, arguments: str) -> Any:
    """An intrinsic of BLAS or LAPACK with these ``flags``, and with its ``arguments`` by name."""

    def declare(_: Any, *kinds: Any) -> Any:
        return _signature_and_code(name, flags, kinds)

    names = ("_", *arguments.split())
    declare.__signature__ = Signature([Parameter(each, Parameter.POSITIONAL_OR_KEYWORD) for each in names])  # type: ignore[attr-defined]
    return _intrinsic(declare)


_dpotrf_l = _call("dpotrf", b"L", "n A lda")
_dtrsm_rltn, _dtrsm_rlnn = (_call("dtrsm", flags, "m n alpha A lda B ldb") for flags in (b"RLTN", b"RLNN"))
_dsyrk_ln = _call("dsyrk", b"LN", "n k alpha A lda beta C ldc")
_dgemm_nt, _dgemm_nn, _dgemm_tn = (_call("dgemm", flags, _PRODUCT) for flags in (b"NT", b"NN", b"TN"))
_dsymm_ll, _dsymm_rl = (_call("dsymm", flags, _SYMMETRIC) for flags in (b"LL", b"RL"))
_dgemv_n = _call("dgemv", b"N", "m n alpha A lda x incx beta y incy")


@routine
def _row(A: Any) -> Any:
    """Numbers from one row to the next, or from one number of a vector to the next."""
    return A.strides[0] // A.itemsize


@routine
def upper_cholesky(A: Any) -> Any:
    """Upper half of A <- U with U' U = A, read from that half; False where A is not positive definite."""
    return _dpotrf_l(len(A), A, _row(A)) == 0


@routine
def solve_upper(U: Any, B: Any) -> None:
    """B <- U^-1 B for the upper half U."""
    _dtrsm_rlnn(B.shape[1], len(U), 1.0, U, _row(U), B, _row(B))


@routine
def product_of_transposed(A: Any, B: Any, C: Any) -> None:
    """C <- A' B."""
    _dgemm_nt(B.shape[1], A.shape[1], len(A), 1.0, B, _row(B), A, _row(A), 0.0, C, _row(C))


@routine
def add_product_of_transposed(weight: float, A: Any, B: Any, C: Any) -> None:
    """C <- C + weight A' B."""
    _dgemm_nt(B.shape[1], A.shape[1], len(A), weight, B, _row(B), A, _row(A), 1.0, C, _row(C))


@routine
def add_symmetric_product(weight: float, A: Any, B: Any, C: Any) -> None:
    """Upper half of C <- C + weight A' B, which is symmetric; of the lower half, anything."""
    n, width = len(C), 32 if len(C) <= SMALL else 256
    for first in range(0, n, width):
        last = min(first + width, n)
        add_product_of_transposed(weight, A[:, :last], B[:, first:last], C[:last, first:last])


@routine
def add_gram(weight: float, A: Any, C: Any) -> None:
    """Upper half of C <- C + weight A' A; of the lower half, anything."""
    if len(C) <= SMALL:
        add_symmetric_product(weight, A, A, C)
    else:
        _dsyrk_ln(len(C), len(A), weight, A, _row(A), 1.0, C, _row(C))


@routine
def solve_transposed(U: Any, B: Any) -> None:
    """B <- U'^-1 B for the upper half U; in strips of rows, which is faster than one dtrsm."""
    for first in range(0, len(U), 12):
        last = min(first + 12, len(U))
        if first > 0:
            add_product_of_transposed(-1.0, U[:first, first:last], B[:first], B[first:last])
        strip = U[first:last, first:last]
        _dtrsm_rltn(B.shape[1], last - first, 1.0, strip, _row(strip), B[first:last], _row(B))


@routine
def add_times_transposed(weight: float, A: Any, B: Any, C: Any) -> None:
    """C <- C + weight A B'."""
    _dgemm_tn(len(B), len(A), A.shape[1], weight, B, _row(B), A, _row(A), 1.0, C, _row(C))


@routine
def times_symmetric(A: Any, S: Any, C: Any) -> None:
    """C <- A S, S read from its upper half."""
    _dsymm_ll(len(S), len(A), 1.0, S, _row(S), A, _row(A), 0.0, C, _row(C))


@routine
def symmetric_times(S: Any, A: Any, C: Any) -> None:
    """C <- S A, S read from its upper half."""
    _dsymm_rl(A.shape[1], len(S), 1.0, S, _row(S), A, _row(A), 0.0, C, _row(C))


@routine
def product(A: Any, B: Any, C: Any) -> None:
    """C <- A B."""
    _dgemm_nn(B.shape[1], len(A), A.shape[1], 1.0, B, _row(B), A, _row(A), 0.0, C, _row(C))


@routine
def add_transposed_times(A: Any, y: Any, x: Any) -> None:
    """x <- x + A' y."""
    _dgemv_n(A.shape[1], len(A), 1.0, A, _row(A), y, _row(y), 1.0, x, _row(x))


@jitable
def semidefinite_cholesky(A: Any, C: Any) -> bool:
    """C (n, n) <- lower root with C C' = A (n, n), positive semidefinite; the column of a zero pivot is zero.

    The start of a trial is known exactly, so the first covariances are singular. Returns False for an A that is
    indefinite or not finite.
    """
    n = A.shape[0]
    for j in range(n):
        pivot = A[j, j]
        for k in range(j):
            pivot -= C[j, k] * C[j, k]
        if not pivot >= -DEFICIENT * abs(A[j, j]):
            return False
        C[j, j] = np.sqrt(pivot) if pivot > DEFICIENT * A[j, j] else 0.0
        for i in range(j + 1, n):
            C[j, i] = 0.0
            if C[j, j] == 0.0:
                C[i, j] = 0.0
            else:
                rest = A[i, j]
                for k in range(j):
                    rest -= C[i, k] * C[j, k]
                C[i, j] = rest / C[j, j]
    return True


@jitable
def definiteness(P: Any) -> int:
    """1 where P (n, n) is positive definite, 0 rank-deficient, -1 indefinite or not finite, judged on correlations."""
    return definiteness_with(P, np.empty(P.shape))


@jitable
def definiteness_with(P: Any, C: Any) -> int:
    """:func:`definiteness` of P (n, n), with ``C`` (n, n) as its workspace."""
    n = P.shape[0]
    deficient = False
    for j in range(n):
        if not (P[j, j] >= 0.0 and P[j, j] < np.inf):
            return -1
        pivot = P[j, j]
        for k in range(j):
            pivot -= C[j, k] * C[j, k]
        if not pivot >= -DEFICIENT * P[j, j]:
            return -1
        if pivot <= DEFICIENT * P[j, j] or P[j, j] <= ROUNDING:
            deficient = True
            for i in range(j, n):
                C[i, j] = 0.0
            continue
        C[j, j] = np.sqrt(pivot)
        for i in range(j + 1, n):
            rest = P[i, j]
            for k in range(j):
                rest -= C[i, k] * C[j, k]
            C[i, j] = rest / C[j, j]
    return 0 if deficient else 1
