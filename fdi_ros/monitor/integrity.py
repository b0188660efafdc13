# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Protection level: how far off the fused rate may be, undetected, by multiple-hypothesis solution separation.

Hypotheses: no channel faulty, each one, each pair, with a fault of the worst size. As in advanced
receiver autonomous integrity monitoring (Blanch et al. 2015, IEEE Trans. Aerosp. Electron. Syst. 51(1));
docs/integrity.md has the formulas.

The level is computed once for each set of channels, at noise_std. For a sample with larger errors the risk stays shared
among the hypotheses in the same way. Then ``T_L + q_L sigma_L`` with ``q_L = (level - T_L) / sigma_L`` is enough, and
the sample path bounds the largest term (`fdi_ros.core.level.fill_level`). NumPy alone.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config.settings import IntegrityConfig
from fdi_ros.core.subsets import flags_of, single_losses
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.model.noise import NoiseModel, normal_isf
from fdi_ros.model.samples import Array, Mask

Axes = tuple[float, float, float]
NO_LEVEL: Axes = (math.inf,) * 3

MIN_LEFT = 1e-3  # smallest singular value of S_LL. Below, L reaches no residual, or its channels cannot be told apart
MIN_SPREAD = 1e-9  # residuals with less than this share of the channel's standard deviation are rounding
_erfc = np.frompyfunc(math.erfc, 1, 1)


@dataclass(frozen=True)
class ProtectionLevel:
    """What holds for one set of fused channels."""

    #: (3,) protection level of the body axes, rad/s, inf if none exists
    level: Array
    limit: Array
    """(n,) largest residual of each channel that passes the separation test, rad/s, inf for channels not fused, and
    for channels that no others check."""
    #: (n, 3) largest weight of the variance of each channel in the square of the level
    #: of each axis
    share: Array


class _Modes(NamedTuple):
    """Fault modes: h sets of channels."""

    #: (h,) probability of each mode
    prior: Array
    #: (h, 3) standard deviation of the rate without them, rad/s
    sigma: Array
    #: (h, 3, k) share of its square that is due to each channel
    sigma_share: Array
    #: (h, 3) largest separation that passes the test, rad/s, inf where the rest gives
    #: no rate
    limit: Array
    #: (h, 3, k) part of that which is due to each channel's variance, rad/s
    limit_share: Array


class Integrity:
    """Protection levels, one set of channels at a time.

    The settings have risk, fault rates, false-alarm probability of the test, and the greatest motion. The weights of
    the fused rate are 1 / noise_std^2. Remaining biases, bias_std, count with the worst correlation for each axis.
    """

    def __init__(
        self,
        settings: IntegrityConfig,
        alarm_probability: float,
        geometry: Geometry,
        noise: NoiseModel,
    ) -> None:
        noise = noise.for_channels(geometry.n)
        self.risk = settings.risk
        self.alarm_probability = alarm_probability
        unnoticed = [
            -math.expm1(-rate * settings.exposure) for rate in settings.fault_rate
        ]
        self.prior: Array = np.broadcast_to(np.array(unnoticed), geometry.n)
        """(n,) probability that a channel is faulty unnoticed."""
        self._axes = geometry.axes
        self._noise = noise.noise_std**2
        norm = np.linalg.norm(geometry.axes, axis=1)
        # All that a level depends on.
        self._inputs = (
            self.risk,
            self.alarm_probability,
            *(part.tobytes() for part in (self.prior, self._axes, self._noise)),
        )
        scale = noise.scale_std * norm * settings.max_rate
        timing = noise.timing_std * norm * settings.max_acceleration
        greatest: Array = (
            self._noise + scale**2 + timing**2 + geometry.n * noise.bias_std**2
        )
        self.scale = math.sqrt(float((greatest / self._noise).max()))
        """By how much the errors of the channels exceed noise_std in the greatest motion."""

    def __hash__(self) -> int:
        return hash(self._inputs)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Integrity) and self._inputs == other._inputs

    def fill(self, subsets: NDArray[Any], *masks: int) -> None:
        """Write the levels for sets of channels, by their bits, into their records (2^n,), unless they are there."""
        n = len(self._axes)
        for mask in masks:
            if not subsets["has_level"][mask]:
                known = _level_of(self, mask)
                subset = subsets[mask]
                subset["level"] = known.level
                subset["limit"][:n] = known.limit
                subset["share"][:n] = known.share
                subset["has_level"] = True

    def after_loss(self, subsets: NDArray[Any], mask: int) -> Axes:
        """Level after one more loss, in the greatest motion, for the worst channel on each axis, rad/s, or inf."""
        self.fill(subsets, mask, *(rest := single_losses(mask)))
        if not rest:
            return NO_LEVEL
        largest = subsets["level"][rest].max(axis=0)
        x, y, z = (self.scale * largest).tolist()
        return x, y, z

    def prepare(self, subsets: NDArray[Any]) -> None:
        """Write the levels for all channels and for every loss of one and two: a fault must not wait for them."""
        whole = len(subsets) - 1
        for left in (whole, *single_losses(whole)):
            self.fill(subsets, left, *single_losses(left))

    def of(self, mask: Mask, variances: Array | None = None) -> ProtectionLevel:
        """Level with the channels in mask (n,) fused, for variances (n,), (rad/s)^2, or noise_std^2."""
        kept = np.flatnonzero(mask)
        limit = np.full(len(mask), np.inf)
        axes = self._axes[kept]
        variance = (self._noise if variances is None else variances)[kept]
        unbounded = np.full(3, np.inf)
        nothing = ProtectionLevel(unbounded, limit, np.zeros((len(mask), 3)))
        if not spans_space(axes):
            return nothing
        root = 1 / np.sqrt(self._noise[kept])
        scaled = np.linalg.pinv(axes * root[:, None])
        gain = np.asarray(scaled * root, dtype=np.float64)
        residual = np.eye(len(kept)) - axes @ gain
        parts = residual**2 * variance
        spread = np.sqrt(parts.sum(axis=1))
        # Bonferroni's bound lies within 1 % above the exact threshold.
        test = normal_isf(self.alarm_probability / (2 * len(kept))) * spread
        limit[kept] = np.where(spread > MIN_SPREAD * np.sqrt(variance), test, np.inf)
        if self.risk <= 0:
            return nothing
        prior = self.prior[kept]
        sets = [
            np.array(list(combinations(range(len(kept)), size)), dtype=np.intp)
            for size in (1, 2)
        ]
        least = np.maximum(spread, MIN_SPREAD * np.sqrt(variance))
        test_parts = parts * (test / least**2)[:, None]
        alike = [
            _modes(chosen, prior, gain, residual, variance, test_parts)
            for chosen in sets
        ]
        modes = _Modes(*map(np.concatenate, zip(*alike, strict=True)))
        sigma = np.sqrt((gain**2 * variance).sum(axis=1))
        level = _solve(sigma, prior, modes, self.risk)
        share = np.zeros((len(mask), 3))
        if np.isfinite(level).all():
            portions = gain**2 * variance / sigma[:, None] ** 2
            share[kept] = _share(level, portions, modes)
        return ProtectionLevel(level, limit, share)


# 12 channels have 79 sets that are prepared, and accelerometers as many.
@functools.lru_cache(maxsize=1024)
def _level_of(integrity: Integrity, mask: int) -> ProtectionLevel:
    """Level with the channels in mask, by their bits: the same in each replay of a sweep."""
    return integrity.of(flags_of(mask, len(integrity.prior)))


def _modes(
    sets: NDArray[np.intp],
    prior: Array,
    gain: Array,
    residual: Array,
    variance: Array,
    test_parts: Array,
) -> _Modes:
    """Fault modes of the sets (h, l), from gain (3, k), residual matrix (k, k) and variance (k,).

    Row i of test_parts (k, k) sums to the test limit of channel i. Its elements belong to the variances.
    """
    inner = residual[sets[:, :, None], sets[:, None, :]]
    possible = np.linalg.svd(inner, compute_uv=False)[:, -1] >= MIN_LEFT
    inverse = np.linalg.inv(
        np.where(possible[:, None, None], inner, np.eye(sets.shape[1]))
    )
    separation = gain[:, sets].transpose(1, 0, 2) @ inverse
    without = gain - separation @ residual[sets]
    limit_share = np.abs(separation) @ test_parts[sets]
    square = without**2 * variance
    odds = prior / (1 - prior)
    return _Modes(
        odds[sets].prod(axis=1) * (1 - prior).prod(),
        np.sqrt(square.sum(axis=2)),
        square / square.sum(axis=2, keepdims=True),
        np.where(possible[:, None], limit_share.sum(axis=2), np.inf),
        limit_share,
    )


def _share(level: Array, share: Array, modes: _Modes) -> Array:
    """Largest share (k, 3) of each variance in the squared level (3,), given the share of the rate alone, (k, 3)."""
    for at, limit_share, sigma_share in zip(
        modes.limit, modes.limit_share, modes.sigma_share, strict=True
    ):
        held = (at <= level)[:, None]
        total = (
            limit_share + (level - np.where(held[:, 0], at, 0.0))[:, None] * sigma_share
        ) / level[:, None]
        share = np.maximum(share, np.where(held, total, 0.0))
    return np.asarray(share.T, dtype=np.float64)


def _solve(sigma: Array, prior: Array, modes: _Modes, risk: float) -> Array:
    """Level (3,) from the sigma (3,) of the fused rate, the priors (k,) and the fault modes."""
    priors = modes.prior
    sigmas = modes.sigma
    limits = modes.limit
    covered = np.isfinite(limits[:, 0])
    none = float((1 - prior).prod())
    by_number = np.ones(1)
    # Probability of each number of faulty channels, without cancellation: the product
    # of all 1 - p + p x.
    for p in prior:
        by_number = np.convolve(by_number, [1 - p, p])
    of_three = float(by_number[3:].sum())
    budget = risk - of_three - float(priors[~covered].sum())
    if budget <= 0:
        return np.full(3, np.inf)
    priors = priors[covered, None]
    sigmas = sigmas[covered]
    limits = limits[covered]

    def missed(level: Array) -> Array:
        sound = _tail(level / sigma)
        faulty = np.where(level < limits, 1.0, _tail((level - limits) / sigmas))
        return 2 * none * sound + (priors * (faulty + sound)).sum(axis=0)

    reach = normal_isf(min(budget / 2, 0.5))
    low = np.zeros(3)
    high = np.vstack([limits + reach * sigmas, reach * sigma]).max(axis=0)
    # Too large by 1e-9 of the interval at most, after 30 halvings.
    for _ in range(30):
        middle = 0.5 * (low + high)
        above = missed(middle) > budget
        low = np.where(above, middle, low)
        high = np.where(above, high, middle)
    return high


def _tail(x: Array) -> Array:
    """P(standard normal > x), elementwise."""
    return 0.5 * np.asarray(_erfc(x / math.sqrt(2)), dtype=np.float64)
