# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The live node on real DDS: faults in, rate and diagnostics out, and no message stops it."""

import math
import signal
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, ParameterValue, SetParametersResult
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    SetParameters,
    SetParametersAtomically,
)
from ros.harness import (
    DEEP,
    RATE,
    SIGMA,
    TWO_IMUS,
    Listener,
    healthy,
    monitoring,
    struck,
)
from ros.processes import ROOT, rest, wait
from sensor_msgs.msg import Imu

from fdi_ros.core.messages import ImuTemplate
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.node import LOAD

FAULTY = int(ChannelState.FAULTY)
DECLARED = (FAULTY, int(ChannelState.AMBIGUOUS))
Y2 = 4  # channel imu_2.y


@pytest.fixture(scope="module")
def node(tmp_path_factory, compiled):
    """One monitor of two IMUs for all tests here."""
    with monitoring(TWO_IMUS, tmp_path_factory.mktemp("node")) as pair:
        yield pair


@pytest.fixture
def listener(node) -> Listener:
    """The listener, with a monitor that has nothing against any channel."""
    listener, process = node
    assert process.popen.poll() is None, process.said()
    assert listener.trigger("reset").success
    listener.calm()
    return listener


def test_a_fault_is_isolated_told_at_once_and_reset_and_the_rate_stays_right(
    listener,
) -> None:
    # Long enough for a name, whatever other tests have taught the node.
    omega, z = struck(900, 200, seed=1)
    begin = time.monotonic()
    stamps = listener.play(z)
    assert wait(lambda: len(listener.fused) == len(listener.integrity) == 900), len(
        listener.fused
    )
    took = time.monotonic() - begin
    assert listener.stamps() == stamps.tolist()
    # GDOP 1.4 with one channel lost.
    assert np.abs(listener.rates() - omega).max() < 6 * 1.5 * SIGMA
    states = listener.states()
    # A busy machine may leave a gap, after which the motion is unknown at first.
    assert np.isin(states[:25], (ChannelState.OK, ChannelState.UNCHECKED)).all()
    assert (states[25:200] == ChannelState.OK).all()
    assert np.flatnonzero(states[-1] == FAULTY).tolist() == [Y2]
    declared = int(np.isin(states, DECLARED).any(axis=1).argmax())
    assert 0 <= declared - 200 < 8
    # The change is told at once, as one of a set or by name, and the rest once a second: by the samples that have been
    # heard, and not by a watch, as the machine may be busy.
    known = [
        (at, s.level)
        for _, at, m in listener.diagnostics
        for s in m.status
        if s.name == "fdi_node: imu_2.y"
    ]
    first = next(at for at, level in known if level == DiagnosticStatus.ERROR)
    assert declared - 20 < first < declared + 75
    assert 2 <= sum(not first - 25 < at < first + 25 for at, _ in known) <= took + 2
    assert listener.says("imu_2.y", "isolated", lambda: listener.play(z[-50:]))
    # The last report with it: by now the silence may be told.
    report = [
        one for one in listener.reports() if "isolated" in one["imu_2.y"].message
    ][-1]
    status, whole = report["imu_2.y"], report["monitor"]
    assert (status.level, status.hardware_id) == (DiagnosticStatus.ERROR, "two_imus")
    assert (whole.level, whole.message[:23]) == (
        DiagnosticStatus.WARN,
        "5 of 6 channels healthy",
    )
    assert report["imu_1.x"].level == DiagnosticStatus.OK
    assert "imu_2.y" in listener.trigger("reset").message
    assert listener.settle()


def test_the_example_subscriber_prints_what_the_monitor_declares(listener) -> None:
    before = listener.count_subscribers("fdi_node/integrity")
    words = ["--ros-args", "-r", "integrity:=fdi_node/integrity"]
    with subprocess.Popen(
        [sys.executable, ROOT / "examples" / "integrity.py", *words],
        stdout=subprocess.PIPE,
        text=True,
    ) as example:
        try:
            assert wait(
                lambda: listener.count_subscribers("fdi_node/integrity") > before
            )
            stamps = listener.play(struck(600, 100, seed=4)[1])
            for line in example.stdout:
                stamp, channel, state = line.split()
                if state == "FAULTY":
                    break
        finally:
            example.send_signal(signal.SIGINT)
    assert channel == "imu_2.y"
    assert stamps[100] / 1e9 <= float(stamp) + 1e-3 <= stamps[-1] / 1e9
    assert example.returncode == 0


def test_no_message_stops_it_and_no_bad_value_reaches_the_output(listener) -> None:
    _, z = healthy(200)
    z[50, 1] = z[100:103, Y2] = math.nan
    z[150:153, Y2] = 1e300
    stamps = listener.play(z)
    for stamp in (int(stamps[-1]), int(stamps[-5]), int(stamps[-1]) - 10**9):
        listener.send_imu(0, stamp, (9.0, 9.0, 9.0))
    for sec, nanosec in (
        (2**31 - 1, 10**9 - 1),
        (2**31 - 1, 2**32 - 1),
        (-1, 0),
        (-(2**31), 2**32 - 1),
        (0, 10**9),
    ):
        message = bytearray(ImuTemplate("imu").fill(0, (9.0, 9.0, 9.0), (0.0,) * 9))
        struct.pack_into("<iI", message, 4, sec, nanosec)
        for output in listener.outputs:
            output.publish(bytes(message))
        listener.play(z[:50])
    assert wait(lambda: len(listener.fused) >= 450), len(listener.fused)
    assert listener.stamps() == sorted(set(listener.stamps()))
    # NaN is not less.
    assert np.abs(listener.rates()).max() < 1
    for name, kind, least in (
        ("imu_2.y", "non-finite", 3),
        ("imu_2.y", "out of range", 3),
        ("input imu_1", "backward", 2),
        ("input imu_1", "duplicate", 1),
        ("input imu_1", "ahead", 1),
        ("input imu_2", "malformed", 4),
    ):
        assert wait(
            lambda name=name, kind=kind, least=least: (
                int(listener.value(name, kind)) >= least
            )
        ), kind
    assert listener.says("input imu_1", "stamps going back")
    assert listener.says("input imu_2", "malformed")


def test_the_rate_reaches_subscribers_of_either_kind_and_those_that_come_and_go(
    listener,
) -> None:
    """The default of rclpy is reliable, sensor data are best effort."""
    reliable: list[bytes] = []
    subscription = listener.create_subscription(
        Imu, "fused", reliable.append, 100, raw=True
    )
    assert wait(lambda: listener.play(healthy(5)[1]) is not None and reliable)
    rest(lambda: len(reliable) + len(listener.fused))
    reliable.clear()
    listener.clear()
    for _ in range(5):
        passing = listener.create_subscription(
            Imu, "fused", lambda _: None, DEEP, raw=True
        )
        listener.play(healthy(20)[1])
        listener.destroy_subscription(passing)
    assert wait(lambda: len(reliable) == len(listener.fused) == 100), (
        len(reliable),
        len(listener.fused),
    )
    listener.destroy_subscription(subscription)


def test_one_dead_topic_does_not_silence_the_rest_and_when_all_is_silent_all_is_stale(
    listener,
) -> None:
    z = healthy(250)[1]
    listener.play(z[:50])
    listener.play(z, triads=[0])
    told = [
        report
        for report in listener.reports()
        if "no data" in report["imu_2.x"].message
    ]
    assert told
    assert all(
        r["imu_2.x"].level == r["input imu_2"].level == DiagnosticStatus.STALE
        for r in told
    )
    # A busy machine may keep the publisher waiting, too.
    assert any(r["imu_1.x"].level != DiagnosticStatus.STALE for r in told)
    assert "silent for" in told[-1]["input imu_2"].message
    assert wait(lambda: len(listener.fused) >= 299)
    assert listener.settle()
    assert wait(lambda: listener.status("input imu_2").level != DiagnosticStatus.STALE)
    listener.clear()
    assert listener.says("monitor", "no sample for")
    assert {s.level for s in listener.diagnostics[-1][-1].status} == {
        DiagnosticStatus.STALE
    }


def test_another_frame_and_stamps_ahead_of_the_clock_are_named_once(
    node, listener
) -> None:
    _, process = node
    other, rates = ImuTemplate("left_wing"), healthy(100, seed=3)[1].tolist()

    def send(row: list[float], ahead: int = 0) -> None:
        listener.send_imu(0, time.time_ns() + ahead, row[:3])
        listener.outputs[1].publish(other.fill(time.time_ns(), row[3:], (0.0,) * 9))
        time.sleep(1 / RATE)

    for k, row in enumerate(rates):
        send(row, 5_000_000_000 if 40 < k < 60 else 0)
    words = "frame_id changed from 'imu' to 'left_wing': another sensor?"
    assert listener.says("input imu_2", words, lambda: send(rates[-1]))
    assert listener.value("input imu_2", "frame_id") == "left_wing"
    late = "/imu_1/data_raw: stamps are more than 1 s ahead of the clock"
    assert wait(lambda: late in process.said())
    lines = process.said().splitlines()
    warned = [line for line in lines if late in line or words in line]
    assert ["[WARN]" in line for line in warned] == [True, True]
    assert listener.settle()
    assert wait(lambda: "frame_id" not in listener.status("input imu_2").message)


def test_the_bias_is_learned_anew_at_rest_and_not_in_motion(listener) -> None:
    listener.play(healthy(100, size=3.0)[1])
    response = listener.trigger("relearn_bias")
    assert not response.success
    assert "in motion" in response.message
    listener.play(healthy(50, size=0.0)[1])
    assert listener.trigger("relearn_bias").success
    listener.play(healthy(650, size=0.0)[1])
    assert wait(lambda: listener.value("monitor", "bias") == "learned")


def test_a_second_publisher_on_an_input_is_named_and_forgotten_when_it_is_gone(
    node, listener
) -> None:
    second = listener.create_publisher(Imu, listener.outputs[0].topic_name, DEEP)
    assert listener.says(
        "input imu_1",
        "2 publishers on /imu_1/data_raw, expected one: /listener, /listener",
    )
    assert "2 publishers on /imu_1/data_raw" in node[1].said()
    listener.destroy_publisher(second)
    listener.clear()
    assert wait(lambda: "publishers" not in listener.status("input imu_1").message)


def test_in_a_flood_inputs_are_polled_and_all_else_goes_on(node, listener) -> None:
    damaged = bytes(ImuTemplate("imu").fill(0, (0.0, 0.0, 0.0), (0.0,) * 9))[:20]

    def flood() -> bool:
        # Without a break: in a break the node catches up.
        for _ in range(5000):
            listener.outputs[0].publish(damaged)
        return "flooded with messages: inputs are polled" in node[1].said()

    # Of a busy machine what is published may not be enough to be told of; all else must go on as well.
    wait(flood, 4.0)
    assert listener.trigger("reset").success
    assert listener.settle()
    assert node[1].memory() < 400
    # And so it is when it is over.
    time.sleep(LOAD.flood_time)
    assert listener.trigger("reset").success
    assert listener.settle()


def test_each_parameter_has_a_description_a_unit_and_a_range(listener) -> None:
    names = [
        "detector.false_alarms_per_hour",
        "imus.timeout",
        "detector.name",
        "decision.confirm_alarms",
    ]
    answer = listener.call(
        DescribeParameters, "fdi_node/describe_parameters", names=names
    )
    rate, timeout, detector, alarms = answer.descriptors
    assert "[1/h]" in rate.description
    assert rate.floating_point_range[0].to_value == 3.6e6
    assert (rate.read_only, timeout.read_only) == (False, True)
    assert "cusum, sequential" in detector.additional_constraints
    assert alarms.integer_range[0].from_value == 1


def test_parameters_keep_their_types_whatever_they_are_set_to(listener) -> None:
    def types(*names):
        asked = {"names": list(names)}
        said = listener.call(
            DescribeParameters, "fdi_node/describe_parameters", **asked
        )
        had = listener.call(GetParameters, "fdi_node/get_parameters", **asked)
        assert [one.type for one in said.descriptors] == [v.type for v in had.values]
        return [value.type for value in had.values]

    texts, real = ParameterType.PARAMETER_STRING_ARRAY, ParameterType.PARAMETER_DOUBLE
    names = ("excluded_channels", "detector.false_alarms_per_hour", "imus.delays")
    expected = [texts, real, ParameterType.PARAMETER_DOUBLE_ARRAY]
    assert types(*names) == expected
    usual = TWO_IMUS.detector.false_alarms_per_hour
    assert listener.set(
        excluded_channels=[], detector__false_alarms_per_hour=1
    ).successful
    assert types(*names) == expected
    assert listener.set(detector__false_alarms_per_hour=usual).successful
    refused = listener.set(detector__false_alarms_per_hour="fast")
    assert (
        "detector.false_alarms_per_hour is 'fast', expected a number" in refused.reason
    )


def test_what_changes_together_is_taken_over_whole_or_not_at_all(
    node, listener
) -> None:
    def taken(detector: str, per_hour: float, probability: float) -> bool:
        rate = {
            "detector__false_alarms_per_hour": per_hour,
            "detector__false_alarm_probability": probability,
        }
        return listener.set(detector__name=detector, **rate).successful

    assert taken("max_residual", 0.0, 1e-7)
    z = struck(300, 100, seed=1)[1]
    listener.play(z)
    assert listener.says("imu_2.y", "isolated", lambda: listener.play(z[-50:]))
    assert listener.value("monitor", "detector") == "max_residual"
    assert taken("likelihood_ratio", 0.001, 0.0)
    for values, words in (
        (
            {"detector__name": "projector", "detector__false_alarms_per_hour": -5.0},
            "-5",
        ),
        ({"detector__name": "nonsense"}, "nonsense"),
        ({"excluded_channels": ["imu_9.x"]}, "imu_9.x"),
        ({"detector__false_alarms_per_hour": 0.0}, "both 0"),
        ({"imus__timeout": 0.5}, "read-only"),
        ({"detector__nmae": "cusum"}, "did you mean 'detector.name'?"),
    ):
        result = listener.set(**values)
        assert not result.successful
        assert words in result.reason
        line = f"parameters refused: {result.reason}"
        # So many lines a second are logged; what was left out comes when it is asked for again.
        assert wait(
            lambda line=line, values=values: (
                line in node[1].said() or not listener.set(**values)
            )
        )
    (name,) = listener.call(
        GetParameters, "fdi_node/get_parameters", names=["detector.name"]
    ).values
    assert name.string_value == "likelihood_ratio"


def test_an_operator_takes_a_channel_out_and_back(listener) -> None:
    assert listener.set(excluded_channels=["imu_1.z"]).successful
    z = healthy(100)[1]
    words = "taken out by the operator"
    assert listener.says("imu_1.z", words, lambda: listener.play(z))
    assert listener.set(excluded_channels=[]).successful
    assert listener.settle()


def test_what_cannot_be_set_is_refused_in_the_answer_one_by_one(node, listener) -> None:
    def value(kind: int) -> ParameterValue:
        return ParameterValue(
            type=kind, double_value=0.5, integer_value=1, string_value="x"
        )

    def ask(changes: list[ParameterMessage]) -> list[SetParametersResult]:
        return listener.call(
            SetParameters, "fdi_node/set_parameters", parameters=changes
        ).results

    changes = [
        ParameterMessage(name="detector.false_alarms_per_hour", value=value(kind))
        for kind in range(256)
    ]
    odd = [
        ParameterMessage(name="", value=value(3)),
        ParameterMessage(name="x" * 10**6, value=value(4)),
    ]
    results = ask(changes[: LOAD.parameters])
    # 3 is PARAMETER_DOUBLE; 2, a whole number, does for it.
    assert [k for k, result in enumerate(results) if result.successful] == [2, 3]
    assert "has type 200, expected a name and a type of 1 to 9" in results[200].reason
    assert all(
        not result.successful and len(result.reason) < 5000 for result in ask(odd)
    )
    results = ask(changes + odd)
    assert len(results) == 258
    assert f"expected at most {LOAD.parameters}" in results[-1].reason
    mixed = {"parameters": [changes[3], changes[200]]}
    result = listener.call(
        SetParametersAtomically, "fdi_node/set_parameters_atomically", **mixed
    ).result
    assert not result.successful
    assert "has type 200" in result.reason
    assert wait(lambda: "more lines, left out" in node[1].said(), 10.0)
    assert max(map(len, node[1].said().splitlines())) < 5000
    assert listener.set(
        detector__false_alarms_per_hour=TWO_IMUS.detector.false_alarms_per_hour
    ).successful
