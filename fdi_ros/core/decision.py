# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From alarms to declarations, and back.

All memory of declarations lives here, and is bounded: the last samples of one window, a
few figures per channel. A fault after ten hours is declared as fast as one after a
second.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import Decision, Evidence, PathSettings
from fdi_ros.model.samples import MAX_RATE

# noise_std that a channel's mean over the clean time is off by where it returns: else
# it is a fault
RETURN_MEAN = 0.5
SUSPECTED, COUNTED, ISOLATED, CHECKED = range(4)
"""Sets of channels kept for each sample: suspects of the alarm, suspects that count
towards a declaration, suspects of an alarm that isolates, and channels whose fault
would have shown."""
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
    # The first sample is one after an interruption: a set that was restored stands
    # until it is clean for long enough.
    if suspected or evidence.undecided or not evidence.judged or evidence.interrupted:
        decision.last_doubt = evidence.stamp
    faulty, undecided = confirm(decision, settings)
    broken = (evidence.broken | evidence.intermittent) & ~decision.faulty
    faulty |= evidence.certain & ~decision.faulty
    if settings.by_evidence:
        # A set by evidence ends with the evidence. A set by votes stays.
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
    """Bits of the channels in the sets of a kind in at least ``least`` samples of the window."""
    mask = 0
    for i in range(settings.n):
        if decision.count[kind, i] >= least:
            mask |= 1 << i
    return mask


@compiled
def confirm(decision: Decision, settings: PathSettings) -> tuple[int, int]:
    """Channels that the alarms of the window declare faulty, and a set one of which is.

    A channel is faulty when at least `alarms` of the last `window` samples suspected it
    and at least half that many suspected nothing but faulty channels with it. When the
    alarms are as many but do not single it out, the channels that at least half of them
    suspected are undecided together. The same holds when all alarms of the window
    disagree.
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
        # Most alarms name this channel alone, though none calls it isolated: no other
        # channel is confused with it.
        faulty |= undecided & enough
    return faulty, 0 if faulty else undecided


@compiled
def follow_declared(
    settings: PathSettings, decision: Decision, evidence: Evidence
) -> None:
    """Note for each channel since when it agrees, and its mean error since then, where a declared one may return."""
    for i in range(settings.n):
        # The clean time of a channel begins with its own declaration.
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
    """Bits of the declared channels that have agreed for the clean time, and in the mean over one or two."""
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
    """Forget the alarms of the window, but not which channels were checked, the last kind."""
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
