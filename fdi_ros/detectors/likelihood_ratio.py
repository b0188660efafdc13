"""Generalised likelihood ratio for one faulty channel, then for two."""

from __future__ import annotations

import numpy as np

from fdi_ros.detectors.base import Array, Detector, Verdict
from fdi_ros.detectors.explanation import Explanation
from fdi_ros.detectors.hypotheses import whitened_directions
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform
from fdi_ros.model.thresholds import false_alarm_probability as probability_per_sample
from fdi_ros.model.thresholds import max_normal_threshold


class LikelihoodRatio(Detector):
    r"""Largest whitened residual, with an exact false-alarm probability, and the channels that explain it.

    Under "channel i is off by an unknown amount" the logarithm of the likelihood rises by ``w_i^2 / 2``, with
    ``w_i = (z_i - h_i omega_i) / std``: omega_i the weighted least-squares rate of the other channels, std the
    standard deviation of the difference. With constant noise of equal size ``w_i = r_i / (sigma sqrt(S_ii))``.
    The statistic is ``max_i |w_i|``; its threshold is exact for correlated w_i (`max_normal_threshold`), at the
    weights of noise_std alone. On alarm `Explanation` says which channels may be faulty: one, its rivals, or pairs.

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
        Error model of a sound channel.
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
        options = {
            "false_alarm_probability": false_alarm_probability,
            "false_alarms_per_hour": false_alarms_per_hour,
            "sample_rate": sample_rate,
            "confidence": confidence,
        }
        super().__init__(geometry, noise, options)
        self.probability = probability_per_sample(false_alarm_probability, false_alarms_per_hour, sample_rate)
        self.explanation = Explanation(geometry, self.noise, confidence)
        self.threshold = max_normal_threshold(whitened_directions(geometry, self.noise), self.probability)
        self._whitening = (
            np.ascontiguousarray(self.explanation.whitened(np.eye(geometry.n), None)) if self.noise.constant else None
        )
        self._unseen = None if geometry.detectable.all() else ~geometry.detectable

    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        rows, n = z.shape
        if self._whitening is not None:
            scores = np.abs(transform(self._whitening, z))
        else:
            scores = np.abs(self.explanation.whitened(z, acceleration))
        statistic = np.maximum.reduce(scores, axis=1)
        alarm = statistic >= self.threshold
        suspects, isolated, error = np.zeros((rows, n), dtype=bool), np.zeros(rows, dtype=bool), np.zeros((rows, n))
        at = alarm.nonzero()[0]
        if len(at):
            found = self.explanation.explain(z[at], None if acceleration is None else acceleration[at])
            suspects[at], isolated[at], error[at] = found
        if self._unseen is not None:
            scores[:, self._unseen] = np.nan
        return Verdict(statistic, np.full(rows, self.threshold), alarm, suspects, isolated, error, scores)
