# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Guaranteeing (set-membership) detection: bounded errors and up to two arbitrary channels.

The method uses the circuits of the sensitivity axes: the smallest sets of channels with
dependent axes (two parallel, three in a plane, four in space). Each circuit has exactly
one check ``nu . z`` that does not depend on the body rate. All statements on bounded errors
follow from these checks (docs/methods.md#guaranteed).
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    Channels,
    Real,
    Whole,
    allocate,
    callback,
    compiled,
    record,
)
from fdi_ros.core.records import SampleInput, SampleVerdict, Sensors
from fdi_ros.detectors.base import Detector
from fdi_ros.errors import ConfigError, DetectorError
from fdi_ros.model.geometry import ROUNDING, Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Mask


def circuits(axes: Array) -> Array:
    """Return the checks of all circuits of axes (n, 3), (C, n).

    At most four entries of a row are not zero, and a row times the axes is zero.
    """
    norm = np.linalg.norm(axes, axis=1)
    unit = axes / norm[:, None]
    lines = _pairs(unit)
    planes = _triples(unit)
    spaces = _quadruples(unit)
    planes = planes[~_contains(planes, lines)]
    spaces = spaces[~_contains(spaces, np.vstack([lines, planes]))]
    return np.vstack([lines, planes, spaces]) / norm


def _pairs(unit: Array) -> Array:
    index = np.array(list(combinations(range(len(unit)), 2)))
    a, b = unit[index.T]
    dependent = np.linalg.norm(np.cross(a, b), axis=1) < ROUNDING
    sign = np.sign((a * b).sum(axis=1))
    values = np.column_stack([np.ones(len(index)), -sign])
    return _scatter(index[dependent], values[dependent], len(unit))


def _triples(unit: Array) -> Array:
    index = np.array(list(combinations(range(len(unit)), 3)))
    a, b, c = unit[index.T]
    volume = (a * np.cross(b, c)).sum(axis=1)
    dependent = np.abs(volume) < ROUNDING
    # In a plane with unit normal N: (b x c . N) a + (c x a . N) b + (a x b . N) c = 0.
    products = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    products = products[dependent]
    longest = np.linalg.norm(products, axis=2).argmax(axis=1)
    normal = products[np.arange(len(products)), longest]
    values = (products * normal[:, None, :]).sum(axis=2)
    length = np.linalg.norm(values, axis=1)
    # Otherwise all three are parallel, and every pair is already a circuit.
    spans = length > ROUNDING
    return _scatter(
        index[dependent][spans], values[spans] / length[spans, None], len(unit)
    )


def _quadruples(unit: Array) -> Array:
    index = np.array(list(combinations(range(len(unit)), 4)))
    values = np.stack(
        [
            (-1) ** k * np.linalg.det(unit[np.delete(index, k, axis=1)])
            for k in range(4)
        ],
        axis=1,
    )
    whole = (np.abs(values) >= ROUNDING).all(axis=1)
    return _scatter(index[whole], values[whole], len(unit))


def _scatter(index: NDArray[np.intp], values: Array, n: int) -> Array:
    rows = np.zeros((len(index), n))
    np.put_along_axis(rows, index, values, axis=1)
    return rows


def _contains(rows: Array, smaller: Array) -> NDArray[np.bool_]:
    """Return for each row whether its support contains a smaller circuit's."""
    support = (rows != 0).astype(np.int64)
    small = (smaller != 0).astype(np.int64)
    inside = support @ small.T == small.sum(axis=1)
    contains: NDArray[np.bool_] = inside.any(axis=1)
    return contains


#: The sets of tables grow with the fourth power of the number of channels.
MOST_CHANNELS = 9
MOST_FAULTS = 2
MOST_SETS = math.comb(MOST_CHANNELS, MOST_FAULTS)
MOST_CIRCUITS = math.comb(MOST_CHANNELS, 4)
"""No circuit contains another. No larger family of sets of four channels exists (Sperner)."""
#: Largest number of circuits through one channel, by the same theorem.
MOST_LIMITS = math.comb(MOST_CHANNELS - 1, 3)
NO_CHANNEL = MOST_CHANNELS  #: In place of a channel, with weight zero.
#: A check up to this multiple of its bound is not violated: rounding is no fault.
UP_TO_ROUNDING = 1 + ROUNDING


# The method


@record
class Circuits:
    """Checks, scaled by the bounds of their members, and sets of possibly faulty channels."""

    sensors: Sensors
    bound: Channels  # limit of a healthy channel's error, rad/s
    threshold: Real  # size of error that counts as a failure, in bounds
    limit: Real  # of the statistic
    faults: Whole  # largest number of faulty channels
    circuits: Whole  # number of checks
    # one check per column, s/rad
    checks: Annotated[NDArray[np.float64], "f8", (MOST_CHANNELS, MOST_CIRCUITS)]
    # bound times |check|, rows add to 1
    weight: Annotated[NDArray[np.float64], "f8", (MOST_CIRCUITS, MOST_CHANNELS + 1)]
    # mask of the sets that a violation of each check rules out
    rules_out: Annotated[NDArray[np.int64], "i8", (MOST_CIRCUITS,)]
    sets: Whole  # number of the largest sets, which explain all that their subsets do
    first: Whole  # bit of the first largest set
    # channels of the largest sets, or ABSENT
    members: Annotated[NDArray[np.int64], "i8", (MOST_SETS, MOST_FAULTS)]
    # [i]: circuits through channel i
    circuit: Annotated[NDArray[np.int16], "i2", (MOST_CHANNELS, MOST_LIMITS)]
    # error of channel i per check, rad/s
    slope: Annotated[NDArray[np.float64], "f8", (MOST_CHANNELS, MOST_LIMITS)]
    # half-width of the interval of channel i by each circuit, rad/s
    half: Annotated[NDArray[np.float64], "f8", (MOST_CHANNELS, MOST_LIMITS)]
    # [i, f]: number of circuits through channel i without other members in set f: only
    # healthy members limit the error of channel i
    usable: Annotated[NDArray[np.uint8], "u1", (MOST_CHANNELS, MOST_SETS)]
    # [i, f]: indices into circuit[i]
    which: Annotated[NDArray[np.uint8], "u1", (MOST_CHANNELS, MOST_SETS, MOST_LIMITS)]


@record
class Findings:
    """Intermediate results of one sample, without memory between samples."""

    # of each check, at most 1 within the bounds
    value: Annotated[NDArray[np.float64], "f8", (MOST_CIRCUITS,)]
    violations: Whole  # number of violated checks
    # violated checks, the worst first
    violated: Annotated[NDArray[np.int64], "i8", (MOST_CIRCUITS,)]
    explanations: Whole  # number of the largest sets that explain the sample
    explains: Annotated[NDArray[np.int64], "i8", (MOST_SETS,)]  # these sets
    lower: Channels  # lower end of the interval of each channel's error, rad/s
    upper: Channels  # upper end, rad/s


@compiled
def check(params: Circuits, z: Array, found: Findings) -> float:
    """Evaluate the checks of a sample z (n,), and return the size of the largest."""
    for k in range(params.circuits):
        found.value[k] = 0.0
    for i in range(params.sensors.n):
        for k in range(params.circuits):
            found.value[k] += params.checks[i, k] * z[i]
    largest = 0.0
    for k in range(params.circuits):
        largest = max(largest, abs(found.value[k]))
    return largest


@compiled
def explain(params: Circuits, found: Findings) -> int:
    """List the violated checks and the largest sets that explain them.

    Return the mask of all sets ruled out.
    """
    found.violations = found.explanations = 0
    ruled_out = 0
    for k in range(params.circuits):
        if abs(found.value[k]) > UP_TO_ROUNDING:
            ruled_out |= params.rules_out[k]
            # The worst in front rejects most explanations at once.
            worst = found.violated[0]
            if found.violations and abs(found.value[k]) > abs(found.value[worst]):
                found.violated[0] = k
                found.violated[found.violations] = worst
            else:
                found.violated[found.violations] = k
            found.violations += 1
    for f in range(params.sets):
        if not ruled_out >> (params.first + f) & 1:
            found.explains[found.explanations] = f
            found.explanations += 1
    return ruled_out


@compiled
def mildest(params: Circuits, found: Findings) -> float:
    """Return the largest error, in bounds, of the mildest explanation of the sample."""
    least = math.inf
    for m in range(found.explanations):
        members = params.members[found.explains[m]]
        largest = 0.0
        for v in range(found.violations):
            k = found.violated[v]
            # Errors of t bounds in the faulty members allow a check of 1 + (t - 1) weight.
            weight = params.weight[k, members[0]] + params.weight[k, members[1]]
            largest = max(largest, (abs(found.value[k]) - 1) / weight)
            if largest >= least:
                break
        least = min(least, largest)
    return 1 + least


@compiled
def intervals(params: Circuits, found: Findings) -> None:
    """Write the interval of each channel's error over all explanations, or NaN."""
    for i in range(params.sensors.n):
        lower = math.inf
        upper = -math.inf
        # Intervals are widest for sets that contain the channel. Evaluated first, they
        # make most other sets unnecessary.
        for faulty in (True, False):
            for m in range(found.explanations):
                f = found.explains[m]
                holds = params.members[f, 0] == i or params.members[f, 1] == i
                if holds != faulty:
                    continue
                high = math.inf if faulty else params.bound[i]
                low = -high
                for u in range(params.usable[i, f]):
                    if low >= lower and high <= upper:
                        break
                    c = params.which[i, f, u]
                    centre = found.value[params.circuit[i, c]] * params.slope[i, c]
                    half = params.half[i, c]
                    low = max(low, centre - half)
                    high = min(high, centre + half)
                lower = min(lower, low)
                upper = max(upper, high)
        found.lower[i] = lower if found.explanations else math.nan
        found.upper[i] = upper if found.explanations else math.nan


@compiled
def name_suspects(params: Circuits, found: Findings, verdict: SampleVerdict) -> None:
    """Write the channels that failed in some explanation, and their errors.

    The verdict isolates if all failed in each explanation.
    """
    n = params.sensors.n
    any_found = False
    for i in range(n):
        beyond = params.threshold * params.bound[i]
        if params.sensors.detectable[i] and (
            found.upper[i] >= beyond or found.lower[i] <= -beyond
        ):
            any_found = True
            for j in range(n):
                if params.sensors.alike[i, j]:
                    verdict.suspects[j] = params.sensors.detectable[j]
    verdict.isolated = True
    for i in range(n):
        lower = found.lower[i]
        upper = found.upper[i]
        beyond = params.threshold * params.bound[i]
        # No explanation, or only undetectable channels could have failed.
        if not any_found:
            verdict.suspects[i] = params.sensors.detectable[i]
        if verdict.suspects[i]:
            if not (lower >= beyond or upper <= -beyond):
                verdict.isolated = False
            if math.isfinite(lower) and math.isfinite(upper):
                verdict.error[i] = 0.5 * (lower + upper)


@callback(Circuits, Findings, SampleInput, SampleVerdict)
def judge(
    params: Circuits, found: Findings, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample by its checks, and if these imply a fault, by all explanations."""
    verdict.statistic = check(params, sample.z, found)
    verdict.threshold = params.limit
    if verdict.statistic < min(UP_TO_ROUNDING, params.limit):
        return
    explain(params, found)
    if found.violations and params.faults:
        verdict.statistic = mildest(params, found)
    verdict.alarm = verdict.statistic >= params.limit
    intervals(params, found)
    # Comparisons with NaN are false: without an explanation a channel is unknown.
    for i in range(params.sensors.n):
        if found.lower[i] > 0 or found.upper[i] < 0:
            verdict.scores[i] = max(found.lower[i], -found.upper[i]) / params.bound[i]
    if verdict.alarm:
        name_suspects(params, found, verdict)


@compiled
def explain_rows(
    params: NDArray[Any],
    found: NDArray[Any],
    z: Array,
    ruled_out: NDArray[np.int64],
    lower: Array,
    upper: Array,
) -> None:
    """Write the masks of ruled-out sets (N,) and the intervals (N, n) of samples z (N, n)."""
    for k in range(len(z)):
        check(params[0], z[k], found[0])
        ruled_out[k] = explain(params[0], found[0])
        intervals(params[0], found[0])
        for i in range(params[0].sensors.n):
            lower[k, i] = found[0].lower[i]
            upper[k, i] = found[0].upper[i]


class Guaranteed(Detector):
    r"""Intervals that certainly contain each channel's error, and certainly failed channels.

    The error of a healthy channel is at most its bound b_i. At most `max_faults` channels
    have arbitrary errors. For a set F of channels left out, the admissible rates are ``Q_F
    = {q : |z_i - h_i q| <= b_i, i not in F}``. The error of channel i is ``z_i - h_i q``
    over the union of all Q_F (*Determining failures of a redundant inertial sensor unit by
    the guaranteeing estimation method*: its linear programmes and test (10), with the sign
    lost in print). A channel has certainly failed if its whole interval is beyond
    ``threshold * b_i``. No linear programme is solved: the optimum is at a vertex of the
    dual, and the vertices are the circuits of the axes (see `circuits`). docs/methods.md
    states when to use this method.

    - `statistic`: largest error, in bounds, of the mildest explanation of the sample with
      at most `max_faults` faults. Infinite without an explanation: the sample contradicts
      `max_faults` or the bounds. With max_faults = 0, the factor by which all bounds would
      have to grow, with threshold 1.
    - `suspects`: channels that failed in some explanation, or all without an explanation.
      `isolated`: each suspect failed in all explanations.
    - `scores`: least size of each channel's error, in bounds, 0 if no fault is necessary.
    - `error`: midpoint of the interval, 0 if unbounded or empty.

    Parameters
    ----------
    geometry
        Sensitivity axes, 4 to 9 channels.
    noise
        Error model with a `bound`, one for all or one per channel.
    max_faults
        0, 1 or 2, at most n - 4, because fewer than four channels cannot be checked.
        Default: the largest number for n.
    threshold
        Size of error that counts as a failure, in bounds, > 0.
    reduce_max_faults
        Lower max_faults to n - 4 instead of raising an error, as for absent channels. The
        verdict then holds for that many faults.
    """

    name = "guaranteed"
    Constants = Circuits
    State = Findings
    judge = judge

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        max_faults: int | None = None,
        threshold: float = 10.0,
        reduce_max_faults: bool = False,
    ) -> None:
        if not 0 < threshold < np.inf:
            raise ConfigError(
                f"threshold is {threshold:g} bounds, expected finite and > 0"
            )
        self.max_faults = _allowed_faults(geometry.n, max_faults, reduce_max_faults)
        options = {
            "max_faults": self.max_faults,
            "threshold": threshold,
            "reduce_max_faults": True,
        }
        super().__init__(geometry, noise, options)
        if self.noise.bound is None:
            raise DetectorError(
                "guaranteed needs noise.bound (rad/s, > 0): the limit of a healthy channel's error"
            )
        self.bound: Array = self.noise.bound
        self.threshold = threshold
        self.sets = tuple(
            f
            for size in range(self.max_faults + 1)
            for f in combinations(range(geometry.n), size)
        )
        """Sets of possibly faulty channels, smallest first: columns of `culprits`."""
        params = self.constants[0]
        params["bound"][: geometry.n] = self.bound
        params["threshold"] = threshold
        params["limit"] = threshold if self.max_faults else UP_TO_ROUNDING
        checks = circuits(geometry.axes)
        checks /= (np.abs(checks) * self.bound).sum(axis=1)[:, None]
        self._prepare_checks(checks)
        self._prepare_intervals(checks)

    @classmethod
    def refuses(cls, n: int) -> str:
        """Return why the method cannot run on n channels that span space, or ""."""
        return (
            ""
            if n <= MOST_CHANNELS
            else f"guaranteed runs on 4 to {MOST_CHANNELS} channels, got {n}"
        )

    def _prepare_checks(self, checks: Array) -> None:
        """Write checks (C, n), and for each the sets that leave all its members healthy."""
        params, (count, n) = self.constants[0], checks.shape
        params["circuits"] = count
        params["checks"][:n, :count] = checks.T
        params["weight"][:count, :n] = np.abs(checks) * self.bound
        members = [[i in channels for i in range(n)] for channels in self.sets]
        struck = np.array(members)
        untouched = (struck @ (checks != 0).T) == 0
        params["rules_out"][:count] = (1 << np.arange(len(self.sets))) @ untouched
        largest = [
            channels for channels in self.sets if len(channels) == self.max_faults
        ]
        params["faults"] = self.max_faults
        params["sets"] = len(largest)
        params["first"] = len(self.sets) - len(largest)
        params["members"] = NO_CHANNEL
        params["members"][: len(largest), : self.max_faults] = largest

    def _prepare_intervals(self, checks: Array) -> None:
        """Write how circuits limit each channel's error, and which circuits do for each set."""
        params = self.constants[0]
        for i, bound in enumerate(self.bound):
            through = np.flatnonzero(checks[:, i])
            half = 1 / np.abs(checks[through, i]) - bound
            # The narrowest intervals first: then later ones seldom change the result.
            order = np.argsort(half, kind="stable")
            through, count = through[order], len(through)
            params["circuit"][i, :count] = through
            params["half"][i, :count] = half[order]
            params["slope"][i, :count] = 1 / checks[through, i]
            others = np.delete(checks[through] != 0, i, axis=1)
            for f, channels in enumerate(self.sets[params["first"] :]):
                struck = [j in channels for j in range(self.geometry.n) if j != i]
                usable = np.flatnonzero(~others[:, struck].any(axis=1))
                params["usable"][i, f] = len(usable)
                params["which"][i, f, : len(usable)] = usable

    @property
    def isolable(self) -> Mask:
        """Channels whose fault can be isolated, (n,). None with max_faults = 0."""
        return self.geometry.isolable & (self.max_faults > 0)

    def culprits(self, z: Array) -> Mask:
        """Return for each finite sample z (N, n) which of `sets` explain it, (N, sets)."""
        ruled_out, _, _ = self._explain(self._checked(z))
        bits = ruled_out[:, None] >> np.arange(len(self.sets))
        return np.asarray(bits & 1 == 0)

    def error_bounds(self, z: Array) -> tuple[Array, Array]:
        """Return the guaranteed interval of every channel's error.

        Parameters
        ----------
        z
            Measured channels, (N, n), rad/s. NaN or infinite: absent from that sample.

        Returns
        -------
        lower, upper
            Ends of the intervals, (N, n), rad/s. Infinite: not limited by the other
            channels. NaN: the sample contradicts `max_faults`, or the channel is absent or
            cannot be judged.

        Raises
        ------
        DetectorError
            If z does not have n columns.
        """
        z = self._checked(z)
        lower = np.full(z.shape, np.nan)
        upper = np.full(z.shape, np.nan)
        present = np.isfinite(z)
        masks = present @ (1 << np.arange(self.geometry.n))
        for mask in np.unique(masks).tolist():
            detector = self.fewer(mask)
            if isinstance(detector, Guaranteed):
                rows = np.flatnonzero(masks == mask)
                at = np.ix_(rows, np.flatnonzero(present[rows[0]]))
                _, lower[at], upper[at] = detector._explain(z[at])
        return lower, upper

    def _explain(self, z: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Return the masks of ruled-out sets and the intervals of finite samples z (N, n)."""
        ruled_out = np.empty(len(z), dtype=np.int64)
        lower = np.empty(z.shape)
        upper = np.empty(z.shape)
        explain_rows(self.constants, allocate(Findings), z, ruled_out, lower, upper)
        return ruled_out, lower, upper


def _allowed_faults(n: int, asked: int | None, reduce: bool) -> int:
    allowed = min(MOST_FAULTS, n - 4)
    if asked is None:
        return allowed
    if (
        not isinstance(asked, int)
        or isinstance(asked, bool)
        or not 0 <= asked <= MOST_FAULTS
    ):
        raise ConfigError(f"max_faults is {asked}, expected 0, 1 or 2")
    if asked > allowed and not reduce:
        raise DetectorError(
            f"max_faults is {asked} with {n} channels, expected at most {allowed} (n - 4)"
        )
    return min(asked, allowed)
