# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A moment of each storm upon a monitor; the long form, with the times, is benchmark/mavlink.py storms."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from ros.harness import TWO_IMUS, monitoring, wait
from ros.storm import KINDS, vehicle, weather

from fdi_ros.ros.node import LOG_PERIOD, MOST_LINES, MOST_PARAMETERS, BoundedLog

SECONDS = 0.7
THROTTLED = 10
"""Lines that are limited each by itself, at most so many a second together."""


def test_in_every_storm_all_is_answered_and_the_log_and_the_memory_are_bounded(tmp_path, compiled) -> None:
    with vehicle(tmp_path) as over:
        for seed, kind in enumerate(KINDS):
            told = weather(over, kind, SECONDS, seed)
            assert told["sent"] > 0
            assert told["answered"] == told["sent"], kind
            for name, process in (("monitor", over.monitor), ("link", over.link)):
                assert process.popen.poll() is None
                assert told[f"{name}: lines of the log a second"] < 3 * MOST_LINES + THROTTLED, process.said()
                assert told[f"{name}: memory, MB"] < 400
        assert over.listener.trigger("reset").success
        assert over.listener.says("monitor", "of 9 channels healthy")


def test_what_cannot_be_set_is_refused_in_the_answer_one_by_one(tmp_path, compiled) -> None:
    def value(kind: int) -> ParameterValue:
        return ParameterValue(type=kind, double_value=0.5, integer_value=1, string_value="x")

    changes = [Parameter(name="detector.false_alarms_per_hour", value=value(kind)) for kind in range(256)]
    changes += [Parameter(name="", value=value(3)), Parameter(name="x" * 10**6, value=value(4))]
    with monitoring(TWO_IMUS, tmp_path) as (listener, process):
        request = SetParameters.Request(parameters=changes[:MOST_PARAMETERS])
        results = listener.call(SetParameters, "fdi_node/set_parameters", request).results
        assert len(results) == MOST_PARAMETERS
        # 3 is PARAMETER_DOUBLE; 2, a whole number, does for it.
        assert [k for k, result in enumerate(results) if result.successful] == [2, 3]
        assert "has type 200, expected a name and a type of 1 to 9" in results[200].reason
        odd = SetParameters.Request(parameters=changes[-2:])
        results = listener.call(SetParameters, "fdi_node/set_parameters", odd).results
        assert [result.successful for result in results] == [False, False]
        assert max(len(result.reason) for result in results) < 5000
        many = SetParameters.Request(parameters=changes)
        results = listener.call(SetParameters, "fdi_node/set_parameters", many).results
        assert len(results) == len(changes)
        assert f"expected at most {MOST_PARAMETERS}" in results[-1].reason
        atomically = SetParametersAtomically.Request(parameters=[changes[3], changes[200]])
        result = listener.call(SetParametersAtomically, "fdi_node/set_parameters_atomically", atomically).result
        assert not result.successful
        assert "has type 200" in result.reason
        assert wait(lambda: "more lines, left out" in process.said(), 10.0)
        assert max(map(len, process.said().splitlines())) < 5000


def test_a_log_is_bounded_and_says_how_much_was_left_out() -> None:
    now, lines = time.monotonic(), []
    logger = SimpleNamespace(info=lines.append, warning=lines.append, error=lines.append)
    bounded = BoundedLog(logger, lambda: now)
    for k in range(1000):
        (bounded.info, bounded.warning, bounded.error)[k % 3](f"line {k}\n" + "x" * 10**5)
    # Each severity has its own room: requests without end hide no declaration.
    assert len(lines) == 3 * MOST_LINES
    assert all(len(line) <= 5000 and "\n" not in line for line in lines)
    now += LOG_PERIOD
    bounded.begin_period()
    assert lines[3 * MOST_LINES :] == [f"and {1000 - 3 * MOST_LINES} more lines, left out"]
    bounded.info("again")
    assert lines[-1] == "again"
