# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sequential evidence: the sums and their run length, delays, what is no fault, and the bound of a single value."""

import math
from functools import cache, partial

import numpy as np
import pytest
from detectors.detector_trials import random_axes
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor.streams import RATE, SIGMA, START, declarations, mounted, parallel, swing
from vehicles import vehicle

from fdi_ros import FdiError, Geometry, NoiseModel
from fdi_ros.detectors.sequential import Sequential
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

UNIT = NoiseModel(1.0)
CONE = Geometry.two_triad_cone()
BOUND = {2.0: 18.8, 4.0: 5.2, 8.0: 1.6}
"""Least mean delay in samples at a run length of 3.6e8, by size in standard deviations (Moustakides 1986)."""


def sequential(geometry=CONE, noise=UNIT, **options):
    return Sequential(geometry, noise, **options)


def white(seed, rows, n=6):
    return np.random.default_rng(seed).standard_normal((rows, n))


def fault(channel, size):
    """Error of one channel (n,) that moves its normalised residual by so many standard deviations."""
    return size / CONE.sensitivity[channel] * np.eye(6)[channel]


@cache
def built():
    """One detector for many streams; building one anew takes longer than a short stream."""
    return sequential()


@cache
def memory(size, rows):
    built().reset()
    built().detect(size * white(99, rows))
    return built().states.copy()


def after(size, rows):
    """The detector after so much noise, of so many standard deviations as expected, which it then knows."""
    built().states[:] = memory(size, rows)
    return built()


fresh, measured, rested = (
    partial(after, 1.0, 0),
    partial(after, 1.0, 4000),
    partial(after, 0.2, 20_000),
)


@pytest.mark.parametrize(
    ("geometry", "noise"),
    [
        (CONE, UNIT),
        (Geometry.from_triads([np.eye(3)] * 3), UNIT),
        (CONE, NoiseModel([1, 2, 0.5, 1, 3, 1])),
    ],
)
def test_run_length_is_at_least_the_one_asked_for(geometry, noise):
    detector, samples, alarms = sequential(geometry, noise, run_length=1000), 0, 0
    for seed in range(30):
        detector.reset()
        z = white(seed, 4000, geometry.n) * noise.for_channels(geometry.n).noise_std
        alarm = detector.detect(z).alarm
        samples += int(alarm.argmax()) + 1 if alarm.any() else len(alarm)
        alarms += bool(alarm.any())
    assert alarms < 30
    assert samples > 1000 * max(alarms, 1)


@pytest.mark.parametrize(("size", "most"), [(2.0, 2.0), (4.0, 1.7), (8.0, 2.0)])
def test_delays_beside_the_optimal_bound(size, most):
    """After 40 s without a fault, over which the noise was measured."""
    delays = []
    for k in range(60):
        alarm = (
            measured()
            .detect(white(k, 200) + fault(k % 6, -size if k % 2 else size))
            .alarm
        )
        assert alarm.any()
        delays.append(int(alarm.argmax()) + 1)
    assert np.mean(delays) < most * BOUND[size]


def test_what_has_passed_is_forgotten():
    """Sums are bounded: a fault of any size and length leaves no more than noise takes away in minutes."""
    detector = measured()
    detector.detect(white(7, 5000) + fault(0, 1000.0))
    alarm = detector.detect(white(8, 40_000)).alarm
    assert alarm[0]
    assert not alarm[-1]


@settings(max_examples=20)
@given(
    size=st.floats(-1e7, 1e7),
    channel=st.integers(0, 5),
    at=st.integers(0, 699),
    common=st.booleans(),
)
def test_one_wild_value_never_alarms(size, channel, at, common):
    z = white(9, 700)
    # A spike that all channels have in the same measure is one of the rate at times.
    z[at, slice(None) if common else channel] += size
    assert not fresh().detect(z).alarm.any()


def test_a_bias_is_learned_and_what_comes_later_is_found():
    detector, z = sequential(noise=NoiseModel(1.0, bias_std=0.2)), white(11, 30_000)
    z += fault(3, 2.4 * 0.2)
    assert not detector.detect(z[:20_000]).alarm.any()
    found = detector.detect(z[20_000:] + fault(3, 1.0))
    assert found.alarm.any()
    assert found.suspects[found.alarm][:, 3].all()


def test_errors_that_motion_explains_never_alarm():
    """A turn as long as it likes, with scale factors up to three standard deviations off, and late instants."""
    rng, noise = (
        np.random.default_rng(12),
        NoiseModel(0.003, scale_std=0.002, timing_std=3e-4),
    )
    t = np.arange(20_000) / 100
    rate = np.stack(
        [np.sin(2 * t), 1.5 * np.cos(0.3 * t), np.full_like(t, 3.0)], axis=1
    )
    turning = np.gradient(rate, 0.01, axis=0)
    for _ in range(3):
        scale, delay = 0.002 * rng.uniform(-3, 3, 6), 3e-4 * rng.uniform(-3, 3, 6)
        z = (rate @ CONE.axes.T) * (1 + scale) + (turning @ CONE.axes.T) * delay
        assert (
            not sequential(noise=noise)
            .detect(z + rng.normal(0, 0.003, z.shape), turning)
            .alarm.any()
        )


def coloured(seed, correlation):
    z = white(seed, 6000)
    for k in range(1, len(z)):
        z[k] = correlation * z[k - 1] + math.sqrt(1 - correlation**2) * z[k]
    return z


def spiky(rng):
    z = white(10, 60_000)
    hit = rng.random(z.shape) < 0.002
    z[hit] += rng.choice([-1, 1], int(hit.sum())) * rng.uniform(5, 500, int(hit.sum()))
    return z


NOISES = {
    "twice as large at once": (
        measured,
        [2.0 * white(seed, 600) for seed in range(20)],
    ),
    "as expected after a long rest": (rested, [white(seed, 400) for seed in range(20)]),
    "coloured": (
        fresh,
        [coloured(seed, one) for seed in range(4) for one in (0.5, 0.9)],
    ),
    "of heavy tails": (
        fresh,
        [np.random.default_rng(13).standard_t(4, (40_000, 6)) / math.sqrt(2)],
    ),
    "with spikes now and then": (fresh, [spiky(np.random.default_rng(10))]),
}


@pytest.mark.parametrize(("detector", "streams"), NOISES.values(), ids=NOISES)
def test_noise_of_another_kind_is_no_fault(detector, streams):
    for z in streams:
        assert not detector().detect(z).alarm.any()


def rows_to_name(spells):
    """Mean samples until 10 SIGMA on imu_3.y are named, 3 s after the last spell of noise.

    In each spell the gyros of imu_3 are 13 times as noisy as before. Nothing may be named
    before the fault.
    """
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    seconds = np.arange(0.0, 44.0, 1.0 / RATE)
    onset = round(38.0 * RATE)
    rows = []
    for seed in range(6):
        z = SIGMA * white(seed, len(seconds), 9)
        for begin, end in spells:
            z[(seconds > begin) & (seconds < end), 6:] *= 13.0
        z[onset:, 7] += 10.0 * SIGMA
        pipeline.restart()
        output = pipeline.process(stamped(seconds, z))
        faulty = output.state == ChannelState.FAULTY
        assert not faulty[:onset].any()
        assert not np.delete(faulty, 7, axis=1).any()
        rows.append(np.argmax(faulty[:, 7]) - onset)
    return np.mean(rows)


def test_after_spells_of_noise_a_fault_is_named_nearly_as_soon_as_before():
    usual = rows_to_name([])
    assert 3 < usual < rows_to_name([(30.0, 35.0)]) < 2.0 * usual
    often = [(k, k + 1.0) for k in range(12, 36, 2)]
    assert rows_to_name(often) < 2.0 * usual


@pytest.mark.parametrize("silent", [0.2, 0.5, 0.9])
def test_a_unit_is_named_although_another_is_silent_for_a_while(silent):
    """All axes of imu_2 are off from 20 s on, and imu_1 is silent for 0.6 s soon after."""
    seconds = np.arange(0.0, 24.0, 1.0 / RATE)
    z = SIGMA * white(7, len(seconds), 9) + np.tile(0.5 * swing(seconds), 3)
    z[seconds >= 20.0, 3:6] += [0.5, -0.3, 0.2]
    since = seconds - 20.0 - silent
    z[(since >= 0.0) & (since < 0.6), :3] = np.nan
    output = Pipeline(parallel(3, detector__name="sequential")).process(
        stamped(seconds, z)
    )
    faulty = output.state == ChannelState.FAULTY
    assert not np.delete(faulty, [3, 4, 5], axis=1).any()
    assert not faulty[seconds < 20.5].any()
    assert faulty[seconds > 22.0][:, 3:6].all()


def test_noise_that_grows_fivefold_within_two_seconds_names_nobody():
    growth = np.concatenate([np.geomspace(1.0, 5.0, 200), np.full(400, 5.0)])[:, None]
    for seed in range(20):
        assert not measured().detect(growth * white(seed, 600)).isolated.any()


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(4, 12))
def test_any_axes_without_alarm_for_20_s(seed, n):
    rng = np.random.default_rng(seed)
    try:
        detector = sequential(random_axes(rng, n), NoiseModel(rng.uniform(0.5, 2.0, n)))
    except FdiError:
        return
    verdict = detector.detect(rng.standard_normal((2000, n)) * detector.noise.noise_std)
    assert np.isfinite(verdict.statistic).all()
    assert not verdict.alarm.any()


def stamped(seconds, z):
    return Block(START + (seconds * 1e9).astype(np.int64), z)


def test_an_undecided_set_leaves_the_culprit_as_evidence_grows():
    """Three parallel triads at rest in the monitor, after ten seconds with a bias of four noise_std on imu_2.y."""
    settings, sizes = (
        parallel(3, detector__name="sequential", bias__startup_bias_duration=3.0),
        [],
    )
    for seed in range(8):
        pipeline, z = Pipeline(settings), SIGMA * white(seed, 2500, 9)
        z[1000:, 4] += 4.0 * SIGMA
        output = pipeline.process(stamped(np.arange(2500) / RATE, z))
        sizes += [(output.state == ChannelState.AMBIGUOUS).sum(axis=1).max()]
        assert declarations(pipeline, output)[-1] == ("imu_2.y", "FAULTY")
        assert output.state[-1].tolist() == [
            ChannelState.FAULTY * (i == 4) for i in range(9)
        ]
    assert max(sizes) > 1


@pytest.mark.parametrize("value", [1.0, 34.95, np.inf])
@pytest.mark.parametrize("kind", ["rest and turns", "flight with rest"])
def test_single_spikes_teach_nothing_and_name_nobody(kind, value):
    """Sixty values far off: before the first motion no delay is known, and after it none is wrong."""
    one, rng, still = vehicle(2, kind, 3), np.random.default_rng(52), 1400
    axes = {
        "geometry.preset": "axes",
        "geometry.axes": one.axes.ravel().tolist(),
        "imus.mounts": [],
    }
    z = one.block.z.copy()
    at = rng.integers(len(z), size=60), rng.integers(9, size=60)
    z[at] = z[at] + 1.0 if value == 1.0 else value
    pipeline = Pipeline.from_config(one.config.replaced(axes))
    pipeline.process(Block(one.block.stamp[:still], z[:still]))
    assert min(pipeline.status().delay_std[1:]) > 0.01
    events = pipeline.process(Block(one.block.stamp[still:], z[still:])).events
    assert not [event for event in events if event.after is ChannelState.FAULTY]
    status = pipeline.status()
    assert (
        np.abs(np.subtract(status.delays, one.late))
        < 4 * np.array(status.delay_std) + 1e-4
    ).all()


def two_units(seconds, late, seed):
    """Two parallel units in quick motion, of which the second stamps its values late."""
    z = np.hstack([swing(seconds), swing(seconds - late)])
    z += SIGMA * white(seed, *z.shape)
    return Pipeline.from_config(parallel(2, detector__name="sequential")), stamped(
        seconds, z
    )


@pytest.mark.parametrize("hole", [0.02, 0.05, 0.1])
@pytest.mark.parametrize("late", [0.0, 0.015])
def test_holes_in_the_stream_teach_no_wrong_delay(hole, late):
    """Samples for 0.1 s, then none for a while, in quick motion: the instants are known, and so is the delay."""
    seconds = np.arange(0.0, 20.0, 1.0 / RATE)
    pipeline, stream = two_units(seconds[seconds % (0.1 + hole) < 0.1], late, 3)
    output = pipeline.process(stream)
    assert not np.isin(
        output.state, (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
    ).any()
    status = pipeline.status()
    assert abs(status.delays[1] - late) < 3.5 * status.delay_std[1] + 1e-4
    assert status.delay_std[1] < 0.002


def own_noise(seconds, rng):
    """Noise of 0.3 rad/s in every channel."""
    return 0.3 * rng.standard_normal((len(seconds), 6))


def own_vibration(seconds, rng):
    """Units oscillate by 0.1 rad/s at the same three frequencies, each in its own way."""
    total = np.zeros((len(seconds), 6))
    for hertz in rng.uniform(2.0, 12.0, 3):
        phase = np.repeat(rng.uniform(0.0, 2 * np.pi, 2), 3)
        size = 0.1 * rng.standard_normal(6)
        total += size * np.sin(2 * np.pi * hertz * seconds[:, None] + phase)
    return total


@pytest.mark.parametrize("shown", [own_noise, own_vibration])
def test_noise_and_vibration_that_units_do_not_share_teach_no_delay(shown):
    """Two units at rest, from 20 s on with much more than the settings expect."""
    seconds = np.arange(0.0, 60.0, 1.0 / RATE)
    pipeline = Pipeline.from_config(parallel(2, detector__name="sequential"))
    for seed in range(8):
        rng = np.random.default_rng([seed, 11])
        z = SIGMA * white(seed, len(seconds))
        z += (seconds > 20.0)[:, None] * shown(seconds, rng)
        pipeline.restart()
        pipeline.process(stamped(seconds, z))
        status = pipeline.status()
        assert abs(status.delays[1]) < 3.0 * status.delay_std[1]


def test_shared_noise_stays_a_covariance_while_channels_are_missing():
    """Two units oscillate, then one of their channels is missing and the others are quiet."""
    seconds = np.arange(0.0, 8.0, 1.0 / RATE)
    share = np.array([1, 2, 1, -2, 1, 1, 0, 0, 0])
    vibration = 0.03 * np.sin(2 * np.pi * 7.0 * seconds) * (seconds < 5.0)
    z = np.hstack([swing(seconds)] * 3) + SIGMA * white(1, len(seconds), 9)
    z += np.outer(vibration, share)
    z[seconds > 5.0, 1] = np.nan
    pipeline = Pipeline.from_config(parallel(3, detector__name="sequential"))
    pipeline.process(stamped(seconds, z))
    shared = pipeline.detector.states[0]["estimator"]["shared"]
    for name in ("outer", "line_covariance"):
        # The lower triangle is read.
        spectrum = np.linalg.eigvalsh(shared[name][:9, :9])
        assert spectrum.min() > -1e-9 * spectrum.max(), name


@pytest.mark.parametrize("together", [1, 3])
def test_the_covariance_is_true_while_values_are_missing(together):
    """Two units lose 10 % of the values, by chance: of single channels, or of whole units."""
    seconds = np.arange(0.0, 40.0, 1.0 / RATE)
    motion = swing(seconds, 0.3) * np.clip(seconds - 3.0, 0.0, 1.0)[:, None]
    pipeline = Pipeline.from_config(parallel(2, detector__name="sequential"))
    for seed in range(4):
        rng = np.random.default_rng([seed, 12])
        z = np.tile(motion, 2) + 0.002 * rng.standard_normal(6)
        z += SIGMA * white(seed, len(seconds))
        lost = rng.random((len(seconds), 6 // together)) < 0.1
        z[np.repeat(lost, together, axis=1)] = np.nan
        pipeline.restart()
        output = pipeline.process(stamped(seconds, z))
        rows = output.valid & (seconds > 5.0)
        error = (output.rate - motion)[rows]
        weighed = np.linalg.solve(output.covariance[rows], error[..., None])[..., 0]
        chi = np.einsum("ki,ki->k", error, weighed)
        assert 0.5 < chi.mean() / 3.0 < 1.1
        # Chi-square with 3 degrees of freedom reaches this in one of 5e7 samples.
        assert chi.max() < 37.0


@pytest.mark.parametrize("size", [-0.03, 0.03])
def test_the_mean_of_a_channel_is_that_of_the_samples_it_has_given(size):
    """In a turn of 1 rad/s one unit loses one of 20 samples, and a channel of another one is off."""
    seconds = np.arange(0.0, 25.0, 1.0 / RATE)
    turn = np.clip(seconds - 3.0, 0.0, 1.0)[:, None] * np.array([1.0, 0.8, -0.9])
    pipeline = Pipeline.from_config(parallel(3, detector__name="sequential"))
    z = np.tile(turn, 3) + SIGMA * white(5, len(seconds), 9)
    z[seconds >= 20.0, 7] += size
    z[::20, 3:6] = np.nan
    output = pipeline.process(stamped(seconds, z))
    (event,) = [one for one in output.events if one.after == ChannelState.FAULTY]
    assert pipeline.channel_names[event.channel] == "imu_3.y"
    assert event.error == pytest.approx(size, rel=0.1)
    assert 20.1 < 1e-9 * (event.stamp - START) < 20.5


@pytest.mark.parametrize("hertz", [6.3, 9.7])
def test_a_slow_motion_under_loud_noise_is_no_rest(hertz):
    """A unit that oscillates by 0.4 rad/s hides how the body turns; no bias is learned of it."""
    seconds = np.arange(0.0, 40.0, 1.0 / RATE)
    pipeline = Pipeline.from_config(
        parallel(2, detector__name="sequential", bias__startup_bias_duration=0.0)
    )
    for seed in range(2):
        axis = np.random.default_rng(seed).standard_normal(3)
        since = np.maximum(seconds - 20.0, 0.0)
        z = np.hstack([swing(seconds, 0.04)] * 2) + SIGMA * white(seed, len(seconds))
        loose = 0.4 * np.sin(2 * np.pi * hertz * since)
        z[:, 3:] += np.outer(loose, axis / np.linalg.norm(axis))
        pipeline.restart()
        pipeline.process(stamped(seconds, z))
        bias = pipeline.detector.states[0]["estimator"]["states"]["x"][:6]
        assert np.abs(bias).max() < 0.001


def test_units_may_be_listed_in_any_order():
    """The second and the third of three units, the third with vibration of its own."""
    seconds = np.arange(0.0, 8.0, 1.0 / RATE)
    begins = np.clip(seconds - 3.0, 0.0, 1.0)[:, None]
    z = np.hstack([swing(seconds)] * 3) + SIGMA * white(1, len(seconds), 9)
    vibration = own_vibration(seconds, np.random.default_rng(1))
    z[:, 6:] += 0.3 * vibration[:, 3:] * begins
    pipeline = Pipeline.from_config(parallel(3, detector__name="sequential"))
    pipeline.process(stamped(seconds, z))
    first, second, third = pipeline.status().delay_std
    pipeline.restart()
    pipeline.process(stamped(seconds, z[:, [0, 1, 2, 6, 7, 8, 3, 4, 5]]))
    expected = pytest.approx((first, third, second), rel=2e-3)
    assert pipeline.status().delay_std == expected


def std_of_delay(rate, late, seconds, seed):
    """Return the standard deviation of the delay of the second of two units, s. Its error is within three of them."""
    z = np.hstack([rate(seconds), rate(seconds - late)])
    z += SIGMA * white(seed, len(seconds))
    pipeline = Pipeline.from_config(parallel(2, detector__name="sequential"))
    pipeline.process(stamped(seconds, z))
    status = pipeline.status()
    assert abs(status.delays[1] - late) < 3.0 * status.delay_std[1]
    return status.delay_std[1]


@pytest.mark.parametrize("late", [0.0, 0.005, 0.02])
def test_a_delay_is_learned_in_slow_motion(late):
    """At 0.3 rad/s, with periods of 5 s and more, well within a minute."""
    seconds = np.arange(0.0, 60.0, 1.0 / RATE)

    def rate(t):
        turn = np.sin(np.outer(t, [0.6, 0.9, 1.2]))
        return 0.3 * np.clip(t - 6.0, 0.0, 1.0)[:, None] * turn

    assert std_of_delay(rate, late, seconds, 5) < 0.006


def turning(pipeline, turn, seconds, seed):
    """Values (N, 6) of the cone from 6 s on in turns of so many rad/s, scale factors and axes off by 0.2 %."""
    rng = np.random.default_rng([seed, 60])
    axes = pipeline.geometry.axes + 0.002 * rng.standard_normal((6, 3))
    hertz, phase = rng.uniform(0.1, 0.3, 3), rng.uniform(0.0, 2 * np.pi, 3)
    rate = turn * np.sin(2 * np.pi * np.outer(seconds, hertz) + phase)
    begins = np.clip(seconds - 6.0, 0.0, 1.0)[:, None]
    noise = pipeline.config.noise.noise_std[0]
    return begins * rate @ axes.T + noise * white(seed, len(seconds))


def test_in_turns_white_noise_has_no_tails_and_a_fault_is_declared_soon():
    """A bias of eight standard deviations of one channel, a minute after the start.

    The uncertainty of scale factors comes and goes with the turns, and is no change of the noise.
    """
    seconds = np.arange(0.0, 62.0, 1.0 / RATE)
    pipeline = Pipeline.from_config("two_imus.yaml")
    size = 8.0 * pipeline.config.noise.noise_std[0]
    delays, degrees = [], []
    for seed in range(12):
        z = turning(pipeline, 0.5, seconds, seed)
        z[6000:, seed % 6] += size
        pipeline.restart()
        state = pipeline.process(stamped(seconds, z)).state[:, seed % 6]
        noise = pipeline.detector.states[0]["estimator"]["noise"]
        degrees.append(noise["degrees"][:6].mean())
        declared = (state == ChannelState.AMBIGUOUS) | (state == ChannelState.FAULTY)
        assert not declared[:6000].any()
        assert declared[6000:].any()
        delays.append(int(declared[6000:].argmax()) + 1)
    assert np.mean(degrees) > 30.0
    assert np.mean(delays) < 5.0 * BOUND[8.0]


def slow_turns(seconds, rng):
    """Turns of 0.2 to 0.6 rad/s that begin at 8 s, at 0.1 to 0.6 Hz about each axis."""
    hertz = rng.uniform(0.1, 0.6, 3)
    phase = rng.uniform(0.0, 2 * np.pi, 3)
    size = rng.uniform(0.2, 0.6)
    begins = np.clip((seconds - 8.0) / 2.0, 0.0, 1.0)[:, None]
    return size * begins * np.sin(2 * np.pi * np.outer(seconds, hertz) + phase)


@pytest.mark.parametrize("size", [0.05, 0.3])
@pytest.mark.parametrize("share", [0.15, 2.0])
def test_vibration_with_a_phase_of_its_own_on_each_axis_is_no_delay(size, share):
    """At one frequency a phase is a delay, but each axis of a unit shows another one.

    Gains and phases of the units differ by this share, or by anything.
    """
    seconds = np.arange(0.0, 60.0, 1.0 / RATE)
    pipeline = Pipeline.from_config(parallel(2, detector__name="sequential"))
    errors = []
    for seed in range(16):
        rng = np.random.default_rng([seed, 48])
        late = rng.choice([-0.004, 0.0, 0.004])
        hertz = rng.uniform(2.0, 12.0)
        z = SIGMA * white(seed, len(seconds))
        seed_of_turns = rng.integers(1 << 30)
        for unit, delay in enumerate((0.0, late)):
            t = seconds - delay
            gain = 1.0 + 0.15 * rng.standard_normal(3)
            phase = share * rng.standard_normal(3)
            shaken = size * gain * np.sin(2 * np.pi * hertz * t[:, None] + phase)
            turns = slow_turns(t, np.random.default_rng(seed_of_turns))
            z[:, 3 * unit : 3 * unit + 3] += turns + (t > 8.0)[:, None] * shaken
        pipeline.restart()
        pipeline.process(stamped(seconds, z))
        status = pipeline.status()
        errors.append(abs(status.delays[1] - late) / status.delay_std[1])
    assert max(errors) < 3.0


@pytest.mark.parametrize("late", [0.0, 0.005, 0.02])
@pytest.mark.parametrize("hertz", [0.6, 1.5, 3.0])
def test_a_delay_is_learned_within_seconds_of_motion(late, hertz):
    """Units that see one motion show their delay, however quick the motion is."""
    seconds = np.arange(0.0, 14.0, 1.0 / RATE)

    def rate(t):
        turn = np.sin(2 * np.pi * hertz * np.outer(t, [1.0, 0.8, 1.2]))
        return 0.5 * np.clip(t - 6.0, 0.0, 1.0)[:, None] * turn

    assert std_of_delay(rate, late, seconds, 6) < 0.0015


def flown_with_a_hole(units, hole, fault, seed):
    """Parallel units in motion, no samples from 12 s on for so many s, in which imu_2.y comes to be off."""
    rng, seconds = (
        np.random.default_rng([units, seed]),
        np.arange(0.0, 24.0 + hole, 1.0 / RATE),
    )
    rate = swing(seconds) * np.clip((seconds[:, None] - 4.0) / 2.0, 0.0, 1.0)
    # Biases, their walk and their warming as the settings allow.
    bias = rng.normal(0.0, 0.01, 3 * units) + np.outer(
        seconds, rng.normal(0.0, 5e-6, 3 * units)
    )
    bias = bias + np.cumsum(
        5e-5 / math.sqrt(RATE) * rng.standard_normal(bias.shape), axis=0
    )
    z = np.hstack([rate] * units) + bias + SIGMA * rng.standard_normal(bias.shape)
    z[seconds > 12.0 + hole / 2, 4] += fault
    there = (seconds < 12.0) | (seconds >= 12.0 + hole)
    pipeline = Pipeline.from_config(parallel(units, detector__name="sequential"))
    return pipeline.process(stamped(seconds[there], z[there]))


@pytest.mark.parametrize("hole", [2.0, 6.0, 20.0])
@pytest.mark.parametrize("units", [2, 3])
def test_a_fault_that_begins_in_a_hole_is_found_and_none_without(units, hole):
    """10 mrad/s: of three units the channel by name, of two the two channels that disagree, in 4 s."""
    for seed in range(4):
        state = flown_with_a_hole(units, hole, 0.0, seed).state
        assert not np.isin(state, (ChannelState.FAULTY, ChannelState.AMBIGUOUS)).any()
        if hole < 20.0:
            found = flown_with_a_hole(units, hole, 0.01, seed).state[1600]
            faulty, doubtful = (
                np.flatnonzero(found == one)
                for one in (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
            )
            assert (faulty.tolist(), doubtful.tolist()) == (
                ([4], []) if units == 3 else ([], [1, 4])
            )


@pytest.mark.parametrize("offset", [-0.04, -0.02, 0.02, 0.04])
def test_after_a_reset_a_clock_that_was_set_is_followed(offset):
    seconds = np.arange(0.0, 60.0, 1.0 / RATE)
    pipeline, stream = two_units(seconds, offset * (seconds > 20.0), 4)
    before = pipeline.process(stream[:3000])
    assert (before.state[-1] == ChannelState.AMBIGUOUS).all()
    pipeline.reset()
    after = pipeline.process(stream[3000:])
    assert (after.state[-1] == ChannelState.OK).all()
    status = pipeline.status()
    assert abs(status.delays[1] - offset) < 4 * status.delay_std[1] + 1e-4
    assert status.delay_std[1] < 0.001


@pytest.mark.parametrize("size", [0.03, 0.3])
def test_the_level_covers_a_pair_that_has_the_third_named(size):
    """Two of three parallel gyros that are wrong alike from 12 s on, as parity must see it."""
    axes, seconds = np.tile(np.eye(3), (3, 1)), np.arange(3000) / RATE
    rate = swing(seconds) * (seconds > 5.0)[:, None]
    z = rate @ axes.T + SIGMA * white(1, 3000, 9)
    z[1200:, [0, 3]] += size
    output = Pipeline(mounted(axes, bias__startup_bias_duration=4.0)).process(
        stamped(seconds, z)
    )
    assert [
        event.channel for event in output.events if event.after is ChannelState.FAULTY
    ] == [6]
    assert (np.abs(output.rate - rate) <= output.level)[1301:].all()
    assert size < output.level[1301:, 0].max() < size + 0.1
