# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Health of channels and units over the last minute of a running monitor.

`RecentHealth` counts the same quantities as a replay and uses the same function for concerns. So
diagnostics and `fdi watch` give the verdict that a replay of the last minute would give.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.messages import NS
from fdi_ros.core.states import ChannelState
from fdi_ros.model.samples import Array, Int
from fdi_ros.monitor.diagnostics import input_warning
from fdi_ros.monitor.soundness import (
    REPORTED,
    ChannelHealth,
    Concern,
    RateHealth,
    UnitHealth,
    checked_share,
    concerns_of,
    is_declared_or_silent,
    own_noise,
)

if TYPE_CHECKING:
    from fdi_ros.monitor.diagnostics import InputStatus
    from fdi_ros.monitor.status import ChannelStatus, Status


class _Readings(NamedTuple):
    """Readings that the recent past consists of."""

    #: number of readings that are kept, one per second
    readings: int = 60
    #: largest number of rates of a unit, from which its usual rate follows
    rates: int = 600
    #: smallest number of readings for a share, and number for the rate of a unit
    least_readings: int = 10
    #: smallest number of residuals for a comparison of noise
    least_residuals: int = 30


_PAST = _Readings()

USUAL_QUANTILE = 0.9
"""Quantile of the rates of a unit that is its usual rate, even if the unit is slow for long."""

_COUNTED_KINDS = (
    "samples",
    "missing",
    "non-finite",
    "out of range",
    "spikes",
    "stuck",
)


class _Reading(NamedTuple):
    """Counts of a monitor at one moment."""

    at: float
    """Time, s."""
    counts: NDArray[np.int64]
    """(6, n) counts of each channel, in the order of ``_COUNTED_KINDS``."""
    checked: Int
    """(n,) values of each channel whose fault the others could have shown."""
    residual: Array
    """(n,) residuals of the channels that are OK, rad/s. NaN for the others."""
    received: Int
    """(u,) messages of each input topic."""
    has_rate: bool
    """Whether a fused rate was published."""


class RecentHealth:
    """Health over the last minute, from a reading once a second."""

    def __init__(self) -> None:
        self._readings: deque[_Reading] = deque(maxlen=_PAST.readings)
        self._rates: deque[Array] = deque(maxlen=_PAST.rates)
        self._concerns: list[Concern] = []
        self.channels: tuple[ChannelHealth, ...] = ()
        """Health of the channels in use that are not declared faulty, by the last reading."""

    def add(self, status: Status, inputs: Sequence[InputStatus], at: float) -> None:
        """Add a reading at a time, s. Earlier readings are dropped if time or counts go back or channels change."""
        reading = _reading(status, inputs, at)
        if self._readings:
            before = self._readings[-1]
            restarted = (
                len(before.residual) != len(reading.residual)
                or (reading.counts[0] < before.counts[0]).any()
            )
            if not at > before.at or restarted:
                self._readings.clear()
        self._readings.append(reading)
        units = list(self._units(status, inputs))
        self.channels = tuple(self._channels(status))
        self._concerns = concerns_of(self.channels, units, rate=self._rate_health())

    @property
    def concerns(self) -> list[Concern]:
        """Reasons not to call the monitored channels healthy, by the last reading."""
        return self._concerns

    def _channels(self, status: Status) -> Iterator[ChannelHealth]:
        """Yield each channel in use that is not declared faulty."""
        first = self._readings[0]
        last = self._readings[-1]
        samples, missing, non_finite, at_end, spikes, stuck = last.counts - first.counts
        total = samples + missing
        finite = samples - non_finite
        checked = last.checked - first.checked
        noise = self._own_noise(status)
        measured = len(self._readings) >= _PAST.least_readings
        unit_of = {name: unit.name for unit in status.units for name in unit.channels}
        scales = status.certain_scale_errors()
        for i, one in enumerate(status.channels):
            if one.is_left_out or one.state == ChannelState.AMBIGUOUS:
                continue
            # A stream that has stalled is reported as a whole.
            delivered = finite[i] / total[i] if total[i] else 1.0
            noisy = self._was_noisy(status, one)
            yield ChannelHealth(
                name=one.name,
                unit=unit_of.get(one.name, ""),
                # A stream that has stalled is reported as a whole.
                checked=checked_share(int(checked[i]), int(finite[i]))
                if measured and total.any()
                else 1.0,
                delivered=float(delivered) if measured else 1.0,
                spikes=int(spikes[i]),
                saturated_s=float(at_end[i]) / status.config.sample_rate,
                noisy_s=one.last_noisy.seconds if noisy else 0.0,
                noisy_from_s=(one.last_noisy.since - status.stamp) / NS,
                noisy_times=one.last_noisy.times,
                # A short time of noise would count as the noise of the whole minute.
                own_noise_rad_s=None if noisy else noise[i],
                measured_in=one.unit,
                repeated=float(stuck[i]) / max(1, int(finite[i])),
                drift=status.drift_since_rest(one),
                scale=scales[one.name].size,
                scale_seen=scales[one.name].seen,
            )

    def _was_noisy(self, status: Status, channel: ChannelStatus) -> bool:
        """Whether the last spell of noise reaches into the time of the readings."""
        return status.stamp - channel.last_noisy.until < _PAST.readings * NS

    def _rate_health(self) -> RateHealth:
        """Return how long the fused rate was missing, to a second."""
        published = [one.has_rate for one in self._readings]
        if True not in published:
            return RateHealth()
        published = published[published.index(True) :]
        missing = published.count(False)
        return RateHealth(float(missing), None, 1.0 - missing / len(published))

    def _own_noise(self, status: Status) -> list[float | None]:
        """Return the standard deviation of each channel's errors, rad/s. None: not compared.

        A declared fault disturbs the fused rate, so that no comparison is possible.
        """
        residuals = np.array([one.residual for one in self._readings])
        enough = np.isfinite(residuals).sum(axis=0) >= _PAST.least_residuals
        noise: list[float | None] = [None] * len(status.channels)
        if any(map(is_declared_or_silent, status.channels)) or not enough.any():
            return noise
        for quantity in dict.fromkeys(one.unit for one in status.channels):
            half = [i for i, one in enumerate(status.channels) if one.unit == quantity]
            axes = np.array([status.channels[i].axis for i in half])
            own = own_noise(np.where(enough, residuals, np.nan)[:, half], axes)
            for i, value in zip(half, own.tolist(), strict=True):
                noise[i] = value if math.isfinite(value) else None
        return noise

    def _units(
        self, status: Status, inputs: Sequence[InputStatus]
    ) -> Iterator[UnitHealth]:
        """Yield the health of each input topic, relative to its usual rate and to the other topics."""
        rate = self._rate(_PAST.least_readings)
        if rate is None or not len(rate):
            for line in inputs:
                yield UnitHealth(
                    name=line.name, topic=line.topic, warning=input_warning(line)
                )
            return
        usual = np.quantile([*self._rates, rate], USUAL_QUANTILE, axis=0)
        usual = np.maximum(usual, 1e-9)
        # Messages that a busy computer lost are missing on all topics.
        best = float((rate / usual).max())
        if best > 0.0 and (rate >= REPORTED.delivered * best * usual).all():
            self._rates.append(rate)
        mean = self._rate(_PAST.readings)
        mean = rate if mean is None else mean
        shares = mean / usual / max(float((mean / usual).max()), 1e-9)
        for line, share, own, normal in zip(inputs, shares, rate, usual, strict=True):
            # Without any message there is no rate to compare with.
            yield UnitHealth(
                name=line.name,
                topic=line.topic,
                delivered=float(share),
                rate_hz=float(normal) if line.received else None,
                slow_rate_hz=float(own) if line.received else None,
                warning=input_warning(line),
            )

    def _rate(self, readings: int) -> Array | None:
        """Return the rate of each topic over the last readings, Hz. None: too few readings."""
        last = self._readings[-1]
        if len(self._readings) < _PAST.least_readings:
            return None
        first = self._readings[-min(readings, len(self._readings))]
        rate: Array = (last.received - first.received) / (last.at - first.at)
        return rate


def _reading(status: Status, inputs: Sequence[InputStatus], at: float) -> _Reading:
    channels = status.channels
    return _Reading(
        at=at,
        counts=np.array(
            [[one.counts[kind] for one in channels] for kind in _COUNTED_KINDS]
        ),
        checked=np.array([one.checked for one in channels]),
        residual=np.array(
            [
                one.residual if one.state == ChannelState.OK else math.nan
                for one in channels
            ]
        ),
        received=np.array([line.received for line in inputs]),
        has_rate=status.has_rate,
    )
