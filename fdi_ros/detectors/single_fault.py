"""What all methods share that blame the one channel whose fault explains a sample best."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Detector, Verdict
from fdi_ros.detectors.forms import prediction_errors
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel

Array = NDArray[np.float64]
Index = NDArray[np.intp]


class SingleFaultDetector(Detector):
    """Base of methods that name one channel and compare one figure with one threshold.

    The channel named stands for all that have its parity direction: they are the suspects together, and the fault
    is isolated only where there is no other. The error of a suspect is its difference from the prediction of all
    other channels, ``z_i - z_ip = r_i / S_ii``: the least-squares estimate were it alone at fault.

    A single sample takes a way of its own with Python floats, several times faster than arrays of length one and
    equal to them to the last bit.
    """

    def __init__(self, geometry: Geometry, noise: NoiseModel, options: dict[str, Any]) -> None:
        super().__init__(geometry, noise, options)
        self._prediction_errors = prediction_errors(geometry.axes)
        self._suspects = geometry.group_matrix & geometry.detectable
        self._share = np.diag(geometry.S).copy()
        self._constant = self.noise.constant

    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        return self._judge_one(z, acceleration) if len(z) == 1 else self._judge_block(z, acceleration)

    @abstractmethod
    def _judge_one(self, z: Array, acceleration: Array | None) -> Verdict:
        """Judge one finite sample z (1, n)."""

    @abstractmethod
    def _judge_block(self, z: Array, acceleration: Array | None) -> Verdict:
        """Judge samples z (N, n), all finite."""

    def _rate_along(self, z: Array, errors: Array) -> Array:
        """Least-squares body rate along each axis, (N, n) rad/s, from z and the prediction errors (N, n)."""
        return z - errors * self._share

    def _conclude_one(self, named: int, statistic: float, threshold: float, errors: Array, scores: Array) -> Verdict:
        """Verdict on one sample; errors and scores (n,)."""
        alarm = statistic >= threshold
        n = self.geometry.n
        isolated = False
        if alarm:
            suspects = self._suspects[named : named + 1].copy()
            error = np.where(suspects, errors, 0.0)
            isolated = bool(self.geometry.isolable[named])
        else:
            suspects = np.zeros((1, n), dtype=bool)
            error = np.zeros((1, n))
        return Verdict(
            np.array([statistic]),
            np.array([threshold]),
            np.array([alarm]),
            suspects,
            np.array([isolated]),
            error,
            scores[None],
        )

    def _conclude_block(
        self, named: Index, statistic: Array, threshold: Array | float, errors: Array, scores: Array
    ) -> Verdict:
        """Verdict on a block; errors and scores channel by channel, (n, N)."""
        alarm = statistic >= threshold
        suspects = np.zeros(errors.T.shape, dtype=bool)
        isolated = np.zeros(len(alarm), dtype=bool)
        error = np.zeros(errors.T.shape)
        rows = np.flatnonzero(alarm)
        if len(rows):
            suspects[rows] = self._suspects[named[rows]]
            isolated[rows] = self.geometry.isolable[named[rows]]
            error[rows] = np.where(suspects[rows], errors.T[rows], 0.0)
        bound = np.broadcast_to(threshold, statistic.shape).copy()
        return Verdict(statistic, bound, alarm, suspects, isolated, error, np.ascontiguousarray(scores.T))


def pick(columns: Array, named: Index) -> Array:
    """Figure of the channel named in each sample: columns (n, N), named (N,), result (N,)."""
    return np.take_along_axis(columns, named[None], axis=0)[0]


def sum_terms(terms: Array) -> Array:
    """Sum over the first axis in order, (t, n, N) to (n, N), the same to the last bit for every N."""
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total
