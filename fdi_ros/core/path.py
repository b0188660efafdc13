# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path: one sample through the monitor, in order.

    values -> checks -> bias -> rate -> estimator and its detector -> other method ->
    decision -> fused rate -> states -> protection level

`prepare_sample` is the path up to the detector, `conclude_sample` the rest. Between
them the sample waits if the constants of the detector for just the channels present are
still to be prepared, which happens once for each set of channels.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.acceleration import differentiate_rate
from fdi_ros.core.algebra import along
from fdi_ros.core.bias import IN_MOTION, NOT_AT_REST, begin_in_motion, update_bias
from fdi_ros.core.copies import update_copies
from fdi_ros.core.decision import CHECKED, at_least, decide, forget_kind
from fdi_ros.core.evidence import fill_suspects, gather_evidence
from fdi_ros.core.fusion import fuse
from fdi_ros.core.halves import give_sample
from fdi_ros.core.health import FINE, OUT_OF_RANGE, check, leave_flickering
from fdi_ros.core.judging import (
    is_prepared,
    judge_corrected,
    judge_sample,
    take_verdict,
)
from fdi_ros.core.level import update_level
from fdi_ros.core.records import Bank, Core, PathSettings, Sample
from fdi_ros.core.repeated import all_repeat, update_repeated
from fdi_ros.core.restamping import restamp
from fdi_ros.core.states import alive, left_out, out_of_use, update_states, write_events
from fdi_ros.core.subsets import fill_rate

NOISY = 3.0  # times the noise expected from which a channel is noisy: its weight is then a tenth
# and this many times every channel of the other units: body vibration never shows on
# one unit only
NOISIER = 1.4
# share of the range: where the others predict less, a value out of range is a fault
RAIL_MARGIN = 0.9
LOUD = 1.5  # times the noise expected, below which a channel is not noisy
# time constants of the usual noise where noise is louder, and quieter, s
LOUDER_TIME, QUIETER_TIME = 120.0, 10.0
# ranges that the detector sees of a value out of range at most: any shows as well
RAIL_LIMIT = 10.0
WAITING = -1  # instead of a number of events


class Path(NamedTuple):
    """What the path works on."""

    core: NDArray[Any]  #: the monitor, (1,) `Core`
    subsets: NDArray[Any]  #: all sets of channels, (2^n,) `Subset`
    guard: NDArray[Any]  #: detector that keeps the estimator, (1,) `Bank`
    guard_memory: NDArray[np.uint8]  #: bytes of its states
    method: NDArray[
        Any
    ]  #: detector whose alarms declare, (1,) `Bank`: the guard or another
    method_memory: NDArray[np.uint8]  #: bytes of its states


@compiled
def run(
    paths: tuple[Path, Path],
    halves: int,
    samples: NDArray[Any],
    start: int,
    outs: tuple[NDArray[Any], NDArray[Any]],
    events: NDArray[Any],
    stop_at_event: bool,
) -> tuple[int, int, bool]:
    """Work samples (N,) one after the other, from row `start` on, into ``outs`` (N,) `OutputRow`; stamps increase.

    ``paths``, ``outs``: gyros, accelerometers; the latter count for nothing where
    ``halves`` is 1. Work ends when too few of ``events``, `EventRow`, are free; with
    `stop_at_event` after the first sample that brings one. Returned are the row at
    which it ended, N if all is done; the number of events; and whether something must
    be prepared. If it is the detector, for ``sample.mask`` of a core, the row was not
    worked to its end, and ``now.waiting`` is set; if the row before it lacks its level,
    the channels fused are in ``core.wanted``; or ``core.copies.found`` is set.
    """
    room = count = 0
    for half in range(halves):
        room += paths[half].core[0].settings.n
    for k in range(start, len(samples)):
        if len(events) - count < room:
            return k, count, False
        before = count
        count, waits = step_halves(paths, halves, samples[k], k, events, before)
        if waits:
            return k, count, True
        for half in range(halves):
            outs[half][k] = paths[half].core[0].last
        wants = wants_supply(paths, halves)
        if wants or (stop_at_event and count > before):
            return k + 1, count, wants
    return len(samples), count, False


@compiled
def step_halves(
    paths: tuple[Path, Path],
    halves: int,
    sample: Sample,
    row: int,
    events: NDArray[Any],
    count: int,
) -> tuple[int, bool]:
    """Work one sample through the gyros, then through the accelerometers.

    Returned are the number of events, and whether a detector must be prepared: then
    give the sample again, and it goes on with that half.
    """
    gyros = paths[0].core[0]
    while gyros.half < halves:
        path = paths[gyros.half]
        core = path.core[0]
        if not core.now.waiting:
            give_sample(core, gyros, sample, gyros.half)
        after = step(path, core.given, row, events, count)
        if after < 0:
            return count, True
        count = after
        gyros.half += 1
    gyros.half = 0
    return count, False


@compiled
def wants_supply(paths: tuple[Path, Path], halves: int) -> bool:
    """Whether a half lacks the level of its last sample, or has found copies."""
    wants = False
    for half in range(halves):
        core = paths[half].core[0]
        wants = wants or core.wanted != 0 or core.copies.found
    return wants


@compiled
def step(path: Path, sample: Sample, row: int, events: NDArray[Any], count: int) -> int:
    """Work one sample; the output is ``core.last``. Return the number of events, or `WAITING`: then give it again."""
    core, method = path.core[0], path.method[0]
    now = core.now
    if not now.waiting:
        prepare_sample(path, sample)
    now.waiting = not now.learned_from and not is_prepared(method, core.sample.mask)
    if now.waiting:
        return WAITING
    if not now.learned_from:
        judge_sample(path.guard[0], core.sample, now.input, now.guard)
        apply_estimate(core)
        if core.settings.guard_declares:
            take_verdict(now, core.settings.n)
        else:
            judge_corrected(core, method)
    return conclude_sample(path, row, events, count)


@compiled
def forget(bank: Bank, memory: NDArray[np.uint8]) -> None:
    """Let a detector forget all samples. A loop: the assignment of a slice takes seconds to compile."""
    for k in range(bank.rows * bank.states_size):
        memory[k] = 0


@compiled
def prepare_sample(path: Path, sample: Sample) -> None:
    """Check a sample, learn the bias from it, or correct it and find what the detector is to see.

    The checks see the values as delivered, so that they act at once. Where units are
    late the values judged are those of an earlier instant, of this and earlier samples
    that were checked, too.
    """
    core, subsets = path.core[0], path.subsets
    settings, now, stamp = core.settings, core.now, sample.stamp
    now.evidence.stamp = stamp
    now.evidence.interrupted = (
        core.samples == 0 or stamp - core.last_stamp > settings.stale_time
    )
    core.last_stamp = stamp
    core.samples += 1
    check(settings, core.health, sample)
    plain, fine = bring_together(core, sample)
    update_copies(core.copies, settings, core.line, stamp)
    now.learned_from = False
    if core.bias.learning:
        learn_bias(path, stamp, plain)
    if now.learned_from:
        return
    out = out_of_use(core)
    now.plain, now.in_use = plain, plain & ~out
    now.usable = now.in_use & fine
    leave_flickering(core, subsets)
    for i in range(settings.n):
        now.corrected[i] = now.aligned[i] - core.bias.value[i] - core.correction[i]
    fill_rate(subsets[now.in_use], settings.n, now.in_use, now.corrected, now.rate)
    fill_input(core, out)
    given = core.sample
    given.stamp, given.out, given.interrupted = stamp, out, now.evidence.interrupted
    given.beyond = given.mask & ~now.usable
    given.held = (
        core.saturated and stamp - core.saturated_stamp <= settings.recovery_time
    )
    now.repeated = update_repeated(core)
    given.repeated = now.repeated != 0
    given.wants_excess = not settings.guard_declares
    now.all_repeat = all_repeat(settings, core.health, now, stamp)
    if now.all_repeat:
        given.mask = 0
    differentiate_rate(core.acceleration, stamp, now.rate)


@compiled
def bring_together(core: Core, sample: Sample) -> tuple[int, int]:
    """Fill ``now.aligned`` with values of one instant; return bits of channels in range, and of those fine."""
    settings, aligned = core.settings, core.now.aligned
    delivered = inside = plain = fine = 0
    for i in range(settings.n):
        if sample.received[i]:
            delivered |= 1 << i
            if abs(sample.z[i]) < core.health.limit[i]:
                inside |= 1 << i
        if core.health.condition[i] == FINE:
            fine |= 1 << i
    delivered = restamp(
        core.line,
        settings,
        core.sample.estimate.late,
        sample,
        delivered,
        inside,
        aligned,
    )
    for i in range(settings.n):
        if delivered >> i & 1 and abs(aligned[i]) < core.health.limit[i]:
            plain |= 1 << i
    return plain, fine


@compiled
def learn_bias(path: Path, stamp: int, plain: int) -> None:
    """Offer a sample to the start-up average; ``now.learned_from``: the average took the sample."""
    core, subsets = path.core[0], path.subsets
    bias = core.bias
    core.now.learned_from = update_bias(core, subsets, stamp, plain, left_out(core))
    if bias.learning and bias.outcome == NOT_AT_REST:
        begin_in_motion(bias, core.settings.n)
    if not bias.learning:
        forget(path.guard[0], path.guard_memory)
        forget(path.method[0], path.method_memory)
        begin_bias(core)


@compiled
def apply_estimate(core: Core) -> None:
    """Correct ``now.corrected`` anew by what the estimator has found of the errors of the sensors."""
    now, estimate = core.now, core.sample.estimate
    for i in range(core.settings.n if estimate.known else 0):
        if math.isfinite(now.input[i]):
            now.corrected[i] = estimate.corrected[i]
            if now.usable >> i & 1:
                core.correction[i] = (
                    now.aligned[i] - core.bias.value[i] - now.corrected[i]
                )


@compiled
def update_noisy(core: Core) -> None:
    """Find channels much noisier than expected or than usual, and than all distinguishable ones of other units."""
    settings, noise, usual = (
        core.settings,
        core.now.verdict.noise,
        core.health.usual_noise,
    )
    core.now.noisy = 0
    for i in range(settings.n):
        if noise[i] > 0.0:
            louder = noise[i] > usual[i]
            share = settings.period / (LOUDER_TIME if louder else QUIETER_TIME)
            usual[i] += (min(share, 1.0) if usual[i] > 0.0 else 1.0) * (
                noise[i] - usual[i]
            )
        is_loud = noise[i] > LOUD and noise[i] > NOISY * usual[i]
        if noise[i] < NOISY and not is_loud:
            continue
        own = unit_of(settings, i)
        above = True
        for j in range(settings.n):
            is_other = not own >> j & 1 and not settings.sensors.alike[i, j]
            if is_other and noise[j] * NOISIER > noise[i]:
                above = False
        if above:
            core.now.noisy |= 1 << i
            core.health.noisy[i] += 1


@compiled
def unit_of(settings: PathSettings, i: int) -> int:
    """Bits of the channels of the unit of a channel; of one without a unit its own bit."""
    for unit in range(settings.units):
        if settings.members[unit] >> i & 1:
            return int(settings.members[unit])
    return 1 << i


@compiled
def begin_bias(core: Core) -> None:
    """Begin to follow the biases that were just learned."""
    n, settings, motion, largest = (
        core.settings.n,
        core.settings,
        core.bias.outcome == IN_MOTION,
        0.0,
    )
    lost = left_out(core)
    for i in range(n):
        largest = max(largest, core.health.step[i])
    for i in range(n):
        step = core.health.step[i] if core.health.step[i] > 0.0 else largest
        std = settings.turn_on if motion or lost >> i & 1 else settings.learned[i]
        if not motion and step > settings.sensors.noise_std[i]:
            # Noise does not take a sensor over coarse steps: at rest it was off by up
            # to half of one all the time.
            std = math.sqrt(std * std + step * step / 12.0)
        core.remaining[i] = core.sample.bias_std[i] = std
        core.correction[i] = 0.0


@compiled
def fill_input(core: Core, out: int) -> None:
    """Find the rate along each axis, and choose what the detector sees.

    It sees usable values, and those out of range that no manoeuvre explains. A
    hard-over is a fault. A chip driven out of range by a manoeuvre takes its time to
    come back from its limit, and the manoeuvre is beyond what the error model was made
    for: what disagrees meanwhile is left out, but not declared.
    """
    now, axes, rate = core.now, core.settings.sensors.axes, core.now.rate
    core.sample.mask = now.usable
    for i in range(core.settings.n):
        now.along[i] = along(axes[i], rate)
        now.input[i] = now.aligned[i] - core.bias.value[i]
        if (
            core.health.condition[i] == OUT_OF_RANGE
            and not out >> i & 1
            and math.isfinite(now.aligned[i])
        ):
            limit = core.health.limit[i]
            if abs(now.along[i]) < RAIL_MARGIN * limit:
                now.input[i] = min(
                    max(now.input[i], -RAIL_LIMIT * limit), RAIL_LIMIT * limit
                )
                core.sample.mask |= 1 << i
            else:
                core.saturated, core.saturated_stamp = True, now.evidence.stamp


@compiled
def conclude_sample(path: Path, row: int, events: NDArray[Any], count: int) -> int:
    """Decide, fuse and write events after the detector; the output is ``core.last``. Return the number of events."""
    core, subsets = path.core[0], path.subsets
    settings, now, last, verdict = core.settings, core.now, core.last, core.now.verdict
    last.stamp = now.evidence.stamp
    if now.learned_from:
        skip_sample(core)
        return write_events(core, subsets[alive(core)], row, True, events, count)
    update_noisy(core)
    fill_suspects(core, gather_evidence(core, subsets))
    before = core.decision.ambiguous
    changed = decide(settings, core.decision, now.evidence)
    # What this sample has declared is out of use from it on. What was in doubt before
    # is left out once more, unless too
    # little would be left: then only channels in doubt from now on.
    now.usable &= ~core.decision.faulty
    now.doubtful = core.decision.suspicion | before | core.decision.ambiguous
    enough = not changed or subsets[now.usable & ~now.doubtful].spare
    fuse(core, subsets, now.doubtful if enough else core.decision.ambiguous)
    # The estimator keeps its states whatever is declared.
    if changed and not settings.guard_declares:
        forget(path.method[0], path.method_memory)
    living = alive(core)
    checked = subsets[living].detectable & at_least(
        core.decision, settings, CHECKED, settings.alarms
    )
    update_states(core, checked, 0 if changed else core.decision.suspicion, False)
    last.statistic, last.threshold, last.alarm = (
        verdict.statistic,
        verdict.threshold,
        verdict.alarm,
    )
    update_level(core, subsets)
    return write_events(core, subsets[living], row, False, events, count)


@compiled
def skip_sample(core: Core) -> None:
    """Remember a sample that only the bias was learned from."""
    last = core.last
    forget_kind(core.decision, core.settings, CHECKED)
    for i in range(core.settings.n):
        core.reference[i] = last.residual[i] = math.nan
    update_states(core, 0, 0, True)
    last.instant = max(last.stamp, last.instant + 1)
    for a in range(3):
        last.rate[a], last.level[a] = math.nan, math.inf
    for k in range(6):
        last.covariance[k] = math.nan
    last.statistic = last.threshold = math.nan
    last.valid = last.alarm = False
