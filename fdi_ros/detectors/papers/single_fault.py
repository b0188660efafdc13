# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Common parts of methods that name the one channel whose fault explains a sample best.

These methods use linear forms of a sample in which the body rate cancels: predictions,
innovations, determinants. For ``f = F @ z`` with ``F @ H = 0`` only the errors of channels
reach f, so the standard deviation follows from the noise model alone. The judge of such a
method writes the scores, names a channel by `worst`, compares one figure with one threshold,
and calls `conclude`.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    Channels,
    Flag,
    Flags,
    Real,
    Square,
    Whole,
    callback,
    compiled,
    record,
)
from fdi_ros.core.algebra import dot, variance_along
from fdi_ros.core.records import SampleInput, SampleVerdict, Sensors
from fdi_ros.core.sensors import variance_of
from fdi_ros.detectors.base import Detector, NoState
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import MIN_SENSITIVITY, Geometry
from fdi_ros.model.noise import FalseAlarmRate, NoiseModel, max_normal_threshold
from fdi_ros.model.samples import Array, Mask


def prediction_errors(axes: Array) -> Array:
    """Return the matrix (n, n) that maps z to prediction errors ``z_i - z_ip``.

    Each channel is predicted by all others: ``z_i - z_ip = r_i / S_ii`` for any axes (n, 3).
    Rows of undetectable channels are zero.
    """
    residuals = np.eye(len(axes)) - axes @ np.linalg.pinv(axes)
    share = np.diag(residuals)[:, None]
    seen = share >= MIN_SENSITIVITY**2
    return np.where(seen, residuals / np.where(seen, share, 1.0), 0.0)


def resting_std(forms: Array, noise: NoiseModel) -> Array:
    """Return the standard deviation of forms (k, n) at rest, (k,) rad/s times their unit."""
    return np.sqrt(forms**2 @ noise.noise_std**2)


def largest_form_threshold(
    forms: Array, geometry: Geometry, noise: NoiseModel, probability: float
) -> float:
    """Return the level that the largest |f| / std of forms (k, n) exceeds with a probability.

    All channels are healthy. Rows of zeros are ignored.
    """
    gain = forms[np.abs(forms).max(axis=1) > 0] @ geometry.parity.T
    covariance = (geometry.parity * noise.noise_std**2) @ geometry.parity.T
    directions = gain @ np.linalg.cholesky(covariance)
    return max_normal_threshold(
        directions / np.linalg.norm(directions, axis=1, keepdims=True), probability
    )


TRIALS_PER_CHANNEL, TRIAL_FAULT, TRIAL_NOISE = 200, 50.0, 1.5
"""Trials per channel, and size of faults and noise in the trials, in noise_std. The fault is
by far the larger part. More noise than assumed finds too many rivals rather than too few."""


@record
class SingleFault:
    """Consequences of naming a channel, common to all these methods."""

    sensors: Sensors
    errors: Square  # row i: prediction error z_i - z_ip as a form of z
    resting: Channels  # standard deviation of z_i - z_ip at rest, rad/s
    limit: Real  # threshold of the method's figure
    # row i: suspects if channel i is named
    suspects: Annotated[NDArray[np.uint8], "u1", (MAX_CHANNELS, MAX_CHANNELS)]
    names: Flags  # the fault is isolated if channel i is named
    sign: Real  # +1 if the worst channel has the largest score, -1 if the least
    scored: Flag  # the scores distinguish channels, and are published


def chosen(name: str, value: str, words: tuple[str, ...]) -> str:
    """Return the value of an option, or raise `ConfigError` for an unknown word."""
    if value not in words:
        raise ConfigError(f"{name} is {value!r}, expected one of: {', '.join(words)}")
    return value


class SingleFaultDetector(Detector):
    """Base of methods that name one channel and compare one figure with one threshold.

    All channels with the parity direction of the named one are suspects. The fault is
    isolated only if no other channel has this direction. With unfavourable axes a method may
    name one channel for a large fault of another. This is tried in advance (`_try_faults`):
    all channels whose fault may lead to this name are suspects. The error of a suspect is
    the prediction error ``z_i - z_ip = r_i / S_ii``, the least-squares estimate of a single
    fault.

    Unless a method has its own, the statistic is ``|z_i - z_ip|`` of the named channel over
    its standard deviation. The largest one over all channels exceeds the threshold with
    the false-alarm probability.

    Parameters
    ----------
    geometry, noise
        As of every `Detector`.
    options
        Options of the method. Those of the false-alarm rate are added.
    largest
        The worst channel has the largest score, not the least.
    scored
        As in `SingleFault`.
    errors
        Matrix (n, n) that maps z to ``z_i - z_ip``. None: from the axes.
    """

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        options: dict[str, Any],
        largest: bool,
        scored: bool = True,
        errors: Array | None = None,
        *,
        false_alarm_probability: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
    ) -> None:
        rate = FalseAlarmRate(
            None, false_alarm_probability, false_alarms_per_hour, sample_rate
        )
        super().__init__(geometry, noise, {**options, **rate.as_options()})
        self.probability = rate.per_sample()
        n = geometry.n
        self.errors = prediction_errors(geometry.axes) if errors is None else errors
        params = self.constants[0]
        params["errors"][:n, :n], params["resting"][:n] = (
            self.errors,
            resting_std(self.errors, self.noise),
        )
        params["limit"] = np.inf
        params["sign"] = 1.0 if largest else -1.0
        params["scored"] = scored
        self._set_suspects(
            geometry.group_matrix & geometry.detectable, geometry.isolable
        )

    @property
    def isolable(self) -> Mask:
        """Channels that are named for their own fault and for no other, (n,)."""
        return self._names & ~(
            self._suspects & ~np.eye(self.geometry.n, dtype=bool)
        ).any(axis=0)

    def _set_suspects(self, suspects: Mask, names: Mask) -> None:
        """Set for each named channel the suspects (n, n) and whether these isolate (n,)."""
        n = self.geometry.n
        self._suspects = suspects
        self._names = names
        params = self.constants[0]
        params["suspects"][:n, :n] = suspects
        params["names"][:n] = names
        # Rows that were prepared from the constants before are outdated.
        vars(self).pop("_rows", None)

    def _try_faults(self) -> None:
        """Find by trial which channels are named for a fault of `TRIAL_FAULT`.

        The trials are always the same, with somewhat more noise than assumed. Larger faults
        are not named worse: the scores are even homogeneous functions of z, and the fault
        is then an even larger part of z.
        """
        n = self.geometry.n
        noise = (
            TRIAL_NOISE
            * self.noise.noise_std
            * np.random.default_rng(n).standard_normal((TRIALS_PER_CHANNEL, n))
        )
        found = self._suspects.copy()
        for channel in np.flatnonzero(self.geometry.detectable):
            z = noise.copy()
            z[:, channel] += TRIAL_FAULT * self.noise.noise_std[channel]
            named = self.detect(z).suspects.any(axis=0)
            found[named] |= self._suspects[channel]
        self._set_suspects(found, self.geometry.isolable & (found.sum(axis=1) == 1))


@compiled
def worst(params: SingleFault, verdict: SampleVerdict) -> int:
    """Return the detectable channel with the worst score."""
    named = -1
    most = -math.inf
    for i in range(params.sensors.n):
        badness = params.sign * verdict.scores[i]
        if params.sensors.detectable[i] and (named < 0 or badness > most):
            named = i
            most = badness
    return named


@compiled
def error_of(params: SingleFault, i: int, sample: SampleInput) -> float:
    """Return the error of channel i for a single fault, rad/s: ``z_i - z_ip``."""
    return dot(params.errors[i], sample.z, params.sensors.n)


@compiled
def fill_variances(
    params: SingleFault, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Write the error variance of each channel, (rad/s)^2, if it depends on the rate.

    The variance is at the least-squares rate of the sample, and is stored in the place of
    the errors, which is free until the verdict is concluded.
    """
    for i in range(0 if params.sensors.constant else params.sensors.n):
        rate_along = sample.z[i] - error_of(params, i, sample) * params.sensors.share[i]
        verdict.error[i] = variance_of(
            params.sensors, i, rate_along, sample.acceleration
        )


@compiled
def std_of(
    params: SingleFault, form: Array, resting: float, verdict: SampleVerdict
) -> float:
    """Return the standard deviation of a form in the sample, after `fill_variances`.

    ``resting`` is the standard deviation at rest.
    """
    if params.sensors.constant:
        return resting
    return math.sqrt(variance_along(form, verdict.error, params.sensors.n))


@compiled
def conclude_by_error(
    params: SingleFault, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Complete a verdict with scores by ``|z_i - z_ip|`` of the worst channel over its std."""
    named = worst(params, verdict)
    fill_variances(params, sample, verdict)
    std = std_of(params, params.errors[named], params.resting[named], verdict)
    conclude(
        params,
        named,
        abs(error_of(params, named, sample)) / std,
        params.limit,
        sample,
        verdict,
    )


@compiled
def conclude(
    params: SingleFault,
    named: int,
    statistic: float,
    threshold: float,
    sample: SampleInput,
    verdict: SampleVerdict,
) -> None:
    """Complete a verdict with scores from the named channel, statistic and threshold."""
    alarm = statistic >= threshold
    verdict.statistic = statistic
    verdict.threshold = threshold
    verdict.alarm = alarm
    verdict.isolated = alarm and params.names[named]
    for i in range(params.sensors.n):
        suspect = alarm and params.suspects[named, i]
        verdict.suspects[i] = suspect
        verdict.error[i] = error_of(params, i, sample) if suspect else 0.0
        if not (params.scored and params.sensors.detectable[i]):
            verdict.scores[i] = math.nan


# Scores that are sums of forms


@record
class WithForms(SingleFault):
    """Constants of scores that consist of linear forms of z."""

    terms: Whole  # forms per score
    squares: Flag  # sum squares, not absolute values
    # [t, i]: form t of score i
    forms: Annotated[
        NDArray[np.float64], "f8", (MAX_CHANNELS - 1, MAX_CHANNELS, MAX_CHANNELS)
    ]
    paper: Flag  # a residual search has the tolerance of its paper


def set_forms(params: Any, forms: Array, squares: bool = False) -> None:
    """Write forms (t, n, n) into the constants."""
    terms, n, _ = forms.shape
    params["terms"] = terms
    params["squares"] = squares
    params["forms"][:terms, :n, :n] = forms


@callback(WithForms, NoState, SampleInput, SampleVerdict)
def judge_sums(
    params: WithForms, state: NoState, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample by the error of the channel with the worst sum of forms."""
    for i in range(params.sensors.n):
        for t in range(params.terms):
            value = dot(params.forms[t, i], sample.z, params.sensors.n)
            verdict.scores[i] += value * value if params.squares else abs(value)
    if params.paper:
        named = worst(params, verdict)
        residual = error_of(params, named, sample)
        zero = params.sensors.noise_std[named]
        scale = params.sensors.scale_std[named] * (sample.z[named] - residual)
        conclude(
            params,
            named,
            abs(residual),
            3 * math.sqrt(zero * zero + scale * scale),
            sample,
            verdict,
        )
    else:
        conclude_by_error(params, sample, verdict)
