# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What every registered detector must do, whatever its method."""

import math
import re
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from detectors.detector_trials import (
    FIVE,
    VARIANTS,
    alarms,
    random_axes,
    usual_geometry,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros import FdiError, Geometry, NoiseModel, create_detector
from fdi_ros.core.judging import LARGEST_RATE
from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.detectors.base import MOST_ROWS, Detector, Verdict, accepted_options
from fdi_ros.errors import DetectorError

SIGMA = 1e-3
CONSTANT = NoiseModel(SIGMA, bound=SIGMA)
MOVING = NoiseModel(SIGMA, scale_std=2e-3, timing_std=3e-4, bound=4 * SIGMA)
NAMES = sorted(DETECTORS)
ANY_NUMBER = sorted(set(NAMES) - {"determinant"})
LASTING = {"sequential": 200 * SIGMA}
"""Error of a channel without which a method gives no alarm in noise with single wild values, rad/s."""
SINGLE_FAULT = sorted(
    set(ANY_NUMBER) - {"guaranteed", "likelihood_ratio", "cusum", "sequential"}
)
RATE_OPTIONS = [
    name
    for name in NAMES
    if "false_alarm_probability" in accepted_options(detector_class(name))
]
RUN_LENGTHS = ("cusum", "sequential")

BY_SETS = [variant for variant in VARIANTS if not detector_class(variant[0]).takes_any]
"""With a memory of its own for each set of channels."""

each = pytest.mark.parametrize("name", NAMES)
each_variant = pytest.mark.parametrize(("name", "options"), VARIANTS, ids=str)


def detector_of(name, noise=CONSTANT, lopsided=False, **options):
    """A detector without memory of earlier tests; building one anew takes longer than most tests."""
    detector = built(name, noise, lopsided, tuple(options.items()))
    detector.reset()
    return detector


@cache
def built(name, noise, lopsided, options):
    geometry = usual_geometry(name)
    if lopsided:
        geometry = random_axes(np.random.default_rng(geometry.n), geometry.n)
    return create_detector(name, geometry, noise, **dict(options))


def stream(rng, geometry, rows):
    """Noisy samples in motion with some faults of all sizes, and the angular acceleration."""
    rate = np.cumsum(rng.normal(0, 0.05, (rows, 3)), axis=0)
    z = rate @ geometry.axes.T + rng.normal(0, SIGMA, (rows, geometry.n))
    at_fault = rng.random(rows) < 0.3
    z[np.arange(rows), rng.integers(geometry.n, size=rows)] += at_fault * rng.normal(
        0, 20 * SIGMA, rows
    )
    return z, rng.normal(0, 5.0, (rows, 3))


def lose(rng, z, share):
    gone = rng.random(z.shape) < share
    z[gone] = rng.choice([np.nan, np.inf, -np.inf], size=int(gone.sum()))


def faulty(geometry, channel, size=50 * SIGMA, samples=40):
    z = np.tile(geometry.axes @ [0.3, -0.2, 0.5], (samples, 1))
    z[:, channel] += size
    return z


def in_pieces(detector, z, acceleration, cuts):
    edges = [0, *sorted(cuts), len(z)]
    parts = [
        detector.detect(z[a:b], None if acceleration is None else acceleration[a:b])
        for a, b in pairwise(edges)
    ]
    return Verdict(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def assert_same_bits(one, other):
    for field, a, b in zip(Verdict._fields, one, other, strict=True):
        assert a.tobytes() == b.tobytes(), f"{field} differs"


@each
@pytest.mark.parametrize("rows", [0, 1, 2, 33])
def test_shapes_and_types(name, rows):
    detector = detector_of(name)
    z, _ = stream(np.random.default_rng(rows), detector.geometry, rows)
    before = z.copy()
    verdict = detector.detect(z)
    for field, array in zip(Verdict._fields, verdict, strict=True):
        per_channel = field in ("suspects", "error", "scores")
        assert array.shape == (z.shape if per_channel else (rows,)), field
        assert array.dtype == (
            np.bool_ if field in ("alarm", "suspects", "isolated") else np.float64
        ), field
    assert np.array_equal(z, before), "detect must not write to its argument"
    for layout in (np.asfortranarray(z), np.repeat(z, 2, axis=0)[::2]):
        assert_same_bits(verdict, detector_of(name).detect(layout))


@each_variant
@pytest.mark.parametrize("noise", [CONSTANT, MOVING], ids=["constant", "moving"])
def test_fields_agree_with_each_other(name, options, noise):
    detector = detector_of(name, noise, lopsided=True, **options)
    if name == "sequential" and not noise.constant:
        pytest.skip(
            "a motion that changes from sample to sample explains more than the fault"
        )
    z, acceleration = stream(np.random.default_rng(11), detector.geometry, 2000)
    z[1000:1100, 1] += LASTING.get(name, 20 * SIGMA)
    lose(np.random.default_rng(12), z, 0.02)
    verdict = detector.detect(z, acceleration)
    assert 10 < verdict.alarm.sum() < 1990
    assert np.array_equal(verdict.alarm, verdict.statistic >= verdict.threshold)
    assert np.array_equal(np.isnan(verdict.statistic), np.isnan(verdict.threshold))
    assert np.array_equal(verdict.suspects.any(axis=1), verdict.alarm)
    assert not (verdict.isolated & ~verdict.alarm).any()
    assert not verdict.error[~verdict.suspects].any()
    assert np.isfinite(verdict.error).all()
    assert not verdict.suspects[~np.isfinite(z)].any()
    assert np.isnan(verdict.scores[~np.isfinite(z)]).all()


@each
@pytest.mark.parametrize("shape", [(3,), (3, 4), (2, 3, 6)])
def test_wrong_shape_is_refused(name, shape):
    with pytest.raises(DetectorError, match="expected"):
        detector_of(name).detect(np.zeros(shape))


@each_variant
@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    cuts=st.lists(st.integers(0, 60), max_size=8),
    lost=st.sampled_from([0.0, 0.03, 0.3]),
    noise=st.sampled_from([CONSTANT, MOVING]),
    lopsided=st.booleans(),
)
def test_how_a_stream_is_cut_changes_nothing(
    name, options, seed, cuts, lost, noise, lopsided
):
    rng = np.random.default_rng(seed)
    detector = detector_of(name, noise, lopsided, **options)
    z, turning = stream(rng, detector.geometry, 60)
    lose(rng, z, lost)
    acceleration = None if noise is CONSTANT else turning
    whole = detector.detect(z, acceleration)
    detector.reset()
    assert_same_bits(whole, in_pieces(detector, z, acceleration, cuts))


def on_channels(detector, kept):
    """The same method on some of the channels, or why it cannot run on them."""
    try:
        geometry, noise = detector.geometry.subset(kept), detector.noise.subset(kept)
        return create_detector(detector.name, geometry, noise, **detector.options)
    except FdiError as refusal:
        return str(refusal)


@pytest.mark.parametrize(("name", "options"), BY_SETS, ids=str)
@pytest.mark.parametrize("noise", [CONSTANT, MOVING], ids=["constant", "moving"])
def test_channels_present_judge_as_if_built_alone(name, options, noise):
    detector = detector_of(name, noise, lopsided=True, **options)
    rng, judged = np.random.default_rng(13), 0
    z, acceleration = stream(rng, detector.geometry, 300)
    lose(rng, z, 0.15)
    verdict = detector.detect(z, acceleration)
    present = np.isfinite(z)
    for kept in np.unique(present, axis=0):
        rows = np.flatnonzero((present == kept).all(axis=1))
        part = Verdict(*(field[rows] for field in verdict))
        alone = on_channels(detector, kept)
        if isinstance(alone, str):
            assert detector.refusals[int(kept @ (1 << np.arange(len(kept))))] == alone
            assert np.isnan([part.statistic, *part.scores.T]).all()
            assert not part.alarm.any()
            continue
        expected = alone.detect(
            np.ascontiguousarray(z[rows][:, kept]), acceleration[rows]
        )
        of_channels = {
            f: getattr(part, f)[:, kept] for f in ("suspects", "error", "scores")
        }
        assert_same_bits(part._replace(**of_channels), expected)
        judged += len(rows)
    assert judged > 100


@pytest.mark.parametrize("gone", [(0,), (4,), (1, 5)])
def test_without_some_throughout_it_is_as_if_built_without_them(gone):
    detector = detector_of("sequential", MOVING, lopsided=True)
    z, _ = stream(np.random.default_rng(23), detector.geometry, 1000)
    z[700:, 2] += LASTING["sequential"]
    kept = np.array([i not in gone for i in range(z.shape[1])])
    alone = on_channels(detector, kept)
    assert isinstance(alone, Detector)
    expected = alone.detect(np.ascontiguousarray(z[:, kept]))
    z[:, ~kept] = np.nan
    verdict = detector.detect(z)
    np.testing.assert_allclose(verdict.statistic, expected.statistic, rtol=1e-6)
    assert np.array_equal(verdict.suspects[:, kept], expected.suspects)
    assert verdict.alarm.any()


@each
@pytest.mark.parametrize("left", [0, 1, 3])
def test_too_few_channels_is_not_healthy_but_unknown(name, left):
    detector = detector_of(name)
    z, _ = stream(np.random.default_rng(14), detector.geometry, 5)
    z[:, left:] = np.nan
    verdict = detector.detect(z)
    assert np.isnan(verdict.statistic).all()
    assert np.isnan(verdict.threshold).all()
    assert not verdict.alarm.any()


def test_more_sets_of_channels_than_are_kept():
    detector = create_detector(
        "max_residual", Geometry.cone(10), CONSTANT, tolerance="paper"
    )
    rng = np.random.default_rng(15)
    z, _ = stream(rng, detector.geometry, 1 << 10)
    lost = np.arange(1 << 10)[:, None] >> np.arange(10) & 1
    z[lost == 1] = np.nan
    first, again = detector.detect(z), detector.detect(z[::-1])
    assert np.isfinite(first.statistic).sum() > MOST_ROWS
    assert_same_bits(first, Verdict(*(field[::-1] for field in again)))


@each_variant
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_fault_of_50_sigma_is_named_on_every_isolable_channel(name, options, sign):
    """Its size is exact without noise; `sequential` allows for errors of scale beside it, which takes 4e-6 off."""
    rel = 1e-5 if name == "sequential" else 1e-9
    geometry = usual_geometry(name)
    assert geometry.isolable.all()
    for channel in range(geometry.n):
        # By evidence a name has to stand for a while.
        verdict = detector_of(name, **options).detect(
            faulty(geometry, channel, sign * 50 * SIGMA, 120)
        )
        assert verdict.alarm[-1]
        assert verdict.isolated[-1]
        assert np.flatnonzero(verdict.suspects[-1]).tolist() == [channel]
        assert verdict.error[-1, channel] == pytest.approx(sign * 50 * SIGMA, rel=rel)


@each_variant
@pytest.mark.parametrize("noise", [CONSTANT, MOVING], ids=["constant", "moving"])
def test_value_no_gyro_can_measure(name, options, noise):
    """The squares of such values would overflow, and a NaN statistic is no alarm."""
    acceleration = np.ones((40, 3))
    for channel in range(usual_geometry(name).n):
        wild = faulty(usual_geometry(name), channel, 0.0)
        wild += np.random.default_rng(17).normal(0, SIGMA, wild.shape)
        wild[5:, channel] = LARGEST_RATE
        verdict = detector_of(name, noise, **options).detect(wild, acceleration)
        assert verdict.alarm[-1]
        # At rest, or nearly, the condition number is documented to name wrongly.
        assert (
            verdict.suspects[-1, channel]
            or options.get("criterion") == "condition_number"
        )
        assert np.isfinite(verdict.error).all()
        for size in (1e7, 1e160, 1e308):
            wild[5:, channel] = size
            assert_same_bits(
                verdict, detector_of(name, noise, **options).detect(wild, acceleration)
            )


@each
def test_no_alarm_without_noise(name):
    """Not even in the rounding of single precision, after a long time of none."""
    rate = np.cumsum(np.random.default_rng(17).normal(0, 0.05, (2000, 3)), axis=0)
    z = np.vstack([np.zeros((10_000, 3)), rate]) @ usual_geometry(name).axes.T
    assert (
        not detector_of(name)
        .detect(z.astype(np.float32).astype(np.float64))
        .alarm.any()
    )


def unequal(seed, n):
    """Random axes, channels of unequal noise."""
    rng = np.random.default_rng(seed)
    return random_axes(rng, n), NoiseModel(rng.uniform(0.5e-3, 2e-3, n))


SEARCHES = (
    "mean_abs_residual",
    "mean_square_residual",
    "rate_deviation",
    "max_residual",
)
SLOWLY = NoiseModel(SIGMA, scale_std=1e-3, timing_std=1e-4)
CONE, DODECAHEDRON, PAPER = (
    Geometry.two_triad_cone(),
    Geometry.dodecahedron(),
    Geometry(FIVE),
)
FOUR, UNLIKE = (
    NoiseModel([1e-3, 2e-3, 1e-3, 0.5e-3]),
    NoiseModel(SIGMA * np.array([1.0, 2.0, 0.5, 1.0, 4.0, 1.0])),
)
AS_MANY = [
    *((name, usual_geometry(name), CONSTANT, 1e-2) for name in RATE_OPTIONS),
    *((name, Geometry.cone(4), FOUR, 1e-2) for name in SEARCHES),
    *(
        (name, geometry, CONSTANT, 1e-3)
        for name in SEARCHES
        for geometry in (CONE, DODECAHEDRON)
    ),
    *(
        ("projector", random_axes(np.random.default_rng(n), n), CONSTANT, 1e-3)
        for n in (5, 6, 7, 9, 12)
    ),
    *(("recursive", *unequal(n, n), 1e-3) for n in (4, 5, 6, 9)),
    ("determinant", *unequal(6, 5), 1e-3),
    ("likelihood_ratio", DODECAHEDRON, UNLIKE, 1e-3),
    ("likelihood_ratio", CONE, CONSTANT, 1e-5),
    *((name, CONE, SLOWLY, 1e-3) for name in (*SEARCHES, "recursive")),
    ("projector", DODECAHEDRON, SLOWLY, 1e-3),
    ("determinant", PAPER, SLOWLY, 1e-3),
    *(
        ("likelihood_ratio", geometry, MOVING, 1e-3)
        for geometry in (CONE, random_axes(np.random.default_rng(3), 7))
    ),
]
LOPSIDED = {n: random_axes(np.random.default_rng(3), n) for n in (5, 6)}
HARDLY_MORE = [
    *(
        (name, LOPSIDED[usual_geometry(name).n], noise)
        for name in RATE_OPTIONS
        for noise in (CONSTANT, MOVING)
    ),
    *((name, *unequal(12, 7)) for name in SEARCHES),
]


@pytest.mark.parametrize(("name", "geometry", "noise", "probability"), AS_MANY)
def test_as_many_false_alarms_as_asked_for(name, geometry, noise, probability):
    """Above three parity dimensions the threshold itself is an estimate, good to about 1 %."""
    detector = create_detector(
        name, geometry, noise, false_alarm_probability=probability
    )
    rows = 200_000 if probability > 1e-4 else 3_000_000
    standard_error = math.sqrt(rows * probability * (1 - probability))
    off = alarms(detector, noise, rows, geometry.n) - rows * probability
    assert abs(off) <= (3.0 if noise.constant else 3.5) * standard_error


@pytest.mark.parametrize(("name", "geometry", "noise"), HARDLY_MORE)
def test_false_alarms_are_hardly_more_nor_far_fewer_on_any_axes(name, geometry, noise):
    rows, probability = 100_000, 0.01
    detector = create_detector(
        name, geometry, noise, false_alarm_probability=probability
    )
    assert 0.5 < alarms(detector, noise, rows, 1) / (rows * probability) < 1.1


@pytest.mark.parametrize("name", [*RATE_OPTIONS, *RUN_LENGTHS])
def test_a_rate_per_hour_is_a_probability_per_sample_or_a_run_length(name):
    per_sample = (
        {"run_length": 1e5}
        if name in RUN_LENGTHS
        else {"false_alarm_probability": 1e-5}
    )
    per_hour = {"false_alarms_per_hour": 3.6, "sample_rate": 100.0}
    one, other = (
        create_detector(name, usual_geometry(name), CONSTANT, **options)
        for options in (per_hour, per_sample)
    )
    z = np.zeros((1, one.geometry.n))
    assert one.detect(z).threshold == pytest.approx(other.detect(z).threshold, rel=1e-9)
    assert name not in RUN_LENGTHS or detector_of(name).run_length == 3.6e8


def last_verdicts(name, geometry, **options):
    """Of a large fault of each channel in turn, the last sample's verdict."""
    detector = create_detector(name, geometry, CONSTANT, **options)
    for channel in range(geometry.n):
        detector.reset()
        verdict = detector.detect(faulty(geometry, channel))
        yield channel, Verdict(*(field[-1] for field in verdict))


TRIADS, PAIR = (
    Geometry.from_triads([np.eye(3)] * 2),
    [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0.6, 0.8], [0, -0.6, 0.8]],
)
ALIKE = [
    *((name, {}, TRIADS, [[0, 3], [1, 4], [2, 5]] * 2) for name in ANY_NUMBER),
    *((name, {}, Geometry.cone(4), [[0, 1, 2, 3]] * 4) for name in ANY_NUMBER),
    *(
        ("determinant", {"criterion": one}, Geometry(PAIR), [[0, 1]] * 2)
        for one in ("determinant", "condition_number")
    ),
]


@pytest.mark.parametrize(("name", "options", "geometry", "alike"), ALIKE)
def test_channels_that_look_alike_are_suspects_together_and_none_is_isolated(
    name, options, geometry, alike
):
    for suspects, (_, last) in zip(
        alike, last_verdicts(name, geometry, **options), strict=False
    ):
        assert last.alarm
        assert not last.isolated
        assert np.flatnonzero(last.suspects).tolist() == suspects


@pytest.mark.parametrize("name", ANY_NUMBER)
def test_three_parallel_triads(name):
    for channel, last in last_verdicts(name, Geometry.from_triads([np.eye(3)] * 3)):
        assert last.alarm
        assert last.suspects[channel]
        # Two wrong channels that agree look like one right one: only methods that assume one fault may isolate.
        assert name not in SINGLE_FAULT or (last.isolated and last.suspects.sum() == 1)


@each_variant
def test_channel_no_fault_of_which_is_seen_is_never_suspect(name, options):
    root = np.sqrt(0.5)
    axes = [
        [1, 0, 0],
        [0, 1, 0],
        [root, root, 0],
        [root, -root, 0],
        [0, 0, 1],
        [0.6, 0.8, 0],
    ]
    geometry = Geometry(axes if name in ANY_NUMBER else axes[:5])
    assert np.flatnonzero(~geometry.detectable).tolist() == [4]
    for channel, last in last_verdicts(name, geometry, **options):
        assert last.alarm == (channel != 4)
        assert not last.suspects[4]
        assert last.suspects[channel] == (channel != 4)


@pytest.mark.parametrize(
    ("name", "options"),
    [one for one in VARIANTS if one[0] in SINGLE_FAULT and one[0] != "recursive"],
    ids=str,
)
def test_on_lopsided_axes_an_isolated_verdict_is_never_wrong(name, options):
    """There some methods name one channel for a fault of another, however large it is.

    `recursive` is not asked: noise alone may make what it divides by small.
    """
    isolated = 0
    for seed in range(16):
        rng = np.random.default_rng(seed)
        detector = create_detector(
            name, random_axes(rng, 5 + seed % 4), CONSTANT, **options
        )
        n = detector.geometry.n
        for channel in range(n):
            z = rng.normal(0, SIGMA, (40, n))
            z[:20, channel] += 50 * SIGMA
            z[20:, channel] += 5000 * SIGMA
            verdict = detector.detect(z)
            # At 50 sigma a channel that is hardly seen gives no alarm, at 5000 every one does.
            assert (
                verdict.suspects[20:, channel].all()
                or not detector.geometry.detectable[channel]
            )
            assert (
                verdict.suspects[verdict.isolated] == (np.arange(n) == channel)
            ).all()
            assert verdict.isolated[20:].all() or not detector.isolable[channel]
            isolated += bool(verdict.isolated[20:].all())
    assert isolated > 32


REFUSED = [
    *((name, options, words) for name in RATE_OPTIONS for options, words in (
        ({"false_alarm_probability": 0.0}, "is 0, expected between 0 and 1"),
        ({"false_alarm_probability": 1.0}, "is 1, expected between 0 and 1"),
        ({"false_alarm_probability": math.nan}, "is nan, expected between 0 and 1"),
        ({"false_alarms_per_hour": 1.0, "false_alarm_probability": 1e-3}, "not both"),
    )),
    *((name, options, words) for name in (*RATE_OPTIONS, *RUN_LENGTHS) for options, words in (
        ({"false_alarms_per_hour": 0.0, "sample_rate": 100.0}, "is 0, expected > 0"),
        ({"false_alarms_per_hour": 1.0}, "needs a sample_rate > 0 Hz, got None"),
        ({"false_alarms_per_hour": 1e9, "sample_rate": 1.0}, "expected between 0 and 1"),
    )),
    *((name, options, words) for name in RUN_LENGTHS for options, words in (
        ({"run_length": 1.0}, "run_length is 1 samples, expected 2 to 1e+15"),
        ({"run_length": math.nan}, "run_length is nan samples"),
        ({"run_length": 1e4, "false_alarms_per_hour": 1.0, "sample_rate": 100.0}, "give run_length or false_alarms"),
    )),
    *((name, {"confidence": value}, f"confidence is {value:g}, expected above 0.5 and below 1")
      for name in ("likelihood_ratio", *RUN_LENGTHS) for value in (0.0, 0.5, 1.0, -1.0, math.nan)),
    ("cusum", {"shift": 0.0}, "shift is 0 standard deviations, expected 0.05 to 3"),
    ("cusum", {"shift": math.nan}, "shift is nan"),
    ("guaranteed", {"threshold": 0.0}, "threshold is 0 bounds, expected finite and > 0"),
    ("guaranteed", {"threshold": math.inf}, "threshold is inf"),
    ("guaranteed", {"max_faults": 3}, "max_faults is 3, expected 0, 1 or 2"),
    ("guaranteed", {"max_faults": 1.5}, "max_faults is 1.5, expected 0, 1 or 2"),
    ("max_residual", {"tolerance": "guess"}, "tolerance is 'guess', expected one of: calibrated"),
    ("projector", {"construction": "guess"}, "construction is 'guess', expected one of: svd"),
    ("projector", {"norm": "guess"}, "norm is 'guess', expected one of: l2"),
    ("determinant", {"criterion": "guess"}, "criterion is 'guess', expected one of: determinant"),
    ("max_residual", {"tolerance": "paper", "false_alarm_probability": 1e-3}, "keeps no false-alarm rate"),
]  # fmt: skip


@each
def test_unknown_option_or_detector(name):
    with pytest.raises(
        DetectorError, match=r"no option 'sensitivity', expected one of: \w+"
    ):
        create_detector(name, usual_geometry(name), CONSTANT, sensitivity=3)
    with pytest.raises(
        DetectorError, match=rf"unknown detector '{name}s', did you mean '{name}'"
    ):
        create_detector(f"{name}s", usual_geometry(name), CONSTANT)


@pytest.mark.parametrize(("name", "options", "words"), REFUSED)
def test_bad_options_are_refused(name, options, words):
    with pytest.raises(FdiError) as caught:
        create_detector(name, usual_geometry(name), CONSTANT, **options)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@each
def test_numbers_of_channels_refused_are_those_that_fail(name):
    for n in range(4, 13):
        if reason := detector_class(name).refuses(n):
            with pytest.raises(DetectorError, match=f"^{re.escape(reason)}$"):
                create_detector(name, Geometry.cone(n), CONSTANT)
        else:
            create_detector(name, Geometry.cone(n), CONSTANT)
