# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The injector: passes all on until asked, then strikes as told, and is loud about it."""

from __future__ import annotations

import time

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros.harness import DEEP, RATE, TWO_IMUS, Process, healthy, listening, parameter_file, wait
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from fdi_ros.core.messages import ImuTemplate
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.samples import Block
from fdi_ros.sources import ImuSource


@pytest.fixture(scope="module")
def injector(tmp_path_factory):
    """(listener, what came out of each topic, the injector's last status)."""
    file = parameter_file(TWO_IMUS, tmp_path_factory.mktemp("injector"))
    with listening(TWO_IMUS.topics) as listener:
        process = Process("injector_node", "--ros-args", "--params-file", str(file))
        out: list[list[bytes]] = [[], []]
        said: list[DiagnosticStatus] = []
        for kept, topic in zip(out, TWO_IMUS.topics, strict=True):
            listener.create_subscription(Imu, f"{topic}_faulty", kept.append, DEEP, raw=True)
        listener.create_subscription(DiagnosticArray, "/diagnostics", lambda m: said.append(m.status[0]), 10)
        try:
            assert wait(lambda: all(p.get_subscription_count() for p in listener.outputs)), process.said()
            assert wait(lambda: (listener.play(healthy(5)[1]), all(out))[1])
            yield listener, out, said
        finally:
            assert process.end() == 0, process.said()


def flow(injector, z: np.ndarray) -> tuple[np.ndarray, list[list[bytes]]]:
    """Stamps of samples that are sent, and what comes of them."""
    listener, out, _ = injector

    def rest() -> None:
        before = -1
        while before != (before := sum(map(len, out))):
            time.sleep(0.3)

    rest()
    for kept in out:
        kept.clear()
    stamps = listener.play(z)
    rest()
    return stamps, out


def test_off_it_passes_every_byte(injector) -> None:
    z = healthy(50)[1]
    stamps, out = flow(injector, z)
    template = ImuTemplate("imu")
    for j in range(2):
        sent = [template.fill(s, row[3 * j : 3 * j + 3], (0.0,) * 9) for s, row in zip(stamps.tolist(), z, strict=True)]
        assert out[j] == sent


def test_on_it_strikes_as_the_same_faults_do_offline(injector) -> None:
    listener, _, said = injector
    faults = "channel=imu_2.y kind=bias size=0.2 start=0.2; channel=imu_1 kind=triad_loss start=0.4 stop=0.6"
    result = listener.set("injector_node", faults=faults)
    assert result.successful, result.reason
    assert listener.call(Trigger, "injector_node/start", Trigger.Request()).success
    z = healthy(200)[1]
    stamps, out = flow(injector, z)
    assert wait(lambda: said[-1].level == DiagnosticStatus.WARN and "INJECTING" in said[-1].message)
    names = [f"imu_{k}.{axis}" for k in (1, 2) for axis in "xyz"]
    struck = Injector([parse_fault(text) for text in faults.split(";")], names).apply(Block(stamps, z))
    for j in range(2):
        expected = {
            int(stamp): tuple(row[3 * j : 3 * j + 3])
            for stamp, row, got in zip(stamps, struck.z, struck.received, strict=True)
            if got[3 * j]
        }
        assert dict(ImuSource.parse(data, 3) for data in out[j]) == expected
    assert len(out[0]) == 200 - round(0.2 * RATE)
    assert listener.call(Trigger, "injector_node/stop", Trigger.Request()).success
    assert wait(lambda: said[-1].message == "off")
    stamps, out = flow(injector, z[:20])
    assert [ImuSource.parse(data, 3)[0] for data in out[0]] == stamps.tolist()


def test_a_fault_that_does_not_fit_is_refused(injector) -> None:
    listener, _, _ = injector
    for text, words in (("channel=imu_9.x kind=bias size=1", "imu_9.x"), ("kind=bias", "channel"), ("", "nothing")):
        result = listener.set("injector_node", faults=text, enabled=True)
        assert not result.successful
        assert words in result.reason
