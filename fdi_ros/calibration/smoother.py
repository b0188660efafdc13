# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error states of the monitor over a whole recording: forwards and backwards, in information form.

Windows say ``N x = r`` of the states x; biases b walk from window to window, all others c are constant. Forwards, with
J the information on b so far, C that between b and c, W the walk to the next window and F = (I + W J)^-1:

    J <- F J,    C <- F C,    h <- F h,    T <- T - C' W F C,    g <- g - C' W F h;

backwards, b(k) = F' b(k + 1) + W F (h - C c) with covariance W F. The marginal likelihood of the walk falls out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.model.samples import Array

WALKS = np.geomspace(1e-6, 4e-3, 13)
"""Tried, rad/s/sqrt(s)."""
SHOWN_GAIN = 4.0
"""Log-likelihood that a walk must gain over none to be shown."""
POSSIBLE = 2.0
"""What one may lose against the best and be possible."""


@dataclass(frozen=True)
class Evidence:
    """What the windows say of the states, the n biases first, in units of their standard deviations before.

    In units of their own, information on them would be apart by more than what rounding leaves of a number.
    """

    n: int
    """Number of biases."""
    normal: Array
    """(K, s, s) N."""
    right: Array
    """(K, s) r."""
    apart: Array
    """(K,) time to the next window, s; the last is not read."""
    prior: Array
    """(s,) standard deviations before, of all biases the same: rad/s, s, ..."""
    start: Array
    """(s,) means before."""

    @classmethod
    def in_units(cls, n: int, normal: Array, right: Array, apart: Array, prior: Array, start: Array) -> Evidence:
        """Take the same of states in units of their own."""
        return cls(n, normal * np.outer(prior, prior), right * prior, apart, prior, start / prior)


@dataclass(frozen=True)
class Smoothed:
    """Estimate of all states."""

    constant: Array
    """(m,) the states that stay."""
    constant_covariance: Array
    """(m, m) of them."""
    curve: Array
    """(K, n) biases over time, rad/s."""
    mean: Array
    """(n,) their mean over the recording."""
    mean_covariance: Array
    """(n, n) of it."""


@dataclass(frozen=True)
class Walk:
    """How the biases walk, rad/s/sqrt(s)."""

    value: float
    """0: none shown."""
    possible: float
    """The largest that the recording does not rule out."""


Step = tuple[Array, Array, Array, Array]


def _forwards(of: Evidence, walk: float) -> tuple[list[Step], Array, Array, float]:
    """Return the steps, and of the last window information and right-hand side, and the log-likelihood."""
    n, states = of.n, len(of.prior)
    j, c, t = np.eye(n), np.zeros((n, states - n)), np.eye(states - n)
    h, g = of.start[:n], of.start[n:]
    kept: list[Step] = []
    log, last, eye = 0.0, len(of.normal) - 1, np.eye(n)
    for k in range(last + 1):
        normal, right = of.normal[k], of.right[k]
        j, c, t = j + normal[:n, :n], c + normal[:n, n:], t + normal[n:, n:]
        h, g = h + right[:n], g + right[n:]
        if k == last:
            break
        w = (walk / of.prior[0]) ** 2 * of.apart[k]
        f = np.linalg.inv(eye + w * j)
        m = w * f
        kept.append((f, m, c, h))
        log += 0.5 * float(h @ m @ h + np.linalg.slogdet(f)[1])
        t, g = t - c.T @ m @ c, g - c.T @ m @ h
        j, c, h = f @ j, f @ c, f @ h
        j = 0.5 * (j + j.T)
    whole, side = np.block([[j, c], [c.T, t]]), np.concatenate([h, g])
    log += 0.5 * float(side @ np.linalg.solve(whole, side) - np.linalg.slogdet(whole)[1])
    return kept, whole, side, log


def find_walk(of: Evidence) -> Walk:
    """Find the walk of the biases by its marginal likelihood."""
    if len(of.normal) < 3:
        return Walk(0.0, float(WALKS[-1]))
    logs = np.array([_forwards(of, walk)[3] for walk in WALKS])
    none, best = _forwards(of, 0.0)[3], int(logs.argmax())
    # Between the walks tried, by a parabola.
    shift = 0.0
    if 0 < best < len(WALKS) - 1:
        a, b, c = logs[best - 1 : best + 2]
        shift = float(np.clip(0.5 * (a - c) / min(a - 2 * b + c, -1e-9), -0.5, 0.5))
    value = float(np.exp(np.log(WALKS[best]) + shift * np.log(WALKS[1] / WALKS[0])))
    top = max(float(logs[best]), none)
    possible = float(WALKS[np.flatnonzero(logs > top - POSSIBLE)[-1]]) if (logs > top - POSSIBLE).any() else 0.0
    return Walk(value if logs[best] - none > SHOWN_GAIN else 0.0, possible)


def smooth(of: Evidence, walk: float) -> Smoothed:
    """Estimate the states; walk: of the biases, rad/s/sqrt(s)."""
    kept, whole, side, _ = _forwards(of, walk)
    n, count = of.n, len(of.normal)
    covariance = np.linalg.inv(whole)
    covariance = 0.5 * (covariance + covariance.T)
    x = covariance @ side
    curve = np.empty((count, n))
    curve[-1] = x[:n]
    # Of the sum of all biases so far, of the last one, and of the constants, together.
    size = len(x) + n
    lift = np.vstack([np.eye(len(x))[:n], np.eye(len(x))])
    joint = lift @ covariance @ lift.T
    for k in range(count - 2, -1, -1):
        f, m, c, h = kept[k]
        curve[k] = f.T @ curve[k + 1] + m @ (h - c @ x[n:])
        step = np.eye(size)
        step[n : 2 * n, n : 2 * n] = step[:n, n : 2 * n] = f.T
        step[n : 2 * n, 2 * n :] = step[:n, 2 * n :] = -m @ c
        joint = step @ joint @ step.T
        joint[: 2 * n, : 2 * n] += np.block([[m, m], [m, m]])
    unit = of.prior[n:]
    return Smoothed(
        x[n:] * unit,
        covariance[n:, n:] * np.outer(unit, unit),
        curve * of.prior[0],
        curve.mean(axis=0) * of.prior[0],
        joint[:n, :n] * (of.prior[0] / count) ** 2,
    )
