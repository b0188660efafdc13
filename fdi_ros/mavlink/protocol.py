# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""MAVLink messages with gyros: their layout, their requests, and the clock of their stamps.

Live links and logs share one description, from the common dialect and from the senders
(PX4 ``src/modules/mavlink/streams``, ArduPilot ``GCS_Common.cpp``):

- SCALED_IMU, SCALED_IMU2, SCALED_IMU3: IMU 1, 2, 3 of either autopilot. Whole mrad/s and
  mG, truncated towards zero, with the autopilot's milliseconds. Rates beyond 32.767 rad/s
  overflow.
- RAW_IMU: "raw counts" by the standard. ArduPilot sends IMU 1 in mrad/s with microseconds,
  by default in place of SCALED_IMU (stream RAW_SENS). PX4 does not send RAW_IMU.
- HIGHRES_IMU: floating point and microseconds, of the IMU that the autopilot has selected,
  which may change in flight. PX4 subtracts its estimated bias. Beside SCALED_IMU this
  message is no further sensor.

A message with a magnetometer alone has zeros for gyro and accelerometer, and no IMU.
"""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from fdi_ros.model.quantity import STANDARD_GRAVITY

NS, MS = 1_000_000_000, 1_000_000  #: A second and a millisecond, ns.

Vector = tuple[float, float, float]

GYRO_UPDATED = 0b111000  #: Bits of ``fields_updated`` of HIGHRES_IMU for a new gyro.
ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT of a HEARTBEAT
NO_AUTOPILOT = 8  #: MAV_AUTOPILOT of other components.
#: Largest number of IMUs that the messages of any stack number.
MOST_UNITS = 4


class ImuMessage(NamedTuple):
    """Layout of one message."""

    #: As in MAVLink, such as SCALED_IMU.
    name: str
    #: Number of the message in MAVLink.
    number: int
    kind: str  #: Messages of one kind bring several units of one sort.
    #: Bytes of the payload with extensions. MAVLink 2 drops zeros at the end.
    size: int
    head: struct.Struct  #: First fields: time, acceleration and rate, three each.
    microseconds: int  #: Microseconds in one unit of time.
    gyro: float  #: rad/s in one unit of rate.
    acceleration: float  #: m/s^2 in one unit of acceleration.
    unit: int = -1  #: IMU, from 0. -1: given in the message.
    unit_at: int = -1  #: Offset of the IMU in the payload, bytes.
    updated_at: int = -1  #: Offset of ``fields_updated``, bytes. -1: none.


_MILLI = (1e-3, 1e-3 * STANDARD_GRAVITY)
_SCALED = ("SCALED_IMU", 24, struct.Struct("<I6h"), 1000, *_MILLI)
IMU_MESSAGES: dict[int, ImuMessage] = {
    message.number: message
    for message in (
        ImuMessage("SCALED_IMU", 26, *_SCALED, unit=0),
        ImuMessage("SCALED_IMU2", 116, *_SCALED, unit=1),
        ImuMessage("SCALED_IMU3", 129, *_SCALED, unit=2),
        ImuMessage(
            "RAW_IMU", 27, "RAW_IMU", 29, struct.Struct("<Q6h"), 1, *_MILLI, unit_at=26
        ),
        ImuMessage(
            "HIGHRES_IMU",
            105,
            "HIGHRES_IMU",
            63,
            struct.Struct("<Q6f"),
            1,
            1.0,
            1.0,
            unit_at=62,
            updated_at=60,
        ),
    )
}  #: By message id.
RESOLUTION = {
    "HIGHRES_IMU": "single precision, 1 us",
    "RAW_IMU": "1 mrad/s, 1 us",
    "SCALED_IMU": "1 mrad/s, 1 ms",
}
"""Resolution of rate and time of each kind of messages, the finest first."""
SCALED, RAW = 26, 27  #: SCALED_IMU of IMU 1, and RAW_IMU, which may replace SCALED_IMU.


def numbers(kind: str) -> tuple[int, ...]:
    """Return the ids of the messages of a kind, in the order of the units."""
    return tuple(
        message.number for message in IMU_MESSAGES.values() if message.kind == kind
    )


class ImuSample(NamedTuple):
    """One sample of one IMU, in the body frame of REP-103: x to the front, y to the left, z up."""

    unit: int  #: From 0.
    stamp: int  #: Time on the autopilot's clock, ns.
    rate: Vector  #: rad/s
    acceleration: Vector  #: m/s^2


class Thinning:
    """Picks samples at an interval, ns, from faster ones, the same times for all units.

    Samples within a fifth of the interval of a picked one of another unit belong to
    this one. The next are picked three quarters of the interval later.
    """

    def __init__(self, interval: int) -> None:
        self._interval = interval
        self._begun = 0  # stamp of the first sample of the present row, ns
        self._units: set[int] = set()  # units in it

    def picks(self, sample: ImuSample) -> bool:
        """Return whether a sample is picked."""
        since = sample.stamp - self._begun
        if 4 * since >= 3 * self._interval:
            self._begun = sample.stamp
            self._units.clear()
        elif 5 * abs(since) >= self._interval or sample.unit in self._units:
            return False
        self._units.add(sample.unit)
        return True


def read(number: int, payload: bytes, zeros: bool = False) -> ImuSample | None:
    """Return the sample in a payload of one of `IMU_MESSAGES`, or None without a new gyro sample.

    zeros: a payload of zeros is a sample. Else it has no IMU, but a magnetometer.
    """
    message = IMU_MESSAGES[number]
    data = payload.ljust(message.size, b"\0")
    time, *values = message.head.unpack_from(data)
    if not any(values) and not zeros:
        return None
    if message.updated_at >= 0:
        updated = int.from_bytes(
            data[message.updated_at : message.updated_at + 2], "little"
        )
        if updated & GYRO_UPDATED != GYRO_UPDATED:
            return None
    ax, ay, az, gx, gy, gz = values
    a = message.acceleration
    g = message.gyro
    unit = message.unit if message.unit_at < 0 else data[message.unit_at]
    stamp = 1000 * message.microseconds * time
    # from FRD to FLU
    rate = (g * gx, -g * gy, -g * gz)
    force = (a * ax, -a * ay, -a * az)
    return ImuSample(unit, stamp, rate, force)


def understood(kind: str, autopilot: int) -> bool:
    """Return whether an autopilot (MAV_AUTOPILOT) sends a kind of messages in known units."""
    return kind != "RAW_IMU" or autopilot == ARDUPILOT


# Requests ----------------------------------------------------------------------------------------------


DEFAULT_INTERVAL = 0
ACKNOWLEDGED_WITHIN = NS  #: An acknowledgement may take this time, ns.
TRIES = 3  #: Requests of one message until it has no answer.
AGAIN = 10 * NS  #: Time after which a slow message is requested again, ns.
AGAIN_REFUSED = 60 * NS  #: Time after which a refused message is requested again, ns.
ENOUGH = 0.8  #: Share of the requested rate that is enough.
COMMAND_RESULTS = (
    "accepted",
    "refused for now",
    "denied",
    "unsupported",
    "failed",
    "in progress",
    "cancelled",
)  #: MAV_RESULT
_HOPEFUL = ("not asked yet", COMMAND_RESULTS[5])


@dataclass
class _Wanted:
    #: us, or `DEFAULT_INTERVAL`
    interval: int
    #: of the autopilot
    answer: str = _HOPEFUL[0]
    #: time of the last request, ns
    asked: int = 0
    #: number of requests without an answer
    tries: int = 0


class Streams:
    """Requests of messages at an interval: one at a time, repeated within bounds.

    The acknowledgement of MAV_CMD_SET_MESSAGE_INTERVAL does not name the message, so the
    next request waits for the answer. Autopilots forget intervals at a start, and other
    programs on the link may set them: slow messages are requested again.
    """

    def __init__(self) -> None:
        self._wanted: dict[int, _Wanted] = {}
        # Messages to be requested, in order. The first may be under way.
        self._queue: list[int] = []

    def want(self, messages: Iterable[int], interval: int) -> None:
        """Request messages, by id, at an interval, us. The same request again does nothing."""
        for number in messages:
            if number not in self._wanted or self._wanted[number].interval != interval:
                self._wanted[number] = _Wanted(interval)
                self._enqueue(number)

    def refused(self, number: int) -> bool:
        """Return whether the request of a message failed."""
        return number in self._wanted and self._wanted[number].answer not in (
            *_HOPEFUL,
            COMMAND_RESULTS[0],
        )

    def ask_again(self) -> None:
        """Request all again: the autopilot has started anew."""
        for number, wanted in self._wanted.items():
            if wanted.interval != DEFAULT_INTERVAL:
                self._enqueue(number)

    def _enqueue(self, number: int) -> None:
        self._wanted[number].tries = 0
        if number not in self._queue:
            self._queue.append(number)

    def due(self, now: int) -> tuple[int, int] | None:
        """Return message id and interval, us, of a request to be sent now, or None."""
        while self._queue:
            wanted = self._wanted[self._queue[0]]
            if wanted.tries and now < wanted.asked + ACKNOWLEDGED_WITHIN:
                return None
            if wanted.tries < TRIES:
                wanted.asked = now
                wanted.tries = wanted.tries + 1
                return self._queue[0], wanted.interval
            wanted.answer = "no answer"
            del self._queue[0]
        return None

    def acknowledged(self, result: int) -> None:
        """Take an acknowledgement (MAV_RESULT) of the request under way."""
        if self._queue and (wanted := self._wanted[self._queue[0]]).tries:
            wanted.answer = (
                COMMAND_RESULTS[result]
                if 0 <= result < len(COMMAND_RESULTS)
                else f"result {result}"
            )
            if wanted.answer not in _HOPEFUL:
                del self._queue[0]

    def check(self, number: int, rate: float, now: int) -> None:
        """Request a message again if its rate, Hz, is too low."""
        wanted = self._wanted.get(number)
        if wanted is None or wanted.interval <= 0 or number in self._queue:
            return
        after = AGAIN_REFUSED if self.refused(number) else AGAIN
        if rate < ENOUGH * 1e6 / wanted.interval and now >= wanted.asked + after:
            self._enqueue(number)

    def answer_to(self, number: int | None) -> str:
        """Return the answer to the request of a message."""
        return (
            self._wanted[number].answer if number in self._wanted else "not asked for"
        )


# Clocks ------------------------------------------------------------------------------------------------------


DRIFT = 1e-4  #: Largest drift between two clocks.
#: Rate at which the offset in use follows a better one. Stamps do not step.
SLEW = 1e-3
LARGEST_SLEW = 20 * MS  #: A better offset further away is taken at once, ns.
GRAIN = MS  #: Largest step of the times in answers, ns.
LONGEST_TRIP = NS  #: Longer round trips are ignored, ns.
LATELY = 5 * NS  #: A link is as slow as its round trips of this time, ns.
BELIEVED_AFTER = 3  #: Contradicting times or answers in a row that are believed.
_KEPT = 64  # largest number of round trips, and of requests under way
FIRST_FOR = 20  #: Number of requests at the short interval `FIRST_EVERY`.
FIRST_EVERY = NS // 10  #: Interval of the first requests, ns.
THEN_EVERY = NS // 2  #: Interval of later requests, ns.


class TimeSync:
    """Finds the offset of a remote clock: remote time less local time, ns.

    A request carries the local time. The answer repeats this time beside the remote time
    (Time Synchronization Protocol v2 of the MAVLink guide). The two ways of a round trip
    may differ, so half the trip bounds the error. The offset comes from the shortest
    recent trip, its error adds the drift since. The autopilot's own requests are not
    answered: the autopilot would follow this computer's clock.
    """

    def __init__(self) -> None:
        self._sent: deque[int] = deque(maxlen=_KEPT)
        # End, offset, and half the length of round trips, ns.
        self._trips: deque[tuple[int, int, int]] = deque(maxlen=_KEPT)
        self._best: tuple[int, int, int] | None = None
        self._odd = 0  # contradicting answers in a row
        self._requests = self._next = 0
        self._used: float | None = None
        self._used_at = 0
        # Largest stamp less arrival, ns: offset less latency.
        self._arrival: float | None = None
        self._arrival_at = 0

    def request(self, now: int) -> int | None:
        """Return the time for a request that is due now, ns, or None."""
        if now < self._next:
            return None
        self._requests += 1
        self._next = now + (FIRST_EVERY if self._requests < FIRST_FOR else THEN_EVERY)
        self._sent.append(now)
        return now

    def answer(self, sent: int, remote: int, now: int) -> bool:
        """Take an answer to a request sent at local time sent; return whether it is believed."""
        if sent not in self._sent or not 0 < remote < 1 << 62:
            return False
        self._sent.remove(sent)
        trip = now - sent
        if not 0 <= trip <= LONGEST_TRIP:
            return False
        offset = remote - (sent + trip // 2)
        half = trip // 2
        far = [
            abs(offset - other) > half + less + DRIFT * (now - at) + GRAIN
            for at, other, less in self._trips
        ]
        self._odd = self._odd + 1 if any(far) else 0
        if 0 < self._odd < BELIEVED_AFTER:
            return False
        # Trips that several answers contradict are older than a step of the clock.
        self._trips = deque(
            (one for one, out in zip(self._trips, far, strict=True) if not out),
            maxlen=_KEPT,
        )
        self._trips.append((now, offset, half))
        # The least error: all errors grow alike with time.
        self._best = min(self._trips, key=lambda trip: trip[2] - DRIFT * trip[0])
        return True

    def arrived(self, remote: int, now: int) -> None:
        """Take the time in a message that has just arrived, ns, for use without answers."""
        known = (
            -math.inf
            if self._arrival is None
            else self._arrival - DRIFT * (now - self._arrival_at)
        )
        self._arrival = max(float(remote - now), known)
        self._arrival_at = now

    @property
    def synchronised(self) -> bool:
        """Return whether an answer has come."""
        return self._best is not None

    def trip(self, now: int) -> int | None:
        """Return the shortest round trip of late, ns, or None if none has come."""
        halves = [half for at, _, half in self._trips if now - at < LATELY]
        return 2 * min(halves) if halves else None

    def error(self, now: int) -> float | None:
        """Return a bound on the error of the offset, ns, or None if unknown."""
        return (
            None
            if self._best is None
            else self._best[2] + DRIFT * (now - self._best[0])
        )

    def offset(self, now: int) -> int | None:
        """Return the offset to be used, ns, or None before the first message."""
        wanted = self._arrival if self._best is None else float(self._best[1])
        if wanted is None:
            return None
        used = self._used
        if used is not None and abs(wanted - used) <= LARGEST_SLEW:
            most = SLEW * max(0, now - self._used_at)
            wanted = used + min(max(wanted - used, -most), most)
        self._used = wanted
        self._used_at = now
        return round(wanted)


def system_ahead(
    monotonic: Callable[[], int] = time.monotonic_ns,
    system: Callable[[], int] = time.time_ns,
) -> int:
    """Return system time less monotonic time, ns."""
    tries = [(monotonic(), system(), monotonic()) for _ in range(5)]
    # An interruption lengthens a reading: use the shortest.
    before, there, after = min(tries, key=lambda one: one[2] - one[0])
    return there - (before + after) // 2


class BootClock:
    """Unwraps an autopilot's times, 32 bits of milliseconds (49.7 days), and finds steps."""

    #: Times further back, or further ahead than the time that has passed here, are a step,
    #: ns: a start of the autopilot, or of its clock.
    BACK, AHEAD = NS, 2 * NS
    #: For this time, ns, all times must be a step: over a second path, copies of messages
    #: may come seconds late, those of all units together, between the present ones.
    STEP_STANDS_NS = 200 * MS
    _OVER = (1 << 32) * MS

    def __init__(self) -> None:
        self.reset()
        self.restarts = 0  #: Steps found.

    def reset(self) -> None:
        """Begin anew with the next time."""
        self._latest: int | None = None
        self._lead = 0  # largest time less time here, ns: with the least delay
        self._odd = 0  # steps in a row
        self._odd_since = 0

    def unwrap(
        self, time: int, now: int, milliseconds: bool, about: int | None = None
    ) -> int | None:
        """Return a time that arrived now, unwrapped to be near about, ns. None: impossible."""
        if not 0 <= time < 1 << 61:
            return None
        reference = self._latest if about is None else about
        if milliseconds and reference is not None:
            # The number of overflows that brings the time nearest.
            time += (
                max(0, (reference - time + self._OVER // 2) // self._OVER) * self._OVER
            )
        latest, lead = (
            (time, time - now) if self._latest is None else (self._latest, self._lead)
        )
        if latest - self.BACK <= time <= now + lead + self.AHEAD:
            self._odd = 0
            self._latest = max(latest, time)
            self._lead = max(lead, time - now)
            return time
        self._odd += 1
        if self._odd == 1:
            self._odd_since = now
        if self._odd >= BELIEVED_AFTER and now - self._odd_since >= self.STEP_STANDS_NS:
            self.restarts += 1
            self.reset()
        return None
