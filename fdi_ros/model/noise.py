# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of a healthy channel, false-alarm rates, thresholds and detectable faults.

Chi-square tails with a whole number of degrees of freedom are finite sums, so NumPy and
the standard library suffice.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import combinations
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from fdi_ros.errors import ConfigError
from fdi_ros.model.geometry import MIN_SENSITIVITY, ROUNDING, Geometry
from fdi_ros.model.samples import Array


class NoiseModel:
    """Error of a healthy channel in one sample.

    The variance of channel i is ``noise_std^2 + (scale_std * rate_i)^2 + (timing_std *
    accel_i)^2``, where rate_i and accel_i are the body rate and the angular acceleration
    along the channel's axis.

    Parameters
    ----------
    noise_std
        Standard deviation of the additive error in one sample, rad/s, > 0 (the papers' sigma_0).
    scale_std
        Standard deviation of the scale-factor error, dimensionless, 0 to 1 (sigma_k).
    timing_std
        Standard deviation of the sampling instant, s, 0 to 1, multiplied by the angular
        acceleration.
    bound
        Guaranteed limit of the error, rad/s, > 0 (the guaranteeing method's sigma).
        Only `guaranteed` needs this.
    nonlinearity_std
        Standard deviation of errors that are not linear in the rate, as a share of the
        rate, 0 to 1. Only `sequential` uses this.
    bias_std
        Standard deviation of the bias left after its correction, rad/s, >= 0. A bias
        does not average out, so only methods that accumulate use this.

    Each is a scalar, or (n,) with one value per channel.

    Raises
    ------
    ConfigError
        If a value is not finite or out of its range.
    """

    def __init__(
        self,
        noise_std: ArrayLike,
        scale_std: ArrayLike = 0.0,
        timing_std: ArrayLike = 0.0,
        bound: ArrayLike | None = None,
        bias_std: ArrayLike = 0.0,
        nonlinearity_std: ArrayLike = 0.002,
    ) -> None:
        self.noise_std = _checked("noise_std", noise_std, "rad/s", above=True)
        self.scale_std = _checked("scale_std", scale_std, "", 1.0)
        self.timing_std = _checked("timing_std", timing_std, "s", 1.0)
        self.bound = (
            None if bound is None else _checked("bound", bound, "rad/s", above=True)
        )
        self.bias_std = _checked("bias_std", bias_std, "rad/s")
        self.nonlinearity_std = _checked("nonlinearity_std", nonlinearity_std, "", 1.0)

    def __repr__(self) -> str:
        words = [f"{name}={value}" for name, value in vars(self).items()]
        return f"NoiseModel({', '.join(words)})"

    @property
    def constant(self) -> bool:
        """Whether the variance depends on neither rate nor acceleration."""
        return not (self.scale_std.any() or self.timing_std.any())

    def for_channels(self, n: int) -> NoiseModel:
        """Return the same model with one value per channel.

        Raise `ConfigError` if a value exists for another number of channels than n.
        """
        return NoiseModel(
            **{
                name: _one_per_channel(name, v, n)
                for name, v in vars(self).items()
                if v is not None
            }
        )

    def subset(self, mask: ArrayLike) -> NoiseModel:
        """Return the model of the channels marked in mask (n,) bool."""
        kept = np.asarray(mask, dtype=bool)
        full = vars(self.for_channels(len(kept)))
        return NoiseModel(
            **{name: value[kept] for name, value in full.items() if value is not None}
        )

    def variance(
        self, geometry: Geometry, rate: Array, acceleration: Array | None = None
    ) -> Array:
        """Return the error variance of every channel, (N, n), (rad/s)^2.

        Parameters
        ----------
        geometry
            Sensitivity axes of the n channels.
        rate
            Body rate, (N, 3), rad/s.
        acceleration
            Angular acceleration, (N, 3), rad/s^2. None: zero.
        """
        total = (rate @ geometry.axes.T * self.scale_std) ** 2 + self.noise_std**2
        if acceleration is not None:
            total += (acceleration @ geometry.axes.T * self.timing_std) ** 2
        return np.asarray(total)


def _one_per_channel(name: str, value: Array, n: int) -> Array:
    if value.ndim == 1 and len(value) not in (1, n):
        raise ConfigError(
            f"noise.{name} has {len(value)} values, expected 1 or {n} (one per channel)"
        )
    return np.broadcast_to(value, n).copy()


def _checked(
    name: str, value: ArrayLike, unit: str, high: float = np.inf, above: bool = False
) -> Array:
    """Return a value that is at least 0, or above 0, and at most a limit."""
    array = np.array(value, dtype=np.float64)
    is_large = array > 0 if above else array >= 0
    within = is_large & (array <= high) & np.isfinite(array)
    is_misshapen = array.ndim > 1 or array.size == 0
    if is_misshapen or not within.all():
        wrong = array if is_misshapen else array[~within].flat[0]
        bounds = ("> 0" if above else ">= 0") + (
            "" if high == np.inf else f" and <= {high:g}"
        )
        raise ConfigError(
            f"noise.{name} is {wrong}{' ' + unit if unit else ''}, expected finite, {bounds}"
        )
    array.flags.writeable = False
    return array


#: Ratio to all channels of other units. Vibration of the body gives at most sqrt(3).
MUCH_NOISIER = 3.0


def much_noisier(
    noise: Array, units: Sequence[Sequence[int]]
) -> list[tuple[int, float]]:
    """Find channels that are much noisier than every channel of all other units.

    Parameters
    ----------
    noise
        Noise of each channel, rad/s, (n,). Values that are not finite are ignored.
    units
        Channels of each unit. A channel that fails alone is a unit of its own.

    Returns
    -------
    list
        Channel, and the largest noise in all other units, rad/s.
    """
    found = []
    for k, unit in enumerate(units):
        others_of = [other for j, other in enumerate(units) if j != k]
        others = noise[[i for other in others_of for i in other]]
        beside = float(others[np.isfinite(others)].max(initial=0.0))
        found += [
            (int(i), beside)
            for i in unit
            if beside > 0.0 and noise[i] > MUCH_NOISIER * beside
        ]
    return found


def noisier_words(
    names: Sequence[str],
    noise: Array,
    units: Sequence[Sequence[int]],
    unit: str = "rad/s",
    factor: float = 1.0,
) -> str:
    """Return words about channels that are much noisier than the others, or "".

    Parameters
    ----------
    names
        Names of the channels.
    noise, units
        As for `much_noisier`.
    unit, factor
        Unit of rates in the words, and 1 rad/s in this unit.
    """
    found = much_noisier(noise, units)
    if not found:
        return ""
    levels = [(names[i], noise[i] * factor) for i, _ in found]
    who = ", ".join(f"{name} ({level:.2g} {unit})" for name, level in levels)
    verb = "is" if len(found) == 1 else "are"
    others = max(beside for _, beside in found) * factor
    return f"{who} {verb} much noisier than the other units ({others:.2g} at most)"


# False-alarm rates
# ----------------------------------------------------------------------------------------------------


DEFAULT_PROBABILITY = 1e-6  #: Per sample.
DEFAULT_RUN_LENGTH, MIN_RUN_LENGTH, MAX_RUN_LENGTH = 3.6e8, 2.0, 1e15
"""Samples. The default is one false alarm in 1000 hours at 100 Hz."""
BY_PROBABILITY = ("false_alarm_probability", "false_alarms_per_hour", "sample_rate")
"""Options of a detector that judges each sample alone."""


@dataclass(frozen=True)
class FalseAlarmRate:
    """A false-alarm rate, stated by one option of a detector or by none (default).

    Raises
    ------
    ConfigError
        If the rate is stated in two ways, or a value is out of range.
    """

    run_length: float | None = None  #: Mean number of samples to a false alarm.
    false_alarm_probability: float | None = None  #: Per sample, between 0 and 1.
    false_alarms_per_hour: float | None = None  #: > 0. Needs the sample rate.
    sample_rate: float | None = None  #: Hz, > 0.

    def __post_init__(self) -> None:
        given = [
            name
            for name, value in vars(self).items()
            if value is not None and name != "sample_rate"
        ]
        if len(given) > 1:
            raise ConfigError(f"give {' or '.join(given)}, not both")
        if self.false_alarms_per_hour is not None:
            if not self.false_alarms_per_hour > 0 or not math.isfinite(
                self.false_alarms_per_hour
            ):
                raise ConfigError(
                    f"false_alarms_per_hour is {self.false_alarms_per_hour:g}, expected > 0"
                )
            if (
                self.sample_rate is None
                or not self.sample_rate > 0
                or not math.isfinite(self.sample_rate)
            ):
                raise ConfigError(
                    f"false_alarms_per_hour needs a sample_rate > 0 Hz, got {self.sample_rate}"
                )

    def per_sample(self) -> float:
        """Return the probability of a false alarm in one sample.

        Raise `ConfigError` if the result is not between 0 and 1.
        """
        probability = (
            DEFAULT_PROBABILITY
            if self.false_alarm_probability is None
            else self.false_alarm_probability
        )
        if self.false_alarms_per_hour is not None and self.sample_rate is not None:
            probability = self.false_alarms_per_hour / (3600.0 * self.sample_rate)
        elif self.run_length is not None:
            probability = 1 / self.mean_run_length()
        if not 0 < probability < 1:
            raise ConfigError(
                f"false-alarm probability per sample is {probability:g}, expected between 0 and 1"
            )
        return probability

    def mean_run_length(self) -> float:
        """Return the mean number of samples to a false alarm.

        Raise `ConfigError` if the result is not `MIN_RUN_LENGTH` to `MAX_RUN_LENGTH`.
        """
        samples = DEFAULT_RUN_LENGTH if self.run_length is None else self.run_length
        if (
            self.false_alarms_per_hour is not None
            or self.false_alarm_probability is not None
        ):
            samples = 1 / self.per_sample()
        if not MIN_RUN_LENGTH <= samples <= MAX_RUN_LENGTH:
            raise ConfigError(
                f"run_length is {samples:g} samples, expected {MIN_RUN_LENGTH:g} to {MAX_RUN_LENGTH:g}"
            )
        return samples

    def as_options(
        self, accepted: Collection[str] = BY_PROBABILITY
    ) -> dict[str, float]:
        """Return the options, among those accepted by a detector, that state this rate.

        For a detector that accepts only a run length, a probability is converted.
        """
        options = dict(vars(self))
        probability = self.false_alarm_probability
        if (
            probability is not None
            and "run_length" in accepted
            and "false_alarm_probability" not in accepted
        ):
            options["run_length"] = max(1 / probability, MIN_RUN_LENGTH)
        return {
            name: value
            for name, value in options.items()
            if value is not None and name in accepted
        }


def erfc(x: Array) -> Array:
    """Return the complementary error function, elementwise."""
    return np.asarray(np.frompyfunc(math.erfc, 1, 1)(x), dtype=np.float64)


# Thresholds
# ----------------------------------------------------------------------------------------------------------


def normal_isf(probability: float) -> float:
    """Return the upper quantile of the standard normal distribution."""
    return -NormalDist().inv_cdf(probability)


def chi2_sf(x: Array | float, dof: int) -> Array:
    """Return P(chi-square with whole dof > x), elementwise.

    These are the finite sums of Abramowitz and Stegun 26.4.4-5.
    """
    half = np.asarray(x, dtype=np.float64) / 2
    if dof % 2 == 0:
        terms = [half**k / math.factorial(k) for k in range(dof // 2)]
        return np.asarray(np.exp(-half) * sum(terms), dtype=np.float64)
    terms = [half ** (k + 0.5) / math.gamma(k + 1.5) for k in range((dof - 1) // 2)]
    tail = erfc(np.sqrt(half))
    return np.asarray(tail + np.exp(-half) * sum(terms), dtype=np.float64)


def chi2_isf(probability: float, dof: int) -> float:
    """Return the threshold that a chi-square with whole dof exceeds with a probability."""
    start = max(normal_isf(probability), 0.0) ** 2 + dof
    return solve_log(lambda x: float(chi2_sf(x, dof)), probability, start)


def max_normal_threshold(directions: Array, probability: float) -> float:
    """Return the threshold that ``max_i |directions_i . p|`` exceeds with a probability.

    p is white in m dimensions, and directions (n, m) are unit vectors. Up to m = 3 the
    chi-square tail of ``(t / M(u))^2``, ``M(u) = max_i |directions_i . u|``, is averaged
    over the unit sphere by quadrature. For larger m the average is over samples drawn
    beyond the threshold along each direction in turn (Naiman and Priebe 2001), which
    keeps the relative accuracy far into the tail.
    """
    # A sweep builds the same methods for each of its faults.
    return _max_normal_threshold(
        directions.astype(np.float64).tobytes(), directions.shape, probability
    )


@functools.lru_cache(1024)
def _max_normal_threshold(
    data: bytes, shape: tuple[int, int], probability: float
) -> float:
    directions = np.frombuffer(data).reshape(shape)
    kept: list[int] = []
    for i, direction in enumerate(directions):
        # Equal directions, except for rounding, count once.
        if all(abs(direction @ directions[j]) < 1 - ROUNDING for j in kept):
            kept.append(i)
    unique = directions[kept]
    tail = _sphere_tail(unique) if unique.shape[1] <= 3 else _union_tail(unique)
    bonferroni = normal_isf(probability / (2 * len(unique)))
    return solve_log(tail, probability, bonferroni)


def _sphere_tail(directions: Array) -> Callable[[float], float]:
    points, weights = _half_sphere(directions.shape[1])
    largest = np.abs(points @ directions.T).max(axis=1)
    inverse = np.divide(
        1.0, largest, out=np.full_like(largest, 1e3), where=largest > 1e-3
    )
    return lambda t: float(weights @ chi2_sf((t * inverse) ** 2, directions.shape[1]))


def _half_sphere(m: int) -> tuple[Array, Array]:
    """Return directions (D, m) on half the unit sphere and their weights (D,), m = 1 to 3.

    In a plane these are 360 directions, in space 128 at each of 48 heights, which are
    nodes of Gauss-Legendre quadrature.
    """
    if m == 1:
        return np.ones((1, 1)), np.ones(1)
    if m == 2:
        angle = np.pi * (np.arange(360) + 0.5) / 360
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        return circle, np.full(360, 1 / 360)
    nodes, weights = np.polynomial.legendre.leggauss(48)
    height = (nodes + 1) / 2
    azimuth = 2 * np.pi * (np.arange(128) + 0.5) / 128
    radius = np.sqrt(1 - height**2)
    points = [
        np.outer(radius, np.cos(azimuth)),
        np.outer(radius, np.sin(azimuth)),
        np.outer(height, np.ones(128)),
    ]
    on_sphere = np.stack(points, axis=-1).reshape(-1, 3)
    return on_sphere, np.repeat(weights / 2 / 128, 128)


def _union_tail(directions: Array) -> Callable[[float], float]:
    # A fixed seed makes the threshold a function of the geometry alone.
    rng = np.random.default_rng(20190101)
    n, m = directions.shape
    # With more directions each needs fewer draws. Thus the cost grows with n squared.
    draws = min(4096, 16 * 4096 // n)
    white = rng.standard_normal((draws, m)) @ directions.T
    log_levels = np.log((rng.permutation(draws) + 0.5) / draws)
    nodes = np.linspace(log_levels.min(), 0.0, 257)
    correlation = directions @ directions.T

    def tail(t: float) -> float:
        single = math.erfc(t / math.sqrt(2))
        # Linear interpolation between 257 quantiles has an error below 1e-5.
        along = np.interp(
            log_levels,
            nodes,
            [normal_isf(math.exp(node) * single / 2) for node in nodes],
        )
        total = 0.0
        for i in range(n):
            w = (along - white[:, i])[:, None] * correlation[i]
            w += white
            # The own value of i exceeds t by construction. Rounding must not change this.
            w[:, i] = 0.0
            others = (np.abs(w, out=w) > t).sum(axis=1)
            total += single * float(np.mean(1 / (1 + others)))
        return total

    return tail


def solve_log(tail: Callable[[float], float], level: float, start: float) -> float:
    """Return the root t > 0 of log tail(t) = log level by the secant method.

    Tails and run lengths are nearly exponential in t.
    """
    target = math.log(level)
    older = start
    newer = start + 0.05
    f_older = math.log(tail(older)) - target
    f_newer = math.log(tail(newer)) - target
    for _ in range(60):
        if abs(newer - older) < 1e-9 * newer or f_newer == f_older:
            break
        step = f_newer * (newer - older) / (f_newer - f_older)
        older = newer
        f_older = f_newer
        newer = max(newer - step, 0.2 * newer)
        f_newer = math.log(tail(newer)) - target
    return newer


#: Probability with which one sample shows the smallest detectable error.
DETECTION = 0.99
#: Third singular value below which directions are in one plane, since mounts are uncertain.
IN_PLANE = 0.1
LISTED_SETS = 4  #: Largest number of listed sets of channels.


def smallest_detectable(
    geometry: Geometry, noise: NoiseModel, probability: float
) -> Array:
    """Return the error (n,), rad/s, of each channel that one sample at rest shows.

    The probability of detection is `DETECTION`. The test is the largest normalised
    residual at a false-alarm probability. The whitened residual of a channel is ``w_i =
    error sqrt(v_i' (V R V')^-1 v_i) + N(0, 1)``. Alarms by other channels are neglected.
    """
    V = geometry.parity
    inverse = np.linalg.inv((V * noise.noise_std**2) @ V.T)
    gain = np.sqrt(np.maximum(np.einsum("ai,ab,bi->i", V, inverse, V), 0))
    root = np.linalg.cholesky(inverse)
    directions = (root.T @ V).T[geometry.detectable]
    threshold = max_normal_threshold(
        directions / np.linalg.norm(directions, axis=1)[:, None], probability
    )
    with np.errstate(divide="ignore"):
        return np.where(
            geometry.detectable, (threshold + normal_isf(1 - DETECTION)) / gain, np.inf
        )


def coincidences(geometry: Geometry) -> tuple[tuple[int, ...], ...]:
    """Return sets of channels in which two equal faults look like a fault of a third.

    Their directions in parity space are in one plane, as those of three parallel gyros.
    """
    directions = geometry.parity / np.maximum(
        np.linalg.norm(geometry.parity, axis=0), MIN_SENSITIVITY
    )
    sets: list[set[int]] = []
    triples = np.array(
        list(combinations(np.flatnonzero(geometry.isolable), 3)), dtype=np.int64
    ).reshape(-1, 3)
    third = np.linalg.svd(directions.T[triples], compute_uv=False)[:, 2:].sum(axis=1)
    for triple in triples[third < IN_PLANE].tolist():
        # Two directions define the plane.
        channels = set(triple)
        known = next((found for found in sets if len(found & channels) == 2), None)
        if known is None:
            sets.append(channels)
        else:
            known |= channels
    return tuple(tuple(sorted(found)) for found in sets)


def assumption_words(geometry: Geometry) -> str:
    """Return the assumption behind every name that no data can check, or "".

    See docs/integrity.md.
    """
    names = geometry.channel_names
    found = coincidences(geometry)
    sets = ["/".join(names[i] for i in channels) for channels in found]
    shown = ", ".join(sets[:LISTED_SETS]) + (
        f" and {len(sets) - LISTED_SETS} more sets" if len(sets) > LISTED_SETS else ""
    )
    return (
        f"no two failing alike of {shown}: they would look like a fault of the third"
        if sets
        else ""
    )


def summary_line(
    geometry: Geometry,
    noise: NoiseModel,
    probability: float,
    unit: str = "rad/s",
    factor: float = 1.0,
    agree: bool = True,
) -> str:
    """Return one line on the capability of a mounting, for the log of a node.

    Parameters
    ----------
    geometry, noise
        Sensitivity axes, and errors of healthy channels.
    probability
        Probability of a false alarm per sample.
    unit, factor
        Unit of the errors in the line, and 1 rad/s in this unit.
    agree
        The channels are not known to contradict each other. Otherwise the line does
        not state which faults can be isolated.
    """
    smallest = smallest_detectable(
        geometry, noise.for_channels(geometry.n), probability
    )
    seen = smallest[np.isfinite(smallest)]
    ends = (
        dict.fromkeys(f"{value * factor:.3g}" for value in (seen.min(), seen.max()))
        if len(seen)
        else {}
    )
    span = f"{' to '.join(ends)} {unit}" if ends else "none"
    isolable = int(geometry.isolable.sum())
    n = geometry.n
    smallest_words = f"smallest error detected in one sample at rest with probability {100 * DETECTION:.0f} %: {span}"
    if len(ends) > 1:
        smallest_words += ", depending on the channel"
    words = f"{n} channels, GDOP {geometry.gdop:.2f}; {smallest_words}"
    if not agree:
        return f"{words}; which faults can be isolated is not known: channels contradict each other"
    groups = [group for group in geometry.groups if len(group) > 1]
    if isolable == n:
        return f"{words}; any single fault can be isolated"
    alike = "; ".join(
        " or ".join(geometry.channel_names[i] for i in group) for group in groups
    )
    others = f"indistinguishable: {alike}" if alike else "the others are never detected"
    return f"{words}; {isolable} of {n} single faults can be isolated; {others}"
