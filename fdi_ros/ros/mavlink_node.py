# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gyros of PX4 or ArduPilot from MAVLink to Imu topics, declarations back as STATUSTEXT.

Settings come from the parameter file of the monitor, so both have the same units. Nothing
that the node sends commands the vehicle, except `failover`: it sets which IMUs of an
ArduPilot are in use, and may ask an ArduCopter for another EKF lane.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import time
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.expand_topic_name import expand_topic_name
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from std_srvs.srv import Trigger

from fdi_ros.config.config import is_plain_name
from fdi_ros.config.settings import MAVLINK
from fdi_ros.core.messages import (
    ENCAPSULATION,
    LAST_STAMP,
    ImuTemplate,
    as_batch,
)
from fdi_ros.core.sources import ChannelsSource
from fdi_ros.errors import ConfigError
from fdi_ros.mavlink.failover.controller import OVERSAMPLING, Failover
from fdi_ros.mavlink.failover.policy import PolicySettings
from fdi_ros.mavlink.failover.ready import INS_USE
from fdi_ros.mavlink.link import open_link
from fdi_ros.mavlink.protocol import ImuSample, Thinning, system_ahead
from fdi_ros.mavlink.report import Announcer, Reporter, allows_arming
from fdi_ros.mavlink.signing import NO_TIMES, SigningFile, mark_of, read_key
from fdi_ros.mavlink.vehicle import Vehicle, VehicleSettings
from fdi_ros.monitor.diagnostics import (
    DIAGNOSTICS,
    INPUT,
    MONITOR_LINE,
    Level,
    StatusLine,
    encode_diagnostics,
)
from fdi_ros.monitor.output import INTEGRITY
from fdi_ros.ros.node import REPORT_PERIOD, CheckedNode, message_class, read_diagnostics
from fdi_ros.ros.process import Stop, guarded, make_executor
from fdi_ros.system.clocks import read_clocks

IMU = "sensor_msgs/msg/Imu"
NAMES = (
    "imu_1",
    "imu_2",
    "imu_3",
)  #: Names of units where the settings name none, on topics ``NAME/data_raw``.
WAIT = 0.02  #: Longest wait for the link between two turns of the executor, s.
#: Suffix of topics of the injector, the monitor's inputs on a bench.
INJECTED = "_faulty"
PARTING = 4.0  #: Longest wait at the end, on the ground, until IMUs are put back, s.
_SEND_EVERY = 10_000_000  # interval at which due messages are sent, ns
# largest diagnostics that are read, bytes; twelve channels take 10 000
_LARGEST = 1 << 17
_VALUE_EVERY = 450_000_000  # interval between two NAMED_VALUE_FLOAT of one name, ns


class AutopilotNode(CheckedNode):
    """Publishes the IMUs of an autopilot, one topic for each unit.

    Raises `FdiError` if a parameter is wrong.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("mavlink_node", MAVLINK, subscribes=False, **options)
        params = self.values()
        config = self.config
        settings = self._settings(params)
        self._link = open_link(params["url"])
        self._signing = self._keep_signing_times(params, settings.key)
        times = NO_TIMES if self._signing is None else self._signing.written
        self._vehicle = Vehicle(settings, self._link.send, time.time, times)
        names = config.imu_names if config.has_units else NAMES
        topics = (
            config.topics
            if config.has_units
            else [f"{name}/data_raw" for name in NAMES]
        )
        outputs = [self.create_output(IMU, topic) for topic in topics]
        self._topics = [output.topic_name for output in outputs]
        self._units = list(zip(outputs, map(ImuTemplate, names), strict=True))
        self._reporter = Reporter(self._link, self._vehicle, names, self._topics)
        self._diagnostics = self.create_diagnostics()
        self._valued = self._due = 0
        self._link_state = (
            0,
            self._link.trouble,
        )  # number of times opened, and the reason if it is not open
        self._ahead = system_ahead()
        self._called = False  # whether the executor has run a callback
        channels = config.channel_names or [
            f"{name}.{axis}" for name in names for axis in "xyz"
        ]
        self._sends_values: bool = params["named_values"]
        # Diagnostics have the full name without the first slash.
        self._monitor = expand_topic_name(
            params["monitor"], self.get_name(), self.get_namespace()
        ).lstrip("/")
        self._failover = (
            None if params["failover"] == "off" else self._make_failover(params)
        )
        bound = None if self._failover is None else self._failover.evidence.bound
        self._announcer = Announcer(channels, bound) if params["statustext"] else None
        if (
            self._announcer is not None
            or self._sends_values
            or self._failover is not None
        ):
            few = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
            self.create_subscription(
                DiagnosticArray, DIAGNOSTICS.name, self._on_diagnostics, few, raw=True
            )
        self.every(REPORT_PERIOD, self._report)
        self.get_logger().info(f"listening on {params['url']}")

    def _settings(self, params: dict[str, Any]) -> VehicleSettings:
        if not is_plain_name(params["monitor"]):
            raise ConfigError(
                f"monitor is {params['monitor']!r}, expected the name of a node, such as fdi_node or /drone/fdi_node"
            )
        rate = params["rate"] or self.config.sample_rate
        if not 1.0 <= rate <= 1000.0:
            raise ConfigError(f"rate is {rate:g} Hz, expected 1 to 1000 Hz")
        kind = (
            "" if params["messages"] == "auto" else f"{params['messages'].upper()}_IMU"
        )
        key = read_key(params["signing_key"]) if params["signing_key"] else b""
        self._thinning = (
            None if params["failover"] == "off" else Thinning(round(1e9 / rate))
        )
        rate *= 1.0 if self._thinning is None else OVERSAMPLING
        return VehicleSettings(
            params["system_id"], params["component_id"], kind, rate, key
        )

    def _state_path(self, params: dict[str, Any], kind: str) -> Path:
        """Return the path of a file that outlives a restart, in the folder of such files."""
        if given := params["failover_file"]:
            folder = Path(given).expanduser().parent
        else:
            folder = Path(os.environ.get("ROS_HOME", "~/.ros")).expanduser()
            # Without the folder the file is not usable, and its owner says so.
            with contextlib.suppress(OSError):
                folder.mkdir(parents=True, exist_ok=True)
        name = self.get_fully_qualified_name().strip("/").replace("/", "_")
        return folder / f"{name}_{kind}.json"

    def _keep_signing_times(
        self, params: dict[str, Any], key: bytes
    ) -> SigningFile | None:
        if not key:
            return None
        # A file for each key: a start with a wrong one must not end the times of the right one.
        file = SigningFile(self._state_path(params, f"signing_{mark_of(key)}"))
        if file.trouble:
            self.get_logger().warning(file.trouble)
        return file

    def _make_failover(self, params: dict[str, Any]) -> Failover:
        units = len(self.config.topics)
        if (
            not self.config.has_units
            or not 2 <= units <= len(INS_USE)
            or params["messages"] not in ("auto", "scaled")
        ):
            raise ConfigError(
                f"failover is {params['failover']!r}, with {units} topics and messages {params['messages']!r}, expected"
                f" input: imus, 2 to {len(INS_USE)} imus.topics, and messages: scaled"
            )
        if params["failover_limit"] >= units:
            raise ConfigError(
                f"failover_limit is {params['failover_limit']}, expected 0 to {units - 1}"
            )
        given = params["failover_file"]
        path = (
            Path(given).expanduser() if given else self._state_path(params, "failover")
        )
        declarations = f"/{self._monitor}/{INTEGRITY.topic.name.rpartition('/')[2]}"
        kind = message_class(INTEGRITY.topic.type)
        heard = self.create_subscription(
            kind, declarations, self._on_integrity, 10, raw=True
        )
        self._sole = [
            heard.topic_name,
            *self._topics,
        ]  # topics, after remapping, that must have one publisher
        self.create_service(Trigger, "~/restore", self._on_restore)
        if not params["signing_key"]:
            self.get_logger().warning(
                "failover over an unsigned link: whoever reaches it can pass for the autopilot"
            )
        settings = PolicySettings(params["failover_limit"], params["failover_min_size"])
        channels = self.config.channel_names
        return Failover(self._vehicle, channels, settings, path, read_clocks)

    def live(self, stop: Stop) -> None:
        """Serve the link and the executor in turn, in one thread, until stopped."""
        # The executor's queues are bounded, and gyros do not pass through them.
        executor = make_executor(self, "single")
        due = time.monotonic()
        try:
            while rclpy.ok() and not stop.asked:
                self._link.wait(max(0.0, due - time.monotonic()))
                with guarded(self):
                    self._turn()
                if (now := time.monotonic()) >= due:
                    due = now + WAIT
                    with guarded(self):
                        self._give_turn(executor)
            self._put_back()
        finally:
            executor.remove_node(self)

    def _put_back(self) -> None:
        """Put IMUs back before the end. In flight they stay out of use."""
        end = time.monotonic() + PARTING
        while (
            self._failover is not None
            and not self._failover.is_done
            and time.monotonic() < end
        ):
            self._link.wait(WAIT)
            self._turn()

    def _give_turn(self, executor: Any) -> None:
        # A flood of callbacks must not keep the node from the link.
        for _ in range(32):
            self._called = False
            executor.spin_once(timeout_sec=0.0)
            if not self._called:
                break

    # The link -----------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        """Take received messages, and send due ones."""
        self._receive()
        now = time.monotonic_ns()
        if now < self._due:
            return
        self._due = now + _SEND_EVERY
        if self._announcer is not None and self._vehicle.in_reach:
            for text in self._announcer.due(now):
                self._vehicle.send_text(*text)
        if self._failover is not None:
            self._failover.turn(now)
        self._vehicle.tick(now)
        if self._signing is not None:
            trouble = self._signing.keep(self._vehicle.signing_times, now)
            if trouble:
                self.log.warning(trouble)
        while self._vehicle.events:
            self.log.info(self._vehicle.events.popleft())

    def _receive(self) -> None:
        link = self._link
        received = link.receive(time.monotonic_ns())
        if (state := (link.opened, link.trouble)) != self._link_state:
            self._link_state = state
            self.log.info(
                f"{link.url} is {f'not open: {link.trouble}' if link.trouble else 'open'}"
            )
            if not link.trouble:
                self._vehicle.reopened()
        for peer, data in received:
            now = time.monotonic_ns()
            for sample in self._vehicle.feed(peer, data, now):
                if self._failover is not None:
                    self._failover.feed(sample)
                if self._thinning is not None and not self._thinning.picks(sample):
                    continue
                # Topics have the time of the system.
                stamp = sample.stamp + self._ahead
                if sample.unit < len(self._units) and 0 <= stamp <= LAST_STAMP:
                    output, template = self._units[sample.unit]
                    output.publish(encode_imu(template, stamp, sample))

    # The monitor --------------------------------------------------------------------------------------------------

    def _on_diagnostics(self, data: bytes) -> None:
        self._called = True
        now = time.monotonic_ns()
        failover = self._failover
        # All nodes publish here. Decode only messages that name the monitor.
        if len(data) > _LARGEST or f"{self._monitor}: ".encode() not in data:
            return
        try:
            lines = read_diagnostics(
                deserialize_message(data, DiagnosticArray), self._monitor
            )
        except ValueError:
            # The monitor has no such level.
            return
        whole = next((line for line in lines if line.name == MONITOR_LINE), None)
        due = (
            self._sends_values
            and self._vehicle.in_reach
            and now - self._valued >= _VALUE_EVERY
        )
        if whole is not None and due:
            self._valued = now
            for name, key in (("fdi_stat", "statistic"), ("fdi_limit", "threshold")):
                if not math.isnan(value := whole.number(key)):
                    self._vehicle.send_value(name, value, now)
            protects = failover is None or failover.status(now)[0] == Level.OK
            ready = allows_arming(lines) and protects
            self._vehicle.send_value("fdi_ready", float(ready), now)
        if self._announcer is not None:
            self._announcer.hear(lines, now)
        topics = [
            line.value("topic").removesuffix(INJECTED)
            for line in lines
            if line.name.startswith(INPUT)
        ]
        if failover is not None and topics:
            # With other topics, or another order, its channels are other IMUs.
            agrees = (
                whole is not None
                and whole.level != Level.STALE
                and topics == self._topics
            )
            failover.reported = now if agrees else 0

    def _on_integrity(self, data: bytes) -> None:
        self._called = True
        assert self._failover is not None
        now = time.monotonic_ns()
        count = len(self.config.channel_names)
        # Accelerometers follow the gyros and the stamp, and are not used.
        announced = ChannelsSource.announced(*as_batch(data))
        _, values = ChannelsSource.parse(data, max(announced, count + 7))
        # A second publisher is an imitator, a second monitor, or another source of rates.
        self._failover.is_alone = all(
            self.count_publishers(topic) == 1 for topic in self._sole
        )
        self._failover.evidence.hear(values[2 : 2 + count], now)
        seconds, nanoseconds = values[count + 5 : count + 7]  # stamp of the sample
        self._failover.age = time.time() - (seconds + nanoseconds / 1e9)
        self._failover.turn(now)

    def _on_restore(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._called = True
        assert self._failover is not None
        response.success, response.message = self._failover.restore(time.monotonic_ns())
        self.log.warning(f"~/restore: {response.message}")
        return response

    def _report(self) -> None:
        self._called = True
        self.log.begin_period()
        now = time.monotonic_ns()
        hardware = self.config.hardware_id
        self._ahead = system_ahead()
        lines = self._reporter.lines(self.prefix, hardware, now)
        if self._failover is not None:
            level, words = self._failover.status(now)
            lines.append(StatusLine(level, f"{self.prefix}failover", words, hardware))
        self._diagnostics.publish(encode_diagnostics(lines, time.time_ns()))

    def destroy_node(self) -> None:
        """Close the link too."""
        self._link.close()
        for kept in (self._failover, self._signing):
            if kept is not None:
                try:
                    kept.close()
                except ConfigError as error:
                    self.get_logger().error(str(error))
        super().destroy_node()


def encode_imu(template: ImuTemplate, stamp: int, sample: ImuSample) -> bytes:
    """Return the Imu message of a sample, stamped in ns, with acceleration."""
    struct.pack_into(
        "<iI", template.bytes.data, ENCAPSULATION, *divmod(stamp, 1_000_000_000)
    )
    # A covariance of zeros is unknown (REP-145). The template marks acceleration as absent.
    values = (*sample.rate, *(0.0,) * 9, *sample.acceleration, 0.0)
    struct.pack_into("<16d", template.bytes.data, template.at, *values)
    return template.bytes.tobytes()
