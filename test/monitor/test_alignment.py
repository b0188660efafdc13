"""Alignment of triads: what each sample may hold, when it is formed, and that recorded and live are one."""

from __future__ import annotations

import itertools
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.errors import ConfigError
from fdi_ros.monitor.alignment import MAX_PENDING, Aligner, Sample
from fdi_ros.monitor.triad import MAX_BRIDGE

MS = 1_000_000
SKEW, TIMEOUT = 2 * MS, 100 * MS
START = 1_700_000_000_000_000_000


def ramp(stamp: int) -> tuple[float, float, float]:
    """A rate that tells its own instant: on a line, so that an interpolated one does as well."""
    seconds = (stamp - START) / 1e9
    return seconds, 2 * seconds, -seconds


def run(messages, triads=2, skew=SKEW, timeout=TIMEOUT, flush=False):
    aligner = Aligner(triads, skew, timeout)
    samples = [s for j, stamp in messages for s in aligner.push(j, stamp, ramp(stamp))]
    return aligner, samples + (aligner.flush() if flush else [])


def ms(samples: list[Sample]) -> list[float]:
    return [(s.stamp - START) / MS for s in samples]


def at(*pairs: tuple[int, float]) -> list[tuple[int, int]]:
    return [(j, START + round(t * MS)) for j, t in pairs]


def rounds(count, period=10.0, triads=2, skew=0.0):
    return [(j, k * period + j * skew) for k in range(count) for j in range(triads)]


@st.composite
def streams(draw):
    """Triads of random rates, phases and jitter, with losses, each in order; merged by delayed arrival."""
    triads = draw(st.integers(2, 4))
    messages = []
    for j in range(triads):
        period = draw(st.sampled_from([1.0, 2.5, 5.0, 10.0, 16.0]))
        phase = draw(st.floats(0, 20))
        jitter = draw(st.sampled_from([0.0, 0.1, 0.45])) * period
        loss = draw(st.sampled_from([0.0, 0.1, 0.5]))
        delay = draw(st.floats(0, 30))
        rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
        count = int(draw(st.sampled_from([60, 150])) / period)
        ticks = phase + period * np.arange(count) + rng.uniform(-jitter, jitter, count)
        kept = rng.random(count) >= loss
        arrival = np.maximum.accumulate(ticks + delay + rng.uniform(0, jitter + 1e-3, count))
        messages += [(a, j, START + round(t * MS)) for a, t in zip(arrival[kept], ticks[kept], strict=True)]
    messages.sort()
    return triads, [(j, stamp) for _, j, stamp in messages]


def blocks_of(messages, triads, cuts=(), skew=SKEW, timeout=TIMEOUT):
    aligner = Aligner(triads, skew, timeout)
    triad_of = np.array([j for j, _ in messages], dtype=np.int64)
    stamps = np.array([stamp for _, stamp in messages], dtype=np.int64)
    rates = np.array([ramp(stamp) for _, stamp in messages]).reshape(-1, 3)
    edges = [0, *sorted(cuts), len(messages)]
    blocks = [aligner.push_block(triad_of[a:b], stamps[a:b], rates[a:b]) for a, b in itertools.pairwise(edges)]
    return aligner, blocks


def same(samples: list[Sample], blocks) -> None:
    stamp = np.concatenate([b.stamp for b in blocks])
    assert stamp.tolist() == [s.stamp for s in samples]
    z = np.vstack([b.z for b in blocks])
    np.testing.assert_array_equal(z, np.array([s.z for s in samples]).reshape(z.shape))
    received = np.vstack([np.ones(b.z.shape, bool) if b.received is None else b.received for b in blocks])
    expected = [[True] * z.shape[1] if s.received is None else s.received for s in samples]
    np.testing.assert_array_equal(received, np.array(expected, bool).reshape(z.shape))


@settings(max_examples=150, deadline=None)
@given(streams())
def test_a_sample_holds_only_values_of_its_own_instant_and_stamps_increase(case) -> None:
    triads, messages = case
    _, samples = run(messages, triads, flush=True)
    stamps = [s.stamp for s in samples]
    assert all(a < b for a, b in itertools.pairwise(stamps))
    for sample in samples:
        value = ramp(sample.stamp)
        for j in range(triads):
            got = sample.z[3 * j : 3 * j + 3]
            if sample.received is not None and not sample.received[3 * j]:
                assert all(map(math.isnan, got))
            else:
                # The rate tells its instant: within the skew of the stamp, or exactly it when interpolated.
                np.testing.assert_allclose(got, value, atol=2 * SKEW / 1e9 + 1e-12, rtol=0)


@settings(max_examples=150, deadline=None)
@given(streams())
def test_no_message_is_used_twice_as_it_is(case) -> None:
    triads, messages = case
    _, samples = run(messages, triads, flush=True)
    stamps_of = [{stamp for k, stamp in messages if k == j} for j in range(triads)]
    for j in range(triads):
        used = [s.z[3 * j] for s in samples if s.z[3 * j] in {ramp(stamp)[0] for stamp in stamps_of[j]}]
        assert len(used) == len(set(used))


@settings(max_examples=150, deadline=None)
@given(streams())
def test_all_that_can_be_formed_is_formed_and_never_faster_than_the_fastest(case) -> None:
    triads, messages = case
    aligner, samples = run(messages, triads, flush=True)
    stamps = np.array([s.stamp for s in samples])
    for j in range(triads):
        own = np.array([stamp for k, stamp in messages if k == j])
        if aligner.counters[j].late or not len(own):
            continue
        inside = np.searchsorted(stamps, own[1:], "right") - np.searchsorted(stamps, own[:-1], "left")
        assert (inside >= 1).all()
    fastest = min(np.diff([s for k, s in messages if k == j]).min(initial=1 << 60) for j in range(triads))
    assert np.diff(stamps).min(initial=1 << 60) >= fastest


@settings(max_examples=150, deadline=None)
@given(streams())
def test_a_sample_comes_as_soon_as_every_live_triad_has_spoken_for_it(case) -> None:
    triads, messages = case
    aligner = Aligner(triads, SKEW, TIMEOUT)
    formed: list[int] = []
    newest: dict[int, int] = {}
    for j, stamp in messages:
        out = aligner.push(j, stamp, ramp(stamp))
        newest[j] = max(stamp, newest.get(j, stamp))
        frontier = max(newest.values())
        formed += [s.stamp for s in out]
        live = [k for k in range(triads) if frontier - newest.get(k, messages[0][1]) <= TIMEOUT]
        spoken = min(newest.get(k, -1) for k in live)
        # No stamp that all live triads have reached is left without a sample near it or at it.
        for k in range(triads):
            waiting = [m.stamp for m in aligner._triads[k].pending]
            owed = [s for s in waiting[1:] if s <= spoken]
            assert not owed


@settings(max_examples=100, deadline=None)
@given(streams(), st.lists(st.integers(0, 200), max_size=4))
def test_a_recording_gives_the_samples_of_the_live_stream(case, cuts) -> None:
    triads, messages = case
    live, samples = run(messages, triads)
    recorded, blocks = blocks_of(messages, triads, [min(c, len(messages)) for c in cuts])
    same(samples, blocks)
    assert repr(live.flush()) == repr(recorded.flush())
    assert live.counters == recorded.counters


@settings(max_examples=200, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 1), st.one_of(st.integers(-(2**31), 2**31), st.integers(0, 40).map(lambda k: k * MS))),
        max_size=120,
    )
)
def test_any_stamps_at_all_give_increasing_samples_and_the_same_recorded(messages) -> None:
    messages = [(j, stamp * 1 if abs(stamp) < 2**40 else 0) for j, stamp in messages]
    live, samples = run(messages, 2)
    assert all(a.stamp < b.stamp for a, b in itertools.pairwise(samples))
    recorded, blocks = blocks_of(messages, 2)
    same(samples, blocks)
    assert live.counters == recorded.counters
    assert sum(c.received for c in live.counters) == len(messages)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 30), st.integers(-3, 3)), min_size=20, max_size=300))
def test_rounds_with_any_damage_are_the_same_recorded(damage) -> None:
    clean = [(j, START + k * 10 * MS + j * MS // 4) for k in range(300) for j in range(3)]
    for j, where, shift in damage:
        clean[(where * 29 + j) % len(clean)] = (j % 3, clean[(where * 29 + j) % len(clean)][1] + shift * 5 * MS)
    live, samples = run(clean, 3)
    recorded, blocks = blocks_of(clean, 3, [100, 101, 500])
    same(samples, blocks)
    assert live.counters == recorded.counters
    assert live.base.__dict__ == recorded.base.__dict__


def test_equal_stamps_form_a_sample_with_the_last_message_of_the_round() -> None:
    aligner = Aligner(3, SKEW, TIMEOUT)
    for j, stamp in at(*rounds(5, triads=3)):
        out = aligner.push(j, stamp, ramp(stamp))
        assert [s.stamp for s in out] == ([stamp] if j == 2 else [])
        assert all(s.received is None for s in out)


def test_stamps_within_the_skew_count_as_one_instant() -> None:
    _, samples = run(at(*rounds(5, skew=1.5)))
    assert ms(samples) == [0, 10, 20, 30, 40]
    assert samples[2].z[0] == pytest.approx(0.020)
    assert samples[2].z[3] == pytest.approx(0.0215)


def test_beyond_the_skew_the_slower_one_is_interpolated_to_the_faster() -> None:
    fast = [(0, 5.0 * k) for k in range(12)]
    slow = [(1, 3.0 + 10 * k) for k in range(6)]
    aligner, samples = run(at(*sorted(fast + slow, key=lambda m: m[1])), skew=MS)
    assert ms(samples) == [5.0 * k for k in range(11)]
    assert samples[4].z[3] == pytest.approx(0.020)
    assert aligner.counters[1].interpolated == 10


def test_one_lost_message_is_bridged_and_two_are_not() -> None:
    def lose(*lost):
        return run(at(*[m for m in rounds(30) if m not in [(1, 10.0 * k) for k in lost]]))

    aligner, samples = lose(10)
    assert ms(samples) == [10.0 * k for k in range(30)]
    assert samples[10].received is None
    assert aligner.counters[1].interpolated == 1
    aligner, samples = lose(10, 11)
    assert samples[10].received == samples[11].received == [True] * 3 + [False] * 3
    assert aligner.counters[1].missing == 2


def test_the_one_after_a_lost_message_is_not_taken_for_it() -> None:
    # At 1 kHz the next message is within the skew of 2 ms.
    messages = [m for m in rounds(30, period=1.0) if m != (1, 10.0)]
    _, samples = run(at(*messages))
    assert ms(samples) == [float(k) for k in range(30)]
    assert all(s.z[3] == pytest.approx(s.z[0]) for s in samples)


def test_a_silent_triad_holds_the_rest_up_once_for_the_timeout_and_comes_back_by_itself() -> None:
    messages = [m for m in rounds(60) if not (m[0] == 1 and 100 < m[1] < 400)]
    aligner = Aligner(2, SKEW, TIMEOUT)
    wait = []
    for j, stamp in at(*messages):
        wait += [(stamp - s.stamp) / MS for s in aligner.push(j, stamp, ramp(stamp))]
    assert len(wait) == 60
    assert max(wait) == TIMEOUT / MS
    assert list(wait[30:]) == [0.0] * 30
    # 29 lost, and the one with which it came back: nobody waited for that.
    assert aligner.counters[1].missing == 30
    assert aligner.is_live(1)


def test_a_triad_that_never_speaks_is_waited_for_once() -> None:
    aligner, samples = run(at(*[(0, 10.0 * k) for k in range(30)]))
    assert ms(samples) == [10.0 * k for k in range(30)]
    assert not aligner.is_live(1)
    assert all(s.received == [True] * 3 + [False] * 3 for s in samples)


def test_clock_offset_is_waited_out_and_named() -> None:
    messages = [m for k in range(60) for m in [(0, 10.0 * k), (1, 10.0 * k - 45.0)]]
    aligner, samples = run(at(*messages))
    assert aligner.base.lag == [0, 45 * MS]
    assert all(s.z[3] == pytest.approx(s.z[0]) for s in samples if s.received is None)
    assert len(samples) > 50


def test_a_clock_too_far_behind_is_counted_late_and_the_rest_goes_on() -> None:
    messages = [m for k in range(60) for m in [(0, 10.0 * k), (1, 10.0 * k - 5000.0)]]
    aligner, samples = run(at(*messages))
    assert aligner.counters[1].late == 60
    assert aligner.base.lag[1] == 5000 * MS
    assert len(samples) == 60
    assert aligner.base.restarts == 0


def test_one_clock_that_jumps_ahead_is_refused_and_the_other_goes_on() -> None:
    messages = rounds(20) + [m for k in range(20, 60) for m in [(0, 10.0 * k + 7000.0), (1, 10.0 * k)]]
    aligner, samples = run(at(*messages))
    assert aligner.counters[0].jumped == 40
    assert ms(samples) == [10.0 * k for k in range(60)]
    assert aligner.base.restarts == 0


def test_backward_and_repeated_stamps_are_counted_and_never_enter() -> None:
    messages = rounds(20)
    messages[21:21] = [(0, 40.0), (0, 100.0), (1, 90.0), (1, 80.0)]
    aligner, samples = run(at(*messages))
    assert ms(samples) == [10.0 * k for k in range(20)]
    assert (aligner.counters[0].backward, aligner.counters[0].duplicate) == (1, 1)
    assert (aligner.counters[1].backward, aligner.counters[1].duplicate) == (1, 1)


def test_a_pause_of_all_is_gone_over_at_once() -> None:
    messages = rounds(20) + [(j, t + 60_000) for j, t in rounds(20)]
    aligner, samples = run(at(*messages))
    assert aligner.base.restarts == 1
    assert aligner.base.shift == 0
    assert ms(samples) == [10.0 * k for k in range(20)] + [60_000 + 10.0 * k for k in range(20)]


def test_all_clocks_set_back_shift_the_time_base_and_samples_still_increase() -> None:
    messages = rounds(20) + [(j, t - 3_600_000) for j, t in rounds(20)]
    aligner, samples = run(at(*messages))
    assert aligner.base.restarts == 1
    assert all(a.stamp < b.stamp for a, b in itertools.pairwise(samples))
    assert len(samples) == 40
    assert samples[-1].stamp - samples[-1].shift == START + round((190 - 3_600_000) * MS)


def test_the_only_triad_left_is_believed_after_the_timeout() -> None:
    messages = [(0, 10.0 * k) for k in range(30)] + [(0, 10.0 * k - 9000) for k in range(30)]
    aligner, samples = run(at(*messages), 2)
    assert aligner.base.restarts == 1
    assert aligner.counters[0].backward == 11
    assert len(samples) == 30 + 20


def test_one_wild_stamp_of_the_only_triad_left_changes_nothing() -> None:
    messages = [(0, 10.0 * k) for k in range(30)]
    messages[20:20] = [(0, 1e9), (0, -1e9)]
    aligner, samples = run(at(*messages))
    assert ms(samples) == [10.0 * k for k in range(30)]
    assert aligner.base.restarts == 0


def test_memory_is_bounded_by_a_flood_of_one_nanosecond_steps() -> None:
    aligner = Aligner(2, SKEW, TIMEOUT)
    aligner.push(1, 0, (0.0, 0.0, 0.0))
    for k in range(20_000):
        aligner.push(0, k, (0.0, 0.0, 0.0))
    assert len(aligner._triads[0].pending) <= MAX_PENDING


def test_nan_is_handed_on_as_delivered() -> None:
    aligner = Aligner(2, SKEW, TIMEOUT)
    aligner.push(0, 0, (math.nan, math.inf, 1.0))
    (sample,) = aligner.push(1, 0, (0.0, 0.0, 0.0))
    assert sample.received is None
    assert math.isnan(sample.z[0])


def test_a_span_is_never_bridged_beyond_its_share_of_the_timeout() -> None:
    period = MAX_BRIDGE * TIMEOUT / MS + 1
    fast = [(0, 5.0 * k) for k in range(60)]
    slow = [(1, 1.0 + period * k) for k in range(10)]
    aligner, _ = run(at(*sorted(fast + slow, key=lambda m: m[1])), skew=0)
    assert aligner.counters[1].interpolated == 0


def test_millions_of_regular_messages_a_second() -> None:
    count = 200_000
    triad_of = np.tile(np.array([0, 1, 2]), count)
    stamps = START + np.repeat(np.arange(count) * MS, 3)
    begin = time.perf_counter()
    block = Aligner(3, SKEW, TIMEOUT).push_block(triad_of, stamps, np.zeros((3 * count, 3)))
    assert len(block) == count
    # 10 M/s on an idle core; a busy machine is allowed a tenth.
    assert time.perf_counter() - begin < 0.6


@pytest.mark.parametrize(("triads", "skew", "timeout"), [(0, 0, 1), (2, -1, 1), (2, 0, 0)])
def test_impossible_settings_are_refused(triads, skew, timeout) -> None:
    with pytest.raises(ConfigError, match="cannot align"):
        Aligner(triads, skew, timeout)
