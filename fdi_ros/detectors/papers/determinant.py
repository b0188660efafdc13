# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Identification among five channels by determinants: section 4 of the paper on identification of faults.

"Algorithms of identification of faults of navigation measuring elements" (in Russian, no author line).
"""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array
from fdi_ros.compiling.compiled import callback, compiled
from fdi_ros.compiling.record import Flag, record
from fdi_ros.core.records import NoState, SampleInput, SampleVerdict
from fdi_ros.detectors.papers.single_fault import (
    SingleFault,
    SingleFaultDetector,
    conclude,
    find_variances,
    largest_form_threshold,
    resting_std,
    std_of,
    value_of,
    worst,
)
from fdi_ros.errors import ConfigError, DetectorError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import FalseAlarmRate

Four = tuple[float, float, float, float]

CHANNELS = 5
CRITERIA = ("determinant", "condition_number")
MOST_STEPS = 40
"""Newton steps for a root; five are usual."""
NO_POWER = 1e-200
"""Added to every term, so that a sample of zeros divides nothing by zero."""
OFF_THE_POLE = 1 + 1e-15
SINGULAR = 1e-200
"""A condition number above one over this is infinite."""


@record
class Struck(SingleFault):
    """Constants of the comparison: [j] is [H z] without row j."""

    determinants: Annotated[NDArray[np.float64], "f8", (CHANNELS, CHANNELS)]  # as forms of z
    determinants_resting: Annotated[NDArray[np.float64], "f8", (CHANNELS,)]  # their standard deviations at rest, rad/s
    by_condition: Flag  # the criterion is the condition number
    left: Annotated[NDArray[np.float64], "f8", (CHANNELS, 4, CHANNELS)]  # U' of H, as forms of z
    singular: Annotated[NDArray[np.float64], "f8", (CHANNELS, 3)]  # singular values of H


@callback(Struck, NoState, SampleInput, SampleVerdict)
def judge(own: Struck, state: NoState, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Judge one sample by the largest determinant over its standard deviation."""
    constant = own.sensors.constant
    if not constant:
        # The place of the errors is free until the verdict is concluded.
        find_variances(own, sample, verdict.error)
    statistic = 0.0
    for j in range(CHANNELS):
        size = abs(value_of(own.determinants[j], sample.z, CHANNELS))
        # A determinant that is always zero has no deviation.
        if size > 0:
            std = own.determinants_resting[j] if constant else std_of(own.determinants[j], verdict.error, CHANNELS)
            statistic = max(statistic, size / std)
        verdict.scores[j] = condition_without(own, j, sample) if own.by_condition else size
    conclude(own, worst(own, verdict), statistic, own.limit, sample, verdict)


@compiled
def condition_without(own: Struck, j: int, sample: SampleInput) -> float:
    """2-norm condition number of [H z] without row j; infinite where that is singular.

    With ``U diag(s) Q'`` the singular value decomposition of the axes without row j, ``u = U' z`` and delta the last
    of its four entries (U's last column is normal to the axes), the largest singular value squared is the largest root
    of ``sum_k u_k^2 / (x - s_k^2) = 1``, s_4 = 0. The inverse of the smallest, squared and times delta^2, is that of
    ``sum_k (u_k / s_k)^2 / (x - delta^2 / s_k^2) + 1 / x = 1``. Neither divides by delta, which is zero for a failed
    row without noise.
    """
    left, z = own.left[j], sample.z
    s, t, v = own.singular[j, 0], own.singular[j, 1], own.singular[j, 2]
    a, b, c = value_of(left[0], z, CHANNELS), value_of(left[1], z, CHANNELS), value_of(left[2], z, CHANNELS)
    delta = abs(value_of(left[3], z, CHANNELS))
    largest = largest_root((a * a, b * b, c * c, delta * delta), (s * s, t * t, v * v, 0.0))
    a, b, c = a / s, b / t, c / v
    s, t, v = delta / s, delta / t, delta / v
    inverse = largest_root((a * a, b * b, c * c, 1.0), (s * s, t * t, v * v, 0.0))
    product = math.sqrt(largest) * math.sqrt(inverse)
    return product / delta if delta > SINGULAR * product else math.inf


@compiled
def largest_root(powers: Four, poles: Four) -> float:
    """Largest root x of ``sum_k powers_k / (x - poles_k) = 1``, or the largest pole.

    Newton's method on one over the sum, which is concave in x: it climbs from the left and never oversteps.
    """
    x = 0.0
    for k in range(4):
        x = max(x, poles[k] + (powers[k] + NO_POWER))
    x *= OFF_THE_POLE
    for _ in range(MOST_STEPS):
        value, slope = 0.0, 0.0
        for k in range(4):
            inverse = 1.0 / (x - poles[k])
            term = (powers[k] + NO_POWER) * inverse
            value += term
            slope += term * inverse
        climbed = x + max(value * (value - 1.0) / slope, 0.0)
        if climbed == x:
            break
        x = climbed
    return x


class Determinant(SingleFaultDetector):
    """Five channels: the one without which axes and sample are consistent.

    Form ``[H z]`` (5, 4) and strike row j (section 4): ``d_j = |det|``. Without noise d_j is zero for the failed
    channel and only there; with noise the failed channel is the argmin. The determinant is linear in z, its
    coefficients are the cofactors of H, precomputed. In terms of parity d_j is the residual of the one equation left
    without row j, times a factor that does not depend on z.

    ``criterion="condition_number"``: the failed channel has the largest condition number (2-norm) of the four by four
    matrix. H is fixed and only its last column changes: the extreme singular values are roots of a secular equation
    of rank one, found by Newton's method.

    ``scores``: d_j, rad/s, or the condition numbers. Statistic, for both: the largest d_j over its standard deviation.
    Without a fault all five are noise; a fault leaves only its own so. Threshold: the level that the statistic exceeds
    with the false-alarm probability asked for; exact for constant noise.

    Assumes one fault at a time, five channels. Good: cheap, and as sure as `projector` on symmetric axes. Bad: d_j is
    not scaled by how well a fault of channel j is seen; on lopsided axes badly seen channels are preferred. The
    condition number is wrong where the fault outweighs the body rate: at rest the matrix that holds the fault is the
    worse conditioned one. It serves in motion, or not at all; and it costs about nine times as much.

    With 4 channels, after an isolation, striking a row leaves nothing to compare: it is refused, as is every other
    number.

    Parameters
    ----------
    geometry
        Sensitivity axes, five.
    noise
        Error model of a healthy channel.
    criterion
        ``determinant`` or ``condition_number``.
    false_alarm_probability, false_alarms_per_hour, sample_rate
        Per sample, or per hour at a sample rate in Hz; default 1e-6 per sample.

    Raises
    ------
    DetectorError
        If there are not five channels.
    ConfigError
        If an option is out of its range.
    """

    name = "determinant"
    Constants = Struck
    judge = judge

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        criterion: str = "determinant",
        false_alarm_probability: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
    ) -> None:
        rate = FalseAlarmRate(false_alarm_probability, false_alarms_per_hour, sample_rate=sample_rate)
        options = {"criterion": criterion, **rate.as_options()}
        if refused := self.refuses(geometry.n):
            raise DetectorError(refused)
        if criterion not in CRITERIA:
            raise ConfigError(f"criterion is {criterion!r}, expected one of: {', '.join(CRITERIA)}")
        probability = rate.per_sample()
        by_condition = criterion == "condition_number"
        super().__init__(geometry, noise, options, largest=by_condition)
        forms = determinant_forms(geometry.axes)
        own = self.constants[0]
        own["determinants"], own["determinants_resting"] = forms, resting_std(forms, self.noise)
        own["by_condition"] = by_condition
        own["limit"] = largest_form_threshold(forms, geometry, self.noise, probability)
        for j in range(CHANNELS):
            others = np.delete(np.arange(CHANNELS), j)
            left, own["singular"][j], _ = np.linalg.svd(geometry.axes[others])
            own["left"][j][:, others] = left.T

    @classmethod
    def refuses(cls, n: int) -> str:
        """Why the method cannot run on n channels."""
        if n == CHANNELS:
            return ""
        return (
            f"determinant has {n} channels, expected {CHANNELS}: struck of one row, only [H z] of five rows is square"
        )


def determinant_forms(axes: Array) -> Array:
    """Forms (5, 5) of z: row j gives det of [axes z] without row j."""
    forms = np.zeros((CHANNELS, CHANNELS))
    for j in range(CHANNELS):
        others = np.delete(np.arange(CHANNELS), j)
        for place, k in enumerate(others):
            sign = -1.0 if place % 2 == 0 else 1.0
            forms[j, k] = sign * np.linalg.det(axes[np.delete(others, place)])
    return forms
