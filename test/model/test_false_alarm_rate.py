# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One false-alarm rate, however it is stated."""

from __future__ import annotations

import pytest

from fdi_ros.errors import ConfigError
from fdi_ros.model.thresholds import FalseAlarmRate

RATE = {"run_length", "false_alarms_per_hour", "sample_rate"}
"""Options of a detector that takes a run length."""


def test_three_ways_to_state_the_same() -> None:
    hourly = FalseAlarmRate(per_hour=1e-3, sample_rate=100.0)
    assert hourly.per_sample() == pytest.approx(2.7778e-9, rel=1e-4)
    assert hourly.mean_run_length() == pytest.approx(3.6e8)
    single = FalseAlarmRate(1e-4)
    assert single.per_sample() == 1e-4
    assert single.mean_run_length() == pytest.approx(1e4)
    assert FalseAlarmRate(run_length=1e4).per_sample() == pytest.approx(1e-4)
    assert FalseAlarmRate().per_sample() == 1e-6
    assert FalseAlarmRate().mean_run_length() == 3.6e8


def test_a_detector_gets_what_it_takes() -> None:
    assert FalseAlarmRate(1e-4, sample_rate=50.0).as_options(RATE) == {"run_length": 1e4, "sample_rate": 50.0}
    assert FalseAlarmRate(0.9).as_options(RATE) == {"run_length": 2.0}
    assert FalseAlarmRate(1e-4).as_options({"false_alarm_probability"}) == {"false_alarm_probability": 1e-4}
    hourly = FalseAlarmRate(per_hour=1.0, sample_rate=100.0)
    assert hourly.as_options() == {"false_alarms_per_hour": 1.0, "sample_rate": 100.0}
    assert hourly.as_options({"max_faults"}) == {}


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({"probability": -1e-3}, "is -0.001, expected between 0 and 1"),
        ({"probability": 1.0}, "is 1, expected between 0 and 1"),
        ({"probability": 1e-3, "per_hour": 1.0, "sample_rate": 100.0}, "not both"),
        ({"run_length": 1e3, "per_hour": 1.0, "sample_rate": 100.0}, "give run_length or false_alarms_per_hour, not"),
        ({"per_hour": 0.0, "sample_rate": 100.0}, "is 0, expected > 0"),
        ({"per_hour": 1.0}, "needs a sample_rate > 0 Hz"),
        ({"per_hour": 1.0, "sample_rate": -5.0}, "got -5"),
        ({"per_hour": 1e9, "sample_rate": 1.0}, "expected between 0 and 1"),
        ({"run_length": 1.0}, "run_length is 1 samples, expected 2 to 1e+15"),
    ],
)
def test_refused(stated: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        FalseAlarmRate(**stated).per_sample()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
