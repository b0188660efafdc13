# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Stretches of a recording: what lies between gaps, as between two armings of a flight log.

Each is judged for itself: what was declared or suspected before is forgotten (``Pipeline.reset``), as an operator does
between two flights. Biases stay: the sensors are the same, and a fault that is still there is to be seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.block import Block

GAP = 10.0
"""Samples further apart than this are of two stretches, s. Shorter holes are part of one: messages were lost."""
HOLE = 1.0
"""A fault is not injected where samples are missing for longer than this while it is watched, s."""


class Stretches:
    """Cuts the blocks of a stream where a new stretch begins."""

    def __init__(self) -> None:
        self._last: int | None = None

    def cut(self, block: Block) -> Iterator[tuple[bool, Block]]:
        """Yield the parts of the next block, and of each whether a new stretch begins with it; never the first."""
        if not len(block):
            yield False, block
            return
        before = block.stamp[:1] if self._last is None else np.array([self._last])
        far = np.diff(np.concatenate([before, block.stamp])) > GAP * 1e9
        self._last = int(block.stamp[-1])
        edges = [0, *np.flatnonzero(far).tolist(), len(block)]
        for begin, end in pairwise(edges):
            if end > begin:
                yield bool(far[begin]), block[begin:end]


def pieces(stamp: NDArray[np.int64], longest: float = HOLE) -> list[slice]:
    """Return the rows of stamps (N,), ns, in pieces without an interval longer than this, s."""
    cuts = (np.flatnonzero(np.diff(stamp) > longest * 1e9) + 1).tolist()
    edges = [0, *cuts, len(stamp)]
    return [slice(begin, end) for begin, end in pairwise(edges) if end > begin]
