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
from fdi_ros.estimator.rest import QUIET, REST_STD, UNLEARNED, rests
from fdi_ros.estimator.shared_noise import UNEQUAL
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
    smooth,
)

#: of scale error and misalignment before anything is shown, in each component: 0.5 %
#: and 0.5 deg
SCALE_STD = 0.008
PASSES = 12
TRUSTING = PASSES // 3
"""First passes, which take all motion for motion, because unknown delays and scale
errors look like vibration.
"""
#: change of delays, s, and relative change of axes, below which a pass has settled
SETTLED = 2e-5
#: s, a tenth of a sample at 100 Hz: of a delay, error that is small, and change that
#: moves no bias
SHOWN_DELAY = 0.001
#: s
LARGEST_DELAY = PARAMETERS["imus.delays"].high
#: largest change of a delay in one pass, s, as slopes hold for nearby motion only
STEP_DELAY = 2.0 * UNIT_DELAY
#: windows are joined down to this number
MOST_STEPS = 400
#: variance of a channel that is not there, (rad/s)^2
ABSENT = 1e12
#: largest distance between means of windows at rest, in standard deviations
ALIKE = 5.0
#: walk of biases that show none, rad/s/sqrt(s)
USUAL_WALK = 2e-5
#: axes that are farther off than expected by so much are known less: once in 60 by
#: chance, of two units
WIDER = 1.5
#: fewest blocks for the noise of a window, and blocks per mean for its colour
LEAST_BLOCKS = SUBS = 5
#: one, the rate, the angular acceleration
BASE = 7
#: kinds of error states, whose signals are linear in these
ESTIMATED = (
    "bias",
    "scale",
    "delay",
)
(BIAS_RATE,) = (kind for kind in ERROR_KINDS if kind.feeds == "bias")


@dataclass(frozen=True)
class Priors:
    """Quantities to estimate, with their prior knowledge."""

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

    def disagreement(self) -> tuple[float, float]:
        """Remaining scale error between channels, rms of all components, and its uncertainty.

        Errors common to all channels turn or scale the body frame, and no channel
        contradicts them.
        """
        apart = np.kron(projector(self.axes), np.eye(3))
        left = apart @ self.axes_covariance @ apart
        count = 3 * (len(self.axes) - 3)
        rms = float(np.sqrt(max(float(np.trace(left)) / count, 1e-18)))
        return rms, float(np.sqrt(2.0 * np.sum(left * left)) / count / (2.0 * rms))


def estimate(data: Data, sensors: Priors) -> StateEstimate:
    """Estimate all states from a recording."""
    n, units = len(sensors.axes), sensors.units
    motion = (
        3 * n + units - 1
    )  # of the constants, the first are those that motion shows
    axes, biases, colour, priors = (
        sensors.axes.copy(),
        np.zeros((1, n)),
        np.ones((2, n)),
        sensors,
    )
    taken, moved = (
        np.zeros(units),
        np.inf,
    )  # delays that are off the blocks, and by how much they were to be others
    blocks = make_blocks(data, taken[sensors.unit])
    walk: RandomWalk | None = None
    for number in range(PASSES):
        one = _Pass(blocks, priors, axes, taken, biases, number > 1, colour)
        if number > 1 and (
            number == PASSES - 1 or (walk is None and moved < SHOWN_DELAY)
        ):
            walk = find_random_walk(one.evidence)
        usual = (
            USUAL_WALK if walk is None else walk.value or min(walk.possible, USUAL_WALK)
        )
        shown = smooth(one.careful if number >= TRUSTING else one.evidence, usual)
        found = smooth(
            one.evidence,
            usual,
            (shown.constant[:motion], shown.constant_covariance[:motion, :motion]),
        )
        scale = found.constant[: 3 * n].reshape(n, 3)
        step = np.append(
            0.0, np.clip(found.constant[3 * n : motion], -STEP_DELAY, STEP_DELAY)
        )
        axes = axes + scale
        delay, biases = (
            np.clip(taken + step, -LARGEST_DELAY, LARGEST_DELAY),
            one.curve_of(found),
        )
        colour = one.colours(axes)
        moved = float(np.abs(delay - taken).max())
        if (
            number > TRUSTING
            and walk is not None
            and moved < SETTLED
            and np.abs(scale).max() < SETTLED
        ):
            break
        if moved > SETTLED:
            taken = delay
            blocks = make_blocks(data, taken[sensors.unit])
        # Where the axes are farther off than was supposed, they are not known as well either.
        off = axes - sensors.axes
        apart = off - axes @ (np.linalg.pinv(axes) @ off)
        size = float(np.sqrt((apart**2).sum() / (3 * (n - 3))))
        times = size / max(float(np.median(sensors.scale_std)), 1e-9)
        priors = replace(
            sensors,
            scale_std=sensors.scale_std
            * (times if times > WIDER and number >= TRUSTING else 1.0),
        )
    assert walk is not None
    covariance = found.constant_covariance * misfit(one.careful, shown)
    # No less is known than before.
    known = np.minimum(1.0, one.careful.prior[n:] / np.sqrt(np.diag(covariance)))
    covariance = covariance * np.outer(known, known)
    delay_std = np.append(0.0, np.sqrt(np.diag(covariance)[3 * n : motion]))
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


class _Pass:
    """One linearisation: rest, rate and noise of every window, and evidence for the states.

    ``delay`` (units,): taken off the blocks, s. ``axes`` (n, 3). ``biases`` (K, n): of
    joined windows, rad/s. ``known``: whether the biases come from an earlier pass.
    ``colour`` (2, n): variance of longer means over that of white noise, at rest and in
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
        self.blocks, self.axes, self.window = blocks, axes, blocks.window
        finite = np.isfinite(blocks.mean)
        present = (
            np.add.reduceat(finite, blocks.start, axis=0)
            >= PRESENT * blocks.size[:, None]
        )
        # Blocks (B,) with all channels that are present in their window.
        self.used: Mask = np.asarray((finite | ~present[self.window]).all(axis=1))
        y = np.where(finite & present[self.window], blocks.mean, 0.0)
        count = np.add.reduceat(self.used, blocks.start)
        mean = (
            np.add.reduceat(y * self.used[:, None], blocks.start, axis=0)
            / np.maximum(count, 1)[:, None]
        )
        apart = (y - mean[self.window]) * self.used[:, None]
        covariance = (
            self._by_window(apart, apart) / np.maximum(count - 1, 1)[:, None, None]
        )
        enough = count >= LEAST_BLOCKS
        # (W, n), the second for channels with usable single samples.
        self.present = present & enough[:, None]
        self.sampled = (
            self.present
            & np.isfinite(np.einsum("wii->wi", blocks.samples))
            & (blocks.count > 3)[:, None]
        )
        moment = of_the_moment(covariance, self.present, axes)
        self.floor = find_floor(blocks.samples, blocks.count, self.sampled, axes)
        steady = np.where(self.present, moment, ABSENT)
        # Expand the biases of joined windows to all windows.
        bias = np.repeat(biases, -(-blocks.windows // len(biases)), axis=0)[
            : blocks.windows
        ]
        gain = gains(steady, axes)
        self.rate: Array = np.einsum(
            "bai,bi->ba", gain[self.window], y - bias[self.window]
        )
        self.rest = self._find_rest(gain, steady, known)
        # (W, n) of a block, (rad/s)^2, coloured noise counted in.
        factor = np.where(self.rest[:, None], colour[0], colour[1])
        self.variance: Array = np.where(self.present, moment * factor, ABSENT)
        # Angular acceleration, rad/s^2, 0 where unknown.
        acceleration, inside = (
            np.zeros_like(self.rate),
            np.zeros(len(self.rate), dtype=bool),
        )
        span = blocks.seconds[2:] - blocks.seconds[:-2]
        inside[1:-1] = (span < 2.5 * blocks.length) & self.used[2:] & self.used[:-2]
        acceleration[1:-1] = (self.rate[2:] - self.rate[:-2]) / span[:, None]
        self.used = self.used & (inside | self.rest[self.window]) & enough[self.window]
        each = -(-blocks.windows // MOST_STEPS)
        self.groups = [
            slice(first, first + each) for first in range(0, blocks.windows, each)
        ]
        self.middle: Array = np.array(
            [blocks.time[group].mean() for group in self.groups]
        )
        self.times = (
            blocks.time[0] + self.middle - self.middle[0]
        )  # (K,) of the joined windows, s from the first
        self.evidence, self.careful = self._find_evidence(
            sensors, delay, y, acceleration * inside[:, None]
        )

    def curve_of(self, found: Smoothed) -> Array:
        """Biases (K, n) over time, rad/s."""
        trend = found.constant[-found.curve.shape[1] :]
        return np.asarray(found.curve + np.outer(self.times - self.times.mean(), trend))

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
        blocks, rate, found = (
            self.blocks,
            self.rate,
            np.zeros(self.blocks.windows, dtype=bool),
        )
        noise = np.einsum(
            "wai,wi->wa", gain**2, np.where(variance < ABSENT, variance, 0.0)
        )
        level = levels(blocks.samples, self.sampled, self.axes)
        quiet = level < QUIET * np.average(level[self.floor.windows])
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
        limit = ALIKE * np.sqrt(noise / REST_BLOCKS + REST_STD**2)
        found &= (np.abs(mean - np.median(mean[found], axis=0)) < limit).all(axis=1)
        # Beside motion its beginning is hidden by the noise.
        found &= np.append(True, found[:-1]) & np.append(found[1:], True)
        return found & (float(found.sum()) * REST_BLOCKS * blocks.length >= LONG_TIME)

    def _find_evidence(
        self, sensors: Priors, delay: Array, y: Array, acceleration: Array
    ) -> tuple[NormalEquations, NormalEquations]:
        """Return the evidence in blocks y (B, n), complete and without vibration."""
        blocks, axes, variance, rest, n = (
            self.blocks,
            self.axes,
            self.variance,
            self.rest,
            len(self.axes),
        )
        coefficients, prior = coefficients_of(sensors, axes)
        moving = (~rest[self.window])[:, None]
        base = (
            np.hstack([np.ones((len(y), 1)), self.rate * moving, acceleration * moving])
            * self.used[:, None]
        )
        # In motion A H = 0. Subtracting the rate first avoids the rounding error.
        residual = (y - (self.rate * moving) @ axes.T) * self.used[:, None]
        moments, cross = self._by_window(base, base), self._by_window(base, residual)
        # The noise power of rate and acceleration is subtracted.
        count = np.add.reduceat(self.used, blocks.start) * ~rest
        noise = count[:, None, None] * np.linalg.inv(
            np.einsum("ia,wi,ib->wab", axes, 1.0 / variance, axes)
        )
        moments[:, 1:4, 1:4] -= noise
        moments[:, 4:7, 4:7] -= noise / (2.0 * blocks.length**2)
        values, vectors = np.linalg.eigh(moments)
        moments = np.einsum(
            "wab,wb,wcb->wac", vectors, np.maximum(values, 0.0), vectors
        )
        a = information(variance, axes)
        a[rest] = _at_rest(variance[rest], axes)
        start = np.concatenate(
            [np.zeros(n), (sensors.axes - axes).ravel(), -delay[1:], np.zeros(n)]
        )
        prior = np.concatenate([prior, np.full(n, BIAS_RATE.prior)])
        flat = coefficients.reshape(-1, n * BASE)

        def summed(moments: Array, cross: Array) -> NormalEquations:
            normal, right = (
                np.zeros((len(self.groups), len(flat), len(flat))),
                np.zeros((len(self.groups), len(flat))),
            )
            for k, group in enumerate(self.groups):
                # (n, n, 7, 7): sum of the products of A and s s'.
                products = a[group].reshape(-1, n * n).T @ moments[group].reshape(
                    -1, BASE * BASE
                )
                products = (
                    products.reshape(n, n, BASE, BASE)
                    .transpose(0, 2, 1, 3)
                    .reshape(n * BASE, n * BASE)
                )
                normal[k] = flat @ products @ flat.T
                right[k] = flat @ (a[group] @ np.swapaxes(cross[group], 1, 2)).sum(
                    axis=0
                ).reshape(-1)
            # A steady change is a state of its own: the bias is b + (t - mean t) g.
            since = (self.middle - self.middle.mean())[:, None, None]
            rates = since * normal[:, :n]
            whole = np.block(
                [
                    [normal, np.swapaxes(rates, 1, 2)],
                    [rates, since**2 * normal[:, :n, :n]],
                ]
            )
            rights = np.hstack([right, since[:, 0] * right[:, :n]])
            apart = np.diff(self.middle, append=self.middle[-1])
            return NormalEquations(n, whole, rights, apart, prior, start)

        kept = self._beyond_vibration(moments, count)
        return summed(moments, cross), summed(kept @ moments, kept @ cross)

    def _beyond_vibration(self, moments: Array, count: Int) -> Array:
        """Return the part (W, 7, 7) of moments M (W, 7, 7) beyond vibration: M (M + K)^-1.

        K is W count^2 min(U, s^2) in units of e^2 (docs/calibration.md, "What vibration
        explains").
        """
        variance, moving = self.variance, ~self.rest
        at_rest = (
            np.median(variance[self.rest], axis=0)
            if self.rest.any()
            else np.zeros(len(self.axes))
        )
        there = (variance < ABSENT / 2) & moving[:, None]
        beyond = np.where(there, np.maximum(variance - at_rest, 0.0), 0.0)
        share = (beyond / variance).max(axis=1)[:, None]
        most = np.zeros((len(moments), BASE))
        most[:, 1:4] = (self.axes**2 * beyond[:, :, None]).max(axis=1) / UNEQUAL**2
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
        """Measure what is not linear in the rate, with axes (n, 3) and mean biases (n,), rad/s."""
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
        blocks, n, found = self.blocks, len(axes), np.ones((2, len(axes)))
        full = self.present.all(axis=1) & (blocks.size == REST_BLOCKS)
        full &= np.logical_and.reduceat(self.used, blocks.start)
        for regime, windows in enumerate((full & self.rest, full & ~self.rest)):
            chosen = np.flatnonzero(windows)
            if len(chosen) < LEAST_BLOCKS:
                continue
            rows = blocks.start[chosen][:, None] + np.arange(REST_BLOCKS)
            t = np.einsum(
                "wij,wbj->wbi",
                information(self.variance[chosen], axes),
                blocks.mean[rows],
            )
            means = t.reshape(len(chosen), -1, SUBS, n).mean(axis=2)
            short, long = (part.var(axis=1, ddof=1).sum(axis=0) for part in (t, means))
            found[regime] = np.maximum(SUBS * long / np.maximum(short, 1e-30), 1.0)
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
    rates, accelerations = (
        np.eye(BASE, 3, -1),
        np.hstack([np.zeros((n, 4)), axes]).T.copy(),
    )
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
    x = (
        np.hstack([found.curve, np.tile(found.constant, (len(of.normal), 1))])
        / of.prior
    )
    residual = (of.right - np.einsum("kij,kj->ki", of.normal, x))[:, n:]
    covariance = found.constant_covariance / np.outer(of.prior[n:], of.prior[n:])
    shown = float(np.einsum("ki,ij,kj->", residual, covariance, residual))
    expected = float(np.einsum("kij,ji->", of.normal[:, n:, n:], covariance))
    return max(shown / max(expected, 1e-12), 1.0)
