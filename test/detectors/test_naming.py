# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Naming by odds: the hypotheses against an independent Bayes, the set chosen, and what cannot be told apart."""

from collections import defaultdict
from itertools import combinations

import numpy as np
import pytest
from detectors.detector_trials import log_density, random_axes
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros import Geometry, NoiseModel
from fdi_ros.compiling.compiled import allocate
from fdi_ros.core.subsets import mask_of
from fdi_ros.detectors.naming import (
    AMPLITUDE_COST,
    COINCIDENCE,
    DELAY_STD,
    FIT,
    FIT_PER_CHECK,
    GAIN_STD,
    SHIFTED,
    SHIFTED_AMONG_FEW,
    SHIFTS,
    SHOWN_SHARE,
    SMALLEST_SHIFT,
    TWO_CHECKS,
    WRONG_GAINS,
    Inference,
    add_channels,
    add_shifts,
    add_units,
    explain,
    turns_steadily,
    variance_by_turn,
)
from fdi_ros.detectors.sequential import Sequential
from fdi_ros.estimator.estimator import Total
from fdi_ros.estimator.noise import MOTION

LARGEST = 0.04  # shift of all biases, rad/s


class Mean:
    """A mean to be explained, its covariance, and the motion it is of."""

    def __init__(self, geometry, y, bias, covariance, rate, acceleration, steady=False):
        self.geometry, self.n, self.y, self.covariance = (
            geometry,
            geometry.n,
            y,
            covariance,
        )
        self.params = Sequential(geometry, NoiseModel(1.0)).constants[0]
        self.rows = allocate(Inference)
        own = self.own = self.rows[0]
        own["mask"] = own["judged"] = (1 << self.n) - 1
        own["bias"][: self.n], own["steady"] = bias, steady
        own["y"][: self.n], own["covariance"][: self.n, : self.n] = y, covariance
        own["rate"], own["angular_acceleration"][: self.n] = (
            rate,
            geometry.axes @ acceleration,
        )
        explain(self.params, own)

    def hypotheses(self):
        """Channels, kind and logarithm of the odds of each."""
        self.own["count"] = 0
        add_channels(self.own, self.n)
        add_units(self.params, self.own)
        add_shifts(self.own, self.n, LARGEST)
        count = int(self.own["count"])
        return zip(
            *(self.own[name][:count].tolist() for name in ("members", "whole", "odds")),
            strict=True,
        )


def by_channels(hypotheses):
    """Kinds and odds of the hypotheses of the same channels, in order."""
    found = defaultdict(list)
    for members, *kind_and_odds in sorted(hypotheses, key=lambda one: one[:2]):
        found[members].append(kind_and_odds)
    return found


def evidence(mean, errors):
    """Logarithm of the likelihood of the parity vector with errors of that covariance (n, n)."""
    parity = mean.geometry.parity
    spread = parity @ (mean.covariance + errors) @ parity.T
    return log_density(parity @ mean.y, spread)


def amplitudes(mean, directions):
    """Generalised least squares with a rate and amplitudes (k,) of directions (n, k): estimates and covariance."""
    columns, weight = (
        np.hstack([mean.geometry.axes, directions]),
        np.linalg.inv(mean.covariance),
    )
    normal = columns.T @ weight @ columns
    return np.linalg.solve(normal, columns.T @ weight @ mean.y)[3:], np.linalg.inv(
        normal
    )[3:, 3:]


def oracle(mean):
    """All hypotheses in order, each by the density of the parity vector with and without it."""
    n, unit_vectors = mean.n, np.eye(mean.n)
    healthy, found = evidence(mean, np.zeros((n, n))), []

    def take(channels, prior, directions, std=0.0):
        variance, spread = std**2, AMPLITUDE_COST * directions.shape[1]
        if not std:
            error, scatter = amplitudes(mean, directions)
            # What can hardly be told apart has no figure worth comparing.
            variance = (
                float((error**2 + np.diag(scatter)).mean())
                if np.linalg.cond(scatter) < 1e4
                else np.nan
            )
        ratio = (
            evidence(mean, variance * directions @ directions.T) - healthy
            if variance == variance
            else np.nan
        )
        found.append(
            (
                mask_of(channels),
                int(std > 0),
                np.log(prior) + ratio - (0.0 if std else spread),
            )
        )

    for i in range(n):
        take((i,), 1.0, unit_vectors[:, [i]])
    prior = (COINCIDENCE if n > 5 else TWO_CHECKS * COINCIDENCE) / n
    for i, j in combinations(range(n), 2):
        take((i, j), prior, unit_vectors[:, [i, j]])
    units = mean.geometry.units
    for unit in units:
        inside = np.isin(np.arange(n), unit)
        take(unit, COINCIDENCE / len(units), unit_vectors[:, list(unit)])
        for about, std in (
            (mean.geometry.axes @ mean.own["rate"], GAIN_STD),
            (mean.own["angular_acceleration"][:n], DELAY_STD),
        ):
            take(
                unit,
                COINCIDENCE / len(units),
                np.where(inside, about, 0.0)[:, None],
                std,
            )
        if mean.own["steady"]:
            take_ranges(mean, inside, COINCIDENCE / len(units), found)
    prior = SHIFTED if n > 6 else SHIFTED_AMONG_FEW
    for std in LARGEST * SMALLEST_SHIFT * 2.0 ** np.arange(SHIFTS):
        ratio = evidence(mean, std**2 * np.eye(n)) - healthy
        found.append((0, 1, np.log(prior / SHIFTS) + ratio))
    return found


def take_ranges(mean, inside, prior, found):
    """Add each wrong range of a unit: the chi-square of generalised least squares with its axes times the gain."""
    root = np.linalg.inv(np.linalg.cholesky(mean.covariance))

    def log_likelihood(gain):
        gains = np.where(inside, gain, 1.0)
        columns = root @ (mean.geometry.axes * gains[:, None])
        values = root @ (mean.y - (gains - 1.0) * mean.own["bias"][: mean.n])
        rate, chi_square = np.linalg.lstsq(columns, values, rcond=None)[:2]
        log_det = np.linalg.slogdet(columns.T @ columns)[1]
        return rate, -0.5 * (chi_square.item() + log_det)

    healthy = log_likelihood(1.0)[1]
    for gain in WRONG_GAINS:
        rate, log_density = log_likelihood(gain)
        # Neither unit would show so little of the turn.
        smaller = min(gain, 1.0) * np.linalg.norm(rate)
        if np.linalg.norm(mean.own["rate"]) < SHOWN_SHARE * smaller:
            continue
        # A prior that is flat in the rate times the root of the gain.
        explained = log_density - healthy + 1.5 * np.log(gain)
        channels = mask_of(np.flatnonzero(inside))
        found.append((channels, 0, np.log(prior / len(WRONG_GAINS)) + explained))


def random_mean(seed, n):
    rng = np.random.default_rng(seed)
    geometry = random_axes(rng, n)
    while geometry.sensitivity.min() < 0.3:
        geometry = random_axes(rng, n)
    if n % 3 == 0:
        geometry = Geometry(geometry.axes, [f"imu_{k // 3}.{k % 3}" for k in range(n)])
    root = 1e-3 * (rng.normal(0, 0.4, (n, n)) + np.diag(rng.uniform(0.7, 2.0, n)))
    y = geometry.axes @ rng.normal(0, 1, 3) + root @ rng.standard_normal(n)
    y[rng.integers(n)] += rng.normal(0, 0.01)
    # Each channel has noise of its own: without, some sum of channels is known exactly,
    # and the odds of both computations are rounding errors.
    covariance = root @ root.T + 1e-8 * np.eye(n)
    bias = rng.normal(0, 0.02, n)
    rate, acceleration = rng.normal(0, 1, 3), rng.normal(0, 20, 3)
    steady = seed % 2 == 1
    return Mean(geometry, y, bias, covariance, rate, acceleration, steady)


@pytest.mark.parametrize("n", [5, 6, 7, 9, 12])
@pytest.mark.parametrize("seed", range(5))
def test_odds_are_those_of_normal_densities(seed, n):
    mean = random_mean(seed, n)
    ours, theirs = by_channels(mean.hypotheses()), by_channels(oracle(mean))
    # Pairs that can hardly be told apart are left out.
    assert all(channels.bit_count() == 2 for channels in theirs.keys() - ours.keys())
    for channels, found in ours.items():
        (kinds, odds), (expected_kinds, expected) = (
            zip(*found, strict=True),
            zip(*theirs[channels], strict=True),
        )
        assert kinds == expected_kinds
        if np.isfinite(expected).all():
            np.testing.assert_allclose(
                np.sort(odds), np.sort(expected), rtol=1e-4, atol=1e-3
            )


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([6, 9, 12]))
def test_what_no_hypothesis_explains_blames_all(seed, n):
    """Whatever the odds: more is left than noise by the hypothesis that least squares says is best."""
    mean = random_mean(seed, n)
    root = np.linalg.inv(np.linalg.cholesky(mean.covariance))
    best = [i for i in range(n) if int(mean.own["likeliest"]) >> i & 1]
    columns = root @ np.hstack([mean.geometry.axes, np.eye(n)[:, best]])
    left = (
        root @ mean.y - columns @ np.linalg.lstsq(columns, root @ mean.y, rcond=None)[0]
    )
    limit = FIT + FIT_PER_CHECK * max(n - 3 - len(best), 0)
    if left @ left > 1.01 * limit:
        assert (mean.own["common"], mean.own["union"]) == (0, (1 << n) - 1)


@given(
    seed=st.integers(0, 2**32 - 1),
    delay=st.floats(1e-4, 3e-2),
    seconds=st.floats(0.2, 4.0),
)
def test_a_late_unit_is_off_in_a_mean_by_the_change_of_the_rate(seed, delay, seconds):
    """The delay explains itself times that change. The rest stays within the standard deviation."""
    rng = np.random.default_rng(seed)
    detector = Sequential(
        Geometry(np.vstack([np.eye(3), np.eye(3)]), units=["one"] * 3 + ["two"] * 3),
        NoiseModel(0.003),
        delay_std=0.02,
    )
    params, kf = detector.constants[0], detector.states[0]["estimator"]
    rows = allocate(Inference)
    t = np.linspace(0.0, seconds, 4001)
    size, speed, phase = rng.uniform([0.1, 0.5, 0.0], [2.0, 6.0, 6.3])
    rate, late = (size * np.sin(speed * (t + by) + phase) for by in (0.0, delay))
    turn = (rate[-1] - rate[0]) / seconds
    mean = np.trapezoid(late - rate, t) / seconds
    place = params["layout"]["delays"][1]
    kf["states"]["x"][place], kf["states"]["p"][place, place] = 0.0, delay**2
    kf["noise"]["regime"], kf["peak_turn"][3] = MOTION, size * speed
    rows[0]["angular_acceleration"][3] = turn
    samples = int(seconds / params["period"])
    variance = variance_by_turn(params, kf, rows[0], 3, samples)
    by_timing = (params["timing"][3] * turn) ** 2
    # Third order: the peak of the third derivative.
    third = delay**3 * size * speed**3 / 6
    assert abs(mean - delay * turn) <= np.sqrt(variance - by_timing) + third
    bound = delay**2 * size * speed / seconds
    assert variance <= by_timing + 1.1 * bound**2


@given(seed=st.integers(0, 2**32 - 1))
def test_a_unit_whose_three_biases_move_names_none_of_its_channels(seed):
    """While biases may move, the pairs of a unit that warms have no channel in common that is faulty."""
    rng = np.random.default_rng(seed)
    units = ["one"] * 3 + ["two"] * 3 + ["three"] * 3 + ["four"] * 3
    y = 0.0003 * rng.standard_normal(12)
    y[3:6] += rng.choice([-1, 1], 3) * rng.uniform(0.004, 0.009, 3)
    mean = Mean(
        Geometry(np.tile(np.eye(3), (4, 1)), units=units),
        y,
        np.zeros(12),
        0.0016**2 * np.eye(12),
        np.zeros(3),
        np.zeros(3),
    )
    mean.own["moved"] = 0.0012
    explain(mean.params, mean.own)
    assert mean.own["common"] == 0
    y[[3, 4]] = 0.0
    y[5] = 0.03
    mean.own["y"][:12] = y
    explain(mean.params, mean.own)
    assert mean.own["common"] == mask_of([5])


@pytest.mark.parametrize("gain", [1 / 8, 1 / 4, 1 / 2, 2.0, 4.0, 8.0])
def test_of_two_units_neither_is_named_if_one_has_another_range(gain):
    """The other unit with the inverse gain explains the mean as well, and at another rate."""
    units = ["one"] * 3 + ["two"] * 3
    axes = np.tile(np.eye(3), (2, 1))
    rate = np.array([0.9, -0.5, 0.3])
    y = axes @ rate
    y[3:] *= gain
    nothing, covariance = np.zeros(6), 0.003**2 * np.eye(6)
    geometry = Geometry(axes, units=units)
    mean = Mean(geometry, y, nothing, covariance, rate, np.zeros(3), steady=True)
    assert mean.own["common"] == 0
    assert mean.own["union"] == mask_of(range(6))


@pytest.mark.parametrize(
    ("share", "expected"), [(0.0, False), (0.45, False), (0.55, True), (1.0, True)]
)
def test_a_turn_is_steady_if_its_mean_rate_is_half_of_its_mean_size(share, expected):
    """Rates to and fro about one axis, and more in one direction by a share."""
    mean = random_mean(7, 6)
    rates = np.where(np.arange(1000) < 500 * (1 + share), 1.0, -1.0)
    axis = np.array([0.6, 0.0, 0.8])
    along = mean.geometry.axes @ axis
    since, until = allocate(Total, 2)
    until["rate"] = rates.sum() * axis
    until["speed"][:6] = np.abs(rates).sum() * np.abs(along)
    assert turns_steadily(mean.params, since, until) is expected
