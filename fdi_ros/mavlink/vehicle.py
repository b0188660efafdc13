# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Conversation with one autopilot: takes bytes, returns gyro samples, sends requests and reports.

The module has no input, clock or ROS of its own. The caller gives bytes and time, so a
test can be any autopilot. Data from elsewhere are bounded and checked: other systems,
other addresses than the one in use, wrong signatures, impossible times.

Nothing that is sent commands the vehicle: HEARTBEAT, TIMESYNC,
MAV_CMD_SET_MESSAGE_INTERVAL, STATUSTEXT, NAMED_VALUE_FLOAT. `fdi_ros.mavlink.failover`
adds PARAM_REQUEST_READ, PARAM_SET and MAV_CMD_DO_AUX_FUNCTION.
"""

from __future__ import annotations

import functools
import re
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fdi_ros.mavlink.protocol import (
    ARDUPILOT,
    DEFAULT_INTERVAL,
    IMU_MESSAGES,
    MOST_UNITS,
    MS,
    NO_AUTOPILOT,
    NS,
    PX4,
    RAW,
    RESOLUTION,
    SCALED,
    BootClock,
    ImuSample,
    Streams,
    TimeSync,
    numbers,
    read,
    understood,
)
from fdi_ros.mavlink.senders import Senders
from fdi_ros.mavlink.signing import NO_TIMES, SigningTimes, Verifier, now_in_steps
from fdi_ros.system import require

LOST_AFTER = 3 * NS  #: An autopilot is lost after this time without a message, ns.
UNSYNCHRONISED = 2 * NS  #: Without TIMESYNC for this time, arrival stamps samples, ns.
CHOICE = 3 * NS  #: Kinds of messages are compared for this time before the choice, ns.
OLDEST = 10 * NS  #: Older samples are refused, ns.
NEWEST = NS  #: Samples further in the future are refused, ns.
STAND_IN = 2 * NS  #: After this time without SCALED_IMU, RAW_IMU replaces it, ns.
RATE_WINDOW = 2 * NS  #: Rates are measured over this time, ns.
MOST_LATE = 8  #: After this number of late messages in a row the count begins anew.
_PEERS = 8  # largest number of addresses with a parser
# bytes after which a parser's buffer is cut: pymavlink cuts an empty one only
_LEFT = 1 << 12
#: ArduPilot's text where it refuses to set a parameter.
DENIED = re.compile(r"Param write denied \((\w+)\)")
#: ArduPilot's texts where its primary EKF lane has changed, of the EKF and of the vehicle.
LANE_CHANGED = re.compile(r"EKF3 lane switch (\d+)|EKF primary changed:(\d+)")
#: Texts of each change of the lane: one is lost without notice only with the other.
LANE_TEXTS = 2
LANE_SWITCH = 103  #: RC option and auxiliary function "EKF lane switch" of ArduPilot.
SWITCH_HIGH = 2  #: Position of the switch of an auxiliary function.
#: Vehicles that fly ArduCopter, by their MAV_TYPE. Others send one text of a change only.
COPTERS = (
    "COAXIAL",
    "DECAROTOR",
    "DODECAROTOR",
    "HELICOPTER",
    "HEXAROTOR",
    "OCTOROTOR",
    "QUADROTOR",
    "TRICOPTER",
)
TWO_SENDERS = (
    "two senders as system {} behind one address: two autopilots with one id, or two"
    " links of one"
)
V2 = 0xFD  #: First byte of a message of MAVLink 2.
LARGEST_FLOAT = 3.4e38  #: Largest float in a message.


@dataclass(frozen=True)
class VehicleSettings:
    """Requests to an autopilot."""

    system: int = 0  #: System id. 0: of the first autopilot that sends gyros.
    component: int = 191  #: Own component id. 191: MAV_COMP_ID_ONBOARD_COMPUTER.
    kind: str = ""  #: Kind of messages. Empty: the one with the most units.
    rate: float = 50.0  #: Hz
    key: bytes = b""  #: Signing key. Empty: signatures are neither made nor checked.


@dataclass
class UnitTrack:
    """State of one IMU."""

    #: Number of samples that arrived.
    received: int = 0
    repeated: int = 0  #: Samples at or before the time of the last one.
    impossible: int = 0  #: Samples at impossible times.
    last: int = 0  #: Arrival of the last sample, ns.
    time: int = -1  #: Time of the last sample on the autopilot's clock, ns.
    stamp: int = -1  #: Stamp of the last sample that was returned, ns.
    #: Arrivals of samples, ns.
    arrivals: deque[int] = field(default_factory=lambda: deque(maxlen=1024))

    def rate(self, now: int) -> float:
        """Return the present rate, Hz."""
        while self.arrivals and self.arrivals[0] < now - RATE_WINDOW:
            self.arrivals.popleft()
        count = len(self.arrivals)
        if count < 2 or now - self.last > RATE_WINDOW // 2:
            return 0.0
        return (count - 1) * NS / max(1, self.arrivals[-1] - self.arrivals[0])


def dialect() -> Any:
    """Return pymavlink's ArduPilot dialect of MAVLink 2. Raises `FdiError` without pymavlink."""
    require("MAVLink", ("pymavlink",))
    from pymavlink.dialects.v20 import ardupilotmega

    return ardupilotmega


class ImuFrame:
    """A sound message of an IMU, with the methods of pymavlink's messages that are used."""

    def __init__(self, number: int, data: bytearray) -> None:
        self._number = number
        self._data = data

    def get_msgId(self) -> int:  # noqa: N802
        """Return the number of the message."""
        return self._number

    def get_msgbuf(self) -> bytearray:
        """Return all bytes of the message."""
        return self._data


@functools.cache
def parser_of(mavlink: Any) -> Any:
    """Return the class of parsers of a dialect that leave the fields of `IMU_MESSAGES` to `read`.

    For pymavlink, the fields are half of the cost of a message, and most messages are of IMUs.
    """

    class Parser(mavlink.MAVLink):  # type: ignore[misc]
        def decode(self, msgbuf: bytearray) -> Any:
            number = int.from_bytes(msgbuf[7:10], "little")
            # What is signed, of version 1 or damaged is left to pymavlink.
            is_plain = (
                msgbuf[0] == V2 and not msgbuf[2] and msgbuf[1] == len(msgbuf) - 12
            )
            if not is_plain or number not in IMU_MESSAGES:
                return super().decode(msgbuf)
            extra = mavlink.mavlink_map[number].crc_extra
            checksum = mavlink.x25crc(msgbuf[1:-2] + bytes((extra,))).crc
            if checksum != int.from_bytes(msgbuf[-2:], "little"):
                return super().decode(msgbuf)
            return ImuFrame(number, msgbuf)

    return Parser


class Vehicle:
    """One autopilot. Raises `FdiError` if pymavlink is not installed.

    Parameters
    ----------
    settings
        Requests.
    send
        Takes the bytes of a message and their destination.
    seconds
        Unix time, s, for signatures.
    times
        Times of signed messages before this start.
    """

    def __init__(
        self,
        settings: VehicleSettings,
        send: Callable[[bytes, Any], None],
        seconds: Callable[[], float],
        times: SigningTimes = NO_TIMES,
    ) -> None:
        self.settings = settings
        self.system = settings.system or None  #: System id in use. None: none yet.
        self.autopilot = NO_AUTOPILOT  #: MAV_AUTOPILOT
        #: Last message of each other autopilot on the link, ns, by system id.
        self.others: dict[int, int] = {}
        self.counts: Counter[str] = Counter()
        self.events: deque[str] = deque(maxlen=32)  #: Sentences for the log.
        self.armed = False  #: By the last heartbeat.
        self.disarmed = 0  #: For how long all heartbeats have reported "disarmed", ns.
        #: Number of conversations begun. Parameters reported before may have changed.
        self.begun = 0
        #: Stay with an autopilot that has sent gyros, also while it is silent.
        self.keeps_system = False
        self.peer: Any = None
        self.behind = 0.0  #: Age of the last signature that was too old, s.
        self._behind_from: Any = None
        self._mavlink = dialect()
        self._component = self._mavlink.MAV_COMP_ID_AUTOPILOT1
        self._copters = {getattr(self._mavlink, f"MAV_TYPE_{name}") for name in COPTERS}
        self._send = send
        self._seconds = seconds
        self._verifier = Verifier(settings.key, times) if settings.key else None
        self._parsers: dict[Any, Any] = {}
        # Before an autopilot is known, messages are sent as system 1.
        self._out = self._mavlink.MAVLink(
            None, settings.system or 1, settings.component
        )
        if settings.key:
            self._out.signing.secret_key = settings.key
            self._out.signing.sign_outgoing = True
        self._beat = 0  # time of the last heartbeat sent, ns
        self._scaled_at = 0  # last arrival or request of SCALED_IMU of IMU 1, ns
        self._sequence: int | None = None
        self._late = 0  # late messages in a row
        self._lost = False
        self._disarmed_at: int | None = None
        self._interval = round(1e6 / settings.rate)
        self._know_nothing()

    def _know_nothing(self) -> None:
        """Begin with an autopilot of which nothing is known."""
        self.kind = self.settings.kind  #: Kind of messages in use. Empty: not chosen.
        self.sync = TimeSync()
        self.clock = BootClock()
        self.streams = Streams()
        self.senders = Senders()
        self.units: dict[int, UnitTrack] = {}
        self.magnetometers: set[int] = set()  #: Units that sent only a magnetometer.
        self.heard = 0  #: Time of the last message, ns. 0: none.
        self.gives_gyros = False
        #: Parameters reported: names and values. The reader takes them out.
        self.parameters: deque[tuple[str, float]] = deque(maxlen=64)
        #: Parameters that the autopilot has refused to set.
        self.denied: deque[str] = deque(maxlen=64)
        self.texts = 0  #: Number of texts received.
        #: How often `LANE_TEXTS` messages or more in a row were lost, or came late.
        self.breaks = 0
        self.is_copter = False  #: Flies ArduCopter, by its last heartbeat.
        #: EKF lanes that became primary, from texts. The reader takes them out.
        self.lanes: deque[int] = deque(maxlen=64)
        self._found = self._first_imu = 0
        # Kinds and units that sent samples, until a kind is chosen.
        self._seen: set[tuple[str, int]] = set()

    # What comes in ------------------------------------------------------------------------------------------------

    def reopened(self) -> None:
        """Clear the parsers: the link was opened anew."""
        self._parsers.clear()
        self.peer = self._behind_from = None

    def feed(self, peer: Any, data: bytes, now: int) -> list[ImuSample]:
        """Return the samples in bytes from an address at monotonic time now, ns, by that clock."""
        samples = []
        for message in self._parsed(peer, data):
            if message.get_msgId() == self._mavlink.MAVLINK_MSG_ID_BAD_DATA:
                self.counts["bad"] += 1
            elif (sample := self._process(message, peer, now)) is not None:
                samples.append(sample)
        return samples

    def _process(self, message: Any, peer: Any, now: int) -> ImuSample | None:
        """Take one message and return its sample, if the autopilot in use sent one."""
        number = message.get_msgId()
        data = bytes(message.get_msgbuf())
        header = 10 if data[0] == V2 else 6
        sequence, system, component = data[4:7] if header == 10 else data[2:5]
        self.counts["messages"] += 1
        if self._is_forged(data, system, component, peer):
            self.counts["unsigned"] += 1
        elif number == self._mavlink.MAVLINK_MSG_ID_UNKNOWN:
            # Of another dialect: the checksum depends on the unknown layout.
            self.counts["unknown"] += 1
            sender = (system, component, peer)
            is_ours = sender == (self.system, self._component, self.peer)
            if is_ours:
                self._look_for_another(sequence, data, now)
            if is_ours and self._sequence == (sequence - 1) & 255:
                self._sequence = sequence
        elif self._is_from_autopilot(message, number, system, component, peer, now):
            is_new = self._count_lost(sequence)
            self._look_for_another(sequence, data, now)
            if number in IMU_MESSAGES:
                return self._sample(number, data[header : header + data[1]], now)
            self._hear(message, number, is_new, now)
        return None

    def _is_forged(self, data: bytes, system: int, component: int, peer: Any) -> bool:
        """Return whether a message is in the autopilot's name and is not rightly signed.

        Others are not heard. They may have the key too, and would take up the room for the
        links of the autopilot.
        """
        verifier = self._verifier
        may_be_heard = component == self._component and self.settings.system in (
            0,
            system,
        )
        if verifier is None or not may_be_heard:
            return False
        now = now_in_steps(self._seconds())
        if verifier.accepts(data, system, component, now):
            return False
        if verifier.behind:
            self.counts["signed late"] += 1
            self.behind = verifier.behind
            self._behind_from = peer
        return True

    def _hear(self, message: Any, number: int, is_new: bool, now: int) -> None:
        """Take an answer. is_new: it has overtaken no other message."""
        mavlink = self._mavlink
        if number == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            self.sync.answer(message.ts1, message.tc1, now)
        elif number == mavlink.MAVLINK_MSG_ID_PARAM_VALUE and is_new:
            name = message.param_id.partition("\0")[0]
            self.parameters.append((name, message.param_value))
        elif number == mavlink.MAVLINK_MSG_ID_STATUSTEXT:
            self._hear_text(message.text, is_new)
        elif (
            number == mavlink.MAVLINK_MSG_ID_COMMAND_ACK
            and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        ):
            self.streams.acknowledged(message.result)

    def _hear_text(self, text: str, is_new: bool) -> None:
        """Take a text of the autopilot."""
        self.texts += 1
        if found := DENIED.match(text):
            self.denied.append(found[1])
        elif is_new and (found := LANE_CHANGED.match(text)):
            self.lanes.append(int(found[1] or found[2]))

    def _parsed(self, peer: Any, data: bytes) -> list[Any]:
        """Return the messages in bytes; each address has a parser of its own."""
        parser = self._parsers.pop(peer, None)
        if parser is None:
            parser = parser_of(self._mavlink)(None)
            parser.robust_parsing = True
        self._parsers[peer] = parser
        if len(self._parsers) > _PEERS:
            # Drop the parser of the address that is silent the longest, never of the one in use.
            del self._parsers[next(one for one in self._parsers if one != self.peer)]
        try:
            messages = parser.parse_buffer(data) or []
        except Exception:  # pymavlink raises anything on bad bytes
            self.counts["bad"] += 1
            del self._parsers[peer]
            return []
        if parser.buf_index > _LEFT:
            parser.buf = parser.buf[parser.buf_index :]
            parser.buf_index = 0
        return list(messages)

    def _is_from_autopilot(
        self,
        message: Any,
        number: int,
        system: int,
        component: int,
        peer: Any,
        now: int,
    ) -> bool:
        """Return whether the autopilot in use sent a message; a new one may come into use."""
        mavlink = self._mavlink
        is_autopilot = component == self._component
        beats = is_autopilot and number == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        beats = (
            beats
            and message.autopilot != NO_AUTOPILOT
            and message.type != mavlink.MAV_TYPE_GCS
        )
        if (
            is_autopilot
            and system != self.system
            and self._may_change_to(system, beats, number, now)
        ):
            # It comes into use with its next heartbeat.
            self.system = system
            self.begun = self.begun + 1
            self._know_nothing()
        if system != self.system or not is_autopilot:
            self.counts["of others"] += 1
            if beats:
                if system not in self.others:
                    self.events.append(
                        f"another autopilot on the link, system {system}: left aside"
                    )
                self.others[system] = now
            return False
        if (
            peer != self.peer
            and self.heard
            and now - self.heard <= LOST_AFTER
            and self.peer is not None
        ):
            self.counts["from elsewhere"] += 1
            return False
        if not self.heard or self._lost or peer != self.peer:
            if not beats:
                # Only a heartbeat begins a conversation, the first and each after silence.
                self.counts["before a heartbeat"] += 1
                return False
            self._begin_with(message, peer, now)
        self.heard = now
        if beats:
            self.autopilot = message.autopilot
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self.is_copter = message.type in self._copters
            self._disarmed_at = None if self.armed else self._disarmed_at or now
            self.disarmed = now - (self._disarmed_at or now)
        return True

    def _may_change_to(self, system: int, beats: bool, number: int, now: int) -> bool:
        """Return whether another autopilot may come into use: the present one is lost or silent."""
        is_gone = self.system is None or self._lost
        if self.settings.system or not system:
            return False
        if self.gives_gyros and (self.keeps_system or not is_gone):
            return False
        if number in IMU_MESSAGES:
            return now - self.others.get(system, -LOST_AFTER) < LOST_AFTER
        return beats and (is_gone or now - self._found > LOST_AFTER)

    def _begin_with(self, message: Any, peer: Any, now: int) -> None:
        """Begin or resume a conversation with an autopilot."""
        again = "again, " if self._found else ""
        self.peer = peer
        self.autopilot = message.autopilot
        self._found = now
        self._lost = False
        self.begun += 1
        self._disarmed_at = self._behind_from = None
        self._out.srcSystem = self.system
        self._sequence = None
        self._scaled_at = now
        self.events.append(f"{again}autopilot: {self.name}, system {self.system}")
        if again:
            self.streams.ask_again()
        else:
            kinds = [self.kind] if self.kind else list(RESOLUTION)
            wanted = [
                number
                for kind in kinds
                if understood(kind, self.autopilot)
                for number in numbers(kind)
            ]
            self.streams.want(wanted, self._interval)

    def _count_lost(self, sequence: int) -> bool:
        """Count the messages lost before this one; return whether it is newer than the last."""
        self.counts["in use"] += 1
        gap = 0 if self._sequence is None else (sequence - self._sequence - 1) & 255
        is_new = gap < 128
        self.breaks += gap >= LANE_TEXTS
        self.counts["lost"] += gap if is_new else 0
        self._late = 0 if is_new else self._late + 1
        if is_new or self._late > MOST_LATE:
            self._sequence = sequence
        return is_new

    def _look_for_another(self, sequence: int, data: bytes, now: int) -> None:
        """Report a second sender with the system id in use."""
        if self.senders.take(sequence, data, now):
            self.events.append(f"{TWO_SENDERS.format(self.system)}: samples are mixed")

    def _sample(self, number: int, payload: bytes, now: int) -> ImuSample | None:
        message = IMU_MESSAGES[number]
        # A unit that has delivered may die: its zeros are values.
        sample = read(number, payload, zeros=message.unit in self.units)
        if sample is None:
            if message.unit >= 0 and message.unit not in self.units:
                self.magnetometers.add(message.unit)
            self.counts["without a gyro"] += 1
            return None
        if sample.unit >= MOST_UNITS or not understood(message.kind, self.autopilot):
            self.counts["of no known unit"] += 1
            return None
        kind = message.kind
        self.gives_gyros = True
        if number == SCALED:
            self._scaled_at = now
        elif number == RAW and sample.unit == 0 and now - self._scaled_at > STAND_IN:
            # Unless RAW_IMU itself was chosen.
            kind = kind if self.kind == kind else IMU_MESSAGES[SCALED].kind
        if not self.kind and not self._choose(kind, sample.unit, now):
            return None
        return (
            self._timed(sample, message.microseconds > 1, now)
            if kind == self.kind
            else None
        )

    def _timed(
        self, sample: ImuSample, milliseconds: bool, now: int
    ) -> ImuSample | None:
        """Return a sample stamped by the monotonic clock here; None: repeated or impossible."""
        track = self.units.setdefault(sample.unit, UnitTrack())
        self.magnetometers.discard(sample.unit)
        restarts = self.clock.restarts
        offset = self.sync.offset(now)
        time = self.clock.unwrap(
            sample.stamp, now, milliseconds, None if offset is None else now + offset
        )
        if self.clock.restarts != restarts:
            self.sync = TimeSync()
            self._found = now
            self.begun = self.begun + 1
            for other in self.units.values():
                other.time = -1
            self.streams.ask_again()
            self.events.append(
                "the time of the autopilot has stepped: it has started anew, or its clock was set"
            )
        if time is None:
            track.impossible += 1
            return None
        self.sync.arrived(time, now)
        track.last = now
        if time <= track.time:
            track.repeated += 1
            return None
        track.time = time
        track.received = track.received + 1
        track.arrivals.append(now)
        if not self.sync.synchronised and now - self._found < UNSYNCHRONISED:
            return None
        stamp = time - (self.sync.offset(now) or 0)
        if not max(now - OLDEST, track.stamp + 1) <= stamp <= now + NEWEST:
            track.impossible += 1
            return None
        track.stamp = stamp
        return sample._replace(stamp=stamp)

    def _choose(self, kind: str, unit: int, now: int) -> bool:
        """Choose the kind of messages with the most units, the finest of several; return success."""
        self._first_imu = self._first_imu or now
        self._seen.add((kind, unit))
        if now - self._first_imu < CHOICE:
            return False
        self.kind = max(
            RESOLUTION, key=lambda kind: sum(seen == kind for seen, _ in self._seen)
        )
        for other in RESOLUTION:
            if other != self.kind and understood(other, self.autopilot):
                self.streams.want(numbers(other), DEFAULT_INTERVAL)
        self.events.append(f"{self.kind} is in use")
        return True

    # What goes out ------------------------------------------------------------------------------------------------

    def tick(self, now: int) -> None:
        """Send due messages; called often."""
        mavlink = self._mavlink
        if is_second := now - self._beat >= NS:
            self._beat = now
            self._say(
                "heartbeat",
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                NO_AUTOPILOT,
                0,
                0,
                mavlink.MAV_STATE_ACTIVE,
            )
        if self._found and not self._lost and now - self.heard > LOST_AFTER:
            self._lost = True
            self.events.append(
                f"nothing of {self.name}, system {self.system}, for {LOST_AFTER // NS} s"
            )
        if not self.in_reach:
            return
        if (sent := self.sync.request(now)) is not None:
            self._say("timesync", 0, sent)
        if (request := self.streams.due(now)) is not None:
            fields = (mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, *request, 0, 0, 0, 0, 0)
            self._say("command_long", self.system, self._component, *fields)
        if is_second:
            self._check_rates(now)
            if self.streams.refused(SCALED) and understood("RAW_IMU", self.autopilot):
                self.streams.want((RAW,), self._interval)

    def _check_rates(self, now: int) -> None:
        """Request messages again that come too slowly; the slowest unit of a message counts."""
        for number in numbers(self.kind):
            unit = IMU_MESSAGES[number].unit
            if unit not in self.magnetometers:
                brought = [unit] if unit >= 0 else list(self.units) or [0]
                self.streams.check(
                    number,
                    min(self.units.get(k, UnitTrack()).rate(now) for k in brought),
                    now,
                )

    def send_text(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT, with a MAV_SEVERITY and up to 50 characters."""
        self._say("statustext", severity, text.encode("ascii", "replace")[:50])

    def read_parameter(self, name: str) -> None:
        """Request a parameter; its value arrives in `parameters`."""
        self._say("param_request_read", self.system, self._component, name.encode(), -1)

    def set_parameter(self, name: str, value: float) -> None:
        """Set a parameter; the autopilot reports the new value."""
        self._say(
            "param_set",
            self.system,
            self._component,
            name.encode(),
            value,
            self._mavlink.MAV_PARAM_TYPE_REAL32,  # ArduPilot accepts any type.
        )

    def ask_for_lane(self) -> None:
        """Ask ArduPilot to change to the EKF lane with the best score."""
        command = self._mavlink.MAV_CMD_DO_AUX_FUNCTION
        fields = (command, 0, LANE_SWITCH, SWITCH_HIGH, 0, 0, 0, 0, 0)
        self._say("command_long", self.system, self._component, *fields)

    def send_value(self, name: str, value: float, now: int) -> None:
        """Send a NAMED_VALUE_FLOAT, its name up to 10 characters, at the monotonic time now, ns."""
        time = (now + (self.sync.offset(now) or 0)) // MS & 0xFFFFFFFF
        self._say(
            "named_value_float",
            time,
            name.encode("ascii")[:10],
            min(max(value, -LARGEST_FLOAT), LARGEST_FLOAT),
        )

    def _say(self, name: str, *fields: Any) -> None:
        """Send a message of the dialect."""
        out = self._out
        if self._verifier is not None:
            # An autopilot whose clock is ahead of this one refuses older messages.
            out.signing.timestamp = max(
                out.signing.timestamp,
                self._verifier.newest,
                now_in_steps(self._seconds()),
            )
        data = getattr(out, f"{name}_encode")(*fields).pack(out)
        out.seq = (out.seq + 1) % 256
        # Our signed messages set an autopilot whose signing clock is behind.
        self._send(bytes(data), self._behind_from if self.peer is None else self.peer)

    @property
    def signing_times(self) -> SigningTimes:
        """Times of signed messages until now."""
        if self._verifier is None:
            return NO_TIMES
        newest = max(self._out.signing.timestamp, self._verifier.newest)
        return SigningTimes(newest, self._verifier.latest)

    @property
    def in_reach(self) -> bool:
        """Whether messages of the autopilot arrive."""
        return bool(self._found) and not self._lost

    @property
    def name(self) -> str:
        """Name of the flight stack."""
        return {ARDUPILOT: "ArduPilot", PX4: "PX4"}.get(
            self.autopilot, f"autopilot {self.autopilot}"
        )
