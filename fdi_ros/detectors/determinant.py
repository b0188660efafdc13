"""Identification among five channels by determinants: section 4 of the paper on identification of faults.

"Algorithms of identification of faults of navigation measuring elements" (in Russian, no author line).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.forms import ParityForms
from fdi_ros.detectors.single_fault import SingleFaultDetector, sum_terms
from fdi_ros.errors import ConfigError, DetectorError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform
from fdi_ros.model.thresholds import false_alarm_probability as per_sample_probability

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CHANNELS = 5
CRITERIA = ("determinant", "condition_number")
MOST_STEPS = 40
"""Newton steps for a root; five are usual."""
NO_POWER = 1e-200
"""Added to every term, so that a sample of zeros divides nothing by zero."""
OFF_THE_POLE = 1 + 1e-15
ROOTS_AT_ONCE = 512
"""Rows whose roots are climbed to together: few, since all wait for the slowest."""
SINGULAR = 1e-200
"""A condition number above one over this is infinite."""


class Determinant(SingleFaultDetector):
    """Five channels: the one without which axes and sample are consistent.

    Form ``[H z]`` (5, 4) and strike row j (section 4): ``d_j = |det|``. Without noise d_j is zero for the failed
    channel and only there; with noise the failed channel is the argmin. The determinant is linear in z, its
    coefficients are the cofactors of H, precomputed. In terms of parity d_j is the residual of the one equation left
    without row j,
    times a factor that does not depend on z.

    ``criterion="condition_number"``: the failed channel has the largest condition number (2-norm) of the four by four
    matrix. H is fixed and only its last column changes: the extreme singular values are roots of a secular equation
    of rank one, found by a fixed number of Newton steps in array operations.

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
        Error model of a sound channel.
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
    min_channels = CHANNELS

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
        options = {
            "criterion": criterion,
            "false_alarm_probability": false_alarm_probability,
            "false_alarms_per_hour": false_alarms_per_hour,
            "sample_rate": sample_rate,
        }
        if geometry.n != CHANNELS:
            raise DetectorError(
                f"determinant has {geometry.n} channels, expected {CHANNELS}: struck of one row,"
                " only [H z] of five rows is square"
            )
        if criterion not in CRITERIA:
            raise ConfigError(f"criterion is {criterion!r}, expected one of: {', '.join(CRITERIA)}")
        probability = per_sample_probability(false_alarm_probability, false_alarms_per_hour, sample_rate)
        cofactors = determinant_forms(geometry.axes)
        self._by_condition = criterion == "condition_number"
        super().__init__(geometry, noise, options, cofactors[None], largest=self._by_condition)
        self._forms = ParityForms(cofactors, geometry, self.noise)
        self._limit = self._forms.threshold(probability)
        self._struck = _StruckMatrices(geometry.axes)

    def _scores_one(self, forms: Array, z: Array) -> Array:
        return self._struck.condition(z)[0] if self._by_condition else np.abs(forms)

    def _scores_block(self, forms: Array, z: Array) -> Array:
        if not self._by_condition:
            return np.abs(forms)
        parts = [self._struck.condition(z[start : start + ROOTS_AT_ONCE]) for start in range(0, len(z), ROOTS_AT_ONCE)]
        return np.concatenate(parts).T

    def _figure_one(
        self, named: int, forms: Array, errors: Array, z: Array, acceleration: Array | None
    ) -> tuple[float, float]:
        std = self._forms.resting
        if not self._constant:
            std = self._forms.std(self._rate_along(z, errors), acceleration)[0]
        return float(np.maximum.reduce(np.abs(forms) / std)), self._limit

    def _figure_block(
        self, named: Index, forms: Array, errors: Array, z: Array, acceleration: Array | None
    ) -> tuple[Array, Array | float]:
        std = self._forms.resting[:, None]
        if not self._constant:
            std = self._forms.std(self._rate_along(z, errors.T), acceleration).T
        return np.maximum.reduce(np.abs(forms) / std, axis=0), self._limit


def determinant_forms(axes: Array) -> Array:
    """Forms (5, 5) of z: row j gives det of [axes z] without row j."""
    forms = np.zeros((CHANNELS, CHANNELS))
    for j in range(CHANNELS):
        others = np.delete(np.arange(CHANNELS), j)
        for place, k in enumerate(others):
            sign = -1.0 if place % 2 == 0 else 1.0
            forms[j, k] = sign * np.linalg.det(axes[np.delete(others, place)])
    return forms


class _StruckMatrices:
    """2-norm condition number of [H z] without each row in turn.

    With ``U diag(s) Q'`` the singular value decomposition of the axes without row j, ``u = U' z`` and delta the last
    of its four entries (U's last column is normal to the axes), the largest singular value squared is the largest root
    of ``sum_k u_k^2 / (x - s_k^2) = 1``, s_4 = 0. The inverse of the smallest, squared and times delta^2, is that of
    ``sum_k (u_k / s_k)^2 / (x - delta^2 / s_k^2) + 1 / x = 1``. Neither divides by delta, which is zero for a failed
    row without noise.
    """

    def __init__(self, axes: Array) -> None:
        forms = np.zeros((4, CHANNELS, CHANNELS))
        self._singular = np.zeros((3, CHANNELS, 1))
        for j in range(CHANNELS):
            others = np.delete(np.arange(CHANNELS), j)
            left, singular, _ = np.linalg.svd(axes[others])
            forms[:, j, others] = left.T
            self._singular[:, j, 0] = singular
        self._matrix = np.ascontiguousarray(forms.reshape(-1, CHANNELS).T)

    def condition(self, z: Array) -> Array:
        """Condition numbers (N, 5) of samples z (N, 5); infinite where the matrix is singular."""
        u = np.ascontiguousarray(transform(self._matrix, z).T).reshape(4, CHANNELS, -1)
        delta = np.abs(u[3])
        powers, poles = np.zeros((2, 4, 2, CHANNELS, len(z)))
        powers[:, 0] = u
        powers[:3, 1] = u[:3] / self._singular
        powers[3, 1] = 1.0
        powers *= powers
        poles[:3, 0] = self._singular**2
        poles[:3, 1] = (delta / self._singular) ** 2
        largest, inverse = np.sqrt(_largest_root(powers, poles))
        product = largest * inverse
        infinite = np.full(product.shape, np.inf)
        return np.divide(product, delta, out=infinite, where=delta > SINGULAR * product).T


def _largest_root(powers: Array, poles: Array) -> Array:
    """Largest root x of ``sum_k powers_k / (x - poles_k) = 1``, or the largest pole; sums over the first axis.

    Newton's method on one over the sum, which is concave in x: it climbs from the left and never oversteps.
    """
    powers = powers + NO_POWER
    x = np.maximum.reduce(poles + powers) * OFF_THE_POLE
    for _ in range(MOST_STEPS):
        inverse = 1.0 / (x - poles)
        terms = powers * inverse
        value = sum_terms(terms)
        terms *= inverse
        slope = sum_terms(terms)
        climbed = x + np.maximum(value * (value - 1.0) / slope, 0.0)
        # A root that stands still does so for good: stopping early changes no sample, whatever else is in the block.
        if (climbed == x).all():
            break
        x = climbed
    return x
