# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""State of each channel and the reason, from the declarations and the condition of its values."""

from __future__ import annotations

import math
from enum import Enum, IntEnum
from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.health import FROZEN, SILENT
from fdi_ros.core.records import Core, Subset


class ChannelState(IntEnum):
    """State of one channel, the number in ``~/integrity``."""

    #: Delivers, is checked against the others, and agrees.
    OK = 0
    #: Suspected but not confirmed, and left out of the fused rate for now.
    SUSPECT = 1
    #: In a named set that contains a faulty channel.
    AMBIGUOUS = 2
    #: Declared faulty and left out.
    FAULTY = 3
    #: Gives no value, or no new value.
    STALE = 4
    #: Delivers, but cannot be checked: too few other channels, bias not learned, or the
    #: detector cannot run.
    UNCHECKED = 5
    #: Taken out by the operator.
    EXCLUDED = 6


class Reason(str, Enum):
    """Reason of a state, in words. Records hold the index in this list."""

    NONE = ""
    DISAGREES = "disagrees with the others"
    NON_FINITE = "not a finite number"
    OUT_OF_RANGE = "out of range"
    STUCK = "stuck: repeats one value while the others move"
    FROZEN = "frozen: has repeated one value for long"
    NO_DATA = "gives no data"
    TOO_FEW = "too few channels left to check it"
    LATELY = "most recent samples could not be checked"
    CANNOT_RUN = "the detector cannot run on the channels left"
    BIAS = "bias not learned yet"
    OPERATOR = "taken out by the operator"
    ALL_REPEAT = "all channels repeat their values: nothing new is measured"
    DRIFTED = "has drifted: its bias is beyond bias.max_drift"
    INTERMITTENT = "values come and go"
    COPY = "gives the values of another unit: one sensor, no redundancy"
    OLD = "the unit repeats old values while the others move"
    DOUBTFUL = "a fault is possible, with too little evidence to declare it"


REASONS = tuple(Reason)

OK, SUSPECT, AMBIGUOUS, FAULTY, STALE, UNCHECKED, EXCLUDED = map(int, ChannelState)
_NONE = REASONS.index(Reason.NONE)
_DISAGREES = REASONS.index(Reason.DISAGREES)
_NON_FINITE = REASONS.index(Reason.NON_FINITE)
_OUT_OF_RANGE = REASONS.index(Reason.OUT_OF_RANGE)
_STUCK = REASONS.index(Reason.STUCK)
_FROZEN = REASONS.index(Reason.FROZEN)
_NO_DATA = REASONS.index(Reason.NO_DATA)
_TOO_FEW = REASONS.index(Reason.TOO_FEW)
_LATELY = REASONS.index(Reason.LATELY)
_CANNOT_RUN = REASONS.index(Reason.CANNOT_RUN)
_BIAS = REASONS.index(Reason.BIAS)
_OPERATOR = REASONS.index(Reason.OPERATOR)
_ALL_REPEAT = REASONS.index(Reason.ALL_REPEAT)
_DRIFTED = REASONS.index(Reason.DRIFTED)
_INTERMITTENT = REASONS.index(Reason.INTERMITTENT)
_COPY = REASONS.index(Reason.COPY)
_OLD = REASONS.index(Reason.OLD)
_DOUBTFUL = REASONS.index(Reason.DOUBTFUL)
_SHOWN = (OK, OK, SUSPECT, SUSPECT, STALE, STALE, SUSPECT)
"""State by `Condition`, or OK if the condition implies none."""
_OF_CONDITION = (
    _DISAGREES,
    _DISAGREES,
    _NON_FINITE,
    _OUT_OF_RANGE,
    _FROZEN,
    _NO_DATA,
    _NON_FINITE,
)
"""Reason by `Condition`."""
# Reason by `Decision.why`.
_OF_DECISION = (
    _NONE,
    _DISAGREES,
    _STUCK,
    _NON_FINITE,
    _DRIFTED,
    _INTERMITTENT,
)


@compiled
def left_out(core: Core) -> int:
    """Return the mask of channels declared faulty, taken out, or copies of others."""
    return core.decision.faulty | core.excluded | core.copies.channels


@compiled
def out_of_use(core: Core) -> int:
    """Return the mask of channels left out, or of unknown bias."""
    return left_out(core) | ~core.bias.channels_known


@compiled
def alive(core: Core) -> int:
    """Return the mask of channels in use that deliver new values."""
    gone = 0
    for i in range(core.settings.n):
        if core.health.condition[i] in (SILENT, FROZEN):
            gone |= 1 << i
    return ((1 << core.settings.n) - 1) & ~(gone | out_of_use(core))


@compiled
def update_states(core: Core, checked: int, suspicion: int, learning: bool) -> None:
    """Update the state of every channel.

    ``checked`` is the mask of channels whose fault would have been declared.
    """
    for i in range(core.settings.n):
        bit = 1 << i
        shown = _SHOWN[core.health.condition[i]]
        # Later rules override earlier ones.
        state = OK if checked & bit and not core.now.all_repeat else UNCHECKED
        if suspicion & bit:
            state = SUSPECT
        if core.decision.ambiguous & bit:
            state = AMBIGUOUS
        if learning:
            state = UNCHECKED
        if shown != OK:
            state = shown
        if core.decision.faulty & bit:
            state = FAULTY
        if core.excluded & bit:
            state = EXCLUDED
        core.last.state[i] = state


@compiled
def reason_of(core: Core, subset: Subset, i: int) -> int:
    """Return the reason of a channel's state. ``subset`` belongs to the living channels."""
    state = core.last.state[i]
    condition = core.health.condition[i]
    if state in (OK, EXCLUDED):
        return _NONE if state == OK else _OPERATOR
    if state == FAULTY:
        return _OF_DECISION[core.decision.why[i]]
    if state == UNCHECKED:
        return why_unchecked(core, subset, i)
    if state == SUSPECT and core.now.evidence.flickers >> i & 1:
        return _INTERMITTENT
    if state in (SUSPECT, AMBIGUOUS) and core.now.repeated >> i & 1:
        return _OLD
    if state == AMBIGUOUS and core.decision.voted & core.now.evidence.repeats >> i & 1:
        return _STUCK
    return _OF_CONDITION[condition] if state == _SHOWN[condition] else _DISAGREES


@compiled
def why_unchecked(core: Core, subset: Subset, i: int) -> int:
    """Return the reason why a channel is not checked."""
    if core.copies.channels >> i & 1:
        return _COPY
    if core.bias.learning or not core.bias.channels_known >> i & 1:
        return _BIAS
    if core.now.all_repeat:
        return _ALL_REPEAT
    if core.sample.estimate.doubtful >> i & 1:
        return _DOUBTFUL
    if subset.detectable >> i & 1:
        return _LATELY
    return _CANNOT_RUN if subset.refused else _TOO_FEW


@compiled
def write_events(
    core: Core,
    subset: Subset,
    row: int,
    learning: bool,
    events: NDArray[Any],
    count: int,
) -> int:
    """Store the states of the last sample, and append changes to the events.

    Return the new number of events.
    """
    last = core.last
    core.group = core.decision.ambiguous
    for i in range(core.settings.n):
        after = last.state[i]
        reason = reason_of(core, subset, i)
        core.reason[i] = reason
        if after != core.state[i]:
            error = 0.0
            if reason in (_DISAGREES, _DRIFTED) and not learning:
                error = core.now.verdict.error[i]
                if error == 0:
                    # After a restart the bias of a stored drift is known as well.
                    error = (
                        core.sample.estimate.bias[i]
                        if reason == _DRIFTED
                        else last.residual[i]
                    )
                if not math.isfinite(error):
                    # The channel has no value in this sample.
                    error = 0.0
            event = events[count]
            first = core.settings.first
            event.row = row
            event.stamp = last.stamp
            event.channel = first + i
            event.error = core.settings.natural * error
            event.before = core.state[i]
            event.after = after
            event.reason = reason
            group = core.decision.ambiguous if after == AMBIGUOUS else 1 << i
            event.group = group << first
            core.state[i] = after
            core.since[i] = last.stamp
            core.error[i] = error
            count += 1
    return count
