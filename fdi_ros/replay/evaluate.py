"""What was injected against what was declared: delays, names, and the effect on the fused rate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.output import ChannelState
from fdi_ros.faults.fault import Fault
from fdi_ros.faults.injection import Injector
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Event, Output

Array = NDArray[np.float64]

GRACE = 1.0
"""A declaration this long after the stop of a fault is attributed to it, s."""
_NAMED = (ChannelState.FAULTY, ChannelState.STALE)
_FOUND = (*_NAMED, ChannelState.AMBIGUOUS)


@dataclass
class Finding:
    """What became of one injected fault."""

    fault: Fault
    channels: tuple[int, ...]
    begun: bool = False
    declared_before: bool = False
    """All its channels were declared already when it began: there is nothing left to be detected."""
    detected_at: float | None = None
    """Of the first declaration that names one of its channels, s."""
    detected_stamp: int | None = None
    """And in ns, as stamped."""
    detected_as: ChannelState | None = None
    isolated_at: float | None = None
    """When the last of its channels was declared by itself, s."""
    declared: list[int] = field(default_factory=list)
    """What its first declaration named, and those of its channels that were named by themselves later."""
    named: set[int] = field(default_factory=set)

    def explains(self, time: float, event: Event) -> bool:
        """Whether the fault is a reason for a declaration at this time, s."""
        active = self.fault.start <= time < self.fault.stop + GRACE
        return active and not set(_said(event)).isdisjoint(self.channels)

    def take(self, time: float, event: Event) -> None:
        """Note a declaration that this fault explains."""
        said: Sequence[int] = _said(event)
        if self.detected_at is None:
            self.detected_at, self.detected_stamp, self.detected_as = time, event.stamp, event.after
        elif event.stamp != self.detected_stamp:
            # Other channels that are named later have reasons of their own.
            said = [channel for channel in said if channel in self.channels]
        self.declared = list(dict.fromkeys((*self.declared, *said)))
        if event.after in _NAMED:
            self.named.add(event.channel)
            if self.isolated_at is None and self.named >= set(self.channels):
                self.isolated_at = time

    def as_dict(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the entry of the summary."""
        detected = self.detected_at
        return {
            "channel": self.fault.channel,
            "channels": [names[i] for i in self.channels],
            "kind": self.fault.kind.name,
            "size": self.fault.size,
            "start_s": self.fault.start,
            "stop_s": self.fault.stop if math.isfinite(self.fault.stop) else None,
            "detected_at_s": detected,
            "delay_s": None if detected is None else round(detected - self.fault.start, 9),
            "detected_as": None if self.detected_as is None else self.detected_as.name,
            "isolated": self.isolated_at is not None,
            "isolated_at_s": self.isolated_at,
            "isolation_delay_s": None if self.isolated_at is None else round(self.isolated_at - self.fault.start, 9),
            "declared_channels": [names[i] for i in self.declared],
            "declared_before": self.declared_before,
        }


_SQUARED = 1e150
"""Squares of anything smaller are finite, and so are sums of very many."""


def _said(event: Event) -> tuple[int, ...]:
    """Channels that a declaration names: one, or the set of which one is faulty."""
    return (event.channel,) if event.after in _NAMED else tuple(dict.fromkeys((event.channel, *event.group)))


@dataclass
class Rms:
    """Root mean square of the length of a vector."""

    squares: float = 0.0
    count: int = 0

    def add(self, vectors: Array) -> None:
        """Take in vectors (k, 3); one that is not finite, or too large to be squared, does not count."""
        vectors = vectors[(np.abs(vectors) < _SQUARED).all(axis=1)]
        self.squares += float((vectors**2).sum())
        self.count += len(vectors)

    @property
    def value(self) -> float | None:
        """The root mean square; None of nothing."""
        return math.sqrt(self.squares / self.count) if self.count else None


class Evaluation:
    """Scores one monitor on one stream, block after block.

    Parameters
    ----------
    injector
        Says which faults are in the stream, and when.
    geometry
        Of the monitor: what a plain least-squares rate of all channels would have been.
    """

    def __init__(self, injector: Injector, geometry: Geometry) -> None:
        self.injector = injector
        self.names = geometry.channel_names
        self.findings = [Finding(f, c) for f, c in zip(injector.faults, injector.channels, strict=True)]
        self.unexplained: list[dict[str, Any]] = []
        self.events: list[dict[str, Any]] = []
        self.samples = self.judged = self.with_rate = self.alarms = 0
        self._least_squares = geometry.least_squares
        self._state = [ChannelState.OK] * geometry.n
        self._standing: dict[int, tuple[ChannelState, tuple[int, ...]]] = {}
        self._first: int | None = None
        self._last = 0
        self._rms = {"before_detection": Rms(), "after_detection": Rms(), "without_monitor": Rms()}

    def add(self, output: Output, clean: Array | None = None) -> None:
        """Take in the next samples.

        Parameters
        ----------
        output
            Of the monitor.
        clean
            (N, 3) what the same monitor fuses of them without the faults, rad/s; NaN: not to be compared.
        """
        if len(output) == 0:
            return
        self.samples += len(output)
        self.with_rate += int(output.valid.sum())
        self.judged += int(np.isfinite(output.threshold).sum())
        self.alarms += int(output.alarm.sum())
        self._first = int(output.stamp[0]) if self._first is None else self._first
        self._last = int(output.stamp[-1])
        for event in output.events:
            time = self.time(event.stamp)
            self._begin(time)
            self._add_event(event, round(time, 9))
        self._begin(self.time(self._last))
        if clean is not None:
            self._add_effect(output, clean)

    def add_unmonitored(self, faulty: Block, sound: Block) -> None:
        """Take in what the faults do to the plain least-squares rate of all channels; NaN: not to be compared."""
        rows = self.injector.active(faulty.stamp).any(axis=1)
        if rows.any():
            # What is recorded may be infinite.
            with np.errstate(invalid="ignore", over="ignore"):
                effect = (faulty.z[rows] - sound.z[rows]) @ self._least_squares.T
            self._rms["without_monitor"].add(effect)

    def time(self, stamp: int) -> float:
        """Seconds from the first sample to a stamp, ns."""
        return float(self.injector.time(np.array([stamp]))[0])

    def _begin(self, time: float) -> None:
        """Note the faults that have begun up to this time, s: before what the sample of this time brings."""
        for finding in self.findings:
            if not finding.begun and finding.fault.start <= time:
                finding.begun = True
                finding.declared_before = all(self._state[i] in _NAMED for i in finding.channels)

    def _add_effect(self, output: Output, clean: Array) -> None:
        undetected = np.zeros(len(output), dtype=bool)
        active = self.injector.active(output.stamp)
        for finding, rows in zip(self.findings, active.T, strict=True):
            if not finding.declared_before:
                until = self._last if finding.detected_stamp is None else finding.detected_stamp
                undetected |= rows & (output.stamp <= until)
        effect = output.rate - clean
        self._rms["before_detection"].add(effect[undetected])
        self._rms["after_detection"].add(effect[active.any(axis=1) & ~undetected])

    def _add_event(self, event: Event, time: float) -> None:
        self._state[event.channel] = event.after
        entry = {
            "channel": self.names[event.channel],
            "at_s": time,
            "state": event.after.name,
            "before": event.before.name,
            "reason": event.reason.value,
            "group": [self.names[i] for i in event.group],
            "error": event.error if math.isfinite(event.error) else None,
        }
        self.events.append(entry)
        if event.after == ChannelState.OK:
            self._standing.pop(event.channel, None)
        if event.after not in _FOUND or self._standing.get(event.channel) == (event.after, event.group):
            # What is declared already and was only hidden for a while (the channel gave nothing) is not declared anew.
            return
        if event.declares:
            self._standing[event.channel] = (event.after, event.group)
        explaining = [finding for finding in self.findings if finding.explains(time, event)]
        for finding in explaining:
            finding.take(time, event)
        if not explaining and event.declares:
            self.unexplained.append(entry)

    def summary(self) -> dict[str, Any]:
        """Return the figures, ready for JSON."""
        first = self._last if self._first is None else self._first
        return {
            "samples": self.samples,
            "duration_s": round((self._last - first) * 1e-9, 9),
            "faults": [finding.as_dict(self.names) for finding in self.findings],
            "declared": self.unexplained,
            "fault_effect_rad_s": {name: rms.value for name, rms in self._rms.items()},
            "start_s": 0.0 if self._first is None else round(self.time(first), 9),
            "samples_judged": self.judged,
            "samples_with_rate": self.with_rate,
            "alarms": self.alarms,
            "events": self.events,
        }
