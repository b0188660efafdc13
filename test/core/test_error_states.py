# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error states against textbook formulas: elimination of the rate, the filter, the layout; and the delay line."""

import numpy as np
import pytest
from detectors.detector_trials import random_axes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from fdi_ros.compiling.compiled import MAX_CHANNELS, allocate
from fdi_ros.core.parity import fill_joint_parity
from fdi_ros.core.records import DelayBuffer, Parity, PathSettings, Sample, Sensors
from fdi_ros.core.restamping import restamp
from fdi_ros.estimator.error_states import (
    MAX_STATES,
    ErrorStates,
    Layout,
    Projection,
    begin_states,
    bound_variance,
    fill_signals,
    predict,
    prepare_layout,
    project,
    subtract_errors,
    update,
)

PRIORS = {
    "bias": 0.01,
    "scale": 0.02,
    "delay": 0.01,
    "bias rate": 1e-4,
    "clock rate": 1e-4,
    "asymmetry": 1e-3,
}
WALKS = {"bias": 1e-3, "scale": 1e-4, "delay": 1e-4}


def random_channels(seed, n):
    """Axes (n, 3) that span space by a wide margin, and a covariance (n, n) of errors."""
    rng = np.random.default_rng(seed)
    axes = random_axes(rng, n).axes
    while np.linalg.svd(axes, compute_uv=False)[-1] < 0.3:
        axes = random_axes(rng, n).axes
    root = 1e-3 * (rng.normal(0, 0.4, (n, n)) + np.diag(rng.uniform(0.7, 2.0, n)))
    return rng, axes.copy(), root @ root.T


def estimator(n, units, axes=None):
    layout, states = allocate(Layout)[0], allocate(ErrorStates)[0]
    axes = np.tile(np.eye(3), (n, 1))[:n] if axes is None else axes
    prepare_layout(layout, axes, np.arange(n) * units // n, units, PRIORS, WALKS)
    begin_states(layout, states, np.full(n, 0.01))
    return layout, states


class Measured:
    """States of n channels, three a unit, 3 s after their start and before a sample in motion."""

    def __init__(self, seed, n):
        self.rng, self.axes, self.noise = random_channels(seed, n)
        self.layout, self.states = estimator(n, n // 3, self.axes)
        predict(self.layout, self.states, 3.0)
        self.n, self.count = n, int(self.layout["count"])
        self.x, self.p = self.x_and_p()
        self.at, self.parity, sensors = (
            allocate(one)[0] for one in (Projection, Parity, Sensors)
        )
        self.rate = self.rng.normal(0, 1, 3)
        fill_signals(
            self.layout,
            self.rate,
            self.rng.normal(0, 5, MAX_CHANNELS),
            self.at["signals"],
        )
        project(self.layout, self.states, self.at)
        known = np.zeros((MAX_CHANNELS, MAX_CHANNELS))
        known[:n, :n] = self.noise + self.at["covariance"][:n, :n]
        sensors["n"], sensors["axes"][:n] = n, self.axes
        fill_joint_parity(self.parity, sensors, (1 << n) - 1, known, 1e-6)
        self.columns = self.at["columns"][:n, : self.count].copy()
        self.information = self.parity["information"][:n, :n].copy()

    def x_and_p(self):
        return self.states["x"][: self.count].copy(), self.states["p"][
            : self.count, : self.count
        ].copy()

    def after(self, innovation, least):
        innovation = np.pad(innovation, (0, MAX_CHANNELS - len(innovation)))
        update(
            self.layout,
            self.states,
            self.at,
            self.parity["information"],
            innovation,
            1.0,
            least,
        )
        return self.x_and_p()


def test_a_value_given_again_and_again_counts_once():
    """The first time as a measurement that leaves its own variance, later not at all."""
    one = Measured(5, 6)
    one.after(one.rng.normal(0, 0.01, 6), np.zeros(MAX_STATES))
    x, p = one.x_and_p()
    place = one.layout["delays"][1]
    variance = 0.3 * p[place, place]
    total = p[place, place] ** 2 / (p[place, place] - variance)
    gain = p[:, place] / total
    for _ in range(3):
        bound_variance(one.layout, one.states, place, 0.02, variance)
        after_x, after_p = one.x_and_p()
        assert after_p[place, place] == pytest.approx(variance, rel=1e-9)
        assert after_x == pytest.approx(x + gain * (0.02 - x[place]), abs=1e-12)
        assert after_p == pytest.approx(
            p - total * np.outer(gain, gain), rel=1e-9, abs=1e-15
        )


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([6, 9]))
def test_a_measurement_is_taken_as_by_a_filter_that_knows_nothing_of_the_rate(seed, n):
    """The joint filter of states and rate, with a prior of the rate as wide as that of the elimination."""
    one = Measured(seed, n)
    matrix = np.zeros((n, one.count))
    for i, k in np.argwhere(one.layout["place"][:n] >= 0):
        matrix[i, one.layout["place"][i, k]] = one.at["signals"][i, k]
    np.testing.assert_allclose(
        one.at["covariance"][:n, :n], matrix @ one.p @ matrix.T, rtol=1e-9, atol=1e-15
    )
    y, innovation = (
        one.axes @ one.rate + one.rng.normal(0, 0.01, n),
        np.zeros(MAX_CHANNELS),
    )
    subtract_errors(
        one.layout,
        one.states,
        one.at["signals"],
        np.pad(y, (0, MAX_CHANNELS - n)),
        innovation,
    )
    joint = np.block(
        [[one.p, np.zeros((one.count, 3))], [np.zeros((3, one.count)), 1e6 * np.eye(3)]]
    )
    both = np.hstack([matrix, one.axes])
    gain = joint @ both.T @ np.linalg.inv(both @ joint @ both.T + one.noise)
    x, p = one.after(innovation[:n], np.zeros(MAX_STATES))
    np.testing.assert_allclose(
        x, (np.pad(one.x, (0, 3)) + gain @ (y - matrix @ one.x))[: one.count], atol=1e-7
    )
    np.testing.assert_allclose(
        p, (joint - gain @ both @ joint)[: one.count, : one.count], atol=1e-9
    )


@settings(max_examples=12)
@given(seed=st.integers(0, 2**32 - 1), taken=st.floats(0.0, 1.2))
def test_no_state_is_known_better_than_it_can_be_taught(seed, taken):
    """Least variances hold, and the covariance is that of the gain as cut: (I - D K) P (I - D K)' + D K M K' D."""
    one = Measured(seed, 6)
    whole = one.columns.T @ one.information @ one.columns
    least, innovation, motion = (
        np.zeros(MAX_STATES),
        one.rng.normal(0, 0.01, 6),
        slice(6, 6 + 18),
    )
    least[motion] = (np.diag(one.p) - taken * np.diag(whole))[motion]
    x, p = one.after(innovation, least)
    assert (
        np.diag(p)[motion]
        >= (np.diag(one.p - min(taken, 1.0) * whole))[motion] * (1 - 1e-9)
    ).all()
    share = np.diag(one.at["share"][: one.count])
    np.testing.assert_allclose(
        p, one.p - share @ whole - whole @ share + share @ whole @ share, atol=1e-12
    )
    np.testing.assert_allclose(
        x, one.x + share @ one.columns.T @ one.information @ innovation, atol=1e-12
    )
    assert np.linalg.eigvalsh(p).min() > -1e-12


@settings(max_examples=10)
@given(seconds=st.floats(0.01, 5000.0))
def test_time_passes_as_in_the_linear_model(seconds):
    """The mean by the matrix exponential; that the steps are cut does not matter to it."""
    layout, states = estimator(6, 2)
    count, rng = int(layout["count"]), np.random.default_rng(1)
    states["x"][:count] = rng.normal(0, 1, count)
    flow = np.zeros((count, count))
    for r in range(count):
        if layout["feeds"][r] >= 0:
            flow[layout["feeds"][r], r], flow[r, r] = 1.0, -1.0 / layout["memory"][r]
    expected = expm(seconds * flow) @ states["x"][:count]
    for _ in range(4):
        predict(layout, states, seconds / 4)
    np.testing.assert_allclose(states["x"][:count], expected, rtol=1e-9)
    assert np.linalg.eigvalsh(states["p"][:count, :count]).min() > 0


def test_what_is_not_known_grows_as_in_the_linear_model():
    """Covariance of the exact discretisation (Van Loan); the filter's steps are those of its blocks."""
    layout, states = estimator(6, 2)
    count, seconds, steps = int(layout["count"]), 100.0, 2500
    before = states["p"][:count, :count].copy()
    flow, noise = np.zeros((count, count)), np.diag(layout["walk"][:count] ** 2)
    for r in range(count):
        if layout["feeds"][r] >= 0:
            flow[layout["feeds"][r], r], flow[r, r] = 1.0, -1.0 / layout["memory"][r]
            noise[r, r] += 2.0 * layout["prior"][r] ** 2 / layout["memory"][r]
    joint = np.block([[-flow, noise], [np.zeros_like(flow), flow.T]])
    moved = expm(joint * seconds)
    transition = moved[count:, count:].T
    expected = transition @ before @ transition.T
    expected += transition @ moved[:count, count:]
    for _ in range(steps):
        predict(layout, states, seconds / steps)
    found = states["p"][:count, :count]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.005)
    grown = np.diag(found) - np.diag(before)
    assert (grown[layout["walk"][:count] > 0] > 0).all()


ALL = 0b111111


def restamped(late, samples):
    """Channels and values (6,) that two units of three channels are given, of stamps, values and what is plain."""
    line, sample, out = (
        allocate(DelayBuffer)[0],
        allocate(Sample)[0],
        np.zeros(MAX_CHANNELS),
    )
    config = allocate(PathSettings)[0]
    config["n"], config["units"], config["members"] = 6, 2, [0b111, 0b111000, 0, 0]
    for sample["stamp"], sample["z"][:6], plain in samples:
        found = restamp(
            line, config, np.array([*late, 0.0, 0.0]), sample, ALL, plain, out
        )
        yield found, out[:6].copy()


@settings(max_examples=15)
@given(late=st.floats(-0.05, 0.05), rate=st.sampled_from([50.0, 100.0, 400.0, 1000.0]))
def test_late_units_are_brought_to_one_instant(late, rate):
    """Straight lines in time come out as they went in: all of one instant, that of the latest unit."""
    slope, late = (
        np.array([1.0, -2.0, 3.0, 0.5, 4.0, -1.0]),
        late if abs(late) >= 1e-6 else 0.0,
    )
    stamps = np.arange(200) * round(1e9 / rate)
    of_unit = np.repeat([0.0, late], 3)
    told = list(
        restamped(
            (0.0, late),
            ((k, slope * (1e-9 * k - of_unit), ALL) for k in stamps.tolist()),
        )
    )
    found, out = told[-1]
    assert found == ALL
    np.testing.assert_allclose(
        out, slope * (1e-9 * stamps[-1] - max(late, 0.0)), atol=1e-8
    )


def test_a_hole_is_not_bridged():
    stamps = [*range(0, 300_000_000, 10_000_000), 390_000_000]
    *_, (found, out) = restamped(
        (0.0, 0.025), ((stamp, np.arange(6.0), ALL) for stamp in stamps)
    )
    # The first unit stands back by 25 ms: into the hole.
    assert found == 0b111000
    assert np.isnan(out[:3]).all()


@pytest.mark.parametrize("bad", [1e9, np.inf, np.nan])
def test_a_value_out_of_range_reaches_no_other_instant(bad):
    wild = np.array([1.0, bad, 1.0, 1.0, 1.0, 1.0])
    samples = [
        (k * 10_000_000, wild if k == 30 else np.ones(6), 0b111101 if k == 30 else ALL)
        for k in range(60)
    ]
    told = list(restamped((0.0, 0.025), samples))
    for found, out in told:
        np.testing.assert_allclose(
            out[[i for i in range(6) if found >> i & 1]], 1.0, atol=1e-9
        )
    assert 1 <= sum(not found >> 1 & 1 for found, _ in told[11:]) <= 2
