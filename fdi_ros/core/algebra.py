# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Small linear algebra for compiled code, over the first entries of arrays of fixed size."""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import compiled
from fdi_ros.model.samples import Array


@compiled
def along(axis: Array, vector: Array) -> float:
    """Component of a vector (3,) along an axis (3,)."""
    return axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2]


@compiled
def residual(value: float, axis: Array, vector: Array) -> float:
    """Value less the component of a vector (3,) along an axis (3,)."""
    return value - axis[0] * vector[0] - axis[1] * vector[1] - axis[2] * vector[2]


@compiled
def square(vector: Array) -> float:
    """Square of the length of a vector (3,)."""
    return along(vector, vector)


@compiled
def dot(row: Array, x: Array, n: int) -> float:
    """Sum of ``row[j] x[j]`` over the first n entries."""
    total = 0.0
    for j in range(n):
        total += row[j] * x[j]
    return total


@compiled
def dot_in(row: Array, x: Array, n: int, mask: int) -> float:
    """Sum of ``row[j] x[j]`` over the channels in mask; other entries of x may be NaN."""
    total = 0.0
    for j in range(n):
        if mask >> j & 1:
            total += row[j] * x[j]
    return total


@compiled
def variance_along(row: Array, variance: Array, n: int) -> float:
    """Variance of ``row' x`` for independent x of variances (n,)."""
    total = 0.0
    for j in range(n):
        total += row[j] * row[j] * variance[j]
    return total


@compiled
def quadratic(a: Array, x: Array, n: int) -> float:
    """Quadratic form ``x' A x`` of A (n, n) and x (n,)."""
    total = 0.0
    for i in range(n):
        for j in range(n):
            total += x[i] * a[i, j] * x[j]
    return total


@compiled
def factorise(a: Array, size: int, factor: Array) -> float:
    """Cholesky factor of a symmetric positive definite matrix; return the log of its determinant."""
    log = 0.0
    for i in range(size):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                # Rounding may leave less than zero of a singular matrix.
                factor[i, i] = math.sqrt(max(total, 1e-300))
                log += 2.0 * math.log(factor[i, i])
            else:
                factor[i, j] = total / factor[j, j]
    return log


@compiled
def invert(a: Array, size: int, out: Array) -> float:
    """Inverse of a symmetric positive definite matrix a (size, size), by Cholesky; return the log of its determinant.

    The lower triangle of a is read. ``out`` takes both triangles; on the way the
    factor, then its inverse.
    """
    log = factorise(a, size, out)
    for i in range(size):
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= out[i, k] * out[k, j]
            out[i, j] = total / out[i, i]
        out[i, i] = 1.0 / out[i, i]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += out[k, i] * out[k, j]
            out[i, j] = out[j, i] = total
    return log
