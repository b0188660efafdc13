"""What every registered detector must do, whatever its method."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pytest
from detectors.detector_trials import random_axes
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fdi_ros import FdiError, Geometry, NoiseModel, create_detector
from fdi_ros.detectors import DETECTORS, accepted_options, detector_class
from fdi_ros.detectors.base import CHUNK, Detector, Verdict
from fdi_ros.errors import DetectorError

SIGMA = 1e-3
CONSTANT = NoiseModel(SIGMA, bound=SIGMA)
MOVING = NoiseModel(SIGMA, scale_std=2e-3, timing_std=3e-4, bound=4 * SIGMA)
FIVE_ONLY = {"determinant"}
NAMES = sorted(DETECTORS)
SINGLE_FAULT = sorted(set(NAMES) - {"guaranteed", "likelihood_ratio", "cusum"})
RATE_OPTIONS = [name for name in NAMES if "false_alarm_probability" in accepted_options(detector_class(name))]

VARIANTS: list[tuple[str, dict[str, Any]]] = [(name, {}) for name in NAMES] + [
    ("mean_abs_residual", {"tolerance": "paper"}),
    ("rate_deviation", {"tolerance": "paper"}),
    ("max_residual", {"tolerance": "paper"}),
    ("projector", {"norm": "l1"}),
    ("projector", {"construction": "qr"}),
    ("determinant", {"criterion": "condition_number"}),
]

each = pytest.mark.parametrize("name", NAMES)


def usual_geometry(name: str) -> Geometry:
    return Geometry.cone(5) if name in FIVE_ONLY else Geometry.two_triad_cone()


def stream(rng: np.random.Generator, geometry: Geometry, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Noisy samples in motion with some faults of all sizes, and the angular acceleration."""
    rate = np.cumsum(rng.normal(0, 0.05, (rows, 3)), axis=0)
    z = rate @ geometry.axes.T + rng.normal(0, SIGMA, (rows, geometry.n))
    faulty = rng.random(rows) < 0.3
    z[np.arange(rows), rng.integers(geometry.n, size=rows)] += faulty * rng.normal(0, 20 * SIGMA, rows)
    return z, rng.normal(0, 5.0, (rows, 3))


def lose(rng: np.random.Generator, z: np.ndarray, share: float) -> None:
    gone = rng.random(z.shape) < share
    z[gone] = rng.choice([np.nan, np.inf, -np.inf], size=int(gone.sum()))


def in_pieces(detector: Detector, z: np.ndarray, acceleration: np.ndarray | None, cuts: list[int]) -> Verdict:
    edges = [0, *sorted(cuts), len(z)]
    parts = [detector.detect(z[a:b], None if acceleration is None else acceleration[a:b]) for a, b in pairwise(edges)]
    return Verdict(*(np.concatenate(fields) for fields in zip(*parts, strict=True)))


def assert_same_bits(whole: Verdict, pieces: Verdict) -> None:
    for field, one, other in zip(Verdict._fields, whole, pieces, strict=True):
        assert one.tobytes() == other.tobytes(), f"{field} differs"


each_variant = pytest.mark.parametrize(("name", "options"), VARIANTS, ids=str)


class TestBlockInvariance:
    @each_variant
    @settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    @given(
        seed=st.integers(0, 2**32 - 1),
        cuts=st.lists(st.integers(0, 60), max_size=8),
        lost=st.sampled_from([0.0, 0.03, 0.3]),
        moving=st.booleans(),
        lopsided=st.booleans(),
    )
    def test_random_cuts(
        self, name: str, options: dict[str, Any], seed: int, cuts: list[int], lost: float, moving: bool, lopsided: bool
    ) -> None:
        rng = np.random.default_rng(seed)
        detector = cached_detector(name, moving, lopsided, options)
        z, acceleration = stream(rng, detector.geometry, 60)
        lose(rng, z, lost)
        given_acceleration = acceleration if moving else None
        detector.reset()
        whole = detector.detect(z, given_acceleration)
        detector.reset()
        assert_same_bits(whole, in_pieces(detector, z, given_acceleration, cuts))

    @each_variant
    def test_one_row_at_a_time(self, name: str, options: dict[str, Any]) -> None:
        detector = cached_detector(name, True, False, options)
        z, acceleration = stream(np.random.default_rng(7), detector.geometry, 300)
        detector.reset()
        whole = detector.detect(z, acceleration)
        detector.reset()
        assert_same_bits(whole, in_pieces(detector, z, acceleration, list(range(1, 300))))

    @each_variant
    def test_blocks_longer_than_a_chunk(self, name: str, options: dict[str, Any]) -> None:
        detector = cached_detector(name, False, False, options)
        z, _ = stream(np.random.default_rng(8), detector.geometry, 2 * CHUNK + 1)
        z[CHUNK - 1 : CHUNK + 1, 0] = np.nan
        detector.reset()
        whole = detector.detect(z)
        detector.reset()
        assert_same_bits(whole, in_pieces(detector, z, None, [17, CHUNK + 3, 2 * CHUNK]))

    @each
    def test_memory_layout_does_not_matter(self, name: str) -> None:
        detector = cached_detector(name, False)
        z, _ = stream(np.random.default_rng(9), detector.geometry, 50)
        detector.reset()
        plain = detector.detect(z)
        detector.reset()
        assert_same_bits(plain, detector.detect(np.asfortranarray(z)))
        detector.reset()
        assert_same_bits(plain, detector.detect(np.repeat(z, 2, axis=0)[::2]))


_BUILT: dict[str, Detector] = {}


def cached_detector(name: str, moving: bool, lopsided: bool = False, options: dict[str, Any] | None = None) -> Detector:
    """Detectors are costly to build and forget by `reset`: build each once."""
    key = f"{name} {moving} {lopsided} {options or {}}"
    if key not in _BUILT:
        geometry = usual_geometry(name)
        if lopsided:
            axes = np.random.default_rng(geometry.n).standard_normal((geometry.n, 3))
            geometry = Geometry(axes / np.linalg.norm(axes, axis=1, keepdims=True))
        _BUILT[key] = create_detector(name, geometry, MOVING if moving else CONSTANT, **(options or {}))
    return _BUILT[key]


@each
@pytest.mark.parametrize("rows", [0, 1, 2, 33])
def test_shapes_and_types(name: str, rows: int) -> None:
    detector = cached_detector(name, False)
    n = detector.geometry.n
    z, _ = stream(np.random.default_rng(rows), detector.geometry, rows)
    before = z.copy()
    detector.reset()
    verdict = detector.detect(z)
    for field in ("statistic", "threshold"):
        assert getattr(verdict, field).shape == (rows,)
        assert getattr(verdict, field).dtype == np.float64
    for field in ("alarm", "isolated"):
        assert getattr(verdict, field).shape == (rows,)
        assert getattr(verdict, field).dtype == np.bool_
    assert verdict.suspects.shape == verdict.error.shape == verdict.scores.shape == (rows, n)
    assert verdict.suspects.dtype == np.bool_
    assert verdict.error.dtype == verdict.scores.dtype == np.float64
    assert np.array_equal(z, before), "detect must not write to its argument"


@each
def test_fields_agree_with_each_other(name: str) -> None:
    detector = cached_detector(name, False)
    z, _ = stream(np.random.default_rng(11), detector.geometry, 2000)
    lose(np.random.default_rng(12), z, 0.02)
    detector.reset()
    verdict = detector.detect(z)
    assert 50 < verdict.alarm.sum() < 1990
    judged = ~np.isnan(verdict.statistic)
    assert np.array_equal(verdict.alarm[judged], (verdict.statistic >= verdict.threshold)[judged])
    assert not verdict.alarm[~judged].any()
    assert np.array_equal(verdict.suspects.any(axis=1), verdict.alarm)
    assert not (verdict.isolated & ~verdict.alarm).any()
    assert not verdict.error[~verdict.suspects].any()
    assert np.isfinite(verdict.error).all()
    assert not verdict.suspects[~np.isfinite(z)].any()


@each
def test_lost_channel_is_judged_by_those_left(name: str) -> None:
    detector = cached_detector(name, False)
    geometry = detector.geometry
    z, _ = stream(np.random.default_rng(13), geometry, 40)
    z[:, 2] = np.nan
    detector.reset()
    verdict = detector.detect(z)
    kept = np.arange(geometry.n) != 2
    if name in FIVE_ONLY:
        assert np.isnan(verdict.statistic).all()
        assert not verdict.alarm.any()
        assert "expected 5" in detector.refusals[kept.tobytes()]
        return
    alone = type(detector)(geometry.subset(kept), CONSTANT.subset(kept), **detector.options).detect(
        np.ascontiguousarray(z[:, kept])
    )
    assert alone.alarm.any()
    assert verdict.statistic.tobytes() == alone.statistic.tobytes()
    assert np.array_equal(verdict.suspects[:, kept], alone.suspects)
    assert np.array_equal(verdict.scores[:, kept], alone.scores, equal_nan=True)
    assert np.isnan(verdict.scores[:, 2]).all()


@each
def test_too_few_channels_is_not_healthy_but_unknown(name: str) -> None:
    detector = cached_detector(name, False)
    z, _ = stream(np.random.default_rng(14), detector.geometry, 5)
    z[:, 3:] = np.nan
    verdict = detector.detect(z)
    assert np.isnan(verdict.statistic).all()
    assert np.isnan(verdict.threshold).all()
    assert not verdict.alarm.any()
    row = detector.detect(z[:1])
    assert np.isnan(row.statistic).all()


@each
@pytest.mark.parametrize("shape", [(3,), (3, 4), (2, 3, 6)])
def test_wrong_shape_is_refused(name: str, shape: tuple[int, ...]) -> None:
    with pytest.raises(DetectorError, match="expected"):
        cached_detector(name, False).detect(np.zeros(shape))


@each_variant
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_fault_of_50_sigma_is_named_on_every_isolable_channel(name: str, options: dict[str, Any], sign: float) -> None:
    detector = cached_detector(name, False, False, options)
    geometry = detector.geometry
    assert geometry.isolable.all()
    for channel in range(geometry.n):
        z = np.tile(geometry.axes @ [0.3, -0.2, 0.5], (40, 1))
        z[:, channel] += sign * 50 * SIGMA
        detector.reset()
        verdict = detector.detect(z)
        assert verdict.alarm[-1]
        assert verdict.isolated[-1]
        assert np.flatnonzero(verdict.suspects[-1]).tolist() == [channel]
        assert verdict.error[-1, channel] == pytest.approx(sign * 50 * SIGMA, rel=1e-6)


@each_variant
@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("size", [1e7, 1e100, 1e160, 1e300, -1e300])
def test_value_no_gyro_can_measure(name: str, options: dict[str, Any], moving: bool, size: float) -> None:
    """The squares of such values would overflow, and a NaN statistic is no alarm."""
    detector = cached_detector(name, moving, False, options)
    z = np.tile(detector.geometry.axes @ [0.3, -0.2, 0.5], (40, 1))
    z += np.random.default_rng(17).normal(0, SIGMA, z.shape)
    acceleration = np.ones((40, 3)) if moving else None
    for channel in range(detector.geometry.n):
        wild = z.copy()
        wild[5:, channel] = size
        detector.reset()
        verdict = detector.detect(wild, acceleration)
        assert verdict.alarm[-1]
        # At rest, or nearly, the condition number is documented to name wrongly.
        assert verdict.suspects[-1, channel] or options.get("criterion") == "condition_number"
        assert np.isfinite(verdict.error).all()
        detector.reset()
        assert_same_bits(verdict, in_pieces(detector, wild, acceleration, list(range(1, 40))))


@each
def test_no_alarm_without_noise(name: str) -> None:
    detector = cached_detector(name, False)
    rate = np.random.default_rng(15).uniform(-5, 5, (500, 3))
    rate[:20] = 0
    detector.reset()
    verdict = detector.detect(rate @ detector.geometry.axes.T)
    assert not verdict.alarm.any()
    assert (verdict.statistic < 1e-6).all()


@each
def test_verdict_does_not_depend_on_the_body_rate(name: str) -> None:
    detector = cached_detector(name, False)
    rng = np.random.default_rng(16)
    z, _ = stream(rng, detector.geometry, 500)
    turned = z + rng.uniform(-3, 3, (500, 3)) @ detector.geometry.axes.T
    detector.reset()
    still = detector.detect(z)
    detector.reset()
    moved = detector.detect(turned)
    np.testing.assert_allclose(moved.statistic, still.statistic, rtol=1e-7, atol=1e-7)
    clear = np.abs(still.statistic / still.threshold - 1) > 1e-6
    assert np.array_equal(moved.alarm[clear], still.alarm[clear])
    assert still.alarm.any()
    assert (moved.suspects == still.suspects).all(axis=1)[clear].mean() > 0.999
    np.testing.assert_allclose(moved.error[clear], still.error[clear], atol=1e-9)


class TestChannelsThatCannotBeToldApart:
    @pytest.mark.parametrize("name", [name for name in NAMES if name not in FIVE_ONLY])
    def test_two_parallel_triads(self, name: str) -> None:
        geometry = Geometry.from_triads([np.eye(3), np.eye(3)])
        detector = create_detector(name, geometry, CONSTANT)
        for channel in range(6):
            detector.reset()
            verdict = detector.detect(faulty(geometry, channel))
            assert verdict.alarm[-1]
            assert not verdict.isolated[-1]
            assert set(np.flatnonzero(verdict.suspects[-1])) == {channel, (channel + 3) % 6}

    def test_determinant_with_twins(self) -> None:
        geometry = Geometry([[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0.6, 0.8], [0, -0.6, 0.8]])
        for criterion in ("determinant", "condition_number"):
            detector = create_detector("determinant", geometry, CONSTANT, criterion=criterion)
            verdict = detector.detect(faulty(geometry, 1))
            assert not verdict.isolated.any()
            assert np.flatnonzero(verdict.suspects[-1]).tolist() == [0, 1]

    @pytest.mark.parametrize("name", [name for name in NAMES if name not in FIVE_ONLY])
    def test_three_parallel_triads(self, name: str) -> None:
        geometry = Geometry.from_triads([np.eye(3)] * 3)
        detector = create_detector(name, geometry, CONSTANT)
        for channel in range(9):
            detector.reset()
            verdict = detector.detect(faulty(geometry, channel))
            assert verdict.alarm[-1]
            assert verdict.suspects[-1, channel]
            # Two wrong twins look like one right one: only methods that believe in one fault may isolate.
            if name in SINGLE_FAULT:
                assert verdict.isolated[-1]
                assert verdict.suspects[-1].sum() == 1

    @pytest.mark.parametrize("name", [name for name in NAMES if name not in FIVE_ONLY])
    def test_four_channels_detect_and_do_not_isolate(self, name: str) -> None:
        geometry = Geometry.cone(4)
        detector = create_detector(name, geometry, CONSTANT)
        for channel in range(4):
            detector.reset()
            verdict = detector.detect(faulty(geometry, channel))
            assert verdict.alarm[-1]
            assert verdict.suspects[-1].all()
            assert not verdict.isolated.any()

    @each
    def test_channel_no_fault_of_which_is_seen_is_never_suspect(self, name: str) -> None:
        root = np.sqrt(0.5)
        axes = [[1, 0, 0], [0, 1, 0], [root, root, 0], [root, -root, 0], [0, 0, 1], [0.6, 0.8, 0]]
        geometry = Geometry(axes[:5] if name in FIVE_ONLY else axes)
        assert np.flatnonzero(~geometry.detectable).tolist() == [4]
        detector = create_detector(name, geometry, CONSTANT)
        for channel in range(geometry.n):
            detector.reset()
            verdict = detector.detect(faulty(geometry, channel))
            assert verdict.alarm[-1] == (channel != 4)
            assert not verdict.suspects[:, 4].any()
            assert verdict.suspects[-1, channel] == (channel != 4)
            detector.reset()
            assert_same_bits(verdict, in_pieces(detector, faulty(geometry, channel), None, list(range(1, 40))))


class TestLopsidedAxes:
    """On arbitrary axes some methods name one channel for a fault of another, however large it is."""

    METHODS: ClassVar[list[tuple[str, dict[str, Any]]]] = [
        (name, options) for name, options in VARIANTS if name.endswith(("residual", "deviation", "projector"))
    ]

    @pytest.mark.parametrize(("name", "options"), METHODS, ids=str)
    def test_isolated_verdict_is_never_wrong(self, name: str, options: dict[str, Any]) -> None:
        isolated = 0
        for seed in range(30):
            rng = np.random.default_rng(seed)
            detector = create_detector(name, random_axes(rng, 5 + seed % 4), CONSTANT, **options)
            n = detector.geometry.n
            for channel in range(n):
                z = rng.normal(0, SIGMA, (40, n))
                z[:20, channel] += 50 * SIGMA
                z[20:, channel] += 5000 * SIGMA
                verdict = detector.detect(z)
                # At 50 sigma a channel that is hardly seen gives no alarm, at 5000 every one does.
                large = verdict.suspects[20:, channel]
                assert large.all() or not detector.geometry.detectable[channel]
                assert (verdict.suspects[verdict.isolated] == (np.arange(n) == channel)).all()
                assert verdict.isolated[20:].all() or not detector.isolable[channel]
                isolated += bool(verdict.isolated[20:].all())
        assert isolated > 60

    @pytest.mark.parametrize(("name", "options"), METHODS, ids=str)
    def test_cone_after_an_exclusion(self, name: str, options: dict[str, Any]) -> None:
        detector = create_detector(name, Geometry.two_triad_cone(), CONSTANT, **options)
        assert detector.isolable.all()
        rng = np.random.default_rng(18)
        for gone in range(6):
            for channel in np.delete(np.arange(6), gone):
                z = rng.normal(0, SIGMA, (20, 6))
                z[:, channel] += rng.choice([-300, 300]) * SIGMA
                z[:, gone] = np.nan
                verdict = detector.detect(z)
                assert verdict.suspects[:, channel].all()
                assert (verdict.suspects[verdict.isolated] == (np.arange(6) == channel)).all()

    def test_isolable_is_what_the_method_can_do(self) -> None:
        """Channel k of which another has `|S_ik| > S_ii` is never the one of largest residual."""
        missed = 0
        for seed in range(20):
            geometry = random_axes(np.random.default_rng(seed), 6)
            share = np.abs(geometry.S) / np.diag(geometry.S)[:, None]
            hidden = (share > 1 + 1e-9).any(axis=0)
            missed += hidden.sum()
            assert not create_detector("max_residual", geometry, CONSTANT).isolable[hidden].any()
        assert missed > 10

    @each
    def test_axes_of_one_kind_are_all_isolable(self, name: str) -> None:
        for geometry in (Geometry.cone(5), Geometry.dodecahedron(), Geometry.two_triad_cone(), Geometry.cone(8)):
            if name not in FIVE_ONLY or geometry.n == 5:
                assert create_detector(name, geometry, CONSTANT).isolable.all()

    def test_guaranteeing_no_fault_isolates_none(self) -> None:
        detector = create_detector("guaranteed", Geometry.dodecahedron(), CONSTANT, max_faults=0)
        assert not detector.isolable.any()


def faulty(geometry: Geometry, channel: int) -> np.ndarray:
    z = np.tile(geometry.axes @ [0.3, -0.2, 0.5], (40, 1))
    z[:, channel] += 50 * SIGMA
    return z


class TestBadOptions:
    @each
    def test_unknown_option(self, name: str) -> None:
        with pytest.raises(DetectorError, match=r"no option 'sensitivity', expected one of: \w+"):
            create_detector(name, usual_geometry(name), CONSTANT, sensitivity=3)

    @pytest.mark.parametrize("name", RATE_OPTIONS)
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"false_alarm_probability": 0.0}, "is 0, expected between 0 and 1"),
            ({"false_alarm_probability": -0.1}, "is -0.1, expected between 0 and 1"),
            ({"false_alarm_probability": 1.0}, "is 1, expected between 0 and 1"),
            ({"false_alarm_probability": float("nan")}, "is nan, expected between 0 and 1"),
            ({"false_alarms_per_hour": -2.0, "sample_rate": 100.0}, "is -2, expected > 0"),
            ({"false_alarms_per_hour": 1.0}, "needs a sample_rate > 0 Hz, got None"),
            ({"false_alarms_per_hour": 1.0, "sample_rate": 0.0}, "needs a sample_rate > 0 Hz, got 0.0"),
            ({"false_alarms_per_hour": 1.0, "false_alarm_probability": 1e-3}, "not both"),
        ],
    )
    def test_false_alarm_rate(self, name: str, options: dict[str, float], words: str) -> None:
        with pytest.raises(FdiError) as caught:
            create_detector(name, usual_geometry(name), CONSTANT, **options)
        assert words in str(caught.value)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(
        ("name", "option"),
        [
            ("max_residual", "tolerance"),
            ("mean_abs_residual", "tolerance"),
            ("projector", "construction"),
            ("projector", "norm"),
            ("determinant", "criterion"),
        ],
    )
    def test_word_out_of_its_list(self, name: str, option: str) -> None:
        with pytest.raises(FdiError, match=rf"{option} is 'guess', expected one of: \w+") as caught:
            create_detector(name, usual_geometry(name), CONSTANT, **{option: "guess"})
        assert "\n" not in str(caught.value)

    def test_paper_tolerance_keeps_no_false_alarm_rate(self) -> None:
        with pytest.raises(FdiError, match="keeps no false-alarm rate"):
            create_detector(
                "max_residual", usual_geometry(""), CONSTANT, tolerance="paper", false_alarm_probability=1e-3
            )

    def test_unknown_detector(self) -> None:
        with pytest.raises(DetectorError, match=r"unknown detector 'median', expected one of: .*max_residual"):
            create_detector("median", usual_geometry(""), CONSTANT)

    @pytest.mark.parametrize("n", [4, 6, 9])
    def test_determinant_wants_five_channels(self, n: int) -> None:
        with pytest.raises(DetectorError, match=rf"determinant has {n} channels, expected 5: .*square"):
            create_detector("determinant", Geometry.cone(n), CONSTANT)


@each
def test_false_alarms_per_hour_is_a_probability_per_sample(name: str) -> None:
    if name not in RATE_OPTIONS:
        pytest.skip(f"{name} states its false alarms in another way")
    geometry = usual_geometry(name)
    per_hour = create_detector(name, geometry, CONSTANT, false_alarms_per_hour=3.6, sample_rate=100.0)
    per_sample = create_detector(name, geometry, CONSTANT, false_alarm_probability=1e-5)
    z = np.zeros((1, geometry.n))
    assert per_hour.detect(z).threshold == pytest.approx(per_sample.detect(z).threshold, rel=1e-9)
