# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Series of any length, made small for a page: few bytes per value, and no more values than a page may have."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdi_ros.arrays import Array

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

    def shows(self, name: str) -> bool:
        """Whether a series has any value."""
        column = list(self.kinds).index(name)
        return bool(np.isfinite(self._envelope.spans()[1][:, column]).any())

    def data(self) -> dict[str, Any]:
        """Return what the page's script reads."""
        time, low, high = self._envelope.spans()
        series = {}
        for k, (name, kind) in enumerate(self.kinds.items()):
            columns = [low[:, k], high[:, k]] if self.width > 1 else [low[:, k]]
            series[name] = (kind, _packed(np.column_stack(columns), kind))
        return {"time": _packed(time, "f8"), "width": self.width, "series": series}


class Envelope:
    """Minimum and maximum of c series over spans of samples; memory does not grow.

    When there are too many spans, neighbours are put together and the next spans are twice as long.

    Parameters
    ----------
    columns
        Number of series c.
    most
        Spans kept at most.
    most_merged
        Half of them once samples are put together: a span of several samples is two values, of one it is one.
    """

    def __init__(self, columns: int, most: int, most_merged: bool = False) -> None:
        self.most = most
        self._most_merged = most // 2 if most_merged else most
        self.width = 1
        """Samples in a new span."""
        self._time = np.empty(0)
        self._low = np.empty((0, columns))
        self._high = np.empty((0, columns))
        self._waiting = (np.empty(0), np.empty((0, columns)))

    def add(self, time: Array, values: Array) -> None:
        """Take in the next samples: time (N,) s, values (N, c); NaN is nothing."""
        time, values = np.concatenate([self._waiting[0], time]), np.vstack([self._waiting[1], values])
        whole = len(time) // self.width * self.width
        self._waiting = time[whole:], values[whole:]
        if whole:
            self._store(time[: whole : self.width], values[:whole], values[:whole], self.width)
        while len(self._time) > (self.most if self.width == 1 else self._most_merged):
            time, low, high = self._time, self._low, self._high
            self._time, self._low, self._high = time[:0], low[:0], high[:0]
            even = len(time) // 2 * 2
            self._store(time[:even:2], low[:even], high[:even], 2)
            self._store(time[even:], low[even:], high[even:], 1)
            self.width *= 2

    def spans(self) -> tuple[Array, Array, Array]:
        """Return what there is: time of the first sample (k,), smallest and largest values (k, c)."""
        time, values = self._waiting
        if len(time) == 0:
            return self._time, self._low, self._high
        low, high = _extremes(values, values, len(time))
        return np.append(self._time, time[:1]), np.vstack([self._low, low]), np.vstack([self._high, high])

    def _store(self, time: Array, low: Array, high: Array, together: int) -> None:
        low, high = _extremes(low, high, together)
        self._time = np.concatenate([self._time, time])
        self._low, self._high = np.vstack([self._low, low]), np.vstack([self._high, high])


def _packed(values: Array, kind: str) -> str:
    if kind == SMALL:
        values = np.clip(values, -LARGEST_HALF, LARGEST_HALF)
    return base64.b64encode(np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()).decode("ascii")


def _extremes(low: Array, high: Array, together: int) -> tuple[Array, Array]:
    """Smallest and largest of every `together` rows; NaN only where all are."""
    shape = (-1, together, low.shape[1])
    return np.fmin.reduce(low.reshape(shape), axis=1), np.fmax.reduce(high.reshape(shape), axis=1)
