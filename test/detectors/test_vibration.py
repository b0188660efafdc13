# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Healthy gyros as vehicles shake them: the published covariance and level are true, and no channel is blamed.

The flights are those of ``benchmark/vibration.py``, which measures many more of them.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from fdi_ros import Block, Pipeline

# For this import alone: a module there has the name of a folder of tests.
sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))
import physics
from trials import START, Asked
from vibration import CONDITIONS, config_of, judged

sys.path.pop(0)

FLIGHTS = 2


def flown(units, name):
    pipeline = Pipeline.from_config(config_of(units, CONDITIONS[name][0], Asked()))
    flights = [
        judged(pipeline, name, np.random.default_rng([units, k]))
        for k in range(FLIGHTS)
    ]
    return {key: np.array([flight[key] for flight in flights]) for key in flights[0]}


LEAST = {
    "white": 0.6,
    "unit 1 late by 20 ms": 0.28,
    "unit 2 late by 20 ms": 0.28,
    "own tones 0.03 43.0 Hz at 100": 0.25,
    "own tones 0.1 12.7 Hz at 100": 0.2,
    "body 0.1 43.0 Hz at 100": 0.05,
    "body 0.03 149.0 Hz at 50": 0.3,
    "body broadband 0.05": 0.05,
    "AR 0.9": 0.6,
    "low pass 30 Hz at 400": 0.45,
    "clocks 50 ppm": 0.5,
    "landing shock 5 rad/s": 0.4,
}
"""Least NEES / 3 of two flights, below those of twelve such pairs with two to four units.

A covariance that is too large is of no use either. Where the whole body shakes, NEES differs much
from flight to flight.
"""


@pytest.mark.parametrize("units", [2, 4])
@pytest.mark.parametrize("name", LEAST)
def test_the_covariance_is_true(units, name):
    found = flown(units, name)
    assert LEAST[name] < found["nees"].mean() < 2.0, found
    assert found["nees"].max() < 5.0, found
    assert found["level"].max() < 0.005, found
    assert not found["faulty"].any(), found


@pytest.mark.parametrize("name", ["one unit x3", "one channel x10"])
def test_weights_follow_the_noise(name):
    """Beside the best weighted mean of gyros whose errors are all known; the others are estimated on the way."""
    assert flown(2, name)["over_best"].mean() < 1.35
    assert flown(3, name)["over_best"].mean() < 1.35


@pytest.mark.parametrize("units", [3, 4])
def test_biases_that_all_move_are_followed(units):
    """As motors start, or while all gyros warm up: stated, and no set that stands for the flight."""
    for name in ("rectified 5 mrad/s", "warming 20 mrad/s"):
        found = flown(units, name)
        assert 0.2 < found["nees"].mean() < 3.0, found
        assert found["ok"].mean() > 0.8, found


def test_six_gyros_that_warm_name_none_of_them():
    """Their biases move by 20 mrad/s in half a minute, which may look like a drift of one."""
    label = "cone, 50 Hz, warming 20 mrad/s"
    asked = Asked(seed=36)
    pipeline = Pipeline.from_config(physics.config_of("cone", 50.0, {}, asked))
    rng = asked.rng(label, 0)
    assert not physics.fly(pipeline, "cone", "warming 20 mrad/s", 0.0, rng).wrong


@pytest.mark.parametrize("seed", [5, 17, 21])
def test_vibration_near_the_sample_rate_is_no_delay(seed):
    """It looks like a slow turn, which a unit 0.6 ms late shows as if it were several ms late."""
    settings = {
        "noise.noise_std": (0.001,),
        "noise.scale_std": (0.005,),
        "imus.mounts": (),
    }
    pipeline = Pipeline.from_config(config_of(2, 100.0, Asked(settings=settings)))
    rng = np.random.default_rng(seed)
    slow, phase = rng.uniform(0.3, 1.2, 3), rng.uniform(0.0, 2.0 * np.pi, 3)
    hertz, shifted = rng.uniform(103.0, 117.0), rng.uniform(0.0, 2.0 * np.pi, 3)
    shaken = 0.13 * rng.uniform(0.2, 1.0, 3)

    def rate_at(t):
        turn = 1.5 * np.sin(2.0 * np.pi * np.outer(t, slow) + phase)
        vibration = shaken * np.sin(2.0 * np.pi * hertz * t[:, None] + shifted)
        return np.clip((t - 8.0) / 2.0, 0.0, 1.0)[:, None] * (turn + vibration)

    t = np.arange(4000) / 100.0
    z = np.hstack([rate_at(t), rate_at(t - 0.0006)])
    z += 0.001 * rng.standard_normal(z.shape) + rng.normal(0.0, 0.005, 6)
    output = pipeline.process(Block(START + np.round(1e9 * t).astype(np.int64), z))
    error = (output.rate - rate_at(t + (output.instant - output.stamp) * 1e-9))[900:]
    covariance = output.covariance[900:]
    weighed = np.linalg.solve(covariance, error[..., None])[..., 0]
    assert 0.1 < (error * weighed).sum(axis=1).mean() / 3.0 < 2.0
    assert not any(event.declares for event in output.events)
