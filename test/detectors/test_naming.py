# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Naming by odds: the hypotheses against an independent Bayes, the set chosen, and what cannot be told apart."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
import pytest
from detectors.detector_trials import random_axes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from fdi_ros import Geometry, NoiseModel
from fdi_ros.core.bank import Sensors, describe_sensors
from fdi_ros.core.channel_set import mask_of
from fdi_ros.core.compiled import allocate
from fdi_ros.core.record import MAX_UNITS
from fdi_ros.detectors.naming import (
    DELAY_STD,
    FIT,
    FIT_PER_CHECK,
    FIVE,
    GAIN_STD,
    LAG,
    PAIRS,
    SET,
    UNITS,
    Inference,
    add_channels,
    add_pairs,
    add_units,
    choose,
    explain_mean,
    find_information,
    fits,
)

CONE = Geometry.two_triad_cone()
PARALLEL = Geometry.from_triads([np.eye(3)] * 3)


class Mean:
    """A mean to be explained, and all that belongs to it."""

    def __init__(self, geometry: Geometry, y: np.ndarray, std: np.ndarray | float, scale_std: float = 0.0) -> None:
        self.geometry, n = geometry, geometry.n
        self.sensors, self.inference = allocate(Sensors), allocate(Inference)
        describe_sensors(self.sensors[0], geometry, NoiseModel(1.0, scale_std=scale_std).for_channels(n))
        self.y, self.variance = y, np.broadcast_to(np.square(std), n)
        self.inference["y"][0, :n], self.inference["variance"][0, :n] = y, self.variance
        self.units = np.zeros(MAX_UNITS, dtype=np.int64)
        self.units[: len(geometry.units)] = [mask_of(unit) for unit in geometry.units]

    def moving(self, rate: np.ndarray, acceleration: np.ndarray, turning: float) -> Mean:
        self.inference["rate"], self.inference["acceleration"], self.inference["turning"] = rate, acceleration, turning
        return self

    def hypotheses(self) -> list[tuple[int, float, bool]]:
        """Channels, logarithm of the odds and kind of each, without the share by which the model may be wrong."""
        sensors, inference = self.sensors[0], self.inference[0]
        find_information(sensors, inference)
        inference["count"] = 0
        add_channels(sensors, inference)
        add_pairs(sensors, inference)
        add_units(sensors, inference, self.units)
        count = int(self.inference["count"][0])
        columns = (self.inference[name][0, :count].tolist() for name in ("members", "log_odds", "whole"))
        return list(zip(*columns, strict=True))

    def named(self, confidence: float = 0.999) -> tuple[set[int], bool]:
        """Channels named, and whether they are isolated."""
        explain_mean(self.sensors[0], self.inference[0], self.units, confidence)
        return channels_of(int(self.inference["named"][0])), bool(self.inference["isolated"][0])


def channels_of(mask: int) -> set[int]:
    return {i for i in range(12) if mask >> i & 1}


def evidence(mean: Mean, covariance: np.ndarray) -> float:
    """Logarithm of the likelihood of parity (n - 3,) with errors of that covariance (n, n)."""
    parity = np.linalg.svd(mean.geometry.axes)[0][:, 3:].T
    spread = parity @ (np.diag(mean.variance) + covariance) @ parity.T
    return float(multivariate_normal.logpdf(parity @ mean.y, cov=spread))


def errors_of(mean: Mean, channels: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Weighted least squares with a rate and an error of each of these channels: estimates and covariance."""
    columns = np.hstack([mean.geometry.axes, np.eye(mean.geometry.n)[:, list(channels)]])
    weights = 1 / mean.variance
    normal = (columns.T * weights) @ columns
    return np.linalg.solve(normal, columns.T @ (weights * mean.y))[3:], np.linalg.inv(normal)[3:, 3:]


def oracle(mean: Mean) -> list[tuple[int, float, bool]]:
    """All hypotheses in order, each by the density of the parity vector with and without it."""
    n, axes, told = mean.geometry.n, mean.geometry.axes, mean.inference
    sound, found = evidence(mean, np.zeros((n, n))), []
    single = [errors_of(mean, (i,)) for i in range(n)]

    def take(channels: Any, covariance: np.ndarray, prior: float, whole: bool) -> None:
        full = np.zeros((n, n))
        full[np.ix_(list(channels), list(channels))] = covariance
        found.append((mask_of(channels), np.log(prior) + evidence(mean, full) - sound, whole))

    for i, (error, spread) in enumerate(single):
        take((i,), error[:, None] ** 2 + spread, 1.0, False)
    for i, j in combinations(range(n), 2):
        error, _ = errors_of(mean, (i, j))
        # The information on each error while the other is nought.
        mine = 1 / single[i][1][0, 0], 1 / single[j][1][0, 0]
        spread = np.linalg.inv(errors_of(mean, (i, j))[1])
        scatter = 0.5 * (mine[0] + mine[1]) / np.linalg.det(spread)
        take((i, j), (0.5 * error @ error + scatter) * np.eye(2), (PAIRS if n > 5 else FIVE) / n, False)
    for unit in mean.geometry.units:
        k = list(unit)
        size = sum(float(single[i][0][0]) ** 2 + mean.variance[i] for i in k) / 3
        take(k, size * np.eye(len(k)), UNITS, False)
        for about, std, peak in (
            (told["rate"][0], GAIN_STD, 0.0),
            (told["acceleration"][0], DELAY_STD, float(told["turning"][0])),
        ):
            shape = axes[k] @ about
            other = LAG**2 * max(float(shape @ shape), peak**2) / 3
            take(k, std**2 * (np.outer(shape, shape) + other * np.eye(len(k))), UNITS, True)
    return found


def random_mean(seed: int, n: int) -> Mean:
    rng = np.random.default_rng(seed)
    geometry = random_axes(rng, n)
    while geometry.sensitivity.min() < 0.3:
        geometry = random_axes(rng, n)
    if n % 3 == 0:
        geometry = Geometry(geometry.axes, [f"imu_{k // 3}.{k % 3}" for k in range(n)])
    std = rng.uniform(0.5, 2.0, n)
    y = geometry.axes @ rng.normal(0, 10, 3) + std * rng.standard_normal(n)
    y[rng.integers(n)] += rng.normal(0, 10)
    return Mean(geometry, y, std).moving(rng.normal(0, 20, 3), rng.normal(0, 200, 3), float(rng.uniform(0, 300)))


class TestOdds:
    @settings(max_examples=40)
    @given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([5, 6, 7, 9, 12]))
    def test_are_those_of_normal_densities(self, seed: int, n: int) -> None:
        mean = random_mean(seed, n)
        ours, theirs = mean.hypotheses(), oracle(mean)
        # Pairs that can hardly be told apart are left out.
        missing = {m for m, _, _ in theirs} - {m for m, _, _ in ours}
        assert all(m.bit_count() == 2 for m in missing)
        theirs = [one for one in theirs if one[0] not in missing]
        assert [(m, w) for m, _, w in ours] == [(m, int(w)) for m, _, w in theirs]
        np.testing.assert_allclose([o for _, o, _ in ours], [o for _, o, _ in theirs], rtol=1e-6, atol=1e-5)

    @settings(max_examples=30)
    @given(seed=st.integers(0, 2**32 - 1))
    def test_do_not_depend_on_the_rate(self, seed: int) -> None:
        rng, geometry = np.random.default_rng(seed), CONE
        y = rng.normal(0, 3, 6)
        turned = y + geometry.axes @ rng.normal(0, 5, 3)
        one, other = Mean(geometry, y, 1.0).hypotheses(), Mean(geometry, turned, 1.0).hypotheses()
        np.testing.assert_allclose([o for _, o, _ in one], [o for _, o, _ in other], rtol=1e-7, atol=1e-7)


class TestChoice:
    @settings(max_examples=60)
    @given(
        tenths=st.lists(st.integers(-300, 0), min_size=1, max_size=30, unique=True),
        confidence=st.sampled_from([0.6123, 0.9123, 0.99, 0.999, 0.9999]),
        seed=st.integers(0, 1000),
    )
    def test_is_the_smallest_set_of_that_probability(self, tenths: list[int], confidence: float, seed: int) -> None:
        rng, inference, odds = np.random.default_rng(seed), allocate(Inference), [k / 10 for k in tenths]
        members = rng.integers(1, 1 << 6, len(odds))
        inference["count"], inference["log_odds"][0, : len(odds)], inference["members"][0, : len(odds)] = (
            len(odds),
            odds,
            members,
        )
        choose(inference[0], confidence)
        order = np.argsort(odds)[::-1]
        share = np.cumsum(np.exp(np.array(odds)[order]))
        share /= share[-1]
        common = np.bitwise_and.reduce(members[order[: np.searchsorted(share, confidence) + 1]])
        # A set is told with less certainty than a name, and holds two channels at least.
        count = np.searchsorted(share, max(1 - SET * (1 - confidence), 0.0)) + 1
        union = np.bitwise_or.reduce(members[order[:count]])
        while union & (union - 1) == 0 and count < len(order) and share[count - 1] < confidence:
            union |= members[order[count]]
            count += 1
        few = 0 < int(common).bit_count() <= 2
        assert bool(inference["isolated"][0]) == few
        assert inference["named"][0] == (common if few else union)

    @pytest.mark.parametrize("geometry", [CONE, Geometry.dodecahedron(), PARALLEL, Geometry.cone(12)])
    @pytest.mark.parametrize("size", [-20.0, 20.0, 1000.0])
    def test_one_error_is_named(self, geometry: Geometry, size: float) -> None:
        rng = np.random.default_rng(1)
        for channel in range(geometry.n):
            y = geometry.axes @ rng.normal(0, 1, 3) + rng.normal(0, 0.1, geometry.n)
            y[channel] += size
            mean = Mean(geometry, y, 0.1)
            assert mean.named() == ({channel}, True)
            assert mean.inference["error"][0, channel] == pytest.approx(size, abs=0.7)

    def test_twins_are_named_together(self) -> None:
        """Two parallel triads: the difference of two gyros says nothing about which of them is off."""
        geometry = Geometry.from_triads([np.eye(3)] * 2)
        y = np.random.default_rng(2).normal(0, 0.1, 6)
        y[1] += 5.0
        named, isolated = Mean(geometry, y, 0.1).named()
        assert {1, 4} <= named
        assert not isolated

    def test_two_equal_errors_of_three_parallel_gyros_are_not_taken_for_the_third(self) -> None:
        """The third with the opposite error looks the same: only the odds of such a coincidence are against it."""
        rng = np.random.default_rng(3)
        for size in (0.2, 0.5, 0.8):
            for other in (0.7, 1.0, 1.4, 3.0):
                y = rng.normal(0, 0.1, 9)
                y[0], y[3] = y[0] + size, y[3] + other * size
                named, isolated = Mean(PARALLEL, y, 0.1).named()
                assert not isolated or named <= {0, 3}

    def test_a_unit_that_measures_motion_too_late_does_not_blame_its_gyros(self) -> None:
        acceleration = np.array([20.0, -10.0, 5.0])
        y = np.random.default_rng(4).normal(0, 1e-3, 9)
        y[3:6] -= 3e-3 * PARALLEL.axes[3:6] @ acceleration
        mean = Mean(PARALLEL, y, 1e-3).moving(np.zeros(3), acceleration, 25.0)
        named, isolated = mean.named()
        assert named >= {3, 4, 5}
        assert not isolated or named == {3, 4, 5}

    def test_a_scale_factor_that_is_not_known_names_no_other_channel(self) -> None:
        """The larger the error, the more the axes and scale factors assumed matter."""
        rng = np.random.default_rng(5)
        for _ in range(40):
            channel = int(rng.integers(6))
            error, size = rng.normal(0, 0.003, (6, 6)), float(10 ** rng.uniform(0, 4))
            # The error passes into what is taken for the rate, and from there with wrong gains into all channels.
            y = rng.normal(0, 0.1, 6) + size * np.eye(6)[channel] + size * error[:, channel]
            named, isolated = Mean(CONE, y, 0.1, scale_std=0.002).named()
            assert channel in named
            assert not isolated or named == {channel}


class TestFit:
    @settings(max_examples=40)
    @given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([5, 6, 9, 12]), count=st.integers(1, 3))
    def test_is_what_least_squares_leaves(self, seed: int, n: int, count: int) -> None:
        rng = np.random.default_rng(seed)
        mean = random_mean(seed, n)
        channels = sorted(rng.choice(n, min(count, n - 4), replace=False).tolist())
        columns = np.hstack([mean.geometry.axes, np.eye(n)[:, channels]]) / np.sqrt(mean.variance)[:, None]
        target = mean.y / np.sqrt(mean.variance)
        left = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
        limit = FIT + FIT_PER_CHECK * (n - 3 - len(channels))
        if abs(left @ left - limit) > 0.01 * limit:
            assert fits(mean.sensors[0], mean.inference[0], mask_of(channels)) == (left @ left < limit)
