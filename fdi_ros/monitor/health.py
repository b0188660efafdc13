"""Checks of each channel by itself: finite, in range, delivering at all, and not the same value for too long.

A value that repeats is no defect by itself: a quantised sensor at rest repeats for minutes. It counts after a much
longer time, or against motion that the other channels see along this channel's axis (`stuck.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import ConfigError
from fdi_ros.settings import HealthConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]


class Condition(IntEnum):
    """What is wrong with one value by itself; the larger number wins."""

    FINE = 0
    MISSING = 1
    NON_FINITE = 2
    OUT_OF_RANGE = 3
    FROZEN = 4
    SILENT = 5
    NON_FINITE_LASTING = 6


LASTING = (Condition.FINE, Condition.SILENT, Condition.NON_FINITE_LASTING)
"""Conditions in which a channel may stay for good."""
_FINE, _MISSING, _SILENT = int(Condition.FINE), int(Condition.MISSING), int(Condition.SILENT)
_BROKEN = int(Condition.NON_FINITE_LASTING)
_KINDS = tuple(int(kind) for kind in Condition)


@dataclass
class Memory:
    """What the checks remember of the samples before, one value a channel."""

    value: Array
    """Last finite value delivered, rad/s; NaN before the first."""
    run_stamp: Stamps
    """When it was first seen."""
    received_stamp: Stamps
    """Last sample that the channel delivered."""
    bad_stamp: Stamps
    """Start of the present run of non-finite values; -1 if there is none."""

    def at(self, row: int) -> Memory:
        """Memory after one row of a trace."""
        return Memory(
            self.value[row].copy(),
            self.run_stamp[row].copy(),
            self.received_stamp[row].copy(),
            self.bad_stamp[row].copy(),
        )


@dataclass(frozen=True)
class Trace:
    """Result of the checks on N samples; nothing is remembered until `Health.commit`."""

    condition: NDArray[np.uint8]
    """(N, n) Condition of each value."""
    memory: Memory
    """Of every row, (N, n) each."""


class Health:
    """Checks of n channels.

    Parameters
    ----------
    config
        Limits and times.
    n
        Number of channels.
    """

    def __init__(self, config: HealthConfig, n: int) -> None:
        if len(config.max_rate) not in (1, n):
            raise ConfigError(f"health.max_rate has {len(config.max_rate)} values, expected 1 or {n} (one a channel)")
        self.max_rate = np.broadcast_to(np.array(config.max_rate), n).copy()
        self._non_finite_time = _nanoseconds(config.non_finite_time)
        self._rest_time = _nanoseconds(config.stuck_time_at_rest)
        self._stale_time = _nanoseconds(config.stale_timeout)
        self._soonest = min(
            [t for t in (_nanoseconds(config.stuck_time), self._rest_time) if t], default=np.iinfo(np.int64).max
        )
        self._none_bad = np.full(n, -1, dtype=np.int64)
        self._memory: Memory | None = None
        self.counts = np.zeros((len(Condition), n), dtype=np.int64)
        """(Condition, n): samples of each channel in each condition."""
        self._fine = self.counts[Condition.FINE]
        self.samples = np.zeros(n, dtype=np.int64)
        """(n,) samples delivered."""
        self.stuck = np.zeros(n, dtype=np.int64)
        """(n,) samples that repeated a value against the motion of the others."""

    @property
    def last_received(self) -> Stamps | None:
        """(n,) stamp of the last sample that each channel delivered, ns; None before the first."""
        return None if self._memory is None else self._memory.received_stamp

    def plain(self, z: Array, received: Mask) -> Mask:
        """(N, n): delivered, finite and in range; all that can be said without a prediction."""
        with np.errstate(invalid="ignore"):
            inside = np.abs(z) < self.max_rate
        return inside & received

    def continues(self, stamp: np.int64, z: Array, received: Mask | None, condition: NDArray[np.uint8]) -> bool:
        """Whether one sample (n,) finds every channel in the condition it was in, one of `LASTING`.

        True only where that can be said without a look at predictions; the sample is then for `pass_over`.
        """
        memory = self._memory
        if memory is None:
            return False
        if condition.any():
            fine, silent, broken = condition == _FINE, condition == _SILENT, condition == _BROKEN
            if received is None:
                received = np.ones(len(z), dtype=bool)
            if not (fine | silent | broken).all() or (received == silent).any() or np.isfinite(z[broken]).any():
                return False
            plain, still = np.abs(z[fine]) < self.max_rate[fine], (z == memory.value) & fine
        else:
            if received is not None and not received.all():
                return False
            plain, still = np.abs(z) < self.max_rate, z == memory.value
        heard = memory.received_stamp if not condition.any() else memory.received_stamp[condition != _SILENT]
        if not plain.all() or stamp - heard.min(initial=stamp) > self._stale_time:
            return False
        return not still.any() or bool((stamp - memory.run_stamp[still]).max() < self._soonest)

    def pass_over(self, stamp: np.int64, z: Array, condition: NDArray[np.uint8]) -> Mask:
        """Remember one sample (n,) that goes on as before; return the channels (n,) whose value is new."""
        memory = self._memory
        assert memory is not None
        now = np.full(len(z), stamp)
        if condition.any():
            fine, silent = condition == _FINE, condition == _SILENT
            changed = (z != memory.value) & fine
            heard, value = np.where(silent, memory.received_stamp, now), np.where(fine, z, memory.value)
            bad_stamp = memory.bad_stamp
            self.counts[condition, np.arange(len(z))] += 1
            self.samples += ~silent
        else:
            changed, heard, value, bad_stamp = z != memory.value, now, z.copy(), self._none_bad
            self._fine += 1
            self.samples += 1
        run_stamp = now if changed.all() else np.where(changed, stamp, memory.run_stamp)
        self._memory = Memory(value, run_stamp, heard, bad_stamp)
        return changed

    def inspect(self, stamp: Stamps, z: Array, received: Mask) -> Trace:
        """Check N samples without remembering them.

        Parameters
        ----------
        stamp, z, received
            As in `Block`.
        """
        before = self._memory or _fresh(stamp[0], z.shape[1])
        memory = self._follow(before, stamp, z, received)
        condition = np.zeros(z.shape, dtype=np.uint8)
        condition[~received] = Condition.MISSING
        finite = np.isfinite(z)
        condition[received & ~finite] = Condition.NON_FINITE
        with np.errstate(invalid="ignore"):
            condition[received & finite & (np.abs(z) >= self.max_rate)] = Condition.OUT_OF_RANGE
        now = stamp[:, None]
        repeated = now - memory.run_stamp
        if self._rest_time:
            condition[(repeated >= self._rest_time) & (condition == _FINE)] = Condition.FROZEN
        condition[now - memory.received_stamp > self._stale_time] = Condition.SILENT
        lasting = (memory.bad_stamp >= 0) & (now - memory.bad_stamp >= self._non_finite_time)
        condition[lasting & (condition == Condition.NON_FINITE)] = Condition.NON_FINITE_LASTING
        return Trace(condition, memory)

    def commit(self, trace: Trace, rows: int) -> None:
        """Remember the first rows of a trace."""
        self._memory = trace.memory.at(rows - 1)
        condition = trace.condition[:rows]
        if condition.any():
            for kind in _KINDS:
                self.counts[kind] += (condition == kind).sum(axis=0)
        else:
            self._fine += rows
        self.samples += rows - ((condition == _MISSING) | (condition == _SILENT)).sum(axis=0)

    def _follow(self, before: Memory, stamp: Stamps, z: Array, received: Mask) -> Memory:
        good = received & np.isfinite(z)
        rows = np.arange(len(z))[:, None]
        last_good = np.maximum.accumulate(np.where(good, rows, -1), axis=0)
        previous_good = np.vstack([np.full((1, z.shape[1]), -1), last_good[:-1]])
        previous = np.where(previous_good >= 0, np.take_along_axis(z, previous_good, axis=0), before.value)
        received_row = np.maximum.accumulate(np.where(received, rows, -1), axis=0)
        heard = np.where(received_row >= 0, stamp[received_row], before.received_stamp)
        # Across a hole nobody knows what the value was: a run begins anew.
        hole = stamp[:, None] - np.vstack([before.received_stamp[None], heard[:-1]]) > self._stale_time
        run_row = np.maximum.accumulate(np.where(good & ((z != previous) | hole), rows, -1), axis=0)
        return Memory(
            np.where(last_good >= 0, np.take_along_axis(z, last_good, axis=0), before.value),
            np.where(run_row >= 0, stamp[run_row], before.run_stamp),
            heard,
            _bad_since(before, stamp, received & ~good, last_good, rows),
        )


def _bad_since(before: Memory, stamp: Stamps, bad: Mask, last_good: NDArray[np.intp], rows: NDArray[np.intp]) -> Stamps:
    """Stamp of the first non-finite value after the last good one; missing samples neither start nor end a run."""
    carried = np.where(last_good >= 0, -1, before.bad_stamp)
    if not bad.any():
        return carried
    # The first bad row after the last good one: count bad rows, and look where the count since then becomes one.
    count = np.cumsum(bad, axis=0)
    base = np.where(last_good >= 0, np.take_along_axis(count, last_good, axis=0), 0)
    first = bad & (count - base == 1) & (carried < 0)
    first_row = np.maximum.accumulate(np.where(first, rows, -1), axis=0)
    return np.where((carried < 0) & (first_row > last_good), stamp[first_row], carried)


def _fresh(stamp: np.int64, n: int) -> Memory:
    at = np.full(n, stamp, dtype=np.int64)
    return Memory(np.full(n, np.nan), at, at.copy(), np.full(n, -1, dtype=np.int64))


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)
