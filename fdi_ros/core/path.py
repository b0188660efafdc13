# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The sample path: one sample through the monitor, in order.

    values -> checks -> bias -> rate -> estimator and its detector -> other method ->
    decision -> fused rate -> states -> protection level

`prepare_sample` is the path up to the detector, and `conclude_sample` is the rest. In
between, the sample waits if the detector has no constants yet for the present set of
channels. They are prepared once for each set.
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
from fdi_ros.core.decision import (
    CHECKED,
    at_least,
    decide,
    forget_kind,
    restart_clean_time,
)
from fdi_ros.core.evidence import fill_suspects, gather_evidence
from fdi_ros.core.fusion import fuse
from fdi_ros.core.halves import give_force, give_sample
from fdi_ros.core.health import (
    FINE,
    OUT_OF_RANGE,
    check,
    has_value,
    leave_flickering,
    unit_of,
)
from fdi_ros.core.judging import (
    is_prepared,
    judge_corrected,
    judge_sample,
    take_verdict,
)
from fdi_ros.core.level import update_level
from fdi_ros.core.records import Bank, Core, OutputRow, Sample
from fdi_ros.core.repeated import all_repeat, update_repeated, without_coarse_steps
from fdi_ros.core.restamping import restamp
from fdi_ros.core.states import (
    STALE,
    UNCHECKED,
    alive,
    left_out,
    out_of_use,
    update_states,
    write_events,
)
from fdi_ros.core.subsets import fill_rate

#: A channel is noisy from this multiple of the expected or its usual noise on: its weight
#: in the rate is then a tenth.
NOISY = 3.0
#: It must also exceed the multiple of every channel of the other units by this factor:
#: vibration of the body shows on more than one unit.
NOISIER = 1.8
#: Share of the range. If the others predict less, a value out of range is a fault.
RAIL_MARGIN = 0.9
#: Smallest usual noise, as a share of the expected noise: at rest a value may repeat.
LEAST_USUAL = 0.3
#: Time without noise after which noise is a new spell, ns.
NOISY_BREAK = 1_000_000_000
#: Time constants with which the usual noise follows more and less noise, s.
LOUDER_TIME, QUIETER_TIME = 30.0, 10.0
#: A value out of range is limited to this many ranges before the detector sees it.
RAIL_LIMIT = 10.0
WAITING = -1  #: Returned in place of a number of events.


class Path(NamedTuple):
    """Arrays of one half of a monitor."""

    core: NDArray[Any]  #: Settings and memory, (1,) `Core`.
    subsets: NDArray[Any]  #: All sets of channels, (2^n,) `Subset`.
    guard: NDArray[Any]  #: Detector of the estimator, (1,) `Bank`.
    guard_memory: NDArray[np.uint8]  #: Bytes of its states.
    #: Detector whose alarms declare, (1,) `Bank`: the guard or another one.
    method: NDArray[Any]
    method_memory: NDArray[np.uint8]  #: Bytes of its states.


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
    """Process samples one after the other, from row `start` on. Stamps increase.

    Parameters
    ----------
    paths
        Gyros and accelerometers.
    halves
        1 for gyros alone, 2 for both.
    samples
        Samples, (N,).
    start
        First row to process.
    outs
        Receive the results of gyros and accelerometers, each (N,) `OutputRow`.
    events
        Receives the changes of state, (E,) `EventRow`. Processing ends if too few rows
        are free.
    stop_at_event
        End after the first sample with an event.

    Returns
    -------
    tuple
        Row at which processing ended, N at the end. Number of events. Whether the
        caller must prepare something: a detector for ``sample.mask`` of a core with
        ``now.waiting``, whose row is not finished; the level of the row before, for the
        channels in ``core.wanted``; or copies, with ``core.copies.found``.
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
            core = paths[half].core[0]
            outs[half][k] = core.last
            if half > 0:
                multiply(outs[half][k], core.settings.natural, core.settings.n)
        wants = wants_supply(paths, halves)
        if wants or (stop_at_event and count > before):
            return k + 1, count, wants
    return len(samples), count, False


@compiled
def multiply(row: OutputRow, natural: float, n: int) -> None:
    """Multiply the results of a row by the natural size of the quantity, which the path divides by."""
    for a in range(3):
        row.rate[a] *= natural
        row.level[a] *= natural
    for a in range(6):
        row.covariance[a] *= natural**2
    for i in range(n):
        row.residual[i] *= natural


@compiled
def step_halves(
    paths: tuple[Path, Path],
    halves: int,
    sample: Sample,
    row: int,
    events: NDArray[Any],
    count: int,
) -> tuple[int, bool]:
    """Process one sample of the gyros, then of the accelerometers.

    Return the number of events, and whether a detector must be prepared. After that
    the same sample must be passed again; processing continues with the same half.
    """
    gyros = paths[0].core[0]
    while gyros.half < halves:
        path = paths[gyros.half]
        core = path.core[0]
        if not core.now.waiting:
            give_sample(core, gyros, sample, gyros.half)
            if halves > 1 and gyros.half == 0:
                give_force(core, paths[1].core[0])
        after = step(path, core.given, row, events, count)
        if after < 0:
            return count, True
        count = after
        gyros.half += 1
    gyros.half = 0
    return count, False


@compiled
def wants_supply(paths: tuple[Path, Path], halves: int) -> bool:
    """Return whether a half lacks the level of its last sample, or has found copies."""
    wants = False
    for half in range(halves):
        core = paths[half].core[0]
        wants = wants or core.wanted != 0 or core.copies.found
    return wants


@compiled
def step(path: Path, sample: Sample, row: int, events: NDArray[Any], count: int) -> int:
    """Process one sample; the result is ``core.last``.

    Return the number of events, or `WAITING`: then the same sample must be passed again
    after the detector was prepared.
    """
    core = path.core[0]
    method = path.method[0]
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
    """Clear the memory of a detector."""
    # A loop, because the assignment of a slice takes seconds to compile.
    for k in range(bank.rows * bank.states_size):
        memory[k] = 0


@compiled
def prepare_sample(path: Path, sample: Sample) -> None:
    """Check a sample; then learn the bias from it, or prepare the input of the detector.

    The checks use the values as delivered, so that they act at once. If units are late,
    the detector gets values of an earlier instant, interpolated between this and
    earlier samples, which were checked as well.
    """
    core = path.core[0]
    subsets = path.subsets
    settings = core.settings
    now = core.now
    stamp = sample.stamp
    now.evidence.stamp = stamp
    now.evidence.interrupted = (
        core.samples == 0 or stamp - core.last_stamp > settings.stale_time
    )
    core.last_stamp = stamp
    core.samples += 1
    check(settings, core.health, sample)
    plain, fine = bring_together(core, sample)
    update_copies(core.copies, settings, core.health, core.delay_buffer, stamp)
    now.learned_from = False
    if core.bias.learning:
        learn_bias(path, stamp, plain)
    if now.learned_from:
        return
    out = out_of_use(core)
    now.plain = plain
    now.in_use = plain & ~out
    now.usable = now.in_use & fine
    leave_flickering(core, subsets)
    for i in range(settings.n):
        now.corrected[i] = now.aligned[i] - core.bias.value[i] - core.correction[i]
    fill_rate(subsets[now.in_use], settings.n, now.in_use, now.corrected, now.rate)
    fill_input(core, out)
    given = core.sample
    given.stamp = stamp
    given.out = out
    given.interrupted = now.evidence.interrupted
    now.repeated = update_repeated(core)
    # Old values are no values. The other channels continue to check each other.
    given.mask &= ~without_coarse_steps(settings, core.health, now.repeated)
    given.repeated = given.mask & now.repeated != 0
    given.beyond = given.mask & ~now.usable
    given.in_recovery = (
        core.saturated and stamp - core.saturated_stamp <= settings.recovery_time
    )
    given.wants_excess = not settings.guard_declares
    now.all_repeat = all_repeat(settings, core.health, now, stamp)
    if now.all_repeat:
        given.mask = 0
    differentiate_rate(core.acceleration, stamp, now.rate)


@compiled
def bring_together(core: Core, sample: Sample) -> tuple[int, int]:
    """Fill ``now.aligned`` with values of one instant, less what a turn adds to accelerometers.

    Return the masks of the channels in range, and of the channels without a defect.
    """
    settings = core.settings
    aligned = core.now.aligned
    delivered = inside = plain = fine = 0
    for i in range(settings.n):
        if core.turning.hidden >> i & 1:
            sample.z[i] = math.nan
        elif sample.received[i]:
            delivered |= 1 << i
            if abs(sample.z[i]) < core.health.limit[i]:
                inside |= 1 << i
            sample.z[i] -= core.turning.part[i]
        if core.health.condition[i] == FINE:
            fine |= 1 << i
    delivered = restamp(
        core.delay_buffer,
        settings,
        core.sample.estimate.late,
        sample,
        delivered,
        inside,
        aligned,
    )
    for i in range(settings.n):
        in_range = abs(aligned[i]) < core.health.limit[i]
        if delivered >> i & 1 and in_range:
            plain |= 1 << i
    return plain, fine


@compiled
def learn_bias(path: Path, stamp: int, plain: int) -> None:
    """Pass a sample to the start-up average.

    ``now.learned_from`` is set if the average uses the sample.
    """
    core = path.core[0]
    subsets = path.subsets
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
    """Correct ``now.corrected`` with the present estimate of the sensor errors."""
    now = core.now
    estimate = core.sample.estimate
    for i in range(core.settings.n if estimate.is_current else 0):
        if math.isfinite(now.input[i]):
            now.corrected[i] = estimate.corrected[i]
            if now.usable >> i & 1:
                core.correction[i] = (
                    now.aligned[i] - core.bias.value[i] - now.corrected[i]
                )


@compiled
def update_noisy(core: Core) -> None:
    """Find channels much noisier than expected or usual.

    A noisy channel must also be noisier than all distinguishable channels of other
    units. In the first seconds the usual noise is not known.
    """
    settings = core.settings
    noise = core.now.verdict.noise
    usual = core.health.usual_noise
    core.now.noisy = 0
    for i in range(settings.n):
        if noise[i] > 0.0:
            louder = noise[i] > usual[i]
            share = settings.period / (LOUDER_TIME if louder else QUIETER_TIME)
            usual[i] += (min(share, 1.0) if usual[i] > 0.0 else 1.0) * (
                noise[i] - usual[i]
            )
    if core.samples * settings.period < QUIETER_TIME:
        return
    for i in range(settings.n):
        times = times_as_noisy(core, i)
        if times >= NOISY and exceeds_others(core, i, times):
            core.now.noisy |= 1 << i
            core.health.noisy[i] += 1
            extend_spell(core, i, times)


@compiled
def times_as_noisy(core: Core, i: int) -> float:
    """Return the noise of a channel over the expected or usual one, whichever is smaller."""
    usual = min(max(core.health.usual_noise[i], LEAST_USUAL), 1.0)
    return core.now.verdict.noise[i] / usual


@compiled
def exceeds_others(core: Core, i: int, times: float) -> bool:
    """Whether the noise of a channel has grown more than in all other units."""
    settings = core.settings
    own = unit_of(settings, i)
    for j in range(settings.n):
        is_other = not own >> j & 1 and not settings.sensors.alike[i, j]
        if is_other and times_as_noisy(core, j) * NOISIER > times:
            return False
    return True


@compiled
def extend_spell(core: Core, i: int, times: float) -> None:
    """Add the present sample, with its multiple of the expected noise, to a noisy spell."""
    stamp = core.now.evidence.stamp
    last = core.health.last_noisy
    longest = core.health.longest_noisy
    if stamp - last.until[i] > NOISY_BREAK:
        last.since[i] = stamp
        last.samples[i] = 0
        last.times[i] = 0.0
    last.until[i] = stamp
    last.samples[i] += 1
    last.times[i] += (times - last.times[i]) / last.samples[i]
    if stamp - last.since[i] >= longest.until[i] - longest.since[i]:
        longest.since[i] = last.since[i]
        longest.until[i] = stamp
        longest.samples[i] = last.samples[i]
        longest.times[i] = last.times[i]


@compiled
def begin_bias(core: Core) -> None:
    """Initialise the estimation of biases after the start-up average."""
    n = core.settings.n
    settings = core.settings
    motion = core.bias.outcome == IN_MOTION
    largest = 0.0
    lost = left_out(core)
    for i in range(n):
        largest = max(largest, core.health.step[i])
    for i in range(n):
        own = core.health.step[i]
        step = own if own > 0.0 else largest
        is_unknown = motion or lost >> i & 1
        std = settings.turn_on_std if is_unknown else settings.learned[i]
        if not motion and step > settings.sensors.noise_std[i]:
            # The noise is smaller than the step of the sensor, and the average does
            # not remove the quantisation error: up to half a step at rest.
            std = math.sqrt(std * std + step * step / 12.0)
        core.remaining[i] = core.sample.bias_std[i] = std
        core.correction[i] = 0.0


@compiled
def fill_input(core: Core, out: int) -> None:
    """Calculate the rate along each axis, and choose the values for the detector.

    The detector gets usable values, and values out of range that no manoeuvre explains:
    a hard-over is a fault. A chip that a manoeuvre drives out of range needs time to
    recover from its limit, and such a manoeuvre is beyond the error model. Meanwhile a
    channel that disagrees is left out, but not declared.
    """
    now = core.now
    axes = core.settings.sensors.axes
    rate = core.now.rate
    core.sample.mask = now.usable
    for i in range(core.settings.n):
        now.along[i] = along(axes[i], rate)
        core.sample.start_bias[i] = core.bias.value[i]
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
                core.saturated = True
                core.saturated_stamp = now.evidence.stamp


@compiled
def conclude_sample(path: Path, row: int, events: NDArray[Any], count: int) -> int:
    """Decide, fuse and write events after the detector; the result is ``core.last``.

    Return the number of events.
    """
    core = path.core[0]
    subsets = path.subsets
    settings = core.settings
    now = core.now
    last = core.last
    verdict = core.now.verdict
    last.stamp = now.evidence.stamp
    if now.learned_from:
        skip_sample(core)
        return write_events(core, subsets[alive(core)], row, True, events, count)
    update_noisy(core)
    fill_suspects(core, gather_evidence(core, subsets))
    before = core.decision.ambiguous
    changed = decide(settings, core.decision, now.evidence)
    # A channel declared in this sample is out of use from now on. Channels that were in
    # doubt before are left out once more, unless too few would remain: then only the
    # channels in doubt from now on.
    now.usable &= ~core.decision.faulty
    now.doubtful = core.decision.suspicion | before | core.decision.ambiguous
    outliers = now.evidence.outliers & ~core.decision.faulty
    if changed and not subsets[now.usable & ~now.doubtful].spare:
        now.doubtful = core.decision.ambiguous | outliers
    fuse(core, subsets, now.doubtful)
    # Declarations do not change the states of the estimator.
    if changed and not settings.guard_declares:
        forget(path.method[0], path.method_memory)
    living = alive(core)
    checked = subsets[living].detectable & at_least(
        core.decision, settings, CHECKED, settings.alarms
    )
    update_states(
        core, checked, outliers if changed else core.decision.suspicion, False
    )
    last.statistic = verdict.statistic
    last.threshold = verdict.threshold
    last.alarm = verdict.alarm
    count_checked(core)
    update_level(core, subsets)
    return write_events(core, subsets[living], row, False, events, count)


@compiled
def count_checked(core: Core) -> None:
    """Count the values of this sample whose fault the other channels could have shown."""
    if math.isfinite(core.last.threshold):
        for i in range(core.settings.n):
            state = core.last.state[i]
            if has_value(core.health, i) and state != UNCHECKED and state != STALE:
                core.health.checked[i] += 1


@compiled
def skip_sample(core: Core) -> None:
    """Write the result of a sample that only served to learn the bias."""
    last = core.last
    now = core.now
    decision = core.decision
    now.repeated = now.noisy = now.evidence.flickers = 0
    now.all_repeat = now.withheld = core.sample.estimate.is_current = False
    forget_kind(decision, core.settings, CHECKED)
    # Nothing was compared, so no channel has agreed.
    decision.last_doubt = last.stamp
    for i in range(core.settings.n):
        restart_clean_time(decision, i, last.stamp)
        core.witnesses[i] = 0
        last.residual[i] = math.nan
    update_states(core, 0, 0, True)
    last.instant = max(last.stamp, last.instant + 1)
    for a in range(3):
        last.rate[a] = math.nan
        last.level[a] = math.inf
    for k in range(6):
        last.covariance[k] = math.nan
    last.statistic = last.threshold = math.nan
    last.valid = last.alarm = False
