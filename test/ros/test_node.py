# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The live node on real DDS: faults in, rate and diagnostics out, and no message stops it."""

from __future__ import annotations

import math
import struct
import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros.harness import DEEP, SIGMA, TWO_IMUS, Listener, healthy, monitoring, wait
from sensor_msgs.msg import Imu

from fdi_ros.core.messages import ImuTemplate
from fdi_ros.monitor.output import ChannelState
from fdi_ros.sources import ImuSource

FAULTY = int(ChannelState.FAULTY)
DECLARED = (FAULTY, int(ChannelState.AMBIGUOUS))
Y2 = 4
"""Channel imu_2.y."""


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
    assert listener.settle()
    time.sleep(0.1)
    listener.clear()
    return listener


def struck(count: int, start: int, channel: int = Y2, size: float = 0.3, seed: int = 1):
    omega, z = healthy(count, seed)
    z[start:, channel] += size
    return omega, z


def test_a_fault_is_isolated_told_at_once_and_reset_and_the_rate_stays_right(listener) -> None:
    # Long enough for a name, whatever other tests have taught the node.
    omega, z = struck(900, 200)
    # Told by the samples that have been heard, and not by a watch: the machine may be busy.
    said: list[tuple[int, DiagnosticArray]] = []
    subscription = listener.create_subscription(
        DiagnosticArray, "/diagnostics", lambda message: said.append((len(listener.integrity), message)), 100
    )
    begin = time.monotonic()
    stamps = listener.play(z)
    assert wait(lambda: len(listener.fused) == len(listener.integrity) == 900), len(listener.fused)
    took = time.monotonic() - begin
    listener.destroy_subscription(subscription)
    rates = listener.rates()
    assert [*rates] == stamps.tolist()
    error = np.array([*rates.values()]) - omega
    # GDOP 1.4 with one channel lost.
    assert np.abs(error).max() < 6 * 1.5 * SIGMA
    states = listener.states()
    assert (states[:200] == 0).all()
    assert np.flatnonzero(states[-1] == FAULTY).tolist() == [Y2]
    declared = int(np.isin(states, DECLARED).any(axis=1).argmax())
    assert 0 <= declared - 200 < 8
    # The change is told at once, as one of a set or by name, and the rest once a second.
    known = [(at, s.level) for at, m in said for s in m.status if s.name.endswith(": imu_2.y")]
    first = next(at for at, level in known if level == DiagnosticStatus.ERROR)
    assert declared - 20 < first < declared + 75
    assert 2 <= sum(not first - 25 < at < first + 25 for at, _ in known) <= took + 2
    assert listener.says("imu_2.y", "isolated")
    # The last report with it: by now the silence may be told.
    reports = [{s.name.removeprefix("fdi_node: "): s for s in message.status} for _, message in listener.diagnostics]
    report = [one for one in reports if "isolated" in one["imu_2.y"].message][-1]
    status, whole = report["imu_2.y"], report["monitor"]
    assert (status.level, status.hardware_id) == (DiagnosticStatus.ERROR, "two_imus")
    values = {pair.key: pair.value for pair in status.values}
    assert values["state"] == "FAULTY"
    assert float(values["estimated error (rad/s)"]) == pytest.approx(0.3, abs=0.03)
    assert status.message.startswith("disagrees with the others by 0.")
    assert whole.level == DiagnosticStatus.WARN
    assert whole.message.startswith("5 of 6 channels healthy")
    assert report["imu_1.x"].level == DiagnosticStatus.OK
    response = listener.trigger("reset")
    assert response.success
    assert "imu_2.y" in response.message
    assert listener.settle()


@pytest.mark.parametrize("bad", [math.nan, 1e300])
def test_a_bad_value_never_reaches_the_output(listener, bad) -> None:
    _, z = healthy(200)
    z[50, 1] = z[100:103, Y2] = bad
    listener.play(z)
    assert wait(lambda: len(listener.fused) == 200)
    assert np.isfinite(list(listener.rates().values())).all()
    assert np.abs(list(listener.rates().values())).max() < 1
    kind = "out of range" if bad == 1e300 else "non-finite"
    assert wait(lambda: int(listener.value("imu_2.y", kind)) >= 3)


def test_backward_and_repeated_stamps_never_reach_the_output(listener) -> None:
    z = healthy(50)[1]
    stamps = listener.play(z)
    for stamp in (int(stamps[-1]), int(stamps[-5]), int(stamps[-1]) - 10**9):
        listener.send_imu(0, stamp, (9.0, 9.0, 9.0))
    listener.play(z)
    assert wait(lambda: len(listener.fused) == 100)
    got = [ImuSource.parse(data, 3)[0] for data in listener.fused]
    assert got == sorted(set(got))
    assert np.abs(list(listener.rates().values())).max() < 1
    assert listener.says("input imu_1", "stamps going back")
    for kind, least in (("backward", 2), ("duplicate", 1)):
        assert wait(lambda kind=kind, least=least: int(listener.value("input imu_1", kind)) >= least)


def test_stamps_at_the_ends_of_their_range_end_nothing(listener) -> None:
    z = healthy(50)[1]
    listener.play(z)
    for sec, nanosec in ((2**31 - 1, 10**9 - 1), (2**31 - 1, 2**32 - 1), (-1, 0), (-(2**31), 2**32 - 1), (0, 10**9)):
        message = bytearray(ImuTemplate("imu").fill(0, (0.0, 0.0, 0.0), (0.0,) * 9))
        struct.pack_into("<iI", message, 4, sec, nanosec)
        for output in listener.outputs:
            output.publish(bytes(message))
        listener.play(z)
    assert wait(lambda: len(listener.fused) >= 300), len(listener.fused)
    assert listener.says("input imu_2", "malformed")


def test_the_rate_reaches_subscribers_of_either_kind_and_those_that_come_and_go(listener) -> None:
    """The default of rclpy is reliable, sensor data are best effort."""
    reliable: list[bytes] = []
    subscription = listener.create_subscription(Imu, "fused", reliable.append, 100, raw=True)
    assert wait(lambda: listener.play(healthy(5)[1]) is not None and reliable)
    time.sleep(0.1)
    reliable.clear()
    listener.clear()
    for _ in range(5):
        passing = listener.create_subscription(Imu, "fused", lambda _: None, DEEP, raw=True)
        listener.play(healthy(20)[1])
        listener.destroy_subscription(passing)
    assert wait(lambda: len(reliable) == len(listener.fused) == 100), (len(reliable), len(listener.fused))
    listener.destroy_subscription(subscription)


def test_one_dead_topic_does_not_silence_the_rest(listener) -> None:
    z = healthy(250)[1]
    listener.play(z[:50])
    listener.play(z, triads=[0])
    reports = [{s.name.removeprefix("fdi_node: "): s for s in m.status} for _, m in listener.diagnostics]
    told = [report for report in reports if "no data" in report["imu_2.x"].message]
    assert told
    assert all(r["imu_2.x"].level == r["input imu_2"].level == DiagnosticStatus.STALE for r in told)
    assert all(r["imu_1.x"].level != DiagnosticStatus.STALE for r in told)
    assert "silent for" in told[-1]["input imu_2"].message
    assert wait(lambda: len(listener.fused) >= 299)
    assert listener.settle()
    assert wait(lambda: listener.status("input imu_2").level != DiagnosticStatus.STALE)


def test_when_all_is_silent_all_is_stale(listener) -> None:
    assert listener.says("monitor", "no sample for")
    assert {s.level for s in listener.diagnostics[-1][1].status} == {DiagnosticStatus.STALE}


def test_the_bias_is_learned_anew_at_rest_and_not_in_motion(listener) -> None:
    listener.play(healthy(100, size=3.0)[1])
    response = listener.trigger("relearn_bias")
    assert not response.success
    assert "in motion" in response.message
    listener.play(healthy(50, size=0.0)[1])
    response = listener.trigger("relearn_bias")
    assert response.success, response.message
    listener.play(healthy(650, size=0.0)[1])
    assert wait(lambda: listener.value("monitor", "bias") == "learned")


class TestParameters:
    def test_each_has_a_description_a_unit_and_a_range(self, listener) -> None:
        described = listener.described("detector.false_alarms_per_hour")
        assert "[1/h]" in described.description
        assert described.floating_point_range[0].to_value == 3.6e6
        assert not described.read_only
        assert listener.described("imus.timeout").read_only
        assert "cusum, sequential" in listener.described("detector.name").additional_constraints
        assert listener.described("decision.confirm_alarms").integer_range[0].from_value == 1

    def test_detector_and_options_change_together(self, listener) -> None:
        probability = {"detector__false_alarms_per_hour": 0.0, "detector__false_alarm_probability": 1e-7}
        result = listener.set(detector__name="max_residual", **probability)
        assert result.successful, result.reason
        listener.play(struck(300, 100)[1])
        assert listener.says("imu_2.y", "isolated")
        assert listener.value("monitor", "detector") == "max_residual"
        probability = {"detector__false_alarms_per_hour": 0.001, "detector__false_alarm_probability": 0.0}
        assert listener.set(detector__name="likelihood_ratio", **probability).successful

    def test_what_does_not_fit_is_refused_whole(self, node, listener) -> None:
        before = listener.get("detector.name").string_value
        assert before != "projector"
        result = listener.set(detector__name="projector", detector__false_alarms_per_hour=-5.0)
        assert not result.successful
        assert listener.get("detector.name").string_value == before
        for values, words in (
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
            assert wait(lambda line=line, values=values: line in node[1].said() or not listener.set(**values))

    def test_an_operator_takes_a_channel_out_and_back(self, listener) -> None:
        assert listener.set(excluded_channels=["imu_1.z"]).successful
        listener.play(healthy(100)[1])
        assert listener.says("imu_1.z", "taken out by the operator")
        assert listener.set(excluded_channels=[]).successful
        assert listener.settle()


def test_a_second_publisher_on_an_input_is_named_and_forgotten_when_it_is_gone(node, listener) -> None:
    topic = listener.outputs[0].topic_name
    second = listener.create_publisher(Imu, topic, DEEP)
    assert listener.says("input imu_1", "2 publishers on /imu_1/data_raw, expected one: /listener, /listener")
    assert "2 publishers on /imu_1/data_raw" in node[1].said()
    listener.destroy_publisher(second)
    listener.clear()
    assert wait(lambda: "publishers" not in listener.status("input imu_1").message)
