# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The published covariance is true where little or nothing checks the channels, and no healthy gyro is named.

The flights are those of ``benchmark/physics.py``. NEES is bounded from below as well: a covariance that claims too
little is of no use.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from fdi_ros import Pipeline

# For this import alone: a module there has the name of a folder of tests.
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))
from physics import CONDITIONS, config_of, fly
from trials import Asked

sys.path.pop(0)

FLIGHTS = 3


def flown(mounting, name, **settings):
    condition = CONDITIONS[name]
    changes = {key.replace("__", "."): value for key, value in settings.items()}
    config = config_of(mounting, 100.0, {**condition.settings, **changes}, Asked())
    pipeline = Pipeline.from_config(config)
    flights = [
        fly(pipeline, mounting, name, 0.0, np.random.default_rng([k, 7]))
        for k in range(FLIGHTS)
    ]
    return {
        key: np.array([getattr(one, key) for one in flights])
        for key in ("nees", "level", "wrong", "no_rate")
    }


@pytest.mark.parametrize("mounting", ["cone", "2 units", "3 units"])
@pytest.mark.parametrize(
    "name", ["one unit ever", "unit lost at rest", "unit lost at rest, tones 0.05"]
)
def test_the_covariance_is_true_without_redundancy(mounting, name):
    found = flown(mounting, name)
    # With two units left there is a check, and less to allow for.
    checked = mounting == "3 units" and name != "one unit ever"
    assert (0.5 if checked else 0.3) < found["nees"].mean() < 2.0, found
    assert found["nees"].max() < 3.0, found
    assert not found["wrong"].any()
    assert not found["no_rate"].any()


@pytest.mark.parametrize("mounting", ["cone", "3 units"])
def test_a_bias_that_was_never_learned_is_in_the_covariance(mounting):
    found = flown(mounting, "one unit ever", bias__startup_bias_duration=0.0)
    assert 0.2 < found["nees"].mean() < 2.0, found


@pytest.mark.parametrize(
    ("name", "size", "seeds"),
    [
        ("unit x0.5", 0.0, (53, 63, 64, 66)),
        ("unit turned", 0.0, (51, 52)),
        ("warming 20 mrad/s", 0.1, (55,)),
    ],
)
def test_no_healthy_gyro_is_named_where_no_fault_of_one_explains(name, size, seeds):
    """A unit is wrong as a whole, or all gyros warm before one fails."""
    label = f"cone, 100 Hz, {name}"
    pipeline = Pipeline.from_config(config_of("cone", 100.0, {}, Asked()))
    for seed in seeds:
        words = (label, "t_01", 0) if size else (label, 0)
        flight = fly(pipeline, "cone", name, size, Asked(1, seed).rng(*words))
        assert not flight.wrong, seed
        if size:
            assert flight.named < 1.0, seed
        else:
            assert flight.whole.touched < 1.0, seed
            assert flight.whole.soon, seed


@pytest.mark.parametrize(
    "name", ["unit x0.5", "unit x8.0", "unit swapped", "unit mirrored", "unit offset"]
)
def test_a_unit_that_is_wrong_as_a_whole_stands_in_time(name):
    """All its affected axes are declared and stay so, and the replay tells few episodes."""
    pipeline = Pipeline.from_config(config_of("3 units", 100.0, {}, Asked()))
    flights = [
        fly(pipeline, "3 units", name, 0.0, np.random.default_rng([k, 7]))
        for k in range(FLIGHTS)
    ]
    assert not any(flight.wrong for flight in flights)
    assert all(flight.whole.soon for flight in flights)
    assert all(flight.whole.held > 0.9 for flight in flights)
    assert all(1 <= flight.whole.episodes <= 3 for flight in flights)
