# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated autopilots, made of pymavlink: what PX4 and ArduPilot send of their IMUs, and how they answer; in simulated
time (`Conversation`), or on a real link (`Driver`).

Habits, from their sources: both cut rates off to whole mrad/s towards zero and stamp SCALED_IMU in milliseconds. PX4
sends the sample that is newest when a stream is due, with the time of that sample, of each IMU at phases of its own;
asks for TIMESYNC itself; HIGHRES_IMU is the IMU it has selected, always under id 0. ArduPilot stamps with the time of
sending, its gyros are those of the last turn of its loop, RAW_IMU is IMU 1 in mrad/s; intervals are whole milliseconds.
Both send SCALED_IMU3 with zeros but for the magnetometer where there is a third compass and no third IMU.
ArduPilot's parameters outlive a restart, come as float, are said to all whenever they are set, also to the same value,
and again with their old value after the text `Param write denied (NAME)`; it flies with the first IMU that is in use.
Seen in ArduCopter 4.6.3's own simulation: a read is answered up to 100 ms late, from another thread, with the value of
when it was read (`late_reads`); EKF lane k follows IMU k, or the first IMU in use while IMU k is out (`lanes`); notch
filters are allocated at the start, only for IMUs in use then (`notches`), and EKF lanes for the IMUs in EK3_IMU_MASK,
of which the start removes those that do not exist. It flies with the gyro of its primary lane: of EK3_PRIMARY while
disarmed, in flight often of a lane that a bad IMU has misled (`misled`), until the auxiliary function 103 asks for the
best one. It changes at most once in 5 s, and says so in two texts (`primary`).
"""

import contextlib
import heapq
import math
import os
import pty
import select
import socket
import struct
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.mavlink.protocol import ImuSample
from fdi_ros.mavlink.signing import NO_TIMES, SigningTimes, now_in_steps
from fdi_ros.mavlink.vehicle import Vehicle, VehicleSettings

NS = 1_000_000_000
Motion = Callable[[float], np.ndarray]
"""Rates of all IMUs, (units, 3) rad/s in FRD, at a time since the start of the simulation, s."""


@dataclass
class Gentle:
    """Gentle motion of a vehicle, and white noise of its IMUs."""

    units: int
    noise: float
    random: np.random.Generator
    size: float = 1.0

    def __call__(self, t: float) -> np.ndarray:
        omega = self.size * np.array(
            [0.5 * math.sin(0.8 * t), 0.4 * math.cos(1.1 * t), 0.3 * math.sin(0.5 * t)]
        )
        return omega + self.random.normal(0.0, self.noise, (self.units, 3))


def gentle(units: int, seed: int = 0, noise: float = 0.002) -> Gentle:
    """Return the motion of a vehicle in gentle motion, with noise by a seed, rad/s."""
    return Gentle(units, noise, np.random.default_rng(seed))


def milli(value: float) -> int:
    """Cut off to whole thousandths, as a cast in C does."""
    return int(min(max(value * 1000.0, -32768.0), 32767.0))


MESSAGES = {
    26: "scaled_imu",
    27: "raw_imu",
    105: "highres_imu",
    116: "scaled_imu2",
    129: "scaled_imu3",
}
#: Messages that `framed` makes.
SCALED_IMU = {
    26: mavlink.MAVLink_scaled_imu_message,
    116: mavlink.MAVLink_scaled_imu2_message,
    129: mavlink.MAVLink_scaled_imu3_message,
}
HEADER = struct.Struct("<BBBBBBBHB")
PARAMETERS = ("INS_USE", "INS_USE2", "INS_USE3")
EKF_LANES = "EK3_IMU_MASK"
EKF_PRIMARY = "EK3_PRIMARY"
DO_AUX_FUNCTION, LANE_SWITCH = 218, 103
LANE_PAUSE = 5 * NS  #: Least time between two changes of the primary lane, ns.
LANE_RECOVERY = 7.0  #: Time constant with which the attitude of a lane recovers, s.


def framed(mav: mavlink.MAVLink, number: int, fields: Sequence[int]) -> bytes:
    """Return a message of `SCALED_IMU`, unsigned, as pymavlink packs it, at a quarter of its cost."""
    kind = SCALED_IMU[number]
    payload = kind.unpacker.pack(*fields, 0).rstrip(b"\0") or b"\0"
    sender = (mav.seq, mav.srcSystem, mav.srcComponent)
    content = HEADER.pack(0xFD, len(payload), 0, 0, *sender, number, 0) + payload
    checksum = mavlink.x25crc(content[1:] + bytes((kind.crc_extra,))).crc
    return content + checksum.to_bytes(2, "little")


@dataclass(eq=False)
class Autopilot:
    """One autopilot; `step` and `take` are given the time, so that it runs in a test's time or on a real link."""

    stack: str = "px4"
    motion: Motion | None = None
    units: int = 3
    compasses: int = 1
    system: int = 1
    boot: int = -10 * NS  # time here when it started, ns
    key: bytes = b""
    utc: float | None = None
    loss: float = 0.0
    rates: dict[int, float] = field(
        default_factory=dict
    )  # Hz by message id, without being asked
    seed: int = 0
    texts: list[tuple[int, str]] = field(default_factory=list)
    values: dict[str, float] = field(default_factory=dict)
    commands: list[tuple[int, ...]] = field(default_factory=list)
    refuses: set[int] = field(default_factory=set)
    parameters: dict[str, float] = field(
        default_factory=lambda: {
            **dict.fromkeys(PARAMETERS, 1.0),
            EKF_LANES: 7.0,
            EKF_PRIMARY: 0.0,
        }
    )
    read_only: set[str] = field(default_factory=set)
    sets: list[tuple[int, str, float]] = field(
        default_factory=list
    )  # when each PARAM_SET came, ns, and what it said, but those of 1 where it is 1
    probes: list[tuple[int, str]] = field(default_factory=list)  # and when these came
    hears_sets: bool = True  # a router may drop PARAM_SET, and pass all else
    armed: bool = False
    sent: int = 0
    vehicle: int = mavlink.MAV_TYPE_QUADROTOR
    late_reads: int = 0  # ns by which an answer to a read is late
    bias: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """Errors of the gyros, (IMU, axis) rad/s in FRD."""

    def __post_init__(self) -> None:
        self.motion = self.motion or gentle(self.units, self.seed)
        self.start = self.boot  # where the motion's time counts from, ns
        self.mav, self.inbound = (
            mavlink.MAVLink(None, self.system, 1),
            mavlink.MAVLink(None),
        )
        self.inbound.robust_parsing = True
        for codec in (self.mav, self.inbound):
            if self.key:
                codec.signing.secret_key, codec.signing.sign_outgoing = self.key, True
                codec.signing.timestamp = now_in_steps(
                    time.time() if self.utc is None else self.utc
                )
        self.intervals = {
            number: round(1e6 / rate) for number, rate in self.rates.items()
        }  # us by message id
        self.due: dict[int, int] = {}
        self.random = np.random.default_rng(self.seed + 1)
        self._beat = self._asked = 0
        self._moved: tuple[int, np.ndarray] = (-1, np.empty(0))  # rates at a time, ns
        self._answers: list[tuple[int, str, float]] = []  # when, ns; name and value
        self.primary = 0  # lane, from 0
        self.misled = np.zeros(self.units)  # error of the attitude of each lane, rad
        self.lane_asks: list[int] = []  # when the lane switch was asked for, ns
        self._lane_changed, self._flown_until = -LANE_PAUSE, 0
        self._was_armed = False
        self._allocate()
        self._lock = threading.Lock()

    @property
    def flies_with(self) -> int:
        """First IMU in use, from 0; -1: none."""
        return next(
            (k for k in range(self.units) if self.parameters.get(PARAMETERS[k], 1.0)),
            -1,
        )

    @property
    def lanes(self) -> list[int]:
        """IMU that each EKF lane follows, from 0."""
        names = PARAMETERS[: self.units]
        used = [bool(self.parameters.get(name, 1.0)) for name in names]
        own = [k for k in range(self.units) if self.has_lane >> k & 1]
        return [k if used[k] else self.flies_with for k in own]

    def _fly(self, now: int, out: list[bytes]) -> None:
        """Mislead the lanes by the errors of their IMUs until a time, ns."""
        seconds = (now - self._flown_until) / NS if self._flown_until else 0.0
        self._flown_until = now
        if self.stack == "px4":
            return
        if self.armed and not self._was_armed:
            self.say(6, "Arming motors", out)
        self._was_armed = self.armed
        if not self.armed:
            self.misled[:] = 0.0
            self.primary = int(self.parameters.get(EKF_PRIMARY, 0.0))
            return
        self.misled *= math.exp(-seconds / LANE_RECOVERY)
        for lane, imu in enumerate(self.lanes):
            self.misled[lane] += seconds * float(np.linalg.norm(self.bias[imu]))

    def _change_lane(self, now: int, out: list[bytes]) -> None:
        """Change to the best lane."""
        self.lane_asks.append(now)
        self._fly(now, out)
        best = int(np.argmin(self.misled[: len(self.lanes)]))
        is_better = self.misled[best] < self.misled[self.primary]
        if is_better and now - self._lane_changed >= LANE_PAUSE:
            self.change_primary(best, now, out)

    def change_primary(self, lane: int, now: int, out: list[bytes]) -> None:
        """Change to a lane, and say so."""
        self.primary, self._lane_changed = lane, now
        for severity, text in ((2, "EKF3 lane switch"), (4, "EKF primary changed:")):
            words = f"{text} {lane}" if severity == 2 else f"{text}{lane}"
            self.say(severity, words, out)

    def say(self, severity: int, text: str, out: list[bytes]) -> None:
        """Send a text."""
        self._send(self.mav.statustext_encode(severity, text.encode()), out)

    def _allocate(self) -> None:
        known = [self.parameters.get(name, 0.0) for name in PARAMETERS[: self.units]]
        self.notches = [bool(value) for value in known]
        existing = (1 << self.units) - 1
        self.has_lane = int(self.parameters.get(EKF_LANES, 0)) & existing
        if EKF_LANES in self.parameters:
            self.parameters[EKF_LANES] = float(self.has_lane)

    def reboot(self, now: int) -> None:
        """Start anew: the clock begins at zero, intervals are forgotten."""
        with self._lock:
            self.boot, self._beat = now, 0
            self._allocate()
            self.intervals.clear()
            self.due.clear()

    def clock(self, now: int) -> int:
        """us since its start."""
        return (now - self.boot) // 1000

    def _send(self, message, out: list[bytes]) -> None:
        self._send_frame(bytes(message.pack(self.mav)), out)

    def _send_frame(self, data: bytes, out: list[bytes]) -> None:
        self.mav.seq = (self.mav.seq + 1) % 256
        if self.random.random() >= self.loss:
            out.append(data)
            self.sent += 1

    def due_at(self) -> int:
        """Return the time from which `step` sends something, ns."""
        times = [self.due.get(number, 0) for number in self.intervals]
        times += [at for at, *_ in self._answers]
        if self.stack == "px4":
            times.append(self._asked + NS // 10)
        return min([self._beat + NS, *times])

    def step(self, now: int) -> list[bytes]:
        """Messages to be sent now."""
        with self._lock:
            # A test that starts it anew runs beside the thread that drives it.
            return self._step(max(now, self.boot))

    def _step(self, now: int) -> list[bytes]:
        out: list[bytes] = []
        self._fly(now, out)
        if self._answers:
            for at, name, value in self._answers:
                if at <= now:
                    self._send_value(name, value, out)
            self._answers = [one for one in self._answers if one[0] > now]
        if now - self._beat >= NS:
            self._beat = now
            kind = (
                mavlink.MAV_AUTOPILOT_PX4
                if self.stack == "px4"
                else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
            )
            mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0
            self._send(
                self.mav.heartbeat_encode(self.vehicle, kind, mode, 0, 4),
                out,
            )
        if self.stack == "px4" and now - self._asked >= NS // 10:
            self._asked = now
            self._send(self.mav.timesync_encode(0, self.clock(now) * 1000), out)
        for number, interval in list(self.intervals.items()):
            due = self.due.get(number)
            if due is None:
                # ArduPilot sends all messages of an interval together, PX4 each from when it was asked for.
                step = interval * 1000 if self.stack != "px4" else 1
                due = self.due[number] = -((self.boot - now) // step) * step + self.boot
            if now >= due:
                # After a pause too, messages of one interval have the same times.
                passed = max(1, (now - due) // (interval * 1000))
                self.due[number] = due + passed * interval * 1000
                self._imu(number, now, out)
        return out

    def _sampled(self, unit: int, now: int) -> int:
        """Time of the newest sample of an IMU, ns."""
        if self.stack == "px4":
            period, phase = 5_000_000, 700_000 * unit
            return (now - self.boot - phase) // period * period + phase + self.boot
        return (now - self.boot) // 2_500_000 * 2_500_000 + self.boot

    def _imu(self, number: int, now: int, out: list[bytes]) -> None:
        if number not in MESSAGES or (number == 27 and self.stack == "px4"):
            return
        encode = getattr(self.mav, f"{MESSAGES[number]}_encode")
        unit = {116: 1, 129: 2}.get(number, 0)
        if unit >= self.units:
            if unit < self.compasses:
                self._send(
                    encode(self.clock(now) // 1000, *(0,) * 6, 200, -30, 410), out
                )
            return
        sampled = self._sampled(unit, now)
        if sampled != self._moved[0]:
            self._moved = sampled, self.motion((sampled - self.start) / NS)
        rate = (self._moved[1][unit] + self.bias[unit]).tolist()
        stamp = self.clock(sampled if self.stack == "px4" else now)
        if number == 105:
            self._send(
                encode(stamp, 0.0, 0.0, -9.80665, *rate, *(0.0,) * 7, 0x1FFF, 0),
                out,
            )
        else:
            values = (0, 0, -1000, *map(milli, rate), 0, 0, 0)
            if number == 27:
                self._send(encode(stamp, *values), out)
            elif self.key:
                self._send(encode(stamp // 1000, *values), out)
            else:
                frame = framed(self.mav, number, (stamp // 1000, *values))
                self._send_frame(frame, out)

    def take(self, data: bytes, now: int) -> list[bytes]:
        """Take what came; answers."""
        out: list[bytes] = []
        for message in self.inbound.parse_buffer(data) or []:
            name = message.get_type()
            if name == "COMMAND_LONG":
                self._command(message, now, out)
            elif name == "TIMESYNC" and message.tc1 == 0:
                self._send(
                    self.mav.timesync_encode(self.clock(now) * 1000, message.ts1), out
                )
            elif name in ("PARAM_SET", "PARAM_REQUEST_READ"):
                self._parameter(message, now, out)
            elif name == "STATUSTEXT":
                self.texts.append((message.severity, message.text))
            elif name == "NAMED_VALUE_FLOAT":
                self.values[message.name] = message.value
        return out

    def _parameter(self, message, now: int, out: list[bytes]) -> None:
        name = message.param_id
        if (
            message.target_system != self.system
            or name not in self.parameters
            or self.stack == "px4"
        ):
            return
        if message.get_type() == "PARAM_SET":
            if self.parameters[name] == message.param_value == 1.0:
                self.probes.append((now, name))
            else:
                self.sets.append((now, name, message.param_value))
            if not self.hears_sets:
                return
            if name in self.read_only:
                denial = f"Param write denied ({name})".encode()
                self._send(self.mav.statustext_encode(4, denial), out)
            else:
                self.parameters[name] = message.param_value
            self.say_parameter(name, out)
            return
        self._answers.append((now + self.late_reads, name, self.parameters[name]))

    def say_parameter(self, name: str, out: list[bytes]) -> None:
        self._send_value(name, self.parameters[name], out)

    def _send_value(self, name: str, value: float, out: list[bytes]) -> None:
        self._send(
            self.mav.param_value_encode(
                name.encode().ljust(16, b"\0"), value, 2, 1400, 65535
            ),
            out,
        )

    def _command(self, message, now: int, out: list[bytes]) -> None:
        self.commands.append(
            (message.command, int(message.param1), int(message.param2))
        )
        if message.target_system != self.system:
            return
        number, interval = int(message.param1), int(message.param2)
        if message.command == DO_AUX_FUNCTION and number == LANE_SWITCH:
            self._change_lane(now, out)
            accepted = mavlink.MAV_RESULT_ACCEPTED
            self._send(self.mav.command_ack_encode(message.command, accepted), out)
            return
        known = MESSAGES.keys() - ({27} if self.stack == "px4" else set())
        if message.command != 511 or number not in known or number in self.refuses:
            self._send(
                self.mav.command_ack_encode(message.command, mavlink.MAV_RESULT_FAILED),
                out,
            )
            return
        if interval <= 0:
            self.intervals.pop(number, None)
        else:
            self.intervals[number] = (
                interval if self.stack == "px4" else max(1, interval // 1000) * 1000
            )
        self._send(
            self.mav.command_ack_encode(message.command, mavlink.MAV_RESULT_ACCEPTED),
            out,
        )


class Driver:
    """Runs autopilots on a real link, in a thread of its own, from its time on; end: file descriptor of the link."""

    def __init__(self, end: int, *autopilots: Autopilot) -> None:
        self.ends, self.autopilots = [end], autopilots
        for autopilot in autopilots:
            # It may have been on another link before.
            if autopilot.boot < 0:
                autopilot.boot = autopilot.start = time.monotonic_ns() + autopilot.boot
        self.silent = False  # the link is cut
        os.set_blocking(end, False)
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_) -> None:
        self._done.set()
        self._thread.join()
        for end in self.ends:
            os.close(end)

    def _run(self) -> None:
        while not self._done.is_set():
            select.select(self.ends[:1], [], [], 0.002)
            now = time.monotonic_ns()
            while data := self.read():
                for autopilot in self.autopilots if not self.silent else ():
                    self.write(autopilot.take(data, time.monotonic_ns()))
            for autopilot in self.autopilots:
                self.write(autopilot.step(now))

    def read(self) -> bytes:
        with contextlib.suppress(OSError):
            return os.read(self.ends[0], 2048)
        return b""

    def write(self, messages: list[bytes]) -> None:
        for data in messages if not self.silent else ():
            with contextlib.suppress(OSError):
                os.write(self.ends[0], data)


class OverUdp(Driver):
    """Sends to a port of this machine, as an autopilot does to its companion."""

    def __init__(self, port: int, *autopilots: Autopilot) -> None:
        link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        link.connect(("127.0.0.1", port))
        super().__init__(link.detach(), *autopilots)


class OverPty(Driver):
    """At the other end of a serial line."""

    def __init__(self, *autopilots: Autopilot) -> None:
        end, line = pty.openpty()
        tty.setraw(line)
        super().__init__(end, *autopilots)
        self.device = os.ttyname(line)
        # The line stays open when the node closes it.
        self.ends.append(line)


def free_port() -> int:
    """A UDP port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


UTC = 1_790_000_000
"""Unix time at the start of the simulation, s."""
STEP = NS // 1000  #: Of simulated time, ns.
HARMLESS = {"HEARTBEAT", "TIMESYNC", "COMMAND_LONG", "STATUSTEXT", "NAMED_VALUE_FLOAT"}
"""All that may be sent; of commands only the one for intervals, and with failover the one for another EKF lane."""


class Conversation:
    """A vehicle of ours and simulated autopilots over a link with a latency, in steps of 1 ms of simulated time.

    Settings of the vehicle that are not given: 50 Hz of SCALED_IMU.

    Everything that our side sends is checked to be harmless.
    """

    def __init__(
        self,
        *autopilots: Autopilot,
        latency: Callable[[], int] = lambda: 3_000_000,
        peers: tuple[Any, ...] = (),
        may_set: bool = False,
        times: SigningTimes = NO_TIMES,
        **settings,
    ) -> None:
        self.now = 1000 * NS
        for autopilot in autopilots:
            autopilot.boot += self.now
            autopilot.start += self.now
        self.autopilots = autopilots
        self.peers = peers or (None,) * len(autopilots)
        self.latency, self.may_set = latency, may_set
        self.sent: Counter[str] = Counter()
        self.sent_to: Counter[Any] = Counter()
        settings = VehicleSettings(**{"rate": 50.0, "kind": "SCALED_IMU", **settings})
        self.vehicle = Vehicle(settings, self._send, self.unix, times)
        self.samples: list[tuple[int, ImuSample]] = []
        """With the time at which each came out, ns."""
        self.cut = False
        self._order = count()
        self._under_way: list[tuple[int, int, int, Any, bytes]] = []
        self._check = mavlink.MAVLink(None)

    def unix(self) -> float:
        """Unix time of the simulation, s."""
        return UTC + self.now / NS

    def _send(self, data: bytes, peer: Any) -> None:
        message = self._check.parse_char(data)
        assert message.get_type() in HARMLESS or (
            self.may_set
            and (
                message.param_id in PARAMETERS
                or (
                    message.get_type() == "PARAM_REQUEST_READ"
                    and message.param_id in (EKF_LANES, EKF_PRIMARY)
                )
            )
        )
        if message.get_type() == "COMMAND_LONG" and message.command != 511:
            function = (message.command, message.param1, message.param2)
            assert self.may_set
            assert function == (DO_AUX_FUNCTION, LANE_SWITCH, 2)
        assert message.get_type() != "TIMESYNC" or message.tc1 == 0
        assert message.get_type() != "HEARTBEAT" or message.autopilot == 8
        self.sent[message.get_type()] += 1
        self.sent_to[peer] += 1
        for number, autopilot in enumerate(self.autopilots):
            if self.peers[number] == peer or peer is None:
                self._travel(autopilot, data, None)

    def _travel(self, to: Autopilot | None, data: bytes, peer: Any) -> None:
        if not self.cut:
            number = -1 if to is None else self.autopilots.index(to)
            entry = (self.now + self.latency(), next(self._order), number, peer, data)
            heapq.heappush(self._under_way, entry)

    def inject(self, data: bytes, peer: Any = None) -> None:
        """Bytes from anybody reach us now."""
        self.samples += [
            (self.now, sample) for sample in self.vehicle.feed(peer, data, self.now)
        ]

    def run(self, seconds: float) -> "Conversation":
        end = self.now + round(seconds * NS)
        while self.now < end:
            due = min([end, *(autopilot.due_at() for autopilot in self.autopilots)])
            while not self._has_due(self.now + STEP) and self.now + STEP < due:
                # Nothing else happens.
                self.now += STEP
                self.vehicle.tick(self.now)
            self.now += STEP
            for peer, autopilot in zip(self.peers, self.autopilots, strict=True):
                if sent := autopilot.step(self.now):
                    # A router joins messages of one time as well.
                    self._travel(None, b"".join(sent), peer)
            while self._has_due(self.now):
                _, _, number, peer, data = heapq.heappop(self._under_way)
                if number < 0:
                    self.inject(data, peer)
                else:
                    for answer in self.autopilots[number].take(data, self.now):
                        self._travel(None, answer, self.peers[number])
            self.vehicle.tick(self.now)
        return self

    def _has_due(self, now: int) -> bool:
        """Return whether a message under way arrives until now."""
        return bool(self._under_way) and self._under_way[0][0] <= now

    def of_unit(self, unit: int, since: float = math.inf) -> list[ImuSample]:
        """Samples of a unit that came in the last seconds."""
        return [
            sample
            for at, sample in self.samples
            if sample.unit == unit and at > self.now - since * NS
        ]
