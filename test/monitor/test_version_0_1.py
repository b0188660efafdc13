"""The monitor says what version 0.1 said: every state, event and alarm exactly, every figure up to rounding.

`make_version_0_1.py` has the cases and wrote down what 0.1 made of them.
"""

import functools
import json

import numpy as np
import pytest
from monitor.make_version_0_1 import CASES, FILE, run

ROUNDING = 1e-9
LEARNED = 1e-6
"""0.1 averaged biases in steps of 2^-32 rad/s."""
CUSUM = 1e-5
"""And summed in steps of 2^-24 standard deviations."""


@functools.cache
def recorded():
    with np.load(FILE) as data:
        said = json.loads(data["said"].tobytes())
        return {name: (said[name], data[f"figures {name}"]) for name in said}


def tolerance(name):
    about = f"{CASES[name].settings} {CASES[name].actions}"
    return CUSUM if "cusum" in about else LEARNED if "startup" in about or "relearn" in about else ROUNDING


def close(size):
    return functools.partial(pytest.approx, rel=size, abs=0.01 * size)


def test_every_case_is_recorded():
    assert list(recorded()) == list(CASES)


@pytest.mark.parametrize("name", CASES)
def test_as_version_0_1(name):
    said, figures = recorded()[name]
    now = run(name)
    near = close(tolerance(name))
    assert [event[:-1] for event in now["events"]] == [event[:-1] for event in said["events"]]
    assert [event[-1] for event in now["events"]] == near([event[-1] for event in said["events"]])
    for field in ("stamps", "states", "valid", "alarm"):
        assert now[field] == said[field], field
    for field, value in said["status"].items():
        numbers = field in ("bias", "errors", "after loss")
        assert now["status"][field] == (near(value) if numbers else value), field
    finite = np.isfinite(figures)
    np.testing.assert_array_equal(now["figures"][~finite], figures[~finite])
    gap = np.abs(now["figures"][finite] - figures[finite])
    off = np.flatnonzero(finite)[gap > tolerance(name) * now["scale"][finite]]
    assert len(off) == 0, f"figures {off} are {now['figures'][off]}, were {figures[off]}"
