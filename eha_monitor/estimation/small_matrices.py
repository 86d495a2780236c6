"""Products and solutions of small matrices, compiled: a few states and no more.

numba's own take longer to compile than all of the filter around them, and load scipy for BLAS.
Every matrix is a C-contiguous float64 array, so that each function is compiled once.
"""

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from eha_monitor.compiled import njit


@intrinsic(prefer_literal=True)
def on_stack(typing, rows, columns):
    """Return a scratch matrix, whose size is known when compiling, that costs no allocation.

    Nothing else can lie where it lies.  So the optimiser may keep its elements in registers once
    loops over it are unrolled, and code in loops runs like code written out in scalars.  It lives
    as long as the call, and is for functions with ``allocates=False``.
    """
    if not all(isinstance(size, types.IntegerLiteral) for size in (rows, columns)):
        return None
    shape = rows.literal_value, columns.literal_value
    kind = types.Array(types.float64, 2, "C")

    def generate(context, builder, signature, args):
        matrix, place = make_array(kind)(context, builder), ir.IntType(64)
        data = cgutils.alloca_once(builder, ir.DoubleType(), size=shape[0] * shape[1])
        populate_array(matrix, data=data, shape=[place(size) for size in shape],
                       strides=[place(8 * shape[1]), place(8)], itemsize=place(8), meminfo=None)
        return matrix._getvalue()

    return kind(rows, columns), generate


@njit
def times(a, b):
    """Return A B."""
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@njit
def times_transposed(a, b):
    """Return A B'."""
    out = np.zeros((a.shape[0], b.shape[0]))
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            for k in range(a.shape[1]):
                out[i, j] += a[i, k] * b[j, k]
    return out


@njit(forceinline=True, allocates=False)
def copied(to, row):
    """Write a vector into another; ``to[:] = row`` compiles a message for each pair of shapes."""
    for i in range(row.shape[0]):
        to[i] = row[i]


@njit
def transposed(a):
    """Return A' as an array of its own."""
    out = np.empty((a.shape[1], a.shape[0]))
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[j, i] = a[i, j]
    return out


@njit
def symmetric(a):
    """Return (A + A')/2."""
    out = np.empty((a.shape[0], a.shape[0]))
    for i in range(a.shape[0]):
        for j in range(a.shape[0]):
            out[i, j] = 0.5 * (a[i, j] + a[j, i])
    return out


@njit(allocates=False)
def add(a, b):
    """Add B to A in place."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            a[i, j] += b[i, j]


@njit
def solved(a, b):
    """Return A^-1 B by elimination with the largest pivot of each column; both are overwritten.

    Raises
    ------
    np.linalg.LinAlgError
        A is singular.
    """
    n = a.shape[0]
    for i in range(n):
        best = i
        for k in range(i + 1, n):
            if abs(a[k, i]) > abs(a[best, i]):
                best = k
        if a[best, i] == 0.0:
            raise np.linalg.LinAlgError("Matrix is singular to machine precision.")
        if best != i:
            for j in range(n):
                a[i, j], a[best, j] = a[best, j], a[i, j]
            for j in range(b.shape[1]):
                b[i, j], b[best, j] = b[best, j], b[i, j]
        for k in range(i + 1, n):
            factor = a[k, i] / a[i, i]
            for j in range(i + 1, n):
                a[k, j] -= factor * a[i, j]
            for j in range(b.shape[1]):
                b[k, j] -= factor * b[i, j]
    for i in range(n - 1, -1, -1):
        for j in range(b.shape[1]):
            for k in range(i + 1, n):
                b[i, j] -= a[i, k] * b[k, j]
            b[i, j] /= a[i, i]
    return b
