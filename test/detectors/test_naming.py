# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Naming by odds: the hypotheses against an independent Bayes, the set chosen, and what cannot be told apart."""

from itertools import combinations

import numpy as np
from detectors.detector_trials import random_axes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from fdi_ros import Geometry, NoiseModel, create_detector
from fdi_ros.compiling.compiled import allocate
from fdi_ros.core.subsets import mask_of
from fdi_ros.detectors.naming import (
    COINCIDENCE,
    DELAY_STD,
    FIT,
    FIT_PER_CHECK,
    GAIN_STD,
    SPREAD,
    TWO_CHECKS,
    Inference,
    add_channels,
    add_units,
    explain,
)


class Mean:
    """A mean to be explained, its covariance, and the motion it is of."""

    def __init__(self, geometry, y, covariance):
        self.geometry, self.n, self.y, self.covariance = geometry, geometry.n, y, covariance
        self.params = create_detector("sequential", geometry, NoiseModel(1.0)).constants
        self.rows = allocate(Inference)
        own = self.own = self.rows[0]
        own["mask"] = own["judged"] = (1 << self.n) - 1
        own["y"][: self.n], own["covariance"][: self.n, : self.n] = y, covariance

    def moving(self, rate, acceleration):
        self.own["rate"], self.own["angular_acceleration"][: self.n] = rate, self.geometry.axes @ acceleration
        return self

    def hypotheses(self):
        """Channels, logarithm of the odds and kind of each."""
        explain(self.params[0], self.own)
        self.own["count"] = 0
        add_channels(self.own, self.n)
        add_units(self.params[0], self.own)
        count = int(self.own["count"])
        return list(zip(*(self.own[name][:count].tolist() for name in ("members", "odds", "whole")), strict=True))


def channels_of(mask):
    return {i for i in range(12) if mask >> i & 1}


def evidence(mean, errors):
    """Logarithm of the likelihood of the parity vector with errors of that covariance (n, n)."""
    parity = mean.geometry.parity
    spread = parity @ (mean.covariance + errors) @ parity.T
    return float(multivariate_normal.logpdf(parity @ mean.y, cov=spread))


def amplitudes(mean, directions):
    """Generalised least squares with a rate and amplitudes (k,) of directions (n, k): estimates and covariance."""
    columns, weight = np.hstack([mean.geometry.axes, directions]), np.linalg.inv(mean.covariance)
    normal = columns.T @ weight @ columns
    return np.linalg.solve(normal, columns.T @ weight @ mean.y)[3:], np.linalg.inv(normal)[3:, 3:]


def oracle(mean):
    """All hypotheses in order, each by the density of the parity vector with and without it."""
    n, unit_vectors = mean.n, np.eye(mean.n)
    healthy, found = evidence(mean, np.zeros((n, n))), []

    def take(channels, prior, directions, std=0.0):
        variance, spread = std**2, SPREAD * directions.shape[1]
        if not std:
            error, scatter = amplitudes(mean, directions)
            # What can hardly be told apart has no figure worth comparing.
            variance = float((error**2 + np.diag(scatter)).mean()) if np.linalg.cond(scatter) < 1e4 else np.nan
        ratio = evidence(mean, variance * directions @ directions.T) - healthy if variance == variance else np.nan
        found.append((mask_of(channels), np.log(prior) + ratio - (0.0 if std else spread), int(std > 0)))

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
            take(unit, COINCIDENCE / len(units), np.where(inside, about, 0.0)[:, None], std)
    return found


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
    return Mean(geometry, y, root @ root.T).moving(rng.normal(0, 1, 3), rng.normal(0, 20, 3))


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([5, 6, 7, 9, 12]))
def test_odds_are_those_of_normal_densities(seed, n):
    mean = random_mean(seed, n)
    ours = {(m, w, k): o for k, (m, o, w) in enumerate(sorted(mean.hypotheses(), key=lambda one: (one[0], one[2])))}
    theirs = sorted(oracle(mean), key=lambda one: (one[0], one[2]))
    kept = {m for m, _, _ in ours}
    # Pairs that can hardly be told apart are left out.
    assert all(m.bit_count() == 2 for m, _, _ in theirs if m not in kept)
    theirs = [one for one in theirs if one[0] in kept]
    assert [(m, w) for m, w, _ in ours] == [(m, w) for m, _, w in theirs]
    for mask in kept:
        mine, expected = (
            np.sort(list(odds))
            for odds in ((o for (m, _, _), o in ours.items() if m == mask), (o for m, o, _ in theirs if m == mask))
        )
        if np.isfinite(expected).all():
            np.testing.assert_allclose(mine, expected, rtol=1e-4, atol=1e-3)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([6, 9, 12]))
def test_what_no_hypothesis_explains_blames_all(seed, n):
    """Whatever the odds: more is left than noise by the hypothesis that least squares says is best."""
    mean = random_mean(seed, n)
    root = np.linalg.inv(np.linalg.cholesky(mean.covariance))
    explain(mean.params[0], mean.own)
    best = sorted(channels_of(int(mean.own["likeliest"])))
    columns = root @ np.hstack([mean.geometry.axes, np.eye(n)[:, best]])
    left = root @ mean.y - columns @ np.linalg.lstsq(columns, root @ mean.y, rcond=None)[0]
    limit = FIT + FIT_PER_CHECK * max(n - 3 - len(best), 0)
    if left @ left > 1.01 * limit:
        assert (mean.own["common"], mean.own["union"]) == (0, (1 << n) - 1)
