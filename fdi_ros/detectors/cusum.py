"""Cumulative sums: drift and steps too small for one sample."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Array, Detector, Mask, Verdict
from fdi_ros.detectors.explanation import Explanation
from fdi_ros.detectors.hypotheses import whitened_directions
from fdi_ros.detectors.running_sum import Integers, bounded_sums, threshold_for
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform
from fdi_ros.model.thresholds import false_alarm_probability

QUANTUM = 2.0**24
"""Whole units in one standard deviation."""
LARGEST = 2.0**18
"""Standard deviations above which a sample is scaled down as a whole, so that sums of samples fit 64 bits."""
MIN_SHIFT, MAX_SHIFT = 0.05, 3.0
SYSTEMATIC = 3.0
"""Standard deviations of bias, scale and timing errors that are taken for no fault, however long they last."""
DEFAULT_RUN_LENGTH, MAX_RUN_LENGTH = 3.6e8, 1e15


class Memory(NamedTuple):
    """What is kept of the 2 n sums, downward ones first; replaced as a whole, never changed in place."""

    sums: Integers
    """(2 n,) in whole units."""
    since: Integers
    """(2 n, n + 3) added up since the sum left zero, over at most `window` samples: the w0 of the channels, their
    factors and their systematic parts, all in whole units, and how many samples they are; see `Cusum._added`."""
    oldest: int
    """At least the largest of those counts; saves looking for counts at the limit."""


class Cusum(Detector):
    r"""Two running sums a channel, ``max(0, S + w_i - k)`` and ``max(0, S - w_i - k)``, against one threshold.

    w_i is the whitened single-fault statistic of `likelihood_ratio`, ``k = shift / 2`` (Page, *Continuous inspection
    schemes*, 1954). The threshold h follows from the mean run length to a false alarm, shared among both sides
    of all channels that can be told apart, by Siegmund's approximation (`siegmund_run_length`). A shift d of w_i is
    seen after about ``(h + 1.166) / (d - k)`` samples. Sums are kept below 1.5 h, so that a fault
    which ends is forgotten after about h / shift samples, however long it lasted.

    On alarm the sum that is largest sets the onset: the sample after it was last zero. z is averaged
    from there, over `window` samples at most (the first ones), and `Explanation` names the channels that
    explain this average: its noise is that of one sample over the square root of their number. Correlated channels,
    whose sums rise as well, are thus rejected or kept as rivals by the same rule as in `likelihood_ratio`. The
    onset is picked by the data, so the confidence of an isolation is somewhat less than for one sample.

    Bias left after its correction (`bias_std`) and errors of scale factor and sampling instant are no white noise:
    they keep their sign, for ever or while the motion lasts, and would add up to an alarm. So k grows by
    `SYSTEMATIC` times the standard deviation that they have in w in that sample: only what they do not explain
    counts, and the run length is at least the one asked for. It follows that a short average at start-up limits the
    drift that can be found: a mean w below k never is. A calibrated bias, or a longer average, is better. In
    the average, the same part is taken to be the same in all samples.

    Noise that depends on rate and acceleration: w is whitened sample by sample, and so a fault, which passes for rate
    in the statistics of the other channels, shrinks them. For the average, the whole sample is divided by
    one factor instead, the largest standard deviation that any channel's statistic has in it.

    Good at: small constant errors, slow drift, with an estimate of when it began. Bad at: noise that is not white;
    drift that shows in motion alone; isolated spikes (one far beyond h alarms for h / shift samples).

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a sound channel.
    shift
        Mean shift of w_i that is to be found soonest, in standard deviations of w_i, 0.05 to 3.
    run_length
        Mean samples to a false alarm of the whole detector, 2 to 1e15; default 3.6e8 (1e-3 an hour at 100 Hz).
    false_alarms_per_hour
        The other way to give it, with `sample_rate`.
    sample_rate
        Hz.
    confidence
        With which rivals are rejected, above 0.5 and below 1.

    Notes
    -----
    `scores`: the larger of a channel's two sums. `samples_since_onset` is the onset estimate.
    """

    name = "cusum"

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        shift: float = 0.5,
        run_length: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
        confidence: float = 0.999,
    ) -> None:
        if not MIN_SHIFT <= shift <= MAX_SHIFT:
            raise ConfigError(f"shift is {shift:g} standard deviations, expected {MIN_SHIFT:g} to {MAX_SHIFT:g}")
        self.run_length = _run_length(run_length, false_alarms_per_hour, sample_rate)
        options = {"shift": shift, "run_length": self.run_length, "confidence": confidence}
        super().__init__(geometry, noise, options)
        h = _threshold(geometry, self.noise, shift / 2, self.run_length)
        self._shift = shift
        self._limit = max(round(h * QUANTUM), 1)
        self._cap = self._limit + self._limit // 2
        self.threshold = self._limit / QUANTUM
        self.window = math.ceil(16 * h / shift) + 1
        """Samples after the onset, at most, that the naming of the channel rests on."""
        self._per_sample = None if self.noise.constant else Explanation(geometry, self.noise, confidence)
        self._explanation = Explanation(geometry, NoiseModel(self.noise.noise_std), confidence)
        whitening = self._explanation.whitened(np.eye(geometry.n), None)
        self._whitening = np.ascontiguousarray(whitening)
        self._gain = np.ascontiguousarray(geometry.least_squares.T)
        self._squares = np.ascontiguousarray(whitening**2)
        self._bias: Array = transform(self._squares, (self.noise.bias_std**2)[None])
        reference = _whole(np.minimum(shift / 2 + SYSTEMATIC * np.sqrt(self._bias), LARGEST))
        self._reference = np.concatenate([reference, reference], axis=1)
        self._resting = self._added(np.zeros((1, geometry.n)), np.ones((1, 1)), self._bias)[0, -3:]
        self._unwhitening: Array = np.asarray(np.linalg.pinv(whitening, rcond=1e-9), dtype=np.float64)
        self._unseen = None if geometry.detectable.all() else ~geometry.detectable
        self.reset()

    def reset(self) -> None:
        """Forget all samples seen."""
        super().reset()
        n = self.geometry.n
        self._memory = Memory(np.zeros(2 * n, dtype=np.int64), np.zeros((2 * n, n + 3), dtype=np.int64), 0)

    def samples_since_onset(self) -> NDArray[np.int64]:
        """Return the samples since each channel's drift is estimated to have begun, as of the last judged, (n,).

        0: no drift. At most `window`: that long or longer. Of a channel's two sums the larger counts.
        """
        memory: Memory = self._memory
        down, up = memory.sums.reshape(2, -1)
        count_down, count_up = memory.since[:, -1].reshape(2, -1)
        return np.where(up >= down, count_up, count_down)

    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        rows, n = z.shape
        steps, added = self._steps(z, acceleration)
        sums, since = self._advance_one(steps[0], added[0]) if rows == 1 else self._advance(steps.T, added.T)
        scores = np.maximum(sums[:n], sums[n:]).T / QUANTUM
        statistic = np.maximum.reduce(scores, axis=1)
        alarm = statistic >= self.threshold
        suspects, isolated, error = np.zeros((rows, n), dtype=bool), np.zeros(rows, dtype=bool), np.zeros((rows, n))
        if len(since):
            suspects[alarm], isolated[alarm], error[alarm] = self._name(since)
        if self._unseen is not None:
            scores[:, self._unseen] = np.nan
        return Verdict(statistic, np.full(rows, self.threshold), alarm, suspects, isolated, error, scores)

    def _steps(self, z: Array, acceleration: Array | None) -> tuple[Integers, Integers]:
        """Return the steps of the sums, (N, 2 n), and what `_added` gives, (N, n + 3), for samples z (N, n)."""
        plain = transform(self._whitening, z)
        if self._per_sample is None and np.maximum.reduce(np.abs(plain), axis=None) <= LARGEST:
            return self._constant_steps(_whole(plain))
        variance: Array = np.ones((1, 1))
        w = plain
        if self._per_sample is not None:
            w = self._per_sample.whitened(z, acceleration)
            errors = self.noise.variance(self.geometry, transform(self._gain, z), acceleration)
            # Of w0 by all errors; by noise_std alone it is 1.
            variance = np.maximum(transform(self._squares, errors), 1.0)
        systematic = variance - 1 + self._bias
        reference = self._shift / 2 + SYSTEMATIC * np.sqrt(systematic / variance)
        whole = _whole(w * np.minimum(1.0, LARGEST / np.maximum(_largest(np.abs(w)), 1.0)))
        less = _whole(np.minimum(reference, LARGEST))
        steps = np.concatenate([-whole - less, whole - less], axis=1)
        return steps, self._added(plain, variance, systematic)

    def _constant_steps(self, whole: Integers) -> tuple[Integers, Integers]:
        """As `_steps`, for constant noise and no sample too large, from w in whole units: what is usual, made quick."""
        added = np.empty((len(whole), self.geometry.n + 3), dtype=np.int64)
        added[:, :-3], added[:, -3:] = whole, self._resting
        return np.concatenate([-whole, whole], axis=1) - self._reference, added

    def _added(self, plain: Array, variance: Array, systematic: Array) -> Integers:
        """Return what the naming rests on, of each sample: (N, n + 3) whole units, the last column ones.

        w0 (N, n), whitened for constant noise, times one factor, so that the proportions that name the channel stay;
        the factor, which makes the variance of w0 at most 1; the standard deviation of its systematic part.
        """
        rows, n = plain.shape
        added = np.zeros((rows, n + 3))
        size = np.maximum(_largest(np.abs(plain)), 1.0)
        factor = np.minimum(1 / np.sqrt(_largest(variance)), LARGEST / size)
        added[:, :n] = plain * factor
        added[:, n : n + 1] = factor
        added[:, n + 1 : n + 2] = np.minimum(factor * np.sqrt(_largest(systematic)), LARGEST)
        whole = _whole(added)
        whole[:, -1] = 1
        return whole

    def _advance_one(self, steps: Integers, added: Integers) -> tuple[Integers, Integers]:
        """As `_advance`, for one sample: steps (2 n,), added (n + 3,)."""
        old: Memory = self._memory
        sums = old.sums + steps
        np.maximum(sums, 0, out=sums)
        np.minimum(sums, self._cap, out=sums)
        since, oldest = old.since + added, old.oldest + 1
        if oldest > self.window:
            since = np.where(old.since[:, -1:] < self.window, since, old.since)
            oldest = int(since[:, -1].max())
        since *= (sums > 0)[:, None]
        self._memory = Memory(sums, since, oldest)
        largest = sums.argmax()
        return sums[:, None], since[largest : largest + 1] if sums[largest] >= self._limit else since[:0]

    def _advance(self, steps: Integers, added: Integers) -> tuple[Integers, Integers]:
        """Return sums (2 n, N) after steps (2 n, N), and `Memory.since` (K, n + 3) of the largest at alarms."""
        old: Memory = self._memory
        n, rows = self.geometry.n, steps.shape[1]
        sums = bounded_sums(old.sums, steps, self._cap)
        alarm = np.flatnonzero(sums.max(axis=0) >= self._limit)
        # The state of every sum at the end, then that of the largest sum at each alarm.
        which = np.concatenate([np.arange(2 * n), sums[:, alarm].argmax(axis=0)])
        at = np.concatenate([np.full(2 * n, rows - 1), alarm])
        last_zero = np.maximum.accumulate(np.where(sums == 0, np.arange(rows), -1), axis=1)[which, at]
        carried = np.where((last_zero < 0)[:, None], old.since[which], 0)
        total = np.zeros((n + 3, rows + 1), dtype=np.int64)
        np.add.accumulate(added, axis=1, out=total[:, 1:])
        stop = np.minimum(at, last_zero + self.window - carried[:, -1]) + 1
        since = carried + (total[:, stop] - total[:, last_zero + 1]).T
        end = since[: 2 * n]
        self._memory = Memory(sums[:, -1].copy(), end, int(end[:, -1].max()))
        return sums, since[2 * n :]

    def _name(self, since: Integers) -> tuple[Mask, Mask, Array]:
        """Suspects (K, n), isolated (K,) and errors (K, n) rad/s from the largest sum's `Memory.since`."""
        factor, systematic, count = np.split(since[:, -3:].astype(np.float64), 3, axis=1)
        # The variance of the average is at most 1 / count + (mean systematic part)^2: over its root, that of a sample.
        mean_part = systematic / (QUANTUM * count)
        root = 1 / np.sqrt(1 / count + mean_part * mean_part)
        w = since[:, :-3] / (QUANTUM * count) * root
        suspects, isolated, error = self._explanation.explain(transform(self._unwhitening, w), None)
        return suspects, isolated, error / root * (QUANTUM * count / np.maximum(factor, 1.0))


def _whole(figures: Array) -> Integers:
    return np.rint(figures * QUANTUM).astype(np.int64)


def _largest(figures: Array) -> Array:
    """Largest of each row, (N, k) to (N, 1)."""
    return np.maximum.reduce(figures, axis=1, keepdims=True)


def _run_length(samples: float | None, per_hour: float | None, sample_rate: float | None) -> float:
    if samples is not None and per_hour is not None:
        raise ConfigError("give run_length or false_alarms_per_hour, not both")
    if per_hour is not None:
        samples = 1 / false_alarm_probability(None, per_hour, sample_rate)
    samples = DEFAULT_RUN_LENGTH if samples is None else samples
    if not 2 <= samples <= MAX_RUN_LENGTH:
        raise ConfigError(f"run_length is {samples:g} samples, expected 2 to {MAX_RUN_LENGTH:g}")
    return samples


def _threshold(geometry: Geometry, noise: NoiseModel, reference: float, run_length: float) -> float:
    directions = whitened_directions(geometry, noise)
    seen = np.flatnonzero(geometry.detectable).tolist()
    first = [seen.index(group[0]) for group in geometry.groups if group[0] in seen]
    rho = directions[first] @ directions[first].T
    return threshold_for(run_length, reference, np.block([[rho, -rho], [-rho, rho]]))
