# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Alignment of sensor units: what each sample may hold, when it is formed, and that recorded and live are one."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.config.config import Config
from fdi_ros.core.alignment import MAX_BRIDGE, MAX_STAMP, Alignment, as_block
from fdi_ros.core.records import MAX_PENDING
from fdi_ros.errors import ConfigError

MS = 1_000_000
SKEW, TIMEOUT = 2 * MS, 100 * MS
START = 1_700_000_000_000_000_000


def ramp(stamp):
    """A rate that tells its own instant: on a line, so that an interpolated one does as well."""
    seconds = (stamp - START) / 1e9
    return seconds, 2 * seconds, -seconds


def run(messages, units=2, skew=SKEW, timeout=TIMEOUT, flush=False):
    aligner = Alignment(units, skew, timeout)
    samples = [s for j, stamp in messages for s in aligner.push(j, stamp, ramp(stamp))]
    return aligner, samples + (list(aligner.flush()) if flush else [])


def stamps_of(samples):
    return [int(s["stamp"]) for s in samples]


def values(samples, units=2):
    return np.array([s["z"][: 3 * units] for s in samples]).reshape(-1, 3 * units)


def received(samples, units=2):
    """(N, units) whether each unit gave a value."""
    return np.array(
        [s["received"][: 3 * units : 3] for s in samples], dtype=bool
    ).reshape(-1, units)


def waiting(aligner, j):
    """Stamps of the messages of a unit that wait."""
    unit = aligner.rows["units"][0, j]
    numbers = np.arange(unit["begin"], unit["end"])
    return unit["messages"]["stamp"][numbers % len(unit["messages"])].tolist()


def at(*pairs):
    return [(j, START + round(t * MS)) for j, t in pairs]


def rounds(count, period=10.0, units=2, skew=0.0):
    return [(j, k * period + j * skew) for k in range(count) for j in range(units)]


@st.composite
def streams(draw):
    """Units of random rates, phases and jitter, with losses, each in order; merged by delayed arrival."""
    units = draw(st.integers(2, 4))
    messages = []
    for j in range(units):
        period = draw(st.sampled_from([1.0, 2.5, 5.0, 10.0, 16.0]))
        phase = draw(st.floats(0, 20))
        jitter = draw(st.sampled_from([0.0, 0.1, 0.45])) * period
        loss = draw(st.sampled_from([0.0, 0.1, 0.5]))
        delay = draw(st.floats(0, 30))
        rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
        count = int(draw(st.sampled_from([60, 150])) / period)
        ticks = phase + period * np.arange(count) + rng.uniform(-jitter, jitter, count)
        kept = rng.random(count) >= loss
        arrival = np.maximum.accumulate(
            ticks + delay + rng.uniform(0, jitter + 1e-3, count)
        )
        messages += [
            (a, j, START + round(t * MS))
            for a, t in zip(arrival[kept], ticks[kept], strict=True)
        ]
    messages.sort()
    return units, [(j, stamp) for _, j, stamp in messages]


def arrays(messages):
    """Units, stamps and rates of messages."""
    unit, stamps = np.array(messages, dtype=np.int64).reshape(-1, 2).T
    return (
        unit,
        stamps,
        np.array([ramp(stamp) for stamp in stamps.tolist()]).reshape(-1, 3),
    )


def blocks_of(messages, units, cuts):
    aligner, edges, columns = (
        Alignment(units, SKEW, TIMEOUT),
        [0, *sorted(cuts), len(messages)],
        arrays(messages),
    )
    return aligner, [
        aligner.push_block(*(one[a:b] for one in columns))
        for a, b in itertools.pairwise(edges)
    ]


def same(samples, blocks, units):
    assert np.concatenate([b.stamp for b in blocks]).tolist() == stamps_of(samples)
    assert (
        np.vstack([b.z for b in blocks]).tobytes() == values(samples, units).tobytes()
    )
    told = np.vstack([b.delivered for b in blocks])
    np.testing.assert_array_equal(told, np.repeat(received(samples, units), 3, axis=1))


@settings(max_examples=60)
@given(streams())
def test_a_sample_holds_values_of_its_instant_each_once_and_none_is_left_out(case):
    units, messages = case
    aligner, samples = run(messages, units, flush=True)
    stamps = np.array(stamps_of(samples))
    z, here = values(samples, units).reshape(-1, units, 3), received(samples, units)
    assert np.isnan(z[~here]).all()
    # The rate tells its instant: within the skew of the stamp, or exactly it when interpolated.
    true = np.array([ramp(stamp) for stamp in stamps.tolist()]).reshape(-1, 1, 3)
    np.testing.assert_allclose(
        z[here],
        np.broadcast_to(true, z.shape)[here],
        atol=2 * SKEW / 1e9 + 1e-12,
        rtol=0,
    )
    fastest = 1 << 60
    for j in range(units):
        own = np.array([stamp for k, stamp in messages if k == j], dtype=np.int64)
        fastest = min(fastest, np.diff(own).min(initial=1 << 60))
        # No message counts twice as of another instant.
        told = {ramp(stamp)[0]: stamp for stamp in own.tolist()}
        pairs = zip(z[:, j, 0].tolist(), stamps.tolist(), strict=True)
        moved = [value for value, stamp in pairs if told.get(value, stamp) != stamp]
        assert len(moved) == len(set(moved))
        # All that can be formed is formed.
        if not aligner.counters[j]["late"]:
            inside = np.searchsorted(stamps, own[1:], "right") - np.searchsorted(
                stamps, own[:-1], "left"
            )
            assert (inside >= 1).all()
    assert np.diff(stamps).min(initial=1 << 60) >= fastest > 0


@settings(max_examples=12)
@given(streams(), st.lists(st.integers(-100_000, 100_000), min_size=4, max_size=4))
def test_late_stamps_with_their_delays_are_the_stream_without_lateness(case, lateness):
    units, messages = case
    unit, stamps, rates = arrays(messages)
    delays = [1e-6 * d for d in lateness[:units]]
    right, corrected = (
        Alignment(units, SKEW, TIMEOUT),
        Alignment(units, SKEW, TIMEOUT, delays),
    )
    late = stamps + 1000 * np.array(lateness)[unit]
    for expected, block in (
        (
            right.push_block(unit, stamps, rates),
            corrected.push_block(unit, late, rates),
        ),
        (as_block(right.flush(), units), as_block(corrected.flush(), units)),
    ):
        assert block.stamp.tobytes() == expected.stamp.tobytes()
        assert block.z.tobytes() == expected.z.tobytes()
    assert corrected.counters == right.counters


@settings(max_examples=50)
@given(streams())
def test_a_sample_comes_as_soon_as_every_live_unit_has_spoken_for_it(case):
    units, messages = case
    aligner = Alignment(units, SKEW, TIMEOUT)
    newest = {}
    # How far each other unit has come since the last message of one.
    since = np.zeros((units, units), dtype=np.int64)
    for j, stamp in messages:
        aligner.push(j, stamp, ramp(stamp))
        step = stamp - newest.get(j, stamp)
        since[:, j] += step if step <= TIMEOUT else 0
        since[j], newest[j] = 0, stamp
        live = [k for k in range(units) if since[k].max() <= TIMEOUT]
        assert all(aligner.is_live(k) <= (k in live) for k in range(units))
        spoken = min(newest.get(k, -1) for k in live)
        # No stamp that all live units have reached is left without a sample near it or at it.
        for k in range(units):
            assert not [s for s in waiting(aligner, k)[1:] if s <= spoken]


@settings(max_examples=50)
@given(streams(), st.lists(st.integers(0, 200), max_size=4))
def test_a_recording_gives_the_samples_of_the_live_stream_wherever_it_is_cut(
    case, cuts
):
    units, messages = case
    live, samples = run(messages, units)
    recorded, blocks = blocks_of(messages, units, [min(c, len(messages)) for c in cuts])
    same(samples, blocks, units)
    assert live.rows.tobytes() == recorded.rows.tobytes()
    same(live.flush(), [as_block(recorded.flush(), units)], units)
    assert live.rows.tobytes() == recorded.rows.tobytes()


anything = st.one_of(
    st.integers(-(2**31), 2**31),
    st.integers(0, 40).map(lambda k: k * MS),
    st.integers(1 - MAX_STAMP, MAX_STAMP - 1),
    st.sampled_from([1 - MAX_STAMP, MAX_STAMP - 1]),
)


@settings(max_examples=120)
@given(
    st.lists(st.tuples(st.integers(0, 3), anything), max_size=120),
    st.sampled_from([(SKEW, TIMEOUT), (0, 1)]),
)
def test_any_stamps_at_all_give_increasing_samples_and_every_message_is_counted(
    messages, spans
):
    aligner, samples = run(messages, 4, *spans, flush=True)
    assert all(a < b for a, b in itertools.pairwise(stamps_of(samples)))
    # Without its shift a sample stands at the stamp of a message, and shift or not, at most one at each message.
    assert {int(s["stamp"] - s["shift"]) for s in samples} <= {
        stamp for _, stamp in messages
    }
    assert len(samples) <= len(messages)
    assert sum(count["received"] for count in aligner.counters) == len(messages)
    # Where two clocks have gone apart what there is of a sample is not given, and yet not missing.
    empty = sum(not s["received"].any() for s in samples)
    for j in range(4):
        own = [s for s in samples if s["received"][3 * j]]
        counts = aligner.counters[j]
        refused = sum(counts[kind] for kind in ("duplicate", "backward", "jumped"))
        assert (
            len(own)
            <= counts["received"]
            - refused
            + counts["interpolated"]
            + aligner.rows["restarts"][0]
        )
        assert 0 <= len(samples) - len(own) - counts["missing"] <= empty


@pytest.mark.parametrize("stamp", [MAX_STAMP, -MAX_STAMP, 2**63 - 1, -(2**63)])
def test_a_stamp_that_no_message_can_have_changes_nothing(stamp):
    aligner, _ = run(at(*rounds(5)))
    before, rate = aligner.rows.tobytes(), aligner.rows["rate"].copy()
    for j in (0, 1, 2, -1):
        assert len(aligner.push(j, stamp, ramp(START))) == 0
    assert len(aligner.push(2, START, ramp(START))) == 0
    aligner.rows["rate"] = rate  # of the message on its way, which nothing remembers
    assert aligner.rows.tobytes() == before


TENS = [10.0 * k for k in range(60)]
ALONE = [(0, t) for t in TENS[:30]]


def without(*lost, count=30, period=10.0):
    """Rounds of two units without some messages of the second."""
    return [
        m for m in rounds(count, period) if m not in [(1, period * k) for k in lost]
    ]


SLOWEST = MAX_BRIDGE * TIMEOUT / MS


@pytest.mark.parametrize(
    ("messages", "formed", "restarts", "counted"),
    [
        # One lost message is bridged, two are not.
        (without(10), TENS[:30], 0, {1: {"interpolated": 1, "missing": 0}}),
        (without(10, 11), TENS[:30], 0, {1: {"interpolated": 0, "missing": 2}}),
        # A silent unit comes back by itself: with the message for which it was not waited any more.
        (without(*range(11, 40), count=60), TENS, 0, {1: {"missing": 30}}),
        # At 1 kHz the next message is within the skew of 2 ms, and is not taken for the one lost.
        (
            without(10, period=1.0),
            [float(k) for k in range(30)],
            0,
            {1: {"interpolated": 1}},
        ),
        # No span is bridged beyond its share of the timeout.
        (
            without(*range(1, 20, 2), period=SLOWEST / 2),
            None,
            0,
            {1: {"interpolated": 10}},
        ),
        (
            without(*range(1, 20, 2), period=SLOWEST / 2 + 0.5),
            None,
            0,
            {1: {"interpolated": 0}},
        ),
        # A clock too far behind: the rest goes on, as it does, after a wait, with one that is a little behind.
        (
            [m for t in TENS for m in ((0, t), (1, t - 5000.0))],
            TENS,
            0,
            {1: {"late": 60}},
        ),
        ([m for t in TENS for m in ((0, t), (1, t - 45.0))], None, 0, {1: {"late": 0}}),
        # Stamps go back and are repeated, and never enter.
        (
            [
                *rounds(20)[:21],
                (0, 40.0),
                (0, 100.0),
                (1, 90.0),
                (1, 80.0),
                *rounds(20)[21:],
            ],
            TENS[:20],
            0,
            {j: {"backward": 1, "duplicate": 1} for j in range(2)},
        ),
        # A pause of all is gone over at once.
        (
            rounds(20) + [(j, t + 6e4) for j, t in rounds(20)],
            TENS[:20] + [t + 6e4 for t in TENS[:20]],
            1,
            {},
        ),
        # All clocks set back shift the time base.
        (
            rounds(20) + [(j, t - 36e5) for j, t in rounds(20)],
            TENS[:20] + [t - 36e5 for t in TENS[:20]],
            1,
            {},
        ),
        # The only unit left is believed after the timeout.
        (
            ALONE + [(0, t - 9000) for _, t in ALONE],
            TENS[:30] + [t - 9000 for t in TENS[10:30]],
            1,
            {0: {"backward": 11}},
        ),
        # A unit that never speaks is waited for once.
        (ALONE, TENS[:30], 0, {1: {"received": 0, "missing": 30}}),
        # One wild stamp of the only unit left changes nothing.
        ([*ALONE[:20], (0, 1e9), (0, -1e9), *ALONE[20:]], TENS[:30], 0, {}),
    ],
)
def test_what_stamps_bring_about_is_counted_and_the_rest_goes_on(
    messages, formed, restarts, counted
):
    aligner, samples = run(at(*messages))
    # Without the shift that keeps time from stepping back.
    assert formed in (
        None,
        [(int(s["stamp"] - s["shift"]) - START) / MS for s in samples],
    )
    assert np.diff(stamps_of(samples)).min() > 0
    assert aligner.rows["restarts"][0] == restarts
    assert samples[-1]["shift"] == aligner.shift
    z, whole = values(samples), received(samples).all(axis=1)
    np.testing.assert_allclose(z[whole, 3], z[whole, 0])
    for j, counts in counted.items():
        assert {kind: aligner.counters[j][kind] for kind in counts} == counts


def test_a_flood_of_one_nanosecond_steps_never_has_more_than_so_many_wait():
    aligner, _ = run([(1, 0)])
    for k in range(3 * MAX_PENDING):
        aligner.push(0, k, (0.0, 0.0, 0.0))
        assert len(waiting(aligner, 0)) <= MAX_PENDING


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        (
            {"imus.delays": [0.004]},
            r"imus.delays has 1 values, expected 0 or 2 \(one per triad\)",
        ),
        ({"imus.delays": [0.0, 0.2]}, r"imus.delays.* 0.2.* -0.1 to 0.1"),
        (
            {"imus.delays": [0.004], "input": "channels"},
            r"imus.delays is given, but input is 'channels'",
        ),
    ],
)
def test_delays_that_do_not_fit_are_refused(parameters, words):
    with pytest.raises(ConfigError, match=words):
        Config.from_parameters(
            {"input": "imus", "imus.topics": ["/a", "/b"], **parameters}
        )


CLOCKS = {
    "fast": ("jumped", lambda seconds: 1.0002 * seconds),
    "slow": ("late", lambda seconds: 0.9998 * seconds),
    "much too fast": ("jumped", lambda seconds: 1.05 * seconds),
    "much too slow": ("late", lambda seconds: 0.95 * seconds),
    # From 2 s on every message just less than the timeout ahead of the one before.
    "leaping": (
        "jumped",
        lambda s: s + 0.99e-9 * TIMEOUT * np.maximum(np.arange(len(s)) - 200, 0),
    ),
    "random": (
        "backward",
        lambda s: s + np.random.default_rng(1).uniform(-1.0, 1.0, len(s)),
    ),
    "of another time": ("jumped", lambda seconds: seconds + 5e6),
}
"""As what messages with the stamps of a clock are counted, and the clock."""


def clocks_of(clock, odd, units):
    """At 100 Hz, (N, units) s, one of them odd: such as are hardly wrong part after minutes."""
    count = 72_000 if clock in ("fast", "slow") else 6000
    clocks = np.arange(count)[:, None] * 0.01 + 0.001 * np.arange(units)
    clocks += np.random.default_rng(odd).uniform(0, 3e-4, clocks.shape)
    right = clocks.copy()
    clocks[:, odd] = CLOCKS[clock][1](clocks[:, odd])
    return clocks, right


def through(aligner, clocks, order=None):
    """Block of messages of all units at once, stamped by clocks (N, units) in s; in the order of arrival."""
    count, units = clocks.shape
    order = slice(None) if order is None else order
    stamp = START + np.round(1e9 * clocks.ravel()[order]).astype(np.int64)
    return aligner.push_block(
        np.tile(np.arange(units), count)[order], stamp, np.zeros((count * units, 3))
    )


@pytest.mark.parametrize("odd", [0, 2])
@pytest.mark.parametrize("clock", CLOCKS)
def test_of_three_clocks_the_odd_one_is_left_out_and_the_others_stay(clock, odd):
    clocks, right = clocks_of(clock, odd, 3)
    arrival = (
        right + np.random.default_rng(odd).uniform(0, 0.005, right.shape)
    ).ravel()
    aligner = Alignment(3, SKEW, TIMEOUT)
    given = (
        through(aligner, clocks, np.argsort(arrival))
        .delivered[-3000:, ::3]
        .mean(axis=0)
    )
    others = [j for j in range(3) if j != odd]
    assert given[odd] < 0.05
    assert (given[others] > 0.99).all()
    assert aligner.counters[odd][CLOCKS[clock][0]] > 500
    assert all(
        aligner.counters[j][other] <= 2
        for j in others
        for other in ("late", "jumped", "backward")
    )


@pytest.mark.parametrize(
    ("late", "refused"), [(0.06, False), (0.08, False), (0.13, True)]
)
def test_a_unit_is_ahead_only_if_it_is_so_at_one_instant(late, refused):
    """Two of three units arrive late, s, over a link that also stops for 0.09 s.

    The third unit is then 0.17 s ahead of their last stamps, and not of their clocks.
    """
    aligner = Alignment(3, SKEW, TIMEOUT)
    seconds = np.arange(600) * 0.01
    over_link = seconds + late
    over_link[(over_link >= 3.0) & (over_link < 3.09)] = 3.09
    arrival = np.column_stack([seconds, over_link, over_link])
    clocks = seconds[:, None] + 0.0005 * np.arange(3)
    order = np.argsort(arrival.ravel(), kind="stable")
    given = through(aligner, clocks, order).delivered[:, ::3]
    lost = [counters["jumped"] + counters["late"] for counters in aligner.counters]
    assert lost[0] == 0
    assert given[:, 0].all()
    assert [count > 500 for count in lost[1:]] == [refused] * 2
    assert (lost[1:] == [0, 0]) != refused
    assert given.all() != refused


@pytest.mark.parametrize("odd", [0, 1])
@pytest.mark.parametrize("clock", [*CLOCKS][:5])
def test_of_two_clocks_that_go_apart_none_is_believed_alone(clock, odd):
    aligner = Alignment(2, SKEW, TIMEOUT)
    block = through(aligner, clocks_of(clock, odd, 2)[0])
    assert block.delivered[:100].any(axis=1).all()
    given = block.delivered[-1000:, ::3]
    # A clock that leaps shows by itself that it is the wrong one.
    assert given[:, 1 - odd].all() == given[:, 1 - odd].any() == (clock == "leaping")
    assert not given[:, odd].any()
    assert aligner.are_parted == (clock != "leaping")


def test_two_clocks_that_come_together_again_are_believed_again():
    seconds = np.arange(3000) * 0.01
    apart = (
        np.interp(seconds, [5.0, 10.0, 15.0, 20.0], [0.0, 2.0, 2.0, 0.0])
        * TIMEOUT
        / 1e9
    )
    block = through(
        Alignment(2, SKEW, TIMEOUT), np.column_stack([seconds, seconds + 0.001 - apart])
    )
    given, at = block.delivered[:, ::3], (block.stamp - START) / 1e9
    assert given[(at < 5.0) | (at > 20.0)].all()
    assert not given[(at > 9.0) & (at < 16.0)].any()


JUMPS = [
    [m for t in range(1000, 3000, 10) for m in ((0, float(t)), (1, t + jump))]
    for jump in (5e3, 5e2, -150, -5e2, -5e3)
]
HELD_UP = [(0, float(t)) for t in range(1000, 2000, 10)]
HELD_UP += [m for t in range(2000, 3000, 10) for m in ((0, float(t)), (1, t - 1000.0))]
"""The link of the second unit keeps its messages for a second, and then delivers them one after the other."""


@pytest.mark.parametrize("later", [*JUMPS, HELD_UP])
def test_of_two_units_one_that_jumps_or_was_held_up_costs_the_other_nothing(later):
    aligner, samples = run(at(*rounds(100), *later))
    assert not aligner.are_parted
    assert received(samples)[:, 0].all()
    assert later is HELD_UP or not received(samples)[110:, 1].any()
