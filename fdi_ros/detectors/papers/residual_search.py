# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failed-channel searches by residuals: Gorelov, Zbrutskyi, Shcholieva, Yankelevych 2019."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from fdi_ros.detectors.papers.single_fault import (
    SingleFaultDetector,
    WithForms,
    chosen,
    judge_sums,
    largest_form_threshold,
    prediction_errors,
    set_forms,
)
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array

TOLERANCES = ("calibrated", "paper")


class ResidualSearch(SingleFaultDetector):
    """Search for the failed channel by one of four criteria, then test its tolerance.

    Gorelov et al. (2019). G_i is the least-squares inverse of H without row i, G_ij the
    inverse without rows i and j, and ``z_ip = h_i G_i z``. ``scores`` are the figures of
    the criterion, rad/s or (rad/s)^2. With 4 channels only those of `MaxResidual` exist,
    others are NaN.

    With the tolerance ``paper``, eq. (8), the statistic is ``|z_i - z_ip|``, rad/s, of the
    worst channel, and the threshold ``3 sqrt(sigma_0^2 + sigma_k^2 z_ip^2)``. With
    ``calibrated`` the statistic is divided by its standard deviation, prediction included.
    The largest one over all channels exceeds the threshold with the required
    false-alarm probability. docs/methods.md states when to use which.

    Parameters
    ----------
    geometry, noise
        As of every `Detector`.
    tolerance
        ``calibrated`` or ``paper``.
    rate
        For `calibrated`: `false_alarm_probability` per sample, by default 1e-6, or
        `false_alarms_per_hour` with `sample_rate`, Hz.

    Raises
    ------
    ConfigError
        If an option is out of range, or a false-alarm rate is given for `paper`.
    """

    Constants = WithForms
    judge = judge_sums
    #: The criterion sums squares, not absolute values.
    criterion_squares: ClassVar[bool] = False
    #: The worst channel has the largest figure, not the least.
    criterion_largest: ClassVar[bool] = False

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        tolerance: str = "calibrated",
        **rate: Any,
    ) -> None:
        paper = chosen("tolerance", tolerance, TOLERANCES) == "paper"
        if paper and any(
            value is not None for name, value in rate.items() if name != "sample_rate"
        ):
            raise ConfigError(
                "tolerance 'paper' keeps no false-alarm rate: leave it out, or take 'calibrated'"
            )
        # Three of four channels have no residual: only the last criterion exists.
        scored = self.criterion_largest or geometry.n > 4
        largest = self.criterion_largest or not scored
        super().__init__(
            geometry,
            noise,
            {"tolerance": tolerance},
            largest=largest,
            scored=scored,
            **rate,
        )
        params = self.constants[0]
        set_forms(
            params,
            self._forms(geometry) if scored else self.errors[None],
            self.criterion_squares and scored,
        )
        params["paper"] = paper
        if not paper:
            params["limit"] = largest_form_threshold(
                self.errors, geometry, self.noise, self.probability
            )
        self._try_faults()

    def _forms(self, geometry: Geometry) -> Array:
        """Linear forms (t, n, n) whose absolute values or squares, summed over t, are the scores."""
        return self.errors[None]


class MeanAbsResidual(ResidualSearch):
    """The channel i without which the mean over j of ``|z_j - h_j G_ij z|`` is least, eqs. (4)-(7)."""

    name = "mean_abs_residual"

    def _forms(self, geometry: Geometry) -> Array:
        n = geometry.n
        terms = np.zeros((n - 1, n, n))
        for i, forms, _ in _left_out(geometry):
            terms[: len(forms), i] = forms / len(forms)
        return terms


class MeanSquareResidual(ResidualSearch):
    """The channel i without which the mean over j of ``(z_j - h_j G_ij z)^2`` is least, eqs. (10)-(11)."""

    name = "mean_square_residual"
    criterion_squares = True

    def _forms(self, geometry: Geometry) -> Array:
        return _squares(geometry, lambda forms, gain: forms / math.sqrt(len(forms)))


class RateDeviation(ResidualSearch):
    """The channel i with the least mean over j and x, y, z of ``(G_i z - G_ij z)^2``, eqs. (12)-(16)."""

    name = "rate_deviation"
    criterion_squares = True

    def _forms(self, geometry: Geometry) -> Array:
        # Leaving out j changes the rate by G_i[:, j] (z_j - z_jp).
        return _squares(
            geometry,
            lambda forms, gain: (
                forms
                * np.linalg.norm(gain, axis=0)[:, None]
                / math.sqrt(3 * len(forms))
            ),
        )


class MaxResidual(ResidualSearch):
    """The channel i of the largest ``|z_i - z_ip|``, predicted by all others, eqs. (17)-(19)."""

    name = "max_residual"
    criterion_largest = True


def _left_out(geometry: Geometry) -> list[tuple[int, Array, Array]]:
    """Return for each detectable channel i the prediction errors among the others.

    Each element contains i, the forms ``z_j - h_j G_ij z`` (k, n) of the k channels j that
    the remaining channels predict, and the columns j of G_i (3, k).
    """
    found: list[tuple[int, Array, Array]] = []
    for i in map(int, np.flatnonzero(geometry.detectable)):
        others = np.delete(np.arange(geometry.n), i)
        forms = np.zeros((len(others), geometry.n))
        forms[:, others] = prediction_errors(geometry.axes[others])
        seen = forms.any(axis=1)
        gain = np.asarray(np.linalg.pinv(geometry.axes[others]), dtype=np.float64)
        found.append((i, forms[seen], gain[:, seen]))
    return found


def _squares(geometry: Geometry, weighted: Callable[[Array, Array], Array]) -> Array:
    """Return forms (n - 4, n, n) with the same sums of squares as the weighted forms.

    Each channel left out has as many forms as the rank of its weighted forms.
    """
    terms = np.zeros((geometry.n - 4, geometry.n, geometry.n))
    for i, forms, gain in _left_out(geometry):
        _, singular, rows = np.linalg.svd(weighted(forms, gain), full_matrices=False)
        scaled = singular[:, None] * rows
        terms[: len(singular), i] = scaled[: len(terms)]
    return terms
