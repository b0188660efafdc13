# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether an autopilot obeys, found out by a parameter that is set to its own value."""

from collections.abc import Sequence
from itertools import pairwise

from fdi_ros.mavlink.failover.probe import Probe, probe

MS = 1_000_000
NS = 1000 * MS
PROBE_QUIET = 500 * MS
ANSWERED = NS
PROBE_AGAIN = 5 * NS
TICK = 20 * MS


class Probed:
    """An autopilot of three IMUs that reports each parameter 50 ms after it is set."""

    def __init__(self) -> None:
        self.state = Probe.begin(3)
        self.now = 100 * NS
        self.may = [True] * 3
        self.heard = [self.now] * 3
        self.answers = [True] * 3
        self.outcomes: list[bool | None] = [None] * 3
        self.set_at: list[tuple[int, int]] = []  # IMU and time, ns

    def run(self, seconds: float) -> Sequence[bool | None]:
        """Return what is known then of each IMU."""
        for _ in range(round(seconds * NS / TICK)):
            self.now += TICK
            for k, at in self.set_at:
                if self.answers[k] and at + 50 * MS < self.now <= at + 50 * MS + TICK:
                    self.heard[k] = self.now
            for k in range(3):
                # An answer to a read sent before the parameter became quiet.
                if (
                    k != self.state.imu
                    or self.now < self.state.begun + PROBE_QUIET - TICK
                ):
                    self.heard[k] = self.now
            self.state, imu = probe(
                self.state, self.may, self.heard, self.outcomes, self.now
            )
            if imu >= 0:
                self.set_at.append((imu, self.now))
        return self.state.obeys


def test_each_parameter_is_set_once_and_known_after_its_answer() -> None:
    talk = Probed()
    assert talk.run(3.0) == (True, True, True)
    assert [imu for imu, _ in talk.set_at] == [0, 1, 2]


def test_one_that_is_not_answered_stays_unknown_and_is_tried_again() -> None:
    talk = Probed()
    talk.answers[1] = False
    assert talk.run(20.0) == (True, None, True)
    times = [at for imu, at in talk.set_at if imu == 1]
    # Each time it becomes quiet, is set, and waits for the answer.
    pause = PROBE_QUIET + ANSWERED + PROBE_AGAIN
    pauses = [b - a for a, b in pairwise(times)]
    assert len(pauses) > 1
    assert all(pause <= one <= pause + 10 * TICK for one in pauses)


def test_while_an_order_may_follow_nothing_is_set() -> None:
    talk = Probed()
    talk.run(0.2)
    assert talk.state.imu == 0
    talk.may = [False] * 3
    assert talk.run(9.0) == (None,) * 3
    assert not talk.set_at
    assert talk.state.imu < 0, "its parameter is read as usual"


def test_what_orders_show_counts() -> None:
    talk = Probed()
    talk.outcomes = [False, True, None]
    assert talk.run(2.0) == (False, True, True)
    assert [imu for imu, _ in talk.set_at] == [2]
    talk.outcomes = [True, None, None]
    assert talk.run(2.0) == (True, True, True)
