# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording played with /clock to a monitor in simulated time."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

import rclpy
from bag.recordings import IMU, imu, write_mcap
from mcap.writer import Writer
from rclpy.context import Context
from ros.harness import DEEP, PATIENCE, ROOT, Process, assert_refused, listening, wait
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from fdi_ros.bag.reader import Recording
from fdi_ros.config.config import Config
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros import player_node
from fdi_ros.sources import ImuSource

FILE = ROOT / "config" / "two_imus.yaml"
CONFIG = Config.from_file(FILE)
WORDS = ("--ros-args", "--params-file", str(FILE))


def stamp_of(message: Imu) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_it_pauses_where_it_is_and_begins_anew_in_a_namespace(flight) -> None:
    words = [*WORDS, "-r", "__ns:=/drone"]
    with listening() as listener:
        heard: list[int] = []
        listener.create_subscription(Imu, "/drone/imu_1/data_raw", lambda m: heard.append(stamp_of(m)), DEEP)
        listener.create_subscription(Imu, "/drone/imu_2/data_raw", lambda m: None, DEEP)
        arguments = ("-r", "/clock:=clock", "-p", f"bag:={flight}", "-p", "rate:=50.0", "-p", "loop:=true")
        playing = Process("player_node", *words, *arguments)
        try:
            assert wait(lambda: len(heard) > 100, 2 * PATIENCE), playing.said()
            # The clock of one vehicle, if it is remapped so, is not that of all.
            assert (listener.count_publishers("/drone/clock"), listener.count_publishers("/clock")) == (1, 0)
            assert listener.call(Trigger, "/drone/player_node/pause", Trigger.Request()).message == "paused"
            # What was on its way has come, and nothing more comes.
            assert wait(lambda: len(heard) == (time.sleep(0.5), len(heard))[1])
            held = len(heard)
            assert listener.call(Trigger, "/drone/player_node/resume", Trigger.Request()).message == "playing"
            assert wait(lambda: (np.diff(heard) < 0).any()), playing.said()
        finally:
            assert playing.end() == 0, playing.said()
    steps = np.diff(heard)
    # The half second of the pause, 25 s of the recording, is not left out.
    assert 0 < steps[held - 1] < 5 * 10**9
    (first, *_) = np.flatnonzero(steps < 0)
    assert abs(heard[first + 1] - min(heard)) < 5 * 10**9
    assert "the recording has ended: from its beginning" in playing.said()


def test_a_bag_waits_for_the_monitor_behind_the_injector_and_is_monitored_in_its_own_time(flight) -> None:
    """As replay.launch.py starts them; the monitor comes last, as where it compiles first. At four times the speed."""
    with Recording(flight) as recording:
        first = min(int(batch.log_time.min()) for batch in recording.batches(CONFIG.topics))
    with listening() as listener:
        simulated = ("-p", "use_sim_time:=true")
        playing = Process("player_node", *WORDS, "-p", f"bag:={flight}", "-p", "rate:=4.0", "-p", "wait:=3600.0")
        nodes = [playing, injecting := Process("injector_node", *WORDS, *simulated, "-p", "suffix:=_faulty")]
        try:
            assert wait(lambda: "waiting for subscribers" in playing.said()), playing.said()
            assert wait(lambda: listener.count_publishers("imu_1/data_raw_faulty") == 1), injecting.said()
            assert listener.count_subscribers("imu_1/data_raw") == 0
            remaps = [word for topic in CONFIG.topics for word in ("-r", f"{topic}:={topic}_faulty")]
            at_once = ("-p", "bias.startup_bias_duration:=0.0")
            started = time.monotonic()
            nodes.append(monitor := Process("fdi_node", *WORDS, *simulated, *at_once, *remaps))
            assert wait(lambda: len(listener.fused) > 0), (playing.said(), injecting.said(), monitor.said())
            heard = time.monotonic()
            assert wait(lambda: len(listener.fused) > 400), (playing.said(), injecting.said(), monitor.said())
        finally:
            codes = [process.end() for process in nodes]
    assert codes == [0, 0, 0]
    assert "playing all the same" not in playing.said()
    assert not np.isin(listener.states(), (ChannelState.FAULTY, ChannelState.AMBIGUOUS)).any()
    stamps = [ImuSource.parse(data, 3)[0] for data in listener.fused]
    assert stamps == sorted(set(stamps))
    assert (np.diff(stamps) % 10**7 == 0).all()
    # Of the recording no more is missing than was played since the monitor started: the player had waited for it.
    assert stamps[0] - first < 4.0 * (heard - started) * 1e9


def test_what_is_read_slowly_is_not_made_up_for_in_a_burst(flight, monkeypatch) -> None:
    """By a clock of the test's own, which runs while a part of the recording is read, and while it is waited."""
    seconds = [0.0]
    published: list[float] = []

    def batches(topics):
        with Recording(flight) as recording:
            for batch in recording.batches(topics):
                seconds[0] += 0.4
                yield batch

    def spin(wait: float) -> None:
        seconds[0] += wait

    monkeypatch.setattr(player_node.time, "monotonic", lambda: seconds[0])
    context = Context()
    rclpy.init(args=[*WORDS, "-p", f"bag:={flight}", "-p", "rate:=10.0"], context=context)
    try:
        node = player_node.PlayerNode(context=context)
        node.recording.batches = batches
        node.outputs[1] = SimpleNamespace(publish=lambda data: published.append(seconds[0]))
        assert node._play_once(SimpleNamespace(asked=False), spin)
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)
    assert len(published) == 6001
    # 1000 messages a second; 0.4 s of them would be 400 at once.
    assert max(Counter(round(at / 0.02) for at in published).values()) < 100
    # Four parts of the five are read while others play.
    assert 6.0 + 3 * 0.4 < published[-1] - published[0] < 6.0 + 4 * 0.4 + 0.1


def test_a_recording_without_messages_is_not_played_for_ever(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    with empty.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema(IMU, "ros2msg", b"")
        for topic in CONFIG.topics:
            writer.register_channel(topic, "cdr", schema)
        writer.finish()
    playing = Process("player_node", *WORDS, "-p", f"bag:={empty}", "-p", "loop:=true", "-p", "wait:=0.0")
    assert playing.popen.wait(timeout=PATIENCE) == 2, playing.said()
    assert f"{empty} holds no message of imu_1/data_raw, imu_2/data_raw" in playing.said()


@pytest.mark.parametrize("first", [0, 2_000_000_000 * 10**9])
def test_a_damaged_first_time_is_not_waited_for(tmp_path: Path, first: int) -> None:
    begin = 1_700_000_000 * 10**9
    times = [first, *(begin + k * 10**7 for k in range(1, 100))]
    messages = [(topic, at, imu(at, (0.0, 0.0, 0.0))) for at in times for topic in CONFIG.topics]
    recording = write_mcap(tmp_path / "damaged.mcap", messages)
    with listening() as listener:
        heard: list[int] = []
        for topic in CONFIG.topics:
            listener.create_subscription(Imu, topic, lambda m: heard.append(stamp_of(m)), DEEP)
        start = time.monotonic()
        playing = Process("player_node", *WORDS, "-p", f"bag:={recording}")
        assert playing.popen.wait(timeout=PATIENCE) == 0, playing.said()
        # At its pace, all the same.
        assert time.monotonic() - start > 0.9
        # A subscriber may miss the very first, and a player that has ended sends nothing again.
        assert wait(lambda: len(heard) >= 190), (len(heard), playing.said())
    assert "which is not waited for" in playing.said()


def test_what_cannot_be_played_is_said_in_one_line() -> None:
    refused = {
        "": "no recording given",
        "-p bag:=/nowhere": "no recording at /nowhere",
        "-p bag:=bags/cone_flight -p rate:=0.0": "rate is 0, expected 0.001 to 1000",
        "-p bag:=bags/cone_flight -p rate:=fast": "rate is 'fast', expected a number",
        "-p bag:=bags/cone_flight -p imus.topics:=[a,b]": "has no topic 'a'",
    }
    assert_refused("player_node", refused, *WORDS)
