# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of IMUs are as pymavlink lays them out; the offset of a clock is true within the error that is stated."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from fdi_ros.mavlink.protocol import (
    IMU_MESSAGES,
    MS,
    NS,
    BootClock,
    ImuSample,
    Thinning,
    TimeSync,
    read,
    system_ahead,
    understood,
)

OVER = (1 << 32) * MS
SHORT = st.integers(-32768, 32767)


@pytest.mark.parametrize("fast", [9, 18, 20, 25])
def test_samples_picked_from_faster_ones_are_of_the_same_times(fast: int) -> None:
    """Units come 1 ms after each other, some samples are lost, sending is late by 2 ms."""
    random = np.random.default_rng(fast)
    thinning = Thinning(20 * MS)
    times: dict[int, list[int]] = {0: [], 1: [], 2: []}
    for burst in range(2000):
        late = int(random.integers(3))
        for unit in times:
            stamp = (fast * burst + late + unit) * MS
            if random.random() > 0.1 and thinning.picks(
                ImuSample(unit, stamp, (0.0,) * 3, (0.0,) * 3)
            ):
                times[unit].append(stamp - unit * MS)
    rows = sorted({at for picked in times.values() for at in picked})
    assert np.diff(rows).min() >= 14 * MS
    assert all(
        len(set(picked)) == len(picked) > 0.85 * len(rows) for picked in times.values()
    )


def payload_of(message) -> bytes:
    data = bytes(message.pack(mavlink.MAVLink(None)))
    return data[10 : 10 + data[1]]


@pytest.mark.parametrize("number", IMU_MESSAGES)
@given(
    time=st.integers(1, 2**32 - 1),
    values=st.lists(SHORT, min_size=6, max_size=6),
    unit=st.integers(0, 3),
)
def test_values_are_pymavlinks_in_our_units_and_axes(
    number: int, time: int, values: list[int], unit: int
) -> None:
    message, theirs = IMU_MESSAGES[number], mavlink.mavlink_map[number]
    assert (message.name, message.size) == (theirs.msgname, theirs.unpacker.size)
    acceleration, rate = values[:3], values[3:]
    if message.name == "HIGHRES_IMU":
        made = mavlink.MAVLink_highres_imu_message(
            time, *map(float, values), *(0.0,) * 7, 0x3F, unit
        )
        g = a = 1.0
    elif message.name == "RAW_IMU":
        made = mavlink.MAVLink_raw_imu_message(time, *values, 0, 0, 0, unit, 0)
        g, a = 1e-3, 9.80665e-3
    else:
        made = theirs(time, *values, 0, 0, 0, 0)
        g, a, unit = 1e-3, 9.80665e-3, message.unit
    reading = read(number, payload_of(made))
    if not any(values):
        assert reading is None
        return
    assert reading is not None
    assert (reading.unit, reading.stamp) == (
        unit,
        1000 * time * (1000 if number in (26, 116, 129) else 1),
    )
    np.testing.assert_allclose(
        reading.rate, [g * rate[0], -g * rate[1], -g * rate[2]], atol=1e-12
    )
    np.testing.assert_allclose(
        reading.acceleration,
        np.array([1, -1, -1]) * a * np.array(acceleration),
        atol=1e-9,
    )


@pytest.mark.parametrize("updated", [0, 0b000111, 0b011000])
def test_a_gyro_that_is_not_new_is_no_sample(updated: int) -> None:
    made = mavlink.MAVLink_highres_imu_message(
        5, 0.0, 0.0, -9.8, 0.1, 0.2, 0.3, *(0.0,) * 7, updated, 0
    )
    assert read(105, payload_of(made)) is None


def test_raw_counts_have_no_unit_but_from_ardupilot() -> None:
    assert understood("RAW_IMU", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA)
    assert not understood("RAW_IMU", mavlink.MAV_AUTOPILOT_PX4)
    assert understood("SCALED_IMU", mavlink.MAV_AUTOPILOT_PX4)


BEGIN = 10**16
SEEDS = st.integers(0, 2**32 - 1)


def answers(
    sync: TimeSync, remote: Callable[[int], int], trip: Callable[[int], int]
) -> Iterator[tuple[int, bool]]:
    """Ask ten times a second where it is due, for 30 s: the time after each answer, ns, and whether it was taken."""
    now = BEGIN
    while now < BEGIN + 30 * NS:
        sent = sync.request(now)
        if sent is not None:
            there, back = trip(now), trip(now)
            taken = sync.answer(sent, remote(now + there), now + there + back)
            now += there + back
            yield now, taken
        now += NS // 10


@given(
    SEEDS, st.integers(-(10**15), 10**15), st.floats(-9e-5, 9e-5), st.floats(1e-5, 0.05)
)
def test_the_offset_is_right_within_its_error(
    seed: int, offset: int, drift: float, shortest: float
) -> None:
    """Whatever the two ways take, and however they differ, up to 100 ppm."""
    random, sync = np.random.default_rng(seed), TimeSync()

    def remote(at: int) -> int:
        return at + offset + round(drift * (at - BEGIN))

    def off(now: int) -> int:
        return abs((sync.offset(now) or 0) - (remote(now) - now))

    for now, _ in answers(
        sync, remote, lambda _: round(NS * shortest * (1 + random.exponential(2.0)))
    ):
        error = sync.error(now)
        # The offset in use follows at a bounded rate: so there is a time for it.
        assert not sync.synchronised or remote(now) <= 0 or off(now) <= error + 20 * MS
    if sync.synchronised:
        for later in range(now, now + 20 * NS, NS // 10):
            sync.offset(later)
        assert off(later) <= (sync.error(later) or 0) + 1


@given(SEEDS, st.sampled_from([0.0, 0.1, 0.5, 0.9, 2.0]), st.integers(-2 * NS, 2 * NS))
def test_a_clock_that_steps_or_runs_at_another_pace_is_followed_by_the_next_answer(
    seed: int, pace: float, step: int
):
    """As of a simulation that is stopped, or slower than time, whatever short round trips there were before."""
    random, sync, turn = np.random.default_rng(seed), TimeSync(), BEGIN + 10 * NS

    def remote(at: int) -> int:
        return at if at < turn else turn + step + round(pace * (at - turn))

    def trip(at: int) -> int:
        return round(MS * (1 if at < turn else 5) * (1 + random.exponential()))

    for now, taken in answers(sync, remote, trip):
        # Half a second at that pace, in which nothing is asked; no more.
        off = abs((sync.offset(now) or 0) - (remote(now) - now))
        assert not taken or off <= 30 * MS + abs(1 - pace) * NS // 2


@given(st.integers(-(10**12), 10**12), st.integers(0, MS), st.integers(1, 2))
def test_one_or_two_wrong_answers_change_nothing(
    wrong: int, trip: int, count: int
) -> None:
    """However short the way that they seem to have taken; three in a row are believed."""
    sync, now = TimeSync(), BEGIN
    for k in range(30):
        now += NS // 2
        sent = sync.request(now)
        assert sent is not None
        is_wrong = 20 <= k < 20 + count and abs(wrong) > 20 * MS
        sync.answer(
            sent,
            now + trip // 2 + wrong * is_wrong,
            now + (trip if is_wrong else 4 * MS),
        )
        assert abs(sync.offset(now + 4 * MS) or 0) <= 4 * MS


@pytest.mark.parametrize(
    ("sent", "remote", "after"),
    [(7, NS, 0), (NS, 0, 0), (NS, -5, 0), (NS, 1 << 63, 0), (NS, NS, -1)],
)
def test_an_answer_that_cannot_be_says_nothing_and_one_that_can_counts_once(
    sent: int, remote: int, after: int
) -> None:
    sync = TimeSync()
    assert sync.request(NS) == NS
    assert not sync.answer(sent, remote, NS + after)
    assert sync.offset(2 * NS) is None
    again = TimeSync()
    again.request(NS)
    assert [again.answer(NS, 3 * NS, NS + MS) for _ in range(2)] == [True, False]


def test_without_answers_the_least_delayed_arrival_counts() -> None:
    sync, random = TimeSync(), np.random.default_rng(0)
    for k in range(200):
        at = k * NS // 50
        sync.arrived(at, 10 * NS + at + 5 * MS + round(random.exponential(10 * MS)))
    offset = sync.offset(10 * NS + 4 * NS)
    assert offset is not None
    assert 5 * MS <= -offset - 10 * NS < 6 * MS


@given(
    start=st.integers(0, 2**33),
    steps=st.lists(st.integers(5, 500), min_size=1, max_size=50),
)
def test_milliseconds_that_run_over_go_on(start: int, steps: list[int]) -> None:
    clock, true, now = BootClock(), start * MS, 10**15
    for step in [0, *steps]:
        true, now = true + step * MS, now + step * MS
        assert clock.unwrap(true % OVER, now, True, true) == true
    assert clock.restarts == 0


def test_a_clock_that_begins_anew_is_found_and_a_single_wrong_time_is_not() -> None:
    clock, now = BootClock(), 0
    for k in range(100):
        now += 20 * MS
        assert clock.unwrap(100 * NS + now, now, True) == 100 * NS + now
        if k % 10 == 0:
            assert clock.unwrap(5 * NS, now, True) is None
    assert clock.restarts == 0
    steps = [k * 20 * MS for k in range(20)]
    taken = [clock.unwrap(step, now + step, True) for step in steps]
    assert clock.restarts == 1
    lasting = BootClock.STEP_STANDS_NS // (20 * MS) + 1
    assert taken == [None] * lasting + steps[lasting:]


@pytest.mark.parametrize("late", [1500 * MS, 5 * NS])
def test_late_copies_over_a_second_path_are_no_start(late: int) -> None:
    """Those of three units come together, between the present ones."""
    clock = BootClock()
    for now in range(NS, 20 * NS, 20 * MS):
        for _ in range(3):
            assert clock.unwrap(100 * NS + now, now, True) == 100 * NS + now
        for _ in range(3 if now > 10 * NS else 0):
            assert clock.unwrap(100 * NS + now - late, now, True) is None
    assert clock.restarts == 0


def test_the_time_of_the_system_is_measured_between_interruptions() -> None:
    """A process that is kept waiting between two readings of the clocks does not shift its stamps."""
    random, clock = np.random.default_rng(0), [0]

    def tick() -> int:
        clock[0] += 200 if random.random() < 0.95 else 50 * MS
        return clock[0]

    for _ in range(200):
        assert (
            abs(
                system_ahead(tick, lambda: tick() + 1_790_000_000 * NS)
                - 1_790_000_000 * NS
            )
            <= 200
        )
