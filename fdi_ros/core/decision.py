# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Declaration of faults from alarms, and recovery.

The memory of declarations is bounded: the last samples of one window, and a few figures
per channel. Thus a fault after ten hours is declared as fast as one after a second.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.records import Decision, Evidence, PathSettings
from fdi_ros.model.samples import MAX_RATE

#: Largest mean error of a recovering channel over the clean time, in its noise_std.
RETURN_MEAN = 0.5
SUSPECTED, COUNTED, ISOLATED, CHECKED = range(4)
"""Sets of channels stored for each sample: suspects of the alarm, suspects that count
towards a declaration, suspects of an alarm that isolates, and channels whose fault
would have shown."""
UNDECLARED, DISAGREES, STUCK, NOT_FINITE, DRIFTED, INTERMITTENT = range(6)
WHY = ("", "disagrees", "stuck", "non-finite", "drifted", "intermittent")
"""Reasons of declarations: the numbers, and their words in files."""


@compiled
def decide(settings: PathSettings, decision: Decision, evidence: Evidence) -> bool:
    """Process the evidence of one sample. Return whether the declarations changed."""
    suspected = evidence.suspected & ~decision.faulty
    counted = 0 if evidence.no_votes else suspected
    doubtful = suspected | evidence.outliers & ~decision.faulty
    push(
        decision,
        settings,
        (doubtful, counted, counted & evidence.isolated, evidence.checked),
    )
    decision.suspicion = at_least(decision, settings, SUSPECTED, 1)
    # The first sample counts as interrupted: a restored set stands until it has been
    # clean for long enough.
    if (
        suspected
        or evidence.undecided
        or evidence.unclear
        or not evidence.judged
        or evidence.interrupted
    ):
        decision.last_doubt = evidence.stamp
    faulty, undecided = confirm(decision, settings)
    broken = (evidence.broken | evidence.intermittent) & ~decision.faulty
    faulty |= evidence.certain & ~decision.faulty
    wanted = wanted_set(settings, decision, evidence, undecided)
    follow_declared(settings, decision, evidence)
    returns = 0
    clears = False
    if not settings.latch:
        returns = update_returns(settings, decision, evidence.stamp)
        clears = (
            decision.ambiguous != 0
            and evidence.stamp - decision.last_doubt >= settings.clean_time
        )
    # A member that disagrees, is stuck or has drifted explains the set. One whose values
    # are no numbers does not: another member may be wrong.
    if clears or decision.ambiguous & faulty:
        decision.voted = wanted = 0
    after = (decision.faulty | faulty | broken) & ~returns
    decision.voted &= ~after
    wanted &= ~after
    if after == decision.faulty and wanted == decision.ambiguous:
        return False
    decision.ambiguous = wanted
    set_faulty(settings, decision, evidence, after)
    forget_alarms(decision, settings)
    return True


@compiled
def wanted_set(
    settings: PathSettings, decision: Decision, evidence: Evidence, undecided: int
) -> int:
    """Return the set that is AMBIGUOUS by the votes for ``undecided`` and by the evidence."""
    if not settings.by_evidence:
        return decision.ambiguous | undecided
    # A set by evidence ends with its evidence, a set by votes after `clean_time`
    # without doubt. A member that nothing checks remains in doubt.
    decision.voted |= undecided
    if evidence.stamp - decision.last_doubt >= settings.clean_time:
        decision.voted = 0
    lasting = evidence.unclear if evidence.judged else decision.ambiguous
    return decision.voted | evidence.undecided | lasting


@compiled
def set_faulty(
    settings: PathSettings, decision: Decision, evidence: Evidence, faulty: int
) -> None:
    """Set the faulty channels, and keep the reasons of those that are new."""
    for i in range(settings.n):
        if not faulty >> i & 1:
            decision.why[i] = UNDECLARED
        elif not decision.faulty >> i & 1:
            decision.why[i] = reason_for(evidence, i)
    decision.faulty = faulty


@compiled
def reason_for(evidence: Evidence, i: int) -> int:
    """Return the reason why a channel is declared."""
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
    """Add the sets of one sample, by kind, to the window."""
    decision.at = (decision.at + 1) % settings.window
    if sets[COUNTED]:
        decision.alarms += 1
    if decision.sets[COUNTED, decision.at]:
        decision.alarms -= 1
    for kind in range(4):
        new = sets[kind]
        old = decision.sets[kind, decision.at]
        decision.sets[kind, decision.at] = new
        if new != old:
            for i in range(settings.n):
                decision.count[kind, i] += (new >> i & 1) - (old >> i & 1)


@compiled
def at_least(decision: Decision, settings: PathSettings, kind: int, least: int) -> int:
    """Return the channels in the sets of a kind in at least ``least`` samples."""
    mask = 0
    for i in range(settings.n):
        if decision.count[kind, i] >= least:
            mask |= 1 << i
    return mask


@compiled
def confirm(decision: Decision, settings: PathSettings) -> tuple[int, int]:
    """Return the channels that the window declares faulty, and an undecided set.

    A channel is faulty if at least `alarms` of the last `window` samples suspected the
    channel, and at least half as many alarms isolate their suspects. If the
    alarms suffice but isolate no channel, the channels that at least half
    suspected form the undecided set. The same holds if all samples of the window have
    alarms that disagree; if no channel is in half of `alarms` of them, all suspects
    form the set.
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
        # Most alarms suspect this channel alone, although none isolates: no other
        # channel is confused with it.
        faulty |= undecided & enough
    return faulty, 0 if faulty else undecided


@compiled
def follow_declared(
    settings: PathSettings, decision: Decision, evidence: Evidence
) -> None:
    """Update the clean time and the mean error of declared channels that may recover."""
    for i in range(settings.n):
        # The clean time of a channel begins at its declaration.
        is_declared = decision.faulty >> i & 1 and not settings.latch
        if not is_declared or evidence.interrupted or not evidence.agrees >> i & 1:
            restart_clean_time(decision, i, evidence.stamp)
        else:
            decision.error_sum[i] += min(max(evidence.error[i], -MAX_RATE), MAX_RATE)
            decision.error_count[i] += 1


@compiled
def restart_clean_time(decision: Decision, i: int, stamp: int) -> None:
    """Let the clean time of a channel begin at this stamp, ns."""
    decision.last_bad[i] = decision.renewed[i] = stamp
    decision.error_sum[i] = decision.earlier_sum[i] = 0.0
    decision.error_count[i] = decision.earlier_count[i] = 0


@compiled
def update_returns(settings: PathSettings, decision: Decision, stamp: int) -> int:
    """Return the declared channels that recover.

    They have agreed for the clean time, and their mean error over one or two clean
    times is small.
    """
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
                decision.earlier_sum[i] = decision.error_sum[i]
                decision.earlier_count[i] = decision.error_count[i]
                decision.error_sum[i] = 0.0
                decision.error_count[i] = 0
                decision.renewed[i] = stamp
    return returns


@compiled
def forget_kind(decision: Decision, settings: PathSettings, kind: int) -> None:
    """Clear the sets of a kind."""
    for k in range(settings.window):
        decision.sets[kind, k] = 0
    for i in range(settings.n):
        decision.count[kind, i] = 0


@compiled
def forget_alarms(decision: Decision, settings: PathSettings) -> None:
    """Clear the alarms of the window, but keep the checked channels (the last kind)."""
    decision.alarms = 0
    for kind in range(CHECKED):
        forget_kind(decision, settings, kind)


@compiled
def clear_declarations(core: NDArray[Any]) -> int:
    """Clear all declarations and suspicions, and return the mask of declared channels.

    ``core`` has shape (1,).
    """
    decision = core[0].decision
    settings = core[0].settings
    declared = decision.faulty | decision.ambiguous
    decision.faulty = decision.ambiguous = decision.voted = decision.suspicion = 0
    for i in range(settings.n):
        decision.why[i] = UNDECLARED
    forget_alarms(decision, settings)
    return declared


@compiled
def clear_disagreements(core: NDArray[Any]) -> None:
    """Clear sets, suspicions and declarations that rest on the comparison of channels.

    A channel that is stuck or not finite stays declared. ``core`` has shape (1,).
    """
    decision = core[0].decision
    settings = core[0].settings
    decision.ambiguous = decision.voted = decision.suspicion = 0
    for i in range(settings.n):
        why = decision.why[i]
        if why != STUCK and why != NOT_FINITE and why != INTERMITTENT:
            decision.faulty &= ~(1 << i)
            decision.why[i] = UNDECLARED
    forget_alarms(decision, settings)
