# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Identification by the projector on parity space: sections 1-2 of the paper on identification of faults.

"Algorithms of identification of faults of navigation measuring elements" (in Russian, no author line).
"""

from __future__ import annotations

from itertools import combinations
from math import comb
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.arrays import Array
from fdi_ros.compiling.compiled import callback
from fdi_ros.compiling.record import MAX_CHANNELS, Whole, record
from fdi_ros.core.records import NoState, SampleInput, SampleVerdict
from fdi_ros.detectors.papers.single_fault import (
    SingleFault,
    SingleFaultDetector,
    SumsOfForms,
    conclude,
    error_ratio,
    largest_form_threshold,
    score_by_sums,
    set_forms,
    value_of,
    worst,
)
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import FalseAlarmRate

CONSTRUCTIONS = ("svd", "qr")
NORMS = ("l2", "l1")
MIN_BASIS_DETERMINANT = 1e-9
"""Channels whose parity directions span less volume than this are no basis of parity space."""
MOST_IN_SET = MAX_CHANNELS - 3
MOST_SETS = comb(MAX_CHANNELS, 3)


@record
class OneNorm(SingleFault):
    """For the norm `l1`: every set of n - 3 channels whose errors alone can explain a sample."""

    sets: Whole  # how many
    channels: Annotated[NDArray[np.uint8], "u1", (MOST_SETS, MOST_IN_SET)]  # [b, k]: channel k of set b
    solutions: Annotated[NDArray[np.float64], "f8", (MOST_SETS, MOST_IN_SET, MAX_CHANNELS)]  # its error as a form of z


@callback(SumsOfForms, NoState, SampleInput, SampleVerdict)
def judge(own: SumsOfForms, state: NoState, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Judge one sample by what a fault of each channel leaves unexplained."""
    score_by_sums(own, sample, verdict)
    named = worst(own, verdict)
    conclude(own, named, error_ratio(own, named, sample, verdict), own.limit, sample, verdict)


@callback(OneNorm, NoState, SampleInput, SampleVerdict)
def judge_one_norm(own: OneNorm, state: NoState, sample: SampleInput, verdict: SampleVerdict) -> None:
    """Judge one sample by the error of least 1-norm that explains it."""
    n, z = own.sensors.n, sample.z
    best, least = 0, np.inf
    for b in range(own.sets):
        norm = 0.0
        for k in range(n - 3):
            norm += abs(value_of(own.solutions[b, k], z, n))
            if norm >= least:
                break
        if norm < least:
            best, least = b, norm
    # The scores of all other channels are zero as they come.
    for k in range(n - 3):
        verdict.scores[own.channels[best, k]] = abs(value_of(own.solutions[best, k], z, n))
    named = worst(own, verdict)
    conclude(own, named, error_ratio(own, named, sample, verdict), own.limit, sample, verdict)


class Projector(SingleFaultDetector):
    """The channel whose fault leaves least of the parity vector unexplained.

    U2 (n, n - 3) spans the space in which the body rate cancels, ``U2' H = 0``: the last columns of the orthogonal
    factor of the SVD or of the QR decomposition of H. ``e0 = U2 U2' z = G z`` is the least error that explains the
    sample, g_k the columns of G. For every channel (section 2):

    - ``kappa_k = g_k' e0 / |g_k|^2``: its error were it alone at fault, rad/s;
    - ``J(k) = |g_k kappa_k - e0|^2``: what that leaves, (rad/s)^2. The failed channel is the argmin.

    ``norm="l1"``: the error e of least 1-norm with ``U2' e = U2' z``. Such an e has at most n - 3 entries that are not
    zero, so it is found exactly by trying every set of n - 3 channels; the failed channel has the largest ``|e_k|``.
    kappa_k is then still the one above: the estimate were k alone at fault.

    ``scores``: J(k), or ``|e_k|`` for `l1`. Statistic: ``|kappa_k|`` of the channel named, over its standard deviation.
    Threshold: the level that the largest of ``|kappa_k|`` / std over all channels exceeds with the false-alarm
    probability asked for. With equal white noise kappa_k over its deviation is w_k and the argmin of J the argmax of
    ``|w_k|``: the likelihood-ratio choice, and the threshold is exact. For `l1`, or unequal noise, it is an upper
    bound.

    Assumes one fault at a time; J weighs all channels alike. Good: any axes, names the most likely channel. Bad:
    channels of unequal noise (take `likelihood_ratio`), two faults at once. `l1` names no channel whose parity
    direction lies within the hull of the others', however large its fault, but another: both are suspects then and
    neither is isolated. On symmetric axes there is none such, on arbitrary ones often. Its cost grows as the number
    of sets of n - 3 channels: 20 at n = 6, 84 at n = 9, 220 at 12.

    With 4 channels it detects and isolates nothing.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel.
    construction
        ``svd`` or ``qr``: equal to rounding, QR is cheaper to build.
    norm
        ``l2`` or ``l1``.
    false_alarm_probability, false_alarms_per_hour, sample_rate
        Per sample, or per hour at a sample rate in Hz; default 1e-6 per sample.

    Raises
    ------
    ConfigError
        If an option is out of its range.
    """

    name = "projector"
    Constants = SumsOfForms
    judge = judge

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        construction: str = "svd",
        norm: str = "l2",
        false_alarm_probability: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
    ) -> None:
        rate = FalseAlarmRate(false_alarm_probability, false_alarms_per_hour, sample_rate=sample_rate)
        options = {"construction": construction, "norm": norm, **rate.as_options()}
        probability = rate.per_sample()
        if norm not in NORMS:
            raise ConfigError(f"norm is {norm!r}, expected one of: {', '.join(NORMS)}")
        if norm == "l1":
            self.Constants = OneNorm  # type: ignore[assignment]
            self.judge = judge_one_norm
        self.basis = parity_basis(geometry.axes, construction)
        """U2, (n, n - 3)."""
        errors = _single_errors(self.basis, geometry.detectable)
        super().__init__(geometry, noise, options, largest=norm == "l1", errors=errors)
        own = self.constants[0]
        if norm == "l1":
            sets, solutions = _basic_solutions(self.basis, geometry.detectable)
            count, m, n = solutions.shape
            own["sets"], own["channels"][:count, :m], own["solutions"][:count, :m, :n] = count, sets, solutions
        else:
            set_forms(own, _unexplained(self.basis, geometry.detectable), squares=True)
        own["limit"] = largest_form_threshold(errors, geometry, self.noise, probability)
        self._try_faults()


def parity_basis(axes: Array, construction: str) -> Array:
    """U2 (n, n - 3): orthonormal columns with ``U2' axes = 0``, from the SVD or the QR decomposition of axes (n, 3).

    Raises
    ------
    ConfigError
        If there is no such construction.
    """
    if construction not in CONSTRUCTIONS:
        raise ConfigError(f"construction is {construction!r}, expected one of: {', '.join(CONSTRUCTIONS)}")
    if construction == "svd":
        return np.linalg.svd(axes)[0][:, 3:]
    return np.linalg.qr(axes, mode="complete")[0][:, 3:]


def _single_errors(basis: Array, seen: NDArray[np.bool_]) -> Array:
    """Matrix (n, n) that maps z to kappa_k; zero where no fault is seen."""
    projector = basis @ basis.T
    power = np.where(seen, np.sum(projector**2, axis=0), 1.0)
    return np.where(seen[:, None], projector.T @ projector / power[:, None], 0.0)


def _unexplained(basis: Array, seen: NDArray[np.bool_]) -> Array:
    """Forms (n - 4, n, n) whose squares, summed over the first axis, are J(k); one of zeros for n = 4.

    ``J(k) = y' U2 (I - u u' / u'u) U2' y`` with u row k of U2: the square of what U2' y has across u.
    """
    n, m = basis.shape
    forms = np.zeros((max(m - 1, 1), n, n))
    for k in np.flatnonzero(seen):
        across = np.linalg.svd(basis[k][:, None])[0][:, 1:]
        forms[: m - 1, k] = across.T @ basis.T
    return forms


def _basic_solutions(basis: Array, seen: NDArray[np.bool_]) -> tuple[NDArray[np.intp], Array]:
    """Every set of n - 3 channels (b, n - 3) that spans parity space, and the forms (b, n - 3, n) of their errors.

    Channels whose faults are not seen are in no set.
    """
    n, m = basis.shape
    sets = np.array(list(combinations(np.flatnonzero(seen), m)))
    directions = basis[sets].transpose(0, 2, 1)
    spans = np.abs(np.linalg.det(directions)) > MIN_BASIS_DETERMINANT
    solutions = np.linalg.solve(directions[spans], np.broadcast_to(basis.T, (int(spans.sum()), m, n)))
    return sets[spans], solutions
