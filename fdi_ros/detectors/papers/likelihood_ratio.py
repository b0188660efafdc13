# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Generalised likelihood ratio for one and for two faulty channels.

A hypothesis "channels L have arbitrary errors, all others are healthy" leaves L out. With
the residual matrix S of all channels and ``r = S z``, the residuals become ``r - S[:, L]
S_LL^-1 r_L``, and the errors are ``S_LL^-1 r_L``. Thus no hypothesis needs its own matrix.
If the noise depends on the rate, the variances under a hypothesis are those at the
least-squares rate of the remaining channels, and the weighted solution is a correction to
that rate. Thus no weight depends on the channels left out, and a larger fault of channel i
is never less visible in the statistic of {i}.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    Channels,
    Flag,
    Real,
    Square,
    Symmetric,
    Vector,
    Whole,
    callback,
    compiled,
    record,
)
from fdi_ros.core.algebra import along
from fdi_ros.core.records import SampleInput, SampleVerdict, Sensors
from fdi_ros.core.sensors import variance_of
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.noise import (
    FalseAlarmRate,
    NoiseModel,
    chi2_isf,
    max_normal_threshold,
)
from fdi_ros.model.samples import Array

MAX_RATIO = 1e6
"""Largest ratio of variances in a sample. Under a wrong hypothesis a huge fault appears as
rate, and a larger ratio of weights would leave no correct digit in the normal equations."""
SAME_FIT = 1e-6  #: Chi-squares that differ by less are equal except for rounding.


@record
class Hypotheses:
    """Constants of the hypotheses on one set of channels. `explain` uses the limits."""

    fixed: Flag  # the weights are those of noise_std in every sample
    residual: Square  # S, or if fixed, S of values divided by noise_std
    single_limit: Real
    pair_limit: Real
    unit_limit: Real
    rival_margin: Real
    can_isolate: Flag
    pairs: Flag  # pairs are tried
    units: Whole  # number of whole units that are tried
    unit: Annotated[NDArray[np.int64], "i8", (4, 3)]  # channels of these units


@record
class Scratch:
    """Working memory for one sample."""

    residual: Channels  # S z
    quiet: Channels  # variance without the part of the rate, (rad/s)^2
    kept: Channels  # residuals under a hypothesis
    variance: Channels  # under a hypothesis, (rad/s)^2
    inverse: Symmetric  # covariance of the rate under a hypothesis, (rad/s)^2
    correction: Vector  # of the rate, rad/s
    estimate: Vector  # errors of the channels left out, rad/s
    remaining: Channels  # chi-square of each single-channel hypothesis
    # chi-square of the best pair of each channel, or the three errors of a unit, rad/s
    misfit: Channels


def prepare_hypotheses(
    params: Any, geometry: Geometry, noise: NoiseModel, confidence: float, fixed: bool
) -> None:
    """Fill a record of `Hypotheses` from noise with one value per channel.

    Parameters
    ----------
    params
        The record.
    geometry, noise
        Sensitivity axes, and errors of healthy channels.
    confidence
        Confidence with which rivals are rejected, above 0.5 and below 1.
    fixed
        The weights are those of noise_std in every sample.

    Raises
    ------
    ConfigError
        If the confidence is out of range.
    """
    if not 0.5 < confidence < 1:
        raise ConfigError(
            f"confidence is {confidence:g}, expected above 0.5 and below 1"
        )
    n = geometry.n
    m = geometry.n - 3
    rest = 1 - confidence
    params["fixed"] = fixed
    params["residual"][:n, :n] = (
        whitened_residuals(geometry, noise) if fixed else geometry.S
    )
    params["single_limit"] = chi2_isf(rest, m - 1) if m > 1 else math.inf
    params["pair_limit"] = chi2_isf(rest, m - 2) if m > 2 else math.inf
    params["unit_limit"] = chi2_isf(rest, m - 3) if m > 3 else math.inf
    params["rival_margin"] = 2 * math.log(confidence / rest)
    # A pair of five channels explains every sample.
    params["can_isolate"] = m > 1
    params["pairs"] = n > 5
    units = [unit for unit in geometry.units if _may_be_one_fault(geometry, unit)]
    params["units"] = len(units)
    params["unit"][: len(units)] = np.reshape(units, (-1, 3))


def whitened_residuals(geometry: Geometry, noise: NoiseModel) -> Array:
    """Return the matrix (n, n) from values to residuals, both over noise_std."""
    white = geometry.axes / noise.noise_std[:, None]
    return np.eye(geometry.n) - white @ np.linalg.pinv(white)


def whitened_directions(geometry: Geometry, noise: NoiseModel) -> Array:
    """Return the unit parity directions of the detectable channels, (k, n - 3), for variances noise_std^2."""
    white = geometry.axes / noise.noise_std[:, None]
    directions = np.linalg.qr(white, mode="complete")[0][:, 3:][geometry.detectable]
    return np.asarray(directions / np.linalg.norm(directions, axis=1)[:, None])


def _may_be_one_fault(geometry: Geometry, unit: tuple[int, ...]) -> bool:
    """Return whether a check remains after a common fault of three channels of a unit."""
    rest = np.delete(geometry.axes, unit, axis=0)
    return (
        len(unit) == 3
        and bool(geometry.detectable[list(unit)].all())
        and len(rest) > 3
        and spans_space(rest)
    )


@compiled
def fill_scratch(
    params: Hypotheses, sensors: Sensors, sample: SampleInput, room: Scratch
) -> None:
    """Calculate the quantities that all hypotheses on one sample share."""
    n = sensors.n
    for i in range(n):
        total = 0.0
        for j in range(n):
            z = sample.z[j] / sensors.noise_std[j] if params.fixed else sample.z[j]
            total += params.residual[i, j] * z
        room.residual[i] = total
    if not params.fixed:
        for i in range(n):
            room.quiet[i] = variance_of(sensors, i, 0.0, sample.acceleration)


@compiled
def leave_out(
    params: Hypotheses, n: int, room: Scratch, a: int, b: int, c: int
) -> None:
    """Write the residuals without channels a, b and c to `kept`, and their errors.

    b and c may be -1: none. Errors are in the places of their channels.
    """
    S = params.residual
    r = room.residual
    e0 = r[a] / S[a, a]
    e1 = 0.0
    e2 = 0.0
    if c >= 0:
        p = S[a, a]
        q = S[a, b]
        t = S[a, c]
        u = S[b, b]
        v = S[b, c]
        w = S[c, c]
        x = u * w - v * v
        y = t * v - q * w
        z = q * v - t * u
        det = p * x + q * y + t * z
        e0 = (x * r[a] + y * r[b] + z * r[c]) / det
        e1 = (y * r[a] + (p * w - t * t) * r[b] + (q * t - p * v) * r[c]) / det
        e2 = (z * r[a] + (q * t - p * v) * r[b] + (p * u - q * q) * r[c]) / det
    elif b >= 0:
        det = S[a, a] * S[b, b] - S[a, b] * S[a, b]
        e0 = (S[b, b] * r[a] - S[a, b] * r[b]) / det
        e1 = (S[a, a] * r[b] - S[a, b] * r[a]) / det
    for j in range(n):
        value = r[j] - S[j, a] * e0
        if b >= 0:
            value -= S[j, b] * e1
        if c >= 0:
            value -= S[j, c] * e2
        room.kept[j] = value
    room.kept[a] = e0
    if b >= 0:
        room.kept[b] = e1
    if c >= 0:
        room.kept[c] = e2


@compiled
def correct_rate(
    sensors: Sensors, sample: SampleInput, room: Scratch, a: int, b: int, c: int
) -> float:
    """Correct the rate of the remaining channels by their weights in this sample.

    `kept` contains residuals of the plain least-squares rate, which have the size of the
    noise. Thus the weighted solution is a small correction, and a large rate costs no
    digits. Return the remaining chi-square.
    """
    n = sensors.n
    kept = room.kept
    smallest = math.inf
    for j in range(n):
        scale = sensors.scale_std[j] * (sample.z[j] - kept[j])
        room.variance[j] = room.quiet[j] + scale * scale
        smallest = min(smallest, room.variance[j])
    xx = xy = xz = yy = yz = zz = x = y = z = squares = 0.0
    for j in range(n):
        room.variance[j] = min(room.variance[j], MAX_RATIO * smallest)
        if j != a and j != b and j != c:
            h = sensors.axes[j]
            weight = 1.0 / room.variance[j]
            moment = weight * kept[j]
            p = weight * h[0]
            q = weight * h[1]
            t = weight * h[2]
            xx += p * h[0]
            xy += p * h[1]
            xz += p * h[2]
            yy += q * h[1]
            yz += q * h[2]
            zz += t * h[2]
            x += h[0] * moment
            y += h[1] * moment
            z += h[2] * moment
            squares += moment * kept[j]
    s = room.inverse
    d = room.correction
    s[0] = yy * zz - yz * yz
    s[1] = xz * yz - xy * zz
    s[2] = xy * yz - xz * yy
    s[3] = xx * zz - xz * xz
    s[4] = xy * xz - xx * yz
    s[5] = xx * yy - xy * xy
    scale = 1.0 / (xx * s[0] + xy * s[1] + xz * s[2])
    for k in range(6):
        s[k] *= scale
    d[0] = s[0] * x + s[1] * y + s[2] * z
    d[1] = s[1] * x + s[3] * y + s[4] * z
    d[2] = s[2] * x + s[4] * y + s[5] * z
    return max(squares - (x * d[0] + y * d[1] + z * d[2]), 0.0)


@compiled
def fit(
    params: Hypotheses,
    sensors: Sensors,
    sample: SampleInput,
    room: Scratch,
    a: int,
    b: int,
    c: int,
) -> float:
    """Return the chi-square of the others if channels a, b, c are faulty.

    Their errors, rad/s, are written to `estimate`.
    """
    leave_out(params, sensors.n, room, a, b, c)
    residual = 0.0
    if params.fixed:
        for j in range(sensors.n):
            if j != a and j != b and j != c:
                residual += room.kept[j] * room.kept[j]
    else:
        residual = correct_rate(sensors, sample, room, a, b, c)
    for place in range(3):
        i = a if place == 0 else b if place == 1 else c
        if i >= 0 and params.fixed:
            room.estimate[place] = room.kept[i] * sensors.noise_std[i]
        elif i >= 0:
            room.estimate[place] = room.kept[i] - along(
                sensors.axes[i], room.correction
            )
    return residual


@compiled
def whitened(
    params: Hypotheses, sensors: Sensors, sample: SampleInput, room: Scratch, i: int
) -> float:
    """Return the error of channel i over its standard deviation, 0 if not detectable."""
    if not sensors.detectable[i]:
        return 0.0
    if params.fixed:
        return room.residual[i] / math.sqrt(params.residual[i, i])
    leave_out(params, sensors.n, room, i, -1, -1)
    correct_rate(sensors, sample, room, i, -1, -1)
    h = sensors.axes[i]
    s = room.inverse
    own_part = h[0] * (s[0] * h[0] + 2 * (s[1] * h[1] + s[2] * h[2])) + h[1] * (
        s[3] * h[1] + 2 * s[4] * h[2]
    )
    spread = room.variance[i] + own_part + h[2] * s[5] * h[2]
    return (room.kept[i] - along(h, room.correction)) / math.sqrt(spread)


@compiled
def explain(
    params: Hypotheses,
    sensors: Sensors,
    sample: SampleInput,
    room: Scratch,
    verdict: SampleVerdict,
) -> None:
    """Write the suspects that explain a sample, their errors, and whether they are isolated.

    These are a single channel and its rivals, or else pairs, or else a whole unit, or else
    all channels (docs/methods.md#likelihood_ratio). `fill_scratch` must have been called.
    """
    n = sensors.n
    best = math.inf
    for i in range(n):
        room.remaining[i] = math.inf
        if sensors.detectable[i]:
            room.remaining[i] = fit(params, sensors, sample, room, i, -1, -1)
            verdict.error[i] = room.estimate[0]
            best = min(best, room.remaining[i])
    if best <= params.single_limit:
        for i in range(n):
            verdict.suspects[i] = (
                sensors.detectable[i]
                and room.remaining[i] <= best + params.rival_margin
            )
        verdict.isolated = (
            params.can_isolate and add_alike(sensors, verdict.suspects) == 1
        )
    elif not explain_by_pairs(
        params, sensors, sample, room, verdict
    ) and not explain_by_units(params, sensors, sample, room, verdict):
        verdict.isolated = False
        for i in range(n):
            verdict.suspects[i] = sensors.detectable[i]
    for i in range(n):
        if not verdict.suspects[i]:
            verdict.error[i] = 0.0


@compiled
def explain_by_pairs(
    params: Hypotheses,
    sensors: Sensors,
    sample: SampleInput,
    room: Scratch,
    verdict: SampleVerdict,
) -> bool:
    """Name the channels of all pairs that explain the sample. Return False if none does."""
    if not params.pairs:
        return False
    n = sensors.n
    possible = 0
    for i in range(n):
        verdict.suspects[i] = False
        room.misfit[i] = math.inf
    for i in range(n):
        for j in range(i + 1, n):
            # Two indistinguishable channels explain no more than one alone.
            if (
                sensors.detectable[i]
                and sensors.detectable[j]
                and not sensors.alike[i, j]
            ):
                residual = fit(params, sensors, sample, room, i, j, -1)
                if residual <= params.pair_limit:
                    possible += 1
                    add_suspect(room, verdict, i, residual, room.estimate[0])
                    add_suspect(room, verdict, j, residual, room.estimate[1])
    if possible == 0:
        return False
    verdict.isolated = add_alike(sensors, verdict.suspects) == 2 and possible == 1
    return True


@compiled
def add_suspect(
    room: Scratch, verdict: SampleVerdict, i: int, residual: float, estimate: float
) -> None:
    """Add a channel of a pair that explains the sample, with its error in its best pair.

    Among equally good pairs, such as those of three parallel axes, the largest error counts.
    """
    verdict.suspects[i] = True
    as_good = residual <= room.misfit[i] + SAME_FIT and abs(estimate) > abs(
        verdict.error[i]
    )
    if residual < room.misfit[i] - SAME_FIT or as_good:
        verdict.error[i] = estimate
    room.misfit[i] = min(room.misfit[i], residual)


@compiled
def explain_by_units(
    params: Hypotheses,
    sensors: Sensors,
    sample: SampleInput,
    room: Scratch,
    verdict: SampleVerdict,
) -> bool:
    """Name the unit that explains the sample. Return False unless exactly one does."""
    found = -1
    possible = 0
    for k in range(params.units):
        unit = params.unit[k]
        if (
            fit(params, sensors, sample, room, unit[0], unit[1], unit[2])
            <= params.unit_limit
        ):
            found = k
            possible = possible + 1
            for place in range(3):
                room.misfit[place] = room.estimate[place]
    if possible != 1:
        return False
    for i in range(sensors.n):
        verdict.suspects[i] = False
    for place in range(3):
        verdict.suspects[params.unit[found, place]] = True
        verdict.error[params.unit[found, place]] = room.misfit[place]
    verdict.isolated = True
    return True


@compiled
def add_alike(sensors: Sensors, suspects: NDArray[np.uint8]) -> int:
    """Add all channels indistinguishable from a suspect. Return the number of suspects."""
    count = 0
    for i in range(sensors.n):
        if sensors.detectable[i] and not suspects[i]:
            for j in range(sensors.n):
                # Alike is transitive, so an added channel represents its whole group.
                if suspects[j] and sensors.alike[i, j]:
                    suspects[i] = True
        if suspects[i]:
            count += 1
    return count


# The method


@record
class Constants:
    """Constants of `judge`."""

    sensors: Sensors
    hypotheses: Hypotheses
    threshold: Real  # of the largest |w|


@callback(Constants, Scratch, SampleInput, SampleVerdict)
def judge(
    params: Constants, room: Scratch, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample by the largest whitened residual."""
    sensors = params.sensors
    largest = 0.0
    fill_scratch(params.hypotheses, sensors, sample, room)
    for i in range(sensors.n):
        verdict.scores[i] = math.nan
        if sensors.detectable[i]:
            verdict.scores[i] = abs(
                whitened(params.hypotheses, sensors, sample, room, i)
            )
            largest = max(largest, verdict.scores[i])
    verdict.statistic = largest
    verdict.threshold = params.threshold
    verdict.alarm = largest >= params.threshold
    if verdict.alarm:
        explain(params.hypotheses, sensors, sample, room, verdict)


class LikelihoodRatio(Detector):
    r"""Largest whitened residual, with an exact false-alarm probability.

    If channel i has an unknown error, the logarithm of the likelihood rises by ``w_i^2 /
    2``, ``w_i = (z_i - h_i omega_i) / std``. Here omega_i is the weighted least-squares rate
    of the other channels, and std the standard deviation of the difference. With constant
    noise of equal size ``w_i = r_i / (sigma sqrt(S_ii))``. The statistic is ``max_i |w_i|``.
    The threshold is exact for correlated w_i (`max_normal_threshold`) with the weights of
    noise_std. On alarm `explain` finds the suspects: one channel, its rivals, or pairs.
    docs/methods.md contains details and applications.

    Parameters
    ----------
    geometry, noise
        As of every `Detector`.
    false_alarm_probability, false_alarms_per_hour, sample_rate
        Per sample, 0 to 1, or per hour at a sample rate in Hz. Default 1e-6 per sample.
    confidence
        Confidence with which rivals are rejected, above 0.5 and below 1.

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
        rate = FalseAlarmRate(
            None, false_alarm_probability, false_alarms_per_hour, sample_rate
        )
        self.probability = rate.per_sample()
        super().__init__(
            geometry,
            noise,
            {"false_alarm_probability": self.probability, "confidence": confidence},
        )
        params = self.constants[0]
        prepare_hypotheses(
            params["hypotheses"],
            geometry,
            self.noise,
            confidence,
            fixed=self.noise.constant,
        )
        self.threshold = max_normal_threshold(
            whitened_directions(geometry, self.noise), self.probability
        )
        params["threshold"] = self.threshold
