# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Starting, stopping, managing: signals, wrong settings, the managed node, simulated time."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from itertools import cycle, islice, takewhile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from ros.harness import (
    ROOT,
    TRANSITIONS,
    TWO_IMUS,
    Process,
    assert_refused,
    connect,
    healthy,
    monitoring,
    parameter_file,
    wait,
)
from rosgraph_msgs.msg import Clock

from fdi_ros.sources import ImuSource


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)


REFUSED = {
    "--ros-args -p detector.nmae:=cusum": "unknown parameter 'detector.nmae', did you mean 'detector.name'?",
    "--ros-args -p sample_rate:=-1.0": "sample_rate is -1 Hz, expected 0.1 to 100000 Hz",
    "--ros-args -p detector.name:=magic": "likelihood_ratio",
    "--ros-args -p executor:=fastest": "executor is 'fastest', expected one of: auto, events, single",
    "--ros-args -p state_file:=[]": "state_file is [], expected a text",
    "--ros-args -p use_sim_time:=5": "'use_sim_time' to '5' of type 'INTEGER', expecting type 'BOOL'",
    "--ros-args --params-file /nowhere.yaml": "nowhere.yaml",
    "--ros-args --params-file OTHER": "no parameters for /fdi_node in ",
    "--ros-args --params-file OTHER -p use_sim_time:=true": "no parameters for /fdi_node in ",
    "--ros-args --params-file config/two_imus.yaml --params-file OTHER": "no parameters for /fdi_node in ",
    "--ros-args -r __ns:=/b --params-file OTHER": "no parameters for /b/fdi_node in ",
    "--ros-args --param-file OTHER": "unknown ROS argument '--param-file', expected one of: ",
    "--ros-args -p state_file:=OTHER": "holds no state of a monitor",
    "--ros-args -p qos_overrides./imu_9.subscription.depth:=5": "./imu_9.subscription.depth', expected one of: ",
    "--params-file config/two_imus.yaml": "unknown argument '--params-file', expected: fdi_node --ros-args",
    "--ros-args -p qos_overrides./fused.publisher.dept:=5": "publisher.dept', expected one of: ",
    "--ros-args -p qos_overrides./fused.publisher.depth:=0": "is 0, expected a whole number, 1 to 100000",
    "--ros-args -p qos_overrides./fused.publisher.history:=keep": "is 'keep', expected one of: keep_last, keep_all",
    "--ros-args -p channels.topic:=a//b": "topic 'a//b' is no ROS name",
}


def test_what_would_be_left_aside_refuses_the_start_in_one_line(tmp_path) -> None:
    other = tmp_path / "other.yaml"
    other.write_text(
        "{another_node: {ros__parameters: {sample_rate: 5.0}}, a: {fdi_node: {ros__parameters: {sample_rate: 5.0}}}}"
    )
    assert_refused("fdi_node", {start.replace("OTHER", str(other)): words for start, words in REFUSED.items()})


def test_without_ros_it_says_so_in_one_line() -> None:
    # Without the site's packages there is no rclpy.
    done = python("-S", "-m", "fdi_ros.ros.process", "fdi_node")
    assert done.returncode == 2
    assert done.stderr.startswith("fdi_node: needs ROS 2 Jazzy")
    assert len(done.stderr.splitlines()) == 1


def test_names_of_statuses_carry_the_namespace_and_a_dump_loads_back(tmp_path) -> None:
    """What ros2 param dump writes of a node with empty arrays, given to it again."""
    dump = tmp_path / "dump.yaml"
    code = f"""
import rclpy, yaml
from fdi_ros.ros.monitor_node import MonitorNode
for file in ({str(parameter_file(TWO_IMUS, tmp_path))!r}, {str(dump)!r}):
    rclpy.init(args=["--ros-args", "--params-file", file, "-r", "__ns:=/drone"])
    node = MonitorNode()
    values = {{name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}}
    values = {{name: list(value) if hasattr(value, "tolist") else value for name, value in values.items()}}
    with open({str(dump)!r}, "w") as out:
        yaml.safe_dump({{"/drone/fdi_node": {{"ros__parameters": values}}}}, out)
    print(node.prefix, sorted(values.items()))
    node.destroy_node()
    rclpy.shutdown()
"""
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    first, again = done.stdout.splitlines()
    assert first.startswith("drone/fdi_node: ")
    assert "('excluded_channels', [])" in first
    assert again == first


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_before_it_is_up_ends_it_at_once(tmp_path, number) -> None:
    process = Process("fdi_node", "--ros-args", "--params-file", str(parameter_file(TWO_IMUS, tmp_path)))
    maps = Path(f"/proc/{process.popen.pid}/maps")
    assert wait(lambda: "librcl" in maps.read_text(), 20)
    assert process.end(number) == -number
    assert process.said() == ""


def test_a_shutdown_from_inside_ends_it_well() -> None:
    code = """
import rclpy
from fdi_ros.ros.process import run
def make():
    from fdi_ros.ros.monitor_node import MonitorNode
    node = MonitorNode()
    node.create_timer(0.2, rclpy.shutdown)
    return node
raise SystemExit(run("fdi_node", [], make))
"""
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_the_single_threaded_executor_does_the_same_and_ends_at_a_second_signal_too(tmp_path) -> None:
    with monitoring(TWO_IMUS, tmp_path, executor="single") as (listener, process):
        z = healthy(400)[1]
        z[100:, 4] += 0.3
        assert listener.settle()
        listener.play(z)
        assert listener.says("imu_2.y", "isolated")
        # At the end comes another one, of the other kind, and it is as well as after one.
        process.popen.send_signal(signal.SIGTERM)


def test_a_manager_takes_it_through_its_states(tmp_path) -> None:
    random, now, refusals = np.random.default_rng(1), "unconfigured", 0
    with monitoring(TWO_IMUS, tmp_path, autostart=False) as (listener, process):
        change, state = listener.change, listener.state
        assert state() == "unconfigured"
        assert "waiting for a lifecycle manager, or ros2 lifecycle set /fdi_node configure" in process.said()
        # What would fail at the next transition is refused now, and the log says so too.
        refused = listener.set(excluded_channels=["imu_9.x"])
        assert not refused.successful
        assert "imu_9.x" in refused.reason
        assert wait(lambda: f"parameters refused: {refused.reason}" in process.said())
        # As often one that is possible as one that mostly is not, or that does not exist.
        for _ in range(30):
            wanted = int(random.choice(list(TRANSITIONS[now]) if random.random() < 0.5 else [1, 2, 3, 4, 9, 60, 255]))
            goal = TRANSITIONS[now].get(wanted)
            assert change(wanted) == (goal is not None), (now, wanted)
            refusals += goal is None
            now = goal or now
            assert state() == now
        assert refusals > 5
        for wanted in {"active": (4, 2), "inactive": (2,), "unconfigured": ()}[now]:
            assert change(wanted)
        # Not more lines a second than the log is bounded to; how many there were is said.
        shown = wait(lambda: " refused: not possible while " in process.said())
        left_out = sum(map(int, re.findall(r"and ([0-9]+) more lines", process.said())))
        assert shown, process.said()
        assert process.said().count(" refused: not possible while ") + left_out >= refusals
        assert "No transition matching" not in process.said()
        assert listener.count_publishers("fused") == 0
        assert change(Transition.TRANSITION_CONFIGURE)
        assert state() == "inactive"
        assert listener.says("monitor", "inactive")
        assert change(Transition.TRANSITION_ACTIVATE)
        fresh = len(process.said())
        assert wait(lambda: "imu_1: no message yet on /imu_1/data_raw" in process.said()[fresh:])
        connect(listener, process)
        assert wait(lambda: "imu_1: messages on /imu_1/data_raw\n" in process.said()[fresh:])
        assert listener.settle()
        assert change(Transition.TRANSITION_DEACTIVATE)
        listener.diagnostics.clear()
        assert listener.says("monitor", "inactive")
        listener.clear()
        listener.play(healthy(20)[1])
        assert not listener.fused
        # Back in the middle of a recording that begins anew, an hour earlier.
        assert change(Transition.TRANSITION_ACTIVATE)
        connect(listener, process, prime=False)
        z = healthy(250)[1].tolist()
        begin = time.time_ns() - 3600 * 10**9
        for k, row in enumerate(z):
            for j in (0, 1):
                listener.send_imu(j, begin + k * 4_000_000, row[3 * j : 3 * j + 3])
            time.sleep(0.004)
        assert wait(lambda: len(listener.fused) > 100)
        assert abs(ImuSource.parse(listener.fused[-1], 3)[0] - begin) < 2 * 10**9
        assert change(Transition.TRANSITION_DEACTIVATE)
        assert change(Transition.TRANSITION_CLEANUP)
        assert change(Transition.TRANSITION_CONFIGURE)
        assert change(Transition.TRANSITION_ACTIVATE)
        connect(listener, process)
        assert listener.settle()
        assert change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert state() == "finalized"
        assert not change(Transition.TRANSITION_CONFIGURE)
        assert state() == "finalized"


def test_simulated_time_rules_silence(tmp_path) -> None:
    """Ten times real time: what is silent for 0.03 s by the wall is silent for 0.3 s by the clock."""
    with monitoring(TWO_IMUS, tmp_path, prime=False, use_sim_time=True) as (listener, process):
        clock = listener.create_publisher(Clock, "/clock", 10)
        assert wait(lambda: clock.get_subscription_count() == 1)
        origin = 1000 * 10**9

        def play(samples: Iterable[list[float]], stamp: int, triads=(0, 1)) -> int:
            """Samples every 20 ms of simulated time, some 2 ms of the wall; each when the one before has passed."""
            for row in samples:
                now, known = Clock(), len(listener.fused)
                now.clock.sec, now.clock.nanosec = divmod(stamp, 10**9)
                clock.publish(now)
                for j in triads:
                    listener.send_imu(j, stamp, row[3 * j : 3 * j + 3])
                wait(lambda known=known: len(listener.fused) > known, 0.01)
                stamp += 20_000_000
            return stamp

        z = healthy(200, rate=50.0)[1].tolist()
        end = play(z, origin)
        assert wait(lambda: len(listener.fused) > 150)
        assert abs(ImuSource.parse(listener.fused[-1], 3)[0] - end) < 10**9

        def only_the_second_is_silent() -> bool:
            levels = {s.name: s.level for s in listener.diagnostics[-1][1].status}
            first, second = (levels.get(f"fdi_node: input imu_{k}") for k in (1, 2))
            return second == DiagnosticStatus.STALE != first

        end = play(takewhile(lambda _: not only_the_second_is_silent(), islice(cycle(z), 50_000)), end, triads=[0])
        assert only_the_second_is_silent()
        assert listener.says("input imu_2", "silent for")
        end = play(z, end)
        # The clock stands still: nothing is silent by it, however long the wall waits.
        listener.diagnostics.clear()
        assert wait(lambda: len(listener.diagnostics) > 1)
        assert "no sample" not in listener.status("monitor").message
        # Times before 1970 and after 2038: whoever says them, the monitor goes on and its reports have a stamp.
        for sec, nanosec in ((-5, 0), (2**31 - 1, 2**32 - 1)):
            clock.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
            listener.diagnostics.clear()
            assert wait(lambda: listener.diagnostics), process.said()
        assert listener.diagnostics[-1][1].header.stamp.sec == 2**31 - 1
        assert "/clock says -5 s, which is before 1970: left aside" in process.said()
        assert "FATAL" not in process.said()
        assert process.popen.poll() is None
