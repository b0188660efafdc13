# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error states against textbook formulas: elimination of the rate, the filter, the layout; and the delay line."""

import numpy as np
import pytest
from detectors.detector_trials import random_axes
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from fdi_ros.compiling.compiled import allocate
from fdi_ros.compiling.record import MAX_CHANNELS
from fdi_ros.core.alignment import restamp
from fdi_ros.core.parity import compute_joint_weights, eliminate_rate
from fdi_ros.core.records import DelayBuffer, Parity
from fdi_ros.estimator.error_states import (
    MAX_STATES,
    ErrorStates,
    Layout,
    Projection,
    begin_states,
    fill_signals,
    predict,
    prepare_layout,
    project,
    subtract_errors,
    update,
)

PRIORS = {"bias": 0.01, "scale": 0.02, "delay": 0.01, "bias rate": 1e-4, "clock rate": 1e-4}
WALKS = {"bias": 1e-3, "scale": 1e-4, "delay": 1e-4}


def random_channels(seed, n):
    """Axes (n, 3) that span space by a wide margin, and a covariance (n, n) of errors."""
    rng = np.random.default_rng(seed)
    axes = random_axes(rng, n).axes
    while np.linalg.svd(axes, compute_uv=False)[-1] < 0.3:
        axes = random_axes(rng, n).axes
    root = 1e-3 * (rng.normal(0, 0.4, (n, n)) + np.diag(rng.uniform(0.7, 2.0, n)))
    return rng, axes.copy(), root @ root.T


def padded(matrix):
    full = np.zeros((MAX_CHANNELS, MAX_CHANNELS))
    full[: len(matrix), : len(matrix)] = matrix
    return full


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(4, 12), absent=st.integers(0, 4))
def test_information_is_that_of_the_parity_vector(seed, n, absent):
    """A = V' (V M V')^-1 V with any basis V of the null space, of the channels that are there; G is least squares."""
    rng, axes, covariance = random_channels(seed, n)
    gone = rng.choice(n, min(absent, n - 4), replace=False)
    kept = np.setdiff1d(np.arange(n), gone)
    if np.linalg.svd(axes[kept], compute_uv=False)[-1] < 0.1:
        return
    parity = allocate(Parity)[0]
    compute_joint_weights(parity, n, int((1 << kept).sum()), padded(covariance))
    eliminate_rate(parity, n, axes, 1e-9)
    null = np.linalg.svd(axes[kept])[0][:, 3:].T
    inner = covariance[np.ix_(kept, kept)]
    expected = null.T @ np.linalg.solve(null @ inner @ null.T, null)
    found = parity["information"][:n, :n]
    np.testing.assert_allclose(found[np.ix_(kept, kept)], expected, atol=1e-6 * np.abs(expected).max())
    assert not found[gone].any()
    weight = np.linalg.inv(inner)
    gain = np.linalg.solve(axes[kept].T @ weight @ axes[kept], axes[kept].T @ weight)
    np.testing.assert_allclose(parity["gain"][:, kept], gain, atol=1e-6 * np.abs(gain).max())


def estimator(n, units):
    layout, states, unit = allocate(Layout), allocate(ErrorStates), np.arange(n) * units // n
    prepare_layout(layout[0], unit, units, PRIORS, WALKS)
    begin_states(layout[0], states[0], np.full(n, 0.01))
    return layout[0], states[0], unit


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), n=st.sampled_from([6, 9]))
def test_a_measurement_is_taken_as_by_a_filter_that_knows_nothing_of_the_rate(seed, n):
    """The joint filter of states and rate, with a prior of the rate as wide as that of the elimination."""
    rng, axes, noise = random_channels(seed, n)
    layout, states, _ = estimator(n, n // 3)
    predict(layout, states, 3.0)
    count = int(layout["count"])
    before, prior = states["x"][:count].copy(), states["p"][:count, :count].copy()
    rate, turn, at = rng.normal(0, 1, 3), rng.normal(0, 5, MAX_CHANNELS), allocate(Projection)[0]
    fill_signals(layout, rate, turn, at["signals"])
    project(layout, states, at)
    matrix = np.zeros((n, count))
    for i in range(n):
        for k, place in enumerate(layout["place"][i]):
            if place >= 0:
                matrix[i, place] = at["signals"][i, k]
    np.testing.assert_allclose(at["covariance"][:n, :n], matrix @ prior @ matrix.T, rtol=1e-9, atol=1e-15)
    y = axes @ rate + rng.normal(0, 0.01, n)
    innovation = np.zeros(MAX_CHANNELS)
    values = np.concatenate([y, np.zeros(MAX_CHANNELS - n)])
    subtract_errors(layout, states, at["signals"], values, innovation)
    parity = allocate(Parity)[0]
    compute_joint_weights(parity, n, (1 << n) - 1, padded(noise + at["covariance"][:n, :n]))
    eliminate_rate(parity, n, axes, 1e-6)
    update(layout, states, at, parity["information"], innovation, 1.0, np.zeros(MAX_STATES))
    joint = np.block([[prior, np.zeros((count, 3))], [np.zeros((3, count)), 1e6 * np.eye(3)]])
    both = np.hstack([matrix, axes])
    gain = joint @ both.T @ np.linalg.inv(both @ joint @ both.T + noise)
    after = np.concatenate([before, np.zeros(3)]) + gain @ (y - matrix @ before)
    left = joint - gain @ both @ joint
    np.testing.assert_allclose(states["x"][:count], after[:count], atol=1e-7)
    np.testing.assert_allclose(states["p"][:count, :count], left[:count, :count], atol=1e-9)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 1.2))
def test_no_state_is_known_better_than_it_can_be_taught(seed, share):
    """Least variances hold, and the covariance is that of the gain as cut: (I - D K) P (I - D K)' + D K M K' D."""
    rng, axes, noise = random_channels(seed, 6)
    layout, states, _ = estimator(6, 2)
    predict(layout, states, 3.0)
    count = int(layout["count"])
    x, p = states["x"][:count].copy(), states["p"][:count, :count].copy()
    at, parity = allocate(Projection)[0], allocate(Parity)[0]
    fill_signals(layout, rng.normal(0, 1, 3), np.pad(rng.normal(0, 5, 6), (0, MAX_CHANNELS - 6)), at["signals"])
    project(layout, states, at)
    compute_joint_weights(parity, 6, ALL, padded(noise + at["covariance"][:6, :6]))
    eliminate_rate(parity, 6, axes, 1e-6)
    columns, information = at["columns"][:6, :count].copy(), parity["information"][:6, :6].copy()
    gained = np.diag(columns.T @ information @ columns)
    least, innovation = np.zeros(MAX_STATES), rng.normal(0, 0.01, 6)
    motion = slice(6, 6 + 18)
    least[motion] = (np.diag(p) - share * gained)[motion]
    update(layout, states, at, parity["information"], np.pad(innovation, (0, MAX_CHANNELS - 6)), 1.0, least)
    after = states["p"][:count, :count]
    assert (np.diag(after)[motion] >= (np.diag(p) - min(share, 1.0) * gained)[motion] * (1 - 1e-9)).all()
    taught, whole = np.diag(least[:count]), columns.T @ information @ columns
    np.testing.assert_allclose(after, p - taught @ whole - whole @ taught + taught @ whole @ taught, atol=1e-12)
    np.testing.assert_allclose(states["x"][:count], x + taught @ columns.T @ information @ innovation, atol=1e-12)
    assert np.linalg.eigvalsh(after).min() > -1e-12


@settings(max_examples=20)
@given(seconds=st.floats(0.01, 5000.0))
def test_time_passes_as_in_the_linear_model(seconds):
    """The mean by the matrix exponential; that the steps are cut does not matter to it."""
    layout, states, _ = estimator(6, 2)
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


ALL = 0b111111


def restamped(late, samples):
    """Channels and values (6,) that two units of three channels are given, of stamps, values and what is plain."""
    line, out, members = allocate(DelayBuffer)[0], np.zeros(MAX_CHANNELS), np.array([0b111, 0b111000, 0, 0])
    for stamp, values, plain in samples:
        full = np.concatenate([values, np.zeros(MAX_CHANNELS - 6)])
        found = restamp(line, 6, 2, members, np.array([*late, 0.0, 0.0]), stamp, full, ALL, plain, out)
        yield found, out[:6].copy()


@settings(max_examples=30)
@given(late=st.floats(-0.05, 0.05), rate=st.sampled_from([50.0, 100.0, 400.0, 1000.0]))
def test_late_units_are_brought_to_one_instant(late, rate):
    """Straight lines in time come out as they went in: all of one instant, that of the latest unit."""
    slope, late = np.array([1.0, -2.0, 3.0, 0.5, 4.0, -1.0]), late if abs(late) >= 1e-6 else 0.0
    stamps = np.arange(200) * round(1e9 / rate)
    of_unit = np.repeat([0.0, late], 3)
    told = list(restamped((0.0, late), ((k, slope * (1e-9 * k - of_unit), ALL) for k in stamps.tolist())))
    found, out = told[-1]
    assert found == ALL
    np.testing.assert_allclose(out, slope * (1e-9 * stamps[-1] - max(late, 0.0)), atol=1e-8)


def test_a_hole_is_not_bridged():
    stamps = [*range(0, 300_000_000, 10_000_000), 390_000_000]
    *_, (found, out) = restamped((0.0, 0.025), ((stamp, np.arange(6.0), ALL) for stamp in stamps))
    # The first unit stands back by 25 ms: into the hole.
    assert found == 0b111000
    assert np.isnan(out[:3]).all()


@pytest.mark.parametrize("bad", [1e9, np.inf, np.nan])
def test_a_value_out_of_range_reaches_no_other_instant(bad):
    wild = np.array([1.0, bad, 1.0, 1.0, 1.0, 1.0])
    samples = [(k * 10_000_000, wild if k == 30 else np.ones(6), 0b111101 if k == 30 else ALL) for k in range(60)]
    told = list(restamped((0.0, 0.025), samples))
    for found, out in told:
        np.testing.assert_allclose(out[[i for i in range(6) if found >> i & 1]], 1.0, atol=1e-9)
    assert 1 <= sum(not found >> 1 & 1 for found, _ in told[11:]) <= 2
