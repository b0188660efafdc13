# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bytes of messages in, bytes out: what the live node does with each message, without a node."""

import gc

import numpy as np
import pytest
from monitor.streams import START, config, parallel, run, stream

from fdi_ros.core.alignment import Alignment
from fdi_ros.core.live import HAS_EVENTS, HAS_RATE, MORE, SUPPLY, WORKED
from fdi_ros.core.messages import ChannelsTemplate, ImuTemplate
from fdi_ros.core.sources import ChannelsSource, ImuSource
from fdi_ros.monitor.output import FUSED, INTEGRITY, ChannelState
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import Receiver, SilenceClock, Watchdog

STEP = 10_000_000


class Ear:
    """Takes what a receiver would have a node publish."""

    def __init__(self, pipeline):
        self.receiver = Receiver(pipeline)
        self.fused, self.integrity, self.events = [], [], []

    def take(self, inlet, data, stamp=0):
        flags = self.receiver.receive(inlet, data, stamp)
        while flags:
            if flags & SUPPLY:
                self.receiver.supply()
            if flags & HAS_RATE:
                self.fused.append(self.receiver.message(FUSED))
            if flags & WORKED:
                self.integrity.append(self.receiver.message(INTEGRITY))
            if flags & HAS_EVENTS:
                self.events += self.receiver.events
            flags = self.receiver.go_on() if flags & MORE else 0

    def rates(self):
        return dict(ImuSource.parse(data, 3) for data in self.fused)


def messages(block, units):
    """The Imu messages of a stream: unit and bytes, the units of one sample half a millisecond apart."""
    template = ImuTemplate("imu")
    for stamp, row in zip(
        block.stamp.tolist(),
        block.z.reshape(len(block), units, 3).tolist(),
        strict=True,
    ):
        for unit in range(units):
            yield unit, template.fill(stamp + unit * 500_000, row[unit], (0.0,) * 9)


@pytest.mark.parametrize("units", [2, 3, 4])
def test_message_by_message_equals_the_whole_stream(units):
    settings = parallel(
        units,
        bias__startup_bias_duration=0.5,
        bias__max_rest_rate=10.0,
        noise__timing_std=1e-4,
    )
    ear, offline = Ear(Pipeline(settings)), Pipeline(settings)
    faults = (
        "channel=imu_2.y kind=bias size=0.5 start=2",
        "channel=imu_1.x kind=dropout start=3 stop=3.2",
    )
    block, _ = run(Pipeline(settings), 400, *faults, size=0.02)
    sent = list(messages(block, units))
    for unit, data in sent:
        ear.take(unit, data)
    stamps, values = zip(*(ImuSource.parse(data, 3) for _, data in sent), strict=True)
    given = np.array([unit for unit, _ in sent]), np.array(stamps), np.array(values)
    output = offline.process(
        Alignment(units, 2_000_000, 100_000_000).push_block(*given)
    )
    assert list(ear.events) == list(output.events)
    figures = np.array(
        [ChannelsSource.parse(data, 3 * units + 7)[1] for data in ear.integrity]
    )
    np.testing.assert_array_equal(figures[:, 0], output.statistic)
    np.testing.assert_array_equal(figures[:, 2 : 2 + 3 * units], output.state)
    np.testing.assert_array_equal(figures[:, -5:-2], output.level)
    assert (figures[:, -2:] @ [10**9, 1] == output.stamp).all()
    assert [*ear.rates()] == output.stamp[output.valid].tolist()
    np.testing.assert_array_equal([*ear.rates().values()], output.rate[output.valid])
    assert offline.core.tobytes() == ear.receiver.pipeline.core.tobytes()


@pytest.mark.parametrize(
    ("rate", "timeout"), [(10.0, 0.4), (39.0, 4 / 39), (100.0, 0.1)]
)
def test_slow_samples_are_waited_for_four_intervals_and_fast_ones_as_configured(
    rate, timeout
):
    alignment = Receiver(Pipeline(parallel(2, sample_rate=rate))).source.alignment
    assert alignment[2] == pytest.approx(1e9 * timeout)


def test_silence_is_judged_by_the_steady_clock_where_the_clock_stands():
    second, clock = 10**9, SilenceClock()
    watchdog = Watchdog(second // 10)
    # A simulation at a twentieth of real time, with a clock that steps by 20 ms.
    for k in range(200):
        watchdog.check(
            k, clock.read(5 * second + k // 40 * second // 50, k * second // 100)
        )
        assert not clock.standing
        assert not watchdog.silent
    # The clock and the messages stand, and later both go on.
    before, moved = 5 * second + 4 * second // 50, 160 * second // 100
    for steady, silent in ((1.9, False), (2.05, False), (2.2, True), (9.0, True)):
        watchdog.check(199, clock.read(before, moved + round(steady * second)))
        assert watchdog.silent == silent
        assert clock.standing == (pytest.approx(steady) if steady > 2 else 0)
    watchdog.check(200, clock.read(before + second, moved + 10 * second))
    assert not watchdog.silent
    assert not clock.standing


def test_arrays_are_stamped_when_they_arrive_even_by_a_clock_set_back():
    pipeline = Pipeline(config())
    ear, template, z = (
        Ear(pipeline),
        ChannelsTemplate(6),
        stream(pipeline.geometry, 60).z.tolist(),
    )
    clock = (
        [START + k * STEP for k in range(20)]
        + [START + 19 * STEP]
        + [START - 10**9 + k * STEP for k in range(39)]
    )
    for stamp, values in zip(clock, z, strict=True):
        ear.take(0, template.fill(values), stamp)
    stamps = list(ear.rates())
    assert len(stamps) == 60
    assert ear.receiver.restarts == 1
    # A clock that stands still for a moment is waited out; one set back is followed, and the messages say its time.
    assert stamps[20] == START + 19 * STEP + 1
    assert stamps[22:] == clock[22:]


@pytest.mark.parametrize("leap", [-0.06, -0.03, 0.004, 0.03, 0.06])
@pytest.mark.parametrize("motion", [0.0, 1.0])
def test_a_clock_that_leaps_once_by_less_than_the_timeout_blames_no_other_unit(
    leap, motion
):
    """From the leap on the unit tells of another instant: in motion it disagrees by as much; a few ms are a delay."""
    pipeline, template = (
        Pipeline(parallel(3, detector__name="sequential")),
        ImuTemplate("imu"),
    )
    ear, block = Ear(pipeline), stream(pipeline.geometry, 1200, size=motion)
    for k, (stamp, row) in enumerate(
        zip(block.stamp.tolist(), block.z.reshape(1200, 3, 3).tolist(), strict=True)
    ):
        for unit in range(3):
            leapt = unit == 1 and k >= 800
            ear.take(
                unit,
                template.fill(stamp + round(1e9 * leap) * leapt, row[unit], (0.0,) * 9),
            )
    assert len(ear.fused) == len(ear.integrity) >= 1190, "a rate in every sample"
    declared = [event for event in ear.events if event.declares]
    assert bool(declared) == (motion > 0.0 and abs(leap) > 0.01)
    assert {event.channel for event in declared[:3]} <= {3, 4, 5}
    assert all((event.stamp - block.stamp[800]) / 1e9 < 0.3 for event in declared[:3])
    assert {
        event.channel for event in declared if event.after == ChannelState.FAULTY
    } <= {3, 4, 5}
    counts = ear.receiver.counts(1)
    lost = counts["missing"] if leap > 0 else counts["duplicate"] + counts["backward"]
    assert lost == (0 if leap == 0.004 else round(abs(leap) / 0.01))


def test_a_detector_that_is_replaced_under_way_is_the_one_that_is_asked():
    """Compiled code reaches constants by their address: those of the detector before must not be asked any more."""
    pipeline = Pipeline(parallel(3))
    ear, block = Ear(pipeline), stream(pipeline.geometry, 100)
    names, thresholds = ("cusum", "guaranteed", "recursive", "likelihood_ratio"), []
    for k, (unit, data) in enumerate(messages(block, 3)):
        if k % 60 == 59:
            thresholds.append(ChannelsSource.parse(ear.integrity[-1], 16)[1][1])
            pipeline.reconfigure(
                pipeline.config.replaced({"detector.name": names[k // 60 % 4]})
            )
            gc.collect()
        ear.take(unit, data)
    assert len(ear.integrity) >= 99
    assert len(set(thresholds[1:])) == len(names)
    assert pipeline.status().detector in names


def test_the_last_stamp_is_that_of_the_newest_sample_of_imus():
    """The check of the sample rate takes it."""
    pipeline = Pipeline(parallel(2, detector__name="sequential"))
    block = stream(pipeline.geometry, 50)
    ear = Ear(pipeline)
    for unit, data in messages(block, 2):
        ear.take(unit, data)
    behind = block.stamp[-1] - ear.receiver.last_stamp
    assert abs(behind) < 0.02e9
