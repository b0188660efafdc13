# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detectors compared on the same samples at one false-alarm rate, and the least delay possible."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.detectors.base import Detector, Verdict, accepted_options, built
from fdi_ros.errors import FdiError
from fdi_ros.experiments.montecarlo import (
    Counts,
    Field,
    Preparation,
    Refusals,
    Schema,
    TrialProtocol,
    geometry_of,
)
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import FalseAlarmRate, NoiseModel, chi2_isf, solve_log
from fdi_ros.model.samples import Array, Mask


class ChiSquare:
    """Chi-square test of the parity vector that names the channel of the largest ``|w_i|``.

    Not a detector of the monitor: parameters and verdicts as of one, without a memory.
    """

    name = "chi_square"

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        false_alarm_probability: float | None = None,
    ) -> None:
        self.geometry, self.noise = geometry, noise.for_channels(geometry.n)
        self.options: dict[str, Any] = {}
        white = geometry.axes / self.noise.noise_std[:, None]
        basis = np.linalg.qr(white, mode="complete")[0][:, 3:]
        self._parity = (basis / self.noise.noise_std[:, None]).T
        length = np.linalg.norm(basis, axis=1)
        scale = np.where(geometry.detectable, length, np.inf)
        self._normalised = (self._parity.T @ basis.T / scale).T
        self.threshold = chi2_isf(
            FalseAlarmRate(
                false_alarm_probability=false_alarm_probability
            ).per_sample(),
            geometry.n - 3,
        )

    def detect(self, z: Array) -> Verdict:
        """Judge samples z (N, n), rad/s, by the square of the whitened parity vector."""
        square = (_products(z, self._parity) ** 2).cumsum(axis=1)[:, -1]
        scores = np.abs(_products(z, self._normalised))
        alarm = square >= self.threshold
        suspects = alarm[:, None] & (
            np.arange(z.shape[1]) == scores.argmax(axis=1)[:, None]
        )
        threshold = np.full(len(z), self.threshold)
        return Verdict(
            square,
            threshold,
            alarm,
            suspects,
            alarm,
            np.where(suspects, scores, 0.0),
            scores,
        )

    def reset(self) -> None:
        """Nothing is remembered."""


def _products(z: Array, forms: Array) -> Array:
    """Return the value (N, k) of each form (k, n) for each sample (N, n).

    The sums go in the order of channels, on every machine.
    """
    terms = z[:, None, :] * forms
    return np.asarray(terms.cumsum(axis=2)[:, :, -1])


BOUND = 3.0
"""Guaranteed bound of a channel in a study, in noise_std: 3 sigma taken for a limit."""
RANKED_BY_SCORE = ("likelihood_ratio", "cusum")
"""Methods that rank suspects by scores. Others rank by the largest normalised error."""

NORMALISED_SCORES = (
    "likelihood_ratio",
    "chi_square",
)  # methods whose scores are the normalised residuals ``|w_i|``

Method = Detector | ChiSquare

METHODS: dict[str, Any] = {
    **{name: detector_class(name) for name in DETECTORS},
    ChiSquare.name: ChiSquare,
}
"""All that a study can compare."""


class Evaluation(NamedTuple):
    """Verdicts of one method on N samples at its loose threshold."""

    #: (N,) statistic over threshold, NaN without an alarm
    ratio: Array
    #: (N, n) channels that may be the faulty ones
    suspects: Mask
    #: (N,) whether the method isolates its suspects
    isolated: Mask
    #: (N,) the worst of the suspects, -1 without suspects
    named: NDArray[np.intp]
    best: NDArray[np.intp] | None
    """(N,) channel of the largest normalised residual. None if the method has no residuals."""


class Contender:
    """One method with a loose threshold, a multiple of which gives the common rate."""

    def __init__(self, detector: Method) -> None:
        self.detector = detector
        # A run length instead of a probability per sample: the method is for a stream.
        self.has_memory = "run_length" in accepted_options(METHODS[detector.name])
        self._weight = detector.geometry.sensitivity / detector.noise.noise_std

    def evaluate(self, z: Array) -> Evaluation:
        """Verdicts on samples z (N, n) rad/s."""
        verdict = self.detector.detect(z)
        worst = (
            verdict.scores
            if self.detector.name in RANKED_BY_SCORE
            else np.abs(verdict.error) * self._weight
        )
        named = np.where(
            verdict.alarm, _largest(np.where(verdict.suspects, worst, -1.0)), -1
        )
        with np.errstate(invalid="ignore"):
            ratio = verdict.statistic / verdict.threshold
        best = (
            _largest(verdict.scores)
            if self.detector.name in NORMALISED_SCORES
            else None
        )
        return Evaluation(
            np.where(verdict.alarm, ratio, np.nan),
            verdict.suspects,
            verdict.isolated,
            named,
            best,
        )

    def ratios(self, z: Array) -> Array:
        """Statistic over threshold of every sample, (N,), alarm or not; -inf where not judged."""
        verdict = self.detector.detect(z)
        return np.nan_to_num(
            verdict.statistic / verdict.threshold,
            nan=-np.inf,
            posinf=1e300,
            neginf=-np.inf,
        )


class Contenders(NamedTuple):
    """Methods that run on a geometry, and why the others do not."""

    #: methods by name
    running: dict[str, Contender]
    #: reasons by name of the method
    refused: dict[str, str]


def _largest(size: Array) -> NDArray[np.intp]:
    """Return the column of the largest value of each row, (N,), equal within rounding."""
    size = np.nan_to_num(size, nan=-1.0)
    top = size.max(axis=1, keepdims=True)
    relative = size / np.where(top > 0, top, 1.0)
    return np.round(relative, 9).argmax(axis=1)


# One false-alarm rate for all ---------------------------------------------------------


class Cell(NamedTuple):
    """Trials on one geometry, of one size of fault or one selection, or without faults."""

    #: number of the geometry in the section
    geometry: int
    #: of the fault, in noise_std. 0: no fault, or a selection
    size: float = 0.0
    #: name of a selection of trials. Empty: none
    selection: str = ""

    @property
    def healthy(self) -> bool:
        """Whether no channel is off."""
        return not (self.size or self.selection)


class CommonRate(TrialProtocol[Cell]):
    """A protocol that compares all methods at one false-alarm rate.

    The first stage is the same for all: on healthy channels it finds the threshold at
    which each method gives the rates asked for.
    """

    streams: ClassVar[bool] = False  # trials are streams, which all methods can judge
    schema: ClassVar[Schema] = {
        "geometries": Field("geometries", ["two_triad_cone"]),
        "detectors": Field("detectors", "all", choices=tuple(METHODS)),
        "options": Field("mapping", {}),
    }

    @property
    def specs(self) -> list[Any]:
        """Geometries as the study gives them."""
        found: list[Any] = self.settings["geometries"]
        return found

    @cached_property
    def geometries(self) -> list[Geometry]:
        """As set."""
        return [geometry_of(spec) for spec in self.specs]

    @cached_property
    def contenders(self) -> list[Contenders]:
        """Methods at their loose thresholds for each geometry."""
        return [
            self.build(g, self.settings["detectors"], self.settings["options"])
            for g in range(len(self.specs))
        ]

    def preparation_cells(self) -> list[Cell]:
        """List the geometries, with healthy channels."""
        return [Cell(g) for g in range(len(self.specs))]

    def trials(self, cell: Cell) -> tuple[int, int]:
        """Return the trials of a cell and of a block. Healthy channels need more trials."""
        return self.settings[
            "sound_trials" if cell.healthy else "trials"
        ], self.settings["block"]

    def prepare(self, cell: Cell, count: int, rng: np.random.Generator) -> Counts:
        """Find by method the ratios of healthy samples that can decide a threshold."""
        z = self.draw(cell, count, rng)[0]
        alarms = self.settings["false_alarms"]
        # Twice the share of alarms, and more.
        kept = int(2 * max(alarms) * len(z)) + 50
        running = self.contenders[cell.geometry].running
        largest = {
            name: np.sort(one.ratios(z))[::-1][:kept].tolist()
            for name, one in running.items()
        }
        return {"trials": count, "largest": largest}

    def conclude(self, found: Sequence[Sequence[Counts]]) -> Preparation:
        """Find the multiples of the loose thresholds by geometry, method and false-alarm rate."""
        return {
            "factors": [
                factors_of(blocks, self.settings["false_alarms"]) for blocks in found
            ]
        }

    def refusals(self) -> Refusals:
        """Return the methods that judge no such trials, or do not run on a geometry."""
        return {
            str(spec): one.refused
            for spec, one in zip(self.specs, self.contenders, strict=True)
        }

    @abstractmethod
    def draw(
        self, cell: Cell, count: int, rng: np.random.Generator
    ) -> tuple[Array, Any]:
        """Draw values of trials, rad/s, and which channels are off."""

    @abstractmethod
    def loose(self) -> tuple[NoiseModel, float]:
        """Return the error model of a channel and the loose false-alarm probability."""

    def build(
        self, g: int, names: Sequence[str], own: Mapping[str, Mapping[str, Any]]
    ) -> Contenders:
        """Build methods of `METHODS` at loose thresholds. Options in ``own`` take precedence."""
        geometry, (noise, probability) = self.geometries[g], self.loose()
        running = {}
        refused = {}
        streaming = {}
        for name in names:
            accepted = accepted_options(METHODS[name])
            options = dict(
                FalseAlarmRate(false_alarm_probability=probability).as_options(accepted)
            )
            if not options and "max_faults" in accepted:
                # A loose threshold, in bounds: its own is found from it.
                options = {
                    "threshold": 0.2,
                    "max_faults": min(2, geometry.n - 4),
                }
            options |= own.get(name, {})
            try:
                contender = Contender(built(METHODS[name], geometry, noise, options))
            except FdiError as error:
                refused[name] = str(error)
                continue
            if contender.has_memory and not self.streams:
                streaming[name] = "judges a stream, not one sample"
            else:
                running[name] = contender
        return Contenders(running, refused | streaming)


def factors_of(
    blocks: Sequence[Counts], false_alarms: Sequence[float]
) -> dict[str, list[float]]:
    """Return the multiple of each loose threshold for each rate, from healthy channels.

    Each has the number of its ``trials``, and by method its ``largest`` ratios.
    """
    trials = sum(block["trials"] for block in blocks)
    pooled = {
        name: [ratio for block in blocks for ratio in block["largest"][name]]
        for name in blocks[0]["largest"]
    }
    return {
        name: [threshold_factor(own, alarm, trials) for alarm in false_alarms]
        for name, own in pooled.items()
    }


def threshold_factor(
    largest: Sequence[float], alarm_probability: float, trials: int
) -> float:
    """Return the ratio that a share of trials reaches, at least 1, the loose threshold."""
    rank = round(alarm_probability * trials)
    ordered = np.sort(np.asarray(largest, dtype=np.float64))[::-1]
    if rank < 1 or rank > len(ordered):
        return 1.0 if rank >= 1 else float(ordered[0])
    return max(float(ordered[rank - 1]), 1.0)


# The least delay ----------------------------------------------------------------------


def moustakides_delay(shift: float, run_length: float) -> float:
    """Return the least possible worst-case mean delay, samples, at a mean run length.

    No method has less than the CUSUM tuned to the very change (Moustakides 1986), for a
    ``shift`` > 0 of the mean of a standard normal: the fault in standard deviations
    times sqrt(S_ii).
    """
    limit = solve_log(
        lambda limit: cusum_run_length(limit, shift / 2, 0.0),
        run_length,
        math.log(run_length) / shift,
    )
    return cusum_run_length(limit, shift / 2, shift)


def cusum_run_length(limit: float, reference: float, mean: float) -> float:
    """Return the mean samples until a CUSUM ``max(0, s + x - reference)`` has its limit.

    Starts at s = 0. Solves the integral equation of Page (1954) by Gauss-Legendre
    quadrature, in standard deviations of x.
    """

    def above(x: float) -> float:
        return 0.5 * math.erfc(x / math.sqrt(2))

    if limit <= 0:
        return 1 / above(reference - mean)
    # The kernel is one standard deviation wide: a few nodes in each.
    nodes = 60 + math.ceil(2 * limit)
    node, weight = np.polynomial.legendre.leggauss(nodes)
    at = limit * (node + 1) / 2
    weight = limit * weight / 2
    start = np.concatenate([[0.0], at])
    step = at - start[:, None] + reference - mean
    matrix = np.zeros((nodes + 1, nodes + 1))
    matrix[:, 1:] = np.exp(-0.5 * step**2) * weight / math.sqrt(2 * math.pi)
    matrix[:, 0] = [1 - above(reference - mean - s) for s in start]
    return float(np.linalg.solve(np.eye(nodes + 1) - matrix, np.ones(nodes + 1))[0])
