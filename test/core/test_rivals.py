# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The protection level holds where the name of the faulty channel is wrong, and stays finite where no other fits."""

import numpy as np
import pytest
from monitor.streams import mounted

from fdi_ros import Block, Pipeline
from fdi_ros.model.geometry import Geometry

RATE, ONSET, NOISE = 100, 12.0, 0.003
PARALLEL = np.tile(np.eye(3), (3, 1))


def flown(axes, faults, seed):
    """Return the output on biases from the onset on, errors (N, 3) of the fused rate, and times (N,)."""
    seconds = np.arange(30 * RATE) / RATE
    rate = np.where(seconds > 5.0, 0.5, 0.0)[:, None] * np.sin(seconds[:, None] * [1.0, 1.3, 0.7])
    values = rate @ axes.T + NOISE * np.random.default_rng(seed).standard_normal((len(seconds), len(axes)))
    for channel, bias in faults.items():
        values[seconds >= ONSET, channel] += bias
    stamps = (1e9 * seconds).astype(np.int64) + 10**18
    settings = mounted(axes, noise__noise_std=NOISE, bias__startup_bias_duration=4.0)
    output = Pipeline(settings).process(Block(stamps, values))
    return output, output.rate - rate, seconds


@pytest.mark.parametrize("size", [0.03, 0.3])
def test_two_alike_of_three_parallel_gyros(size):
    """They have the third named, as parity must: the level then covers the pair."""
    output, error, seconds = flown(PARALLEL, {0: size, 3: size}, 1)
    assert [event.channel for event in output.events if event.after.name == "FAULTY"] == [6]
    after = seconds > ONSET + 1.0
    assert (np.abs(error[after]) <= output.level[after]).all()
    assert size < output.level[after, 0].max() < size + 0.1


@pytest.mark.parametrize("seed", range(3))
def test_what_no_others_explain_leaves_the_level_alone(seed):
    """On the cone no one or two channels look like a large fault of another; what is left is checked by fewer."""
    output, error, seconds = flown(Geometry.two_triad_cone().axes, {0: 0.5}, seed)
    before, after = (seconds > 9.0) & (seconds < ONSET), seconds > ONSET + 1.0
    assert (np.abs(error[after]) <= output.level[after]).all()
    assert np.median(output.level[after]) < 3.0 * np.median(output.level[before])
