# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Generalised likelihood ratio for one faulty channel, then for two."""

from __future__ import annotations

import math

from fdi_ros.compiling.compiled import callback
from fdi_ros.compiling.record import Real, record
from fdi_ros.core.records import SampleInput, SampleVerdict, Sensors
from fdi_ros.detectors.base import Detector
from fdi_ros.detectors.papers.explanation import (
    Hypotheses,
    Scratch,
    explain,
    prepare_hypotheses,
    take_sample,
    whitened,
    whitened_directions,
)
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import FalseAlarmRate, max_normal_threshold


@record
class Constants:
    """What `judge` needs."""

    sensors: Sensors
    hypotheses: Hypotheses
    threshold: Real  # of the largest |w|


@callback(Constants, Scratch, SampleInput, SampleVerdict)
def judge(own: Constants, room: Scratch, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Largest whitened residual of all channels; on alarm, the channels that explain it."""
    sensors, largest = own.sensors, 0.0
    take_sample(own.hypotheses, sensors, sample, room)
    for i in range(sensors.n):
        verdict.scores[i] = math.nan
        if sensors.detectable[i]:
            verdict.scores[i] = abs(whitened(own.hypotheses, sensors, sample, room, i))
            largest = max(largest, verdict.scores[i])
    verdict.statistic, verdict.threshold = largest, own.threshold
    verdict.alarm = largest >= own.threshold
    if verdict.alarm:
        explain(own.hypotheses, sensors, sample, room, verdict)


class LikelihoodRatio(Detector):
    r"""Largest whitened residual, with an exact false-alarm probability, and the channels that explain it.

    Under "channel i is off by an unknown amount" the logarithm of the likelihood rises by ``w_i^2 / 2``, with
    ``w_i = (z_i - h_i omega_i) / std``: omega_i the weighted least-squares rate of the other channels, std the
    standard deviation of the difference. With constant noise of equal size ``w_i = r_i / (sigma sqrt(S_ii))``.
    The statistic is ``max_i |w_i|``; its threshold is exact for correlated w_i (`max_normal_threshold`), at the
    weights of noise_std alone. On alarm `explain` says which channels may be faulty: one, its rivals, or pairs.

    Noise that depends on rate and acceleration: the variances for channel i are taken at the rate which the
    other channels give (least squares), so a fault never hides itself by inflating the rate: w_i grows in
    proportion to it. It does inflate the variances of the other channels' statistics, which favours the true one.

    Good at: steps in one sample, any axes, unequal and rate-dependent noise. Bad at: slow drift below the
    threshold (see `cusum`); a wrong noise_std (20 % too small turns 1e-3 into 1e-2).

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel.
    false_alarm_probability
        Per sample, 0 to 1; default 1e-6.
    false_alarms_per_hour
        The other way to give it, with `sample_rate`.
    sample_rate
        Hz.
    confidence
        With which rivals are rejected, above 0.5 and below 1.

    Notes
    -----
    `scores` are ``|w_i|``.
    """

    name = "likelihood_ratio"
    Constants = Constants
    State = Scratch
    judge = judge

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        false_alarm_probability: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
        confidence: float = 0.999,
    ) -> None:
        rate = FalseAlarmRate(false_alarm_probability, false_alarms_per_hour, sample_rate=sample_rate)
        options = {**rate.as_options(), "confidence": confidence}
        super().__init__(geometry, noise, options)
        self.probability = rate.per_sample()
        own = self.constants[0]
        prepare_hypotheses(own["hypotheses"], geometry, self.noise, confidence, fixed=self.noise.constant)
        self.threshold = max_normal_threshold(whitened_directions(geometry, self.noise), self.probability)
        own["threshold"] = self.threshold
