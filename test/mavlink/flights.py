# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Random flights of the failover policy: `cd test && python -m mavlink.flights 10000`.

Faults come and go on several IMUs; messages are lost, late, doubled and overtake one another; somebody else sets the
same parameters; link, monitor, autopilot and companion fall silent or start anew. At every step it is checked that
nothing healthy and nothing last is taken out, and after the landing that all of ours is back.
"""

import sys
from collections import Counter
from collections.abc import Callable

import numpy as np

from fdi_ros.mavlink.failover import (
    GROUNDED,
    FailoverState,
    FailoverUnit,
    Known,
    decide,
)

MS = 1_000_000
NS = 1000 * MS
STEP = 50 * MS


class Flight:
    """One flight and what its policy does."""

    def __init__(self, seed: int) -> None:
        self.random = random = np.random.default_rng(seed)
        self.count = int(random.integers(2, 4))
        self.limit = int(random.integers(1, self.count))
        self.loss, self.slow = (
            random.choice([0.0, 0.2, 0.5]),
            int(random.choice([10, 100, 700])) * MS,
        )
        self.now, self.state, self.done = 100 * NS, FailoverState(), Counter[str]()
        self.under_way: list[tuple[int, Callable[[], None]]] = []
        every = range(self.count)
        self.use, self.by = [True for _ in every], ["" for _ in every]
        """The truth: which are in use, and who has set that last."""
        self.said: list[tuple[bool | None, int]] = [(None, 0) for _ in every]
        self.newest, self.touched = [0 for _ in every], [False for _ in every]
        """When what was heard last was sent; whether somebody else was heard to change it in this flight."""
        self.asked, self.wish = [0 for _ in every], [True for _ in every]
        """When we set it last, and to what."""
        self.faulty = [False for _ in every]
        self.declared: list[int | None] = [None for _ in every]
        self.ok, self.well = [True for _ in every], [0 for _ in every]
        self.delivers = [True for _ in every]
        self.armed, self.linked, self.monitored, self.restore = True, True, True, False
        self.disarmed, self.landed = 0, 0

    def draw(self, rate: float) -> bool:
        """Whether something happens in this step that does so many times a second."""
        return self.random.random() < rate * STEP / NS

    def travel(self, arrive: Callable[[], None]) -> None:
        for _ in range(1 + (self.random.random() < 0.1)):
            if self.linked and self.random.random() >= self.loss:
                self.under_way.append(
                    (self.now + int(self.random.integers(1, self.slow)), arrive)
                )

    def send_text(self, k: int) -> None:
        """The autopilot says a parameter; one that was overtaken is dropped by its sequence number."""
        value, by, sent = self.use[k], self.by[k], self.now

        def arrive() -> None:
            if sent > self.newest[k]:
                is_new = (
                    self.said[k][0] not in (None, value)
                    and self.now - self.asked[k] > 2 * NS + STEP
                )
                self.touched[k] |= is_new and by == "other"
                self.said[k], self.newest[k] = (value, self.now), sent

        self.travel(arrive)

    def set_use(self, k: int, use: bool, by: str) -> None:
        self.use[k], self.by[k] = use, by
        self.send_text(k)

    def happen(self) -> None:
        """What nobody has asked for."""
        k = int(self.random.integers(self.count))
        self.faulty[k] ^= self.draw(0.3)
        if self.faulty[k] and self.declared[k] is None and self.draw(20):
            self.declared[k], self.ok[k] = self.now, False
        elif not self.faulty[k] and self.declared[k] is not None and self.draw(5):
            self.declared[k] = None
        elif self.declared[k] is None:
            self.ok[k] = not self.draw(0.2)
        self.well[k] = self.now if self.declared[k] is not None else self.well[k]
        self.delivers[k] = not self.draw(0.1) and (self.delivers[k] or self.draw(20))
        if self.draw(0.05):
            self.set_use(k, bool(self.random.random() < 0.5), "other")
        self.linked ^= self.draw(0.05 if self.linked else 1.0)
        self.monitored ^= self.draw(0.05 if self.monitored else 1.0)
        self.armed ^= self.draw(0.02 if self.armed else 0.5)
        self.restore = self.draw(0.02)
        if self.draw(0.01):
            # A companion that starts anew knows what is ours, and takes all else as it finds it.
            self.state = FailoverState.resumed(self.state.orders)
            self.said, self.touched = [(None, 0)] * self.count, [False] * self.count
        if self.draw(0.02):
            # The autopilot starts anew: its parameters are as they were, and asked for again.
            self.said = [(None, 0)] * self.count

    def step(self) -> None:
        self.now += STEP
        if not self.now // STEP % 20 and self.linked:
            self.landed = self.now if self.armed else self.landed
            self.disarmed = self.now - self.landed
        due = [arrive for at, arrive in self.under_way if at <= self.now]
        self.under_way = [one for one in self.under_way if one[0] > self.now]
        for arrive in due:
            arrive()
        if self.disarmed >= GROUNDED:
            # By the last heartbeat it is on the ground: what is heard till the next one was set there.
            self.touched = [False] * self.count
        k, begins = divmod(self.now // STEP % (10 * self.count), 10)
        if not begins:
            self.travel(lambda: self.send_text(k))
        told = zip(
            self.said, self.declared, self.ok, self.well, self.delivers, strict=True
        )
        units = tuple(FailoverUnit(*said, *rest) for said, *rest in told)
        known = Known(
            units, self.linked, self.armed, self.disarmed, self.monitored, self.restore
        )
        self.state, actions = decide(self.state, known, self.now, self.limit)
        for action in actions:
            self.done[action.kind] += 1
            if action.kind == "set":
                self.order(known, action.unit, action.use)

    def order(self, known: Known, k: int, use: bool) -> None:
        self.asked[k], self.wish[k] = self.now, use
        if not use:
            units = known.units
            assert all((known.armed, known.linked, known.monitored))
            assert units[k].declared is not None, "a healthy one"
            assert self.now - units[k].declared <= 3 * NS, "declared long ago"
            assert all(unit.use is not None for unit in units)
            assert units[k].use, "out already"
            healthy = {
                j
                for j, unit in enumerate(units)
                if unit.use and unit.delivers and unit.ok
            }
            # What we have just set to be out may be out, though it was not heard yet.
            assert (
                healthy
                - {
                    j
                    for j, at in enumerate(self.asked)
                    if not self.wish[j] and self.now - at < 2 * NS
                }
                - {k}
            )
            out = [order for order in self.state.orders.values() if order.is_out]
            assert len(out) <= self.limit < self.count
            assert not self.touched[k], "somebody else's"
        assert k in self.state.orders, "kept in mind before it is sent"
        self.travel(lambda: self.set_use(k, use, "ours"))

    def fly(self, seconds: float = 60.0) -> Counter[str]:
        """Fly, land, and check that nothing of ours is left out."""
        for _ in range(round(seconds * NS / STEP)):
            self.happen()
            self.step()
        self.loss, self.linked, self.armed, self.restore = 0.0, True, False, False
        for _ in range(round(30 * NS / STEP)):
            self.step()
        assert not self.state.orders
        for use, by in zip(self.use, self.by, strict=True):
            assert use or by == "other", "not put back"
        return self.done


if __name__ == "__main__":
    total = Counter[str]()
    for number in range(int(sys.argv[1])):
        print(end=f"\rflight {number}", file=sys.stderr)
        total += Flight(number).fly()
    print(f"\n{sys.argv[1]} flights:", dict(total))
