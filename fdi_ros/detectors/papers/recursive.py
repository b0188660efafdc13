# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Identification by recursion over cyclic permutations: section 3 of the paper on identification of faults.

"Algorithms of identification of faults of navigation measuring elements" (in Russian, no author line).
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array
from fdi_ros.compiling.compiled import callback
from fdi_ros.compiling.record import MAX_CHANNELS, record
from fdi_ros.core.records import NoState, SampleInput, SampleVerdict
from fdi_ros.detectors.papers.single_fault import (
    SingleFault,
    SingleFaultDetector,
    conclude,
    find_variances,
    largest_form_threshold,
    std_of,
    value_of,
    worst,
)
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import FalseAlarmRate

Index = NDArray[np.intp]

SPANNED = 1e-9
"""An axis with less than this share outside the space of other axes lies in it."""
NOTHING = 1e-20
"""k_s of an innovation of 1e-10 standard deviations: rounding. Added to divisors, it makes 0 / 0 zero."""


@record
class Innovations(SingleFault):
    """Constants of the recursion: [k, i] is innovation k of the permutation with channel i last."""

    innovations: Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS - 3, MAX_CHANNELS, MAX_CHANNELS)]


@callback(Innovations, NoState, SampleInput, SampleVerdict)
def judge(own: Innovations, state: NoState, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Judge one sample by the largest k_s of all equations and permutations."""
    n, constant = own.sensors.n, own.sensors.constant
    if not constant:
        # The place of the errors is free until the verdict is concluded.
        find_variances(own, sample, verdict.error)
    largest = 0.0
    for i in range(n):
        before, last = 0.0, 0.0
        for k in range(n - 3):
            innovation = value_of(own.innovations[k, i], sample.z, n)
            if not constant:
                innovation /= std_of(own.innovations[k, i], verdict.error, n)
            before, last = last, innovation * innovation
            largest = max(largest, last)
        verdict.scores[i] = last / (before + NOTHING) if n > 4 else last
    conclude(own, worst(own, verdict), largest, own.limit, sample, verdict)


class Recursive(SingleFaultDetector):
    """The channel whose equation, taken last, breaks a recursion that went well until then.

    The equations ``z_i = a_i x`` are solved one by one (section 3):
    ``x+ = x + P a' Y (z - a x)``, ``Y = (sigma^2 + a P a')^-1``, ``P+ = P - P a' Y a P``. Those that find the rate
    (three, with axes that span space) have no innovation; each other gives ``k_s = nu^2 Y``, chi-square with one
    degree of freedom while the model holds. This is done for all n cyclic permutations of the equations. The ratio
    of the last two k_s of a permutation is largest when the failed channel comes last.

    Innovations are fixed linear forms of z: those of all permutations are precomputed, with sigma_i the resting noise
    of each channel.

    ``scores``: of each channel, the last ratio ``k_s,n / k_s,n-1`` of the permutation that puts it last. The channel
    named has the largest.

    Statistic: the largest k_s of all equations and permutations. Threshold k_s,max: the level that it exceeds with
    the false-alarm probability asked for, exact for constant noise: the innovations are normal with known correlation.
    Where the noise depends on rate or acceleration, nu^2 is divided by its variance in that sample.

    Assumes one fault at a time. Good: one equation at a time is how a filter takes them; it names the channel of a
    large fault on any axes. With five channels the last two k_s add up to the whole parity vector, and it names what
    `projector` names. Bad: with more, the ratio divides by a figure that noise alone makes large or small: a fault
    of 8 sigma on the two-triad cone is named correctly in 84 % of samples, by `projector` in 98 %.

    With 4 channels there is one innovation a permutation and no ratio: it detects, isolates nothing, and the scores
    are NaN.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel.
    false_alarm_probability, false_alarms_per_hour, sample_rate
        Per sample, or per hour at a sample rate in Hz; default 1e-6 per sample.

    Raises
    ------
    ConfigError
        If an option is out of its range.
    """

    name = "recursive"
    Constants = Innovations
    judge = judge

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        false_alarm_probability: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
    ) -> None:
        rate = FalseAlarmRate(false_alarm_probability, false_alarms_per_hour, sample_rate=sample_rate)
        options = rate.as_options()
        probability = rate.per_sample()
        forms = innovations(geometry.axes, noise.for_channels(geometry.n).noise_std)
        super().__init__(geometry, noise, options, largest=True, scored=geometry.n > 4)
        n = geometry.n
        own = self.constants[0]
        own["innovations"][: n - 3, :n, :n] = forms
        own["limit"] = largest_form_threshold(forms.reshape(-1, n), geometry, self.noise, probability) ** 2


def innovations(axes: Array, noise_std: Array) -> Array:
    """Innovations over their standard deviation as linear forms of z.

    Parameters
    ----------
    axes
        Sensitivity axes, (n, 3).
    noise_std
        Standard deviation of each channel, (n,) rad/s.

    Returns
    -------
    Forms (n - 3, n, n): ``[k, i]`` is the k-th innovation of the permutation that puts channel i last.
    """
    n = len(axes)
    forms = np.zeros((n - 3, n, n))
    for last in range(n):
        order = (np.arange(n) + last + 1) % n
        found = (_innovation(axes, noise_std, order[:k], int(order[k])) for k in range(1, n))
        forms[:, last] = [form for form in found if form is not None]
    return forms


def _innovation(axes: Array, noise_std: Array, before: Index, new: int) -> Array | None:
    """Innovation form (n,) of one equation after those before it, None where they do not predict it."""
    weighted = axes[before] / noise_std[before][:, None]
    axis = axes[new] / noise_std[new]
    gain = axis @ np.linalg.pinv(weighted, rcond=SPANNED)
    if np.linalg.norm(axis - gain @ weighted) > SPANNED * np.linalg.norm(axis):
        return None
    form = np.zeros(len(axes))
    form[before] = -gain / noise_std[before]
    form[new] = 1 / noise_std[new]
    return form / np.sqrt(1 + gain @ gain)
