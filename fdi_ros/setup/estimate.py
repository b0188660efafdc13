# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error states of the monitor, estimated from a whole recording.

The states are those of `fdi_ros.estimator.error_states` that a recording can show. The
noise, and therefore the information A, is constant within a window. With s = (1, rate,
angular acceleration) of a block and the signals ``B_i s`` of channel i, a window
contributes

    N = sum_ij A_ij B_i' (sum s s') B_j,        r = sum_ij A_ij B_i' (sum s y_j),

where the rate is known to be zero at rest. Passes repeat, with delays taken off the
samples and scale errors put into the axes, until both settle. States without evidence
stay at their prior.

`fdi_ros.setup.smoother` solves the normal equations of all windows together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fdi_ros.compiling.compiled import allocate
from fdi_ros.config.config import PARAMETERS
from fdi_ros.estimator.error_states import (
    ERROR_KINDS,
    ONE,
    SIGNALS,
    Layout,
    fill_signals,
    places_of,
    prepare_layout,
)
from fdi_ros.estimator.estimator import LONG_TIME, REST_BLOCKS
from fdi_ros.estimator.rest import REST_RATIO, REST_STD, UNLEARNED, rests
from fdi_ros.estimator.shared_noise import UNEQUAL
from fdi_ros.model.geometry import spans_space
from fdi_ros.model.samples import Array, Int, Mask
from fdi_ros.monitor.building import UNIT_DELAY
from fdi_ros.setup.blocks import PRESENT, Blocks, Data, make_blocks
from fdi_ros.setup.noise import (
    Floor,
    find_floor,
    gains,
    information,
    levels,
    of_the_moment,
    projector,
)
from fdi_ros.setup.nonlinearity import Nonlinearity, measure
from fdi_ros.setup.smoother import (
    NormalEquations,
    RandomWalk,
    Smoothed,
    find_random_walk,
    positive_part,
    smooth,
)

#: Prior standard deviation of each component of scale error and misalignment: 0.5 % and
#: 0.5 deg.
SCALE_STD = 0.008
#: The same for reference channels, whose axes are taken as configured.
REFERENCE_STD = 1e-6


class _PassLimits(NamedTuple):
    """Passes over a recording, and what ends them."""

    #: largest number of passes. They end earlier once nothing changes any more
    most: int = 12
    #: first passes, which take all motion for motion, because unknown delays and
    #: scale errors look like vibration
    trusting: int = most // 3
    #: change of delays, s, and relative change of axes, below which a pass has
    #: settled
    settled: float = 2e-5


_PASSES = _PassLimits()

#: Largest standard error of a delay that counts as known, s, and largest change of a
#: delay in a pass from which the walk of the biases is found: a tenth of a sample at
#: 100 Hz.
SHOWN_DELAY = 0.001
#: Largest delay that can be configured, s.
LARGEST_DELAY = PARAMETERS["imus.delays"].high
#: largest change of a delay in one pass, s, as slopes hold for nearby motion only
STEP_DELAY = 2.0 * UNIT_DELAY
#: variance of a channel that is not there, (rad/s)^2
ABSENT_VARIANCE = 1e12
#: largest distance between means of windows at rest, in standard deviations
SAME_REST = 5.0
#: largest ratio of the noise in motion to the noise that is written
MOST_VIBRATION = 4.0
#: walk of biases that show none, rad/s/sqrt(s)
USUAL_WALK = 2e-5
#: Smallest number of blocks for the noise of a window, and of windows for the colour of
#: the noise; number of blocks in each mean that shows the colour.
LEAST_BLOCKS = COLOUR_WINDOWS = SUBS = 5
#: Number of base signals: one, the rate (3), and the angular acceleration (3).
BASE = 7
#: Estimated kinds of error states. Their signals are linear in the base signals.
ESTIMATED = (
    "bias",
    "scale",
    "delay",
)
(BIAS_RATE,) = (kind for kind in ERROR_KINDS if kind.feeds == "bias")


@dataclass(frozen=True)
class Priors:
    """Quantities to estimate, with their prior knowledge.

    For accelerometers a body rate stands for a specific force, in units of its natural
    size, and an angular acceleration for its change.
    """

    #: (n, 3) as configured
    axes: Array
    #: (n,) number of the unit of each channel
    unit: Int
    #: number of units
    units: int
    #: (n,) of scale error and misalignment
    scale_std: Array
    #: rad/s
    bias_std: float
    #: s
    delay_std: float
    #: (units,) expected delays of the stamps, s; the first one's is known
    delay: Array
    rest: Mask | None = None
    """(W,) windows at rest, where the rate is constant and not known to be zero. None: the
    rate shows rest, and is zero there."""


@dataclass(frozen=True)
class StateEstimate:
    """All states, estimated."""

    #: (n, 3)
    axes: Array
    #: (3 n, 3 n) covariance of all axes
    axes_covariance: Array
    #: (n,) by how much the stamps of each channel's unit are late against those of the
    #: first, s
    delay: Array
    #: (n,) s
    delay_std: Array
    #: (n,) mean over the recording, rad/s
    bias: Array
    #: (n, n) (rad/s)^2
    bias_covariance: Array
    #: (K, n) biases over time, rad/s
    curve: Array
    #: (K,) s
    times: Array
    #: of the biases
    bias_walk: RandomWalk
    #: noise that channels have by themselves
    floor: Floor
    #: (W, n) standard deviation of a sample in every window, vibration included, rad/s
    moment: Array
    #: blocks in use
    blocks: Blocks
    #: (W,) windows at rest
    rest: Mask
    #: (B, 3) of the body, rad/s
    rate: Array
    #: errors that are not linear in the rate
    nonlinearity: Nonlinearity

    @property
    def rest_seconds(self) -> float:
        """Time at rest, s."""
        return float(self.rest.sum()) * REST_BLOCKS * self.blocks.length

    @property
    def noise_std(self) -> Array:
        """Noise of a sample of each channel (n,), rad/s: at rest, or more in motion.

        The monitor accepts at most `MOST_VIBRATION` times this noise as vibration when motion
        begins, so the noise is at least that part of the median noise in motion.
        """
        moving = self.moment[~self.rest]
        if not len(moving):
            return self.floor.std
        return np.maximum(self.floor.std, np.median(moving, axis=0) / MOST_VIBRATION)

    def disagreement(self) -> tuple[float, float]:
        """Remaining scale error between channels, rms of all components, and its uncertainty.

        Errors common to all channels turn or scale the body frame, and no channel
        contradicts them.
        """
        apart = np.kron(projector(self.axes), np.eye(3))
        left = apart @ self.axes_covariance @ apart
        count = 3 * (len(self.axes) - 3)
        mean = float(np.trace(left)) / count
        rms = float(np.sqrt(max(mean, 1e-18)))
        spread = np.sqrt(2.0 * np.sum(left * left)) / count
        return rms, float(spread / (2.0 * rms))


def estimate(data: Data, sensors: Priors) -> StateEstimate:
    """Estimate all states from a recording."""
    n = len(sensors.axes)
    axes = sensors.axes.copy()
    biases = np.zeros((1, n))
    colour = np.ones((2, n))
    priors = sensors
    # Delays taken off the blocks, and the largest change in the last pass.
    taken = sensors.delay.copy()
    moved = np.inf
    blocks = make_blocks(data, taken[sensors.unit])
    walk: RandomWalk | None = None
    for number in range(_PASSES.most):
        one = _Pass(blocks, priors, axes, taken, biases, number > 1, colour)
        is_last = number == _PASSES.most - 1
        if number > 1 and (is_last or (walk is None and moved < SHOWN_DELAY)):
            walk = find_random_walk(one.evidence)
        shown, found = one.solve(walk, number >= _PASSES.trusting)
        scale = found.constant[: 3 * n].reshape(n, 3)
        step = np.clip(found.constant[3 * n : one.motion], -STEP_DELAY, STEP_DELAY)
        axes = axes + scale
        delay = np.clip(taken + np.append(0.0, step), -LARGEST_DELAY, LARGEST_DELAY)
        biases = one.curve_of(found)
        colour = one.colours(axes)
        moved = float(np.abs(delay - taken).max())
        has_settled = moved < _PASSES.settled and np.abs(scale).max() < _PASSES.settled
        if number > _PASSES.trusting and walk is not None and has_settled:
            break
        if moved > _PASSES.settled:
            taken = delay
            blocks = make_blocks(data, taken[sensors.unit])
        priors = _widened(sensors, axes) if number >= _PASSES.trusting else sensors
    assert walk is not None
    covariance = _constant_covariance(one, shown, found)
    of_delays = np.diag(covariance)[3 * n : one.motion]
    delay_std = np.append(0.0, np.sqrt(of_delays))
    # Interpolation reduces white noise; the factor restores the residual.
    kept = np.sqrt(blocks.white)
    return StateEstimate(
        axes,
        covariance[: 3 * n, : 3 * n],
        delay[sensors.unit],
        delay_std[sensors.unit],
        found.mean,
        found.mean_covariance,
        one.curve_of(found),
        one.times,
        walk,
        replace(one.floor, std=one.floor.std / kept, error=one.floor.error / kept),
        np.sqrt(of_the_moment(blocks.samples, one.sampled, axes)) / kept,
        blocks,
        one.rest,
        one.rate,
        one.nonlinearity(sensors, axes, found.mean),
    )


def _widened(sensors: Priors, axes: Array) -> Priors:
    """Widen the prior of the axes where these are farther off than expected."""
    off = axes - sensors.axes
    apart = off - axes @ (np.linalg.pinv(axes) @ off)
    checks = 3 * (len(axes) - 3)
    size = float(np.sqrt((apart**2).sum() / checks))
    times = size / max(float(np.median(sensors.scale_std)), 1e-9)
    # With two units chance makes 1.5 once in 60 recordings.
    return replace(
        sensors, scale_std=sensors.scale_std * (times if times > 1.5 else 1.0)
    )


def _constant_covariance(one: _Pass, shown: Smoothed, found: Smoothed) -> Array:
    """Return the covariance of the constants, enlarged by the misfit, at most the prior."""
    covariance = found.constant_covariance * misfit(one.careful, shown)
    prior = one.careful.prior[len(one.axes) :]
    known = np.minimum(1.0, prior / np.sqrt(np.diag(covariance)))
    return np.asarray(covariance * np.outer(known, known))


class _Pass:
    """One linearisation: rest, rate and noise of every window, and evidence for the states.

    ``delay`` (units,): taken off the blocks, s. ``axes`` (n, 3). ``biases`` (K, n): of
    joined windows, rad/s. ``known``: whether the biases have been refined by two
    passes.
    ``colour`` (2, n): variance of longer means over white noise's, at rest and in
    motion.
    """

    def __init__(
        self,
        blocks: Blocks,
        sensors: Priors,
        axes: Array,
        delay: Array,
        biases: Array,
        known: bool,
        colour: Array,
    ) -> None:
        self.blocks = blocks
        self.axes = axes
        self.window = blocks.window
        #: number of constants that motion shows, the first of all
        self.motion = 3 * len(axes) + sensors.units - 1
        y, moment = self._noise_of_windows()
        steady = np.where(self.present, moment, ABSENT_VARIANCE)
        gain = gains(steady, axes)
        # Expand the biases of joined windows to all windows.
        each = -(-blocks.windows // len(biases))
        bias = np.repeat(biases, each, axis=0)[: blocks.windows]
        self.rate: Array = np.einsum(
            "bai,bi->ba", gain[self.window], y - bias[self.window]
        )
        own = sensors.rest is None
        self.rest: Mask = (
            self._find_rest(gain, steady, known)
            if sensors.rest is None
            else sensors.rest
        )
        #: (W,) windows with a rate that is known to be zero
        self.still: Mask = self.rest if own else np.zeros_like(self.rest)
        # (W, n) of a block, (rad/s)^2, coloured noise counted in.
        factor = np.where(self.rest[:, None], colour[0], colour[1])
        self.variance: Array = np.where(self.present, moment * factor, ABSENT_VARIANCE)
        acceleration = self._accelerations()
        self._join_windows()
        self.evidence, self.careful = self._find_evidence(
            sensors, delay, y, acceleration
        )

    def _noise_of_windows(self) -> tuple[Array, Array]:
        """Return blocks (B, n), zero where not used, and the variance of one (W, n), (rad/s)^2."""
        blocks = self.blocks
        finite = np.isfinite(blocks.mean)
        delivered = np.add.reduceat(finite, blocks.start, axis=0)
        present = delivered >= PRESENT * blocks.size[:, None]
        # Channels that do not span space give no rate.
        present &= spanning(present, self.axes)[:, None]
        # Blocks (B,) with all channels that are present in their window.
        complete = (finite | ~present[self.window]).all(axis=1)
        known: Mask = np.asarray(present.any(axis=1))
        self.used: Mask = np.asarray(complete & known[self.window])
        y = np.where(finite & present[self.window], blocks.mean, 0.0)
        self.count: Int = np.add.reduceat(self.used, blocks.start)
        total = np.add.reduceat(y * self.used[:, None], blocks.start, axis=0)
        mean = total / np.maximum(self.count, 1)[:, None]
        apart = (y - mean[self.window]) * self.used[:, None]
        free = np.maximum(self.count - 1, 1)[:, None, None]
        covariance = self._by_window(apart, apart) / free
        # (W, n), the second for channels with usable single samples.
        self.present = present & (self.count >= LEAST_BLOCKS)[:, None]
        usable = np.isfinite(np.einsum("wii->wi", blocks.samples))
        self.sampled = self.present & usable & (blocks.count > 3)[:, None]
        moment = of_the_moment(covariance, self.present, self.axes)
        self.floor = find_floor(blocks.samples, blocks.count, self.sampled, self.axes)
        return y, moment

    def _accelerations(self) -> Array:
        """Return angular accelerations (B, 3), rad/s^2, 0 where unknown.

        Blocks in motion without one are no longer used.
        """
        blocks = self.blocks
        acceleration = blocks.slopes(self.rate)
        inside: Mask = np.asarray(np.isfinite(acceleration).all(axis=1))
        inside[1:-1] &= self.used[2:] & self.used[:-2]
        enough = self.count >= LEAST_BLOCKS
        self.used = self.used & (inside | self.rest[self.window]) & enough[self.window]
        return np.where(inside[:, None], acceleration, 0.0)

    def _join_windows(self) -> None:
        """Join windows to at most `MOST_GROUPS` groups of a constant bias."""
        blocks = self.blocks
        each = blocks.group_size
        self.groups = [
            slice(first, first + each) for first in range(0, blocks.windows, each)
        ]
        self.middle: Array = np.array(
            [blocks.time[group].mean() for group in self.groups]
        )
        #: (K,) of the joined windows, s from the first
        self.times = blocks.time[0] + self.middle - self.middle[0]

    def solve(
        self, walk: RandomWalk | None, careful: bool
    ) -> tuple[Smoothed, Smoothed]:
        """Return the constants that motion shows, and all states given these.

        ``careful``: without what vibration explains.
        """
        usual = USUAL_WALK
        if walk is not None:
            usual = walk.value or min(walk.possible, USUAL_WALK)
        shown = smooth(self.careful if careful else self.evidence, usual)
        of_motion = slice(0, self.motion)
        known = (
            shown.constant[of_motion],
            shown.constant_covariance[of_motion, of_motion],
        )
        return shown, smooth(self.evidence, usual, known)

    def curve_of(self, found: Smoothed) -> Array:
        """Biases (K, n) over time, rad/s."""
        trend = found.constant[-found.curve.shape[1] :]
        since_middle = self.times - self.times.mean()
        return np.asarray(found.curve + np.outer(since_middle, trend))

    def _by_window(self, first: Array, second: Array) -> Array:
        """Sum (W, l, r) products over the blocks of every window."""
        found = np.empty((self.blocks.windows, first.shape[1], second.shape[1]))
        for i, j in np.ndindex(found.shape[1:]):
            found[:, i, j] = np.add.reduceat(
                first[:, i] * second[:, j], self.blocks.start
            )
        return found

    def _find_rest(self, gain: Array, variance: Array, known: bool) -> Mask:
        """Find windows (W,) at rest.

        Quiet, at rest for the monitor, and with one common mean.
        """
        blocks = self.blocks
        rate = self.rate
        found = np.zeros(self.blocks.windows, dtype=bool)
        noise = np.einsum(
            "wai,wi->wa", gain**2, np.where(variance < ABSENT_VARIANCE, variance, 0.0)
        )
        level = levels(blocks.samples, self.sampled, self.axes)
        quiet = level < REST_RATIO * np.average(level[self.floor.windows])
        unlearned = np.full(3, UNLEARNED**2 if known else 0.05**2)
        for w in (
            np.flatnonzero(quiet & (blocks.size == REST_BLOCKS))
            if blocks.windows > 1
            else ()
        ):
            rows = slice(blocks.start[w], blocks.start[w] + REST_BLOCKS)
            there = self.used[rows]
            if there.mean() >= PRESENT:
                # A block that is missing shows no motion.
                part = np.where(
                    there[:, None], rate[rows], rate[rows][there].mean(axis=0)
                )
                found[w] = rests(
                    part, REST_BLOCKS - 1, noise[w], unlearned, REST_STD**2
                )
        if not found.any():
            return found
        mean = np.add.reduceat(rate, blocks.start, axis=0) / REST_BLOCKS
        limit = SAME_REST * np.sqrt(noise / REST_BLOCKS + REST_STD**2)
        apart = np.abs(mean - np.median(mean[found], axis=0))
        found &= (apart < limit).all(axis=1)
        # Noise may hide the beginning of a motion: drop rest windows beside motion.
        before = np.append(True, found[:-1])
        after = np.append(found[1:], True)
        found &= before & after
        return found & (float(found.sum()) * REST_BLOCKS * blocks.length >= LONG_TIME)

    def _find_evidence(
        self, sensors: Priors, delay: Array, y: Array, acceleration: Array
    ) -> tuple[NormalEquations, NormalEquations]:
        """Return the evidence in blocks y (B, n), complete and without vibration."""
        axes = self.axes
        variance = self.variance
        n = len(self.axes)
        coefficients, prior = coefficients_of(sensors, axes)
        moving = (~self.still[self.window])[:, None]
        one = np.ones((len(y), 1))
        base = np.hstack([one, self.rate * moving, acceleration * moving])
        base = base * self.used[:, None]
        # In motion A H = 0. Subtracting the rate first avoids the rounding error.
        residual = (y - (self.rate * moving) @ axes.T) * self.used[:, None]
        moments = self._by_window(base, base)
        cross = self._by_window(base, residual)
        count = np.add.reduceat(self.used, self.blocks.start) * ~self.still
        moments = self._without_noise(moments, count)
        a = information(variance, axes)
        a[self.still] = _at_rest(variance[self.still], axes)
        expected = (sensors.delay - delay)[1:]
        of_axes = (sensors.axes - axes).ravel()
        start = np.concatenate([np.zeros(n), of_axes, expected, np.zeros(n)])
        prior = np.concatenate([prior, np.full(n, BIAS_RATE.prior)])
        flat = coefficients.reshape(-1, n * BASE)

        def summed(moments: Array, cross: Array) -> NormalEquations:
            normal, right = self._sums(flat, a, moments, cross)
            apart = np.diff(self.middle, append=self.middle[-1])
            return NormalEquations(n, normal, right, apart, prior, start)

        kept = self._beyond_vibration(moments, count)
        return summed(moments, cross), summed(kept @ moments, kept @ cross)

    def _without_noise(self, moments: Array, count: Int) -> Array:
        """Return moments (W, 7, 7) without the noise power of rate and acceleration."""
        axes = self.axes
        of_rate = np.einsum("ia,wi,ib->wab", axes, 1.0 / self.variance, axes)
        noise = count[:, None, None] * np.linalg.inv(of_rate)
        moments[:, 1:4, 1:4] -= noise
        moments[:, 4:7, 4:7] -= noise / (2.0 * self.blocks.length**2)
        return positive_part(moments)

    def _sums(
        self, flat: Array, a: Array, moments: Array, cross: Array
    ) -> tuple[Array, Array]:
        """Sum N (K, s, s) and r (K, s) over joined windows.

        ``flat`` (s, 7 n): coefficients of the states, ``a`` (W, n, n): information,
        ``moments`` (W, 7, 7) and ``cross`` (W, 7, n). The change of the biases is
        added as states of its own: the bias is b + (t - mean t) g.
        """
        n = len(self.axes)
        size = (len(self.groups), len(flat))
        normal = np.zeros((*size, len(flat)))
        right = np.zeros(size)
        for k, group in enumerate(self.groups):
            # (n, n, 7, 7): sum of the products of A and s s'.
            of_windows = a[group].reshape(-1, n * n).T
            products = of_windows @ moments[group].reshape(-1, BASE * BASE)
            products = products.reshape(n, n, BASE, BASE).transpose(0, 2, 1, 3)
            normal[k] = flat @ products.reshape(n * BASE, n * BASE) @ flat.T
            of_group = np.swapaxes(cross[group], 1, 2)
            weighted = (a[group] @ of_group).sum(axis=0)
            right[k] = flat @ weighted.reshape(-1)
        since = (self.middle - self.middle.mean())[:, None, None]
        rates = since * normal[:, :n]
        squares = since**2 * normal[:, :n, :n]
        whole = np.block([[normal, np.swapaxes(rates, 1, 2)], [rates, squares]])
        return whole, np.hstack([right, since[:, 0] * right[:, :n]])

    def _beyond_vibration(self, moments: Array, count: Int) -> Array:
        """Return the part (W, 7, 7) of moments M (W, 7, 7) beyond vibration: M (M + K)^-1.

        K is W count^2 min(U, s^2), here times the largest share e^2 of vibration in the
        variance of a channel (docs/calibration.md, "Vibration").
        """
        variance = self.variance
        moving = ~self.rest
        at_rest = (
            np.median(variance[self.rest], axis=0)
            if self.rest.any()
            else np.zeros(len(self.axes))
        )
        there = (variance < ABSENT_VARIANCE / 2) & moving[:, None]
        beyond = np.where(there, np.maximum(variance - at_rest, 0.0), 0.0)
        share = (beyond / variance).max(axis=1)[:, None]
        most = np.zeros((len(moments), BASE))
        along = self.axes**2 * beyond[:, :, None]
        most[:, 1:4] = along.max(axis=1) / UNEQUAL**2
        # Differences of two blocks hold at most half of the power.
        most[:, 4:7] = (
            0.5 * most[:, 1:4].max(axis=1, keepdims=True) / self.blocks.length**2
        )
        square = np.einsum("wkk->wk", moments) / np.maximum(count, 1)[:, None]
        off = moving.sum() * count[:, None] ** 2 * share * np.minimum(most, square)
        # A signal that is not there has neither.
        whole = moments + np.eye(BASE) * np.maximum(off, 1e-12)[:, :, None]
        return np.asarray(np.swapaxes(np.linalg.solve(whole, moments), 1, 2))

    def nonlinearity(self, sensors: Priors, axes: Array, bias: Array) -> Nonlinearity:
        """Measure the nonlinearity in the rate, with axes (n, 3) and mean biases (n,), rad/s."""
        window = self.window
        # Only blocks in which no channel is absent.
        rows = self.used & ~self.rest[window] & self.present[window].all(axis=1)
        rate = self.rate[rows]
        return measure(
            self.blocks.mean[rows] - bias - rate @ axes.T,
            rate,
            self.blocks.seconds[rows],
            self.variance,
            window[rows],
            axes,
            sensors.bias_std,
            sensors.scale_std,
        )

    def colours(self, axes: Array) -> Array:
        """Return the variance (2, n) of longer means over white noise, at least 1.

        The first row is at rest, the second in motion.
        """
        blocks = self.blocks
        n = len(axes)
        found = np.ones((2, len(axes)))
        full = self.present.all(axis=1) & (blocks.size == REST_BLOCKS)
        full &= np.logical_and.reduceat(self.used, blocks.start)
        for regime, windows in enumerate((full & self.rest, full & ~self.rest)):
            chosen = np.flatnonzero(windows)
            if len(chosen) < COLOUR_WINDOWS:
                continue
            rows = blocks.start[chosen][:, None] + np.arange(REST_BLOCKS)
            t = np.einsum(
                "wij,wbj->wbi",
                information(self.variance[chosen], axes),
                blocks.mean[rows],
            )
            means = t.reshape(len(chosen), -1, SUBS, n).mean(axis=2)
            short = t.var(axis=1, ddof=1).sum(axis=0)
            long = means.var(axis=1, ddof=1).sum(axis=0)
            found[regime] = np.maximum(SUBS * long / np.maximum(short, 1e-30), 1.0)
        return found


def spanning(present: Mask, axes: Array) -> Mask:
    """Return the windows (W,) whose channels, present (W, n), span three dimensions."""
    found = np.zeros(len(present), dtype=bool)
    patterns, which = np.unique(present, axis=0, return_inverse=True)
    for k, pattern in enumerate(patterns):
        found[which.ravel() == k] = spans_space(axes[pattern])
    return found


def _at_rest(variance: Array, axes: Array) -> Array:
    """Work out A (..., n, n) where the rate is known to be zero but for `REST_STD`."""
    weighted = axes / variance[..., :, None]
    normal = axes.T @ weighted + np.eye(3) / REST_STD**2
    solved = np.linalg.solve(normal, np.swapaxes(weighted, -1, -2))
    return np.asarray(np.eye(len(axes)) / variance[..., :, None] - weighted @ solved)


def coefficients_of(sensors: Priors, axes: Array) -> tuple[Array, Array]:
    """Return coefficients (states, n, 7) and priors (states,) of the kinds in `ESTIMATED`."""
    n, (layout,) = len(axes), allocate(Layout)
    priors: dict[str, float | Array] = {
        "bias": sensors.bias_std,
        "scale": sensors.scale_std,
        "delay": sensors.delay_std,
        "asymmetry": 0.0,
    }
    prepare_layout(layout, axes, sensors.unit, sensors.units, priors, {"bias": 0.0})
    # Each of the base alone: rates, and accelerations along the channels.
    signals = np.zeros((BASE, n, SIGNALS))
    rates = np.eye(BASE, 3, -1)
    accelerations = np.hstack([np.zeros((n, 4)), axes]).T.copy()
    for k in range(BASE):
        fill_signals(layout, rates[k], accelerations[k], signals[k])
    signals[1:, :, layout["by"] == ONE] = 0.0
    shown = [
        p
        for kind in ESTIMATED
        for places in places_of(kind, n, sensors.units)
        for p in places
    ]
    order = {place: k for k, place in enumerate(shown)}
    coefficients = np.zeros((len(shown), n, BASE))
    for i, k in np.ndindex(n, SIGNALS):
        if (place := int(layout["place"][i, k])) in order:
            coefficients[order[place], i] += signals[:, i, k]
    return coefficients, np.asarray(layout["prior"][shown])


def misfit(of: NormalEquations, found: Smoothed) -> float:
    """Return the scatter of single windows about the constants over its expectation."""
    n = of.n
    constants = np.tile(found.constant, (len(of.normal), 1))
    x = np.hstack([found.curve, constants]) / of.prior
    residual = (of.right - np.einsum("kij,kj->ki", of.normal, x))[:, n:]
    covariance = found.constant_covariance / np.outer(of.prior[n:], of.prior[n:])
    shown = float(np.einsum("ki,ij,kj->", residual, covariance, residual))
    expected = float(np.einsum("kij,ji->", of.normal[:, n:, n:], covariance))
    return max(shown / max(expected, 1e-12), 1.0)
