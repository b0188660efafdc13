# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""mavlink_node on real links, with simulated autopilots: Imu topics out, declarations back, nothing waits."""

import contextlib
import json
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from mavlink.autopilots import NS, Autopilot, OverPty, OverUdp, free_port
from ros.harness import Listener, listening, stamps_of
from ros.processes import ROOT, Process, assert_refused, running, wait
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from fdi_ros.system.clocks import read_clocks

TOPICS = tuple(f"imu_{k}/data_raw" for k in (1, 2, 3))


@contextlib.contextmanager
def linked(
    stack: str, url: str, *remaps: str, **parameters: object
) -> Iterator[tuple[Listener, Process]]:
    """The node of a link, and what hears it."""
    file = ROOT / "config" / f"{stack}.yaml"
    with (
        listening() as ears,
        running("mavlink_node", file, *remaps, url=url, **parameters) as process,
    ):
        ears.speaker, ears.imu = "mavlink_node", [ears.hear(topic) for topic in TOPICS]
        yield ears, process


@contextlib.contextmanager
def linked_over_udp(
    *autopilots: Autopilot, remaps: tuple[str, ...] = (), **parameters: object
) -> Iterator[tuple[Listener, Process]]:
    port, stack = free_port(), autopilots[0].stack
    with (
        OverUdp(port, *autopilots),
        linked(stack, f"udpin:127.0.0.1:{port}", *remaps, **parameters) as pair,
    ):
        yield pair


def struck(autopilot: Autopilot, unit: int, axis: int) -> Callable[[], None]:
    """What, when called, lets a gyro of the autopilot go bad."""
    strikes, healthy = [], autopilot.motion

    def motion(t: float) -> np.ndarray:
        z = healthy(t)
        z[unit, axis] += 0.3 * bool(strikes)
        return z

    autopilot.motion = motion
    return lambda: strikes.append(True)


def test_px4_over_udp_is_chosen_among_two_monitored_and_told(
    quiet_domain, compiled
) -> None:
    """The whole way: gyros to the node, to the monitor, its declaration back to the autopilot."""
    autopilot, other = (
        Autopilot("px4", system=system, seed=system) for system in (2, 1)
    )
    strike = struck(autopilot, 1, 1)
    with (
        running("fdi_node", ROOT / "config" / "px4.yaml") as monitor,
        linked_over_udp(autopilot, other, named_values=True, system_id=2) as (
            ears,
            process,
        ),
    ):
        assert ears.says(
            "link", "PX4, system 2; other autopilots on the link, left aside: 1"
        )
        assert ears.says("unit imu_3", "Hz of 50 asked for"), process.said()
        assert not other.intervals
        assert wait(lambda: float(ears.value("unit imu_2", "rate (Hz)") or 0) > 35), (
            process.said()
        )
        assert ears.says("fdi_node: monitor", "9 of 9"), monitor.said()
        # By the clock of this computer, within what TIMESYNC says and the step of a millisecond.
        now = time.time_ns()
        assert wait(lambda: len(ears.imu[0]) > 50)
        assert abs(stamps_of(ears.imu[0])[-1] - now) < 30 * NS
        assert 0 < float(ears.value("link", "stamps known to (ms)")) < 50
        assert ears.value("link", "resolution") == "1 mrad/s, 1 ms"
        assert wait(lambda: autopilot.values.get("fdi_ready") == 1.0), monitor.said()
        strike()
        told = (2, "FDI: imu_2.y faulty")
        assert wait(lambda: told in autopilot.texts), (autopilot.texts, monitor.said())
        assert wait(lambda: autopilot.values["fdi_ready"] == 0.0)
        assert {"fdi_stat", "fdi_limit"} <= autopilot.values.keys()
        assert autopilot.values["fdi_limit"] > 0
        assert {command[0] for command in autopilot.commands} == {511}


def test_a_faulty_imu_of_ardupilot_is_taken_out_of_use_and_put_back(
    quiet_domain, compiled, tmp_path
) -> None:
    """The closed loop: gyros to the monitor, its declaration to the autopilot, which then flies with another IMU."""
    autopilot = Autopilot("ardupilot", armed=True)
    strike = struck(autopilot, 0, 1)
    remaps, failover = (
        ("/fdi_node/integrity:=/verdict",),
        {"failover": "ardupilot", "failover_file": tmp_path / "out"},
    )
    with (
        running(
            "fdi_node", ROOT / "config" / "ardupilot.yaml", "~/integrity:=/verdict"
        ) as monitor,
        linked_over_udp(autopilot, remaps=remaps, **failover) as (ears, process),
    ):
        assert ears.says("failover", "ready"), process.said()
        assert ears.says("fdi_node: monitor", "9 of 9"), monitor.said()
        stranger = ears.create_publisher(Imu, "imu_1/data_raw", 1)
        assert ears.says("failover", "monitor silent or not alone"), (
            "rates of another source"
        )
        ears.destroy_publisher(stranger)
        ears.clear()
        assert ears.says("failover", "ready")
        strike()
        assert wait(lambda: autopilot.flies_with == 1), (
            autopilot.sets,
            process.said(),
            monitor.said(),
        )
        told = "FDI: IMU 1 out of use (gyro y"
        assert wait(lambda: any(text.startswith(told) for _, text in autopilot.texts))
        assert ears.says("failover", "out of use: IMU 1 of system 1")
        assert (
            ears.call(Trigger, "/mavlink_node/restore").message
            == "the autopilot is asked to use IMU 1 again"
        )
        assert wait(lambda: autopilot.flies_with == 0)
        assert {(name, value) for _, name, value in autopilot.sets} == {
            ("INS_USE", 0.0),
            ("INS_USE", 1.0),
        }
        assert "failover over an unsigned link" in process.said()


def test_what_is_out_of_use_is_put_back_on_the_ground_if_the_monitor_reports_no_fault(
    quiet_domain, compiled, tmp_path
) -> None:
    """The link is signed: the times of its messages go on over each restart."""
    key, file = tmp_path / "key", tmp_path / "out.json"
    key.touch(0o600)
    key.write_bytes(bytes(range(32)))
    autopilot = Autopilot("ardupilot", armed=True, key=key.read_bytes())
    begun = autopilot.mav.signing.timestamp
    autopilot.parameters["INS_USE2"] = 0.0
    clocks = read_clocks()
    saved = {
        "system_id": 1,
        "out_of_use": [2],
        "autopilot_booted": clocks.unix + autopilot.boot / NS,
        "after_computer": clocks.uptime + autopilot.boot / NS,
        "computer_boot": clocks.boot,
        "bad_axes": ["xyz"],
        "bad_errors": [{axis: [0.3, 1.0] for axis in "xyz"}],
    }
    file.write_text(json.dumps(saved))
    failover = {
        "failover": "ardupilot",
        "failover_file": file,
        "signing_key": key,
    }
    with linked_over_udp(autopilot, **failover) as (ears, _):
        assert ears.says("link", "ArduPilot, system 1")
        assert ears.says("failover", "out of use: IMU 2 of system 1")
    [kept] = tmp_path.glob("mavlink_node_signing_*.json")
    times = json.loads(kept.read_text())
    [[*sender, time_of_last]] = times["latest"]
    assert sender == [0, 1, 1]
    assert begun < time_of_last < autopilot.mav.signing.timestamp
    assert autopilot.parameters["INS_USE2"] == 0.0, "in flight it stays out"
    autopilot.armed = False
    with linked_over_udp(autopilot, **failover) as (ears, _):
        told = (4, "FDI: IMU 2 stays out, monitor does not find it OK")
        assert wait(lambda: told in autopilot.texts), autopilot.texts
    assert autopilot.parameters["INS_USE2"] == 0.0, "nothing is known of it"
    autopilot.texts.clear()
    with (
        running("fdi_node", ROOT / "config" / "ardupilot.yaml") as monitor,
        linked_over_udp(autopilot, **failover) as (ears, process),
    ):
        assert ears.says("fdi_node: monitor", "9 of 9"), monitor.said()
        assert wait(lambda: autopilot.parameters["INS_USE2"] == 1.0), process.said()
        assert ears.says("failover", "ready")
    assert '"out_of_use": []' in file.read_text()


def test_ardupilot_over_a_serial_line_that_comes_late_and_is_cut_while_it_restarts(
    quiet_domain, tmp_path
) -> None:
    pytest.importorskip("serial", reason="serial lines need pyserial")
    device, autopilot = tmp_path / "device", Autopilot("ardupilot", loss=0.02)
    with linked("ardupilot", f"serial:{device}:57600") as (ears, process):
        assert ears.says("link", "No such file or directory")
        assert process.said().count("is not open: ") == 1
        with OverPty(autopilot) as line:
            device.symlink_to(line.device)
            assert ears.says("unit imu_3", "Hz of 50 asked for"), process.said()
            assert "57600 is open" in process.said()
            line.silent = True
            assert ears.says("link", "nothing of ArduPilot, system 1")
            assert ears.says("unit imu_1", "silent for")
            autopilot.reboot(time.monotonic_ns())
            line.silent = False
            ears.clear()
            assert ears.says("unit imu_1", "Hz of 50 asked for")
            count = len(ears.imu[2])
            assert wait(lambda: len(ears.imu[2]) > count + 100)
            assert all((np.diff(stamps_of(heard)) > 0).all() for heard in ears.imu)
            assert ears.value("link", "restarts of the autopilot's time") == "1"
    assert "has started anew" in process.said()


def test_what_is_wrong_is_one_line() -> None:
    refused = {
        "-p url:=udp:1": "url is 'udp:1', expected udpin:HOST:PORT",
        "-p monitor:=a//b": "monitor is 'a//b', expected the name of a node, such as fdi_node or /drone/fdi_node",
        "-p messages:=attitude": "messages is 'attitude', expected one of: auto, highres, raw, scaled",
        "-p failover:=px4": "failover is 'px4', expected one of: off, ardupilot",
        "-p failover:=off -p rate:=0.1": "rate is 0.1 Hz",
        "-p failover:=ardupilot": "expected input: imus, 2 to 3 imus.topics, and messages: scaled",
        "-p failover:=ardupilot -p failover_limit:=2 -p input:=imus -p imus.topics:=[a,b]": "expected 0 to 1",
        "-p signing_key:=/nowhere/key -p rate:=100.0": "cannot read signing_key /nowhere/key",
    }
    assert_refused("mavlink_node", refused, "--ros-args")
