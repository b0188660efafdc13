# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoother against all windows written into one large system."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.setup.estimate import NormalEquations, find_random_walk, smooth


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(2, 8), st.integers(1, 3), st.integers(1, 4), st.floats(0.05, 3.0))
def test_it_solves_the_whole_system(seed: int, windows: int, n: int, m: int, walk: float) -> None:
    rng, size = np.random.default_rng(seed), windows * n + m
    rows, y = rng.standard_normal((windows, n + m + 2, n + m)), rng.standard_normal((windows, n + m + 2))
    normal, rights = np.einsum("kai,kaj->kij", rows, rows), np.einsum("kai,ka->ki", rows, y)
    apart, start = rng.uniform(0.5, 2.0, windows), rng.standard_normal(n + m)
    prior = np.concatenate([np.full(n, rng.uniform(0.5, 2.0)), rng.uniform(0.5, 2.0, m)])
    whole, right, constants = np.zeros((size, size)), np.zeros(size), np.arange(windows * n, size)
    for k in range(windows):
        own = np.concatenate([np.arange(k * n, k * n + n), constants])
        whole[np.ix_(own, own)] += normal[k]
        right[own] += rights[k]
    first = np.concatenate([np.arange(n), constants])
    whole[first, first] += prior**-2
    right[first] += prior**-2 * start
    for k in range(windows - 1):
        here, then, weight = np.arange(k * n, k * n + n), np.arange(k * n + n, k * n + 2 * n), 1 / walk**2 / apart[k]
        for a, b, sign in ((here, here, 1), (then, then, 1), (here, then, -1), (then, here, -1)):
            whole[a, b] += sign * weight
    covariance = np.linalg.inv(whole)
    x, found = covariance @ right, smooth(NormalEquations(n, normal, rights, apart, prior, start), walk)
    mean = np.hstack([np.kron(np.ones((1, windows)), np.eye(n)) / windows, np.zeros((n, m))])
    np.testing.assert_allclose(found.curve.ravel(), x[: windows * n], atol=1e-9)
    np.testing.assert_allclose(found.constant, x[windows * n :], atol=1e-9)
    np.testing.assert_allclose(found.constant_covariance, covariance[np.ix_(constants, constants)], atol=1e-9)
    np.testing.assert_allclose(found.mean_covariance, mean @ covariance @ mean.T, atol=1e-9)


def test_the_walk_is_found_where_there_is_one() -> None:
    rng, windows, walk, noise = np.random.default_rng(3), 300, 5e-4, 1e-3
    for true in (walk, 0.0):
        bias = np.cumsum(true * rng.standard_normal((windows, 3)), axis=0)
        normal = np.tile(np.diag([noise**-2.0] * 3 + [1e-9]), (windows, 1, 1))
        right = np.hstack([(bias + noise * rng.standard_normal((windows, 3))) / noise**2, np.zeros((windows, 1))])
        prior = np.array([0.02] * 3 + [1.0])
        found = find_random_walk(NormalEquations(3, normal, right, np.ones(windows), prior, np.zeros(4)))
        if true:
            assert 0.6 < found.value / true < 1.6
        else:
            assert found.value == 0.0
            assert found.possible < 1e-4
