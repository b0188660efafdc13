# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Cumulative sums: detection of drift and of steps too small for one sample."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    Channels,
    Real,
    Square,
    Whole,
    callback,
    compiled,
    record,
)
from fdi_ros.core.algebra import along, dot
from fdi_ros.core.records import SampleInput, SampleVerdict, Sensors
from fdi_ros.core.sensors import variance_of
from fdi_ros.detectors.base import Detector
from fdi_ros.detectors.papers.likelihood_ratio import (
    Hypotheses,
    Scratch,
    explain,
    fill_scratch,
    prepare_hypotheses,
    whitened,
    whitened_directions,
)
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import FalseAlarmRate, NoiseModel, erfc
from fdi_ros.model.samples import Array


@lru_cache(maxsize=16)
def mean_overshoot(reference: float) -> float:
    """Return the mean overshoot of a sampled running sum over both of its ends.

    ``-ln nu(2 k) / k`` with ``nu(x) = 2 / x^2 exp(-2 sum_n Phi(-x sqrt(n) / 2) / n)``
    (Siegmund, Sequential Analysis, 1985, eq. 4.37): 1.166 for small k, 1.137 at k = 1.
    """
    if reference < 0.1:
        return 1.166
    n = np.arange(1.0, 5000.0)
    tails = float((erfc(reference * np.sqrt(n / 2)) / n).sum())
    return (math.log(2 * reference**2) + tails) / reference


def siegmund_run_length(threshold: float, reference: float) -> float:
    """Return the mean number of samples in which a running sum reaches a threshold.

    The steps are standard normal less k. Siegmund (1985): ``(exp(2 k b) - 1 - 2 k b) / (2
    k^2)``, where b is the threshold plus `mean_overshoot`.
    """
    x = 2 * reference * (threshold + mean_overshoot(reference))
    return (math.expm1(x) - x) / (2 * reference**2)


def threshold_for(run_length: float, reference: float, correlation: Array) -> float:
    """Return the threshold of correlated sums for the mean run length to a false alarm.

    Sums of correlated samples sometimes alarm together, and shared crossings count once.
    If one sum crosses the threshold, its samples drift by +k, and those of another sum by
    ``(2 rho - 1) k``. The other sum is then at a normally distributed distance D from the
    threshold, where ``2 k D`` has mean mu = ``4 (1 - rho) k b`` and variance 2 mu. Its
    probability to cross as well is exp(-2 k D), with mean ``erfc(sqrt((1 - rho) k b))``.

    Parameters
    ----------
    run_length
        Mean number of samples to a false alarm of any sum.
    reference
        k, subtracted from every sample, in standard deviations.
    correlation
        Correlation rho between the samples of the sums, (K, K).

    Returns
    -------
    float
        Threshold, in standard deviations.

    Raises
    ------
    ConfigError
        If the run length is too short for any positive threshold.
    """
    count = len(correlation)
    overshoot = mean_overshoot(reference)
    apart = 1 - np.clip(correlation[~np.eye(count, dtype=bool)], -1, 1)
    single = count * run_length
    threshold = 0.0
    for _ in range(8):
        threshold = _single_threshold(single, reference)
        b = threshold + overshoot
        shared = float(erfc(np.sqrt(apart * reference * b)).sum()) / count
        effective = count * max(1 - shared / 2, 1 / (1 + shared))
        # A crossing takes b / k samples, which several sums share.
        single = max(
            effective * (run_length - b / reference) + b / reference, run_length
        )
    return threshold


def _single_threshold(run_length: float, reference: float) -> float:
    shortest = siegmund_run_length(0.0, reference)
    if run_length <= shortest:
        raise ConfigError(
            f"run length is {run_length:.4g} samples per sum, expected above {shortest:.3g}"
        )
    # ln(1 + x + 2 k^2 L) is a close lower bound. Since expm1(x) - x is convex, Newton's
    # method converges from there.
    target = 2 * reference**2 * run_length
    x = math.log1p(target)
    for _ in range(20):
        x += (target + x - math.expm1(x)) / math.expm1(x)
    return x / (2 * reference) - mean_overshoot(reference)


#: A larger sample is scaled down to this as a whole, standard deviations.
LARGEST_SAMPLE = 2.0**18
#: Lasting errors of bias, scale and timing up to this many standard deviations are no
#: fault: 0.3 % of sensors have more.
SYSTEMATIC = 3.0


# The method


@record
class Constants:
    """Constants of `judge`."""

    sensors: Sensors
    hypotheses: Hypotheses  # with the noise of the sample
    resting: Hypotheses  # with noise_std alone, used to name averages
    # factor of each residual over noise_std that gives unit variance, 0 if not detectable
    scale: Channels
    squares: Square  # share of each channel's variance in that of a w0, 1 / (rad/s)^2
    bias: Channels  # variance of the remaining bias in a w0
    half_shift: Real  # k, standard deviations
    threshold: Real  # standard deviations
    window: Whole  # largest number of samples after the onset used to name a channel


@record
class Side:
    """A running sum, and sums over at most `window` samples since its onset."""

    total: Real  # the running sum, standard deviations
    count: Whole  # number of samples in the sums below
    factor: Real  # sum of the common factors
    systematic: Real  # sum of the standard deviations of the systematic errors
    residual: Channels  # sum of the residuals over noise_std, times the factor


@record
class State:
    """Running sums, two per channel."""

    # downward sum of each channel, then the upward ones
    sides: Annotated[list[Side], 2 * MAX_CHANNELS]
    room: Scratch
    resting: Channels  # residuals of this sample over noise_std
    variance: Channels  # of each w0 of this sample by all errors, 1 by noise_std alone


@compiled
def advance(
    side: Side,
    params: Constants,
    step: float,
    factor: float,
    systematic: float,
    residual: NDArray[np.float64],
) -> None:
    """Add one sample to a running sum, which is limited to 0 to 1.5 thresholds."""
    side.total = min(max(side.total + step, 0.0), 1.5 * params.threshold)
    if side.total == 0.0 and side.count > 0:
        side.count = 0
        side.factor = side.systematic = 0.0
        for i in range(params.sensors.n):
            side.residual[i] = 0.0
    elif side.total > 0.0 and side.count < params.window:
        side.count += 1
        side.factor += factor
        side.systematic += systematic
        for i in range(params.sensors.n):
            side.residual[i] += factor * residual[i]


@compiled
def name(
    params: Constants,
    side: Side,
    state: State,
    sample: SampleInput,
    verdict: SampleVerdict,
) -> None:
    """Name the channels that explain the average since the onset."""
    mean_part = side.systematic / side.count
    # The variance of the average is at most 1 / count + mean_part^2. Division by its
    # square root gives the variance of one sample.
    root = 1.0 / math.sqrt(1.0 / side.count + mean_part * mean_part)
    for i in range(params.sensors.n):
        state.room.residual[i] = side.residual[i] / side.count * root
    explain(params.resting, params.sensors, sample, state.room, verdict)
    for i in range(params.sensors.n):
        verdict.error[i] *= side.count / max(side.factor, 2.0**-24) / root


@compiled
def name_largest(
    params: Constants, state: State, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Name the channels by the largest sum. Of equal sums the first downward one counts."""
    for k in range(2 * MAX_CHANNELS):
        if state.sides[k].total == verdict.statistic:
            name(params, state.sides[k], state, sample, verdict)
            return


@callback(Constants, State, SampleInput, SampleVerdict)
def judge(
    params: Constants, state: State, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Advance all sums by one sample. On alarm, name the channels by the largest sum."""
    sensors = params.sensors
    room = state.room
    n = sensors.n
    fill_scratch(params.resting, sensors, sample, room)
    for i in range(n):
        state.resting[i] = room.residual[i]
        state.variance[i] = 1.0
    if not sensors.constant:
        plain_variances(params, sample, state)
        fill_scratch(params.hypotheses, sensors, sample, room)
    largest = size = spread = 1.0
    systematic = 0.0
    for i in range(n):
        w0 = state.resting[i] * params.scale[i]
        # The scores store w until the sums are advanced.
        verdict.scores[i] = (
            w0
            if sensors.constant
            else whitened(params.hypotheses, sensors, sample, room, i)
        )
        largest = max(largest, abs(w0))
        size = max(size, abs(verdict.scores[i]))
        spread = max(spread, state.variance[i])
        systematic = max(systematic, state.variance[i] - 1.0 + params.bias[i])
    factor = min(1.0 / math.sqrt(spread), LARGEST_SAMPLE / largest)
    lasting = min(factor * math.sqrt(systematic), LARGEST_SAMPLE)
    shrink = min(1.0, LARGEST_SAMPLE / size)
    verdict.statistic = 0.0
    verdict.threshold = params.threshold
    for i in range(n):
        w = verdict.scores[i] * shrink
        variance = state.variance[i]
        less = min(
            params.half_shift
            + SYSTEMATIC * math.sqrt((variance - 1.0 + params.bias[i]) / variance),
            LARGEST_SAMPLE,
        )
        down = state.sides[i]
        up = state.sides[MAX_CHANNELS + i]
        advance(down, params, -w - less, factor, lasting, state.resting)
        advance(up, params, w - less, factor, lasting, state.resting)
        verdict.scores[i] = max(down.total, up.total)
        verdict.statistic = max(verdict.statistic, verdict.scores[i])
        if not sensors.detectable[i]:
            verdict.scores[i] = math.nan
    verdict.alarm = verdict.statistic >= params.threshold
    if verdict.alarm:
        name_largest(params, state, sample, verdict)


@compiled
def plain_variances(params: Constants, sample: SampleInput, state: State) -> None:
    """Write the variance of every w0 by all errors of this sample to ``state.variance``."""
    sensors = params.sensors
    rate = state.room.correction
    n = sensors.n
    for a in range(3):
        rate[a] = 0.0
        for i in range(n):
            rate[a] += sensors.gain[i, a] * sample.z[i]
    for j in range(n):
        state.room.variance[j] = variance_of(
            sensors, j, along(sensors.axes[j], rate), sample.acceleration
        )
    for i in range(n):
        variance = dot(params.squares[i], state.room.variance, n)
        state.variance[i] = max(variance, 1.0)


class Cusum(Detector):
    r"""Two running sums per channel, ``max(0, S + w_i - k)`` and ``max(0, S - w_i - k)``, against one threshold.

    w_i is the whitened single-fault statistic of `likelihood_ratio`, and ``k = shift / 2``
    (Page, *Continuous inspection schemes*, 1954). The threshold h follows from the mean
    run length to a false alarm, shared by both sides of all distinguishable channels, with
    Siegmund's approximation (`siegmund_run_length`). On alarm the largest sum gives the
    onset, and `explain` names the channels that explain the average since then. Errors of
    constant sign (`bias_std`, scale, timing) raise k by `SYSTEMATIC` times their standard
    deviation in w. docs/methods.md contains details and applications.

    Parameters
    ----------
    geometry, noise
        As of every `Detector`.
    shift
        Mean shift of w_i that is detected fastest, in standard deviations, 0.05 to 3.
    run_length
        Mean number of samples to a false alarm of the whole detector, 2 to 1e15. Default
        3.6e8 (1e-3 per hour at 100 Hz).
    false_alarms_per_hour, sample_rate
        In place of the run length, with the rate in Hz.
    confidence
        Confidence with which rivals are rejected, above 0.5 and below 1.

    Notes
    -----
    `scores`: the larger of a channel's two sums. `samples_since_onset` is the onset estimate.
    """

    name = "cusum"
    Constants = Constants
    State = State
    judge = judge

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        shift: float = 0.5,
        run_length: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
        confidence: float = 0.999,
    ) -> None:
        if not 0.05 <= shift <= 3.0:
            raise ConfigError(
                f"shift is {shift:g} standard deviations, expected 0.05 to 3"
            )
        self.run_length = FalseAlarmRate(
            run_length, None, false_alarms_per_hour, sample_rate
        ).mean_run_length()
        super().__init__(
            geometry,
            noise,
            {"shift": shift, "run_length": self.run_length, "confidence": confidence},
        )
        params = self.constants[0]
        n = geometry.n
        prepare_hypotheses(
            params["resting"], geometry, self.noise, confidence, fixed=True
        )
        prepare_hypotheses(
            params["hypotheses"],
            geometry,
            self.noise,
            confidence,
            fixed=self.noise.constant,
        )
        residual = params["resting"]["residual"][:n, :n]
        share = np.where(geometry.detectable, np.diag(residual), np.inf)
        params["scale"][:n] = 1 / np.sqrt(share)
        params["squares"][:n, :n] = (
            residual**2 / share[:, None] / self.noise.noise_std**2
        )
        params["bias"][:n] = params["squares"][:n, :n] @ self.noise.bias_std**2
        seen = np.flatnonzero(geometry.detectable).tolist()
        heads = [group[0] for group in geometry.groups]
        first = [seen.index(head) for head in heads if head in seen]
        directions = whitened_directions(geometry, self.noise)[first]
        rho = directions @ directions.T
        self.threshold = threshold_for(
            self.run_length, shift / 2, np.block([[rho, -rho], [-rho, rho]])
        )
        self.window = math.ceil(16 * self.threshold / shift) + 1
        """Largest number of samples after the onset used to name a channel."""
        params["half_shift"] = shift / 2
        params["threshold"] = self.threshold
        params["window"] = self.window

    def samples_since_onset(self) -> NDArray[np.int64]:
        """Return the number of samples since the estimated onset in each channel, (n,).

        0: no drift. `window`: that long or longer. The larger of a channel's two sums
        counts.
        """
        sides = self.states[0]["sides"]
        n = self.geometry.n
        down = sides[:n]
        up = sides[MAX_CHANNELS : MAX_CHANNELS + n]
        return np.where(up["total"] >= down["total"], up["count"], down["count"])
