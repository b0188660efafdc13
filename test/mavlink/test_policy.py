# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Times of the failover policy, each from both sides: one step earlier nothing happens."""

from dataclasses import replace

import pytest

from fdi_ros.mavlink.failover_evidence import Evidence, RawComparison
from fdi_ros.mavlink.failover_policy import (
    LASTING,
    LONGEST_PAUSE,
    PAUSE,
    STALE_ANSWER,
    Imu,
    Memory,
    PolicySettings,
    PolicyState,
    View,
    decide,
)

MS = 1_000_000
START = 1000 * 1000 * MS
OUT = Memory(ours=True, held=True, seen=False, out_sent=START, tries=1, taken=1)


def tick(memory, now, *, use, agreed=None):
    """Memory of the first of three IMUs after one tick; its INS_USE is reported now."""
    first = Imu(use, now, delivers=True, ok=True, size=0.0, agreed=agreed)
    others = (Imu(True, now, delivers=True, ok=True, size=0.0, agreed=START),) * 2
    view = View((first, *others), linked=True, armed=True, monitored=True)
    state = PolicyState(
        (memory, Memory(seen=True), Memory(seen=True)), at=now - 20 * MS
    )
    return decide(state, view, now, PolicySettings()).state.memories[0]


@pytest.mark.parametrize("taken", [1, 2, 3, 9])
def test_the_pause_before_an_imu_goes_back_doubles_each_time_it_was_taken_out(taken):
    pause = min(PAUSE * 2 ** (taken - 1), LONGEST_PAUSE)
    memory, agreed = replace(OUT, taken=taken), START + 1000 * MS
    assert tick(memory, agreed + pause - MS, use=False, agreed=agreed).held
    assert not tick(memory, agreed + pause, use=False, agreed=agreed).held


def reported(memory, first, last):
    """Memory after reports of an IMU in use, every 20 ms from one time to another."""
    for now in range(first, last, 20 * MS):
        memory = tick(memory, now, use=True)
    return memory


def test_a_late_answer_to_a_read_is_nobodys_hand_and_a_later_one_is():
    """By then it says how the IMU is, and not how it was before our order."""
    late = reported(OUT, START + 20 * MS, START + STALE_ANSWER + LASTING - 40 * MS)
    assert late.ours
    assert not late.left_alone
    begin = START + STALE_ANSWER
    assert not reported(OUT, begin, begin + LASTING - 20 * MS).left_alone
    assert reported(OUT, begin, begin + LASTING + 40 * MS).left_alone


@pytest.mark.parametrize(("apart", "compared"), [(7, True), (9, False)])
def test_samples_form_a_pair_within_four_tenths_of_an_interval(apart, compared):
    raw = RawComparison(2, 20 * MS)
    for k in range(20):
        raw.feed(0, START + 20 * k * MS, (0.1, 0.0, 0.0))
        # The next sample of the first comes 20 ms later, and is not compared with this.
        raw.feed(1, START + (20 * k + apart) * MS, (0.0, 0.0, 0.0))
    found = raw.between(0, 1, START + 400 * MS)
    assert (found is not None) == compared
    assert not compared or found.mean == pytest.approx((0.1, 0.0, 0.0))


@pytest.mark.parametrize(
    ("rate", "factor", "named"),
    [(20.0, 1.03, False), (20.0, 1.1, True), (20.0, 0.0, True), (0.7, 0.0, True)],
)
def test_an_error_of_scale_in_a_fast_turn_is_no_clear_error(rate, factor, named):
    """Two IMUs agree, and the third one reads the rate times a factor; no doubt."""
    evidence = Evidence(3, 20 * MS, min_size=0.03)
    evidence.hear([0.0] * 9, START)
    for k in range(10):
        now = START + k * 20 * MS
        for unit, scale in enumerate((1.0, 1.0, factor)):
            evidence.raw.feed(unit, now, (scale * rate, 0.0, 0.0))
        imus = evidence.look([True] * 3, now)
    assert [imu.named for imu in imus] == [False, False, named]
