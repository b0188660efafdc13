"""One sample through the monitor, in order: check, correct, judge, decide, fuse, tell.

    values -> checks -> bias -> rate -> detector -> stuck -> decision -> fused rate -> states -> protection level

`look` is the way up to the detector, `conclude` the rest. Between them the sample waits if the constants of the
detector for just the channels present are still to be prepared, which happens once for each set of channels.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.acceleration import take_rate
from fdi_ros.core.bank import Bank, judge_sample, suspicion_of, variance_of
from fdi_ros.core.bias import IN_MOTION, NOT_AT_REST, begin_in_motion, take_for_bias
from fdi_ros.core.compiled import compiled
from fdi_ros.core.core import Core
from fdi_ros.core.decision import CHECKED, at_least, decide, forget_checks
from fdi_ros.core.health import FINE, NON_FINITE_LASTING, OUT_OF_RANGE, check
from fdi_ros.core.states import AMBIGUOUS, SUSPECT, alive, has_drifted, out_of_use, state_of, tell_changes
from fdi_ros.core.stuck import add_stuck, find_stuck
from fdi_ros.core.subsets import find_covariance, find_growth, find_level_of, find_rate, passes_test
from fdi_ros.core.tracking import begin_tracking, follow, give_back
from fdi_ros.core.unit_delay import take_for_delay
from fdi_ros.model.geometry import MIN_SENSITIVITY

Array = NDArray[np.float64]

LEAST_SHARE = 0.1
"""Of a channel's error in its residual, to divide by."""
STEPS = 3.0
"""Of a quantised sensor: it repeats its value by chance until the body has moved by so many."""
NOISE_SEEN = 1.5
"""A channel with more than so many times the noise expected is that much noisier; less is chance."""
NOISY, NOISIER = 3.0, 1.4
"""A channel is noisy from so many times the noise expected, if that is so many times what any other has."""
RAIL_MARGIN = 0.9
"""A value out of range while the others predict less than this share of the range is a fault, not a manoeuvre."""
WAITING = -1
RAIL_LIMIT = 10.0
"""A value out of range is fed to the detector as so many ranges at most."""


@compiled
def run(
    core: NDArray[Any],
    bank: NDArray[Any],
    memory: NDArray[np.uint8],
    subsets: NDArray[Any],
    stamp: NDArray[np.int64],
    z: Array,
    received: NDArray[np.uint8],
    start: int,
    out: NDArray[Any],
    events: NDArray[Any],
    stop_at_event: bool,
) -> tuple[int, int, bool]:
    """Work samples one after the other, from row `start` on.

    Parameters
    ----------
    core
        (1,) `Core`.
    bank, memory
        (1,) `Bank` of the detector, and the bytes of its states.
    subsets
        (2^n,) `Subset`.
    stamp
        (N,) ns, strictly increasing.
    z
        (N, n) rad/s.
    received
        (N, n) whether a value was delivered, or (1, n) for all samples.
    start
        Row to begin with.
    out
        (N,) `Output`.
    events
        `Event`; work ends when fewer than n are free.
    stop_at_event
        End after the first sample that brings an event.

    Returns
    -------
    The row at which work ended, N if all is done; the number of events; and whether something is asked for. If the row
    was not worked because the detector wants preparing for ``core.fed_mask``, ``core.waiting`` is set; if the row
    before it lacks its protection level, the channels fused are in ``core.wanted``.
    """
    own, count = core[0], 0
    for k in range(start, len(stamp)):
        if len(events) - count < own.settings.n:
            return k, count, False
        before = count
        now = received[k if len(received) > 1 else 0]
        count = step(own, bank[0], memory, subsets, stamp[k], z[k], now, k, events, before)
        if count < 0:
            return k, before, True
        out[k] = own.last
        if own.wanted or (stop_at_event and count > before):
            return k + 1, count, own.wanted != 0
    return len(stamp), count, False


@compiled
def step(
    core: Core,
    bank: Bank,
    memory: NDArray[np.uint8],
    subsets: NDArray[Any],
    stamp: int,
    z: Array,
    received: NDArray[np.uint8],
    row: int,
    events: NDArray[Any],
    count: int,
) -> int:
    """Work one sample; the output is ``core.last``.

    Returns
    -------
    The number of events; `WAITING`, with ``core.waiting`` set, if the detector wants preparing for ``core.fed_mask``:
    then the same sample is to be given again.
    """
    if not core.waiting:
        look(core, bank, memory, subsets, stamp, z, received)
    core.waiting = not core.learned_from and not judge_sample(bank, core.fed_mask, core.fed, core.known, core.verdict)
    return WAITING if core.waiting else conclude(core, bank, memory, subsets, row, events, count)


@compiled
def forget(bank: Bank, memory: NDArray[np.uint8]) -> None:
    """Let the detector forget all samples. A loop: the assignment of a slice takes seconds to compile."""
    for k in range(bank.rows * bank.states_size):
        memory[k] = 0


@compiled
def look(
    core: Core,
    bank: Bank,
    memory: NDArray[np.uint8],
    subsets: NDArray[Any],
    stamp: int,
    z: Array,
    received: NDArray[np.uint8],
) -> None:
    """Check a sample, learn the bias from it, or correct it and find what the detector is to see."""
    settings, health = core.settings, core.health
    n = settings.n
    core.evidence.stamp = stamp
    core.evidence.interrupted = core.samples == 0 or stamp - core.last_stamp > settings.health.stale_time
    core.last_stamp = stamp
    core.samples += 1
    check(settings.health, health, n, stamp, z, received)
    plain = fine = 0
    for i in range(n):
        if received[i] and abs(z[i]) < settings.health.max_rate[i]:
            plain |= 1 << i
        if health.condition[i] == FINE:
            fine |= 1 << i
    core.learned_from = False
    if core.bias.learning:
        core.learned_from = take_for_bias(
            core.bias, settings.sensors, stamp, z, plain, core.decision.faulty | core.excluded
        )
        if settings.tracking.on and core.bias.learning and core.bias.outcome == NOT_AT_REST:
            begin_in_motion(core.bias, n)
        if not core.bias.learning:
            forget(bank, memory)
            begin_bias(core, n)
        if core.learned_from:
            return
    out = out_of_use(core)
    core.plain, core.in_use = plain, plain & ~out
    core.usable = core.in_use & fine
    find_rate(subsets[core.in_use], n, core.in_use, z_less_bias(core, z), core.rate)
    find_along(core)
    feed(core, out)
    core.known.held = core.saturated and stamp - core.saturated_stamp <= settings.health.recovery_time
    core.repeated = find_repeated(core)
    core.known.repeated = core.repeated != 0
    if settings.needs_acceleration:
        take_rate(core.acceleration, stamp, core.rate)
        for a in range(3):
            core.known.acceleration[a] = core.acceleration.value[a]


@compiled
def z_less_bias(core: Core, z: Array) -> Array:
    """Values less their bias, in ``core.z``."""
    for i in range(core.settings.n):
        core.z[i] = z[i] - core.bias.value[i] - core.tracking.value[i]
    return core.z


@compiled
def find_repeated(core: Core) -> int:
    """Channels of the units that give all their values again while the others say that the body has moved.

    They are old, and say nothing about a channel of it.
    """
    delay, sensors, found = core.settings.delay, core.settings.sensors, 0
    for u in range(delay.units):
        # A unit with a silent channel is none of these: what it gives is new, or the sample is without it.
        fresh, moved = delay.members[u] & ~core.usable != 0, False
        for i in range(core.settings.n):
            if delay.members[u] >> i & 1:
                h, change = sensors.axes[i], 0.0
                for a in range(3):
                    change += h[a] * (core.rate[a] - core.unit_rate[u, a])
                fresh = fresh or core.health.run_stamp[i] == core.evidence.stamp
                moved = moved or abs(change) > sensors.noise_std[i] + STEPS * core.health.step[i]
        if fresh:
            for a in range(3):
                core.unit_rate[u, a] = core.rate[a]
        elif moved:
            found |= delay.members[u]
    return found


@compiled
def find_noisy(core: Core) -> None:
    """Find channels that are much noisier than expected, and than all others but those they cannot be told from."""
    n, noise, sensors = core.settings.n, core.verdict.noise, core.settings.sensors
    core.noisy = 0
    for i in range(n):
        if noise[i] < NOISY:
            continue
        above = True
        for j in range(n):
            if j != i and not sensors.alike[i, j] and noise[j] * NOISIER > noise[i]:
                above = False
        if above:
            core.noisy |= 1 << i


@compiled
def begin_bias(core: Core, n: int) -> None:
    """Begin to follow the biases that were just learned."""
    limits, motion, largest = core.settings.tracking, core.bias.outcome == IN_MOTION, 0.0
    for i in range(n):
        largest = max(largest, core.health.step[i])
    for i in range(n):
        step = core.health.step[i] if core.health.step[i] > 0.0 else largest
        if not motion and step > core.settings.sensors.noise_std[i]:
            # Noise does not take a sensor over coarse steps: at rest it was off by up to half of one all the time.
            std = math.sqrt(limits.learned[i] * limits.learned[i] + step * step / 12.0)
        else:
            std = limits.turn_on if motion else limits.learned[i]
        core.remaining[i] = std
        core.variance[i] = std * std
        core.known.bias_std[i] = std
    begin_tracking(core.tracking, core.settings.tracking, n, core.variance)


@compiled
def learn_from_motion(core: Core, subsets: NDArray[Any]) -> None:
    """Follow the biases and the delays of the units, by what the detector did not object to."""
    settings, verdict = core.settings, core.verdict
    # What was measured before says nothing about bias and delay now.
    mask = 0 if core.repeated else core.fed_mask & core.usable
    # A sample that could not be judged, for want of channels, is no suspicion.
    suspicious = verdict.statistic >= suspicion_of(verdict.threshold)
    alarm = verdict.alarm or core.decision.ambiguous != 0
    follow(
        core.tracking,
        settings.tracking,
        settings.sensors,
        subsets,
        core.evidence.stamp,
        mask,
        core.z,
        core.along,
        suspicious,
        alarm,
        core.known,
    )
    for i in range(settings.n):
        # What is followed of a bias is about the part that shows in the residual; as much of it does not.
        share = max(subsets[core.in_use].sensitivity[i], LEAST_SHARE)
        followed = core.tracking.value[i] / share
        core.remaining[i] = math.sqrt(core.tracking.unseen[i] + followed * followed)
    if settings.delay.units > 1:
        take_for_delay(
            core.delays,
            settings.delay,
            settings.sensors,
            subsets,
            core.evidence.stamp,
            0 if core.repeated else core.in_use,
            core.rate,
            core.z,
            core.along,
            core.known,
        )


@compiled
def find_along(core: Core) -> None:
    """Rate of the channels in use along each axis, in ``core.along``."""
    axes, rate = core.settings.sensors.axes, core.rate
    for i in range(core.settings.n):
        core.along[i] = axes[i, 0] * rate[0] + axes[i, 1] * rate[1] + axes[i, 2] * rate[2]


@compiled
def feed(core: Core, out: int) -> None:
    """Choose what the detector sees: usable values, and those out of range that no manoeuvre explains.

    A hard-over is a fault. A chip driven out of range by a manoeuvre takes its time to come back from its limit, and
    the manoeuvre is beyond what the error model was made for: what disagrees meanwhile is left out, but not declared.
    """
    core.fed_mask = core.usable
    for i in range(core.settings.n):
        core.fed[i] = core.z[i]
        if core.health.condition[i] == OUT_OF_RANGE and not out >> i & 1:
            limit = core.settings.health.max_rate[i]
            if abs(core.along[i]) < RAIL_MARGIN * limit:
                core.fed[i] = min(max(core.z[i], -RAIL_LIMIT * limit), RAIL_LIMIT * limit)
                core.fed_mask |= 1 << i
            else:
                core.saturated, core.saturated_stamp = True, core.evidence.stamp


@compiled
def conclude(
    core: Core,
    bank: Bank,
    memory: NDArray[np.uint8],
    subsets: NDArray[Any],
    row: int,
    events: NDArray[Any],
    count: int,
) -> int:
    """Decide, fuse and tell after the detector; the output is ``core.last``. Return the number of events."""
    n, last = core.settings.n, core.last
    last.stamp = core.evidence.stamp
    if core.learned_from:
        pass_over(core, n)
        return tell_changes(core, subsets[alive(core)], row, True, events, count)
    if core.settings.tracking.on:
        learn_from_motion(core, subsets)
        find_noisy(core)
    stuck = gather_evidence(core, subsets)
    find_named(core, n, stuck)
    ambiguous, faulty = core.decision.ambiguous, core.decision.faulty
    changed = decide(core.settings.decision, core.decision, n, core.evidence)
    for i in range(n):
        if (core.decision.faulty & ~faulty) >> i & 1 and has_drifted(core, i):
            give_back(core.tracking, core.settings.sensors, subsets, i)
    fuse(core, subsets, core.decision.suspicion | ambiguous)
    # Evidence goes on to gather on an undecided set: only what it is gathered on may change under it.
    if changed and not (core.settings.decision.evidence and faulty == core.decision.faulty):
        forget(bank, memory)
    living = alive(core)
    checked = subsets[living].detectable & at_least(core.decision, CHECKED, n, core.settings.decision.alarms)
    for i in range(n):
        last.state[i] = state_of(core, i, checked, 0 if changed else core.decision.suspicion, False)
    last.statistic, last.threshold, last.alarm = core.verdict.statistic, core.verdict.threshold, core.verdict.alarm
    find_level(core, subsets)
    return tell_changes(core, subsets[living], row, False, events, count)


@compiled
def pass_over(core: Core, n: int) -> None:
    """Remember a sample that only the bias was learned from."""
    last = core.last
    forget_checks(core.decision, core.settings.decision, n)
    for i in range(n):
        core.reference[i] = last.residual[i] = math.nan
        last.state[i] = state_of(core, i, 0, 0, True)
    for a in range(3):
        last.rate[a], last.level[a] = math.nan, math.inf
    for k in range(6):
        last.covariance[k] = math.nan
    last.statistic = last.threshold = math.nan
    last.valid = last.alarm = False


@compiled
def bits_of(flags: NDArray[np.uint8], n: int) -> int:
    """Set of the channels whose flag is set."""
    mask = 0
    for i in range(n):
        if flags[i]:
            mask |= 1 << i
    return mask


@compiled
def units_of(core: Core, channels: int) -> int:
    """Set of all channels of the units that these are of."""
    members, mask = core.settings.delay.members, 0
    for u in range(core.settings.delay.units):
        if members[u] & channels:
            mask |= members[u]
    return mask


@compiled
def find_named(core: Core, n: int, stuck: int) -> None:
    """Tell the decision which channels the verdict and their repeated values name."""
    told, verdict = core.evidence, core.verdict
    told.certain = told.undecided = 0
    told.outliers, suspects = bits_of(verdict.outliers, n) | core.repeated, bits_of(verdict.suspects, n)
    if stuck & core.repeated:
        # All values of a unit are old: its driver or its bus repeats them, and no channel is worse than the others.
        stuck |= units_of(core, stuck & core.repeated)
    if core.settings.decision.evidence and verdict.alarm and not told.held:
        late = suspects & core.delays.late
        if verdict.isolated and not late:
            told.certain = suspects
        else:
            # Of a unit whose stamps are wrong no channel is named by itself.
            told.undecided = suspects | units_of(core, late)
    add_stuck(core, stuck)
    for i in range(n):
        if verdict.error[i] != 0:
            core.doubt[i] = verdict.error[i]
    told.named, told.isolated = bits_of(verdict.suspects, n), verdict.isolated
    if core.settings.decision.evidence:
        told.named, told.isolated = stuck, stuck & (stuck - 1) == 0


@compiled
def gather_evidence(core: Core, subsets: NDArray[Any]) -> int:
    """Complete what the decision is told, but for what the verdict names; return bits of stuck channels."""
    n, seen, limits, health = core.settings.n, core.evidence, core.settings.health, core.health
    seen.judged = not math.isnan(core.verdict.statistic)
    seen.checked = subsets[core.fed_mask].detectable if seen.judged else 0
    seen.held = core.saturated and seen.stamp - core.saturated_stamp <= limits.recovery_time
    seen.broken = seen.repeats = clear = 0
    for i in range(n):
        if health.condition[i] == NON_FINITE_LASTING:
            seen.broken |= 1 << i
        if limits.stuck_time and seen.stamp - health.run_stamp[i] >= limits.stuck_time:
            seen.repeats |= 1 << i
        if not core.verdict.suspects[i]:
            clear |= 1 << i
        seen.error[i] = core.z[i] - core.along[i]
    find_agreement(core)
    clear &= core.usable
    return find_stuck(core, subsets[clear], clear, seen.stamp)


@compiled
def find_agreement(core: Core) -> None:
    """Which channels agree with the others, where one that was declared may return."""
    core.evidence.agrees = 0
    if core.settings.decision.latch or not core.decision.faulty:
        return
    for i in range(core.settings.n):
        # The prediction of n - 1 channels is at worst as uncertain as the channel itself on a sane mounting.
        variance = 2 * variance_of(core.settings.sensors, i, core.along[i], core.acceleration.value)
        if core.plain >> i & 1 and abs(core.evidence.error[i]) <= core.settings.return_limit * math.sqrt(variance):
            core.evidence.agrees |= 1 << i


@compiled
def fuse(core: Core, subsets: NDArray[Any], doubtful: int) -> None:
    """Fused rate of the usable channels without the doubtful; with them, or none, if too little would be left."""
    n, last, sensors = core.settings.n, core.last, core.settings.sensors
    trusted = core.usable & ~doubtful
    core.withheld = False
    if doubtful and not subsets[trusted].spare:
        trusted = core.usable & ~core.evidence.outliers
        if not subsets[trusted].spare:
            trusted = core.usable
        if doubtful & trusted and not core.settings.publish_under_doubt:
            core.withheld, trusted = True, 0
    core.fused = trusted
    find_rate(subsets[trusted], n, trusted, core.z, last.rate)
    last.valid = not math.isnan(last.rate[0])
    for i in range(n):
        h = sensors.axes[i]
        along = h[0] * last.rate[0] + h[1] * last.rate[1] + h[2] * last.rate[2]
        core.variance[i] = variance_of(sensors, i, along, core.acceleration.value)
        if core.verdict.noise[i] > NOISE_SEEN:
            core.variance[i] += (core.verdict.noise[i] * core.verdict.noise[i] - 1.0) * (
                sensors.noise_std[i] * sensors.noise_std[i]
            )
        if core.bias.outcome == IN_MOTION:
            # What the biases have in common shows in no residual.
            core.variance[i] += core.remaining[i] * core.remaining[i]
        if doubtful & trusted & (1 << i):
            # It could not be left out: what it may be wrong by belongs into the covariance.
            doubt = core.doubt[i]
            if doubt == 0 and subsets[trusted].sensitivity[i] > MIN_SENSITIVITY:
                # No verdict has put a figure on it: what the others say of it now.
                doubt = (core.z[i] - along) / subsets[trusted].sensitivity[i]
            core.variance[i] += doubt * doubt
        last.residual[i] = core.z[i] - along if math.isfinite(core.z[i]) else math.nan
    find_covariance(subsets[trusted], n, trusted, core.variance, last.covariance)


@compiled
def find_level(core: Core, subsets: NDArray[Any]) -> None:
    """Protection level of the fused rate; if it is still to be worked out for the channels fused, ``core.wanted``.

    It is for the errors that this sample may have, in its own motion. There is none without a fused rate, while a
    channel under suspicion has to be fused for want of others, and where the separation test fails, whatever the
    detector says.
    """
    last, subset = core.last, subsets[core.fused]
    passes = last.valid != 0
    for i in range(core.settings.n):
        if core.fused >> i & 1 and last.state[i] in (SUSPECT, AMBIGUOUS):
            passes = False
    core.wanted = core.fused if passes and not subset.has_level else 0
    n, sensors = core.settings.n, core.settings.sensors
    find_growth(n, sensors.noise_std, core.variance, core.remaining, core.growth)
    find_level_of(subset, n, core.fused, core.growth, last.level)
    if not passes or not passes_test(
        subset, sensors.axes, sensors.noise_std, n, core.fused, core.growth, last.residual
    ):
        for a in range(3):
            last.level[a] = math.inf
