# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Properties of the whole pipeline: the same for every cut, never a NaN published, honest about what it cannot do.

And its decision over time, against a plain account of the same rules over whole windows.
"""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor.streams import (
    SIGMA,
    START,
    body_rate,
    config,
    declarations,
    parallel,
    run,
    seconds,
    stream,
)

from fdi_ros.compiling.compiled import allocate
from fdi_ros.config.config import Config
from fdi_ros.core.decision import decide
from fdi_ros.core.records import Decision, Evidence, PathSettings
from fdi_ros.core.subsets import is_in, mask_of
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import ConfigError
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState, Output, Reason
from fdi_ros.monitor.pipeline import EVENTS, Pipeline

FIELDS = (
    "stamp",
    "rate",
    "covariance",
    "valid",
    "statistic",
    "threshold",
    "alarm",
    "state",
    "residual",
    "level",
)


def joined(parts: list[Output]) -> Output:
    events = [event for part in parts for event in part.events]
    return Output(np.concatenate([part.rows for part in parts]), parts[0].n, events)


def same(left: Output, right: Output) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(
            getattr(left, name), getattr(right, name), err_msg=name
        )
    assert list(left.events) == list(right.events)


def cut(block: Block, at: list[int]) -> list[Block]:
    edges = [0, *sorted(at), len(block)]
    return [block[a:b] for a, b in itertools.pairwise(edges) if b > a]


def troubled(pipeline: Pipeline, seed: int, samples: int = 300) -> Block:
    """A stream with everything in it: faults, NaN, missing units, spikes out of range, repeated values."""
    rng = np.random.default_rng(seed)
    block = stream(pipeline.geometry, samples, seed=seed)
    n = pipeline.geometry.n
    z, received = block.z, block.delivered
    for _ in range(rng.integers(1, 5)):
        channel, start = rng.integers(n), rng.integers(samples)
        stop = start + rng.integers(1, 150)
        kind = rng.integers(6)
        if kind == 0:
            z[start:stop, channel] += rng.choice([0.02, 0.3, 50.0])
        elif kind == 1:
            z[start:stop, channel] = rng.choice([np.nan, np.inf, -np.inf, 1e300])
        elif kind == 2:
            received[start:stop, channel - channel % 3 : channel - channel % 3 + 3] = (
                False
            )
        elif kind == 3:
            z[start:stop, channel] = z[start, channel]
        elif kind == 4:
            z[start:stop] = z[start]
        else:
            z[start:stop] += rng.normal(0, 1, z[start:stop].shape)
    stamp = block.stamp + np.cumsum(rng.integers(0, 2, samples) * 1_000_000)
    return Block(stamp, z, received)


SETTINGS: list[Config] = [
    config(),
    config(
        decision__latch=False,
        decision__clean_time=0.2,
        noise__scale_std=0.01,
        noise__timing_std=5e-4,
    ),
    parallel(3, detector__name="max_residual", health__stuck_time_at_rest=0.3),
    parallel(
        2,
        bias__startup_bias_duration=0.5,
        bias__max_rest_rate=10.0,
        noise__timing_std=1e-4,
    ),
    config(detector__name="guaranteed", geometry__preset="dodecahedron"),
]
OF_FIVE = config(
    detector__name="determinant", geometry__preset="cone", geometry__cone_channels=5
)
EVERY: list[Config] = [
    *SETTINGS,
    *(
        config(detector__name=name, detector__run_length=1e4)
        for name in sorted({*DETECTORS} - {"determinant"})
    ),
    OF_FIVE,
    parallel(
        3, noise__timing_std=2e-4, decision__latch=False, decision__clean_time=0.5
    ),
]
CUTS = [1, 40, 41, 150, 222], list(range(300))


@pytest.mark.parametrize("at", CUTS, ids=["anywhere", "at every sample"])
@pytest.mark.parametrize(("seed", "which"), [*enumerate(EVERY)], ids=range(len(EVERY)))
def test_cutting_the_stream_anywhere_changes_nothing(seed, which, at):
    """With every detector, and after losses too: nothing may differ, to the last bit and counter."""
    whole, pieces = Pipeline(which), Pipeline(which)
    block = troubled(whole, seed)
    same(
        whole.process(block), joined([pieces.process(part) for part in cut(block, at)])
    )
    assert repr(whole.status()) == repr(pieces.status())


ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from(
    [0.0, np.nan, np.inf, 34.9]
)


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(SETTINGS),
    st.lists(ANY_FLOAT, min_size=1),
)
@settings(max_examples=25)
def test_never_a_nan_in_a_published_rate(seed, which, junk):
    pipeline = Pipeline(which)
    rng = np.random.default_rng(seed)
    block = stream(pipeline.geometry, 60, seed=seed % 1000)
    z = np.where(
        rng.random(block.z.shape) < rng.random(),
        rng.choice(junk, block.z.shape),
        block.z,
    )
    received = rng.random(block.z.shape) < rng.choice([0.5, 0.99, 1.0])
    output = pipeline.process(Block(block.stamp, z, received))
    assert np.isfinite(output.rate[output.valid]).all()
    assert np.isfinite(output.covariance[output.valid]).all()
    assert np.isnan(output.rate[~output.valid]).all()
    assert (np.linalg.eigvalsh(output.covariance[output.valid]) > 0).all()


def test_gyros_better_than_their_settings_have_a_covariance_that_is_little_too_large():
    """The settings allow for errors of scale and for nonlinearity, which this stream does not have: 2.1 for 3."""
    pipeline = Pipeline(config())
    block = stream(pipeline.geometry, 20_000)
    output = pipeline.process(block)
    error = output.rate - body_rate(20_000)
    normalised = np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(output.covariance), error
    )
    # Mean of a chi-square with 3 degrees of freedom over 20 000 samples: standard error 0.017.
    assert 2.0 < normalised.mean() < 3.06
    std = np.sqrt(np.trace(output.covariance[-1]))
    assert 0.9 < std / (SIGMA * pipeline.geometry.gdop) < 1.5


@pytest.mark.parametrize("mounting", ["cone", "parallel"])
@pytest.mark.parametrize("name", ["likelihood_ratio", "sequential"])
def test_the_fused_rate_is_as_good_as_its_covariance_says(name, mounting):
    """Of gyros with errors as the settings state them: biases, scale and axes are drawn anew for each flight."""
    scale = 0.003
    given = {
        "detector__name": name,
        "noise__scale_std": scale,
        "bias__turn_on_std": SIGMA,
    }
    which = config(**given) if mounting == "cone" else parallel(2, **given)
    rate, rows, found = body_rate(300), [20, 100, 200, 299], []
    pipeline = Pipeline(which)
    for seed in range(60):
        pipeline.restart()
        rng, axes = np.random.default_rng(seed), pipeline.geometry.axes
        axes = axes + rng.normal(0.0, scale, axes.shape)
        z = rate @ axes.T + rng.normal(0.0, SIGMA, len(axes))
        z += rng.normal(0.0, SIGMA, z.shape)
        output = pipeline.process(Block(START + np.arange(300) * 10_000_000, z))
        error = (output.rate - rate)[rows]
        inverse = np.linalg.inv(output.covariance[rows])
        found.append(np.einsum("ni,nij,nj->n", error, inverse, error))
    # The mean of a chi-square with 3 degrees of freedom over 60 flights: standard error 0.32.
    mean = np.mean(found, axis=0)
    assert (mean > 2.0).all()
    assert (mean < 4.0).all()


def test_second_and_third_fault_down_to_detection_only():
    pipeline = Pipeline(config(geometry__preset="dodecahedron"))
    faults = [
        "channel=g1 kind=bias size=0.5 start=2",
        "channel=g4 kind=bias size=-0.5 start=5",
    ]
    _, output = run(pipeline, 1000, *faults)
    assert declarations(pipeline, output) == [("g1", "FAULTY"), ("g4", "FAULTY")]
    status = pipeline.status()
    assert status.can_isolate == ()
    assert set(status.can_detect) == {"g2", "g3", "g5", "g6"}
    _, output = run(
        pipeline, 1000, *faults, "channel=g2 kind=bias size=0.5 start=0.01", late=20.0
    )
    assert set(declarations(pipeline, output)) == {
        (name, "AMBIGUOUS") for name in ("g2", "g3", "g5", "g6")
    }


@pytest.mark.parametrize(
    ("out", "unchecked", "words"),
    [
        # Two parallel triads, one channel taken out: a fault of its twin would go unseen.
        (["imu_1.x"], {"imu_2.x"}, "imu_2.x"),
        (
            ["imu_1.x", "imu_1.y", "imu_1.z"],
            {"imu_2.x", "imu_2.y", "imu_2.z"},
            "3 channels",
        ),
    ],
)
def test_what_nothing_checks_gives_a_rate_and_is_not_called_healthy(
    out, unchecked, words
):
    pipeline = Pipeline(parallel(2, excluded_channels=out))
    output = pipeline.process(stream(pipeline.geometry, 100))
    status = pipeline.status()
    assert output.valid.all()
    states = {c.name: c.state for c in status.channels if c.name not in out}
    assert states == {
        name: ChannelState.UNCHECKED if name in unchecked else ChannelState.OK
        for name in states
    }
    assert not unchecked & set(status.can_detect)
    assert words in status.note


@pytest.mark.parametrize(
    ("units", "share", "wrong"),
    [
        (2, 0.0, set()),
        (2, 0.04, set()),
        (2, 0.12, {"imu_1.y", "imu_2.y"}),
        (3, 0.04, set()),
        (3, -0.12, {"imu_1.y", "imu_2.y", "imu_3.y"}),
    ],
)
def test_a_scale_error_that_was_learned_is_told(units, share, wrong):
    """It is corrected, and declared only if it begins in motion."""
    settings = {"detector__name": "sequential", "noise__scale_std": 0.01}
    pipeline = Pipeline(parallel(units, **settings))
    block = stream(pipeline.geometry, 2000)
    block.z[:, 4] *= 1.0 + share
    assert not [event for event in pipeline.process(block).events if event.declares]
    status = pipeline.status()
    found = status.certain_scale_errors()
    assert {name for name, one in found.items() if one.size} == wrong
    if wrong:
        # Half of the difference of two, and two thirds of that of one to two others.
        expected = share * (units - 1) / units
        assert found["imu_2.y"].size == pytest.approx(expected, rel=0.15)
    assert all(str(error) for error in status.errors)


def test_a_detector_that_cannot_run_on_the_channels_left_says_so():
    pipeline = Pipeline(OF_FIVE)
    run(pipeline, 500, "channel=g2 kind=bias size=0.5 start=1")
    status = pipeline.status()
    others = {(c.state, c.reason) for c in status.channels if c.name != "g2"}
    assert others == {(ChannelState.UNCHECKED, Reason.CANNOT_RUN)}
    assert "5" in status.note


@pytest.mark.parametrize("lasts", [False, True])
def test_a_reset_clears_what_is_over_and_what_lasts_is_declared_again(lasts):
    pipeline = Pipeline(config())
    block, _ = run(pipeline, 1000, "channel=g4 kind=bias size=0.5 start=5 stop=9")
    assert pipeline.status().channels[3].state == ChannelState.FAULTY
    pipeline.reset()
    rows = np.s_[600:900] if lasts else np.s_[:100]
    output = pipeline.process(Block(block.stamp[rows] + 20_000_000_000, block.z[rows]))
    assert declarations(pipeline, output) == ([("g4", "FAULTY")] if lasts else [])
    # All are unchecked after a hole until it is known how the body moves.
    assert lasts or [e.after.name for e in output.events if e.channel == 3] == [
        "UNCHECKED",
        "OK",
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"excluded_channels": ["g9"]}, "g9"),
        ({"excluded_channels": ["g1", "g2", "g3", "g5"]}, "do not span"),
        ({"decision.latch": False}, "latch cannot change"),
        # Too high for this sample rate: seen only after the detector was built.
        (
            {"detector.false_alarms_per_hour": 3.6e6},
            "false-alarm probability per sample is 10",
        ),
        (
            {"noise.acceleration_window": 0.8, "sample_rate": 2000.0},
            "1600 samples at 2000 Hz, expected at most 1000",
        ),
    ],
)
def test_a_change_that_is_refused_changes_nothing(change, words):
    pipeline = Pipeline(config(detector__name="guaranteed"))
    before = pipeline.detector, pipeline.config, pipeline.core.tobytes()
    with pytest.raises(ConfigError, match=words):
        pipeline.reconfigure(pipeline.config.replaced(change))
    assert (pipeline.detector, pipeline.config, pipeline.core.tobytes()) == before


@pytest.mark.parametrize("detector", ["sequential", "likelihood_ratio"])
def test_channels_are_excluded_without_preparing_all_anew(detector):
    """A live node is deaf meanwhile; and what it says is what one that was built so says."""
    options = {"detector__name": detector, "bias__fixed": [0.0] * 6}
    pipeline, built = (
        Pipeline(config(**options)),
        Pipeline(config(**options, excluded_channels=["g4"])),
    )
    pipeline.prepare()
    prepared = (
        pipeline.detector,
        pipeline.integrity,
        pipeline.subsets["has_level"].sum(),
    )
    pipeline.reconfigure(built.config)
    assert (
        pipeline.detector,
        pipeline.integrity,
        pipeline.subsets["has_level"].sum(),
    ) == prepared
    said, expected = (
        run(one, 1000, "channel=g2 kind=bias size=0.5 start=5")[1]
        for one in (pipeline, built)
    )
    assert declarations(pipeline, said) == declarations(built, expected) != []
    np.testing.assert_array_equal(said.rate, expected.rate)
    np.testing.assert_array_equal(said.level, expected.level)
    # And back.
    pipeline.reconfigure(pipeline.config.replaced({"excluded_channels": []}))
    late = stream(pipeline.geometry, 100, late=20.0)
    assert (pipeline.process(late).state[-1, [0, 2, 3]] == ChannelState.OK).all()


def test_steps_end_where_something_happens_and_events_say_the_row_of_their_sample():
    pipeline, whole = Pipeline(config()), Pipeline(config())
    block, output = run(whole, 1000, "channel=g4 kind=bias size=0.5 start=5")
    assert [output.stamp[event.row] for event in output.events] == [
        event.stamp for event in output.events
    ]
    assert output.alarm[500]
    assert np.abs(output.rate - body_rate(1000)).max() < 6 * SIGMA, (
        "never fused, from its first alarm on"
    )
    seen = []
    for step in pipeline.steps(block):
        assert all(
            event.stamp == step.stamp[-1] and event.row == len(step) - 1
            for event in step.events
        )
        if any(event.declares for event in step.events):
            assert pipeline.status().channels[3].state == ChannelState.FAULTY
        seen += [
            (event.channel, event.after.name, seconds(event)) for event in step.events
        ]
    assert seen[-2:] == [
        (3, "SUSPECT", pytest.approx(5.0)),
        (3, "FAULTY", pytest.approx(5.03)),
    ]
    assert seen == [
        (event.channel, event.after.name, seconds(event)) for event in output.events
    ]


@pytest.mark.parametrize(
    ("block", "words"),
    [
        (Block(np.array([START]), np.zeros((1, 5))), "expected .N, 6."),
        (Block(np.array([START, START]), np.zeros((2, 6))), "do not increase"),
        (
            Block(np.array([0, 2**63], dtype=np.uint64), np.zeros((2, 6))),
            "expected within",
        ),
        (Block(np.array([-(2**62)]), np.zeros((1, 6))), "expected within"),
        (Block(np.array([START]), np.zeros((1, 6))), "does not come after"),
    ],
)
def test_what_is_no_stream_is_refused(block, words):
    pipeline = Pipeline(config())
    empty = pipeline.process(stream(pipeline.geometry, 0))
    assert (len(empty), empty.state.shape) == (0, (0, 6))
    pipeline.process(stream(pipeline.geometry, 10))
    before = pipeline.core.tobytes()
    for take in (pipeline.process, pipeline.steps):
        with pytest.raises(ConfigError, match=words):
            take(block)
    assert pipeline.core.tobytes() == before


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        (
            (np.arange(10), np.zeros((9, 6))),
            "stamps have shape .10,. of int64, expected .9,. whole numbers, ns",
        ),
        ((np.array([0.1, 0.2]), np.zeros((2, 6))), "of float64"),
        (
            (np.arange(2), np.zeros(2)),
            "samples have shape .2,. of float64, expected .N, n. real numbers",
        ),
        ((np.arange(2), np.zeros((2, 6), dtype=complex)), "complex128, expected"),
        (
            (np.arange(10), np.zeros((10, 6)), np.ones((2, 6), dtype=bool)),
            "received has shape .2, 6. of bool",
        ),
        ((np.arange(2), np.zeros((2, 6)), "all"), "received has shape .. of"),
    ],
)
def test_arrays_that_do_not_fit_are_no_block(arrays, words):
    with pytest.raises(ConfigError, match=words):
        Block(*arrays)


def test_any_memory_layout_gives_the_same():
    block = stream(Pipeline(config()).geometry, 50)
    usual = Pipeline(config()).process(block)
    for z in (np.asfortranarray(block.z), np.repeat(block.z, 2, axis=0)[::2]):
        same(Pipeline(config()).process(Block(block.stamp.astype(np.uint64), z)), usual)


def test_more_events_than_are_written_down_at_once():
    """Values that are now and then not finite bring events in every other sample."""
    pipeline = Pipeline(config())
    block = stream(pipeline.geometry, 9000)
    lost = np.random.default_rng(3).random(block.z.shape) < 0.05
    loud = Block(block.stamp, np.where(lost, np.nan, block.z))
    output = pipeline.process(loud)
    assert len(output.events) > 2 * EVENTS
    pieces = Pipeline(pipeline.config)
    same(output, joined([pieces.process(part) for part in cut(loud, [7, 400, 1999])]))


@given(latch=st.booleans(), seed=st.integers(0, 1000))
@settings(max_examples=10)
def test_states_follow_from_the_events(latch, seed):
    """Replaying the events gives the states: nothing changes without being told."""
    pipeline = Pipeline(parallel(3, decision__latch=latch, decision__clean_time=0.3))
    block = troubled(pipeline, seed)
    output = pipeline.process(block)
    state = np.full(output.state.shape, ChannelState.UNCHECKED)
    for event in output.events:
        assert state[event.row, event.channel] == event.before
        state[event.row :, event.channel] = event.after
    np.testing.assert_array_equal(state, output.state)


DOUBTS = ((ChannelState.FAULTY,), (ChannelState.SUSPECT, ChannelState.AMBIGUOUS))


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", ["sequential", "cusum", "max_residual"])
def test_no_level_vouches_for_a_channel_in_doubt(name, seed):
    """Sample by sample: what is FAULTY is not fused, and with what is SUSPECT or AMBIGUOUS there is no level."""
    under_doubt = seed % 2 == 0
    pipeline = Pipeline(
        config(
            detector__name=name,
            decision__latch=seed % 3 > 0,
            publish_under_doubt=under_doubt,
        )
    )
    for block in cut(troubled(pipeline, seed), list(range(1, 300))):
        output, fused = pipeline.process(block), int(pipeline.core["now"]["fused"][0])
        in_state = [
            sum(1 << int(i) for i in np.flatnonzero(np.isin(output.state[0], states)))
            for states in DOUBTS
        ]
        assert not output.valid[0] or not fused & in_state[0]
        assert not (fused & in_state[1]) or not np.isfinite(output.level[0]).any()
        assert under_doubt or not output.valid[0] or not fused & in_state[1]


N = 5
SETS = [(), (0,), (1,), (0, 1), (2, 3), (0, 1, 2, 3, 4)]
ALL = mask_of(range(N))


class Decider:
    """The decision, told of one sample after the other."""

    def __init__(self, alarms, window):
        self.limits, self.own, self.seen = (
            allocate(PathSettings),
            allocate(Decision),
            allocate(Evidence),
        )
        for name, value in {
            "n": N,
            "alarms": alarms,
            "window": window,
            "latch": True,
        }.items():
            self.limits[name] = value
        self.stamp = 0

    def take(self, members, isolated=False, **more):
        """Whether a sample whose alarm names these channels changes what is declared."""
        self.stamp += 1
        told = {
            "suspected": mask_of(members),
            "isolated": mask_of(members) if isolated else 0,
            "judged": True,
            "checked": ALL,
        }
        for name in self.seen.dtype.names:
            self.seen[name] = {**told, "stamp": self.stamp, **more}.get(name, 0)
        return decide(self.limits[0], self.own[0], self.seen[0])

    def channels(self, name):
        return {i for i in range(N) if is_in(i, int(self.own[name][0]))}


def by_hand(sets, isolated, alarms, window):
    """First row that declares, and what: ('faulty' | 'ambiguous', channels)."""
    for row in range(len(sets)):
        recent = range(max(0, row - window + 1), row + 1)
        named = [sum(i in sets[k] for k in recent) for i in range(N)]
        alone = [sum(i in sets[k] and isolated[k] for k in recent) for i in range(N)]
        half = -(-alarms // 2)
        faulty = {i for i in range(N) if named[i] >= alarms and alone[i] >= half}
        often = {i for i in range(N) if named[i] >= half}
        if not faulty and max(named) >= alarms and len(often) == 1:
            faulty = often
        if faulty:
            return row, "faulty", faulty
        if max(named) >= alarms:
            return row, "ambiguous", often
        if sum(bool(sets[k]) for k in recent) == window:
            return row, "ambiguous", often or {i for i in range(N) if named[i]}
    return None


@given(
    data=st.lists(
        st.tuples(st.sampled_from(SETS), st.booleans()), min_size=1, max_size=40
    ),
    alarms=st.integers(1, 5),
    extra=st.integers(0, 5),
)
@settings(max_examples=80)
def test_first_declaration_is_the_one_found_by_hand(data, alarms, extra):
    decider, window = Decider(alarms, alarms + extra), alarms + extra
    expected = by_hand(*zip(*data, strict=True), alarms, window)
    declares = next(
        (row for row, sample in enumerate(data) if decider.take(*sample)), None
    )
    if expected is None:
        assert declares is None
    else:
        row, kind, channels = expected
        assert (declares, decider.channels(kind)) == (row, channels)


def test_a_set_narrows_down_to_the_channel_that_later_evidence_singles_out():
    decider, history = Decider(2, 4), []
    for members, alone in [((0, 1), False)] * 3 + [((1,), True)] * 3:
        decider.take(members, isolated=alone)
        history.append((decider.channels("ambiguous"), decider.channels("faulty")))
    assert ({0, 1}, set()) in history
    assert history[-1] == (set(), {1})


def test_alarms_held_off_are_suspicion_and_never_a_declaration():
    decider, changes = Decider(2, 4), []
    for held in (True, True, True, True, False, False):
        changes.append(decider.take((1,), isolated=True, no_votes=held))
        assert decider.channels("suspicion") == {1}
    assert changes == [False] * 5 + [True]
