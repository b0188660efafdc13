# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Random flights of the failover policy: `cd test && python -m mavlink.flights 20000`,
or some of them: `python -m mavlink.flights 4000 6000`.

A `Flight` holds the truth: which IMUs the vehicle uses, and how wrong each gyro is. The
policy sees it over a link that loses, delays and reorders messages, and through an
autopilot that answers a read up to 100 ms late with the value of when it read it. Other
stations set the same parameters. Link, monitor, autopilot and companion fail and start
anew. After every step the truth is checked, not the policy's view of it.
"""

import math
import sys
from collections import Counter
from collections.abc import Callable
from typing import NoReturn, Protocol

import numpy as np

from fdi_ros.mavlink.failover.controller import READ_EVERY, READ_HURRIED
from fdi_ros.mavlink.failover.lane import (
    ASK_AFTER,
    HEARTBEAT_AGE,
    LaneReport,
    LaneState,
    follow,
)
from fdi_ros.mavlink.failover.policy import (
    FRESH,
    GROUNDED,
    Imu,
    Order,
    PolicySettings,
    PolicyState,
    View,
    decide,
)
from fdi_ros.mavlink.failover.words import Note, WordsState, announce

MS = 1_000_000
NS = 1000 * MS
STEP = 25 * MS
LATE_ANSWER = 100 * MS  #: By so much an answer to a read is late at most, ns.
OURS, OTHERS = "ours", "a station"


class Flight:
    """One flight: the truth, what the policy sees, and the checks."""

    def __init__(self, seed: int) -> None:
        self.random = random = np.random.default_rng(seed)
        self.count = int(random.integers(2, 4))
        self.settings = PolicySettings(limit=int(random.integers(0, self.count)))
        self.loss = float(random.choice([0.0, 0.2, 0.4]))
        self.slow = int(random.choice([10, 100, 400])) * MS
        self.now = 100 * NS
        self.state = PolicyState.begin(self.count)
        self.words = WordsState((Note(),) * self.count)
        self.done = Counter[str]()
        self.under_way: list[tuple[int, Callable[[], None]]] = []
        every = range(self.count)
        # The truth.
        self.use = [True for _ in every]
        self.by = ["" for _ in every]
        self.error = [0.0 for _ in every]
        self.notch = [True for _ in every]
        self.armed = True
        self.boots = 0
        self.is_without = False  # no IMU is in use
        self.without_any = 0  # for how long, since the link was there, ns
        self.taken_by_others = -NS  # when a station last took an IMU out of use, ns
        self.primary = 0  # EKF lane that the vehicle flies with
        self.lane_changed = 0  # when it changed, or the vehicle was disarmed, ns
        self.lane_misled = -NS  # when we last took the IMU of this lane out, ns
        self.ran_on = [-NS for _ in every]  # when this lane last ran on each IMU, ns
        # The policy's view.
        self.named = [False for _ in every]
        self.agreed: list[int | None] = [0 for _ in every]
        self.told: list[tuple[bool | None, int]] = [(None, 0) for _ in every]
        self.newest = [0 for _ in every]
        self.delivers = [True for _ in every]
        self.stuck = [False for _ in every]
        self.linked = self.monitored = True
        self.restore = self.hurry = False
        self.disarmed = self.landed = 0
        self.read_at = 0
        self.lane = LaneState()
        self.lane_named: int | None = None  # by a text, since the last step

    def draw(self, rate: float) -> bool:
        """Whether an event of this rate, 1/s, happens in this step."""
        return self.random.random() < rate * STEP / NS

    def travel(self, arrive: Callable[[], None]) -> None:
        """Send a message: it may be lost, come twice, and overtake others."""
        for _ in range(1 + (self.random.random() < 0.1)):
            if self.linked and self.random.random() >= self.loss:
                late = int(self.random.integers(1, self.slow))
                self.under_way.append((self.now + late, arrive))

    def report(self, k: int, value: bool) -> None:
        """The autopilot sends a parameter. The sequence number drops an overtaken one."""
        sent = self.now

        def arrive() -> None:
            if sent >= self.newest[k]:
                self.newest[k] = sent
                self.told[k] = value, self.now

        self.travel(arrive)

    def answer(self, k: int) -> None:
        """A read has arrived: the value is read now, and sent up to 100 ms later."""
        value = self.use[k]
        late = int(self.random.integers(0, LATE_ANSWER))
        self.under_way.append((self.now + late, lambda: self.report(k, value)))

    def set_use(self, k: int, use: bool, by: str) -> None:
        """A PARAM_SET has arrived."""
        if by == OTHERS and self.use[k] and not use:
            self.taken_by_others = self.now
        # Its own IMU may have come back just before.
        trip = FRESH + LATE_ANSWER + 2 * self.slow
        if by == OURS and not use and self.now - self.ran_on[k] <= trip:
            self.lane_misled = self.now
        self.use[k] = use
        self.by[k] = by
        self.report(k, use)

    @property
    def source(self) -> int:
        """IMU that the primary EKF lane runs on. -1: none is in use."""
        if self.use[self.primary]:
            return self.primary
        return self.use.index(True) if any(self.use) else -1

    def change_lane(self, lane: int) -> None:
        """The autopilot flies with another lane, and says so twice."""
        if lane == self.primary:
            return
        self.primary = lane
        self.lane_changed = self.now
        self.lane_misled = -NS
        self.ran_on = [-NS] * self.count

        def arrive() -> None:
            self.lane_named = lane

        for _ in range(2):
            self.travel(arrive)

    def happen(self) -> None:
        """Events that nobody has asked for."""
        random = self.random
        k = int(random.integers(self.count))
        if self.draw(0.4):
            sizes = (0.0, random.uniform(0.005, 0.03), random.uniform(0.1, 3.0))
            self.error[k] = float(random.choice(sizes))
        if not self.error[k]:
            # An IMU that healed stays declared for a while. Some declarations are wrong.
            self.named[k] = (self.named[k] and not self.draw(2.0)) or (
                self.count == 3 and self.draw(0.05)
            )
        elif not self.named[k]:
            self.named[k] = self.draw(20.0)
        self.delivers[k] = not self.draw(0.1) and (self.delivers[k] or self.draw(20.0))
        self.stuck[k] ^= self.draw(1.0 if self.stuck[k] else 0.1)
        if self.draw(0.05):
            self.set_use(k, bool(random.random() < 0.5), OTHERS)
        self.linked ^= self.draw(0.05 if self.linked else 1.0)
        self.monitored ^= self.draw(0.05 if self.monitored else 1.0)
        self.armed ^= self.draw(0.02 if self.armed else 0.5)
        if not self.armed:
            self.primary = 0
            self.lane_changed = self.now
        elif self.draw(0.05):
            self.change_lane(k)
        self.restore = self.draw(0.02)
        if self.draw(0.01):
            # The companion starts anew: its file says which IMUs are ours.
            ours = [j for j, one in enumerate(self.state.memories) if one.ours]
            self.state = PolicyState.begin(self.count, ours)
            self.lane = LaneState()
            self.told = [(None, 0)] * self.count
            self.boots = 0
        if not self.armed and self.draw(0.1):
            # The autopilot starts anew: parameters outlive it, and it allocates a notch
            # filter only for an IMU in use.
            self.boots += 1
            self.notch = list(self.use)
            self.told = [(None, 0)] * self.count
            self.newest = [self.now] * self.count

    def look(self) -> View:
        """Return the policy's view."""
        imus = []
        for k in range(self.count):
            # One that is stuck is no measure for others.
            others = [
                abs(self.error[k] - self.error[j])
                for j in range(self.count)
                if j != k and not self.stuck[j]
            ]
            size = min(others, default=math.nan)
            least = min(
                (abs(self.error[k] - e) for j, e in enumerate(self.error) if j != k),
                default=math.nan,
            )
            agrees = size < self.settings.min_size and not self.stuck[k]
            self.agreed[k] = (self.agreed[k] or self.now) if agrees else None
            imus.append(
                Imu(
                    use=self.told[k][0]
                    if self.now - self.told[k][1] < 10 * NS
                    else None,
                    heard=self.told[k][1],
                    named=self.named[k],
                    blamed=self.named[k],
                    ok=not self.named[k] and self.error[k] < self.settings.min_size,
                    delivers=self.delivers[k],
                    stuck=self.stuck[k],
                    size=size,
                    least=least,
                    agreed=self.agreed[k],
                )
            )
        return View(
            tuple(imus),
            linked=self.linked,
            armed=self.armed,
            disarmed=self.disarmed,
            monitored=self.monitored,
            boots=self.boots,
            restore=self.restore,
        )

    def step(self) -> None:
        self.now += STEP
        if self.source >= 0:
            self.ran_on[self.source] = self.now
        if not self.now // STEP % 40 and self.linked:
            self.landed = self.now if self.armed else self.landed
            self.disarmed = self.now - self.landed
        due = [arrive for at, arrive in self.under_way if at <= self.now]
        self.under_way = [one for one in self.under_way if one[0] > self.now]
        for arrive in due:
            arrive()
        if self.now - self.read_at >= (READ_HURRIED if self.hurry else READ_EVERY):
            self.read_at = self.now
            for k in range(self.count):
                self.travel(lambda k=k: self.answer(k))
        view = self.look()
        decision = decide(self.state, view, self.now, self.settings)
        self.state = decision.state
        self.hurry = decision.hurry
        memories = self.state.memories
        self.words, words = announce(
            self.words, memories, view, self.now, self.settings
        )
        for _, condition in words:
            self.done[condition.name] += 1
        for order in decision.orders:
            self.check_order(order, view)
            self.done["in use" if order.use else "out of use"] += 1
            self.travel(lambda order=order: self.set_use(*order, by=OURS))
        self.follow_lane(view)
        self.check_vehicle()

    def follow_lane(self, view: View) -> None:
        """Ask for another EKF lane where that is due."""
        report = LaneReport(
            named=self.lane_named,
            configured=0,
            lanes=self.count,
            is_complete=self.linked and not self.loss,
            has_texts=True,
        )
        self.lane_named = None
        memories = self.state.memories
        self.lane, asks = follow(
            self.lane, report, memories, view, self.now, self.settings
        )
        if asks:
            self.check_ask()
            self.done["lane"] += 1
            self.travel(self.change_lane_if_better)

    def change_lane_if_better(self) -> None:
        """An ask for another lane has arrived."""
        if self.armed and self.now - self.lane_changed >= 5 * NS:
            self.change_lane(int(self.random.integers(self.count)))

    def check_ask(self) -> None:
        """Check that our order took out the IMU of the lane that the vehicle flies with."""
        assert self.armed, "asks on the ground"
        assert self.monitored, "asks unmonitored"
        trip = 2 * self.slow + LATE_ANSWER + 2 * STEP
        if self.now - self.lane_changed <= HEARTBEAT_AGE + trip:
            # The text is still under way.
            return
        assert self.lane.primary == self.primary, "asks for a healthy lane's change"
        since = self.now - self.lane_misled
        assert since <= ASK_AFTER[-1] + FRESH + trip, "the lane was not misled by ours"

    def check_order(self, order: Order, view: View) -> None:
        """Check an order against the truth when it is sent."""
        k = order.imu
        assert self.state.memories[k].ours, "kept in mind before it is sent"
        if order.use:
            return
        assert self.armed
        assert self.monitored
        rest = [j for j in range(self.count) if j != k]
        assert any(view.imus[j].use and not self.stuck[j] for j in rest)
        others = [self.error[j] for j in rest if not self.stuck[j]]
        if len(others) == 2:
            # Two gyros that fail alike cannot be told from two healthy ones.
            alike = abs(others[0] - others[1]) < self.settings.min_size
            assert self.error[k] >= self.settings.min_size or (alike and all(others))
            assert min(others) <= self.error[k] or (alike and all(others))
        limit = self.settings.limit or self.count - 1
        assert sum(one.ours for one in self.state.memories) <= limit

    def check_vehicle(self) -> None:
        """Check that our hand has not taken the last IMU out of use."""
        if any(self.use):
            self.is_without = False
            self.without_any = 0
            return
        if not self.is_without and OURS in self.by:
            # Only a station that acts within the age of our reports can bring this about.
            trip = FRESH + LATE_ANSWER + 2 * self.slow + STEP
            assert self.now - self.taken_by_others <= trip, "the last one, by our hand"
            self.done["station within a round trip"] += 1
        self.is_without = True
        # Without a link nothing can be put back: the time counts from its return.
        self.without_any = self.without_any + STEP if self.linked else 0
        if OURS in self.by and not self.loss:
            assert self.without_any <= 2 * NS, "none in use for long"

    def fly(self, seconds: float = 60.0) -> Counter[str]:
        """Fly, land, and check that nothing of ours is left out without a reason."""
        for _ in range(round(seconds * NS / STEP)):
            self.happen()
            self.step()
        self.loss = 0.0
        self.linked = self.monitored = True
        self.armed = self.restore = False
        for k in range(self.count):
            self.delivers[k] = True
            self.stuck[k] = False
        end = self.now + GROUNDED + 30 * NS
        while self.now < end and any(one.ours for one in self.state.memories):
            self.step()
        for k, memory in enumerate(self.state.memories):
            ours = not self.use[k] and self.by[k] == OURS
            still_bad = self.named[k] or self.agreed[k] is None
            assert not ours or still_bad or memory.without_notch, "not put back"
            assert not ours or memory.ours, "forgotten"
        return self.done


class Flown(Protocol):
    """A random flight that checks itself."""

    done: Counter[str]  #: What was done so far.

    def fly(self) -> object:
        """Fly. Raise `AssertionError` if something is violated."""


def violation(flight: Flown, number: int, done: Counter[str]) -> str:
    """Fly one flight, add what was done, and return what was violated; empty: nothing."""
    try:
        flight.fly()
    except AssertionError as error:
        return f"flight {number}: {error}"
    finally:
        done.update(flight.done)
    return ""


def fly_all(begin: Callable[[int], Flown]) -> NoReturn:
    """Fly the flights that the command line asks for, print what was done, and exit: 1 if anything is violated."""
    first, last = map(int, ["0", *sys.argv[1:]][-2:])
    total = Counter[str]()
    found = [
        text for k in range(first, last) if (text := violation(begin(k), k, total))
    ]
    print(f"flights {first} to {last - 1}:", dict(total), *found, sep="\n")
    sys.exit(bool(found))


if __name__ == "__main__":
    fly_all(Flight)
