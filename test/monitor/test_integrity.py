# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

import math
from itertools import combinations, product
from statistics import NormalDist

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor.streams import config, mounted, parallel, stream, told

from fdi_ros.core.level import fill_level, passes_test
from fdi_ros.core.subsets import prepare_subsets
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Block
from fdi_ros.monitor.integrity import Integrity
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline

ALARM = 1e-6
ALL = np.ones(6, dtype=bool)


def integrity(geometry=None, noise=1.0, *, prior=1e-3, risk=1e-5):
    settings = {
        "integrity.risk": risk,
        "integrity.fault_rate": -math.log1p(-prior),
        "integrity.exposure": 1.0,
    }
    return Integrity(
        config(**settings).integrity,
        ALARM,
        geometry or Geometry.two_triad_cone(),
        NoiseModel(noise),
    )


def block(z, first=0):
    return Block((first + np.arange(len(z))) * 10_000_000, z)


class Exceedance:
    """Probability that one axis is off by more than a level without an alarm, by importance sampling.

    Fault sizes are the worst of a grid for every set of faulty channels: the size is not known. The noise is drawn
    shifted towards the level along the estimator of that axis, and weighed by the ratio of the densities. The errors of
    the channels are root (n, k) times white noise; residuals beyond the limit (n,) are an alarm.
    """

    def __init__(self, geometry, prior, axis, root, limit):
        self.geometry, self.prior, self.root, self.limit = geometry, prior, root, limit
        self.gain = geometry.least_squares[axis]
        self.rng = np.random.default_rng(20240607)

    def of(self, level, draws):
        """Value and standard error of the sum over no fault, every single and every pair."""
        n, p = self.geometry.n, self.prior
        parts = []
        for size in (0, 1, 2):
            weight = p**size * (1 - p) ** (n - size)
            for chosen in combinations(range(n), size):
                worst = max(
                    self.under(fault, level, draws) for fault in self.faults(chosen)
                )
                parts.append((weight * worst[0], weight * worst[1]))
        values, errors = np.array(parts).T
        return values.sum(), np.sqrt((errors**2).sum())

    def faults(self, chosen):
        """Errors of the chosen channels that leave normalised residuals about at the threshold."""
        index = list(chosen)
        if not index:
            yield np.zeros(self.geometry.n)
            return
        inner = np.linalg.inv(self.geometry.S[np.ix_(index, index)])
        limit = self.limit[index]
        for sign in product([1.0], *[[1.0, -1.0]] * (len(index) - 1)):
            for strength in np.linspace(0.55, 1.0, 6):
                fault = np.zeros(self.geometry.n)
                fault[index] = inner @ (strength * limit * sign)
                yield fault

    def under(self, fault, level, draws):
        white = self.gain @ self.root
        length = np.linalg.norm(white)
        ahead = abs(self.gain @ fault)
        shift = max(level - ahead, 0.0) / length
        towards = white / length * (np.sign(self.gain @ fault) or 1.0)
        noise = self.rng.standard_normal((draws, len(white))) + shift * towards
        weight = np.exp(-shift * (noise @ towards) + shift**2 / 2)
        z = noise @ self.root.T + fault
        # Half of the exceedances of a fault-free sample are on the other side, where nothing was drawn.
        sides = 1 if fault.any() else 2
        missed = z @ self.gain * (np.sign(self.gain @ fault) or 1.0) > level
        missed &= (np.abs(z @ self.geometry.S) <= self.limit).all(axis=1)
        figure = sides * weight * missed
        return figure.mean(), figure.std() / np.sqrt(draws)


def level_and_limits(settings, rate):
    """Level in a steady turn, and up to which residuals there is one, both in units of the noise, 1e-3."""
    pipeline = Pipeline(settings)
    geometry = pipeline.geometry
    output = pipeline.process(block(np.tile(geometry.axes @ rate, (3, 1))))
    growth, limit = (
        pipeline.core["now"]["error_ratio"][0, : geometry.n],
        pipeline.subsets["limit"][-1, : geometry.n],
    )
    parts = geometry.S**2
    return 1e3 * output.level[-1], 1e3 * limit * np.sqrt(
        parts @ growth / parts.sum(axis=1)
    )


@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.8, 0.3, 0.0)])
@pytest.mark.parametrize(
    ("remaining", "prior", "risk"),
    [(0.0, 1e-2, 1e-3), (0.0, 1e-4, 1e-5), (0.5, 1e-3, 1e-4)],
)
def test_in_rest_and_in_motion_the_level_of_a_sample_holds_and_is_not_loose(
    rate, remaining, prior, risk
):
    """Errors of noise, of scale factors as the body turns, and of biases at the start.

    In the first samples of a turn the level is up to three times the one needed: nothing
    is known yet of how the scale errors of channels hang together, so each of them counts
    in full in the residuals, and once more in what no residual shows.
    """
    scale = 0.003
    settings = config(
        detector__false_alarms_per_hour=0.0,
        detector__false_alarm_probability=ALARM,
        noise__noise_std=1e-3,
        noise__scale_std=scale,
        bias__turn_on_std=1e-3 * remaining,
        integrity__risk=risk,
        integrity__fault_rate=-math.log1p(-prior),
    )
    geometry = Geometry.two_triad_cone()
    level, limit = level_and_limits(settings, np.array(rate))
    std = np.sqrt(1 + (1e3 * scale * geometry.axes @ np.array(rate)) ** 2)
    for axis in (0, 2):
        root = np.column_stack([np.diag(std), remaining * np.eye(geometry.n)])
        simulated = Exceedance(geometry, prior, axis, root, limit)
        value, error = simulated.of(level[axis], 1000)
        assert value + 1.645 * error <= risk
        value, error = simulated.of(level[axis] / (3 if any(rate) else 2), 300)
        assert value - 1.645 * error > risk


@pytest.mark.parametrize(
    ("name", "share", "most"),
    [("likelihood_ratio", 0.75, 12.0), ("sequential", 0.4, 7.0)],
)
@pytest.mark.parametrize("rate", [(0.0, 0.0, 1.0), (0.8, 0.3, 0.0)])
def test_half_a_second_of_a_turn_makes_the_level_smaller(rate, name, share, most):
    """Then the errors that channels do not have in common are known; the common ones never are.

    The level is at least 5.3 deviations of the fused rate, for a risk of 1e-7. Beyond
    that are faults too small to be noticed, which count more where biases are none.
    """
    linear = {"noise__scale_std": 0.003, "noise__nonlinearity_std": 0.0}
    pipeline = Pipeline(config(detector__name=name, **linear))
    z = np.tile(pipeline.geometry.axes @ np.array(rate), (50, 1))
    z += np.random.default_rng(0).normal(0.0, 0.0025, z.shape)
    output = pipeline.process(block(z))
    assert (output.level[-1] < share * output.level[2]).all()
    ratio = output.level[-1] / np.sqrt(np.diag(output.covariance[-1]))
    assert ratio.min() > 5.3
    assert ratio.max() < most


@settings(max_examples=25)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["cone", "parallel", "any"]))
def test_the_level_of_a_sample_bounds_the_exact_one_and_is_it_where_all_errors_grow_alike(
    seed, mounting
):
    rng = np.random.default_rng(seed)
    axes = rng.standard_normal((6, 3))
    geometry = {
        "cone": Geometry.two_triad_cone(),
        "parallel": Geometry.from_triads([np.eye(3), np.eye(3)]),
        "any": Geometry(axes / np.linalg.norm(axes, axis=1)[:, None]),
    }[mounting]
    noise = NoiseModel(rng.uniform(1.0, 3.0, 6))
    own, subsets = (
        integrity(geometry, noise.noise_std, prior=1e-4, risk=1e-7),
        prepare_subsets(geometry, noise),
    )
    own.fill(subsets, 63)
    level, growth = np.zeros(3), np.zeros(12)
    for ratio in (np.full(6, rng.uniform(1.0, 9.0)), rng.uniform(1.0, 9.0, 6)):
        growth[:6] = ratio
        exact = own.of(ALL, ratio * noise.noise_std**2)
        fill_level(subsets[63], 6, 63, growth, level)
        assert (level >= exact.level * (1 - 1e-9)).all()
        alike = ratio.min() == ratio.max()
        assert (
            level
            <= exact.level
            * (1 + 1e-9 if alike else math.sqrt(ratio.max() / ratio.min()))
        ).all()
        # And the test that it rests on is the exact one.
        given = (
            np.pad(geometry.axes, ((0, 6), (0, 0))),
            np.pad(noise.noise_std, (0, 6)),
            6,
            63,
            growth,
        )
        residual = np.pad(
            np.where(np.isfinite(exact.limit), exact.limit, 0.0), (0, 6)
        ) * (1 - 1e-9)
        assert passes_test(subsets[63], *given, residual)
        residual[rng.integers(6)] *= 1 + 1e-6
        assert not passes_test(subsets[63], *given, residual)


def test_without_faults_the_level_is_the_quantile_of_the_noise():
    level = integrity(noise=0.01, prior=0.0, risk=1e-4).of(ALL).level
    # H'H = 2 I: every component has half the variance of a channel.
    assert level == pytest.approx(
        0.01 * np.sqrt(0.5) * NormalDist().inv_cdf(1 - 0.5e-4) * np.ones(3), rel=1e-8
    )


@given(st.floats(1e-6, 1e-2), st.floats(1e-9, 1e-3), st.floats(1e-4, 10.0))
def test_the_level_grows_with_noise_and_priors_and_falls_with_risk(prior, risk, noise):
    level = integrity(prior=prior, risk=risk).of(ALL).level
    assert integrity(noise=noise, prior=prior, risk=risk).of(
        ALL
    ).level == pytest.approx(noise * level, rel=1e-9)
    assert (
        integrity(prior=2 * prior, risk=risk).of(ALL).level >= level * (1 - 1e-9)
    ).all()
    assert (
        integrity(prior=prior, risk=2 * risk).of(ALL).level <= level * (1 + 1e-9)
    ).all()


@pytest.mark.parametrize(
    ("channels", "prior", "risk", "given"),
    [
        # Without redundancy only faults that are rarer than the risk leave a level, and two channels none.
        (3, 1e-3, 1e-5, False),
        (3, 1e-7, 1e-5, True),
        (2, 1e-9, 1e-2, False),
        # Parallel triads protect against one fault; three pairs of twins at 1e-8 each are more than the lower risk.
        (0, 1e-4, 1e-7, True),
        (0, 1e-4, 2e-8, False),
    ],
)
def test_a_level_is_given_where_redundancy_or_priors_bear_the_risk(
    channels, prior, risk, given
):
    geometry = None if channels else Geometry.from_triads([np.eye(3), np.eye(3)])
    level = (
        integrity(geometry, prior=prior, risk=risk)
        .of(np.arange(6) < (channels or 6))
        .level
    )
    assert (np.isfinite(level) == given).all()


def test_the_pipeline_gives_a_level_that_grows_when_a_channel_is_lost():
    """Apart from that it follows the noise of the moment, within a fifth in white noise."""
    rng = np.random.default_rng(5)
    z = 0.0025 * rng.standard_normal((400, 6))
    z[200:, 3] += 0.1
    pipeline, healthy = Pipeline(config(publish_under_doubt=False)), Pipeline(config())
    output = pipeline.process(block(z))
    level = output.level
    assert output.valid.all(), "what can be left out withholds nothing"
    assert np.isfinite(level).all()
    assert np.ptp(level[20:200], axis=0).max() < 0.2 * level[20].min()
    assert np.ptp(level[300:], axis=0).max() < 0.2 * level[300].min()
    # A later level was foreseen for the worst loss.
    assert np.isinf(healthy.status().protection_level_after_loss).all(), (
        "no sample yet: no rate, no level"
    )
    healthy.process(block(z[:200]))
    status = healthy.status()
    assert status.protection_level == tuple(level[199])
    # It is foreseen in the noise expected.
    after = np.array(status.protection_level_after_loss)
    assert (level[300] <= 1.1 * after).all()
    assert (level[300] >= level[199]).all()
    assert pipeline.status().protection_level == tuple(level[-1])


def test_the_level_holds_while_a_fault_that_the_detector_lets_pass_is_in_sight():
    """`guaranteed` waits for ten bounds; the estimator's own detector leaves the channel out meanwhile."""
    rng = np.random.default_rng(6)
    z = 0.0025 * rng.standard_normal((200, 6))
    z[100:, 2] += 0.05
    pipeline = Pipeline(config(detector__name="guaranteed"))
    output = pipeline.process(block(z))
    level = output.level
    others = np.arange(6) != 2
    assert (output.state[5:, others] == ChannelState.OK).all()
    assert (output.state[5:100, 2] == ChannelState.OK).all()
    assert (output.state[-50:, 2] == ChannelState.SUSPECT).all()
    assert np.isfinite(level[:100]).all()
    assert (np.abs(output.rate) < level).all()
    # Without the channel the level is the one of five channels, but for single samples.
    assert (np.median(level[-50:], axis=0) < 2.0 * level[90]).all()


def test_a_rate_of_channels_under_doubt_says_so_in_covariance_and_level_or_is_withheld_if_asked_for():
    """Two units mounted alike in a turn, of which the second comes loose: it feels other axes."""
    t = np.arange(400) / 100
    rate = np.column_stack(
        [1.5 * np.sin(2 * t), 0.8 * np.cos(1.3 * t), 0.5 * np.sin(t)]
    )
    other = np.vstack([rate[:200], rate[200:, [1, 2, 0]]])
    z = np.hstack([rate, other]) + 0.0025 * np.random.default_rng(8).standard_normal(
        (400, 6)
    )
    pipeline, open_ = (
        Pipeline(parallel(2, publish_under_doubt=False)),
        Pipeline(parallel(2)),
    )
    output, published = pipeline.process(block(z)), open_.process(block(z))
    np.testing.assert_array_equal(output.state, published.state)
    doubt = np.isin(output.state, (ChannelState.SUSPECT, ChannelState.AMBIGUOUS))
    all_doubted = doubt.all(axis=1)
    assert all_doubted[210:].all()
    assert published.valid.all()
    assert np.isinf(published.level[all_doubted]).all()
    error, std = (
        np.abs(published.rate - rate),
        np.sqrt(np.diagonal(published.covariance, axis1=1, axis2=2)),
    )
    assert error[all_doubted].max() > 0.5
    assert (error < 3 * std)[all_doubted].all()
    np.testing.assert_array_equal(output.valid, ~doubt.any(axis=1))
    assert np.isnan(output.rate[~output.valid]).all()
    assert np.isnan(output.covariance[~output.valid]).all()
    assert pipeline.status().withheld
    assert told(pipeline)["monitor"].message.startswith(
        "no fused rate: withheld, because suspect channels"
    )
    pipeline.reconfigure(open_.config)
    assert pipeline.process(block(z[-1:], len(z))).valid.all()
    assert not pipeline.status().withheld


def test_risk_zero_switches_it_off_and_a_bad_setting_is_named():
    assert np.isinf(
        Pipeline(config(integrity__risk=0.0)).process(block(np.zeros((3, 6)))).level
    ).all()
    with pytest.raises(
        ConfigError,
        match=r"fault_rate has 2 values, expected 1 or 6 \(one per channel\)",
    ):
        Pipeline(config(integrity__fault_rate=[1e-4, 1e-4]))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_no_hypothesis_explains_is_in_the_covariance(seed: int) -> None:
    """Three gyros of a housing that is not given drift together: nobody can say which, and the rate says so."""
    settings = mounted(np.tile(np.eye(3), (3, 1)), noise__noise_std=0.003)
    rng, seconds = np.random.default_rng(seed), np.arange(6000) / 100.0
    z = 0.003 * rng.standard_normal((6000, 9))
    z[:, :3] += (0.02 * np.clip(seconds - 20.0, 0.0, None))[:, None] * rng.permutation(
        [0.2, 0.5, 0.84]
    )
    output = Pipeline(settings).process(
        Block((1e9 * seconds).astype(np.int64) + 10**18, z)
    )
    rate, covariance = output.rate[2500:], output.covariance[2500:]
    stated = np.isfinite(rate).all(axis=1)
    nees = (
        np.einsum(
            "ki,kij,kj->k",
            rate[stated],
            np.linalg.inv(covariance[stated]),
            rate[stated],
        )
        / 3
    )
    # Two of three axes are named at most, and the third drifts by less than 3 mrad/s^2.
    assert 0.2 < nees.mean() < 6.0


def parity_of(pipeline, mask):
    """Information, gain and covariance of the rate of the channels in mask, with the uncertainty of this sample."""
    n, used = pipeline.geometry.n, list(np.flatnonzero(mask))
    axes = pipeline.geometry.axes[used]
    weight = np.diag(1.0 / pipeline.core["now"]["uncertainty"][0, used])
    covariance = np.linalg.inv(axes.T @ weight @ axes)
    information, gain = np.zeros((n, n)), np.zeros((3, n))
    gain[:, used] = covariance @ axes.T @ weight
    information[np.ix_(used, used)] = weight - weight @ axes @ gain[:, used]
    return information, gain, covariance


def level_if_another_is_faulty(pipeline, rate, named, prior, risk):
    """Level (3,) in the last sample if the channel named is healthy, and one or two others are not."""
    z = pipeline.core["now"]["corrected"][0, : pipeline.geometry.n]
    others = np.arange(len(z)) != named
    chi = z @ parity_of(pipeline, others)[0] @ z
    information, gain, covariance = parity_of(pipeline, np.full(len(z), True))
    fused, level = np.flatnonzero(others), np.zeros(3)
    for rival in [*combinations(fused, 1), *combinations(fused, 2)]:
        index = list(rival)
        spread = np.linalg.inv(information[np.ix_(index, index)])
        error = spread @ (information @ z)[index]
        left = z @ information @ z - (information @ z)[index] @ error
        odds = 2 * prior if len(index) == 2 else 1.0
        log_odds = 0.5 * (chi - left) + math.log(odds * len(fused) ** 2 / risk)
        apart = np.abs(rate - gain @ z + gain[:, index] @ error)
        variance = np.diag(covariance + gain[:, index] @ spread @ gain[:, index].T)
        if log_odds > 0.0:
            level = np.maximum(level, apart + np.sqrt(2.0 * log_odds * variance))
    return level


@pytest.mark.parametrize(("fault_rate", "whole"), [(1e-5, False), (1e-12, True)])
def test_beside_a_named_channel_the_level_holds_if_others_are_faulty_instead(
    fault_rate, whole
):
    """Where two faults are rare it is that level on every axis, else on one at least."""
    settings = config(integrity__fault_rate=fault_rate, bias__turn_on_std=0.0)
    pipeline = Pipeline(settings)
    z = np.random.default_rng(1).normal(0.0, 0.0025, (500, 6))
    z[200:, 4] += 6 * 0.0025 / math.sqrt(pipeline.geometry.S[4, 4])
    output = pipeline.process(block(z))
    assert output.state[-1].tolist().count(ChannelState.FAULTY) == 1
    prior = fault_rate * settings.integrity.exposure
    risk = settings.integrity.risk
    level = level_if_another_is_faulty(pipeline, output.rate[-1], 4, prior, risk)
    ratio = output.level[-1] / level
    assert ratio.min() == pytest.approx(1.0, rel=1e-6)
    assert ratio.max() < 1.0 + 1e-6 if whole else ratio.max() < 1.8


def test_a_declared_channel_that_loses_a_value_does_not_lower_the_level():
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    block = stream(pipeline.geometry, 1000, size=0.3)
    block.z[400:, 4] += 0.1
    block.z[700::10, 4] = np.nan
    level = pipeline.process(block).level[699:, 1]
    assert (level[1::10] > 0.9 * level[:-1:10]).all()
    assert (level[1::10] < 1.1 * level[:-1:10]).all()
