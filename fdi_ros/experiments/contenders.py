# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detectors side by side: at one false-alarm rate, on the same samples; and the best that any could do.

The best is Bayes decisions on one sample, and optimal stopping over many.

One sample. Whatever a method does with a sample, without knowledge of the rate it can use the parity vector alone.
With f_0 the density of the parity vector of healthy channels and f_i that with channel i faulty, prior P_i, the
decision that names the right channel most often at a given false-alarm rate names ``argmax P_i f_i`` and declares
it where ``max_i P_i f_i / f_0`` exceeds a level (Neyman and Pearson's lemma, one region per channel). Both
probabilities are integrals over parity space.

Many samples. No method with mean run length G to a false alarm has a worst-case mean delay below that of the CUSUM
tuned to the very change (Lorden 1971, first order; Moustakides 1986, exactly).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors import DETECTORS, create_detector, detector_class
from fdi_ros.detectors.base import Detector, Verdict, accepted_options
from fdi_ros.errors import FdiError, StudyError
from fdi_ros.experiments.study import Counts, Field, Refusals, Schema, TrialProtocol, geometry_of
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.samples import Array, Mask
from fdi_ros.model.thresholds import FalseAlarmRate, chi2_isf, half_sphere, solve_log
from fdi_ros.replay.outcomes import settled


class ChiSquare:
    """Chi-square test of the whole parity vector, constant noise; names the channel of the largest ``|w_i|``.

    Not a detector of the monitor: parameters and verdicts as of one, without a memory.
    """

    name = "chi_square"

    def __init__(self, geometry: Geometry, noise: NoiseModel, *, false_alarm_probability: float | None = None) -> None:
        self.geometry, self.noise = geometry, noise.for_channels(geometry.n)
        self.options: dict[str, Any] = {}
        white = geometry.axes / self.noise.noise_std[:, None]
        basis = np.linalg.qr(white, mode="complete")[0][:, 3:]
        self._parity = (basis / self.noise.noise_std[:, None]).T
        length = np.linalg.norm(basis, axis=1)
        scale = np.where(geometry.detectable, length, np.inf)
        self._normalised = (self._parity.T @ basis.T / scale).T
        self.threshold = chi2_isf(FalseAlarmRate(false_alarm_probability).per_sample(), geometry.n - 3)

    def detect(self, z: Array) -> Verdict:
        """Verdicts on samples z (N, n) rad/s: square of the whitened parity vector against its quantile."""
        square = (_products(z, self._parity) ** 2).cumsum(axis=1)[:, -1]
        scores = np.abs(_products(z, self._normalised))
        alarm = square >= self.threshold
        suspects = alarm[:, None] & (np.arange(z.shape[1]) == scores.argmax(axis=1)[:, None])
        threshold = np.full(len(z), self.threshold)
        return Verdict(square, threshold, alarm, suspects, alarm, np.where(suspects, scores, 0.0), scores)

    def reset(self) -> None:
        """Nothing is remembered."""


def _products(z: Array, forms: Array) -> Array:
    """Value of each form (k, n) for each sample (N, n): (N, k), summed in the order of channels on every machine."""
    return np.asarray((z[:, None, :] * forms).cumsum(axis=2)[:, :, -1])


BOUND = 3.0
"""Guaranteed bound of a channel in a study, in noise_std: what a user who takes 3 sigma for the limit would set."""
LOOSE_BOUNDS = 0.2
"""Loose threshold of `guaranteed`, in bounds, from which its own is found."""
RANKED_BY_SCORE = ("likelihood_ratio", "cusum")
"""Methods that leave several suspects and rank them by their scores; of others the largest normalised error counts."""

NORMALISED_SCORES = ("likelihood_ratio", "chi_square")
"""Methods whose scores are the normalised residuals ``|w_i|``."""

Method = Detector | ChiSquare

METHODS: dict[str, Any] = {**{name: detector_class(name) for name in DETECTORS}, ChiSquare.name: ChiSquare}
"""All that a study can compare."""


class Evaluation(NamedTuple):
    """Verdicts of one method on N samples at its loose threshold."""

    ratio: Array
    """(N,) statistic over threshold; alarm where it reaches the factor found. NaN without an alarm."""
    suspects: Mask
    """(N, n)"""
    isolated: Mask
    """(N,)"""
    named: NDArray[np.intp]
    """(N,) the worst of the suspects; -1 without suspects."""
    best: NDArray[np.intp] | None
    """(N,) the channel of the largest normalised residual, alarm or not; None: the method does not give it."""


class Contender:
    """One method with a loose threshold; that of the common false-alarm rate is a multiple of it."""

    def __init__(self, detector: Method) -> None:
        self.detector = detector
        # A run length instead of a probability per sample: the method is for a stream.
        self.has_memory = "run_length" in accepted_options(METHODS[detector.name])
        self._weight = detector.geometry.sensitivity / detector.noise.noise_std

    def evaluate(self, z: Array) -> Evaluation:
        """Verdicts on samples z (N, n) rad/s."""
        verdict = self.detector.detect(z)
        worst = verdict.scores if self.detector.name in RANKED_BY_SCORE else np.abs(verdict.error) * self._weight
        named = np.where(verdict.alarm, _largest(np.where(verdict.suspects, worst, -1.0)), -1)
        with np.errstate(invalid="ignore"):
            ratio = verdict.statistic / verdict.threshold
        best = _largest(verdict.scores) if self.detector.name in NORMALISED_SCORES else None
        return Evaluation(np.where(verdict.alarm, ratio, np.nan), verdict.suspects, verdict.isolated, named, best)

    def ratios(self, z: Array) -> Array:
        """Statistic over threshold of every sample, (N,), alarm or not; -inf where not judged."""
        verdict = self.detector.detect(z)
        return np.nan_to_num(verdict.statistic / verdict.threshold, nan=-np.inf, posinf=1e300, neginf=-np.inf)


class Contenders(NamedTuple):
    """Methods that run on a geometry, and why the others do not."""

    running: dict[str, Contender]
    refused: dict[str, str]

    def for_single_samples(self) -> Contenders:
        """Return the same without the methods that need a stream."""
        streaming = {name for name, contender in self.running.items() if contender.has_memory}
        return Contenders(
            {name: contender for name, contender in self.running.items() if name not in streaming},
            {**self.refused, **{n: "judges a stream, not one sample" for n in self.running if n in streaming}},
        )


def build_contenders(
    names: Sequence[str],
    geometry: Geometry,
    noise: NoiseModel,
    alarm_probability: float,
    own: Mapping[str, Mapping[str, Any]],
    factors: Mapping[str, float] | None = None,
) -> Contenders:
    """Build methods of `METHODS` for channels, with loose thresholds of a probability of alarm per sample.

    ``own``: options of a method by name; they win. ``factors``: multiple of the loose threshold that each method is to
    have, where its verdict depends on its threshold.
    """
    running, refused = {}, {}
    for name in names:
        options = loose_options(name, geometry.n, alarm_probability) | dict(own.get(name, {}))
        if factors and name in factors and "threshold" in options:
            options["threshold"] *= factors[name]
        try:
            running[name] = Contender(_create(name, geometry, noise, options))
        except FdiError as error:
            refused[name] = str(error)
    return Contenders(running, refused)


def loose_options(name: str, n: int, alarm_probability: float) -> dict[str, Any]:
    """Options of a method with a threshold of a given false-alarm probability per sample, or a loose one."""
    accepted = accepted_options(METHODS[name])
    stated = FalseAlarmRate(alarm_probability).as_options(accepted)
    if stated:
        return dict(stated)
    return {"threshold": LOOSE_BOUNDS, "max_faults": min(2, n - 4)} if "max_faults" in accepted else {}


def _create(name: str, geometry: Geometry, noise: NoiseModel, options: Mapping[str, Any]) -> Method:
    if name == ChiSquare.name:
        return ChiSquare(geometry, noise, **options)
    return create_detector(name, geometry, noise, **options)


def _largest(size: Array) -> NDArray[np.intp]:
    """Column of the largest of each row (N,); parallel channels are equal but for rounding, which must not decide."""
    size = np.nan_to_num(size, nan=-1.0)
    top = size.max(axis=1, keepdims=True)
    return np.round(size / np.where(top > 0, top, 1.0), 9).argmax(axis=1)


def white_noise(noise_std: float) -> NoiseModel:
    """Error model of a study: equal channels, the guaranteed bound at `BOUND` noise_std."""
    return NoiseModel(noise_std, bound=BOUND * noise_std)


# One false-alarm rate for all -----------------------------------------------------------------------------------------


def largest_ratios(running: Mapping[str, Contender], z: Array, false_alarms: Sequence[float]) -> dict[str, list[float]]:
    """Keep by method the ratios of samples z (N, n) that can decide a threshold: twice the share of alarms and more."""
    kept = int(2 * max(false_alarms) * len(z)) + 50
    return {name: np.sort(one.ratios(z))[::-1][:kept].tolist() for name, one in running.items()}


def factors_of(blocks: Sequence[Counts], false_alarms: Sequence[float]) -> dict[str, list[float]]:
    """Multiple of its loose threshold by method for each false-alarm rate, from blocks of healthy channels.

    Each has the number of its ``trials``, and by method its ``largest`` ratios.
    """
    trials = sum(block["trials"] for block in blocks)
    pooled = {name: [ratio for block in blocks for ratio in block["largest"][name]] for name in blocks[0]["largest"]}
    return {name: [threshold_factor(own, alarm, trials) for alarm in false_alarms] for name, own in pooled.items()}


def threshold_factor(largest: Sequence[float], alarm_probability: float, trials: int) -> float:
    """Ratio that the given share of trials reaches, from their largest ratios; at least the loose threshold, 1."""
    rank = round(alarm_probability * trials)
    ordered = np.sort(np.asarray(largest, dtype=np.float64))[::-1]
    if rank < 1 or rank > len(ordered):
        return 1.0 if rank >= 1 else float(ordered[0])
    return max(float(ordered[rank - 1]), 1.0)


class Cell(NamedTuple):
    """Trials on one geometry with faults of one size; 0: none. Or the best possible decision on these."""

    geometry: int
    size: float
    limit: bool = False


class OnGeometries(TrialProtocol[Cell]):
    """A protocol whose cells are each on one of the ``geometries`` of its settings."""

    schema: ClassVar[Schema] = {
        "geometries": Field("geometries", ["two_triad_cone"]),
        "detectors": Field("detectors", "all", choices=tuple(METHODS)),
        "options": Field("mapping", {}),
    }

    @cached_property
    def geometries(self) -> list[Geometry]:
        """As set."""
        return [geometry_of(spec) for spec in self.settings["geometries"]]

    @cached_property
    def contenders(self) -> list[Contenders]:
        """Methods at their loose thresholds for each geometry."""
        return [self.build(g, self.settings["detectors"]) for g in range(len(self.geometries))]

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block: as set; healthy channels need more than faulty ones."""
        if cell.limit:
            return 1, 1
        return self.settings["trials" if cell.size else "sound_trials"], self.settings["block"]

    @abstractmethod
    def build(self, g: int, names: Sequence[str]) -> Contenders:
        """Build methods at their loose thresholds for a geometry, by its number."""

    def refusals(self) -> Refusals:
        """Return the methods that do not judge what the trials are of, or do not run on a geometry."""
        return {str(spec): one.refused for spec, one in zip(self.settings["geometries"], self.contenders, strict=True)}


# The best that any method could do ------------------------------------------------------------------------------------


MAX_DIMENSIONS = 3
"""Dimensions of parity space up to which a limit is worth its time: those of six channels."""
RADII, AROUND = 240, 96
"""Radii, and directions once around, of the grid."""


@dataclass(frozen=True)
class Rule:
    """Points of parity space in standard deviations, and weights: integrals over it become sums."""

    points: Array
    """(Q, m)"""
    log_weight: Array
    """(Q,)"""


@dataclass(frozen=True)
class Limit:
    """Best possible figures over all false-alarm rates."""

    false_alarm: Array
    """(Q,) probability of an alarm on healthy channels, increasing."""
    declared: Array
    """(Q,) probability that a fault is declared, on whatever channel."""
    right: Array
    """(Q,) probability that it is declared and the right channel named."""

    def shares(self, false_alarms: Sequence[float]) -> dict[str, list[float]]:
        """Best possible shares declared, and declared with the right channel named, at some false-alarm rates."""
        declared, right = zip(*map(self.at, false_alarms), strict=True)
        return {"declared": [settled(share) for share in declared], "right": [settled(share) for share in right]}

    def at(self, false_alarm: float) -> tuple[float, float]:
        """Probabilities (declared, right) at a false-alarm rate."""
        x = math.log(false_alarm)
        known = np.log(np.maximum(self.false_alarm, 1e-300))
        return float(np.interp(x, known, self.declared)), float(np.interp(x, known, self.right))


def limit_points(shares: Mapping[str, Sequence[float]], false_alarms: Sequence[float]) -> list[dict[str, float]]:
    """Best possible shares, one by one with their false-alarm rates: as the result of a study has them."""
    each = zip(false_alarms, shares["declared"], shares["right"], strict=True)
    return [{"false_alarm": alarm, "declared": declared, "right": right} for alarm, declared, right in each]


def grid(m: int, reach: float, radii: int = RADII, around: int = AROUND) -> Rule:
    """Rule over half of parity space, out to `reach` standard deviations; everything is even, so half is enough.

    Radius and direction each by themselves, up to three dimensions.
    """
    if not 1 <= m <= MAX_DIMENSIONS:
        raise StudyError(f"quadrature in parity space has 1 to {MAX_DIMENSIONS} dimensions, got {m}")
    nodes, weights = np.polynomial.legendre.leggauss(radii)
    radius, radial = reach * (nodes + 1) / 2, reach * weights / 2 * (reach * (nodes + 1) / 2) ** (m - 1)
    direction, share = half_sphere(m, circle=around, around=around, heights=around // 3)
    solid = share * (1.0, np.pi, 2 * np.pi)[m - 1]
    points = (radius[:, None, None] * direction).reshape(-1, m)
    return Rule(points, np.log(2 * np.outer(radial, solid)).ravel())


def log_normal(points: Array, covariance: Array) -> Array:
    """Logarithm of the density of a normal parity vector, (Q,), covariance (m, m)."""
    factor = np.linalg.cholesky(covariance)
    # One product: solving for a million right-hand sides takes several times as long, and the factor is small.
    white = np.linalg.inv(factor) @ points.T
    return -0.5 * (white**2).sum(axis=0) - float(np.log(np.diag(factor)).sum()) - 0.5 * len(factor) * _LOG_2PI


def log_faulty(points: Array, direction: Array, sizes: Array, covariance: Array) -> Array:
    """Logarithm of the density (Q,) with a fault along one direction, each of its sizes and either sign alike.

    At points (Q, m): direction (m,) is what a unit error adds, sizes (K,) are of the error, covariance (m, m) of all
    other errors.
    """
    precise = np.linalg.inv(covariance)
    along, own = points @ (precise @ direction), float(direction @ precise @ direction)
    shape = np.abs(np.outer(sizes, along)) - 0.5 * own * (sizes**2)[:, None] + math.log(0.5 / len(sizes))
    # ln(e^x + e^-x) = |x| + ln(1 + e^(-2 |x|)): neither overflows.
    terms = shape + np.log1p(np.exp(-2 * np.abs(np.outer(sizes, along))))
    top = terms.max(axis=0)
    return log_normal(points, covariance) + top + np.log(np.exp(terms - top).sum(axis=0))


def best_decisions(rule: Rule, healthy: Array, faulty: Array) -> Limit:
    """Best figures from the log densities of healthy channels (Q,) and of each one faulty, prior included (n, Q)."""
    best = faulty.max(axis=0)
    order = np.argsort(healthy - best, kind="stable")
    weight = rule.log_weight[order]
    return Limit(
        np.cumsum(np.exp(healthy[order] + weight)),
        np.cumsum(np.exp(faulty[:, order] + weight).sum(axis=0)),
        np.cumsum(np.exp(best[order] + weight)),
    )


def fault_of_size(geometry: Geometry, size: float) -> Limit:
    """Limit for unit white noise and one fault of a size, in standard deviations; any channel, either sign alike."""
    directions = geometry.parity.T
    m = directions.shape[1]
    rule = grid(m, size + 7.0)
    each = [log_faulty(rule.points, u, np.array([size]), np.eye(m)) - math.log(geometry.n) for u in directions]
    return best_decisions(rule, log_normal(rule.points, np.eye(m)), np.array(each))


def lorden_delay(shift: float, run_length: float) -> float:
    """First-order bound on the worst-case mean delay, samples: ln(G) over the information ``shift^2 / 2`` of a sample.

    ``shift`` > 0: change of the mean of a standard normal, the fault in standard deviations times sqrt(S_ii). G: mean
    run length, samples to a false alarm.
    """
    return math.log(run_length) / (0.5 * shift**2)


def moustakides_delay(shift: float, run_length: float) -> float:
    """Least possible worst-case mean delay, samples: that of the CUSUM tuned to the change, at its run length.

    Parameters as in `lorden_delay`.
    """
    limit = solve_log(lambda limit: cusum_run_length(limit, shift / 2, 0.0), run_length, math.log(run_length) / shift)
    return cusum_run_length(limit, shift / 2, shift)


def cusum_run_length(limit: float, reference: float, mean: float) -> float:
    """Mean number of samples until a one-sided CUSUM ``s = max(0, s + x - reference)`` of normal x reaches its limit.

    From s = 0; the integral equation of Page (1954) by Gauss-Legendre quadrature; all in standard deviations of x.
    """
    if limit <= 0:
        return 1 / _above(reference - mean)
    # The kernel is one standard deviation wide: a few nodes in each.
    nodes = 60 + math.ceil(2 * limit)
    node, weight = np.polynomial.legendre.leggauss(nodes)
    at, weight = limit * (node + 1) / 2, limit * weight / 2
    start = np.concatenate([[0.0], at])
    step = at - start[:, None] + reference - mean
    matrix = np.zeros((nodes + 1, nodes + 1))
    matrix[:, 1:] = np.exp(-0.5 * step**2) * weight / math.sqrt(2 * math.pi)
    matrix[:, 0] = [1 - _above(reference - mean - s) for s in start]
    return float(np.linalg.solve(np.eye(nodes + 1) - matrix, np.ones(nodes + 1))[0])


def _above(x: float) -> float:
    return 0.5 * math.erfc(x / math.sqrt(2))


_LOG_2PI = math.log(2 * math.pi)
