# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sums of evidence and the mean that is explained: how long they last, and what they leave to noise."""

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, START, parallel, swing

from fdi_ros.compiling.compiled import allocate
from fdi_ros.detectors.naming import noise_of_mean
from fdi_ros.detectors.sums import Scale, add_evidence
from fdi_ros.estimator.estimator import Estimator
from fdi_ros.estimator.noise import LONG, QUARTER
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline


class Evidence:
    """Sums of one time scale of three parallel units, given values of channel 4."""

    def __init__(self, at: int) -> None:
        self.at = at
        self.params = Pipeline(parallel(3, detector__name="sequential")).guard.constants
        self.limit = self.params[0]["limit"]
        self.estimator, self.scale = allocate(Estimator)[0], allocate(Scale)[0]
        self.estimator["judged"] = 1 << 4
        self.estimator["noise"]["cap"][:] = 1e9

    def take(self, value: float) -> float:
        """Add one value, in standard deviations; return the largest sum over its threshold."""
        self.scale["series"][self.scale["newest"], 4] = value
        add_evidence(self.params[0], self.estimator, self.scale, self.at, 0)
        return float(self.scale["sums"].max() / self.limit)


def test_what_has_passed_is_forgotten_soon_however_long_it_lasted():
    """After one fault of three deviations over 2000 values, and one that has just reached the threshold."""
    left = []
    for length in (40, 2000):
        sums = Evidence(QUARTER)
        assert max(sums.take(3.0) for _ in range(length)) > 1.0
        count = 1
        while sums.take(0.0) > 1e-3 and count < 5000:
            count += 1
        left.append(count)
    assert 5 < left[0] <= left[1] < 1500


@pytest.mark.parametrize(("at", "found"), [(QUARTER, True), (LONG, False)])
def test_only_at_the_longest_time_scale_a_third_of_the_noise_is_a_walk(at, found):
    """A bias walks by so much in the values of two seconds; a shorter time shows no walk."""
    sums = Evidence(at)
    largest = max(sums.take(0.33) for _ in range(2000))
    assert (largest > 1.0) == found
    assert max(sums.take(1.5) for _ in range(200)) > 1.0


def flown(seconds, size, seed=0):
    """Monitor of three parallel units after a flight; ``size`` gives that of the motion, from times (N,) in s."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    time = np.arange(round(seconds * RATE)) / RATE
    z = np.tile(size(time)[:, None] * swing(time, 1.0), 3)
    z += np.random.default_rng(seed).normal(0.0, SIGMA, z.shape)
    stamps = START + np.round(1e9 * time).astype(np.int64)
    pipeline.process(Block(stamps[:-1], z[:-1]))
    return pipeline, Block(stamps[-1:], z[-1:])


def slow(time):
    return np.full(len(time), 0.1)


def test_slow_noise_is_unknown_at_first_and_anew_in_a_motion_far_beyond_any_before():
    """A mean over two seconds in multiples of white noise: up to 17 as long as nothing longer was seen."""

    def multiple(seconds, size):
        guard = flown(seconds, size)[0].guard
        noise = guard.states["estimator"]["noise"][0]
        white = noise["now"]["sample"][4] / 200
        return noise_of_mean(guard.constants[0], noise, 4, 200) / white

    assert 8.0 < multiple(1.0, slow) < 20.0
    assert 0.9 < multiple(60.0, slow) < 1.8
    assert 3.0 < multiple(61.0, lambda time: np.where(time < 58.0, 0.1, 2.0)) < 20.0


@pytest.mark.parametrize(("share", "named"), [(0.0, True), (0.003, True), (0.1, False)])
def test_a_large_fault_is_named_beside_errors_of_a_few_thousandths_of_it(share, named):
    """Beside a fault of 10 rad/s, errors of axes and scale leave the other gyros off by some 30 mrad/s."""
    pipeline, last = flown(10.0, np.ones_like)
    state, samples = pipeline.guard.states[0], 50
    error = 10.0 * share * np.array([1.0, -1.0, 0.5, -0.5, 0.0, 1.0, -1.0, 0.7, 0.3])
    error[4] = 10.0
    state["estimator"]["total"]["values"][:9] += samples * error
    state["case"]["open"], state["case"]["suspects"] = True, 1 << 4
    state["case"]["onset"] = state["estimator"]["samples"] - samples + 2
    pipeline.process(last)
    inference = state["case"]["inference"]
    assert (inference["common"] == 1 << 4) == named
    assert inference["union"] >> 4 & 1


@pytest.mark.parametrize("samples", [8, 16])
def test_two_gyros_that_fail_in_turn_do_not_have_the_third_named(samples):
    """Their mean is that of the opposite fault of the third; single blocks show one of them each."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    z = np.random.default_rng(1).normal(0.0, SIGMA, (1400, 9))
    z += np.tile(swing(np.arange(1400) / RATE), 3)
    first = np.arange(400) // samples % 2 == 0
    z[1000:, 1] += 8.0 * SIGMA * first
    z[1000:, 4] += 8.0 * SIGMA * ~first
    output = pipeline.process(Block(START + np.arange(1400) * 10_000_000, z))
    assert not (output.state[:, 7] == ChannelState.FAULTY).any()
    doubted = (ChannelState.FAULTY, ChannelState.AMBIGUOUS)
    assert np.isin(output.state[-1, [1, 4]], doubted).all()
