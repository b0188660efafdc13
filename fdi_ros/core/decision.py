# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From alarms to declarations, and from these and what a channel shows by itself to its state.

All memory of declarations lives here, and is bounded: the last samples of one window, a few figures per channel. A
fault after ten hours is declared as fast as one after a second.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.health import (
    FROZEN,
    INTERMITTENT_SHARE,
    NON_FINITE_LASTING,
    SILENT,
    add_stuck,
    intermittent_channels,
    update_stuck,
)
from fdi_ros.core.records import (
    Core,
    Current,
    Decision,
    Evidence,
    PathSettings,
    SampleInput,
    Subset,
)
from fdi_ros.core.subsets import variance_of
from fdi_ros.model.samples import MAX_RATE

SURE_DRIFT = 4.0  # standard deviations by which a bias is beyond its limit: by chance it is so once in 30 000


@compiled
def gather_evidence(core: Core, subsets: NDArray[Any]) -> int:
    """Fill in the evidence, but for what the verdict names; return bits of stuck channels."""
    settings, health, now, evidence = (
        core.settings,
        core.health,
        core.now,
        core.now.evidence,
    )
    evidence.judged = not math.isnan(now.verdict.statistic)
    evidence.checked = subsets[core.sample.mask].detectable if evidence.judged else 0
    if settings.estimates:
        evidence.checked &= core.sample.estimate.checked
    evidence.held = core.sample.held
    evidence.broken = evidence.repeats = evidence.agrees = clear = 0
    may_return = not settings.latch and core.decision.faulty != 0
    for i in range(settings.n):
        if health.condition[i] == NON_FINITE_LASTING:
            evidence.broken |= 1 << i
        if (
            settings.stuck_time
            and evidence.stamp - health.run_stamp[i] >= settings.stuck_time
        ):
            evidence.repeats |= 1 << i
        if not now.verdict.suspects[i]:
            clear |= 1 << i
        evidence.error[i] = now.corrected[i] - now.along[i]
        if may_return and now.plain >> i & 1:
            # The prediction of n - 1 channels is at worst as uncertain as the channel itself on a sane mounting.
            variance = 2 * variance_of(
                settings.sensors, i, now.along[i], core.acceleration.value
            )
            if abs(evidence.error[i]) <= settings.return_limit * math.sqrt(variance):
                evidence.agrees |= 1 << i
    evidence.intermittent = intermittent_channels(
        health.gone, health.leaves, settings.n, INTERMITTENT_SHARE
    )
    clear &= now.usable
    return update_stuck(core, subsets[clear], clear, evidence.stamp)


@compiled
def fill_suspects(core: Core, stuck: int) -> None:
    """Fill in which channels the verdict and their repeated values name."""
    settings, now, evidence, verdict = (
        core.settings,
        core.now,
        core.now.evidence,
        core.now.verdict,
    )
    n, evidence.certain, evidence.undecided = settings.n, 0, 0
    evidence.outliers = bits_of(verdict.outliers, n) | now.repeated | evidence.flickers
    if settings.by_evidence and verdict.alarm and not evidence.held:
        if verdict.isolated:
            evidence.certain = bits_of(verdict.suspects, n)
        else:
            evidence.undecided = bits_of(verdict.suspects, n)
    for u in range(settings.units):
        # All values of a unit are old: its driver or its bus repeats them, and no channel is worse than the others.
        if settings.members[u] & stuck & now.repeated:
            stuck |= settings.members[u]
    update_drifted(settings, core.sample, now)
    evidence.certain |= evidence.drifted
    add_stuck(settings, now, stuck)
    for i in range(n):
        if verdict.error[i] != 0:
            core.last_error[i] = verdict.error[i]
    evidence.suspected, evidence.isolated = (
        bits_of(verdict.suspects, n),
        verdict.isolated,
    )
    if settings.by_evidence:
        evidence.suspected, evidence.isolated = stuck, stuck & (stuck - 1) == 0


@compiled
def update_drifted(settings: PathSettings, sample: SampleInput, now: Current) -> None:
    """Find channels whose bias is surely beyond what a bias may be; they are suspects of the verdict too."""
    now.evidence.drifted, estimate = 0, sample.estimate
    if settings.estimates and settings.max_drift > 0.0 and estimate.known:
        for i in range(settings.n):
            bias = abs(estimate.bias[i]) - SURE_DRIFT * estimate.bias_std[i]
            if sample.mask >> i & 1 and bias > settings.max_drift:
                now.evidence.drifted |= 1 << i
                now.verdict.suspects[i], now.verdict.error[i] = True, estimate.bias[i]


@compiled
def bits_of(flags: NDArray[np.uint8], n: int) -> int:
    """Set of the channels whose flag is set."""
    mask = 0
    for i in range(n):
        if flags[i]:
            mask |= 1 << i
    return mask


# Declarations --------------------------------------------------------------------------------------------------------


RETURN_MEAN = 0.5  # noise_std that a channel's mean over the clean time is off by where it returns: else it is a fault
SUSPECTED, COUNTED, ISOLATED, CHECKED = range(4)
"""Sets of channels kept for each sample: suspected by the alarm; of these, those that count towards a declaration; of
these, those of an alarm that isolates; and channels whose fault would have shown."""
UNDECLARED, DISAGREES, STUCK, NOT_FINITE, DRIFTED, INTERMITTENT = range(6)
WHY = ("", "disagrees", "stuck", "non-finite", "drifted", "intermittent")
"""Why a channel was declared: numbers, and the words for them in files."""


@compiled
def decide(settings: PathSettings, decision: Decision, evidence: Evidence) -> bool:
    """Take the verdict on one sample; return whether it changed what is declared."""
    suspected = evidence.suspected & ~decision.faulty
    counted = 0 if evidence.held else suspected
    doubtful = suspected | evidence.outliers & ~decision.faulty
    push(
        decision,
        settings,
        (doubtful, counted, counted if evidence.isolated else 0, evidence.checked),
    )
    decision.suspicion = at_least(decision, settings, SUSPECTED, 1)
    # The first sample is one after an interruption: a set that was restored stands until it is clean for long enough.
    if suspected or evidence.undecided or not evidence.judged or evidence.interrupted:
        decision.last_doubt = evidence.stamp
    faulty, undecided = confirm(decision, settings)
    broken = (evidence.broken | evidence.intermittent) & ~decision.faulty
    faulty |= evidence.certain & ~decision.faulty
    if settings.by_evidence:
        # A set follows the evidence, and ends with it; one by votes stays.
        decision.voted |= undecided
        if evidence.stamp - decision.last_doubt >= settings.clean_time:
            decision.voted = 0
        wanted = (
            (decision.voted | evidence.undecided)
            if evidence.judged
            else decision.ambiguous
        )
    else:
        wanted = decision.ambiguous | undecided
    follow_declared(settings, decision, evidence)
    returns, clears = 0, False
    if not settings.latch:
        returns = update_returns(settings, decision, evidence.stamp)
        clears = (
            decision.ambiguous != 0
            and evidence.stamp - decision.last_doubt >= settings.clean_time
        )
    # A set of which a member is now known to be faulty is explained by it.
    if clears or decision.ambiguous & (faulty | broken):
        decision.voted = wanted = 0
    after = (decision.faulty | faulty | broken) & ~returns
    decision.voted &= ~after
    wanted &= ~after
    if after == decision.faulty and wanted == decision.ambiguous:
        return False
    decision.ambiguous = wanted
    for i in range(settings.n):
        if after >> i & 1 and not decision.faulty >> i & 1:
            decision.why[i] = reason_for(evidence, i)
        elif not after >> i & 1:
            decision.why[i] = UNDECLARED
    decision.faulty = after
    forget_alarms(decision, settings)
    return True


@compiled
def reason_for(evidence: Evidence, i: int) -> int:
    """Why a channel is declared."""
    if evidence.broken >> i & 1:
        return NOT_FINITE
    if evidence.intermittent >> i & 1:
        return INTERMITTENT
    if evidence.repeats >> i & 1:
        return STUCK
    return DRIFTED if evidence.drifted >> i & 1 else DISAGREES


@compiled
def push(
    decision: Decision, settings: PathSettings, sets: tuple[int, int, int, int]
) -> None:
    """Move the window on by one sample with these sets, by kind."""
    decision.at = (decision.at + 1) % settings.window
    if sets[COUNTED]:
        decision.alarms += 1
    if decision.sets[COUNTED, decision.at]:
        decision.alarms -= 1
    for kind in range(4):
        new, old = sets[kind], decision.sets[kind, decision.at]
        decision.sets[kind, decision.at] = new
        if new != old:
            for i in range(settings.n):
                decision.count[kind, i] += (new >> i & 1) - (old >> i & 1)


@compiled
def at_least(decision: Decision, settings: PathSettings, kind: int, least: int) -> int:
    """Bits of the channels that are in the sets of a kind of so many samples of the window at least."""
    mask = 0
    for i in range(settings.n):
        if decision.count[kind, i] >= least:
            mask |= 1 << i
    return mask


@compiled
def confirm(decision: Decision, settings: PathSettings) -> tuple[int, int]:
    """Channels that the alarms of the window declare faulty, and a set one of which is.

    A channel is faulty when at least `alarms` of the last `window` samples suspected it and at least half that many
    suspected nothing but faulty channels with it. When the alarms are as many but do not single it out, the channels
    that at least half of them suspected are undecided together, and so they are when all the window disagrees about it.
    """
    half = (settings.alarms + 1) // 2
    enough = at_least(decision, settings, COUNTED, settings.alarms)
    faulty = enough & at_least(decision, settings, ISOLATED, half)
    undecided = 0
    if enough or decision.alarms == settings.window:
        undecided = at_least(decision, settings, COUNTED, half)
        if not undecided:
            undecided = at_least(decision, settings, COUNTED, 1)
    if undecided & (undecided - 1) == 0:
        # Named alone by most alarms, though never called isolated: there is no other channel to confuse it with.
        faulty |= undecided & enough
    return faulty, 0 if faulty else undecided


@compiled
def follow_declared(
    settings: PathSettings, decision: Decision, evidence: Evidence
) -> None:
    """Note for each channel since when it agrees, and its mean error since then, where a declared one may return."""
    for i in range(settings.n):
        # That of one that is not declared counts from its declaration, not from that of another.
        is_declared = decision.faulty >> i & 1 and not settings.latch
        if not is_declared or evidence.interrupted or not evidence.agrees >> i & 1:
            decision.last_bad[i] = decision.renewed[i] = evidence.stamp
            decision.error_sum[i], decision.error_count[i] = 0.0, 0
            decision.earlier_sum[i], decision.earlier_count[i] = 0.0, 0
        else:
            decision.error_sum[i] += min(max(evidence.error[i], -MAX_RATE), MAX_RATE)
            decision.error_count[i] += 1


@compiled
def update_returns(settings: PathSettings, decision: Decision, stamp: int) -> int:
    """Bits of the declared channels that have agreed for the clean time, and in the mean of one or two of these."""
    returns = 0
    for i in range(settings.n):
        if (
            decision.faulty >> i & 1
            and stamp - decision.last_bad[i] >= settings.clean_time
        ):
            total = abs(decision.error_sum[i] + decision.earlier_sum[i])
            if total <= settings.mean_limit[i] * (
                decision.error_count[i] + decision.earlier_count[i]
            ):
                returns |= 1 << i
            elif stamp - decision.renewed[i] >= settings.clean_time:
                decision.earlier_sum[i], decision.earlier_count[i] = (
                    decision.error_sum[i],
                    decision.error_count[i],
                )
                decision.error_sum[i], decision.error_count[i], decision.renewed[i] = (
                    0.0,
                    0,
                    stamp,
                )
    return returns


@compiled
def forget_kind(decision: Decision, settings: PathSettings, kind: int) -> None:
    """Forget which channels were in the sets of a kind."""
    for k in range(settings.window):
        decision.sets[kind, k] = 0
    for i in range(settings.n):
        decision.count[kind, i] = 0


@compiled
def forget_alarms(decision: Decision, settings: PathSettings) -> None:
    """Forget the alarms of the window. What was checked stays known; it is the last kind."""
    decision.alarms = 0
    for kind in range(CHECKED):
        forget_kind(decision, settings, kind)


@compiled
def clear_declarations(core: NDArray[Any]) -> int:
    """Clear all that is declared or suspected; core (1,). Returns the channels that were declared, by their bits."""
    decision, settings = core[0].decision, core[0].settings
    declared = decision.faulty | decision.ambiguous
    decision.faulty = decision.ambiguous = decision.voted = decision.suspicion = 0
    for i in range(settings.n):
        decision.why[i] = UNDECLARED
    forget_alarms(decision, settings)
    return declared


# States ---------------------------------------------------------------------------------------------------------------


class ChannelState(IntEnum):
    """State of one channel; the number is what ``~/integrity`` carries."""

    OK = 0  # delivers, is checked against the others and agrees
    SUSPECT = 1  # left out of the fused rate for now: under suspicion, not confirmed
    AMBIGUOUS = (
        2  # one of a named set of channels is faulty; the evidence cannot tell which
    )
    FAULTY = 3  # declared faulty and left out
    STALE = 4  # gives nothing, or nothing new
    UNCHECKED = 5  # delivers, but nothing can check it: too few others, bias not learned, or the detector cannot run
    EXCLUDED = 6  # taken out by the operator


class Reason(str, Enum):
    """Why a channel is in its state, in words; records hold the place in this list."""

    NONE = ""
    DISAGREES = "disagrees with the others"
    NON_FINITE = "not a finite number"
    OUT_OF_RANGE = "out of range"
    STUCK = "stuck: repeats one value while the others move"
    FROZEN = "frozen: has repeated one value for long"
    NO_DATA = "gives no data"
    TOO_FEW = "too few channels left to check it"
    LATELY = "too few of its last samples could be checked"
    CANNOT_RUN = "the detector cannot run on the channels left"
    BIAS = "bias not learned yet"
    OPERATOR = "taken out by the operator"
    ALL_REPEAT = "all channels repeat their values: nothing new is measured"
    DRIFTED = "has drifted: its bias is beyond bias.max_drift"
    INTERMITTENT = "its values come and go"
    COPY = "gives the values of another unit: one sensor, no redundancy"


REASONS = tuple(Reason)

OK, SUSPECT, AMBIGUOUS, FAULTY, STALE, UNCHECKED, EXCLUDED = map(int, ChannelState)
_NONE, _DISAGREES, _NON_FINITE, _OUT_OF_RANGE, _STUCK, _FROZEN, _NO_DATA, _TOO_FEW = (
    range(8)
)
_LATELY, _CANNOT_RUN, _BIAS, _OPERATOR, _ALL_REPEAT, _DRIFTED, _INTERMITTENT, _COPY = (
    range(8, len(REASONS))
)
_SHOWN = (OK, OK, SUSPECT, SUSPECT, STALE, STALE, SUSPECT)
"""State that a value shows by itself, by `Condition`; OK where it shows none of its own."""
_OF_CONDITION = (
    _DISAGREES,
    _DISAGREES,
    _NON_FINITE,
    _OUT_OF_RANGE,
    _FROZEN,
    _NO_DATA,
    _NON_FINITE,
)
"""Why, by `Condition`."""
_OF_DECISION = (
    _NONE,
    _DISAGREES,
    _STUCK,
    _NON_FINITE,
    _DRIFTED,
    _INTERMITTENT,
)  # by why a channel was declared


@compiled
def left_out(core: Core) -> int:
    """Bits of the channels declared faulty, taken out, or copies of others."""
    return core.decision.faulty | core.excluded | core.copies.channels


@compiled
def out_of_use(core: Core) -> int:
    """Bits of the channels left out, or of unknown bias."""
    return left_out(core) | ~core.bias.known


@compiled
def alive(core: Core) -> int:
    """Bits of the channels in use that deliver something new."""
    gone = 0
    for i in range(core.settings.n):
        if core.health.condition[i] in (SILENT, FROZEN):
            gone |= 1 << i
    return ((1 << core.settings.n) - 1) & ~(gone | out_of_use(core))


@compiled
def update_states(core: Core, checked: int, suspicion: int, learning: bool) -> None:
    """State of every channel; checked: bits of the channels whose fault would have been declared."""
    for i in range(core.settings.n):
        bit, shown = 1 << i, _SHOWN[core.health.condition[i]]
        # What comes later tells more of the channel.
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
    """Why a channel is in its state; subset: the channels alive."""
    state, condition = core.last.state[i], core.health.condition[i]
    if state in (OK, EXCLUDED):
        return _NONE if state == OK else _OPERATOR
    if state == FAULTY:
        return _OF_DECISION[core.decision.why[i]]
    if state == UNCHECKED:
        return why_unchecked(core, subset, i)
    if state == SUSPECT and core.now.evidence.flickers >> i & 1:
        return _INTERMITTENT
    return _OF_CONDITION[condition] if state == _SHOWN[condition] else _DISAGREES


@compiled
def why_unchecked(core: Core, subset: Subset, i: int) -> int:
    """Why nothing checks a channel."""
    if core.copies.channels >> i & 1:
        return _COPY
    if core.bias.learning or not core.bias.known >> i & 1:
        return _BIAS
    if core.now.all_repeat:
        return _ALL_REPEAT
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
    """Take over the states of the last sample; write changes into events from `count` on; return the new count."""
    last = core.last
    core.group = core.decision.ambiguous
    for i in range(core.settings.n):
        after, reason = last.state[i], reason_of(core, subset, i)
        core.reason[i] = reason
        if after != core.state[i]:
            error = 0.0
            if reason in (_DISAGREES, _DRIFTED) and not learning:
                error = core.now.verdict.error[i]
                if error == 0:
                    # Of a drift that was declared before a restart the bias is known, too.
                    error = (
                        core.sample.estimate.bias[i]
                        if reason == _DRIFTED
                        else last.residual[i]
                    )
                if not math.isfinite(error):
                    # It gives nothing in this very sample.
                    error = 0.0
            event = events[count]
            event.row, event.stamp, event.channel, event.error = (
                row,
                last.stamp,
                i,
                error,
            )
            event.before, event.after, event.reason = core.state[i], after, reason
            event.group = core.decision.ambiguous if after == AMBIGUOUS else 1 << i
            core.state[i], core.since[i], core.error[i] = after, last.stamp, error
            count += 1
    return count
