# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sets that come and go are one episode of the unit that was in all of them."""

from dataclasses import replace

import pytest

from fdi_ros.monitor.soundness import REPORTED
from fdi_ros.replay.episodes import (
    Episode,
    Evidence,
    RateMeanwhile,
    Step,
    Stretch,
    join_halves,
)
from fdi_ros.replay.recurring import (
    NoisyTime,
    join_noise,
    join_recurring,
    with_all_candidates,
)

UNIT_OF = {
    f"imu_{unit}.{kind}{axis}": f"imu_{unit}"
    for unit in (1, 2, 3)
    for kind in ("", "accel_")
    for axis in "xyz"
}
GYROS = ("imu_3.x", "imu_3.y", "imu_3.z")
FORCES = ("imu_3.accel_x", "imu_3.accel_y", "imu_3.accel_z")


def episode(start, channels=GYROS, length=0.4, last=None, **changes):
    """A set of some channels that ends as one of the last ones for 10 ms."""
    steps = [Step(start, "AMBIGUOUS", channels, "a set")]
    if last is not None:
        steps.append(Step(start + length, "AMBIGUOUS", last, "the last"))
        length += 0.01
    one = Episode(
        stretch=1,
        state="AMBIGUOUS",
        channels=steps[-1].channels,
        who=steps[-1].who,
        start_s=start,
        since_s=steps[-1].at_s,
        end_s=start + length,
        stands=False,
        steps=tuple(steps),
        candidates=(),
        apart=None,
        evidence=Evidence("disagrees with the others", 1.5, 3, start),
        rate=RateMeanwhile(1.0, 0.002, 0.002, 0.1),
        measured_in="m/s^2" if "accel" in channels[0] else "rad/s",
    )
    return replace(one, **changes)


def test_sets_that_come_and_go_are_one_of_the_unit_in_all_of_them():
    """A set of a healthy channel as evidence fades names it in no episode."""
    every = tuple(name for name in UNIT_OF if "accel" not in name)
    run = [
        episode(6.0, last=("imu_3.z",)),
        episode(7.0, last=("imu_1.x",)),
        episode(8.0, length=0.1, channels=every),
        episode(9.0, length=2.0),
    ]
    (one,) = join_recurring(run, UNIT_OF)
    assert (one.channels, one.who, one.sets) == (GYROS, "a set", 4)
    assert (one.start_s, one.since_s, one.end_s) == (6.0, 6.0, 11.0)
    assert (one.longest_s, one.evidence.alarms) == (2.0, 12)
    assert not one.is_brief
    assert "a set AMBIGUOUS from 6.000 s to 11.000 s, 4 times" in one.words
    assert join_recurring(run[:3], UNIT_OF)[0].is_brief


@pytest.mark.parametrize(
    "last",
    [
        episode(8.0, state="FAULTY"),
        episode(8.0, channels=("imu_1.x", "imu_2.x")),
        episode(7.4 + 2.05),
        episode(8.0, stretch=2),
        episode(8.0, channels=FORCES),
    ],
)
def test_what_may_be_another_fault_stays_an_episode(last):
    run = [*(episode(5.0 + k) for k in range(2)), last]
    assert join_recurring(run, UNIT_OF) == run
    third = replace(run[1], start_s=7.0, since_s=7.0, end_s=7.4)
    third = replace(third, steps=(Step(7.0, "AMBIGUOUS", GYROS, "a set"),))
    whole, other = join_recurring([*run[:2], third, last], UNIT_OF)
    assert (whole.sets, other) == (3, last)


@pytest.mark.parametrize(("pause", "sets"), [(1.95, 3), (2.05, 1)])
def test_sets_recur_within_two_seconds(pause, sets):
    run = [episode(5.0 + k * (0.4 + pause)) for k in range(3)]
    assert join_recurring(run, UNIT_OF)[0].sets == sets


@pytest.mark.parametrize(("length", "joined"), [(0.1, 1), (0.08, 4)])
def test_a_unit_explains_sets_in_which_it_was_for_nine_tenths_of_the_time(
    length, joined
):
    """The last 10 ms of each set are of a channel of another unit."""
    run = [episode(5.0 + k, length=length, last=("imu_1.x",)) for k in range(4)]
    assert len(join_recurring(run, UNIT_OF)) == joined


def test_sets_of_two_units_are_of_either():
    pair = ("imu_1.z", "imu_2.z")
    run = [episode(5.0 + k, pair, last=(pair[k % 2],)) for k in range(5)]
    (one,) = join_recurring(run, UNIT_OF)
    assert one.channels == pair


def test_gyros_and_accelerometers_that_come_and_go_are_one():
    gyros = [episode(6.0 + k) for k in range(4)]
    forces = [episode(6.1 + k, FORCES) for k in range(4)]
    run = sorted([*gyros, *forces], key=lambda one: one.start_s)
    (one,) = join_halves(join_recurring(run, UNIT_OF), UNIT_OF)
    assert one.who == "imu_3 (gyros and accelerometers)"
    assert set(one.channels) == {*GYROS, *FORCES}
    assert [half.sets for half in one.halves] == [4, 4]
    assert one.is_brief
    # One set of the other half, which ends as one channel, belongs to them too.
    single = episode(6.1, FORCES, last=FORCES[2:])
    assert len(join_halves(join_recurring([*gyros, single], UNIT_OF), UNIT_OF)) == 1
    # Beside a fault of a single channel it is another one.
    assert len(join_halves([gyros[0], single], UNIT_OF)) == 2


@pytest.mark.parametrize(
    ("one", "channels", "since"),
    [
        (episode(6.0, length=0.06, last=("imu_3.z",)), GYROS, 6.0),
        (episode(6.0, length=9.0, last=("imu_3.z",)), GYROS, 6.0),
        (episode(6.0, last=("imu_1.z",)), ("imu_1.z", *GYROS), 6.0),
        (episode(6.0, last=("imu_3.z",), end_s=7.5), ("imu_3.z",), 6.4),
        (episode(6.0, last=("imu_3.z",), stands=True), ("imu_3.z",), 6.4),
        (episode(6.0, last=("imu_3.z",), state="FAULTY"), ("imu_3.z",), 6.4),
    ],
)
def test_evidence_that_fades_leaves_no_channel_named(one, channels, since):
    told = with_all_candidates(one, " or ".join)
    assert (told.channels, told.since_s) == (channels, since)
    if told is not one:
        assert (told.start_s, told.end_s, told.ever) == (6.0, one.end_s, one.ever)
        assert told.words.startswith(f"{' or '.join(channels)} AMBIGUOUS from 6.000 s")


STRETCHES = [
    Stretch(0.0, 40.0, 4000, 4000, 39.0),
    Stretch(60.0, 90.0, 3000, 3000, 29.0),
]


def noise(*channels, since=7.0, until=39.9, half="rad/s"):
    return [NoisyTime(name, half, since, until) for name in channels]


def test_a_set_that_passes_into_noise_of_its_unit_is_one_episode_of_the_unit():
    """A later set within that noise is of it, too."""
    run = [episode(6.0, last=("imu_3.x",)), episode(20.0, length=0.3)]
    (one,) = join_noise(run, noise("imu_3.x", "imu_3.z"), STRETCHES, UNIT_OF)
    assert (one.who, one.channels, one.sets) == ("imu_3", GYROS, 2)
    assert (one.start_s, one.end_s, one.stands) == (6.0, 39.9, True)
    assert (one.is_brief, one.noisy_from_s) == (True, 7.0)
    assert one.words.startswith(
        "imu_3 AMBIGUOUS from 6.000 s, 2 times, noisy from 7.000 s on"
    )
    ends = noise("imu_3.x", "imu_3.z", until=15.0)
    one, other = join_noise(run, ends, STRETCHES, UNIT_OF)
    assert (one.end_s, one.stands, one.sets) == (15.0, False, 1)
    assert other == run[1]


@pytest.mark.parametrize(
    "later", [("imu_1.y", "imu_2.y"), ("imu_2.y", "imu_2.z"), ("imu_1.x", "imu_1.y")]
)
def test_a_later_set_without_the_noisy_unit_stays(later):
    run = [
        episode(6.0, ("imu_2.x", "imu_3.x")),
        episode(20.0, later, length=20.0, stands=True),
    ]
    one, other = join_noise(run, noise("imu_3.x", "imu_3.y"), STRETCHES, UNIT_OF)
    assert one.who == "imu_3"
    assert other == run[1]


def test_noise_tells_which_unit_of_a_set_is_loose():
    every = tuple(name for name in UNIT_OF if "accel" not in name)
    found = noise("imu_2.x", "imu_2.y")
    (one,) = join_noise([episode(6.0, every)], found, STRETCHES, UNIT_OF)
    assert (one.who, one.channels) == ("imu_2", ("imu_2.x", "imu_2.y", "imu_2.z"))


@pytest.mark.parametrize(
    ("one", "found"),
    [
        (episode(6.0), noise("imu_3.x")),
        (episode(6.0), noise("imu_2.x", "imu_2.y")),
        (episode(6.0), noise("imu_3.x", "imu_3.y", "imu_2.x")),
        (episode(6.0), noise("imu_3.x", "imu_3.y", since=8.5)),
        (episode(6.0), noise("imu_3.x", "imu_3.y", since=2.0)),
        (episode(6.0), noise("imu_3.x", "imu_3.y", until=6.9 + REPORTED.noisy_s)),
        (episode(6.0), noise(*FORCES, half="m/s^2")),
        (episode(6.0, state="FAULTY"), noise("imu_3.x", "imu_3.y")),
    ],
)
def test_noise_of_one_channel_or_another_unit_or_time_joins_nothing(one, found):
    """A named channel stays named, whatever noise follows."""
    assert join_noise([one], found, STRETCHES, UNIT_OF) == [one]
