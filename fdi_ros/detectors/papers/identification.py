# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Identification of faults by a projector on parity space, recursion and determinants.

"Algorithms of identification of faults of navigation measuring elements" (in Russian,
without author line), sections 1-2, 3 and 4.
"""

from __future__ import annotations

import math
from itertools import combinations
from math import comb
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    Flag,
    Whole,
    callback,
    compiled,
    record,
)
from fdi_ros.core.algebra import dot
from fdi_ros.core.records import SampleInput, SampleVerdict
from fdi_ros.detectors.base import NoState
from fdi_ros.detectors.papers.single_fault import (
    SingleFault,
    SingleFaultDetector,
    WithForms,
    chosen,
    conclude,
    conclude_by_error,
    fill_variances,
    judge_sums,
    largest_form_threshold,
    resting_std,
    set_forms,
    std_of,
    worst,
)
from fdi_ros.model.geometry import ROUNDING, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array

# The projector: sections 1 and 2

CONSTRUCTIONS = ("svd", "qr")
NORMS = ("l2", "l1")
MOST_IN_SET = MAX_CHANNELS - 3
MOST_TRIPLES = comb(MAX_CHANNELS, 3)


@record
class OneNorm(SingleFault):
    """Sets of n - 3 channels whose errors alone explain a sample, for the norm `l1`."""

    sets: Whole  # number of sets
    # [b, k]: channel k of set b
    channels: Annotated[NDArray[np.uint8], "u1", (MOST_TRIPLES, MOST_IN_SET)]
    # [b, k]: error of that channel as a linear form of z
    solutions: Annotated[
        NDArray[np.float64], "f8", (MOST_TRIPLES, MOST_IN_SET, MAX_CHANNELS)
    ]


@callback(OneNorm, NoState, SampleInput, SampleVerdict)
def judge_one_norm(
    params: OneNorm, state: NoState, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample by the error of least 1-norm that explains the sample."""
    n = params.sensors.n
    z = sample.z
    best = 0
    least = np.inf
    for b in range(params.sets):
        norm = 0.0
        for k in range(n - 3):
            norm += abs(dot(params.solutions[b, k], z, n))
            if norm >= least:
                break
        if norm < least:
            best = b
            least = norm
    # The scores of all other channels are already zero.
    for k in range(n - 3):
        verdict.scores[params.channels[best, k]] = abs(
            dot(params.solutions[best, k], z, n)
        )
    conclude_by_error(params, sample, verdict)


class Projector(SingleFaultDetector):
    """The channel whose fault leaves the least of the parity vector unexplained.

    U2 (n, n - 3) spans the space in which the body rate cancels, ``U2' H = 0``: the last
    columns of the orthogonal factor of the SVD or the QR decomposition of H. The least error
    that explains the sample is ``e0 = U2 U2' z = G z``, and g_k are the columns of G. For
    each channel (section 2) ``kappa_k = g_k' e0 / |g_k|^2`` is the error of a single fault,
    rad/s, and ``J(k) = |g_k kappa_k - e0|^2`` the remainder, (rad/s)^2. The failed channel
    has the least J(k). With ``norm="l1"`` the failed channel has the largest ``|e_k|`` of
    the error e of least 1-norm with ``U2' e = U2' z``, found among all sets of n - 3
    channels.

    ``scores`` are J(k) or ``|e_k|``. The statistic is ``|kappa_k|`` of the named channel
    over its standard deviation. The largest one over all channels exceeds the threshold
    with the required false-alarm probability. For `l1` or unequal noise the threshold is an
    upper bound. docs/methods.md states when to use this method.

    Parameters
    ----------
    geometry, noise
        As of every `Detector`.
    construction
        ``svd`` or ``qr``: equal except for rounding. QR is cheaper to build.
    norm
        ``l2`` or ``l1``.
    rate
        `false_alarm_probability` per sample, by default 1e-6, or `false_alarms_per_hour`
        with `sample_rate`, Hz.
    """

    name = "projector"
    Constants = WithForms
    judge = judge_sums

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        construction: str = "svd",
        norm: str = "l2",
        **rate: Any,
    ) -> None:
        options = {"construction": construction, "norm": norm}
        one = chosen("norm", norm, NORMS) == "l1"
        if one:
            self.Constants = OneNorm  # type: ignore[assignment]
            self.judge = judge_one_norm
        self.basis = parity_basis(geometry.axes, construction)  # u2, (n, n - 3)
        errors = _single_errors(self.basis, geometry.detectable)
        super().__init__(geometry, noise, options, largest=one, errors=errors, **rate)
        params = self.constants[0]
        if one:
            sets, solutions = _basic_solutions(self.basis, geometry.detectable)
            count, m, n = solutions.shape
            params["sets"] = count
            params["channels"][:count, :m] = sets
            params["solutions"][:count, :m, :n] = solutions
        else:
            set_forms(
                params, _unexplained(self.basis, geometry.detectable), squares=True
            )
        params["limit"] = largest_form_threshold(
            errors, geometry, self.noise, self.probability
        )
        self._try_faults()


def parity_basis(axes: Array, construction: str) -> Array:
    """Return U2 (n, n - 3): orthonormal columns with ``U2' axes = 0``, for axes (n, 3).

    Raise `ConfigError` for an unknown construction.
    """
    if chosen("construction", construction, CONSTRUCTIONS) == "svd":
        return np.linalg.svd(axes)[0][:, 3:]
    return np.linalg.qr(axes, mode="complete")[0][:, 3:]


def _single_errors(basis: Array, seen: NDArray[np.bool_]) -> Array:
    """Return the matrix (n, n) that maps z to kappa_k, zero for undetectable channels."""
    projector = basis @ basis.T
    power = np.where(seen, np.sum(projector**2, axis=0), 1.0)
    return np.where(seen[:, None], projector.T @ projector / power[:, None], 0.0)


def _unexplained(basis: Array, seen: NDArray[np.bool_]) -> Array:
    """Return forms (n - 4, n, n) whose squares, summed over the first axis, are J(k).

    ``J(k) = y' U2 (I - u u' / u'u) U2' y`` with u row k of U2: the square of the part of
    U2' y normal to u. For n = 4 a single form is zero.
    """
    n, m = basis.shape
    forms = np.zeros((max(m - 1, 1), n, n))
    for k in np.flatnonzero(seen):
        across = np.linalg.svd(basis[k][:, None])[0][:, 1:]
        forms[: m - 1, k] = across.T @ basis.T
    return forms


def _basic_solutions(
    basis: Array, seen: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], Array]:
    """Return all sets of n - 3 channels that span parity space, and forms of their errors.

    The shapes are (b, n - 3) and (b, n - 3, n). Undetectable channels are in no set.
    """
    n, m = basis.shape
    sets = np.array(list(combinations(np.flatnonzero(seen), m)))
    directions = basis[sets].transpose(0, 2, 1)
    spans = np.abs(np.linalg.det(directions)) > ROUNDING
    shape = (int(spans.sum()), m, n)
    solutions = np.linalg.solve(directions[spans], np.broadcast_to(basis.T, shape))
    return sets[spans], solutions


# Recursion over cyclic permutations: section 3

Index = NDArray[np.intp]

#: k_s of an innovation of 1e-10 standard deviations, which is rounding. Added to divisors,
#: so that 0 / 0 is zero.
NOTHING = 1e-20


@callback(WithForms, NoState, SampleInput, SampleVerdict)
def judge_innovations(
    params: WithForms, state: NoState, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample by the largest k_s of all equations and permutations.

    Forms [k, i] are those of `innovations`.
    """
    n = params.sensors.n
    largest = 0.0
    fill_variances(params, sample, verdict)
    for i in range(n):
        before = 0.0
        last = 0.0
        for k in range(n - 3):
            form = params.forms[k, i]
            innovation = dot(form, sample.z, n) / std_of(params, form, 1.0, verdict)
            before = last
            last = innovation * innovation
            largest = max(largest, last)
        verdict.scores[i] = last / (before + NOTHING) if n > 4 else last
    conclude(params, worst(params, verdict), largest, params.limit, sample, verdict)


class Recursive(SingleFaultDetector):
    """The channel whose equation, taken last, contradicts the recursion before.

    The equations ``z_i = a_i x`` are solved one by one (section 3): ``x+ = x + P a' Y (z - a
    x)``, ``Y = (sigma^2 + a P a')^-1``, ``P+ = P - P a' Y a P``, for all n cyclic
    permutations. The equations that determine the rate have no innovation. Each other one
    gives ``k_s = nu^2 Y``, chi-square with one degree of freedom for healthy channels. The
    ratio of the last two k_s of a permutation is largest when the failed channel comes last.
    Innovations are fixed linear forms of z, calculated with the resting noise.

    ``scores`` are the last ratios ``k_s,n / k_s,n-1`` of the permutation that ends with the
    channel, or NaN with 4 channels. The statistic is the largest k_s of all equations and
    permutations. It exceeds the threshold k_s,max with the required false-alarm probability,
    which is exact for constant noise. If the noise depends on rate or acceleration, nu^2 is
    divided by its variance in that sample. docs/methods.md states when to use this method.

    Parameters
    ----------
    geometry, noise, rate
        As of `Projector`.
    """

    name = "recursive"
    Constants = WithForms
    judge = judge_innovations

    def __init__(self, geometry: Geometry, noise: NoiseModel, **rate: Any) -> None:
        n = geometry.n
        super().__init__(geometry, noise, {}, largest=True, scored=n > 4, **rate)
        params = self.constants[0]
        forms = innovations(geometry.axes, self.noise.noise_std)
        set_forms(params, forms)
        params["limit"] = (
            largest_form_threshold(
                forms.reshape(-1, n), geometry, self.noise, self.probability
            )
            ** 2
        )


def innovations(axes: Array, noise_std: Array) -> Array:
    """Return innovations over their standard deviation as linear forms of z, (n - 3, n, n).

    ``[k, i]`` is the k-th innovation of the permutation that ends with channel i.
    """
    n = len(axes)
    forms = np.zeros((n - 3, n, n))
    for last in range(n):
        order = (np.arange(n) + last + 1) % n
        found = (
            _innovation(axes, noise_std, order[:k], int(order[k])) for k in range(1, n)
        )
        forms[:, last] = [form for form in found if form is not None]
    return forms


def _innovation(axes: Array, noise_std: Array, before: Index, new: int) -> Array | None:
    """Return the innovation form (n,) of an equation, or None if it is not predicted."""
    weighted = axes[before] / noise_std[before][:, None]
    axis = axes[new] / noise_std[new]
    gain = axis @ np.linalg.pinv(weighted, rcond=ROUNDING)
    if np.linalg.norm(axis - gain @ weighted) > ROUNDING * np.linalg.norm(axis):
        return None
    form = np.zeros(len(axes))
    form[before] = -gain / noise_std[before]
    form[new] = 1 / noise_std[new]
    return form / np.sqrt(1 + gain @ gain)


# Determinants of five channels: section 4

Four = tuple[float, float, float, float]

#: The paper identifies among five sensors.
PAPER_CHANNELS = 5
CRITERIA = ("determinant", "condition_number")
NO_POWER = 1e-200
"""Added to every term, so that a sample of zeros causes no division by zero. A condition
number above its inverse is infinite."""


@record
class Struck(WithForms):
    """Constants for [H z] without row j. Its determinant is the single form of score j."""

    # standard deviations of the determinants at rest, rad/s
    determinants_resting: Annotated[NDArray[np.float64], "f8", (PAPER_CHANNELS,)]
    by_condition: Flag  # the criterion is the condition number
    # U' of H without row j, as forms of z
    complement: Annotated[
        NDArray[np.float64], "f8", (PAPER_CHANNELS, 4, PAPER_CHANNELS)
    ]
    # singular values of H without row j
    singular: Annotated[NDArray[np.float64], "f8", (PAPER_CHANNELS, 3)]


@callback(Struck, NoState, SampleInput, SampleVerdict)
def judge_determinants(
    params: Struck, state: NoState, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample by the largest determinant over its standard deviation."""
    statistic = 0.0
    fill_variances(params, sample, verdict)
    for j in range(PAPER_CHANNELS):
        size = abs(dot(params.forms[0, j], sample.z, PAPER_CHANNELS))
        # A determinant that is always zero has no standard deviation.
        if size > 0:
            std = std_of(
                params, params.forms[0, j], params.determinants_resting[j], verdict
            )
            statistic = max(statistic, size / std)
        verdict.scores[j] = (
            condition_without(params, j, sample) if params.by_condition else size
        )
    conclude(params, worst(params, verdict), statistic, params.limit, sample, verdict)


@compiled
def condition_without(params: Struck, j: int, sample: SampleInput) -> float:
    """Return the 2-norm condition number of [H z] without row j, or infinity.

    The axes without row j have the singular value decomposition ``U diag(s) Q'``. ``u = U'
    z``, and delta is the last of its four entries, since the last column of U is normal to
    the axes. The square of the largest singular value is the largest root of ``sum_k u_k^2 /
    (x - s_k^2) = 1``, s_4 = 0. The inverse square of the smallest one, times delta^2, is the
    largest root of ``sum_k (u_k / s_k)^2 / (x - delta^2 / s_k^2) + 1 / x = 1``. Neither
    equation divides by delta, which is zero for a failed row without noise.
    """
    u = params.complement[j]
    z = sample.z
    s = params.singular[j, 0]
    t = params.singular[j, 1]
    v = params.singular[j, 2]
    a = dot(u[0], z, PAPER_CHANNELS)
    b = dot(u[1], z, PAPER_CHANNELS)
    c = dot(u[2], z, PAPER_CHANNELS)
    delta = abs(dot(u[3], z, PAPER_CHANNELS))
    largest = largest_root(
        (a * a, b * b, c * c, delta * delta), (s * s, t * t, v * v, 0.0)
    )
    a = a / s
    b = b / t
    c = c / v
    s = delta / s
    t = delta / t
    v = delta / v
    inverse = largest_root((a * a, b * b, c * c, 1.0), (s * s, t * t, v * v, 0.0))
    product = math.sqrt(largest) * math.sqrt(inverse)
    return product / delta if delta > NO_POWER * product else math.inf


@compiled
def largest_root(powers: Four, poles: Four) -> float:
    """Return the largest root x of ``sum_k powers_k / (x - poles_k) = 1``, or the largest pole.

    Newton's method is applied to the inverse of the sum. This is concave in x, so the
    iteration increases from the left and never exceeds the root.
    """
    x = 0.0
    for k in range(4):
        x = max(x, poles[k] + (powers[k] + NO_POWER))
    # Just beyond the pole. Then about five steps suffice.
    x *= 1 + 1e-15
    for _ in range(40):
        value = 0.0
        slope = 0.0
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
    """The one of five channels without which axes and sample are consistent.

    ``d_j`` is the absolute determinant of ``[H z]`` (5, 4) without row j (section 4), linear
    in z with the cofactors of H. Without noise only the failed channel has d_j = 0. With
    noise the failed channel has the least d_j. With ``criterion="condition_number"`` it has
    the largest 2-norm condition number of the four by four matrix. Only the last column of
    this matrix changes, so the extreme singular values are roots of a secular equation of
    rank one, found by Newton's method. docs/methods.md states when to use this method.

    ``scores`` are d_j, rad/s, or the condition numbers. The statistic of both criteria is the
    largest d_j over its standard deviation. It exceeds the threshold with the required
    false-alarm probability, which is exact for constant noise.

    Parameters
    ----------
    geometry
        Sensitivity axes, five (else `DetectorError`).
    criterion
        ``determinant`` or ``condition_number``.
    noise, rate
        As of `Projector`.
    """

    name = "determinant"
    Constants = Struck
    judge = judge_determinants

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        criterion: str = "determinant",
        **rate: Any,
    ) -> None:
        by_condition = chosen("criterion", criterion, CRITERIA) == "condition_number"
        super().__init__(
            geometry, noise, {"criterion": criterion}, largest=by_condition, **rate
        )
        forms = determinant_forms(geometry.axes)
        params = self.constants[0]
        set_forms(params, forms[None])
        params["determinants_resting"] = resting_std(forms, self.noise)
        params["by_condition"] = by_condition
        params["limit"] = largest_form_threshold(
            forms, geometry, self.noise, self.probability
        )
        for j in range(PAPER_CHANNELS):
            others = np.delete(np.arange(PAPER_CHANNELS), j)
            complement, params["singular"][j], _ = np.linalg.svd(geometry.axes[others])
            params["complement"][j][:, others] = complement.T

    @classmethod
    def refuses(cls, n: int) -> str:
        """Return why the method cannot run on n channels, or ""."""
        words = f"determinant has {n} channels, expected {PAPER_CHANNELS}:"
        words += " struck of one row, only [H z] of five is square"
        return "" if n == PAPER_CHANNELS else words


def determinant_forms(axes: Array) -> Array:
    """Return forms (5, 5) of z. Row j gives the determinant of [axes z] without row j."""
    forms = np.zeros((PAPER_CHANNELS, PAPER_CHANNELS))
    for j in range(PAPER_CHANNELS):
        others = np.delete(np.arange(PAPER_CHANNELS), j)
        for place, k in enumerate(others):
            forms[j, k] = (-1.0) ** (place + 1) * np.linalg.det(
                axes[np.delete(others, place)]
            )
    return forms
