# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The clock of an autopilot against that of this computer: TIMESYNC, steps of time, times that run over.

A request carries the time here, the answer repeats it beside the time there (Time Synchronization Protocol v2 of the
MAVLink guide). Nothing says how a round trip divides into its two ways, so half of it is a bound on the error: the
offset is that of the shortest round trip of late, and its error half of that and what the clocks may drift meanwhile.
Requests of the autopilot itself are not answered: it would take this computer's clock for the one to follow.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable

NS, MS = 1_000_000_000, 1_000_000  # a second and a millisecond, ns
DRIFT = 1e-4  # clocks drift from one another by less: 100 ppm
SLEW = 1e-3  # so fast the offset in use follows a better one, so that stamps do not step
STEP = 20 * MS  # a better offset further away than this is taken at once, ns
GRAIN = MS  # step of the times in answers, at most, ns
LONGEST = NS  # round trips that take longer say nothing, ns
SURE = 3  # times or answers in a row that contradict what was known before they are believed: a single one may be wrong
_KEPT = 64  # round trips, and requests under way, at most
FIRST_FOR, FIRST_EVERY, THEN_EVERY = 20, NS // 10, NS // 2  # so many requests at an interval, then at another, ns


class TimeSync:
    """Finds the offset of a remote clock: its time less the time here, ns."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all: the remote clock has begun anew."""
        self._sent: deque[int] = deque(maxlen=_KEPT)
        self._trips: deque[tuple[int, int, int]] = deque(maxlen=_KEPT)  # when it ended, offset, half the round trip; ns
        self._best: tuple[int, int, int] | None = None
        self._odd = 0  # answers in a row that contradict those before
        self._requests = 0
        self._next = 0
        self._used: float | None = None
        self._used_at = 0
        self._arrival: float | None = None
        """Highest difference of a stamp from the time of its arrival, ns: its offset less the link's latency."""
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
        far = [abs(offset - other) > half + less + DRIFT * (now - at) + GRAIN for at, other, less in self._trips]
        self._odd = self._odd + 1 if any(far) else 0
        if 0 < self._odd < SURE:
            return False
        # What so many in a row contradict is of before a step: of a simulation that stood still, or has another pace.
        self._trips = deque((one for one, out in zip(self._trips, far, strict=True) if not out), maxlen=_KEPT)
        self._trips.append((now, offset, half))
        # Which one has the least error does not depend on the time that passes for all of them.
        self._best = min(self._trips, key=lambda trip: trip[2] - DRIFT * trip[0])
        return True

    def arrived(self, remote: int, now: int) -> None:
        """Take the time of a message that has just arrived, ns: without answers it is all there is."""
        known = -math.inf if self._arrival is None else self._arrival - DRIFT * (now - self._arrival_at)
        self._arrival, self._arrival_at = max(float(remote - now), known), now

    @property
    def synchronised(self) -> bool:
        """Whether there was an answer."""
        return self._best is not None

    def error(self, now: int) -> float | None:
        """Bound on the error of the offset, ns; None: nothing is known."""
        return None if self._best is None else self._best[2] + DRIFT * (now - self._best[0])

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


class SystemTime:
    """What the time of the system is ahead of the monotonic clock, ns: measured now and then, between interruptions."""

    EVERY = NS
    TRIES = 5

    def __init__(self, monotonic: Callable[[], int] = time.monotonic_ns, system: Callable[[], int] = time.time_ns):
        self._monotonic, self._system = monotonic, system
        self._ahead = self._next = 0

    def ahead(self, now: int) -> int:
        """Return by how much, at the monotonic time now, ns."""
        if now >= self._next:
            self._next = now + self.EVERY
            tries = [(self._monotonic(), self._system(), self._monotonic()) for _ in range(self.TRIES)]
            # Of several readings the one during which the least time has passed.
            before, there, after = min(tries, key=lambda one: one[2] - one[0])
            self._ahead = there - (before + after) // 2
        return self._ahead


class BootClock:
    """Times of an autopilot as they come: made whole where they run over, and looked at for steps.

    Milliseconds in 32 bits run over after 49.7 days.
    """

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
        self._lead = 0
        """By how much the times were ahead of those here at most, ns: those of messages with the least delay."""
        self._odd = 0

    def unwrap(self, time: int, now: int, milliseconds: bool, about: int | None = None) -> int | None:
        """Return a time that a message says, made whole, ns; None: it is not to be used.

        It is looked at at the time now here, runs over if it comes in milliseconds, and should be about so much there.
        """
        if not 0 <= time < 1 << 61:
            return None
        reference = self._latest if about is None else about
        if milliseconds and reference is not None:
            # As many whole runs as bring it nearest.
            time += max(0, (reference - time + self._OVER // 2) // self._OVER) * self._OVER
        latest, lead = (time, time - now) if self._latest is None else (self._latest, self._lead)
        if latest - self.BACK <= time <= now + lead + self.AHEAD:
            self._odd = 0
            self._latest, self._lead = max(latest, time), max(lead, time - now)
            return time
        self._odd += 1
        if self._odd >= SURE:
            self.restarts += 1
            self.reset()
        return None
