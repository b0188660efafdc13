"""Which channels explain a sample that is known to hold a fault: one, a pair, a unit, or a set of rivals."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.hypotheses import FixedFits, SampleFits, pairs, singles, whole_units
from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.thresholds import chi2_isf

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Explanation:
    """Single-fault hypotheses first, pairs where no single channel explains the sample.

    With c(k) the chi-square with k degrees of freedom that a true hypothesis stays below with the confidence asked
    for, and m = n - 3:

    1. A single channel explains the sample when what is left without it is at most c(m - 1). The best one is
       named together with every rival whose fit is not worse by ``2 ln(confidence / (1 - confidence))``, that is
       with odds below confidence : (1 - confidence). One without rivals is isolated. Two faults that together look
       like one of a third channel are taken for it: one fault is believed rather than two.
    2. Where no single channel explains the sample, every pair is possible whose chi-square is at most c(m - 2);
       suspects are their union, isolated when it is one pair alone (then both are faulty: neither explains
       the sample by itself). With five channels a pair explains anything: all are suspect.
    3. Where no pair does either, a whole unit of three channels may (one chip, one cable): named, all three as
       faulty, when it is the only unit that leaves at most c(m - 3).
    4. Where nothing explains the sample, all detectable channels are suspect.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model, one value a channel.
    confidence
        With which rivals are rejected, above 0.5 and below 1.

    Raises
    ------
    ConfigError
        If the confidence is out of its range.
    """

    def __init__(self, geometry: Geometry, noise: NoiseModel, confidence: float) -> None:
        if not 0.5 < confidence < 1:
            raise ConfigError(f"confidence is {confidence:g}, expected above 0.5 and below 1")
        fits = FixedFits if noise.constant else SampleFits
        self.geometry = geometry
        self.channels: NDArray[np.intp] = np.flatnonzero(geometry.detectable)
        """Channels judged, in the order of the hypotheses of `singles`."""
        self.singles = fits(geometry, noise, singles(geometry))
        doubles = pairs(geometry) if geometry.n > 5 else []
        self._pairs = fits(geometry, noise, doubles) if doubles else None
        units = whole_units(geometry)
        self._units = fits(geometry, noise, units) if units else None
        self._twins = None if geometry.isolable.all() else geometry.group_matrix.astype(np.int64)
        m, rest = geometry.n - 3, 1 - confidence
        self._single_limit = chi2_isf(rest, m - 1) if m > 1 else math.inf
        self._pair_limit = chi2_isf(rest, m - 2) if m > 2 else math.inf
        self._unit_limit = chi2_isf(rest, m - 3) if m > 3 else math.inf
        self._rival_margin = 2 * math.log(confidence / rest)
        self._can_isolate = m > 1

    def whitened(self, z: Array, acceleration: Array | None) -> Array:
        """Single-fault statistics w, (N, n); 0 for a channel no fault of which is seen."""
        w = np.zeros(z.shape[::-1])
        w[self.channels] = self.singles.whitened(z, acceleration)[0]
        return w.T

    def explain(self, z: Array, acceleration: Array | None) -> tuple[Mask, Mask, Array]:
        """Suspects (N, n), isolated (N,) and errors of the suspects (N, n) rad/s."""
        rows, n = z.shape
        estimate, remaining = self.singles.fit(z, acceleration)
        best = remaining.min(axis=0)
        suspects, error = np.zeros((n, rows), dtype=bool), np.zeros((n, rows))
        suspects[self.channels] = remaining <= best + self._rival_margin
        error[self.channels] = estimate[0]
        suspects = self._with_twins(suspects)
        single = best <= self._single_limit
        isolated = single & (suspects.sum(axis=0) == 1) & self._can_isolate
        rest = (~single).nonzero()[0]
        if len(rest):
            suspects[:, rest] = self.geometry.detectable[:, None]
        for more in (self._explain_by_pairs, self._explain_by_units):
            if len(rest):
                part = more(z[rest], None if acceleration is None else acceleration[rest])
                some = part[0].any(axis=0)
                at = rest[some]
                suspects[:, at], isolated[at], error[:, at] = part[0][:, some], part[1][some], part[2][:, some]
                rest = rest[~some]
        return suspects.T, isolated, np.where(suspects, error, 0.0).T

    def _explain_by_pairs(self, z: Array, acceleration: Array | None) -> tuple[Mask, Mask, Array]:
        """Suspects (n, N), isolated (N,) and errors (n, N); no suspects where no pair explains the sample."""
        rows, n = z.shape
        suspects, error = np.zeros((n, rows), dtype=bool), np.zeros((n, rows))
        if self._pairs is None:
            return suspects, np.zeros(rows, dtype=bool), error
        estimate, remaining = self._pairs.fit(z, acceleration)
        possible = remaining <= self._pair_limit
        misfit = np.full((n, rows), np.inf)
        # A channel's error is that of the best pair it is in.
        for k, pair in enumerate(self._pairs.out):
            for place, channel in enumerate(pair):
                suspects[channel] |= possible[k]
                better = remaining[k] < misfit[channel]
                error[channel][better] = estimate[place, k][better]
                misfit[channel][better] = remaining[k][better]
        suspects = self._with_twins(suspects)
        isolated = (possible.sum(axis=0) == 1) & (suspects.sum(axis=0) == 2)
        return suspects, isolated, error

    def _explain_by_units(self, z: Array, acceleration: Array | None) -> tuple[Mask, Mask, Array]:
        """Suspects (n, N), isolated (N,) and errors (n, N); no suspects unless exactly one unit explains the sample."""
        rows, n = z.shape
        suspects, error = np.zeros((n, rows), dtype=bool), np.zeros((n, rows))
        if self._units is None:
            return suspects, np.zeros(rows, dtype=bool), error
        estimate, remaining = self._units.fit(z, acceleration)
        possible = remaining <= self._unit_limit
        one = possible.sum(axis=0) == 1
        for k, unit in enumerate(self._units.out):
            named = one & possible[k]
            suspects[unit[:, None], named] = True
            error[unit[:, None], named] = estimate[:, k, named]
        return suspects, one, error

    def _with_twins(self, suspects: Mask) -> Mask:
        """Suspects (n, N) and all that cannot be told apart from one of them."""
        if self._twins is None:
            return suspects
        return np.asarray(self._twins @ suspects > 0) & self.geometry.detectable[:, None]
