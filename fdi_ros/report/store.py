"""Series of any length, made small for a page: few bytes a value, and no more values than a page may have."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.report.envelope import Envelope

Array = NDArray[np.float64]

BYTES = 600_000
"""Text that the series of a page may take."""
FINE, SMALL = "f4", "f2"
"""Kinds of a series: 24 bits, for values that are looked at against each other; 11 bits, 0.05 % of the value."""
LARGEST_HALF = 65504.0
_TEXT = 4 / 3  # characters of base64 per byte


class PageStore:
    """Series over one time, of which a page keeps all samples, or the extremes of spans of samples.

    Parameters
    ----------
    kinds
        Name and kind of each series.
    most_bytes
        Text that they may take.
    """

    def __init__(self, kinds: Mapping[str, str], most_bytes: int = BYTES) -> None:
        self.kinds = dict(kinds)
        size = 8 + sum(int(kind[1]) for kind in kinds.values())
        self._envelope = Envelope(len(kinds), max(200, int(most_bytes / _TEXT / size)), most_merged=True)

    @property
    def width(self) -> int:
        """Samples in one span."""
        return self._envelope.width

    def add(self, time: Array, columns: Sequence[Array]) -> None:
        """Take in the next samples: time (N,) s, and columns (N, any) that together hold every series in order."""
        values = np.column_stack(columns)
        self._envelope.add(time, np.where(np.isfinite(values), values, np.nan))

    def data(self) -> dict[str, Any]:
        """Return what the page's script reads."""
        time, low, high = self._envelope.spans()
        series = {}
        for k, (name, kind) in enumerate(self.kinds.items()):
            columns = [low[:, k], high[:, k]] if self.width > 1 else [low[:, k]]
            series[name] = (kind, _packed(np.column_stack(columns), kind))
        return {"time": _packed(time, "f8"), "width": self.width, "series": series}


def _packed(values: Array, kind: str) -> str:
    if kind == SMALL:
        values = np.clip(values, -LARGEST_HALF, LARGEST_HALF)
    return base64.b64encode(np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()).decode("ascii")
