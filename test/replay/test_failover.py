# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Orders of failover in a recording: the same evidence as on a live vehicle."""

import numpy as np
import pytest

from fdi_ros.config.config import Config
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.failover import FailoverReplay, is_possible
from fdi_ros.replay.run import Walk

CONFIG = Config.of("ardupilot")
NAMES = CONFIG.channel_names
INTERVAL = 20_000_000


def recorded(seconds=60.0, seed=1, interval=INTERVAL):
    """Rates of three IMUs in gentle motion, (N, 9) rad/s."""
    t = np.arange(0.0, seconds, interval * 1e-9)
    rates = np.column_stack(
        [0.5 * np.sin(0.8 * t), 0.4 * np.cos(1.1 * t), 0.3 * np.sin(0.5 * t)]
    )
    noise = np.random.default_rng(seed).normal(0.0, 0.002, (len(t), 9))
    return np.round(np.tile(rates, 3) + noise, 3)


def orders(rates, config=CONFIG):
    """Orders in a recording, by what is said before " at ", and their times, s."""
    replay = FailoverReplay(config.channel_names, config.sample_rate)
    stamp = 10**18 + INTERVAL * np.arange(len(rates))
    Walk(Pipeline(config), [replay]).take(Block(stamp, rates))
    _, _, text = replay.text().partition(": ")
    pairs = [order.split(" at ") for order in text.split("; ")]
    return [(words, float(time.split()[0])) for words, time in pairs]


def test_a_healthy_recording_has_no_order():
    replay = FailoverReplay(NAMES, CONFIG.sample_rate)
    Walk(Pipeline(CONFIG), [replay]).take(Block(INTERVAL * np.arange(3000), recorded()))
    assert replay.text() == (
        "what failover would have done if armed: no IMU out of use"
        " (it acts on errors of 0.03 rad/s and more)"
    )


@pytest.mark.parametrize(
    ("error", "latest"), [((0.0, 0.2, 0.0), 0.3), ((0.7, -0.9, 0.8), 0.1)]
)
def test_the_orders_of_failover_in_a_recording(error, latest):
    """Of a whole unit the raw rates alone are enough before the monitor names any axis."""
    rates = recorded()
    rates[1500:2000, 3:6] += error
    (out, begin), (back, end) = orders(rates)
    assert out == "IMU 2 out of use"
    assert back == "IMU 2 in use again"
    assert 30.0 <= begin <= 30.0 + latest
    assert 42.0 <= end <= 42.5


@pytest.mark.parametrize("frequency", [49.8, 100.3])
def test_vibration_near_a_multiple_of_50_hz_is_no_error_in_a_fast_recording(frequency):
    """Compared every 20 ms it would be a slow error of 0.8 rad/s."""
    interval = 5_000_000
    rates = recorded(30.0, interval=interval)
    t = 0.005 * np.arange(len(rates))
    rates[:, 6] += 0.8 * np.sin(2.0 * np.pi * frequency * t) * (t > 20.0)
    config = CONFIG.replaced({"sample_rate": 200.0})
    replay = FailoverReplay(NAMES, config.sample_rate)
    Walk(Pipeline(config), [replay]).take(Block(interval * np.arange(len(t)), rates))
    assert "no IMU out of use" in replay.text()


def test_failover_works_with_two_or_three_imus_of_three_channels():
    counts = [n for n in range(20) if is_possible(NAMES[:1] * n)]
    assert counts == [6, 9]


def test_an_imu_keeps_its_number_where_the_log_lacks_another():
    """IMU 1, 3 and 4: the second unit of the recording is IMU 3 of the autopilot."""
    names = ["imu_1", "imu_3", "imu_4"]
    changes = {"imus.topics": [f"/{name}" for name in names], "imus.names": names}
    rates = recorded()
    rates[1500:2000, 3:6] += (0.7, -0.9, 0.8)
    assert orders(rates, CONFIG.replaced(changes))[0][0] == "IMU 3 out of use"


def test_of_two_imus_a_frozen_one_stays_in_use():
    """Nothing checks the other one meanwhile, which may be wrong as well."""
    changes = {"imus.topics": ["/imu_1", "/imu_3"], "imus.mounts": []}
    config = CONFIG.replaced({**changes, "imus.names": ["imu_1", "imu_3"]})
    rates = recorded()[:, :6]
    rates[1500:2000, 3:6] = rates[1499, 3:6]
    replay = FailoverReplay(config.channel_names, config.sample_rate)
    Walk(Pipeline(config), [replay]).take(Block(INTERVAL * np.arange(3000), rates))
    assert "no IMU out of use" in replay.text()
