# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What happened in a recording: of states and residuals to episodes, of these to words and to the faults injected."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from monitor.streams import output_of, parallel
from replay.summaries import summary_of

from fdi_ros.core.states import ChannelState, Reason
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.geometry import (
    Geometry,
    all_of_words,
    one_of_words,
    spans_space,
)
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import Event, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.episodes import (
    EPISODE_TIMES,
    Candidate,
    Size,
    _growth,
    detail_words,
    episode_words,
    pieces,
    size_words,
)
from fdi_ros.replay.outcomes import Evaluation, Followed, score
from fdi_ros.replay.recorder import Batches, Recorder
from fdi_ros.replay.run import Sink, Walk
from fdi_ros.replay.verdict import verdict_of
from fdi_ros.replay.words import fault_sections, sentences
from fdi_ros.report.layout import RADIANS, Severity

S = ChannelState
THREE = Geometry.from_triads([np.eye(3)] * 3)
TWO = Geometry.from_triads(
    [np.eye(3)] * 2, [f"imu_{k}.{axis}" for k in range(2) for axis in "xyz"]
)
NOISE = NoiseModel(2.0**-8)
STEP = 2.0**-6
"""s; times and residuals of the tests are sums of powers of two, so that sums are exact in any order."""


def outputs(geometry, states, errors=None, time=None):
    """Samples with these states (N, n) and errors (N, n) of the channels, fused from the channels that are OK."""
    states = np.asarray(states, dtype=np.uint8)
    count, n = states.shape
    time = STEP * np.arange(count) if time is None else np.asarray(time)
    stamp = np.round(time * 1e9).astype(np.int64)
    before = np.vstack([np.zeros(n, dtype=np.uint8), states[:-1]])
    events = [
        Event(
            int(stamp[k]),
            int(i),
            S(before[k, i]),
            S(states[k, i]),
            Reason.DISAGREES,
            (int(i),),
            0.0,
            int(k),
        )
        for k, i in np.argwhere(states != before)
    ]
    figures = {
        "rate": 0.0,
        "statistic": 1.0,
        "threshold": 2.0,
        "level": 0.01,
        "valid": True,
    }
    figures |= {
        "residual": 0.0 if errors is None else errors,
        "covariance": 1e-6 * np.eye(3),
        "state": states,
    }
    return time, output_of(n, events, stamp=stamp, **figures)


def told(geometry, part, pieces=1):
    """The story of a stretch that comes in so many pieces."""
    recorder, (time, output) = Recorder(geometry, NOISE), part
    for rows in filter(len, np.array_split(np.arange(len(time)), pieces)):
        span = slice(int(rows[0]), int(rows[-1]) + 1)
        events = [
            event for event in output.events if span.start <= event.row < span.stop
        ]
        recorder.add(time[span], Output(output.rows[span], output.n, events))
    return recorder.story()


def course(n, count, *changes):
    """States (count, n): OK, but as `(row, {channel: state})` say from a row on."""
    states = np.zeros((count, n), dtype=np.uint8)
    for row, now in changes:
        for channel, state in now.items():
            states[row:, channel] = state
    return states


@st.composite
def histories(draw):
    """States that change now and then, in an order no monitor would give, and holes in the time."""
    count, n = draw(st.integers(2, 80)), THREE.n
    change = st.tuples(
        st.integers(0, count - 1), st.integers(0, n - 1), st.sampled_from(S)
    )
    changes = draw(st.lists(change, max_size=25))
    steps = np.full(count, STEP)
    steps[draw(st.lists(st.integers(1, count - 1), max_size=2))] = 0.5
    errors = draw(st.integers(0, 2**16)) * 2.0**-12 * np.ones((count, n)) * np.arange(n)
    return outputs(
        THREE,
        course(n, count, *((row, {i: s}) for row, i, s in changes)),
        errors,
        np.cumsum(steps),
    )


@pytest.mark.parametrize(
    ("last", "words"),
    [
        (0.3, "imu_1.x growing by +0.02 rad/s per second, from +0.2 to +0.3 rad/s"),
        (-0.1, "imu_1.x changing from +0.2 to -0.1 rad/s"),
    ],
)
def test_a_slope_is_said_only_if_the_error_went_that_way(last, words):
    """An error that goes there and back has a slope of either sign."""
    size = Size(0.2, 0.01, "growing", last, slope_rad_s2=0.02)
    assert _growth(Candidate("imu_1.x", "x", size), RADIANS) == words


@given(histories(), st.integers(1, 40))
def test_how_a_stream_is_cut_changes_nothing_of_the_story(history, count):
    whole = asdict(told(THREE, history))
    cut_up = asdict(told(THREE, history, pieces=count))
    assert flat(cut_up) == pytest.approx(flat(whole), rel=1e-9, abs=1e-12)
    for one in told(THREE, history).episodes:
        assert one.start_s <= one.since_s <= one.end_s
        assert set(one.channels) <= one.ever
        assert episode_words(one)
        assert detail_words(one)


def flat(values, path=""):
    """Numbers and names of a nested structure, each under its place; names as their hash; sentences left out."""
    if isinstance(values, dict):
        return {
            key: value
            for name, part in values.items()
            for key, value in flat(part, f"{path}.{name}").items()
        }
    if isinstance(values, (list, tuple)):
        return {
            key: value
            for k, part in enumerate(values)
            for key, value in flat(part, f"{path}.{k}").items()
        }
    if path.endswith(".words"):
        return {}
    return {path: values if isinstance(values, (int, float)) else hash(str(values))}


@given(
    st.integers(0, 2**32 - 1), st.integers(0, 8), st.floats(0.01, 1.0), st.booleans()
)
def test_the_size_is_the_error_whatever_was_fused(seed, channel, error, left_out):
    """Noise aside; the fused rate is that of any channels that span space, the faulty one among them or not."""
    random = np.random.default_rng(seed)
    axes = np.vstack(
        [THREE.axes @ np.linalg.qr(random.normal(size=(3, 3)))[0]]
    ) * random.uniform(0.9, 1.1, (9, 1))
    geometry = Geometry.from_axes(axes, THREE.channel_names)
    used = random.random(9) < 0.7
    used[channel] = not left_out
    if not spans_space(axes[used]):
        used[:] = np.arange(9) != channel
    z = np.zeros(9)
    z[channel] = error
    residual = z - axes @ (np.linalg.pinv(axes[used]) @ z[used])
    states = course(9, 100, (20, {channel: S.FAULTY}))
    (one,) = told(
        geometry, outputs(geometry, states, np.broadcast_to(residual, (100, 9)))
    ).episodes
    (candidate,) = one.candidates
    assert candidate.size.rad_s == pytest.approx(error, rel=1e-6)
    assert candidate.size.course == "steady"


def test_a_fault_that_comes_to_a_name_is_one_episode():
    pair, whole = {4: S.AMBIGUOUS, 0: S.AMBIGUOUS}, dict.fromkeys(range(9), S.AMBIGUOUS)
    time, errors = 60.0 + np.arange(4000) * 0.008, np.zeros((4000, 9))
    errors[:, 4] = (
        0.042
        + 0.01 * np.maximum(0, time - 65.668)
        + np.random.default_rng(1).normal(0, 0.004, 4000)
    )
    rows = [int(np.searchsorted(time, at)) for at in (63.072, 63.080, 65.668)]
    steps = (whole, {**dict.fromkeys(range(9), S.OK), **pair}, {0: S.OK, 4: S.FAULTY})
    states = course(9, 4000, *zip(rows, steps, strict=True))
    (one,) = told(THREE, outputs(THREE, states, errors, time)).episodes
    assert one.words == (
        "imu_2.y FAULTY from 65.672 s (+0.0466 +- 0.0013 rad/s, growing to +0.304 rad/s); before that any"
        " of the 9 gyros from 63.072 s, imu_1.x or imu_2.y from 63.080 s"
    )
    counts = [(step.state, len(step.channels)) for step in one.steps]
    assert counts == [("AMBIGUOUS", 9), ("AMBIGUOUS", 2), ("FAULTY", 1)]
    assert (
        dict(detail_words(one))["alternative"]
        == "no other single channel explains the evidence"
    )
    assert one.rate.published == 1.0


def test_a_pair_that_measures_one_axis_is_named_by_it_with_how_far_it_is_apart():
    errors = np.zeros((1000, 6))
    errors[:, 0] = np.random.default_rng(2).normal(0.1, 0.15, 1000)
    axis, apart = "the x axis of imu_0 or imu_1", "0.096 +- 0.005 rad/s apart"
    for channels, measured, words in (
        ((0, 3), "x of the body", f"{axis} AMBIGUOUS from 1.562 s, {apart}"),
        # Before the evidence has come to the pair, the sizes show it.
        (
            range(6),
            "x, y, z of the body",
            f"any of the 6 gyros AMBIGUOUS from 1.562 s, seen on {axis}: {apart}",
        ),
    ):
        states = course(6, 1000, (100, dict.fromkeys(channels, S.AMBIGUOUS)))
        (one,) = told(TWO, outputs(TWO, states, errors)).episodes
        assert one.words == words
        assert dict(detail_words(one))["axis"] == measured
    turned = Geometry.from_triads([np.eye(3), [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]])
    assert one_of_words(turned, [0, 4]) == "imu_1.x or imu_2.y, which measure one axis,"
    assert one_of_words(turned, [3, 4, 5]) == "any axis of imu_2"
    forces = Geometry(
        turned.axes, [name.replace(".", ".accel_") for name in turned.channel_names]
    )
    assert one_of_words(forces, [3, 4, 5]) == "any axis of imu_2.accel"
    assert all_of_words(forces, [0, 1, 2]) == "imu_1.accel"
    assert one_of_words(turned, [0, 1]) == "imu_1.x or imu_1.y"


def test_a_set_of_most_channels_says_which_sensors_it_is_about():
    three = Geometry.from_triads([np.eye(3)] * 3)
    most = [0, 1, 2, 3, 5, 6, 8]
    but = "(all but imu_2.y and imu_3.y)"
    assert one_of_words(three, most, "gyro") == f"one of the gyros {but}"
    words = one_of_words(three, [0, 1, 2, 3, 4], "accelerometer")
    assert words == "any of 5 accelerometers"
    assert one_of_words(three, range(9), "gyro") == "any of the 9 gyros"


def test_what_hides_for_a_while_is_no_new_declaration_and_a_hole_is_no_silence():
    """A set stands; all is silent for a sample after a hole; the set is there again, and later narrows."""
    states = course(
        9,
        400,
        (100, {0: S.AMBIGUOUS, 3: S.AMBIGUOUS, 6: S.AMBIGUOUS}),
        (200, dict.fromkeys(range(9), S.STALE)),
        (
            201,
            {
                **dict.fromkeys(range(9), S.OK),
                0: S.AMBIGUOUS,
                3: S.SUSPECT,
                6: S.AMBIGUOUS,
            },
        ),
        (202, {3: S.AMBIGUOUS}),
        (300, {6: S.OK}),
    )
    time = STEP * np.arange(400) + np.where(np.arange(400) >= 200, 3.0, 0.0)
    (one,) = told(THREE, outputs(THREE, states, None, time)).episodes
    assert [step.channels for step in one.steps] == [
        ("imu_1.x", "imu_2.x", "imu_3.x"),
        ("imu_1.x", "imu_2.x"),
    ]
    assert one.stands
    # Silence that lasts is told of, of a unit at once.
    lost = course(
        9,
        400,
        (200, {3: S.STALE}),
        (202, {4: S.STALE, 5: S.STALE}),
        (300, {3: S.OK, 4: S.OK, 5: S.OK}),
    )
    (one,) = told(THREE, outputs(THREE, lost)).episodes
    assert (one.who, one.state, one.declares) == ("imu_2", "STALE", False)
    assert one.end_s == pytest.approx(300 * STEP)


def test_units_that_begin_one_after_the_other_were_not_silent():
    silent = (0, dict.fromkeys((3, 4, 5), S.STALE))
    late = course(9, 500, silent, (3, dict.fromkeys((3, 4, 5), S.OK)))
    assert told(THREE, outputs(THREE, late)).episodes == ()
    (one,) = told(THREE, outputs(THREE, course(9, 500, silent))).episodes
    assert (one.who, one.state, one.stands) == ("imu_2", "STALE", True)


def test_a_size_has_its_sign_and_one_below_its_error_is_none():
    assert size_words(Size(-0.2, 0.01, "steady", -0.2)) == "-0.200 +- 0.010 rad/s"
    assert size_words(Size(-0.009, 0.01, "steady", -0.2)) == "too small to measure"
    drift = Size(-0.002, 0.01, "growing", -0.009, slope_rad_s2=-0.006)
    assert size_words(drift) == "too small to measure"
    assert (
        size_words(Size(0.009, 0.01, "growing", 0.2))
        == "too small to measure, growing to +0.2 rad/s"
    )
    assert (
        size_words(Size(-0.02, 0.01, "growing", -0.2))
        == "-0.020 +- 0.010 rad/s, growing to -0.2 rad/s"
    )


def test_two_faults_are_two_episodes_and_what_returns_is_over():
    states = course(
        9, 400, (100, {1: S.FAULTY}), (150, {5: S.FAULTY}), (300, {1: S.OK})
    )
    first, second = told(THREE, outputs(THREE, states)).episodes
    assert (first.channels, first.stands, first.duration_s) == (
        ("imu_1.y",),
        False,
        pytest.approx(200 * STEP),
    )
    assert (second.channels, second.stands) == (("imu_2.z",), True)
    assert first.words.startswith("imu_1.y FAULTY from 1.562 s to 4.688 s")


@given(st.lists(st.floats(0.001, 30.0), min_size=1, max_size=60), st.integers(1, 20))
def test_stretches_are_cut_at_gaps_and_nowhere_else(steps, count):
    found: list[list[int]] = [[]]

    class Parts(Sink):
        def begin_stretch(self):
            found.append([])

    stamp, walk = (
        np.cumsum(np.round(np.array(steps) * 1e9)).astype(np.int64),
        Walk(Pipeline(parallel(2)), [Parts()]),
    )
    for part in np.array_split(stamp, count):
        for block in walk.pieces(Block(part, np.zeros((len(part), 6)))):
            found[-1] += block.stamp.tolist()
    assert found == [
        stamp[rows].tolist() for rows in pieces(stamp, EPISODE_TIMES.stretch_gap)
    ]
    assert [at for part in found for at in part] == stamp.tolist()


TIME = np.arange(2000) * 0.01
CHANCE = np.random.default_rng(3).normal(0.0, 0.01, 2000)
RATE = np.sin(TIME)


@pytest.mark.parametrize(
    ("error", "course", "size"),
    [
        (0.1 + CHANCE, "steady", 0.1),
        (0.02 + 0.01 * TIME + CHANCE, "growing", 0.025),
        (0.3 - 0.01 * TIME + CHANCE, "shrinking", 0.295),
        (0.05 * RATE + CHANCE, "proportional", 0.037),
        (20 * CHANCE, "noisy", 0.2),
        (0.1 * np.sign(np.sin(3.7 * TIME + 1.3)) + CHANCE, "varying", 0.1),
        (np.where(TIME < 8, 0.1, 0.0) + CHANCE, "gone", 0.1),
    ],
)
def test_what_an_error_does_over_time(error, course, size):
    batches = Batches(0.0, 0.01)
    for rows in np.array_split(np.arange(2000), 7):
        batches.add(TIME[rows], error[rows], RATE[rows])
    found = batches.size(0.0)
    assert found.course == course
    assert found.rad_s == pytest.approx(
        size, abs=max(0.1 * abs(size), 4 * found.std_rad_s)
    )
    assert (
        (found.gone_s == pytest.approx(8.0, abs=0.3))
        if course == "gone"
        else found.gone_s is None
    )
    if course == "proportional":
        assert found.share_of_rate == pytest.approx(0.05, abs=0.005)


def test_the_standard_error_holds_for_errors_that_hang_together():
    """Noise with a correlation time of 0.2 s: the mean of 20 s is within two standard errors in nine of ten trials."""
    random, decay, count = np.random.default_rng(4), np.exp(-0.01 / 0.2), 400
    noise = np.zeros((2000, count))
    noise[0] = random.normal(0, 1, count)
    for k in range(1, 2000):
        noise[k] = decay * noise[k - 1] + np.sqrt(1 - decay**2) * random.normal(
            0, 1, count
        )
    inside = 0
    for column in 0.5 + 0.05 * noise.T:
        batches = Batches(0.0, 0.05)
        batches.add(TIME, column, 0 * TIME)
        found = batches.size(0.0)
        inside += (
            found.course != "steady" or abs(found.rad_s - 0.5) < 2 * found.std_rad_s
        )
    assert inside / count == pytest.approx(0.93, abs=0.05)


@pytest.mark.parametrize("share", [-1.0, 0.3])
@pytest.mark.parametrize("until", [None, 8.0])
def test_a_share_of_the_rate_that_ends_is_not_mixed_with_what_follows(share, until):
    noise = np.random.default_rng(0).normal(0.0, 0.01, len(TIME))
    wrong = (until or TIME[-1]) >= TIME
    rate = np.sin(3.0 * TIME)
    batches = Batches(0.0, 0.01)
    batches.add(TIME, noise + share * rate * wrong, rate)
    found = batches.size(0.0)
    assert found.course == "proportional"
    assert found.share_of_rate == pytest.approx(share, abs=0.02)
    assert (found.gone_s is None) == (until is None)
    if until is not None:
        assert found.gone_s == pytest.approx(until, abs=0.3)
    # At rest at the end it may go on.
    batches = Batches(0.0, 0.01)
    batches.add(TIME, noise + share * rate * wrong, np.where(wrong, rate, 0.0))
    found = batches.size(0.0)
    assert found.course != "proportional" or found.gone_s is None


# Which declaration is whose doing -------------------------------------------------------------------------------------


GEOMETRY = Geometry.two_triad_cone()
FAULT = "channel=g2 kind=bias size=0.2 start=10 stop=20"


def event(second, channel, after, group=None, before=S.OK):
    return Event(
        round(second * 1e9),
        channel,
        before,
        after,
        Reason.DISAGREES,
        group or (channel,),
        0.1,
    )


def scored(faults, *events):
    """Score a monitor that says nothing but these events: 40 samples, one a second, and fused rates."""
    injector = Injector(
        [parse_fault(text) for text in faults], GEOMETRY.channel_names, 0
    )
    evaluation, second = Evaluation(injector, GEOMETRY), np.arange(40)
    rate = np.column_stack([second, second % 5, 0 * second])
    evaluation.add(
        output_of(6, events, stamp=second * 10**9, rate=rate), np.zeros((40, 3))
    )
    return evaluation.scores()


def test_the_error_counts_as_undetected_up_to_the_sample_of_the_declaration():
    rms = scored([FAULT], event(12, 1, S.FAULTY)).fault_effect_rad_s
    for value, seconds in (
        (rms.before_detection, range(10, 13)),
        (rms.after_detection, range(13, 20)),
    ):
        assert value == pytest.approx(
            np.sqrt(np.mean([k**2 + (k % 5) ** 2 for k in seconds]))
        )


PAIR = [event(12, i, S.AMBIGUOUS, (1, 3)) for i in (1, 3)]
NAMED = event(18, 1, S.FAULTY, before=S.AMBIGUOUS)
UNSEEN = (None, None, ())


WHOSE = {
    "named": (FAULT, [event(12, 1, S.FAULTY)], (12, 12, ("g2",)), []),
    "one of a set": (FAULT, PAIR, (12, None, ("g2", "g4")), []),
    "a set, then named": (FAULT, [*PAIR, NAMED], (12, 18, ("g2", "g4")), []),
    "too early": (FAULT, [event(9, 1, S.FAULTY)], UNSEEN, [("g2", 9)]),
    "too late": (FAULT, [event(22, 1, S.FAULTY)], UNSEEN, [("g2", 22)]),
    "another channel, whatever set stands with it": (
        FAULT,
        [event(11, 4, S.FAULTY, (1, 4))],
        UNSEEN,
        [("g5", 11)],
    ),
    "named later for other reasons is not merged": (
        FAULT.replace("stop=20", ""),
        [*PAIR, NAMED, event(30, 5, S.FAULTY), event(32, 1, S.AMBIGUOUS, (1, 4))],
        (12, 18, ("g2", "g4")),
        [("g6", 30)],
    ),
    "silent, and another that is silent is no false declaration": (
        "channel=g1,g2,g3 kind=triad_loss start=10",
        [*(event(11 + i, i, S.STALE) for i in range(3)), event(30, 5, S.STALE)],
        (11, 13, ("g1", "g2", "g3")),
        [],
    ),
    "hidden for a while is not declared anew": (
        FAULT,
        [
            event(5, 4, S.FAULTY),
            event(25, 4, S.STALE, before=S.FAULTY),
            event(28, 4, S.FAULTY, before=S.STALE),
        ],
        UNSEEN,
        [("g5", 5)],
    ),
    "returned is declared anew": (
        FAULT,
        [
            event(5, 4, S.FAULTY),
            event(25, 4, S.OK, before=S.FAULTY),
            event(28, 4, S.FAULTY),
        ],
        UNSEEN,
        [("g5", 5), ("g5", 28)],
    ),
}
"""A fault, events, when it is detected and isolated and with which channels, and what is declared besides."""


@pytest.mark.parametrize(
    ("faults", "events", "found", "others"), WHOSE.values(), ids=WHOSE.keys()
)
def test_which_declaration_is_whose_doing(faults, events, found, others):
    scores = scored([faults], *events)
    (fault,) = scores.faults
    assert (fault.detected_at_s, fault.isolated_at_s, fault.declared_channels) == found
    assert fault.isolated == (found[1] is not None)
    if found[0] is not None:
        assert fault.delay_s == found[0] - fault.start_s
        assert fault.detected_as == events[0].after.name
        assert fault.isolation_delay_s == (
            None if found[1] is None else found[1] - fault.start_s
        )
    assert [(one.channel, one.at_s) for one in scores.declared] == others


declared = st.lists(
    st.tuples(
        st.integers(10, 39),
        st.integers(0, 5),
        st.sampled_from((S.OK, S.FAULTY, S.AMBIGUOUS)),
    )
)


@given(declared)
def test_what_came_of_a_fault_is_the_same_in_a_replay_and_in_a_sweep(drawn):
    """By the changes of state, and by the states of all samples."""
    drawn.sort(key=lambda one: one[0])
    state, since = np.full((40, 6), S.OK), np.arange(40) - 10.0
    for second, channel, after in drawn:
        state[second:, channel] = after
    # Of several changes at once a sample shows the last.
    last = {(second, channel): after for second, channel, after in drawn}
    (fault,) = scored(
        ["channel=g2 kind=bias size=0.2 start=10"],
        *(event(*at, after) for at, after in last.items()),
    ).faults
    assert (
        fault.outcome
        == score(state == S.FAULTY, state == S.AMBIGUOUS, 1, since).outcome.value
    )


def test_the_healthy_channel_that_a_fault_made_faulty_is_named():
    # Two of three gyros of an axis shift alike: the third is named, and struck by nothing.
    fault = ["channel=g1,g4 kind=bias size=0.1 start=10"]
    doubted = [event(12, i, S.AMBIGUOUS, (0, 5)) for i in (0, 5)]
    told = summary_of(
        replace(
            scored(fault, *doubted, event(14, 5, S.FAULTY, before=S.AMBIGUOUS)),
            samples_judged=40,
        )
    )
    found = verdict_of(told)
    assert (found.severity, found.sentence) == (
        Severity.BAD,
        "1 of 1 injected fault detected, 0 isolated.",
    )
    assert sentences(told)[-1] == "Declared faulty without an injected fault: g6."


def test_sentence_and_table_agree_on_two_faults_at_once():
    faults = [
        "channel=g1 kind=bias size=0.05 start=10",
        "channel=g6 kind=bias size=0.05 start=10",
    ]
    both = [event(12, i, S.AMBIGUOUS, (0, 3, 5)) for i in (0, 3, 5)]
    named = [event(14, i, S.FAULTY, before=S.AMBIGUOUS) for i in (0, 5)]
    told = summary_of(replace(scored(faults, *both, *named), samples_judged=40))
    found = verdict_of(told)
    assert (found.severity, found.sentence) == (
        Severity.GOOD,
        "2 of 2 injected faults detected, 2 isolated.",
    )
    words = "detected after 2 s as one of g1, g4, g6, isolated after 4 s."
    last = "No other channel was declared faulty, but g4 was a candidate for a time."
    assert sentences(told) == [f"bias on g1: {words}", f"bias on g6: {words}", last]
    unjudged = summary_of(replace(told.scores, samples_judged=0))
    assert sentences(unjudged)[-1].startswith(
        "The verdict on all other channels is CANNOT TELL: "
    )
    table = fault_sections(told.scores)[0].content
    assert [row[-4:] for row in table[1]] == [
        ("2000.0 ms", "AMBIGUOUS", "4000.0 ms", "g1, g4, g6")
    ] * 2
    unnamed = summary_of(replace(scored(faults, *both), samples_judged=40))
    assert verdict_of(unnamed).severity is Severity.UNKNOWN
    assert sentences(unnamed)[0].endswith("as one of g1, g4, g6, not isolated.")


def test_a_fault_on_what_is_declared_already_is_not_called_missed():
    (found,) = scored(
        ["channel=g2 kind=bias size=1 start=30"], event(5, 1, S.FAULTY)
    ).faults
    assert (found.declared_before, found.detected_at_s) == (True, None)
    (of_a_unit,) = scored(
        ["channel=g1,g2,g3 kind=triad_loss start=30"], event(5, 1, S.FAULTY)
    ).faults
    assert not of_a_unit.declared_before


@pytest.mark.parametrize(("after", "explained"), [(0.9, True), (1.1, False)])
def test_a_declaration_soon_after_a_fault_is_explained_by_it(after, explained):
    """A second: so long the evidence of a fault may take."""
    one = Followed(parse_fault("channel=g1 kind=bias size=1 start=5 stop=8"), [0], "g1")
    assert one.is_active(8.0 + after) == explained
    assert not one.is_active(4.9)
