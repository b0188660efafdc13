# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What MAVLink says of IMUs: the messages that carry gyros, how they are asked for, by which clock they are stamped.

The messages are one description for live and logs, by the common dialect and by what the senders do (PX4
``src/modules/mavlink/streams``, ArduPilot ``GCS_Common.cpp``):

- SCALED_IMU, SCALED_IMU2, SCALED_IMU3: IMU 1, 2, 3 of either autopilot, each under its own name. Whole mrad/s and mG,
  cut off towards zero, with the autopilot's milliseconds. Beyond 32.767 rad/s the number runs over.
- RAW_IMU: "raw counts" by the standard; ArduPilot sends IMU 1 in mrad/s, with microseconds: its streams for ground
  stations have it in place of SCALED_IMU (RAW_SENS: RAW_IMU, SCALED_IMU2, SCALED_IMU3). PX4 does not send it.
- HIGHRES_IMU: floating point and microseconds, of the IMU that the autopilot has chosen for itself, which may change in
  flight; PX4 subtracts the bias that its estimator has found. So one of it beside SCALED_IMU is no further sensor.

A message that carries only a magnetometer has zeros for gyro and accelerometer: it is of no IMU.
"""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

NS, MS = 1_000_000_000, 1_000_000  # a second and a millisecond, ns

Vector = tuple[float, float, float]

STANDARD_GRAVITY = 9.80665  # m/s^2
GYRO_UPDATED = (
    0b111000  # bits of ``fields_updated`` of HIGHRES_IMU: x, y, z of the gyro are new
)
ARDUPILOT, PX4 = 3, 12  # MAV_AUTOPILOT of a HEARTBEAT
NO_AUTOPILOT = 8  # the same of a component that is none
MOST_UNITS = 4


class ImuMessage(NamedTuple):
    """One kind of message."""

    name: str
    number: int
    kind: str  # messages of one kind tell several units of one sort apart
    size: int  # bytes of the payload, extensions included; MAVLink 2 leaves zeros at its end away.
    head: struct.Struct  # time, acceleration and rate, three each, with which it begins
    microseconds: int  # in one unit of the time
    gyro: float  # rad/s in one unit of the rate
    acceleration: float  # m/s^2 in one unit of the acceleration
    unit: int = -1  # of which IMU, from 0; -1: it says itself
    unit_at: int = -1  # where it does, bytes
    updated_at: int = -1  # where it says which fields are new, bytes; -1: nowhere


_MILLI = (1e-3, 1e-3 * STANDARD_GRAVITY)
_SCALED = ("SCALED_IMU", 24, struct.Struct("<I6h"), 1000, *_MILLI)
MESSAGES: dict[int, ImuMessage] = {
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
}  # by message id
RESOLUTION = {
    "HIGHRES_IMU": "single precision, 1 us",
    "RAW_IMU": "1 mrad/s, 1 us",
    "SCALED_IMU": "1 mrad/s, 1 ms",
}
"""Kinds of messages, the finest first, with the resolution of rate and time."""
SCALED, RAW = (
    26,
    27,
)  # messages of IMU 1: SCALED_IMU, and RAW_IMU, which may stand in for it


def numbers(kind: str) -> tuple[int, ...]:
    """Return the ids of the messages of a kind, in the order of the units."""
    return tuple(
        message.number for message in MESSAGES.values() if message.kind == kind
    )


class ImuSample(NamedTuple):
    """One sample of one IMU, in the body frame of REP-103: x to the front, y to the left, z up."""

    unit: int  # from 0
    stamp: int  # ns, as read on the clock of the autopilot
    rate: Vector  # rad/s
    acceleration: Vector  # m/s^2


def read(number: int, payload: bytes) -> ImuSample | None:
    """Read the payload, as it came, of one of `MESSAGES`; None: it holds no new sample of a gyro."""
    message = MESSAGES[number]
    data = payload.ljust(message.size, b"\0")
    time, *values = message.head.unpack_from(data)
    if not any(values):
        return None
    if message.updated_at >= 0:
        updated = int.from_bytes(
            data[message.updated_at : message.updated_at + 2], "little"
        )
        if updated & GYRO_UPDATED != GYRO_UPDATED:
            return None
    ax, ay, az, gx, gy, gz = values
    a, g = message.acceleration, message.gyro
    unit = message.unit if message.unit_at < 0 else data[message.unit_at]
    stamp = 1000 * message.microseconds * time
    return ImuSample(
        unit, stamp, (g * gx, -g * gy, -g * gz), (a * ax, -a * ay, -a * az)
    )


def understood(kind: str, autopilot: int) -> bool:
    """Whether the messages of a kind are in known units, coming from such an autopilot (MAV_AUTOPILOT)."""
    return kind != "RAW_IMU" or autopilot == ARDUPILOT


# How they are asked for ----------------------------------------------------------------------------------------------


DEFAULT_INTERVAL = 0
PATIENCE = NS  # so long an acknowledgement is waited for, ns
TRIES = 3
AGAIN, AGAIN_REFUSED = (
    10 * NS,
    60 * NS,
)  # what comes too slowly, and what was refused, is asked for again after, ns
ENOUGH = 0.8  # of the rate asked for
RESULTS = (
    "accepted",
    "refused for now",
    "denied",
    "unsupported",
    "failed",
    "in progress",
    "cancelled",
)  # MAV_RESULT
_HOPEFUL = ("not asked yet", RESULTS[5])


@dataclass
class _Wanted:
    interval: int  # us; `DEFAULT_INTERVAL`: the autopilot's own
    answer: str = _HOPEFUL[0]  # what the autopilot says to it
    asked: int = 0  # when it was last asked for, ns
    tries: int = 0


class Streams:
    """What one autopilot is asked for: messages at an interval, one request at a time, repeated within bounds.

    The acknowledgement of MAV_CMD_SET_MESSAGE_INTERVAL does not say which message it is about, so the next request
    waits for it. Autopilots forget intervals when they start anew, and other programs on the link may set them: what
    comes too slowly is asked for again now and then.
    """

    def __init__(self) -> None:
        self._wanted: dict[int, _Wanted] = {}
        self._queue: list[
            int
        ] = []  # messages to be asked for, in this order; the first may be under way

    def want(self, messages: Iterable[int], interval: int) -> None:
        """Ask for messages, by id, at an interval in us, unless they are wanted so."""
        for number in messages:
            if number not in self._wanted or self._wanted[number].interval != interval:
                self._wanted[number] = _Wanted(interval)
                self._enqueue(number)

    def refused(self, number: int) -> bool:
        """Whether a message was asked for in vain."""
        return number in self._wanted and self._wanted[number].answer not in (
            *_HOPEFUL,
            RESULTS[0],
        )

    def ask_again(self) -> None:
        """Ask for all anew: the autopilot has."""
        for number, wanted in self._wanted.items():
            if wanted.interval != DEFAULT_INTERVAL:
                self._enqueue(number)

    def _enqueue(self, number: int) -> None:
        self._wanted[number].tries = 0
        if number not in self._queue:
            self._queue.append(number)

    def due(self, now: int) -> tuple[int, int] | None:
        """Return message id and interval, us, of a request to be sent now; None: there is none."""
        while self._queue:
            wanted = self._wanted[self._queue[0]]
            if wanted.tries and now < wanted.asked + PATIENCE:
                return None
            if wanted.tries < TRIES:
                wanted.asked, wanted.tries = now, wanted.tries + 1
                return self._queue[0], wanted.interval
            wanted.answer = "no answer"
            del self._queue[0]
        return None

    def acknowledged(self, result: int) -> None:
        """Take an acknowledgement (MAV_RESULT) of the request under way."""
        if self._queue and (wanted := self._wanted[self._queue[0]]).tries:
            wanted.answer = (
                RESULTS[result] if 0 <= result < len(RESULTS) else f"result {result}"
            )
            if wanted.answer not in _HOPEFUL:
                del self._queue[0]

    def check(self, number: int, rate: float, now: int) -> None:
        """Ask again for a message if it comes too slowly, so many a second."""
        wanted = self._wanted.get(number)
        if wanted is None or wanted.interval <= 0 or number in self._queue:
            return
        after = AGAIN_REFUSED if self.refused(number) else AGAIN
        if rate < ENOUGH * 1e6 / wanted.interval and now >= wanted.asked + after:
            self._enqueue(number)

    def answer_to(self, number: int | None) -> str:
        """Return what the autopilot says to the request of a message."""
        return (
            self._wanted[number].answer if number in self._wanted else "not asked for"
        )


# By which clock ------------------------------------------------------------------------------------------------------


DRIFT = 1e-4  # clocks drift from one another by less: 100 ppm
SLEW = (
    1e-3  # so fast the offset in use follows a better one, so that stamps do not step
)
STEP = 20 * MS  # a better offset further away than this is taken at once, ns
GRAIN = MS  # step of the times in answers, at most, ns
LONGEST = NS  # round trips that take longer say nothing, ns
SURE = 3  # times or answers in a row that contradict what was known before they are believed: a single one may be wrong
_KEPT = 64  # round trips, and requests under way, at most
FIRST_FOR, FIRST_EVERY, THEN_EVERY = (
    20,
    NS // 10,
    NS // 2,
)  # so many requests at an interval, then at another, ns


class TimeSync:
    """Finds the offset of a remote clock: its time less the time here, ns.

    A request carries the time here, the answer repeats it beside the time there (Time Synchronization Protocol v2 of
    the MAVLink guide). Nothing says how a round trip divides into its two ways, so half of it is a bound on the error:
    the offset is that of the shortest round trip of late, and its error half of that and what the clocks may drift
    meanwhile. Requests of the autopilot itself are not answered: it would take this computer's clock for the one to
    follow.
    """

    def __init__(self) -> None:
        self._sent: deque[int] = deque(maxlen=_KEPT)
        self._trips: deque[tuple[int, int, int]] = deque(
            maxlen=_KEPT
        )  # when it ended, offset, half the round trip; ns
        self._best: tuple[int, int, int] | None = None
        self._odd = 0  # answers in a row that contradict those before
        self._requests = self._next = 0
        self._used: float | None = None
        self._used_at = 0
        self._arrival: float | None = (
            None  # highest difference of a stamp from its arrival, ns: offset less latency
        )
        self._arrival_at = 0

    def request(self, now: int) -> int | None:
        """Return the time to be sent in a request, if one is due, ns."""
        if now < self._next:
            return None
        self._requests += 1
        self._next = now + (FIRST_EVERY if self._requests < FIRST_FOR else THEN_EVERY)
        self._sent.append(now)
        return now

    def answer(self, sent: int, remote: int, now: int) -> bool:
        """Take an answer: the time that it repeats, the time there, and now, ns; return whether it is believed."""
        if sent not in self._sent or not 0 < remote < 1 << 62:
            return False
        self._sent.remove(sent)
        trip = now - sent
        if not 0 <= trip <= LONGEST:
            return False
        offset, half = remote - (sent + trip // 2), trip // 2
        far = [
            abs(offset - other) > half + less + DRIFT * (now - at) + GRAIN
            for at, other, less in self._trips
        ]
        self._odd = self._odd + 1 if any(far) else 0
        if 0 < self._odd < SURE:
            return False
        # What so many in a row contradict is of before a step: of a simulation that stood still, or has another pace.
        self._trips = deque(
            (one for one, out in zip(self._trips, far, strict=True) if not out),
            maxlen=_KEPT,
        )
        self._trips.append((now, offset, half))
        # Which one has the least error does not depend on the time that passes for all of them.
        self._best = min(self._trips, key=lambda trip: trip[2] - DRIFT * trip[0])
        return True

    def arrived(self, remote: int, now: int) -> None:
        """Take the time of a message that has just arrived, ns: without answers it is all there is."""
        known = (
            -math.inf
            if self._arrival is None
            else self._arrival - DRIFT * (now - self._arrival_at)
        )
        self._arrival, self._arrival_at = max(float(remote - now), known), now

    @property
    def synchronised(self) -> bool:
        """Whether there was an answer."""
        return self._best is not None

    def error(self, now: int) -> float | None:
        """Bound on the error of the offset, ns; None: nothing is known."""
        return (
            None
            if self._best is None
            else self._best[2] + DRIFT * (now - self._best[0])
        )

    def offset(self, now: int) -> int | None:
        """Return the offset to be used, ns; None: nothing was heard yet."""
        wanted = self._arrival if self._best is None else float(self._best[1])
        if wanted is None:
            return None
        used = self._used
        if used is not None and abs(wanted - used) <= STEP:
            most = SLEW * max(0, now - self._used_at)
            wanted = used + min(max(wanted - used, -most), most)
        self._used, self._used_at = wanted, now
        return round(wanted)


def system_ahead(
    monotonic: Callable[[], int] = time.monotonic_ns,
    system: Callable[[], int] = time.time_ns,
) -> int:
    """Return what the time of the system is ahead of the monotonic clock, ns, measured between interruptions."""
    tries = [(monotonic(), system(), monotonic()) for _ in range(5)]
    # Of several readings the one during which the least time has passed.
    before, there, after = min(tries, key=lambda one: one[2] - one[0])
    return there - (before + after) // 2


class BootClock:
    """Times of an autopilot, made whole where 32 bits of milliseconds run over (49.7 days), and looked at for steps."""

    BACK, AHEAD = NS, 2 * NS
    """Going back further, or ahead further than time has passed here, is a step, ns: the autopilot has started anew, or
    its clock was set."""
    _OVER = (1 << 32) * MS

    def __init__(self) -> None:
        self.reset()
        self.restarts = 0  # steps found

    def reset(self) -> None:
        """Begin anew with the next time."""
        self._latest: int | None = None
        self._lead = 0  # by how much the times were ahead of those here at most, ns: with the least delay
        self._odd = 0

    def unwrap(
        self, time: int, now: int, milliseconds: bool, about: int | None = None
    ) -> int | None:
        """Return a time that came at the time now here, about so much there, made whole, ns; None: not to be used."""
        if not 0 <= time < 1 << 61:
            return None
        reference = self._latest if about is None else about
        if milliseconds and reference is not None:
            # As many whole runs as bring it nearest.
            time += (
                max(0, (reference - time + self._OVER // 2) // self._OVER) * self._OVER
            )
        latest, lead = (
            (time, time - now) if self._latest is None else (self._latest, self._lead)
        )
        if latest - self.BACK <= time <= now + lead + self.AHEAD:
            self._odd = 0
            self._latest, self._lead = max(latest, time), max(lead, time - now)
            return time
        self._odd += 1
        if self._odd >= SURE:
            self.restarts += 1
            self.reset()
        return None
