# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time alignment: form samples from the messages of 1 to 4 sensor units, by stamps.

All decisions follow from the stamps in order of arrival, without clock or timer.
Therefore a replayed recording gives the same samples as the live node. `enter` takes
one message; then `next_sample` returns the samples that this message completes, until
none is left.

Instant of a sample
    A sample is formed at the stamp of a message if no other sample lies between this
    message and the previous one of its unit. Thus samples have the rate of the fastest
    unit, whatever the phases of the others. At that stamp another unit contributes

    - its message within ``max_skew``, and nearer than half the message interval, as if
      measured at that instant, and only once;
    - or the linear interpolation between its messages before and after, if these are
      close enough (`MAX_BRIDGE`, `MAX_STEPS`);
    - or else no value: NaN, not received.

Waiting
    A sample is formed when every live unit has a message at its stamp or later. The
    wait lasts at most one message interval of the slowest unit. After a unit falls
    silent, the wait lasts once ``timeout``, by the stamps of the other units. It never
    lasts longer than `MAX_PENDING` messages.

Accepted stamps
    The common time is the newest stamp that two units have reached. A stamp belongs to
    the time base if it is at most ``timeout`` behind the common time, and is not ahead
    of all other units by more. With three or more units, a single clock that is fast,
    slow, random or jumps leaves the time base unchanged. With two units the newest
    stamp counts. If one of two falls behind by ``timeout`` without a jump, the other
    may be fast: until it comes back or a third unit delivers, samples have no values
    (`are_parted`). Only units that deliver are considered: a unit delivers until
    another has gone on for ``timeout`` since its last message.

Restart
    If all units leave the time base together (a clock set back, or a pause of the whole
    system), the time base moves. This needs every live unit within ``timeout`` of the
    others in the new base, or one unit that goes on there for ``timeout`` while no
    other delivers. After a step back, ``shift`` is added to the stamps of samples.

Delays from the configuration are subtracted before all this, and estimated delays
after it (`fdi_ros.core.restamping`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import MAX_UNITS, allocate, compiled
from fdi_ros.core.records import MAX_PENDING, RING, Aligner, Counters, Sample, Unit
from fdi_ros.errors import ConfigError
from fdi_ros.model.samples import Array, Block, Int

#: Longest interpolated span, as a share of the timeout.
MAX_BRIDGE = 0.25
#: Longest interpolated span, in usual message intervals: one lost message is bridged,
#: two are not.
MAX_STEPS = 2.5
#: Bound of accepted stamps, ns: greater than any stamp of an Imu, and small enough that
#: sums and differences of two stamps do not overflow.
MAX_STAMP = 1 << 61
_UNKNOWN = 1 << 62  # Step before the first message of a time base, ns.
_NONE, _ALL = -_UNKNOWN, _UNKNOWN  # Before and after all stamps, ns.
_IDLE, _FORMING, _RESTARTING = range(3)


# Messages in
# --------------------------------------------------------------------------------------------------------


@compiled
def enter(aligner: Aligner, j: int, stamp: int) -> None:
    """Enter a message of unit j with the stamp, ns.

    Its rate and specific force are those in the aligner. Afterwards `next_sample` must
    be called until it returns False.
    """
    if not 0 <= j < aligner.n:
        return
    unit = aligner.units[j]
    stamp -= unit.delay
    if not -MAX_STAMP < stamp < MAX_STAMP:
        return
    unit.counters.received += 1
    if not aligner.begun:
        aligner.begun = True
        aligner.common = stamp
    goes_on = 0 < stamp - unit.before <= aligner.timeout and not _is_silent(
        aligner, unit
    )
    unit.leapt |= unit.end > 0 and unit.before - stamp > aligner.timeout
    _pass_time(aligner, j, stamp)
    lag = aligner.common - stamp
    if (unit.end > 0 and stamp <= unit.newest) or _is_outside(aligner, j, stamp):
        unit.parted |= (
            goes_on and unit.end > 0 and lag > aligner.timeout and not unit.leapt
        )
        if _have_all_moved(aligner, j, stamp):
            aligner.phase = _RESTARTING
            aligner.force = _ALL
            aligner.moved_to = stamp
        return
    for i in range(aligner.n):
        aligner.units[i].off = False
    unit.lag = max(lag, 0)
    unit.parted = False
    unit.leapt = False
    _accept(aligner, unit, stamp, aligner.rate, aligner.felt)
    if aligner.formed and stamp <= aligner.last:
        unit.counters.late += 1
        unit.begin = unit.end
        return
    aligner.phase = _FORMING
    aligner.force = _NONE
    if unit.end - unit.begin > MAX_PENDING:
        aligner.force = unit.messages[(unit.begin + 1) % RING].stamp


@compiled
def is_live(aligner: Aligner, j: int) -> bool:
    """Return whether unit j has delivered within the timeout, by the stamps of the others.

    Samples wait only for live units.
    """
    unit = aligner.units[j]
    behind = unit.end > 0 and aligner.common - unit.newest > aligner.timeout
    return not behind and not _is_silent(aligner, unit)


@compiled
def are_parted(aligner: Aligner) -> bool:
    """Return whether the clocks of the only two units that deliver differ by more than the timeout."""
    believed = 0
    parted = False
    for j in range(aligner.n):
        believed += aligner.units[j].end > 0 and is_live(aligner, j)
        parted = parted or aligner.units[j].parted
    return parted and believed == 1


@compiled
def _is_silent(aligner: Aligner, unit: Unit) -> bool:
    """Return whether another unit has gone on for the timeout since the unit's last message."""
    longest = 0
    for k in range(aligner.n):
        longest = max(longest, unit.passed[k])
    return longest > aligner.timeout


@compiled
def _pass_time(aligner: Aligner, j: int, stamp: int) -> None:
    """Measure by a stamp of unit j how long the other units have been silent.

    A step of more than the timeout is a jump and is not counted.
    """
    unit = aligner.units[j]
    step = stamp - unit.before
    if unit.heard and 0 < step <= aligner.timeout:
        for k in range(aligner.n):
            if k != j:
                aligner.units[k].passed[j] += step
    unit.heard = True
    unit.before = stamp
    _find_common_time(aligner)


@compiled
def _find_common_time(aligner: Aligner) -> None:
    """Set the common time: the newest stamp that two units have reached.

    While at most two units deliver, the common time is the newest stamp.
    """
    deliver = 0
    newest = _NONE
    second = _NONE
    for j in range(aligner.n):
        unit = aligner.units[j]
        if unit.end > 0 and not _is_silent(aligner, unit):
            deliver += 1
            second = max(second, min(newest, unit.newest))
            newest = max(newest, unit.newest)
    if deliver:
        aligner.common = second if deliver > 2 else newest


@compiled
def _is_ahead(aligner: Aligner, j: int, stamp: int) -> bool:
    """Return whether a stamp of unit j is ahead of the time base.

    With two or more other units that deliver, the stamp must be ahead of each. The time
    of another unit is its last stamp plus the time since, by the stamps of unit j.
    """
    others = near = 0
    for k in range(aligner.n):
        unit = aligner.units[k]
        if k != j and unit.end > 0 and not _is_silent(aligner, unit):
            others += 1
            ahead = stamp - unit.newest - unit.passed[j]
            near += 1 if ahead <= aligner.timeout else 0
    return near == 0 if others > 1 else stamp - aligner.common > aligner.timeout


@compiled
def _is_outside(aligner: Aligner, j: int, stamp: int) -> bool:
    """Return whether a stamp of unit j is outside the time base."""
    return aligner.common - stamp > aligner.timeout or _is_ahead(aligner, j, stamp)


@compiled
def _accept(
    aligner: Aligner, unit: Unit, stamp: int, rate: Array, force: Array
) -> None:
    """Add a message to the waiting messages of its unit."""
    step = stamp - unit.newest if unit.end > 0 else _UNKNOWN
    message = unit.messages[unit.end % RING]
    message.stamp = stamp
    message.step = step
    message.bridges = step <= aligner.bridge and step <= MAX_STEPS * max(
        unit.usual[0], unit.usual[1]
    )
    for a in range(3):
        message.rate[a] = rate[a]
        message.force[a] = force[a]
    unit.usual[0] = unit.usual[1]
    unit.usual[1] = step
    unit.newest = stamp
    unit.end += 1
    for k in range(aligner.n):
        unit.passed[k] = 0
    _find_common_time(aligner)


@compiled
def _have_all_moved(aligner: Aligner, j: int, stamp: int) -> bool:
    """Record a refused stamp, and return whether the time base has moved.

    This is so if all live units have left the time base, or most of them and none of
    these was ever in it.
    """
    unit = aligner.units[j]
    timeout = aligner.timeout
    _count_refused(unit, stamp, aligner.common)
    if (unit.end > 0 and stamp == unit.newest) or not _is_outside(aligner, j, stamp):
        unit.off = False
        return False
    if not unit.off or not 0 <= stamp - unit.off_last <= timeout:
        unit.off_first = stamp
    unit.off = True
    unit.off_last = stamp
    for a in range(3):
        unit.off_rate[a] = aligner.rate[a]
        unit.off_force[a] = aligner.felt[a]
    here = 0
    there = 0
    new = True
    for i in range(aligner.n):
        if is_live(aligner, i) and _stands_at(aligner, aligner.units[i], stamp):
            there += 1
            new = new and aligner.units[i].end == 0
        elif is_live(aligner, i):
            here += 1
    if here:
        # The first stamp received defines the time base, even if most units have another.
        return here < there and new
    return there > 1 or stamp - unit.off_first >= timeout


@compiled
def _count_refused(unit: Unit, stamp: int, common: int) -> None:
    """Count a stamp that is not newer than the last of its unit, or is outside the time base."""
    if unit.end > 0 and stamp == unit.newest:
        unit.counters.duplicate += 1
    elif unit.end > 0 and stamp < unit.newest:
        unit.counters.backward += 1
    elif stamp > common:
        unit.counters.jumped += 1
    else:
        unit.counters.late += 1
        unit.lag = common - stamp


@compiled
def _stands_at(aligner: Aligner, unit: Unit, stamp: int) -> bool:
    """Return whether the refused stamps of a unit are near a stamp outside the time base."""
    return unit.off and abs(unit.off_last - stamp) <= aligner.timeout


@compiled
def _restart(aligner: Aligner) -> None:
    """Begin a new time base with the messages that have shown the move."""
    stamp = aligner.moved_to
    newest = aligner.common
    for j in range(aligner.n):
        if aligner.units[j].end > 0:
            newest = max(newest, aligner.units[j].newest)
    # Every later sample must be newer than the newest message of the old base.
    aligner.shift = max(stamp, newest + aligner.shift + 2 * aligner.timeout + 1) - stamp
    aligner.common = stamp
    aligner.restarts += 1
    aligner.formed = False
    aligner.phase = _FORMING
    aligner.force = _NONE
    for j in range(aligner.n):
        unit = aligner.units[j]
        unit.begin = unit.end = unit.used = unit.usual[0] = unit.usual[1] = 0
        for k in range(aligner.n):
            unit.passed[k] = 0
        unit.parted = unit.leapt = False
        if _stands_at(aligner, unit, stamp):
            unit.lag = max(stamp - unit.off_last, 0)
            _accept(aligner, unit, unit.off_last, unit.off_rate, unit.off_force)
        unit.off = False


# Samples out
# --------------------------------------------------------------------------------------------------------


@compiled
def next_sample(aligner: Aligner, sample: Sample) -> bool:
    """Form the next complete sample. Return False if it needs another message."""
    if aligner.phase == _IDLE:
        return False
    if _form(aligner, sample):
        return True
    if aligner.phase == _RESTARTING:
        _restart(aligner)
        if _form(aligner, sample):
            return True
    aligner.phase = _IDLE
    return False


@compiled
def _form(aligner: Aligner, sample: Sample) -> bool:
    stamp, step = _anchor(aligner)
    if step == 0:
        return False
    if stamp > aligner.force:
        for j in range(aligner.n):
            if not _has_delivered(aligner, j, stamp, step):
                return False
    sample.stamp = stamp + aligner.shift
    sample.shift = aligner.shift
    parted = are_parted(aligner)
    for j in range(aligner.n):
        _add(aligner, j, stamp, step, sample)
        for a in range(3):
            if parted:
                i = 3 * j + a
                sample.z[i] = math.nan
                sample.received[i] = False
                sample.force[i] = math.nan
                sample.felt[i] = False
    aligner.formed = True
    aligner.last = stamp
    return True


@compiled
def _anchor(aligner: Aligner) -> tuple[int, int]:
    """Return stamp and step, ns, of the message at which the next sample is formed.

    This is the earliest message for which no sample lies between itself and the
    previous one of its unit. The step is 0 if no message qualifies.
    """
    stamp = _ALL
    step = 0
    for j in range(aligner.n):
        unit = aligner.units[j]
        # Of each unit only the first two waiting messages can qualify, because samples
        # have not passed the first one.
        for k in range(unit.begin, min(unit.begin + 2, unit.end)):
            message = unit.messages[k % RING]
            if not aligner.formed or message.stamp - message.step >= aligner.last:
                if message.stamp < stamp:
                    stamp = message.stamp
                    step = message.step
                break
    return stamp, step


@compiled
def _has_delivered(aligner: Aligner, j: int, stamp: int, step: int) -> bool:
    """Return whether a sample at the anchor's stamp need not wait for unit j."""
    unit = aligner.units[j]
    if (unit.end > 0 and unit.newest >= stamp) or not is_live(aligner, j):
        return True
    return _match(unit, _after(unit, stamp), stamp, step, aligner.max_skew) >= 0


@compiled
def _add(aligner: Aligner, j: int, stamp: int, step: int, sample: Sample) -> None:
    """Write the values of unit j at the anchor's stamp into a sample."""
    unit = aligner.units[j]
    after = _after(unit, stamp)
    match = _match(unit, after, stamp, step, aligner.max_skew)
    before = unit.messages[(after - 1) % RING]
    message = unit.messages[after % RING]
    passed = stamp
    received = True
    if match >= 0:
        message = unit.messages[match % RING]
        unit.used = match + 1
        passed = max(stamp, message.stamp)
        for a in range(3):
            sample.z[3 * j + a] = message.rate[a]
            sample.force[3 * j + a] = message.force[a]
    elif 0 < after < unit.end and message.bridges and before.stamp <= stamp:
        unit.counters.interpolated += 1
        share = (stamp - before.stamp) / message.step
        for a in range(3):
            sample.z[3 * j + a] = before.rate[a] + share * (
                message.rate[a] - before.rate[a]
            )
            sample.force[3 * j + a] = before.force[a] + share * (
                message.force[a] - before.force[a]
            )
    else:
        unit.counters.missing += 1
        received = False
        for a in range(3):
            sample.z[3 * j + a] = sample.force[3 * j + a] = math.nan
    felt = has_force(sample.force, 3 * j)
    for a in range(3):
        sample.received[3 * j + a] = received
        sample.felt[3 * j + a] = felt
    while unit.begin < unit.end and unit.messages[unit.begin % RING].stamp <= passed:
        unit.begin += 1


@compiled
def has_force(force: Array, start: int) -> bool:
    """Return whether the three values from ``start`` on contain a specific force.

    Where a message has none, all three are NaN.
    """
    missing = 0
    for a in range(3):
        missing += math.isnan(force[start + a])
    return missing < 3


@compiled
def _after(unit: Unit, stamp: int) -> int:
    """Return the number of the unit's first waiting message after a stamp.

    At most two messages wait before an anchor, so the search is short.
    """
    k = unit.begin
    while k < unit.end and unit.messages[k % RING].stamp <= stamp:
        k += 1
    return k


@compiled
def _match(unit: Unit, after: int, stamp: int, step: int, max_skew: int) -> int:
    """Return the number of the message that counts as measured at the anchor, or -1."""
    for k in range(after, max(unit.used, after - 1) - 1, -1):
        message = unit.messages[k % RING]
        apart = abs(message.stamp - stamp)
        # Less than half a step away: otherwise the message after a lost one would match.
        is_near = apart <= max_skew and 2 * apart < min(message.step, step)
        if k < unit.end and is_near:
            return k
    return -1


# Many messages
# ------------------------------------------------------------------------------------------------------


@compiled
def align_messages(
    rows: NDArray[Any],
    unit: Int,
    stamp: Int,
    values: Array,
    start: int,
    samples: NDArray[Any],
) -> tuple[int, int]:
    """Enter messages in order of arrival until they end or the samples (S,) are full.

    Parameters
    ----------
    rows
        The `Aligner`, (1,).
    unit, stamp
        Unit, and stamp in ns, of each message, (M,).
    values
        Rate, rad/s, and specific force, m/s^2, of each message, (M, 6).
    start
        Number of the first message to enter.
    samples
        Receives the samples, (S,).

    Returns
    -------
    tuple
        Number of the next message to enter, and number of samples formed. With fewer
        than S samples, all messages were entered.
    """
    aligner = rows[0]
    count = 0
    while count < len(samples):
        if next_sample(aligner, samples[count]):
            count += 1
        elif start < len(stamp):
            for a in range(3):
                aligner.rate[a] = values[start, a]
                aligner.felt[a] = values[start, 3 + a]
            enter(aligner, unit[start], stamp[start])
            start += 1
        else:
            break
    return start, count


class Alignment:
    """Aligns the messages of a number of units.

    Parameters
    ----------
    units
        Number of units.
    max_skew
        Stamps that differ by at most this much count as one instant, ns.
    timeout
        Samples do not wait for a unit that is silent for longer than this, ns.
    delays
        Delay of the stamps of each unit, s, (units,). Empty: no delays.

    Raises
    ------
    ConfigError
        If a value is out of bounds, or if there are not as many delays as units.
    """

    def __init__(
        self, units: int, max_skew: int, timeout: int, delays: Sequence[float] = ()
    ) -> None:
        if not (
            1 <= units <= MAX_UNITS
            and 0 <= max_skew <= 10**13
            and 1 <= timeout <= 10**13
        ):
            raise ConfigError(
                f"cannot align {units} triads with skew {max_skew} ns and timeout {timeout} ns"
            )
        if len(delays) not in (0, units):
            raise ConfigError(
                f"cannot align {units} triads with {len(delays)} delays, expected one each, or none"
            )
        self.units, self.rows = units, allocate(Aligner)  # the record, (1,)
        row = self.rows[0]
        row["n"] = units
        row["max_skew"] = max_skew
        row["timeout"] = timeout
        row["bridge"] = int(MAX_BRIDGE * timeout)
        delays_ns = [round(1e9 * delay) for delay in delays]
        row["units"]["delay"][: len(delays)] = delays_ns

    def push(self, unit: int, stamp: int, rate: Sequence[float]) -> NDArray[Any]:
        """Enter one message and return the samples that it completes, (S,) `Sample`.

        S is mostly 0 or 1.
        """
        return self._aligned(
            np.array([unit]),
            np.array([stamp]),
            np.array([rate], dtype=np.float64).reshape(1, -1),
        )

    def push_block(self, unit: Int, stamp: Int, values: Array) -> Block:
        """Enter recorded messages in order of arrival and return their samples.

        Parameters
        ----------
        unit, stamp
            Unit, and stamp in ns, of each message, (M,).
        values
            Rates, rad/s, (M, 3). Or (M, 6) with the specific force, m/s^2, in the last
            three columns, which are NaN where a message has none.
        """
        return as_block(self._aligned(unit, stamp, values), self.units)

    def flush(self) -> NDArray[Any]:
        """Return the remaining samples at the end of a recording, (S,) `Sample`."""
        self.rows["phase"] = _FORMING
        self.rows["force"] = _ALL
        none = np.empty(0, dtype=np.int64)
        return self._aligned(none, none, np.empty((0, 6)))

    def is_live(self, unit: int) -> bool:
        """Return whether samples wait for a unit."""
        return bool(is_live(self.rows[0], unit))

    @property
    def are_parted(self) -> bool:
        """Whether the clocks of the only two units that deliver differ too much."""
        return bool(are_parted(self.rows[0]))

    @property
    def counters(self) -> tuple[dict[str, int], ...]:
        """Counters of each unit, by name."""
        rows = self.rows["units"]["counters"][0, : self.units]
        return tuple(
            {name: int(row[name]) for name in Counters.__annotations__} for row in rows
        )

    @property
    def lag(self) -> list[int]:
        """By how much the last message of each unit was behind the common time, ns."""
        return list(self.rows["units"]["lag"][0, : self.units].tolist())

    @property
    def shift(self) -> int:
        """Offset added to the stamps of samples, ns.

        0 before the first move of the time base. Chosen anew at each move, so that
        later samples are newer than all earlier messages.
        """
        return int(self.rows["shift"][0])

    def _aligned(self, unit: Int, stamp: Int, values: Array) -> NDArray[Any]:
        if values.shape[1] == 3:
            values = np.hstack([values, np.full_like(values, np.nan)])
        parts = []
        start = 0
        while True:
            samples = allocate(Sample, min(len(stamp) - start + 64, 8192))
            start, count = align_messages(
                self.rows, unit, stamp, values, start, samples
            )
            parts.append(samples[:count])
            if count < len(samples):
                return parts[0] if len(parts) == 1 else np.concatenate(parts)


def as_block(samples: NDArray[Any], units: int) -> Block:
    """Return a block of samples, (S,) `Sample`.

    The block contains accelerations if any sample has one.
    """
    stamp = samples["stamp"].copy()
    n = 3 * units

    def half(values: str, there: str) -> Block:
        received = samples[there][:, :n].astype(np.bool_)
        z = samples[values][:, :n].copy()
        return Block(stamp, z, None if received.all() else received)

    block = half("z", "received")
    felt = samples["felt"][:, :n].any()
    return replace(block, acceleration=half("force", "felt")) if felt else block
