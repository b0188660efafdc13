# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The chi-square test of the whole parity vector: the textbook test that the methods are compared with."""

from __future__ import annotations

import numpy as np

from fdi_ros.core.bank import NoState, SampleInput, SampleVerdict, Sensors
from fdi_ros.core.compiled import callback
from fdi_ros.core.record import Real, Square, record
from fdi_ros.detectors import Detector
from fdi_ros.detectors.papers.forms import value_of
from fdi_ros.model.false_alarm_rate import FalseAlarmRate
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import chi2_isf


@record
class ChiSquareConstants:
    """What the chi-square test needs."""

    sensors: Sensors
    parity: Square  # whitened parity vector from z, n - 3 rows, 1 / (rad/s)
    normalised: Square  # row i: w_i from z, 1 / (rad/s)
    threshold: Real


@callback(ChiSquareConstants, NoState, SampleInput, SampleVerdict)
def judge(own: ChiSquareConstants, state: NoState, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Square of the whitened parity vector; on alarm the channel of the largest ``|w_i|``."""
    n, square, worst = own.sensors.n, 0.0, 0
    for k in range(n - 3):
        component = value_of(own.parity[k], sample.z, n)
        square += component * component
    for i in range(n):
        verdict.scores[i] = abs(value_of(own.normalised[i], sample.z, n))
        if verdict.scores[i] > verdict.scores[worst]:
            worst = i
    verdict.statistic, verdict.threshold = square, own.threshold
    if square >= own.threshold:
        verdict.alarm = verdict.isolated = verdict.suspects[worst] = True
        verdict.error[worst] = verdict.scores[worst]


class ChiSquare(Detector):
    """Chi-square test of the whole parity vector, constant noise; names the channel of the largest ``|w_i|``.

    Not a detector of the monitor.
    """

    name = "chi_square"
    Constants = ChiSquareConstants
    judge = judge

    def __init__(self, geometry: Geometry, noise: NoiseModel, *, false_alarm_probability: float | None = None) -> None:
        super().__init__(geometry, noise, {"false_alarm_probability": false_alarm_probability})
        white = geometry.axes / self.noise.noise_std[:, None]
        basis = np.linalg.qr(white, mode="complete")[0][:, 3:]
        parity = basis / self.noise.noise_std[:, None]
        length = np.linalg.norm(basis, axis=1)
        scale = np.where(geometry.detectable, length, np.inf)
        own, n = self.constants[0], geometry.n
        own["parity"][: n - 3, :n] = parity.T
        own["normalised"][:n, :n] = (parity @ basis.T / scale).T
        self.threshold = chi2_isf(FalseAlarmRate(false_alarm_probability).per_sample(), n - 3)
        own["threshold"] = self.threshold
