# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results for injected faults, with the same terms in replay, sweep, fleet and studies.

A replay follows the changes of state (`Evaluation`). A sweep and a study have the states of all
samples (`score`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from fdi_ros.core.states import ChannelState
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.quantity import RATE
from fdi_ros.model.samples import Array, Block, Mask
from fdi_ros.monitor.output import Event, Output
from fdi_ros.replay.episodes import DECLARED

ALONE = (ChannelState.FAULTY, ChannelState.STALE)
"""States of a channel that is declared alone."""
DECLARED_STATES = (*ALONE, ChannelState.AMBIGUOUS)
"""States of a declared channel, alone or in a set."""


class OutcomeKind(str, Enum):
    """Result for one injected fault. The values appear in files."""

    ISOLATED = "named"
    """The faulty channel was declared alone."""
    AMBIGUOUS = "in a set"
    """The faulty channel was declared in a set only."""
    MISSED = "silent"
    """Nothing was declared."""
    FALSE_GROUP = "false set"
    """Only sets without the faulty channel were declared."""
    FALSE_ISOLATION = "wrong"
    """A healthy channel was declared alone."""


def outcome_of(
    false_isolation: bool, isolated: bool, in_set: bool, false_group: bool
) -> OutcomeKind:
    """Return the result for a fault. A wrong isolation outweighs a right one."""
    if false_isolation:
        return OutcomeKind.FALSE_ISOLATION
    if isolated:
        return OutcomeKind.ISOLATED
    if in_set:
        return OutcomeKind.AMBIGUOUS
    return OutcomeKind.FALSE_GROUP if false_group else OutcomeKind.MISSED


class TrialOutcome(NamedTuple):
    """Result of one trial of a sweep or a study: what is known from the states alone."""

    outcome: OutcomeKind
    """The result."""
    isolated_after: float
    """Time until the channel was declared alone, s. Infinite: never."""
    detected_after: float
    """Time until the channel was declared alone or in a set, s. Infinite: never."""


def standing(output: Output) -> tuple[Mask, Mask]:
    """Return whether each channel is declared alone or silent, and in a set, (N, n) each."""
    return np.isin(output.state, ALONE), np.asarray(
        output.state == ChannelState.AMBIGUOUS
    )


def score(
    alone: Mask, among: Mask, channel: int | None, since: Array, within: float = np.inf
) -> TrialOutcome:
    """Return the result for a fault.

    Parameters
    ----------
    alone, among
        (N, n) states, as `standing` returns them.
    channel
        Index of the faulty channel. None: all channels are healthy.
    since
        (N,) time from the start of the fault, s.
    within
        Time in which an isolation or a set counts, s. A wrong isolation counts at any time.
    """
    own = [] if channel is None else [channel]
    others = np.delete(alone, own, axis=1)
    soon = since <= within
    isolated = _first(alone[:, own], since)
    detected = _first(alone[:, own] | among[:, own], since)
    found = isolated <= within and isolated < np.inf
    outcome = outcome_of(
        bool(others.any()),
        found,
        bool(among[:, own][soon].any()),
        bool(among[soon].any()),
    )
    return TrialOutcome(outcome, isolated, detected)


def _first(declared: Mask, since: Array) -> float:
    rows = np.flatnonzero(declared.any(axis=1))
    return float(since[rows[0]]) if len(rows) else np.inf


# Changes of state, and the results for each fault


UNCHECKED_STATES = ("STALE", "UNCHECKED")
"""States of a channel that no other channel checks, without a declared fault."""


@dataclass(frozen=True)
class Outcome:
    """Result for one injected fault. Times are in s from the first message."""

    channel: str
    """Channel as the user wrote it: one name, or several with commas between."""
    channels: tuple[str, ...]
    """Names of the channels with the fault."""
    kind: str
    """Kind of the fault."""
    size: float | None
    """Size, in the unit of the kind's option. None: the kind has no size."""
    start_s: float
    """Start of the fault, s."""
    stop_s: float | None
    """End of the fault, s. None: the fault lasts to the end of the recording."""
    detected_at_s: float | None = None
    """Time of the first declaration of one of its channels, s. None: not detected."""
    delay_s: float | None = None
    """Time from the start to the detection, s."""
    detected_as: str | None = None
    """State after the first declaration."""
    isolated: bool = False
    """Whether all its channels were declared faulty, each one alone."""
    isolated_at_s: float | None = None
    """Time of the isolation, s."""
    isolation_delay_s: float | None = None
    """Time from the start to the isolation, s."""
    declared_channels: tuple[str, ...] = ()
    """Channels of the first declaration, and faulty channels that were declared alone later."""
    declared_before: bool = False
    """Whether all its channels were already declared when the fault began."""
    outcome: str = OutcomeKind.MISSED.value
    """Value of `OutcomeKind`, as in a sweep."""

    @property
    def other_channels(self) -> list[str]:
        """Declared channels without this fault."""
        return [name for name in self.declared_channels if name not in self.channels]


@dataclass(frozen=True)
class StateChange:
    """A change of the state of a channel."""

    channel: str
    """Name of the channel."""
    at_s: float
    """Time, s from the first message."""
    state: str
    """State after the change."""
    before: str
    """State before the change."""
    reason: str
    """Reason in words. Empty: none."""
    group: tuple[str, ...]
    """Channels of which one is faulty, or only this channel if it is declared alone."""
    error: float | None
    """Estimated error of the channel. None: the method estimates none."""
    measured_in: str = RATE.unit
    """Unit of the error: rad/s, or m/s^2 for an accelerometer."""

    @property
    def declares(self) -> bool:
        """Whether the change declares a fault of the channel, or of one of a set."""
        return self.state in DECLARED

    @property
    def named(self) -> tuple[str, ...]:
        """The channel, or all channels of the set."""
        return (
            tuple(dict.fromkeys((self.channel, *self.group)))
            if self.state == "AMBIGUOUS"
            else (self.channel,)
        )


@dataclass(frozen=True)
class FaultEffect:
    """Root mean square effect of the injected faults on the rate, rad/s. None: no sample."""

    before_detection: float | None = None
    """Effect on the fused rate before the detection, rad/s."""
    after_detection: float | None = None
    """Effect on the fused rate after the detection, rad/s."""
    without_monitor: float | None = None
    """Effect on the least-squares rate of all channels, rad/s."""


@dataclass(frozen=True)
class Scores:
    """Injected faults against declarations."""

    samples: int
    """Number of samples."""
    duration_s: float
    """Time from the first sample to the last, s."""
    faults: tuple[Outcome, ...]
    """Results for the injected faults."""
    declared: tuple[StateChange, ...]
    """Declarations that no injected fault explains."""
    fault_effect_rad_s: FaultEffect
    """Effect of the faults on the rate, rad/s."""
    start_s: float
    """Time of the first sample, s from the first message."""
    samples_judged: int
    """Number of judged samples."""
    samples_with_rate: int
    """Number of samples with a fused rate."""
    alarms: int
    """Number of samples with an alarm."""
    events: tuple[StateChange, ...]
    """All changes of state."""

    @property
    def end_s(self) -> float:
        """Time of the last sample, s from the first message."""
        return self.start_s + self.duration_s

    @property
    def struck(self) -> set[str]:
        """Channels with an injected fault."""
        return {name for fault in self.faults for name in fault.channels}

    @property
    def isolated(self) -> int:
        """Number of faults that were isolated."""
        return sum(fault.isolated for fault in self.faults)


GRACE = 1.0
"""Time after the end of a fault in which a declaration is still attributed to the fault, s."""
SQUARED = 1e150
"""Values below this have finite squares, and finite sums of squares."""


class Followed:
    """One injected fault, the indices of its channels, and its result so far."""

    def __init__(
        self, fault: Fault, channels: Sequence[int], names: Sequence[str]
    ) -> None:
        self.fault = fault
        self.channels = channels
        self.begun = False
        struck = tuple(names[i] for i in channels)
        self.outcome = Outcome(
            fault.channel,
            struck,
            fault.kind.name,
            fault.size,
            fault.start,
            finite(fault.stop),
        )
        self.detected_stamp: int | None = None
        """Stamp of the first declaration of one of its channels, ns."""
        self._declared: dict[str, bool] = {}
        """Declared channels, and whether each was declared alone."""
        self.false: set[str] = set()
        """States in which healthy channels were declared during the fault."""

    def explains(self, since: float, channels: Collection[str]) -> bool:
        """Whether the fault explains a declaration of some channels at a time, s."""
        return self.is_active(since) and not set(channels).isdisjoint(
            self.outcome.channels
        )

    def is_active(self, since: float) -> bool:
        """Whether the fault can cause a declaration at a time, s."""
        return self.fault.start <= since < self.fault.stop + GRACE

    def add(self, stamp: int, change: StateChange) -> None:
        """Add a declaration that this fault explains."""
        own = self.outcome
        at = change.at_s
        delay = round(change.at_s - self.fault.start, 9)
        if self.detected_stamp is None:
            self.detected_stamp = stamp
            own = replace(
                own, detected_at_s=at, delay_s=delay, detected_as=change.state
            )
        for name in change.named:
            # Later declarations of other channels have other reasons.
            if stamp == self.detected_stamp or name in own.channels:
                self._declared.setdefault(name, False)
        if change.state != "AMBIGUOUS":
            self._declared[change.channel] = True
            if not own.isolated and all(
                self._declared.get(name) for name in own.channels
            ):
                own = replace(
                    own, isolated=True, isolated_at_s=at, isolation_delay_s=delay
                )
        self.outcome = replace(own, declared_channels=tuple(self._declared))

    def result(self) -> Outcome:
        """Return the result so far."""
        false = self.false
        found = self.detected_stamp is not None
        kind = outcome_of(
            "FAULTY" in false, self.outcome.isolated, found, "AMBIGUOUS" in false
        )
        return replace(self.outcome, outcome=kind.value)


class Evaluation:
    """Scores one monitor on one stream with the faults of an injector, block after block."""

    def __init__(
        self, injector: Injector, geometry: Geometry, names: Sequence[str] = ()
    ) -> None:
        """``geometry``: axes of the gyros. ``names``: names of all channels. Empty: the gyros."""
        self.injector = injector
        self.names = tuple(names) or geometry.channel_names
        n = len(self.names)
        pairs = zip(injector.faults, injector.channels, strict=True)
        self.faults = [
            Followed(fault, channels, self.names) for fault, channels in pairs
        ]
        self.events: list[StateChange] = []
        self.samples = 0
        self._counts = np.zeros(3, dtype=np.int64)
        """Numbers of samples that were judged, had a rate, had an alarm."""
        self.without_rate = 0
        """Number of samples without a fused rate after the first one with a rate."""
        self.without_rate_from: float | None = None
        """Time of the first sample without a rate, s from the first message."""
        self._has_had_rate = False
        self._unexplained: list[StateChange] = []
        self._residuals = np.zeros((2, n))
        """Sum of squared residuals and their number, for each channel while OK."""
        self._least_squares = geometry.least_squares
        self._state = [ChannelState.OK] * n
        self._declared: dict[int, ChannelState] = {}
        self._first: int | None = None
        self.last = 0
        """Stamp of the last sample, ns."""
        self._effects = np.zeros((2, 3))
        """Sum of squares and number of the effects before detection, after, and without a monitor."""

    def add(self, output: Output, clean: Array | None = None) -> None:
        """Add the next samples.

        ``clean`` (N, 3): rate that the monitor fuses without the faults, rad/s. NaN: not compared.
        """
        if len(output) == 0:
            return
        judged = np.isfinite(output.threshold)
        self.samples += len(output)
        self._counts += (
            int(judged.sum()),
            int(output.valid.sum()),
            int(output.alarm.sum()),
        )
        self._count_missing_rates(output)
        is_small = np.abs(output.residual) < SQUARED
        fine = (output.state == ChannelState.OK) & is_small
        self._residuals += (
            (np.where(fine, output.residual, 0.0) ** 2).sum(axis=0),
            fine.sum(axis=0),
        )
        self._first = int(output.stamp[0]) if self._first is None else self._first
        self.last = int(output.stamp[-1])
        for event in output.events:
            time = self.time(event.stamp)
            self._begin(time)
            self._add_event(event, round(time, 9))
        self._begin(self.time(self.last))
        if clean is not None:
            undetected = np.zeros(len(output), dtype=bool)
            active = self.injector.active(output.stamp)
            for one, rows in zip(self.faults, active.T, strict=True):
                if not one.outcome.declared_before:
                    until = (
                        self.last if one.detected_stamp is None else one.detected_stamp
                    )
                    undetected |= rows & (output.stamp <= until)
            effect = output.rate - clean
            self._add_effect(0, effect[undetected])
            self._add_effect(1, effect[active.any(axis=1) & ~undetected])

    def _count_missing_rates(self, output: Output) -> None:
        """Count the samples without a rate. Those before the first rate belong to the start-up."""
        rows = np.flatnonzero(~output.valid)
        if not self._has_had_rate:
            if not output.valid.any():
                return
            self._has_had_rate = True
            rows = rows[rows > int(output.valid.argmax())]
        if len(rows) and self.without_rate_from is None:
            first = int(output.stamp[rows[0]])
            self.without_rate_from = round(self.time(first), 9)
        self.without_rate += len(rows)

    def add_unmonitored(self, faulty: Block, healthy: Block) -> None:
        """Add the effect on the least-squares rate of all channels. NaN: not compared."""
        rows = self.injector.active(faulty.stamp).any(axis=1)
        if rows.any():
            # A recording may contain infinite values.
            with np.errstate(invalid="ignore", over="ignore"):
                effect = (faulty.z[rows] - healthy.z[rows]) @ self._least_squares.T
            self._add_effect(2, effect)

    def _add_effect(self, which: int, effect: Array) -> None:
        """Add errors (k, 3) of the rate that are finite and not too large."""
        usable = (np.abs(effect) < SQUARED).all(axis=1)
        effect = effect[usable]
        self._effects[:, which] += float((effect**2).sum()), len(effect)

    def time(self, stamp: int) -> float:
        """Return the time of a stamp, ns, in s from the first message."""
        return float(self.injector.time(np.array([stamp]))[0])

    def begin_stretch(self) -> None:
        """Clear all declarations."""
        self._state = [ChannelState.OK] * len(self.names)
        self._declared = {}

    def _begin(self, time: float) -> None:
        """Mark the faults that began up to a time, s, before the sample of this time is scored."""
        for one in self.faults:
            if not one.begun and one.fault.start <= time:
                before = all(self._state[i] in ALONE for i in one.channels)
                one.begun, one.outcome = (
                    True,
                    replace(one.outcome, declared_before=before),
                )

    def _add_event(self, event: Event, time: float) -> None:
        self._state[event.channel] = event.after
        change = StateChange(
            channel=self.names[event.channel],
            at_s=time,
            state=event.after.name,
            before=event.before.name,
            reason=event.reason.value,
            group=tuple(self.names[i] for i in event.group),
            error=finite(event.error),
            measured_in=event.unit,
        )
        self.events.append(change)
        if event.after in (ChannelState.OK, ChannelState.UNCHECKED):
            self._declared.pop(event.channel, None)
        if (
            event.after not in DECLARED_STATES
            or self._declared.get(event.channel) == event.after
        ):
            # A declared channel that was silent for a while is not declared anew.
            return
        if event.declares:
            self._declared[event.channel] = event.after
        explaining = [one for one in self.faults if one.explains(time, change.named)]
        for one in explaining:
            one.add(event.stamp, change)
        if not explaining and event.declares:
            self._unexplained.append(change)
            for one in [one for one in self.faults if one.is_active(time)]:
                one.false.add(change.state)

    @property
    def residual_rms(self) -> list[float | None]:
        """Root mean square residual of each channel while OK, rad/s. None: never OK."""
        return [rms(*one) for one in self._residuals.T.tolist()]

    def scores(self) -> Scores:
        """Return the scores so far."""
        first = self.last if self._first is None else self._first
        judged, with_rate, alarms = self._counts.tolist()
        return Scores(
            samples=self.samples,
            duration_s=round((self.last - first) * 1e-9, 9),
            faults=tuple(one.result() for one in self.faults),
            declared=tuple(self._unexplained),
            fault_effect_rad_s=FaultEffect(
                *(rms(*one) for one in self._effects.T.tolist())
            ),
            start_s=0.0 if self._first is None else round(self.time(first), 9),
            samples_judged=judged,
            samples_with_rate=with_rate,
            alarms=alarms,
            events=tuple(self.events),
        )


def rms(squares: float, count: float) -> float | None:
    """Return the root mean square of a sum of squares. None: no value."""
    return math.sqrt(squares / count) if count else None


# Counts of trials, which add up over blocks, and estimates from counts


Z95 = 1.959963984540054
"""Normal quantile of a two-sided 95 % interval."""


def added(a: Any, b: Any) -> Any:
    """Add the results of two blocks of trials: numbers, None, lists and mappings, item by item."""
    if a is None:
        return b
    if isinstance(a, Mapping):
        sums = {name: added(a.get(name), value) for name, value in b.items()}
        return {**a, **sums}
    if isinstance(a, list):
        return [added(x, y) for x, y in zip(a, b, strict=True)]
    return a + b


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % interval. NaN: no trials."""

    #: The figure.
    value: float
    #: Lower end of the interval.
    low: float
    #: Upper end of the interval.
    high: float


def share(count: float, trials: float, z: float = Z95) -> Estimate:
    """Return a share of trials with its 95 % interval (Wilson 1927).

    Numbers need not be whole. ``z``: normal quantile of the interval.
    """
    if trials == 0:
        return Estimate(math.nan, 0.0, 1.0)
    p = count / trials
    spread = z**2 / trials
    centre = (p + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(p * (1 - p) / trials + spread / (4 * trials))
    low = 0.0 if count == 0 else max(centre - half, 0.0)
    high = 1.0 if count == trials else min(centre + half, 1.0)
    return Estimate(p, low, high)


def mean_of(total: float, squares: float, count: int) -> Estimate | None:
    """Return the mean with its 95 % interval from a sum and a sum of squares. None: no value."""
    if count == 0:
        return None
    mean = total / count
    error = math.sqrt(max(squares / count - mean**2, 0.0) / count)
    return Estimate(mean, mean - Z95 * error, mean + Z95 * error)


def quantiles(histogram: Mapping[str, int]) -> dict[str, int | None]:
    """Return median and other quantiles of whole numbers, counted as ``{"number": count}``.

    None: no number.
    """
    counts = sorted((int(number), count) for number, count in histogram.items())
    reached = list(accumulate(count for _, count in counts))
    found: dict[str, int | None] = {}
    for level in (0.5, 0.9, 0.99):
        at_least = (
            n
            for (n, _), k in zip(counts, reached, strict=True)
            if k >= level * reached[-1]
        )
        found[f"p{100 * level:g}"] = next(at_least, None)
    return found


def finite(value: float) -> float | None:
    """Return a value, or None if the value is not finite."""
    return value if math.isfinite(value) else None
