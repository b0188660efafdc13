# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A monitor of its own for each test, that no other has taught anything: start and end, life cycle, clocks, input."""

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
    GEOMETRY,
    RATE,
    SIGMA,
    TRANSITIONS,
    TWO_IMUS,
    connect,
    healthy,
    listening,
    monitoring,
    struck,
)
from ros.processes import (
    ROOT,
    Process,
    assert_refused,
    parameter_file,
    rest,
    running,
    wait,
)
from rosgraph_msgs.msg import Clock
from std_msgs.msg import Float64MultiArray

from fdi_ros.config.config import Config
from fdi_ros.core.states import ChannelState
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.signals import STOPPING


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


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
    other, held = tmp_path / "other.yaml", "{ros__parameters: {sample_rate: 5.0}}"
    other.write_text(f"{{another_node: {held}, a: {{fdi_node: {held}}}}}")
    assert_refused(
        "fdi_node",
        {start.replace("OTHER", str(other)): words for start, words in REFUSED.items()},
    )


def test_without_ros_it_says_so_in_one_line() -> None:
    # Without the site's packages there is no rclpy.
    for words in (("fdi_ros.ros.process", "fdi_node"), ("fdi_ros.cli", "watch")):
        done = python("-S", "-m", *words)
        assert done.returncode == 2
        assert re.fullmatch(
            r"(fdi_node:|fdi: watch) needs ROS 2 Jazzy: .*\n", done.stderr
        ), done.stderr


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
    # The executor may hold an event of the timer of the checks over a cleanup.
    node.trigger_configure()
    checks = node._timer.callback
    node.trigger_cleanup()
    checks()
    node.destroy_node()
    rclpy.shutdown()
"""
    done = python("-c", code)
    assert done.returncode == 0, done.stderr
    first, again = done.stdout.splitlines()
    assert first.startswith("drone/fdi_node: ")
    assert "('excluded_channels', [])" in first
    assert again == first


@pytest.mark.parametrize("number", STOPPING)
def test_a_signal_before_it_is_up_ends_it_at_once(tmp_path, number) -> None:
    file = parameter_file(TWO_IMUS, tmp_path)
    for _ in range(5):
        process = Process("fdi_node", file)
        maps = Path(f"/proc/{process.popen.pid}/maps")
        assert wait(lambda maps=maps: "librcl" in maps.read_text())
        # On a busy machine it may be up by now, and ends as asked for.
        if (code := process.end(number)) != 0:
            break
    assert code == -number
    assert process.said() == ""


def test_a_manager_takes_it_through_its_states(tmp_path) -> None:
    random, now, refusals = np.random.default_rng(1), "unconfigured", 0
    with monitoring(TWO_IMUS, tmp_path, autostart=False) as (listener, process):
        change, state = listener.change, listener.state
        assert state() == "unconfigured"
        assert (
            "waiting for a lifecycle manager, or ros2 lifecycle set /fdi_node configure"
            in process.said()
        )
        # What would fail at the next transition is refused now, and the log says so too.
        refused = listener.set(excluded_channels=["imu_9.x"])
        assert not refused.successful
        assert "imu_9.x" in refused.reason
        assert wait(lambda: f"parameters refused: {refused.reason}" in process.said())
        # As often one that is possible as one that mostly is not, or that does not exist; until it is where it was.
        while refusals < 10 or now != "unconfigured":
            wanted = int(
                random.choice(
                    list(TRANSITIONS[now])
                    if random.random() < 0.5
                    else [1, 2, 3, 4, 9, 60, 255]
                )
            )
            goal = TRANSITIONS[now].get(wanted)
            assert change(wanted) == (goal is not None), (now, wanted)
            refusals += goal is None
            now = goal or now
            assert state() == now
        # Not more lines a second than the log is bounded to; how many there were is said.
        assert wait(lambda: " refused: not possible while " in process.said()), (
            process.said()
        )
        left_out = sum(map(int, re.findall(r"and ([0-9]+) more lines", process.said())))
        assert (
            process.said().count(" refused: not possible while ") + left_out >= refusals
        )
        assert "No transition matching" not in process.said()
        assert listener.count_publishers("fused") == 0
        assert change(Transition.TRANSITION_CONFIGURE)
        assert listener.says("monitor", "inactive")
        fresh = len(process.said())
        assert change(Transition.TRANSITION_ACTIVATE)
        assert wait(
            lambda: "imu_1: no message yet on /imu_1/data_raw" in process.said()[fresh:]
        )
        connect(listener, process)
        assert wait(
            lambda: (
                "imu_1: messages on /imu_1/data_raw, frame_id imu\n"
                in process.said()[fresh:]
            )
        )
        assert listener.settle()
        assert change(Transition.TRANSITION_DEACTIVATE)
        listener.clear()
        assert listener.says("monitor", "inactive")
        listener.play(healthy(20)[1])
        assert not listener.fused
        # Back in the middle of a recording that begins anew, an hour earlier.
        assert change(Transition.TRANSITION_ACTIVATE)
        connect(listener, process, prime=False)
        begin = time.time_ns() - 3600 * 10**9
        listener.play(healthy(250)[1], start=begin)
        assert wait(lambda: len(listener.fused) > 100)
        assert abs(listener.stamps()[-1] - begin) < 2 * 10**9
        for wanted in (4, 2, 1, 3):
            assert change(wanted)
        connect(listener, process)
        assert listener.settle()
        assert change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
        assert not change(Transition.TRANSITION_CONFIGURE)
        assert state() == "finalized"


def test_simulated_time_rules_silence(tmp_path) -> None:
    """Ten times real time: what is silent for 0.03 s by the wall is silent for 0.3 s by the clock."""
    with monitoring(TWO_IMUS, tmp_path, prime=False, use_sim_time=True) as (
        listener,
        process,
    ):
        # Without a clock nothing looks healthy, neither while messages come nor after.
        warned = False
        while not warned:
            listener.play(healthy(10)[1])
            warned = "no time on /clock" in listener.status("monitor").message
        assert wait(lambda: listener.status("monitor").level == DiagnosticStatus.STALE)
        assert "no sample " in listener.status("monitor").message
        clock = listener.create_publisher(Clock, "/clock", 10)
        assert wait(lambda: clock.get_subscription_count() == 1)
        origin = 1000 * 10**9

        def play(samples: Iterable[list[float]], stamp: int, triads=(0, 1)) -> int:
            """Samples every 20 ms of simulated time, some 2 ms of the wall; each when the one before has passed."""
            for row in samples:
                known = len(listener.fused)
                clock.publish(
                    Clock(clock=Time(sec=stamp // 10**9, nanosec=stamp % 10**9))
                )
                for j in triads:
                    listener.send_imu(j, stamp, row[3 * j : 3 * j + 3])
                wait(lambda known=known: len(listener.fused) > known, 0.01)
                stamp += 20_000_000
            return stamp

        z = healthy(200, rate=50.0)[1].tolist()
        end = play(z, origin)
        assert wait(lambda: len(listener.fused) > 150)
        assert abs(listener.stamps()[-1] - end) < 10**9

        def only_the_second_is_silent() -> bool:
            levels = {s.name: s.level for s in listener.diagnostics[-1][-1].status}
            first, second = (levels.get(f"fdi_node: input imu_{k}") for k in (1, 2))
            return second == DiagnosticStatus.STALE != first

        end = play(
            takewhile(
                lambda _: not only_the_second_is_silent(), islice(cycle(z), 50_000)
            ),
            end,
            triads=[0],
        )
        assert only_the_second_is_silent()
        assert listener.says("input imu_2", "silent for")
        end = play(z, end)
        # A clock that stands is no health: what is silent then is silent by the wall.
        listener.diagnostics.clear()
        assert listener.says("monitor", "no sample for")
        assert "the clock has stood still for" in listener.status("monitor").message
        end = play(z[:50], end)
        assert wait(lambda: "clock" not in listener.status("monitor").message)
        assert (
            "[INFO]"
            in process.said().partition("the clock runs again")[0].splitlines()[-1]
        )
        # Times before 1970 and after 2038: whoever says them, the monitor goes on and its reports have a stamp.
        for sec, nanosec in ((-5, 0), (2**31 - 1, 2**32 - 1)):
            clock.publish(Clock(clock=Time(sec=sec, nanosec=nanosec)))
            listener.diagnostics.clear()
            assert wait(lambda: listener.diagnostics), process.said()
        assert listener.diagnostics[-1][-1].header.stamp.sec == 2**31 - 1
        assert "/clock says -5 s, which is before 1970: left aside" in process.said()
        assert "FATAL" not in process.said()


def test_channels_in_one_array_are_judged_as_the_pipeline_judges_them(tmp_path) -> None:
    """Here by the SingleThreadedExecutor, elsewhere by the EventsExecutor."""
    axes = {
        "geometry.preset": "axes",
        "geometry.axes": GEOMETRY.axes.reshape(-1).tolist(),
    }
    detector = {"detector.name": "likelihood_ratio"}
    config = TWO_IMUS.replaced(
        {"input": "channels", "channels.topic": "gyros", **axes, **detector}
    )
    with monitoring(config, tmp_path, executor="single") as (listener, process):
        # The first samples are not checked yet.
        assert wait(lambda: listener.prime() or not listener.states()[-1].any())
        rest(lambda: len(listener.fused))
        listener.clear()
        z = struck(450, 150)[1]
        for k, values in enumerate(z.tolist()):
            listener.send_channels(values)
            if k == 100:
                for wrong in ([1.0] * 5, [1.0] * 7, [], [0.0] * 10_000):
                    listener.outputs[0].publish(Float64MultiArray(data=wrong))
            time.sleep(1 / RATE)
        assert wait(lambda: len(listener.fused) >= 450), len(listener.fused)
        # A busy machine may have kept one of those before.
        rest(lambda: len(listener.fused) + len(listener.integrity))
        stamps, states, rates = (
            told[-450:]
            for told in (listener.stamps(), listener.states(), listener.rates())
        )
        assert stamps == sorted(set(stamps))
        assert wait(lambda: listener.value("input gyros", "malformed") == "4")
        last = z[-1].tolist()
        assert listener.says("g5", "isolated", lambda: listener.send_channels(last))
        pipeline = Pipeline.from_config(config)
        # As the node's, it has seen a second at rest, and then nothing for a while.
        before = stamps[0] - 1_000_000_000 - 4_000_000 * np.arange(250, 0, -1)
        pipeline.process(Block(before, np.zeros((250, 6))))
        output = pipeline.process(Block(np.array(stamps), z))
        # What the estimator knows after other samples before differs a little: single
        # samples may be suspected, and rates differ by a quarter of their noise.
        states, faulty = np.array(states), ChannelState.FAULTY
        np.testing.assert_array_equal(states == faulty, output.state == faulty)
        assert (states != output.state).any(axis=1).sum() <= 5
        apart = np.array(rates) - output.rate
        assert np.abs(apart).max() < 0.8 * SIGMA
        assert np.sqrt((apart**2).mean()) < 0.16 * SIGMA
        # At the end comes another signal, of the other kind, and it is as well as after one.
        process.popen.send_signal(signal.SIGTERM)


def test_two_inputs_on_one_topic_are_named_and_are_no_redundancy(
    tmp_path, compiled
) -> None:
    file, remap = parameter_file(TWO_IMUS, tmp_path), "imu_2/data_raw:=imu_1/data_raw"
    with (
        listening(TWO_IMUS.topics) as listener,
        running("fdi_node", file, remap) as process,
    ):
        assert wait(lambda: listener.outputs[0].get_subscription_count() > 1), (
            process.said()
        )
        listener.play(healthy(1250)[1], triads=(0,))
        assert listener.says(
            "monitor",
            "(imu_1/data_raw) and imu_2 (imu_2/data_raw) give the same values",
        )
        assert listener.says(
            "input imu_2", "imu_2 and imu_1 read the same topic /imu_1/data_raw"
        )
        assert listener.says("imu_2.x", "one sensor, no redundancy")
        assert wait(lambda: (listener.states()[-1][3:] == ChannelState.UNCHECKED).all())


def test_a_node_that_waits_for_an_array_is_told_of_imus(tmp_path) -> None:
    with (
        listening(TWO_IMUS.topics) as listener,
        running("fdi_node", parameter_file(Config(), tmp_path)) as process,
    ):
        words = (
            "no array on /gyro_channels, but topics of type sensor_msgs/msg/Imu: to read them,"
            " set `input: imus` and `imus.topics: [/imu_1/data_raw, /imu_2/data_raw]`"
        )
        assert listener.says("input gyro_channels", words)
        assert sum(words in line for line in process.said().splitlines()) == 1


def test_what_is_odd_about_clocks_is_named_and_lived_with(tmp_path) -> None:
    with monitoring(TWO_IMUS, tmp_path, prime=False) as (listener, process):
        for _ in range(100):
            for j in (0, 1):
                listener.send_imu(j, 0, [0.0, 0.0, 0.0])
            time.sleep(1 / RATE)
        assert listener.says("input imu_1", "stamps are not set")
        warned = [
            line for line in process.said().splitlines() if "stamps are not set" in line
        ]
        assert ["[WARN]" in line for line in warned] == [True, True]
        assert "/imu_1/data_raw: stamps are not set" in warned[0]

        # One clock behind the other.
        listener.calm()
        listener.play(healthy(500)[1], skew=-40_000_000)
        said = listener.says(
            "input imu_2",
            "behind those of the other inputs",
            lambda: listener.play(healthy(50)[1], skew=-40_000_000),
        )
        assert wait(lambda: len(listener.fused) > 450)
        # Ten samples behind; nine where the one of the other unit came after it.
        assert 32 <= float(re.search(r"stamps are ([\d.]+) ms behind", said)[1]) <= 40.1
        # The clock is set right, and an operator says that all is well. Nor does a gap leave anything behind.
        assert listener.trigger("reset").success
        assert listener.settle()
        time.sleep(1.0)
        listener.calm()
        listener.play(healthy(250)[1])
        for name in ("imu_1", "imu_2"):
            assert listener.says(
                f"input {name}", "delivers", lambda: listener.play(healthy(50)[1])
            )

        # Both far from now: the time begins anew when both units agree on it.
        listener.clear()
        start, z = time.time_ns() - 3600 * 10**9, struck(1000, 300)[1]
        listener.play(z[:300], start=start)
        assert listener.says("input imu_1", "behind the clock")
        assert wait(lambda: len(listener.fused) > 250)
        late = listener.stamps()[-200:]
        assert late == sorted(set(late))
        assert abs(late[-1] - start) < 10e9
        listener.play(z[300:], start=start + 300 * 4_000_000)
        assert listener.says("imu_2.y", "isolated")
        # Since when: a stamp of the messages, which went back.
        since = listener.value("imu_2.y", "state since (stamp, s)")
        assert abs(float(since) - start / 1e9) < 10
