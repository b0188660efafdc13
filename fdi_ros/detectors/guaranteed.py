"""Guaranteeing (set-membership) detection: bounded errors, no statistics, up to two arbitrary channels."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Array, Detector, Mask, Verdict
from fdi_ros.detectors.circuits import circuits
from fdi_ros.errors import ConfigError, DetectorError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform

MAX_CHANNELS = 9
MAX_FAULTS = 2
WITHIN = 1 + 1e-9
"""A check this many times its bound still counts as within it: rounding is no fault."""
WORK = 200_000
"""Numbers held at a time while intervals are formed: what fits the processor's cache."""


class Guaranteed(Detector):
    r"""Intervals that certainly contain each channel's error, and the channels that have certainly failed.

    A sound channel's error is at most its bound b_i; at most `max_faults` channels, any, are arbitrary. For a set F
    of channels left out the admissible rates are ``Q_F = {q : |z_i - h_i q| <= b_i, i not in F}``; the error of
    channel i is ``z_i - h_i q`` over the union of all Q_F (*Determining failures of a redundant inertial sensor unit
    by the guaranteeing estimation method*: its linear programmes and test (10), with the sign lost in print).
    A channel has certainly failed when its whole interval lies beyond ``threshold * b_i``.

    No programme is solved: each is decided at a vertex of its dual, and the vertices are the circuits of the
    axes (see `circuits`), known in advance. A sample whose circuits all keep their bounds needs no fault.

    - `statistic`: the size in bounds of the largest error in the mildest explanation of the sample with at most
      `max_faults` faults. At least one channel is certainly off by that much. inf: no such explanation, the sample
      contradicts `max_faults` (or the bounds). `threshold`: as given. With max_faults = 0 the statistic is the factor
      by which all bounds would have to grow, its threshold 1.
    - `suspects`: channels that have failed in some explanation; `isolated`: each of them has in all. All channels
      when there is no explanation.
    - `scores`: least possible size of each channel's error in bounds; 0 while the sample needs no fault.
    - `error`: midpoint of the interval; 0 where it is unbounded or empty.

    Good at: certainty without statistics, two simultaneous faults, any axes. Bad at: noise without a hard limit (a
    bound of 3 standard deviations is exceeded); the larger the bound the blinder. Faults below about ``threshold``
    bounds stay unseen by choice.

    Parameters
    ----------
    geometry
        Sensitivity axes, 4 to 9 channels.
    noise
        Error model with a `bound`, one for all or one a channel.
    max_faults
        0, 1 or 2, at most n - 4: with fewer than four channels left nothing checks them. Default: as many as n allows.
    threshold
        Size of error that counts as a failure, in bounds, > 0.
    reduce_max_faults
        Whether to lower max_faults to n - 4 instead of refusing it, as is done when channels are absent. The verdict
        then holds for that many faults.
    """

    name = "guaranteed"

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
            raise ConfigError(f"threshold is {threshold:g} bounds, expected finite and > 0")
        self.max_faults = _allowed_faults(geometry.n, max_faults, reduce_max_faults)
        options = {"max_faults": self.max_faults, "threshold": threshold, "reduce_max_faults": True}
        super().__init__(geometry, noise, options)
        if self.noise.bound is None:
            raise DetectorError("guaranteed needs noise.bound (rad/s, > 0): the limit of a sound channel's error")
        self.bound: Array = self.noise.bound
        self.threshold = threshold
        self.sets = tuple(f for size in range(self.max_faults + 1) for f in combinations(range(geometry.n), size))
        """Sets of channels that may be the faulty ones, smallest first; columns of `culprits`."""
        checks = circuits(geometry.axes)
        checks /= (np.abs(checks) * self.bound).sum(axis=1)[:, None]
        self._checks = np.ascontiguousarray(checks.T)
        self._twins = None if geometry.isolable.all() else geometry.group_matrix.astype(np.int64)
        self._prepare_sets(checks)
        self._prepare_intervals(checks)

    def _prepare_sets(self, checks: Array) -> None:
        members = checks != 0
        struck = np.zeros((len(self.sets), self.geometry.n), dtype=bool)
        for k, channels in enumerate(self.sets):
            struck[k, list(channels)] = True
        # A violated check rules out every set that leaves all its members sound: one bit a set.
        untouched = (struck.astype(np.int64) @ members.T) == 0
        self._rules_out = (untouched * (np.uint64(1) << np.arange(len(self.sets), dtype=np.uint64))[:, None]).sum(
            axis=0, dtype=np.uint64
        )
        # Larger sets explain all that their subsets do; the largest suffice for intervals.
        largest = [k for k, channels in enumerate(self.sets) if len(channels) == self.max_faults]
        self._largest_bits = [1 << k for k in largest]
        self._struck = struck[largest]
        weight = np.abs(checks) * self.bound
        faulty, sound = self._struck @ weight.T, ~self._struck @ weight.T
        touched = faulty > 0
        self._gain = np.where(touched, 1 / np.where(touched, faulty, 1.0), 0.0)[:, :, None]
        self._offset = np.where(touched, sound * self._gain[:, :, 0], 0.0)[:, :, None]

    def _prepare_intervals(self, checks: Array) -> None:
        """Table (sets, n, V) of the intervals that a channel's error lies in, by row of `_intervals`."""
        n, count = self.geometry.n, len(checks)
        channel, circuit = np.nonzero(checks.T)
        self._circuit = circuit
        self._slope = (1 / checks[circuit, channel])[:, None]
        by_circuit = np.abs(self._slope[:, 0]) - self.bound[channel]
        self._half = np.concatenate([by_circuit, self.bound, [np.inf]])[:, None]
        row = np.full((n, count), len(circuit) + n)
        row[channel, circuit] = np.arange(len(circuit))
        overlap = (self._struck.astype(np.int64) @ (checks != 0).T)[:, None, :]
        usable = (checks != 0).T & (overlap == self._struck[:, :, None])
        width = max(int(usable.sum(axis=2).max()), 1)
        order = np.argsort(~usable, axis=2, kind="stable")[:, :, :width]
        unbounded = len(circuit) + n
        table = np.where(np.take_along_axis(usable, order, axis=2), row[np.arange(n)[:, None], order], unbounded)
        own = np.where(self._struck, unbounded, len(circuit) + np.arange(n))
        self._table = np.concatenate([own[:, :, None], table], axis=2)
        self._per_set = max(self._table[0].size, count)

    @property
    def isolable(self) -> Mask:
        """Channels whose fault can be named, (n,); none with max_faults = 0, which finds no fault at all."""
        return self.geometry.isolable & (self.max_faults > 0)

    def culprits(self, z: Array) -> Mask:
        """Which of `sets` explain each sample z (N, n), all finite: (N, sets) bool; none: inconsistent."""
        ruled_out = self._ruled_out(np.abs(transform(self._checks, self._checked(z)).T))
        bits = np.uint64(1) << np.arange(len(self.sets), dtype=np.uint64)
        return np.asarray(ruled_out[:, None] & bits == 0)

    def error_bounds(self, z: Array) -> tuple[Array, Array]:
        """Guaranteed interval of every channel's error.

        Parameters
        ----------
        z
            Measured channels, (N, n) rad/s; NaN or infinite: absent from that sample.

        Returns
        -------
        lower (N, n) and upper (N, n), rad/s. Infinite: not limited by the other channels. NaN: the sample
        contradicts `max_faults`, or the channel is absent or cannot be judged.

        Raises
        ------
        DetectorError
            If z does not have n columns.
        """
        z = self._checked(z)
        present = np.isfinite(z)
        if present.all():
            lower, upper, _ = self._explanations(transform(self._checks, z).T)
            return lower.T, upper.T
        lower, upper = np.full(z.shape, np.nan), np.full(z.shape, np.nan)
        patterns, which = np.unique(present, axis=0, return_inverse=True)
        for k, mask in enumerate(patterns):
            detector = self.fewer(mask)
            if isinstance(detector, Guaranteed):
                at = np.ix_(np.flatnonzero(which.reshape(-1) == k), np.flatnonzero(mask))
                lower[at], upper[at] = detector.error_bounds(z[at])
        return lower, upper

    def _checked(self, z: Array) -> Array:
        z = np.asarray(z, dtype=np.float64)
        if z.ndim != 2 or z.shape[1] != self.geometry.n:
            raise DetectorError(f"z has shape {z.shape}, expected (N, {self.geometry.n})")
        return z

    def _ruled_out(self, size: Array) -> NDArray[np.uint64]:
        """Bits of the sets that each sample rules out, (N,), from |checks| (C, N)."""
        return np.bitwise_or.reduce(np.where(size > WITHIN, self._rules_out[:, None], np.uint64(0)), axis=0)

    def _explanations(self, checks: Array) -> tuple[Array, Array, Array]:
        """Lower (n, N), upper (n, N) rad/s and mildest largest error (N,) in bounds, from checks (C, N)."""
        ruled_out = self._ruled_out(np.abs(checks))
        if len(ruled_out) == 1:
            return self._under(int(ruled_out[0]), checks)
        n, rows = self.geometry.n, len(ruled_out)
        lower, upper, mildest = np.empty((n, rows)), np.empty((n, rows)), np.empty(rows)
        # Samples that leave the same sets possible are worked on together.
        for pattern in np.unique(ruled_out):
            at = np.flatnonzero(ruled_out == pattern)
            possible = sum(not int(pattern) & bit for bit in self._largest_bits)
            step = 1 + WORK // (1 + possible * self._per_set)
            for part in (at[start : start + step] for start in range(0, len(at), step)):
                lower[:, part], upper[:, part], mildest[part] = self._under(int(pattern), checks[:, part])
        return lower, upper, mildest

    def _under(self, ruled_out: int, checks: Array) -> tuple[Array, Array, Array]:
        """As `_explanations`, for samples that rule out the same sets."""
        possible = [k for k, bit in enumerate(self._largest_bits) if not ruled_out & bit]
        n, rows = self.geometry.n, checks.shape[1]
        if not possible:
            return np.full((n, rows), np.nan), np.full((n, rows), np.nan), np.full(rows, np.inf)
        table = self._table.take(possible, axis=0)
        low, high = self._intervals(checks)
        lower = np.minimum.reduce(np.maximum.reduce(low.take(table, axis=0), axis=2), axis=0)
        upper = np.maximum.reduce(np.minimum.reduce(high.take(table, axis=0), axis=2), axis=0)
        excess = np.abs(checks) * self._gain.take(possible, axis=0)
        excess -= self._offset.take(possible, axis=0)
        return lower, upper, np.minimum.reduce(np.maximum.reduce(excess, axis=1), axis=0)

    def _intervals(self, checks: Array) -> tuple[Array, Array]:
        """Every single interval: of a channel by a circuit, by its own bound, and none; (rows, N) each."""
        count = len(self._circuit)
        low, high = np.empty((2, len(self._half), checks.shape[1]))
        centre = checks.take(self._circuit, axis=0)
        centre *= self._slope
        low[:count], low[count:] = centre, 0.0
        np.add(low, self._half, out=high)
        low -= self._half
        return low, high

    def _judge(self, z: Array, acceleration: Array | None) -> Verdict:
        rows, n = z.shape
        checks = transform(self._checks, z).T
        size = np.abs(checks)
        statistic = np.maximum.reduce(size, axis=0)
        limit = self.threshold if self.max_faults else WITHIN
        at = (statistic > min(WITHIN, limit)).nonzero()[0]
        if len(at) == rows:
            return self._explain(checks, size, limit)
        verdict = Verdict(
            statistic,
            np.full(rows, limit),
            np.zeros(rows, dtype=bool),
            np.zeros((rows, n), dtype=bool),
            np.zeros(rows, dtype=bool),
            np.zeros((rows, n)),
            np.zeros((rows, n)),
        )
        if len(at):
            part = self._explain(checks[:, at], size[:, at], limit)
            for whole, piece in zip(verdict, part, strict=True):
                whole[at] = piece
        return verdict

    def _explain(self, checks: Array, size: Array, limit: float) -> Verdict:
        """Verdict on samples that may need a fault."""
        lower, upper, mildest = self._explanations(checks)
        need_none = np.maximum.reduce(size, axis=0)
        statistic = np.where(need_none <= WITHIN, need_none, mildest) if self.max_faults else need_none
        alarm = statistic >= limit
        beyond = (self.threshold * self.bound)[:, None]
        seen = self.geometry.detectable[:, None]
        failed = (lower >= beyond) | (upper <= -beyond)
        suspects = ((upper >= beyond) | (lower <= -beyond)) & seen
        if self._twins is not None:
            suspects = np.asarray(self._twins @ suspects > 0) & seen
        # Only channels whose faults the geometry hides could have failed, or none could: nothing to choose by.
        suspects = np.where(suspects.any(axis=0), suspects, seen) & alarm
        isolated = alarm & ~(suspects & ~failed).any(axis=0)
        scores = np.fmax(np.maximum(lower, -upper), 0.0) / self.bound[:, None]
        known = suspects & np.isfinite(lower) & np.isfinite(upper)
        error = 0.5 * (np.where(known, lower, 0.0) + np.where(known, upper, 0.0))
        threshold = np.full(len(alarm), limit)
        return Verdict(statistic, threshold, alarm, suspects.T, isolated, error.T, scores.T)


def _allowed_faults(n: int, asked: int | None, reduce: bool) -> int:
    if n > MAX_CHANNELS:
        raise DetectorError(f"guaranteed runs on 4 to {MAX_CHANNELS} channels, got {n}")
    allowed = min(MAX_FAULTS, n - 4)
    if asked is None:
        return allowed
    if not isinstance(asked, int) or isinstance(asked, bool) or not 0 <= asked <= MAX_FAULTS:
        raise ConfigError(f"max_faults is {asked}, expected 0, 1 or 2")
    if asked > allowed and not reduce:
        raise DetectorError(f"max_faults is {asked} with {n} channels, expected at most {allowed} (n - 4)")
    return min(asked, allowed)
