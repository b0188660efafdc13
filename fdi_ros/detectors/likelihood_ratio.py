"""Generalised likelihood ratio for one faulty channel, then for two."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Array, Detector, Mask, Verdict
from fdi_ros.detectors.hypotheses import FixedFits, SampleFits, pairs, singles
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform
from fdi_ros.model.thresholds import chi2_isf, max_normal_threshold
from fdi_ros.model.thresholds import false_alarm_probability as probability_per_sample


class LikelihoodRatio(Detector):
    r"""Largest whitened residual, with an exact false-alarm probability, and the sets of channels that explain it.

    Under "channel i is off by an unknown amount" the logarithm of the likelihood rises by ``w_i^2 / 2``, with
    ``w_i = (z_i - h_i omega_i) / std``: omega_i the weighted least-squares rate of the other channels, std the
    standard deviation of the difference. With constant noise of equal size ``w_i = r_i / (sigma sqrt(S_ii))``.
    The statistic is ``max_i |w_i|``; its threshold is exact for correlated w_i (`max_normal_threshold`), at the
    weights of noise_std alone.

    On alarm, with c(k) the chi-square with k degrees of freedom that a true hypothesis stays below with the
    confidence asked for, and m = n - 3:

    1. A single channel explains the sample when what is left without it is at most c(m - 1). The best one is
       named together with every rival whose fit is not worse by ``2 ln(confidence / (1 - confidence))``, that is
       with odds below confidence : (1 - confidence). A rival-free channel is isolated. Two faults that together look
       like one of a third channel are taken for it: one fault is believed rather than two.
    2. Where no single channel explains the sample, every pair is possible whose chi-square is at most c(m - 2);
       suspects are their union, isolated when it is one pair alone (then both are faulty: neither explains
       the sample by itself). With five channels a pair explains anything: all are suspect.
    3. Where no pair does either, all detectable channels are suspect.

    Noise that depends on rate and acceleration: the variances for channel i are taken at the rate which the
    other channels give (least squares), so a fault never hides itself by inflating the rate; a fault
    does inflate the variances of the other channels' statistics, which only favours the true one.

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
        self.confidence = checked_confidence(confidence)
        self._channels = np.flatnonzero(geometry.detectable)
        fits = FixedFits if self.noise.constant else SampleFits
        self._singles = fits(geometry, self.noise, singles(geometry))
        doubles = pairs(geometry) if geometry.n > 5 else []
        self._pairs = fits(geometry, self.noise, doubles) if doubles else None
        self._set_limits(geometry.n - 3)
        self._whitening = self._fixed_whitening(geometry.n)
        self.threshold = max_normal_threshold(whitened_directions(geometry, self.noise), self.probability)
        self._twins = (geometry.group_matrix & geometry.detectable).astype(np.int64)

    def _set_limits(self, m: int) -> None:
        rest = 1 - self.confidence
        self._single_limit = chi2_isf(rest, m - 1) if m > 1 else math.inf
        self._pair_limit = chi2_isf(rest, m - 2) if m > 2 else math.inf
        self._rival_margin = 2 * math.log(self.confidence / rest)
        self._can_isolate = m > 1

    def _fixed_whitening(self, n: int) -> Array | None:
        if not isinstance(self._singles, FixedFits):
            return None
        whitening = np.zeros((n, n))
        whitening[:, self._channels] = self._singles.whitened(np.eye(n), None)[0].T
        return whitening

    def whitened(self, z: Array, acceleration: Array | None) -> Array:
        """Single-fault statistics w, (N, n); 0 for a channel no fault of which is seen."""
        if self._whitening is not None:
            return transform(self._whitening, z)
        w = np.zeros(z.shape[::-1])
        w[self._channels] = self._singles.whitened(z, acceleration)[0]
        return w.T

    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        rows, n = z.shape
        scores = np.abs(self.whitened(z, acceleration))
        statistic = np.maximum.reduce(scores, axis=1)
        threshold = np.full(rows, self.threshold)
        alarm = statistic >= threshold
        suspects, isolated, error = np.zeros((rows, n), dtype=bool), np.zeros(rows, dtype=bool), np.zeros((rows, n))
        at = alarm.nonzero()[0]
        if len(at):
            found = self.explain(z[at], None if acceleration is None else acceleration[at])
            suspects[at], isolated[at], error[at] = found
        if len(self._channels) < n:
            scores[:, ~self.geometry.detectable] = np.nan
        return Verdict(statistic, threshold, alarm, suspects, isolated, error, scores)

    def explain(self, z: Array, acceleration: Array | None) -> tuple[Mask, Mask, Array]:
        """Suspects (N, n), isolated (N,) and errors (N, n) rad/s of samples known to hold a fault."""
        rows, n = z.shape
        estimate, remaining = self._singles.fit(z, acceleration)
        best = remaining.min(axis=0)
        possible = np.zeros((n, rows), dtype=bool)
        possible[self._channels] = remaining <= best + self._rival_margin
        error = np.zeros((n, rows))
        error[self._channels] = estimate[0]
        suspects = self._with_twins(possible.T)
        single = best <= self._single_limit
        isolated = single & (suspects.sum(axis=1) == 1) & self._can_isolate
        error = error.T
        rest = (~single).nonzero()[0]
        if len(rest):
            suspects[rest] = self.geometry.detectable
            if self._pairs is not None:
                part = self._explain_by_pairs(z[rest], None if acceleration is None else acceleration[rest])
                some = part[0].any(axis=1)
                at = rest[some]
                suspects[at], isolated[at], error[at] = (field[some] for field in part)
        return suspects, isolated, np.where(suspects, error, 0.0)

    def _explain_by_pairs(self, z: Array, acceleration: Array | None) -> tuple[Mask, Mask, Array]:
        assert self._pairs is not None
        rows, n = z.shape
        estimate, remaining = self._pairs.fit(z, acceleration)
        possible = remaining <= self._pair_limit
        suspects = np.zeros((n, rows), dtype=bool)
        error, misfit = np.zeros((n, rows)), np.full((n, rows), np.inf)
        # A channel's error is that of the best pair it is in.
        for k, pair in enumerate(self._pairs.out):
            for place, channel in enumerate(pair):
                suspects[channel] |= possible[k]
                better = remaining[k] < misfit[channel]
                error[channel][better] = estimate[place, k][better]
                misfit[channel][better] = remaining[k][better]
        all_suspects = self._with_twins(suspects.T)
        isolated = (possible.sum(axis=0) == 1) & (all_suspects.sum(axis=1) == 2)
        return all_suspects, isolated, error.T

    def _with_twins(self, suspects: Mask) -> Mask:
        return np.asarray(suspects.astype(np.int64) @ self._twins > 0)


def whitened_directions(geometry: Geometry, noise: NoiseModel) -> Array:
    """Return the unit parity directions of the detectable channels, (k, n - 3), for variances noise_std^2."""
    white = geometry.axes / noise.noise_std[:, None]
    directions: NDArray[np.float64] = np.linalg.qr(white, mode="complete")[0][:, 3:][geometry.detectable]
    return directions / np.linalg.norm(directions, axis=1)[:, None]


def checked_confidence(confidence: float) -> float:
    """Confidence of an isolation, refused outside 0.5 to 1."""
    if not 0.5 < confidence < 1:
        raise ConfigError(f"confidence is {confidence:g}, expected above 0.5 and below 1")
    return confidence
