# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time alignment: messages of 1 to 4 sensor units to samples, by their stamps.

Decisions come from stamps in arrival order alone: no clock and no timer, so that a
recording played through it gives the samples that the live node formed. One message is
entered, then the samples that it completes are taken out one by one: `enter`, then
`next_sample` until there is none.

Where a sample is formed: at the stamp of a message, if there is none between it and the
message before of the same unit. So samples come at the rate of the fastest unit,
whatever the phases. What the other units give at that stamp:

- a message within ``max_skew`` (and nearer than half the message interval) counts as of
  that instant, as it is, once;
- else the line between the messages before and after, if they are near enough
  (`MAX_BRIDGE`, `MAX_STEPS`);
- else nothing: NaN, not received.

A sample is formed as soon as every live unit has delivered for its stamp, or beyond.
The wait is at most the message interval of the slowest unit; if one falls silent,
``timeout`` by the stamps of the others, once; and never longer than `MAX_PENDING`
messages.

Which stamps are accepted: a stamp belongs to the common time base if it is at most
``timeout`` behind the common time, the newest stamp that two units have reached, and
not ahead of all other units by more. So of three units or more, one whose clock is
fast, slow, jumps or is random leaves the base alone; of two, the newest counts, but
where one falls behind by ``timeout`` without a jump the other may be fast. Until it
comes back, or a third delivers, neither is believed: samples are formed, without values
(`are_parted`). Only units that deliver count: one does until another has gone on for
``timeout`` since its last message. When all leave the base together (a clock set back,
a pause of the whole system) it has moved. That is accepted once every live unit stands
within ``timeout`` of the others there, or one has gone on there for ``timeout`` while
no other delivered. After a step back, ``shift`` is added to the stamps of samples.

Delays that are set are taken off before all of this; estimated ones after it
(`fdi_ros.core.restamping`).
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

# longest span that is interpolated, over the timeout: a unit that lost four messages is
# hardly there
MAX_BRIDGE = 0.25
MAX_STEPS = (
    2.5  # and in usual message intervals: one lost message is bridged, two are not
)
MAX_STAMP = (
    1 << 61
)  # ns: beyond all that an Imu can carry, and no sum or difference of two overflows
_UNKNOWN = 1 << 62  # step before the first message of a time base, ns
_NONE, _ALL = -_UNKNOWN, _UNKNOWN  # before and after all stamps, ns
_IDLE, _FORMING, _RESTARTING = range(3)


# Messages in
# --------------------------------------------------------------------------------------------------------


@compiled
def enter(aligner: Aligner, j: int, stamp: int) -> None:
    """Take a message of unit j, rate and felt force of the aligner at stamp, ns; then take out its samples."""
    if not 0 <= j < aligner.n:
        return
    unit = aligner.units[j]
    stamp -= unit.delay
    if not -MAX_STAMP < stamp < MAX_STAMP:
        return
    unit.counters.received += 1
    if not aligner.begun:
        aligner.begun, aligner.common = True, stamp
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
            aligner.phase, aligner.force, aligner.moved_to = _RESTARTING, _ALL, stamp
        return
    for i in range(aligner.n):
        aligner.units[i].off = False
    unit.lag, unit.parted, unit.leapt = max(lag, 0), False, False
    _accept(aligner, unit, stamp, aligner.rate, aligner.felt)
    if aligner.formed and stamp <= aligner.last:
        unit.counters.late += 1
        unit.begin = unit.end
        return
    aligner.phase, aligner.force = _FORMING, _NONE
    if unit.end - unit.begin > MAX_PENDING:
        aligner.force = unit.messages[(unit.begin + 1) % RING].stamp


@compiled
def is_live(aligner: Aligner, j: int) -> bool:
    """Whether unit j has delivered within the timeout, by the stamps of the others: if not, it is not waited for."""
    unit = aligner.units[j]
    behind = unit.end > 0 and aligner.common - unit.newest > aligner.timeout
    return not behind and not _is_silent(aligner, unit)


@compiled
def are_parted(aligner: Aligner) -> bool:
    """Whether the clocks of the only two units that deliver went apart by more than the timeout, whichever is wrong."""
    believed, parted = 0, False
    for j in range(aligner.n):
        believed += aligner.units[j].end > 0 and is_live(aligner, j)
        parted = parted or aligner.units[j].parted
    return parted and believed == 1


@compiled
def _is_silent(aligner: Aligner, unit: Unit) -> bool:
    """Whether another unit has gone on for the timeout since the last message of this one."""
    longest = 0
    for k in range(aligner.n):
        longest = max(longest, unit.passed[k])
    return longest > aligner.timeout


@compiled
def _pass_time(aligner: Aligner, j: int, stamp: int) -> None:
    """Note by a stamp of unit j for how long the others have been silent; a step beyond the timeout is a jump."""
    unit = aligner.units[j]
    step = stamp - unit.before
    if unit.heard and 0 < step <= aligner.timeout:
        for k in range(aligner.n):
            if k != j:
                aligner.units[k].passed[j] += step
    unit.heard, unit.before = True, stamp
    _find_common_time(aligner)


@compiled
def _find_common_time(aligner: Aligner) -> None:
    """Take the newest stamp that two units have reached; while no more than two deliver, the newest."""
    deliver, newest, second = 0, _NONE, _NONE
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
    """Whether a stamp of unit j is ahead of the time base: of every other unit that delivers, where these are two.

    Each is as far as its last message and what has passed since, by the stamps of unit j.
    """
    others = near = 0
    for k in range(aligner.n):
        unit = aligner.units[k]
        if k != j and unit.end > 0 and not _is_silent(aligner, unit):
            others += 1
            near += 1 if stamp - unit.newest - unit.passed[j] <= aligner.timeout else 0
    return near == 0 if others > 1 else stamp - aligner.common > aligner.timeout


@compiled
def _is_outside(aligner: Aligner, j: int, stamp: int) -> bool:
    """Whether a stamp of unit j is outside of the time base."""
    return aligner.common - stamp > aligner.timeout or _is_ahead(aligner, j, stamp)


@compiled
def _accept(
    aligner: Aligner, unit: Unit, stamp: int, rate: Array, force: Array
) -> None:
    """Let a message wait."""
    step = stamp - unit.newest if unit.end > 0 else _UNKNOWN
    message = unit.messages[unit.end % RING]
    message.stamp, message.step = stamp, step
    message.bridges = step <= aligner.bridge and step <= MAX_STEPS * max(
        unit.usual[0], unit.usual[1]
    )
    for a in range(3):
        message.rate[a], message.force[a] = rate[a], force[a]
    unit.usual[0], unit.usual[1] = unit.usual[1], step
    unit.newest = stamp
    unit.end += 1
    for k in range(aligner.n):
        unit.passed[k] = 0
    _find_common_time(aligner)


@compiled
def _have_all_moved(aligner: Aligner, j: int, stamp: int) -> bool:
    """Note a refused stamp; return whether all units have left the time base, or most if these were never in it."""
    unit, timeout = aligner.units[j], aligner.timeout
    _count_refused(unit, stamp, aligner.common)
    if (unit.end > 0 and stamp == unit.newest) or not _is_outside(aligner, j, stamp):
        unit.off = False
        return False
    if not unit.off or not 0 <= stamp - unit.off_last <= timeout:
        unit.off_first = stamp
    unit.off, unit.off_last = True, stamp
    for a in range(3):
        unit.off_rate[a], unit.off_force[a] = aligner.rate[a], aligner.felt[a]
    here, there, new = 0, 0, True
    for i in range(aligner.n):
        if is_live(aligner, i) and _stands_at(aligner, aligner.units[i], stamp):
            there += 1
            new = new and aligner.units[i].end == 0
        elif is_live(aligner, i):
            here += 1
    if here:
        # The first stamp of all makes a base: most units may have another one from the start.
        return here < there and new
    return there > 1 or stamp - unit.off_first >= timeout


@compiled
def _count_refused(unit: Unit, stamp: int, common: int) -> None:
    """Count a stamp that is no newer than the last of its unit, or outside the time base."""
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
    """Whether a unit stands near a stamp outside the time base."""
    return unit.off and abs(unit.off_last - stamp) <= aligner.timeout


@compiled
def _restart(aligner: Aligner) -> None:
    """Begin the time base anew with the messages that showed that it has moved."""
    stamp, newest = aligner.moved_to, aligner.common
    for j in range(aligner.n):
        if aligner.units[j].end > 0:
            newest = max(newest, aligner.units[j].newest)
    # No sample from now on can be as old as the newest message of the old base.
    aligner.shift = max(stamp, newest + aligner.shift + 2 * aligner.timeout + 1) - stamp
    aligner.common = stamp
    aligner.restarts += 1
    aligner.formed = False
    aligner.phase, aligner.force = _FORMING, _NONE
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
    """Form the next sample that is complete; False if there is none before the next message."""
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
    sample.stamp, sample.shift = stamp + aligner.shift, aligner.shift
    parted = are_parted(aligner)
    for j in range(aligner.n):
        _add(aligner, j, stamp, step, sample)
        for a in range(3):
            if parted:
                i = 3 * j + a
                sample.z[i], sample.received[i] = math.nan, False
                sample.force[i], sample.felt[i] = math.nan, False
    aligner.formed, aligner.last = True, stamp
    return True


@compiled
def _anchor(aligner: Aligner) -> tuple[int, int]:
    """Return stamp and step of the earliest message without a sample between it and the one before; step 0: none."""
    stamp, step = _ALL, 0
    for j in range(aligner.n):
        unit = aligner.units[j]
        # If not the first that waits, then the second: samples have not passed the first.
        for k in range(unit.begin, min(unit.begin + 2, unit.end)):
            message = unit.messages[k % RING]
            if not aligner.formed or message.stamp - message.step >= aligner.last:
                if message.stamp < stamp:
                    stamp, step = message.stamp, message.step
                break
    return stamp, step


@compiled
def _has_delivered(aligner: Aligner, j: int, stamp: int, step: int) -> bool:
    """Whether unit j need not be waited for to form a sample at the anchor's stamp."""
    unit = aligner.units[j]
    if (unit.end > 0 and unit.newest >= stamp) or not is_live(aligner, j):
        return True
    return _match(unit, _after(unit, stamp), stamp, step, aligner.max_skew) >= 0


@compiled
def _add(aligner: Aligner, j: int, stamp: int, step: int, sample: Sample) -> None:
    """Put into a sample at the anchor's stamp what unit j gives there."""
    unit = aligner.units[j]
    after = _after(unit, stamp)
    match = _match(unit, after, stamp, step, aligner.max_skew)
    before, message = unit.messages[(after - 1) % RING], unit.messages[after % RING]
    passed, received = stamp, True
    if match >= 0:
        message = unit.messages[match % RING]
        unit.used, passed = match + 1, max(stamp, message.stamp)
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
    """Whether three values from a place on are a specific force: one that is not there is NaN on all axes."""
    missing = 0
    for a in range(3):
        missing += math.isnan(force[start + a])
    return missing < 3


@compiled
def _after(unit: Unit, stamp: int) -> int:
    """Return the number of the first message that waits and is beyond a stamp; an anchor has at most two before."""
    k = unit.begin
    while k < unit.end and unit.messages[k % RING].stamp <= stamp:
        k += 1
    return k


@compiled
def _match(unit: Unit, after: int, stamp: int, step: int, max_skew: int) -> int:
    """Return the number of the message that counts as of the anchor's instant, -1 if there is none."""
    for k in range(after, max(unit.used, after - 1) - 1, -1):
        message = unit.messages[k % RING]
        apart = abs(message.stamp - stamp)
        # Nearer than half a step, or the message after a lost one would be taken for it.
        if k < unit.end and apart <= max_skew and 2 * apart < min(message.step, step):
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
    """Enter messages (M,) in order of arrival from number `start` on, as long as there is room for samples (S,).

    Of each: unit, stamp, ns, values (M, 6): rate, rad/s, and specific force, m/s^2; the
    `Aligner` is in rows (1,). Returned are the number of the next message to be
    entered, and of samples formed. Fewer than S: all is done.
    """
    aligner, count = rows[0], 0
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

    ``max_skew``: stamps this close count as one instant, ns. ``timeout``: a unit silent
    for longer than this by the stamps of the others is not waited for, ns. ``delays``:
    by how much the stamps of each unit are late, s, (units,); empty: not at all.
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
        row["n"], row["max_skew"], row["timeout"], row["bridge"] = (
            units,
            max_skew,
            timeout,
            int(MAX_BRIDGE * timeout),
        )
        row["units"]["delay"][: len(delays)] = [round(1e9 * delay) for delay in delays]

    def push(self, unit: int, stamp: int, rate: Sequence[float]) -> NDArray[Any]:
        """Take one message and return the samples that it completes, mostly none or one, (S,) `Sample`."""
        return self._aligned(
            np.array([unit]),
            np.array([stamp]),
            np.array([rate], dtype=np.float64).reshape(1, -1),
        )

    def push_block(self, unit: Int, stamp: Int, values: Array) -> Block:
        """Take recorded messages in order of arrival and return the samples that they complete.

        Messages: unit (M,), stamp (M,) ns, values (M, 3) rad/s, or (M, 6) with the
        specific force behind them, m/s^2, all NaN where a message has none.
        """
        return as_block(self._aligned(unit, stamp, values), self.units)

    def flush(self) -> NDArray[Any]:
        """Return what is left at the end of a recording, without waiting for any unit, (S,) `Sample`."""
        self.rows["phase"], self.rows["force"] = _FORMING, _ALL
        return self._aligned(
            np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty((0, 6))
        )

    def is_live(self, unit: int) -> bool:
        """Whether a unit is waited for."""
        return bool(is_live(self.rows[0], unit))

    @property
    def are_parted(self) -> bool:
        """Whether the clocks of the only two units that deliver went apart."""
        return bool(are_parted(self.rows[0]))

    @property
    def counters(self) -> tuple[dict[str, int], ...]:
        """What was counted, by name, for each unit."""
        rows = self.rows["units"]["counters"][0, : self.units]
        return tuple(
            {name: int(row[name]) for name in Counters.__annotations__} for row in rows
        )

    @property
    def lag(self) -> list[int]:
        """How far the last message of each unit stood behind the newest of all, ns."""
        return list(self.rows["units"]["lag"][0, : self.units].tolist())

    @property
    def shift(self) -> int:
        """Added to the stamps of the samples, ns; 0 until all clocks were set back."""
        return int(self.rows["shift"][0])

    def _aligned(self, unit: Int, stamp: Int, values: Array) -> NDArray[Any]:
        if values.shape[1] == 3:
            values = np.hstack([values, np.full_like(values, np.nan)])
        parts, start = [], 0
        while True:
            samples = allocate(Sample, min(len(stamp) - start + 64, 8192))
            start, count = align_messages(
                self.rows, unit, stamp, values, start, samples
            )
            parts.append(samples[:count])
            if count < len(samples):
                return parts[0] if len(parts) == 1 else np.concatenate(parts)


def as_block(samples: NDArray[Any], units: int) -> Block:
    """Block of samples, (S,) `Sample`, with the accelerations of all units if any has one."""
    stamp, n = samples["stamp"].copy(), 3 * units

    def half(values: str, there: str) -> Block:
        received = samples[there][:, :n].astype(np.bool_)
        z = samples[values][:, :n].copy()
        return Block(stamp, z, None if received.all() else received)

    block = half("z", "received")
    felt = samples["felt"][:, :n].any()
    return replace(block, acceleration=half("force", "felt")) if felt else block
