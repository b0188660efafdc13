# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The monitor says what version 0.1 said: every state, event and alarm exactly, every figure up to rounding.

`make_version_0_1.py` has the cases and wrote down what 0.1 made of them.
"""

import functools
import json

import numpy as np
import pytest
from monitor.make_version_0_1 import CASES, FILE, SAMPLED, run

ROUNDING = 1e-9
LEARNED = 1e-3
"""0.1 took the plain mean of the start-up time, which a spike or a knock moves: biases as near as noise lets them be,
rad/s, and the figures that they enter are not compared."""
LEVELS = 3 * SAMPLED + 2
"""Figures of the protection level, the last ones of a case."""
CUSUM = 1e-5
"""And summed in steps of 2^-24 standard deviations."""


@functools.cache
def recorded():
    with np.load(FILE) as data:
        said = json.loads(data["said"].tobytes())
        return {name: (said[name], data[f"figures {name}"]) for name in said}


COVARIANCE = 138
CHANGES = {
    "noisy cusum": {COVARIANCE},
    "latched": {COVARIANCE},
    "four channels": {COVARIANCE},
    "two triads alike": {COVARIANCE},
    "two triads alike, max_residual": {COVARIANCE},
    "excluded from the start": {COVARIANCE},
    "three triads, recursive": {64, COVARIANCE, 248},
    "protection level": {64, COVARIANCE, 212},
}
"""Sums over all samples that the samples which change a declaration enter otherwise, by 2 % at most: 0.1 fused once
more what such a sample declares, and doubted once more what it clears."""
OF_A_BASIS = ("projector, l1 by qr",)
"""The l1 norm depends on the basis of parity space, and that of LAPACK's QR on its version: figures differ."""


def tolerance(name):
    about = f"{CASES[name].settings} {CASES[name].actions}"
    return CUSUM if "cusum" in about else ROUNDING


def learns(name):
    return "bias.startup_bias_duration" in CASES[name].settings


def close(name):
    if learns(name):
        return functools.partial(pytest.approx, rel=0, abs=LEARNED)
    return functools.partial(pytest.approx, rel=tolerance(name), abs=0.01 * tolerance(name))


def test_every_case_is_recorded():
    assert list(recorded()) == list(CASES)


@pytest.mark.parametrize("name", CASES)
def test_as_version_0_1(name):
    said, figures = recorded()[name]
    now = run(name)
    near = close(name)
    assert [event[:-1] for event in now["events"]] == [event[:-1] for event in said["events"]]
    assert [event[-1] for event in now["events"]] == near([event[-1] for event in said["events"]])
    for field in ("stamps", "states", "valid", "alarm"):
        assert now[field] == said[field], field
    for field, value in said["status"].items():
        if field == "after loss":
            # The protection level of 0.1 was for the greatest motion; now it is for that of the sample.
            continue
        if field == "of all":
            # The last is why nothing can be judged: there is a reason or there is none, and now it has better words.
            assert [*now["status"][field][:-1], bool(now["status"][field][-1])] == [*value[:-1], bool(value[-1])]
            continue
        numbers = field in ("bias", "errors")
        assert now["status"][field] == (near(value) if numbers else value), field
    if learns(name) or name in OF_A_BASIS:
        return
    figures, found, scale = figures[:-LEVELS], now["figures"][:-LEVELS], now["scale"][:-LEVELS]
    finite = np.isfinite(figures)
    np.testing.assert_array_equal(found[~finite], figures[~finite])
    off = np.flatnonzero(finite)[np.abs(found - figures)[finite] > tolerance(name) * scale[finite]]
    assert set(off) == CHANGES.get(name, set()), f"figures {off} are {found[off]}, were {figures[off]}"
    np.testing.assert_allclose(found[off], figures[off], rtol=0.02)
