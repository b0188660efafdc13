"""Products of a small matrix with every row of a block, equal to the last bit for every block length.

BLAS picks its kernel, and with it the order of the sums, by the size of the operands: the same sample
would get another rounding alone than within a block, and a verdict could depend on how a stream was cut.
Here the terms are always added in channel order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def transform(transposed: Array, rows: Array) -> Array:
    """Multiply every row by a matrix that is given transposed.

    Parameters
    ----------
    transposed
        Matrix, transposed, (n, k).
    rows
        Block of rows, (N, n).

    Returns
    -------
    rows @ transposed, (N, k). For N > 1 in column-major order, so that per-channel work stays contiguous.
    """
    if len(rows) == 1:
        return np.add.accumulate(transposed * rows.T, axis=0)[-1:]
    columns = np.ascontiguousarray(rows.T)
    total = transposed[0][:, None] * columns[0]
    for j in range(1, len(columns)):
        total += transposed[j][:, None] * columns[j]
    return total.T


def row_sum(rows: Array) -> Array:
    """Sum along each row in channel order: (N, k) to (N,)."""
    if len(rows) == 1:
        return np.add.accumulate(rows[0])[-1:]
    total = rows[:, 0].copy()
    for j in range(1, rows.shape[1]):
        total += rows[:, j]
    return total
