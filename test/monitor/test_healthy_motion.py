# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors and motions that healthy gyros have are no fault, and the same in a larger size is one."""

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, START, declarations, parallel, swing

from fdi_ros.compiling.compiled import allocate
from fdi_ros.estimator.error_states import ErrorStates
from fdi_ros.estimator.noise import MOTION, REST
from fdi_ros.estimator.rest import rests
from fdi_ros.estimator.snapshots import predict_from
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline


def times(seconds):
    return np.arange(round(seconds * RATE)) / RATE


def passed(pipeline, z):
    """Output of a monitor for values (N, n) at the usual rate."""
    stamps = START + np.round(1e9 * times(len(z) / RATE)).astype(np.int64)
    return pipeline.process(Block(stamps, z))


@pytest.mark.parametrize(
    ("fault", "least", "most"), [(0.0, 0.0, 0.25), (0.5, 0.99, 9.0)]
)
def test_a_turn_within_a_block_is_explained_by_scale_errors(fault, least, most):
    """From rest to 10 rad/s: scale errors of 1 % are 40 deviations of the noise, and were not seen before."""
    random = np.random.default_rng(1)
    settings = parallel(3, detector__name="sequential", noise__scale_std=0.01)
    z = random.normal(0.0, SIGMA, (640, 9))
    rate = 10.0 * np.tile([0.6, 0.6, 0.5], 3)
    z[603:] += rate * (1.0 + random.normal(0.0, 0.01, 9))
    z[615:, 4] += fault
    output = passed(Pipeline(settings), z)
    assert least <= np.nanmax(output.statistic[600:] / output.threshold[600:]) < most


@pytest.mark.parametrize(("size", "alarms"), [(1.0, False), (300.0, True)])
def test_errors_that_are_not_linear_in_the_rate_are_none_up_to_their_usual_size(
    size, alarms
):
    """Positive and negative rates have scales apart by 3e-4 (standard deviation); one channel by `size` times that."""
    noise = 5e-4
    for seed in (3, 4, 6):
        random = np.random.default_rng(seed)
        settings = parallel(3, detector__name="sequential", noise__noise_std=noise)
        time = times(20.0)
        turns = 2 * np.pi * np.outer(time, [0.15, 0.17, 0.13]) + np.arange(3.0)
        rate = np.tile(10.0 * np.sin(turns), 3)
        apart = random.normal(0.0, 3e-4, 9)
        apart[4] = size * 3e-4
        z = rate + apart * np.abs(rate) + random.normal(0.0, noise, rate.shape)
        output = passed(Pipeline(settings), z)
        largest = np.nanmax(output.statistic / output.threshold)
        assert largest >= 1.0 if alarms else largest < 0.8


@pytest.mark.parametrize(("std", "least", "most"), [(0.006, 0, 2), (0.1, 5, 6)])
def test_all_biases_may_move_at_once_by_a_few_mrad_per_s(std, least, most):
    """As motors start; a hundred are too many."""
    declared = 0
    for seed in range(6):
        random = np.random.default_rng(seed)
        settings = parallel(4, detector__name="sequential", noise__noise_std=1e-3)
        pipeline = Pipeline(settings)
        z = np.tile(swing(times(14.0)), 4)
        z += random.normal(0.0, 1e-3, z.shape)
        z[1000:] += random.normal(0.0, std, 12)
        declared += bool(declarations(pipeline, passed(pipeline, z)))
    assert least <= declared <= most


@pytest.mark.parametrize(("deviations", "moves"), [(2.0, False), (12.0, True)])
def test_a_slow_turn_ends_rest_at_once_where_it_exceeds_the_noise_of_the_rate(
    deviations, moves
):
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    z = np.random.default_rng(0).normal(0.0, SIGMA, (2010, 9))
    passed(pipeline, z[:2000])
    regime = pipeline.guard.states["estimator"]["noise"]["regime"]
    assert regime[0] == REST
    z[2000:, [1, 4, 7]] += deviations * SIGMA / np.sqrt(3.0)
    stamps = START + np.arange(2000, 2010) * round(1e9 / RATE)
    pipeline.process(Block(stamps, z[2000:]))
    assert (regime[0] == MOTION) == moves


@pytest.mark.parametrize(("last", "resting"), [(2.0, True), (5.0, False)])
def test_one_block_that_is_far_off_ends_rest(last, resting):
    """In deviations of a block of one axis; all earlier ones of the second are as usual."""
    rates = np.random.default_rng(0).normal(0.0, 1e-3, (25, 3))
    rates[24] = [0.0, last * 1e-3, 0.0]
    assert rests(rates, 24, np.full(3, 1e-6), np.full(3, 1e-6), 1e-8) == resting
    assert rests(rates[::-1].copy(), 3, np.full(3, 1e-6), np.full(3, 1e-6), 1e-8)


def test_the_noise_of_blocks_is_learned_while_scales_are_unknown():
    """Two units with scales apart by 1 %: white noise has the same variance in a block, times its samples."""
    random = np.random.default_rng(0)
    noise = {"noise__noise_std": 1e-3, "noise__scale_std": 0.02}
    pipeline = Pipeline(parallel(2, detector__name="sequential", **noise))
    z = np.tile(swing(times(10.0), 3.0), 2) * (1.0 + random.normal(0.0, 0.01, 6))
    passed(pipeline, z + random.normal(0.0, 1e-3, z.shape))
    learned = pipeline.guard.states["estimator"]["noise"]["now"]["block"][0, :6]
    assert 0.3e-6 < learned.mean() < 2e-6


def test_before_a_fault_a_delay_is_what_it_was_though_it_is_taken_off_since():
    """States before the onset refer to values as they are now: late by 8 ms less what is made up for."""
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    time, delay = times(30.0), 0.008
    z = np.hstack([swing(time, 2.0), swing(time - delay, 2.0), swing(time, 2.0)])
    z += np.random.default_rng(0).normal(0.0, SIGMA, z.shape)
    params, state = pipeline.guard.constants[0], pipeline.guard.states[0]["estimator"]
    place = params["layout"]["delays"][1]
    passed(pipeline, z)
    assert 0.007 < state["late"][1] < 0.009
    found = allocate(ErrorStates)[0]
    kept = state["snapshots"]
    # A snapshot from before the delay was taken off, when it was known already.
    early = (kept["late"][:, 1] == 0.0) & (kept["states"]["x"][:, place] > 0.006)
    assert early.any()
    assert predict_from(params, state, kept["seconds"][early].max(), found)
    assert abs(found["x"][place]) < 0.002
