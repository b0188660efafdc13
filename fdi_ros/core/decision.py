# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From alarms to declarations: confirmation over a window, latching or return after a clean time.

All memory of verdicts lives here, and all of it is bounded: the last samples of one window, one stamp per channel. A
fault after ten hours is declared as fast as one after a second.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import MAX_CHANNELS, Channels, Counts, Flag, Flags, Mask, Stamps, Whole, record

MAX_WINDOW = 1000
"""Samples in the longest window."""
RETURN_MEAN = 0.5
"""A channel returns only if, averaged over the clean time, it is off by less than this many noise_std."""
LARGEST_ERROR = 1e3
"""rad/s; a larger error counts as this in that average."""
NAMED, COUNTED, ISOLATED, CHECKED = range(4)
"""Sets of channels kept for each sample: named by the alarm; of these, those that count towards a declaration; of
these, those of an alarm that isolates; and channels whose fault would have shown."""
UNDECLARED, DISAGREES, STUCK, NON_FINITE = range(4)
WHY = ("", "disagrees", "stuck", "non-finite")
"""Why a channel was declared: numbers, and the words for them in files."""

Kinds = Annotated[NDArray[np.int64], "i8", (4, MAX_CHANNELS)]
Ring = Annotated[NDArray[np.int64], "i8", (4, MAX_WINDOW)]


@record
class DecisionSettings:
    """When a fault is declared, and whether it is forgiven."""

    evidence: Flag  # an alarm is accumulated evidence, and declares at once; votes count for stuck channels only
    alarms: Whole  # that confirm a fault
    window: Whole  # samples among which they count
    latch: Flag
    clean_time: Whole  # ns
    mean_limit: Channels  # largest mean error of a channel that returns, rad/s


@record
class Decision:
    """What is declared, and the alarms of the last window."""

    faulty: Mask  # declared faulty
    ambiguous: Mask  # a set one of which is faulty
    voted: Mask  # of it, by votes
    why: Flags  # why each channel was declared
    at: Whole  # place of the last sample in the window
    sets: Ring  # of each sample of the window, by kind
    count: Kinds  # samples of the window in whose set a channel is, by kind
    alarms: Whole  # samples of the window with an alarm that counts
    last_bad: Stamps  # last sample at which a declared channel still disagreed or was unusable, ns
    error_sum: Channels  # of its errors since then, rad/s
    error_count: Counts  # of its samples since then
    last_doubt: Whole  # last sample with an alarm, or that could not be judged, ns
    suspicion: Mask  # named by an alarm in the window


@record
class Evidence:
    """What the decision gets of one sample."""

    stamp: Whole  # ns
    named: Mask  # suspects of the verdict; where evidence decides, channels that are stuck
    outliers: Mask  # channels too far off to be used for now, which counts towards no declaration
    isolated: Flag  # every suspect is faulty
    certain: Mask  # channels that are faulty by accumulated evidence
    undecided: Mask  # a set that holds a faulty one, by accumulated evidence
    judged: Flag  # there was a verdict
    held: Flag  # an alarm of this sample is a suspicion, but does not count towards a declaration
    interrupted: Flag  # there is a hole in the stream before this sample
    checked: Mask  # channels whose fault would have shown
    agrees: Mask  # channels that agree with the others; looked at for declared ones
    broken: Mask  # channels that have given nothing but non-finite values for long
    repeats: Mask  # channels that have repeated one value for long
    error: Channels  # each channel minus the rate of the channels in use along its axis, rad/s


@compiled
def decide(limits: DecisionSettings, own: Decision, n: int, evidence: Evidence) -> bool:
    """Take the verdict on one sample; return whether it changed what is declared."""
    named = evidence.named & ~own.faulty
    counted = 0 if evidence.held else named
    doubtful = named | evidence.outliers & ~own.faulty
    push(own, limits, n, doubtful, counted, counted if evidence.isolated else 0, evidence.checked)
    own.suspicion = at_least(own, NAMED, n, 1)
    faulty, undecided = confirm(own, limits, n)
    broken = evidence.broken & ~own.faulty
    faulty |= evidence.certain & ~own.faulty
    if limits.evidence:
        # A set follows the evidence, and ends with it; one by votes stays.
        own.voted |= undecided
        if evidence.stamp - own.last_doubt >= limits.clean_time:
            own.voted = 0
        wanted = (own.voted | evidence.undecided) if evidence.judged else own.ambiguous
    else:
        wanted = own.ambiguous | undecided
    follow_declared(limits, own, n, evidence)
    if named or evidence.undecided or not evidence.judged or evidence.interrupted:
        own.last_doubt = evidence.stamp
    returns, clears = 0, False
    if not limits.latch:
        returns = find_returns(limits, own, n, evidence.stamp)
        clears = own.ambiguous != 0 and evidence.stamp - own.last_doubt >= limits.clean_time
    # A set of which a member is now known to be faulty is explained by it.
    if clears or own.ambiguous & (faulty | broken):
        own.voted = wanted = 0
    after = (own.faulty | faulty | broken) & ~returns
    own.voted &= ~after
    wanted &= ~after
    if after == own.faulty and wanted == own.ambiguous:
        return False
    own.ambiguous = wanted
    for i in range(n):
        if after >> i & 1 and not own.faulty >> i & 1:
            own.why[i] = NON_FINITE if evidence.broken >> i & 1 else STUCK if evidence.repeats >> i & 1 else DISAGREES
        elif not after >> i & 1:
            own.why[i] = UNDECLARED
    own.faulty = after
    forget_alarms(own, limits, n)
    return True


@compiled
def push(
    own: Decision, limits: DecisionSettings, n: int, named: int, counted: int, isolated: int, checked: int
) -> None:
    """Move the window on by one sample."""
    own.at = (own.at + 1) % limits.window
    if counted:
        own.alarms += 1
    if own.sets[COUNTED, own.at]:
        own.alarms -= 1
    for kind in range(4):
        new = named if kind == NAMED else counted if kind == COUNTED else isolated if kind == ISOLATED else checked
        old = own.sets[kind, own.at]
        own.sets[kind, own.at] = new
        if new != old:
            for i in range(n):
                own.count[kind, i] += (new >> i & 1) - (old >> i & 1)


@compiled
def at_least(own: Decision, kind: int, n: int, least: int) -> int:
    """Bits of the channels that are in the sets of a kind of so many samples of the window at least."""
    mask = 0
    for i in range(n):
        if own.count[kind, i] >= least:
            mask |= 1 << i
    return mask


@compiled
def confirm(own: Decision, limits: DecisionSettings, n: int) -> tuple[int, int]:
    """Channels that the alarms of the window declare faulty, and a set one of which is.

    A channel is faulty when at least `alarms` of the last `window` samples named it and at least half that many
    named nothing but faulty channels with it. When the alarms are as many but do not single it out, the channels that
    at least half of them named are undecided together, and so they are when all the window disagrees about it.
    """
    half = (limits.alarms + 1) // 2
    enough = at_least(own, COUNTED, n, limits.alarms)
    faulty = enough & at_least(own, ISOLATED, n, half)
    undecided = 0
    if enough or own.alarms == limits.window:
        undecided = at_least(own, COUNTED, n, half)
        if not undecided:
            undecided = at_least(own, COUNTED, n, 1)
    if undecided & (undecided - 1) == 0:
        # Named alone by most alarms, though never called isolated: there is no other channel to confuse it with.
        faulty |= undecided & enough
    return faulty, 0 if faulty else undecided


@compiled
def follow_declared(limits: DecisionSettings, own: Decision, n: int, evidence: Evidence) -> None:
    """Note for each channel since when it agrees, and its mean error since then, where a declared one may return."""
    if limits.latch or not own.faulty:
        for i in range(n):
            own.last_bad[i] = evidence.stamp
            own.error_sum[i], own.error_count[i] = 0.0, 0
        return
    for i in range(n):
        if evidence.interrupted or not evidence.agrees >> i & 1:
            own.last_bad[i] = evidence.stamp
            own.error_sum[i], own.error_count[i] = 0.0, 0
        else:
            own.error_sum[i] += min(max(evidence.error[i], -LARGEST_ERROR), LARGEST_ERROR)
            own.error_count[i] += 1


@compiled
def find_returns(limits: DecisionSettings, own: Decision, n: int, stamp: int) -> int:
    """Bits of the declared channels that have agreed for the clean time."""
    returns = 0
    for i in range(n):
        small = abs(own.error_sum[i]) <= limits.mean_limit[i] * own.error_count[i]
        if own.faulty >> i & 1 and stamp - own.last_bad[i] >= limits.clean_time and small:
            returns |= 1 << i
    return returns


@compiled
def forget_alarms(own: Decision, limits: DecisionSettings, n: int) -> None:
    """Forget the alarms of the window."""
    own.alarms = 0
    # What was checked stays known; it is the last kind.
    for kind in range(CHECKED):
        for k in range(limits.window):
            own.sets[kind, k] = 0
        for i in range(n):
            own.count[kind, i] = 0


@compiled
def forget_checks(own: Decision, limits: DecisionSettings, n: int) -> None:
    """Forget that samples of the window were checked."""
    for k in range(limits.window):
        own.sets[CHECKED, k] = 0
    for i in range(n):
        own.count[CHECKED, i] = 0


@compiled
def clear(own: Decision, limits: DecisionSettings, n: int) -> None:
    """Clear all that is declared or suspected."""
    own.faulty = own.ambiguous = own.voted = own.suspicion = 0
    for i in range(n):
        own.why[i] = UNDECLARED
    forget_alarms(own, limits, n)
