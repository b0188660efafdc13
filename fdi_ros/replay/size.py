# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How large an error was and what it did over time, from means over batches of samples; memory does not grow.

The standard error of the mean is that of the batch means: it holds for errors that hang together in time as well, as
long as they do so for less than a batch (Law and Kelton, Simulation Modeling and Analysis, ch. 9).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array

Course = Literal["steady", "growing", "shrinking", "varying", "noisy", "proportional", "gone"]

MOST = 512  # batches kept; when there would be more, neighbours are put together
FIRST_WIDTH = 0.1  # of a batch, s
LONGER = 12
"""Batches that the standard error is taken from, put together of those kept: an error hangs together for less."""
FEW = 4  # batches from which on their scatter says something
CERTAIN = 4.0  # a trend is one from so many of its standard errors on
TREND = 0.3  # and from a change of such a share of the size on
PASSED = 0.25  # an error has passed when it stays below such a share of what it was
LASTING = 1.0  # time over which the size at the declaration is taken, and for which an error must have stayed away, s
ROUNDING = 1e-12  # share of a mean square that is rounding
SMALL = 0.5  # a mean below such a share of the scatter is not what the error is
LOUD = 3.0  # an error is noise where it scatters so many times as much as the channel's noise lets it
SQUARED = 1e150  # squares of anything smaller are finite, and so are sums of very many


@dataclass(frozen=True)
class Size:
    """The error of one channel while it stood declared, if it alone was wrong."""

    rad_s: float  # with its sign; of what varies or is noise, root mean square
    std_rad_s: float  # standard error of that: by chance, and by the scale factors and biases that are not known
    course: Course
    """steady; growing, shrinking (then the size is that at the declaration); varying; noisy; proportional to the rate
    along the axis; gone before the end."""
    last_rad_s: float  # in the last batch
    slope_rad_s2: float | None = None  # of what grows or shrinks
    share_of_rate: float | None = None  # of what is proportional to the rate: an error of the scale factor
    gone_s: float | None = None  # since when it has stayed away, s from the first message


class Batches:
    """Means of an error over batches of time, from ``begin`` on, s.

    ``noise``: standard deviation that it alone gives the error in one sample, rad/s. ``scale``, ``bias``: standard
    deviation of what unknown scale factors make of the rate, as a share of it, and of unknown biases, rad/s.
    """

    def __init__(self, begin: float, noise: float, scale: float = 0.0, bias: float = 0.0) -> None:
        self._begin, self._noise, self._scale, self._bias = begin, noise, scale, bias
        self._width = FIRST_WIDTH
        # Of each batch: samples, sum, sum of squares.
        self._sums = np.zeros((3, MOST))
        self._with_rate = np.zeros(2)  # sum of error times rate, and of the squared rate

    def add(self, time: Array, error: Array, rate: Array) -> None:
        """Take in samples (N,): time, s; error and rate along the axis, rad/s; what is not finite does not count."""
        known = np.isfinite(error) & (np.abs(error) < SQUARED)
        time, error, rate = time[known], error[known], np.nan_to_num(rate[known])
        if not len(time):
            return
        while time[-1] - self._begin >= MOST * self._width:
            self._sums = np.hstack([self._sums.reshape(3, -1, 2).sum(axis=2), np.zeros((3, MOST // 2))])
            self._width *= 2
        number = np.maximum(((time - self._begin) / self._width).astype(np.intp), 0)
        number = np.minimum(number, MOST - 1)
        for k, values in enumerate((None, error, error**2)):
            self._sums[k] += np.bincount(number, values, MOST)
        self._with_rate += float(error @ rate), float(rate @ rate)

    def size(self, declared: float) -> Size | None:
        """Sum up; declared: time of the declaration, s. None: no sample was known."""
        count, total, square = self._sums
        used = np.flatnonzero(count)
        if not len(used):
            return None
        mean: Array = np.asarray(total[used] / count[used], dtype=np.float64)
        middle: Array = np.asarray(self._begin + (used + 0.5) * self._width, dtype=np.float64)
        samples, whole = float(count.sum()), float(total.sum() / count.sum())
        mean_square = float(square.sum() / samples)
        scatter = mean_square - whole**2
        scatter = scatter if scatter > ROUNDING * mean_square else 0.0
        lasting = math.hypot(self._scale * math.sqrt(float(self._with_rate[1]) / samples), self._bias)
        std = math.hypot(_standard_error(mean, scatter, samples), lasting)
        last = float(mean[-1])
        share, explained = self._share_of_rate(samples * mean_square)
        rms = math.sqrt(mean_square)
        if share is not None and explained > max(0.5, 2 * whole**2 / mean_square):
            chance = _standard_error(mean, scatter, samples)
            return Size(rms, chance, "proportional", last, share_of_rate=share)
        at = (middle >= declared) & (middle < declared + max(LASTING, self._width))
        here = mean[at] if at.any() else mean[-1:]
        then = float(here.mean())
        gone = self._gone(used, mean, then)
        if gone is not None:
            before = middle < gone
            part, samples_then = mean[before], float(count[used][before].sum())
            error = math.hypot(_standard_error(part, scatter, samples_then), lasting)
            return Size(float(part.mean()), error, "gone", last, gone_s=round(gone, 3))
        slope = _trend(middle, mean)
        if slope is not None and abs(slope) * (middle[-1] - middle[0]) > TREND * abs(whole):
            course: Course = "growing" if slope * (then or whole) > 0 else "shrinking"
            straight = mean - slope * (middle - middle.mean())
            chance = float(straight.std(ddof=2)) / math.sqrt(len(here))
            return Size(then, math.hypot(chance, lasting), course, last, slope)
        if abs(whole) < SMALL * math.sqrt(scatter):
            wander = float(mean.var()) if len(mean) >= FEW else 0.0
            if wander > max(0.5 * scatter, (CERTAIN * std) ** 2):
                return Size(rms, std, "varying", last)
            if scatter > (LOUD * self._noise) ** 2:
                return Size(rms, rms / math.sqrt(2.0 * samples), "noisy", last)
        return Size(whole, std, "steady", last)

    def _share_of_rate(self, squares: float) -> tuple[float | None, float]:
        """Regression of the error on the rate, and the share of its mean square that this explains."""
        product, rates = self._with_rate
        if rates <= 0.0 or squares <= 0.0:
            return None, 0.0
        return product / rates, product**2 / (rates * squares)

    def _gone(self, used: NDArray[np.intp], mean: Array, then: float) -> float | None:
        """Since when the means have stayed well below what they were at the declaration, s; None: they have not."""
        large = np.flatnonzero(np.abs(mean) >= PASSED * abs(then))
        if not len(large) or large[-1] == len(mean) - 1:
            return None
        since = self._begin + (used[large[-1]] + 1) * self._width
        lasted = self._begin + (used[-1] + 1) * self._width - since
        return float(since) if lasted >= max(LASTING, 2 * self._width) else None


def _standard_error(means: Array, scatter: float, samples: float) -> float:
    """Of the mean of all, from the scatter of the batch means and that of single samples, whichever says more."""
    by_sample = scatter / max(samples, 1.0)
    if len(means) >= 2 * LONGER:
        means = np.array([part.mean() for part in np.array_split(means, LONGER)])
    by_batch = float(means.var(ddof=1)) / len(means) if len(means) >= FEW else 0.0
    return math.sqrt(max(by_sample, by_batch))


def _trend(time: Array, mean: Array) -> float | None:
    """Slope of a straight line through the means (k,), where it is certain; else None."""
    if len(mean) < 2 * FEW:
        return None
    x = time - time.mean()
    slope = float(x @ mean / (x @ x))
    rest = mean - mean.mean() - slope * x
    std = math.sqrt(float(rest @ rest) / (len(mean) - 2) / float(x @ x))
    return slope if abs(slope) > CERTAIN * std else None
