# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Walking biases and constants, estimated from all groups of windows together.

Groups contribute ``N x = r`` for the states x. Biases b walk from group to group, and
all other states c are constant. For the biases of all groups the system is banded with
the constants as its border: ``B b + C c = h, C' b + T c = g``. Elimination of the
biases (banded Cholesky) also gives the marginal likelihood of the walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from fdi_ros.model.samples import Array

#: tried, rad/s/sqrt(s)
WALKS = np.geomspace(1e-6, 4e-3, 13)


class _WalkEvidence(NamedTuple):
    """How the walk of the biases is found."""

    #: smallest walk, rad/s/sqrt(s), which moves no bias and keeps the system
    #: regular
    none: float = 1e-7
    #: log-likelihood that a walk must gain over none to be shown: one of 200
    #: without a walk does
    gain: float = 4.0
    #: loss of log-likelihood for a possible walk, exceeded by one true walk in 20
    possible: float = 2.0


_WALK = _WalkEvidence()


class NormalEquations:
    """Normal equations of groups, biases (n) first, in units of prior standard deviations.

    The scaling keeps information within the range of double precision. ``normal``,
    ``right``: N (K, s, s) and r (K, s). ``apart`` (K,): time to the next group, s, the
    last unused. ``prior``, ``start`` (s,): prior standard deviations, equal for all
    biases, and prior means.
    """

    def __init__(
        self,
        n: int,
        normal: Array,
        right: Array,
        apart: Array,
        prior: Array,
        start: Array,
    ) -> None:
        self.n = n
        self.apart = apart
        self.prior = prior
        self.normal = normal * np.outer(prior, prior)
        self.right = right * prior
        self.start = start / prior


def positive_part(matrices: Array) -> Array:
    """Return symmetric matrices (W, s, s) with their negative eigenvalues set to 0.

    Moments less the moments of noise have some by chance.
    """
    values, vectors = np.linalg.eigh(matrices)
    positive = np.maximum(values, 0.0)
    return np.asarray(np.einsum("wab,wb,wcb->wac", vectors, positive, vectors))


@dataclass(frozen=True)
class Smoothed:
    """Estimate of all states."""

    #: (m,) the states that stay
    constant: Array
    #: (m, m) covariance of the constants
    constant_covariance: Array
    #: (K, n) biases over time, rad/s
    curve: Array
    #: (n,) their mean over the recording
    mean: Array
    #: (n, n) covariance of the mean
    mean_covariance: Array


class RandomWalk(NamedTuple):
    """How the biases walk, rad/s/sqrt(s)."""

    #: 0: none shown
    value: float
    #: the largest that the recording does not rule out
    possible: float


def _eliminate(of: NormalEquations, walk: float) -> tuple[Array, Array, Array, float]:
    """Eliminate biases with this walk.

    Returns B^-1 (K n, n + m + 1) applied to the mean of the biases, to C and to h
    (the biases for zero constants), information (m, m) on the constants with its
    right-hand side (m,), and the log marginal likelihood.
    """
    n = of.n
    count = len(of.normal)
    stiffness = of.prior[0] ** 2 / (max(walk, _WALK.none) ** 2 * of.apart[:-1])[:, None]
    blocks = of.normal[:, :n, :n].copy()
    diagonal = np.einsum("kii->ki", blocks)
    diagonal[0] += 1.0
    diagonal[:-1] += stiffness
    diagonal[1:] += stiffness
    band = np.zeros((n + 1, count, n))
    for below in range(n):
        band[below, :, : n - below] = np.diagonal(blocks, -below, 1, 2)
    band[n, :-1] = -stiffness
    border = of.normal[:, :n, n:].reshape(count * n, -1)
    h = of.right[:, :n].copy()
    h[0] += of.start[:n]
    factor = cholesky_banded(band.reshape(n + 1, -1), lower=True)
    mean = np.tile(np.eye(n) / count, (count, 1))
    solved = cho_solve_banded(
        (factor, True), np.column_stack([mean, border, h.ravel()])
    )
    from_constants = solved[:, n:-1]
    alone = solved[:, -1]
    information = (
        np.eye(border.shape[1])
        + of.normal[:, n:, n:].sum(axis=0)
        - border.T @ from_constants
    )
    information = 0.5 * (information + information.T)
    side = of.start[n:] + of.right[:, n:].sum(axis=0) - border.T @ alone
    constants = np.linalg.solve(information, side)
    fits = float(h.ravel() @ alone + side @ constants)
    volume = (
        2.0 * np.log(factor[0]).sum()
        - n * np.log(stiffness).sum()
        + np.linalg.slogdet(information)[1]
    )
    return solved, information, side, 0.5 * (fits - float(volume))


def find_random_walk(of: NormalEquations) -> RandomWalk:
    """Find the walk of the biases by its marginal likelihood."""
    if len(of.normal) < 3:
        return RandomWalk(0.0, float(WALKS[-1]))
    tried = (0.0, *WALKS)
    none, *logs = (_eliminate(of, walk)[-1] for walk in tried)
    best = int(np.argmax(logs))
    # Between the walks tried, by a parabola.
    shift = 0.0
    if 0 < best < len(WALKS) - 1:
        a, b, c = logs[best - 1 : best + 2]
        curvature = min(a - 2 * b + c, -1e-9)
        shift = float(np.clip(0.5 * (a - c) / curvature, -0.5, 0.5))
    value = float(WALKS[best] * (WALKS[1] / WALKS[0]) ** shift)
    likely = np.array(logs) > max(logs[best], none) - _WALK.possible
    possible = float(WALKS[likely].max(initial=0.0))
    return RandomWalk(value if logs[best] - none > _WALK.gain else 0.0, possible)


def smooth(
    of: NormalEquations, walk: float, known: tuple[Array, Array] | None = None
) -> Smoothed:
    """Estimate the states for biases with this walk, rad/s/sqrt(s).

    ``known``: the first constants (k,) and their covariance (k, k) from elsewhere. They
    stay as given, and their uncertainty counts (Schmidt 1966).
    """
    n = of.n
    solved, information, side, _ = _eliminate(of, walk)
    if known is None:
        covariance = np.linalg.inv(information)
        constant = covariance @ side
    else:
        k = len(known[0])
        prior = of.prior[n : n + k]
        first = known[0] / prior
        p = known[1] / np.outer(prior, prior)
        free = np.linalg.inv(information[k:, k:])
        by = -free @ information[k:, :k]
        constant = np.concatenate([first, free @ side[k:] + by @ first])
        cross = by @ p
        covariance = np.block([[p, p @ by.T], [cross, free + cross @ by.T]])
    curve = (solved[:, -1] - solved[:, n:-1] @ constant).reshape(-1, n)
    # The mean of the biases by itself, and by the constants.
    mean = solved.reshape(len(curve), n, -1).mean(axis=0)
    alone = mean[:, :n]
    each = mean[:, n:-1]
    unit = of.prior[n:]
    return Smoothed(
        constant * unit,
        covariance * np.outer(unit, unit),
        curve * of.prior[0],
        curve.mean(axis=0) * of.prior[0],
        (alone + each @ covariance @ each.T) * of.prior[0] ** 2,
    )
