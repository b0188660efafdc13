"""What all methods share that blame the one channel whose fault explains a sample best."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Detector, Verdict
from fdi_ros.detectors.forms import ParityForms, prediction_errors
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

TRIAL_FAULT = 50.0
"""Size of the faults tried, in noise_std of their channel."""
TRIAL_NOISE = 1.5
"""The noise of the trials, in noise_std."""
TRIALS = 200
"""Trials a channel."""


class SingleFaultDetector(Detector):
    """Base of methods that name one channel and compare one figure with one threshold.

    A method gives the linear forms of z its scores are made of, and which end of the scores is the worst channel. All
    forms, and the difference of each channel from its prediction, come from one product with a fixed matrix.

    The channel named stands for all that have its parity direction: they are the suspects together, and the fault
    is isolated only where there is no other. A method that may name one channel for a large fault of another, as
    some do on lopsided axes, tries that in advance (`_try_faults`): all whose fault may have had it named are suspects.
    The error of a suspect is its difference from the prediction of all
    other channels, ``z_i - z_ip = r_i / S_ii``: the least-squares estimate were it alone at fault.

    Statistic and threshold, unless a method has its own: ``|z_i - z_ip|`` of the channel named over its standard
    deviation, against the level that the largest of these over all channels exceeds with the false-alarm probability.

    A single sample takes a way of its own, with Python floats where arrays of length one would be slow, equal to the
    way of blocks to the last bit.

    Parameters
    ----------
    geometry, noise, options
        As for every detector.
    forms
        Linear forms, (t, k, n); by default score k is the sum over t of their absolute values.
    largest
        The worst channel has the largest score, not the least.
    squares
        Sum squares, not absolute values.
    errors
        Matrix (n, n) that maps z to ``z_i - z_ip``; by default from the axes.
    """

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        options: dict[str, Any],
        forms: Array,
        *,
        largest: bool = False,
        squares: bool = False,
        errors: Array | None = None,
    ) -> None:
        super().__init__(geometry, noise, options)
        errors = prediction_errors(geometry.axes) if errors is None else errors
        self._shape = forms.shape[:2]
        self._split = forms.shape[0] * forms.shape[1]
        self._matrix = np.ascontiguousarray(np.vstack([forms.reshape(self._split, -1), errors]).T)
        self._largest = largest
        self._squares = squares
        self._suspects: Mask = geometry.group_matrix & geometry.detectable
        self._names: Mask = geometry.isolable
        worst = -np.inf if largest else np.inf
        self._blind = None if geometry.detectable.all() else np.where(geometry.detectable, 0.0, worst)
        self._share = np.diag(geometry.S).copy()
        self._constant = self.noise.constant
        self._errors = ParityForms(errors, geometry, self.noise)
        self._resting = self._errors.resting.tolist()
        self._limit = np.inf

    @property
    def isolable(self) -> Mask:
        """Channels whose fault is named, and no other's fault in its place, (n,)."""
        return self._names & ~(self._suspects & ~np.eye(self.geometry.n, dtype=bool)).any(axis=0)

    def _try_faults(self) -> None:
        """Find out which channels are named for a fault of `TRIAL_FAULT`: row i of the suspects, if i is named.

        The same trials each time, in somewhat more than the noise assumed. Larger faults are named no worse: the
        scores are even homogeneous functions of z, of which the fault then is the larger part.
        """
        n = self.geometry.n
        noise = TRIAL_NOISE * self.noise.noise_std * np.random.default_rng(n).standard_normal((TRIALS, n))
        found = self._suspects.copy()
        for channel in np.flatnonzero(self.geometry.detectable):
            z = noise.copy()
            z[:, channel] += TRIAL_FAULT * self.noise.noise_std[channel]
            named = self._judge_block(z, None).suspects.any(axis=0)
            found[named] |= self._suspects[channel]
        self._suspects = found
        self._names = self.geometry.isolable & (found.sum(axis=1) == 1)

    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        if len(z) > 1:
            return self._judge_block(z, acceleration)
        row = transform(self._matrix, z)[0]
        forms, errors = row[: self._split], row[self._split :]
        forms = self._weighed(forms, errors, z, acceleration)
        scores = self._scores_one(forms, z)
        named = int(self._worst(scores))
        statistic, threshold = self._figure_one(named, forms, errors, z, acceleration)
        return self._conclude_one(named, statistic, threshold, errors, self._published(scores))

    def _judge_block(self, z: Array, acceleration: Array | None) -> Verdict:
        columns = transform(self._matrix, z).T
        forms, errors = columns[: self._split], columns[self._split :]
        forms = self._weighed(forms, errors, z, acceleration)
        scores = self._scores_block(forms, z)
        named = self._worst(scores)
        statistic, threshold = self._figure_block(named, forms, errors, z, acceleration)
        return self._conclude_block(named, statistic, threshold, errors, self._published(scores))

    def _weighed(self, forms: Array, errors: Array, z: Array, acceleration: Array | None) -> Array:
        """Forms (t * k,) or (t * k, N) in the units in which the method compares them."""
        return forms

    def _scores_one(self, forms: Array, z: Array) -> Array:
        """Scores (n,) of one sample z (1, n) from its forms (t * k,)."""
        terms = forms * forms if self._squares else np.abs(forms)
        return terms if self._shape[0] == 1 else np.add.accumulate(terms.reshape(self._shape))[-1]

    def _scores_block(self, forms: Array, z: Array) -> Array:
        """Scores (n, N) of samples z (N, n) from their forms (t * k, N)."""
        terms = forms * forms if self._squares else np.abs(forms)
        return sum_terms(terms.reshape(*self._shape, -1))

    def _figure_one(
        self, named: int, forms: Array, errors: Array, z: Array, acceleration: Array | None
    ) -> tuple[float, float]:
        """Statistic and threshold of one sample."""
        if self._constant:
            return abs(errors.item(named)) / self._resting[named], self._limit
        std = self._errors.std_one(self._rate_along(z, errors), acceleration, named)
        return abs(errors.item(named)) / std, self._limit

    def _figure_block(
        self, named: Index, forms: Array, errors: Array, z: Array, acceleration: Array | None
    ) -> tuple[Array, Array | float]:
        """Statistic (N,) and threshold of a block."""
        size = np.abs(pick(errors, named))
        if self._constant:
            return size / self._errors.resting[named], self._limit
        std = self._errors.std(self._rate_along(z, errors.T), acceleration)
        return size / pick(std.T, named), self._limit

    def _rate_along(self, z: Array, errors: Array) -> Array:
        """Least-squares body rate along each axis, (N, n) rad/s, from z and the prediction errors (N, n)."""
        return z - errors * self._share

    def _worst(self, scores: Array) -> Index:
        """Worst channel from scores (n,) or (n, N)."""
        if self._blind is not None:
            scores = (scores.T + self._blind).T
        return np.asarray(scores.argmax(axis=0) if self._largest else scores.argmin(axis=0))

    def _published(self, scores: Array) -> Array:
        """Scores (n,) or (n, N) with NaN for channels no fault of which is seen."""
        if self._blind is None:
            return scores
        return np.where(self.geometry.detectable, scores.T, np.nan).T

    def _conclude_one(self, named: int, statistic: float, threshold: float, errors: Array, scores: Array) -> Verdict:
        alarm = statistic >= threshold
        isolated = False
        if alarm:
            suspects = self._suspects[named : named + 1].copy()
            error = np.where(suspects, errors, 0.0)
            isolated = bool(self._names[named])
        else:
            suspects = np.zeros((1, self.geometry.n), dtype=bool)
            error = np.zeros((1, self.geometry.n))
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
        alarm = statistic >= threshold
        suspects = np.zeros(errors.T.shape, dtype=bool)
        isolated = np.zeros(len(alarm), dtype=bool)
        error = np.zeros(errors.T.shape)
        rows = np.flatnonzero(alarm)
        if len(rows):
            suspects[rows] = self._suspects[named[rows]]
            isolated[rows] = self._names[named[rows]]
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
