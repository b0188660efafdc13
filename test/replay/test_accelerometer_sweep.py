# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sweeps of accelerometer faults: sizes in m/s^2, and continuing from a snapshot of both halves."""

from dataclasses import replace

import numpy as np
import pytest
from monitor.test_accelerometers import flight, settings

from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.sweep import (
    Plan,
    Subject,
    judged_with,
    onsets_of,
    parse_swept,
    sweep,
)
from fdi_ros.replay.sweep_report import lines_of, sweep_figures, sweep_text

pytestmark = pytest.mark.usefixtures("compiled")
BIAS = "channel=accelerometers kind=bias size=0.001,3"


@pytest.fixture(scope="module")
def block():
    return flight(1000)[0]


def test_sizes_of_accelerometers_are_in_their_unit_and_strike_no_gyro(block):
    plan = Plan(
        parse_swept(BIAS) + parse_swept("kind=bias size=0.3"), times=1, within=2.0
    )
    (tried,) = sweep([Subject("own", settings(), block)], plan)
    small, large, gyros = lines_of(tried, plan)
    assert (small.trials, large.trials, gyros.trials) == (9, 9, 9)
    assert (small.count(named=True), large.count(named=True)) == (0, 9)
    assert gyros.count(named=True) == 9
    assert large.false == small.false == gyros.false == 0
    struck = {t.swept.channels: set() for t in tried.trials}
    for trial in tried.trials:
        struck[trial.swept.channels].add(tried.channels[trial.channel])
    assert all(".accel_" in name for name in struck["accelerometers"])
    assert not any(".accel_" in name for name in struck["gyros"])
    text = sweep_text([tried], plan, "bag")
    assert "accelerometer bias 3 m/s^2" in text
    assert "bias 0.3 rad/s" in text
    figures = sweep_figures([tried], plan, "bag")["monitors"][0]
    assert figures["smallest"]["named"] == {"accelerometer bias": 3.0, "bias": 0.3}
    assert [one["channels"] for one in figures["faults"]] == [
        "accelerometers",
        "accelerometers",
        "gyros",
    ]


@pytest.mark.parametrize("channel", ["imu_2.accel_z", "imu_1.y"])
def test_continuing_from_a_snapshot_equals_the_full_replay(block, channel):
    pipeline = Pipeline(settings())
    later, earlier = reversed(list(onsets_of(pipeline, block, (3.0, 6.0), 1.5)))
    for onset in (later, earlier):
        fault = parse_fault(f"channel={channel} kind=bias size=1 start={onset.at}")
        found = judged_with(pipeline, onset, fault)
        end = int(np.searchsorted(block.stamp, onset.block.stamp[-1])) + 1
        names = pipeline.channel_names
        full = Pipeline(settings()).process(Injector([fault], names).apply(block[:end]))
        first = end - len(found)
        np.testing.assert_array_equal(found.state, full.state[first:])
        np.testing.assert_array_equal(found.residual, full.residual[first:])
        np.testing.assert_array_equal(
            found.acceleration.rate, full.acceleration.rate[first:]
        )
        assert (found.state != full.state[first - 1]).any()


def test_without_accelerometers_their_faults_are_refused_or_left_out(block):
    alone = replace(block, acceleration=None)
    plan = Plan(parse_swept(BIAS), times=1, within=2.0)
    with pytest.raises(FaultError, match="none are judged in this recording"):
        sweep([Subject("own", settings(), alone)], plan)
    both = Plan(parse_swept(BIAS) + parse_swept("kind=stuck"), times=1, within=2.0)
    (tried,) = sweep([Subject("own", settings(), alone)], both)
    assert [line.swept.words for line in lines_of(tried, both)] == ["stuck"]
    with pytest.raises(FaultError, match="'g1', expected gyros or accelerometers"):
        parse_swept("channel=g1 kind=stuck")
