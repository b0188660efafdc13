# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Every kind of fault in an accelerometer changes that channel alone, while the fault lasts."""

import re

import numpy as np
import pytest
from monitor.test_accelerometers import flight, settings

from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.monitor.accelerometers import accelerometer_names
from fdi_ros.monitor.building import build_geometry

FAULTY = "imu_2.accel_y"
OPTIONS = {
    "bias": "size=2",
    "drift": "size=1",
    "scale": "size=1",
    "stuck": "",
    "dropout": "",
    "intermittent": "size=3 period=0.5",
    "noise": "size=3",
    "spike": "size=20 rate=3",
    "saturation": "size=0.5",
    "sign": "",
    "delay": "size=40",
    "oscillation": "size=3 frequency=2",
    "triad_loss": "",
}


def test_every_kind_is_tried():
    assert set(OPTIONS) == set(FAULT_KINDS)


@pytest.mark.parametrize("kind", OPTIONS)
def test_a_fault_strikes_its_accelerometer_alone(kind):
    block, config = flight(1000)[0], settings()
    whole = FAULT_KINDS[kind].whole_unit
    channel = "imu_2" if whole else FAULTY
    fault = parse_fault(
        f"channel={channel} kind={kind} {OPTIONS[kind]} start=4 stop=8 seed=1"
    )
    names = (
        *build_geometry(config).channel_names,
        *accelerometer_names(config, range(3)),
    )
    faulty = Injector([fault], names).apply(block)
    before = np.hstack([half.z for half in block.halves])
    after = np.hstack([half.z for half in faulty.halves])
    changed = (before != after).any(axis=0)
    struck = {names[i] for i in np.flatnonzero(changed)}
    expected = {name for name in names if name.startswith("imu_2.")}
    assert struck == (expected if whole else {FAULTY})
    inside = (block.stamp - block.stamp[0]) * 1e-9
    rows = (inside >= 4.0) & (inside < 8.0)
    np.testing.assert_array_equal(before[~rows], after[~rows])


@pytest.mark.parametrize(
    ("channel", "words"),
    [
        ("imu_1.accel_x", "in m/s^2"),
        ("imu_1.accel", "in m/s^2"),
        ("imu_1.x", "in rad/s"),
    ],
)
def test_a_missing_size_is_asked_for_in_the_unit_of_the_channel(channel, words):
    with pytest.raises(FaultError, match=re.escape(f"needs size {words}") + "$"):
        parse_fault(f"channel={channel} kind=bias")
    unit = words.removeprefix("in ")
    with pytest.raises(FaultError, match=re.escape(unit)):
        parse_fault(f"channel={channel} kind=bias size=1e9")
