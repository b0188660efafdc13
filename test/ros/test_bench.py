# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What stands in for a vehicle on the bench: a recording that is played, faults on the way, the demo of both."""

import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2")

from bag.recordings import IMU, imu, imu_messages, write_mcap
from diagnostic_msgs.msg import DiagnosticStatus
from mcap.writer import Writer
from ros.harness import RATE, TWO_IMUS, healthy, listening, stamps_of
from ros.processes import (
    PATIENCE,
    ROOT,
    Process,
    assert_refused,
    parameter_file,
    rest,
    running,
    wait,
)
from std_srvs.srv import Trigger

from fdi_ros.bag.reader import Recording
from fdi_ros.config.config import Config
from fdi_ros.core.messages import ImuTemplate
from fdi_ros.core.sources import ImuSource
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState

STATUS = "injector_node: injector"
FILE = ROOT / "config" / "two_imus.yaml"
CONFIG = Config.from_file(FILE)


def test_it_pauses_where_it_is_and_begins_anew_in_a_namespace(tmp_path: Path) -> None:
    stamp = 10**18 + 10**7 * np.arange(3000)
    recording = write_mcap(
        tmp_path / "rest.mcap", imu_messages(stamp, np.zeros((3000, 6)), CONFIG.topics)
    )
    with listening() as listener:
        heard, _ = (listener.hear(f"/drone/imu_{k}/data_raw") for k in (1, 2))
        remaps = ("__ns:=/drone", "/clock:=clock")
        with running(
            "player_node", FILE, *remaps, bag=recording, rate=20.0, loop=True
        ) as playing:
            assert wait(lambda: len(heard) > 100, 2 * PATIENCE), playing.said()
            # The clock of one vehicle, if it is remapped so, is not that of all.
            assert (
                listener.count_publishers("/drone/clock"),
                listener.count_publishers("/clock"),
            ) == (1, 0)
            assert (
                listener.call(Trigger, "/drone/player_node/pause").message == "paused"
            )
            # What was on its way has come, and nothing more comes.
            rest(lambda: len(heard))
            held = len(heard)
            assert (
                listener.call(Trigger, "/drone/player_node/resume").message == "playing"
            )
            assert wait(lambda: (np.diff(stamps_of(heard)) < 0).any()), playing.said()
    stamps = stamps_of(heard)
    steps = np.diff(stamps)
    # The pause, at least 6 s of the recording, is not left out.
    assert 0 < steps[held - 1] < 5 * 10**9
    (first, *_) = np.flatnonzero(steps < 0)
    assert abs(stamps[first + 1] - min(stamps)) < 5 * 10**9
    assert "the recording has ended: from its beginning" in playing.said()


def test_a_bag_waits_for_the_monitor_behind_the_injector_and_is_monitored_in_its_own_time(
    flight, compiled
) -> None:
    """As replay.launch.py starts them; the monitor comes last, as where it compiles first. At four times the speed."""
    with Recording(flight) as recording:
        first = min(
            int(batch.log_time.min()) for batch in recording.batches(CONFIG.topics)
        )
    with (
        listening() as listener,
        running("player_node", FILE, bag=flight, rate=4.0, wait=3600.0) as playing,
        running(
            "injector_node", FILE, use_sim_time=True, suffix="_faulty"
        ) as injecting,
    ):
        assert wait(lambda: "waiting for subscribers" in playing.said()), playing.said()
        assert wait(lambda: listener.count_publishers("imu_1/data_raw_faulty") == 1), (
            injecting.said()
        )
        assert listener.count_subscribers("imu_1/data_raw") == 0
        remaps, started = (
            [f"{topic}:={topic}_faulty" for topic in CONFIG.topics],
            time.monotonic(),
        )
        with running(
            "fdi_node",
            FILE,
            *remaps,
            use_sim_time=True,
            bias__startup_bias_duration=0.0,
        ) as monitor:
            assert wait(lambda: len(listener.fused) > 0), (
                playing.said(),
                injecting.said(),
                monitor.said(),
            )
            heard = time.monotonic()
            assert wait(lambda: len(listener.fused) > 400), (
                playing.said(),
                injecting.said(),
                monitor.said(),
            )
    assert "playing all the same" not in playing.said()
    assert not np.isin(
        listener.states(), (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
    ).any()
    stamps = listener.stamps()
    assert stamps == sorted(set(stamps))
    assert (np.diff(stamps) % 10**7 == 0).all()
    # Of the recording no more is missing than was played since the monitor started: the player had waited for it.
    assert stamps[0] - first < 4.0 * (heard - started) * 1e9


def test_damaged_times_are_not_waited_for(tmp_path: Path) -> None:
    begin = 1_700_000_000 * 10**9
    times = [begin + k * 10**7 for k in range(100)]
    times[0], times[50] = 0, 2_000_000_000 * 10**9
    messages = [
        (topic, at, imu(at, (0.0, 0.0, 0.0))) for at in times for topic in CONFIG.topics
    ]
    recording = write_mcap(tmp_path / "damaged.mcap", messages)
    with listening() as listener:
        heard = [listener.hear(topic) for topic in CONFIG.topics]
        start = time.monotonic()
        playing = Process("player_node", FILE, bag=recording)
        assert playing.popen.wait(timeout=PATIENCE) == 0, playing.said()
        # At its pace, all the same.
        assert time.monotonic() - start > 0.9
        # A subscriber may miss the first, and a player that has ended sends nothing again.
        assert wait(lambda: sum(map(len, heard)) > 150), playing.said()
    assert playing.said().count("which is not waited for") >= 2


def test_a_recording_without_messages_is_not_played_for_ever(tmp_path: Path) -> None:
    empty = tmp_path / "empty.mcap"
    with empty.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        schema = writer.register_schema(IMU, "ros2msg", b"")
        for topic in CONFIG.topics:
            writer.register_channel(topic, "cdr", schema)
        writer.finish()
    playing = Process("player_node", FILE, bag=empty, loop=True, wait=0.0)
    assert playing.popen.wait(timeout=PATIENCE) == 2, playing.said()
    assert (
        f"{empty} holds no message of imu_1/data_raw, imu_2/data_raw" in playing.said()
    )


def test_what_cannot_be_played_is_said_in_one_line() -> None:
    refused = {
        "": "no recording given",
        "-p bag:=/nowhere": "no recording at /nowhere",
        "-p bag:=bags/cone_flight -p rate:=0.0": "rate is 0, expected 0.001 to 1000",
        "-p bag:=bags/cone_flight -p rate:=fast": "rate is 'fast', expected a number",
        "-p bag:=bags/cone_flight -p imus.topics:=[a,b]": "has no topic 'a'",
    }
    assert_refused("player_node", refused, "--ros-args", "--params-file", str(FILE))


@pytest.fixture(scope="module")
def injector(tmp_path_factory):
    """(listener, what came out of each topic)."""
    file = parameter_file(TWO_IMUS, tmp_path_factory.mktemp("injector"))
    with (
        listening(TWO_IMUS.topics) as listener,
        running("injector_node", file) as process,
    ):
        out = [listener.hear(f"{topic}_faulty") for topic in TWO_IMUS.topics]
        assert wait(
            lambda: all(p.get_subscription_count() for p in listener.outputs)
        ), process.said()
        assert wait(lambda: (listener.play(healthy(5)[1]), all(out))[1])
        yield listener, out


def flow(injector, z: np.ndarray) -> tuple[np.ndarray, list[list[bytes]]]:
    """Stamps of samples that are sent, and what comes of them."""
    listener, out = injector
    rest(lambda: sum(map(len, out)))
    for kept in out:
        kept.clear()
    stamps = listener.play(z)
    rest(lambda: sum(map(len, out)))
    return stamps, out


def test_off_it_passes_every_byte(injector) -> None:
    z = healthy(50)[1]
    stamps, out = flow(injector, z)
    template = ImuTemplate("imu")
    for stamp, row, *came in zip(
        stamps.tolist(), z.reshape(-1, 2, 3), *out, strict=True
    ):
        assert came == [template.fill(stamp, rate, (0.0,) * 9) for rate in row]


def test_on_it_strikes_as_the_same_faults_do_offline(injector) -> None:
    listener, _ = injector
    faults = "channel=imu_2.y kind=bias size=0.2 start=0.2; channel=imu_1 kind=triad_loss start=0.4 stop=0.6"
    assert listener.set("injector_node", faults=faults).successful
    assert listener.call(Trigger, "injector_node/start").success
    z = healthy(200)[1]
    stamps, out = flow(injector, z)
    assert listener.says(STATUS, "INJECTING")
    assert listener.status(STATUS).level == DiagnosticStatus.WARN
    names = [f"imu_{k}.{axis}" for k in (1, 2) for axis in "xyz"]
    struck = Injector([parse_fault(text) for text in faults.split(";")], names).apply(
        Block(stamps, z)
    )
    for unit, axes in ((0, slice(3)), (1, slice(3, 6))):
        passed = struck.received[:, axes].all(axis=1)
        got_stamps, rates = zip(
            *(ImuSource.parse(data, 3) for data in out[unit]), strict=True
        )
        np.testing.assert_array_equal(got_stamps, stamps[passed])
        np.testing.assert_array_equal(rates, struck.z[passed, axes])
    assert len(out[0]) == 200 - round(0.2 * RATE)
    assert listener.call(Trigger, "injector_node/stop").success
    assert wait(lambda: listener.status(STATUS).message == "off")
    stamps, out = flow(injector, z[:20])
    assert stamps_of(out[0]) == stamps.tolist()


def test_a_fault_that_does_not_fit_is_refused(injector) -> None:
    listener, _ = injector
    for text, words in (
        ("channel=imu_9.x kind=bias size=1", "imu_9.x"),
        ("kind=bias", "channel"),
        ("", "nothing"),
    ):
        result = listener.set("injector_node", faults=text, enabled=True)
        assert not result.successful
        assert words in result.reason


def test_in_the_demo_the_fault_is_found_shown_and_summed_up(
    quiet_domain, compiled
) -> None:
    command = [sys.executable, "examples/demo.py", "--seconds", "6.0"]
    command += ["--fault", "channel=imu_1.z kind=bias size=-0.2 start=5.0"]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    # A machine that is busy may deliver both changes at once.
    assert re.search(
        r"^[\d:.]+  imu_1\.z  (OK|SUSPECT|AMBIGUOUS) -> FAULTY",
        done.stdout,
        re.MULTILINE,
    ), done.stdout
    assert re.search(
        r"  all  UNCHECKED: no sample yet|  all  UNCHECKED -> OK", done.stdout
    ), done.stdout
    # What is to come is said until it is there, and then what has come.
    before, begins, after = done.stdout.partition("fault since 5 s: channel=imu_1.z")
    assert begins
    assert before.startswith("This demo plays 6 s of a recorded flight")
    assert "fault to come at 5 s: channel=imu_1.z" in before
    assert "to come" not in after
    assert "5.00 s  the demo adds the fault: channel=imu_1.z" in done.stdout
    assert re.search(r"5\.\d\d s  the monitor names imu_1\.z", done.stdout)
    assert "no healthy gyro was named" in done.stdout
