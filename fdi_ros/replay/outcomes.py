# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What came of injected faults, in one vocabulary for replay, sweep, fleet and studies; and counts of many trials.

A replay follows the changes of state (`Evaluation`), a sweep and a study have the states of all samples (`score`).
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

ALONE = (
    ChannelState.FAULTY,
    ChannelState.STALE,
)  # states by which a channel is declared by itself
STANDING = (*ALONE, ChannelState.AMBIGUOUS)


class OutcomeKind(str, Enum):
    """What came of one injected fault; the values are the words of the files that hold outcomes."""

    ISOLATED = "named"  # the faulty channel was declared by itself
    AMBIGUOUS = (
        "in a set"  # it was one of an ambiguity group, and not declared by itself
    )
    MISSED = "silent"  # nothing was declared
    FALSE_GROUP = "false set"  # only groups without it were declared
    FALSE_ISOLATION = "wrong"  # a healthy channel was declared by itself


def outcome_of(
    false_isolation: bool, isolated: bool, in_set: bool, false_group: bool
) -> OutcomeKind:
    """Return what came of a fault: a healthy channel that was declared counts more than that it was found."""
    if false_isolation:
        return OutcomeKind.FALSE_ISOLATION
    if isolated:
        return OutcomeKind.ISOLATED
    if in_set:
        return OutcomeKind.AMBIGUOUS
    return OutcomeKind.FALSE_GROUP if false_group else OutcomeKind.MISSED


class Scored(NamedTuple):
    """What came of one fault, and when."""

    outcome: OutcomeKind
    isolated_after: (
        float  # until the channel was declared by itself, s; inf: it was not
    )
    detected_after: (
        float  # until it was declared by itself or in a group, s; inf: it was not
    )


def standing(output: Output) -> tuple[Mask, Mask]:
    """(N, n) whether a channel stands declared by itself, or silent; and whether it stands in an ambiguity group."""
    return np.isin(output.state, ALONE), np.asarray(
        output.state == ChannelState.AMBIGUOUS
    )


def score(
    alone: Mask, among: Mask, channel: int | None, since: Array, within: float = np.inf
) -> Scored:
    """Say what came of a fault of a channel (None: none is faulty); ``alone`` and ``among`` (N, n) as of `standing`.

    ``since`` (N,) s from the start of the fault. It is isolated, or in a group, if it is so ``within`` so many s; a
    false isolation counts at any time.
    """
    own = [] if channel is None else [channel]
    others, soon = np.delete(alone, own, axis=1), since <= within
    isolated, detected = (
        _first(alone[:, own], since),
        _first(alone[:, own] | among[:, own], since),
    )
    found = isolated <= within and isolated < np.inf
    outcome = outcome_of(
        bool(others.any()),
        found,
        bool(among[:, own][soon].any()),
        bool(among[soon].any()),
    )
    return Scored(outcome, isolated, detected)


def _first(declared: Mask, since: Array) -> float:
    rows = np.flatnonzero(declared.any(axis=1))
    return float(since[rows[0]]) if len(rows) else np.inf


# Changes of state, and what they make of each fault ------------------------------------------------------------------


UNCHECKED_STATES = (
    "STALE",
    "UNCHECKED",
)  # states of a channel that nothing checks, and that no fault was declared of


@dataclass(frozen=True)
class Outcome:
    """What became of one injected fault; times in s from the first message."""

    channel: str  # As it was asked for: one name, or several separated by commas.
    channels: tuple[str, ...]  # Names of the channels that it is injected into.
    kind: str
    size: float | None  # In the unit of the kind's option; None: the kind has no size.
    start_s: float
    stop_s: float | None  # None: it lasts to the end.
    detected_at_s: float | None = (
        None  # Of the first declaration that names one of its channels.
    )
    delay_s: float | None = None  # From its start to its detection, s.
    detected_as: str | None = None  # State that the first declaration brought.
    isolated: bool = False  # All its channels were declared, each by itself.
    isolated_at_s: float | None = None
    isolation_delay_s: float | None = None
    declared_channels: tuple[str, ...] = ()
    """Named by its first declaration, and those of its channels that were named by themselves later."""
    declared_before: bool = False
    """All its channels were declared already when it began: there is nothing left to be detected."""
    outcome: str = (
        OutcomeKind.MISSED.value
    )  # As a sweep has it: one of `fdi_ros.replay.outcomes.OutcomeKind`.

    @property
    def other_channels(self) -> list[str]:
        """Channels that were named with the fault and that it is not injected into."""
        return [name for name in self.declared_channels if name not in self.channels]


@dataclass(frozen=True)
class StateChange:
    """A change of the state of a channel."""

    channel: str
    at_s: float  # s from the first message.
    state: str  # After the change.
    before: str
    reason: str
    group: tuple[
        str, ...
    ]  # Channels of which one is faulty; the channel itself where it is declared by itself.
    error: float | None  # Estimated error of the channel; None: the method gives none.
    measured_in: str = RATE.unit  # Unit of the error: rad/s, of an accelerometer m/s^2.

    @property
    def declares(self) -> bool:
        """Whether this is a declaration: the channel is faulty, or one of a set is."""
        return self.state in DECLARED

    @property
    def named(self) -> tuple[str, ...]:
        """The channels that it is about: the one, or all of the set."""
        return (
            tuple(dict.fromkeys((self.channel, *self.group)))
            if self.state == "AMBIGUOUS"
            else (self.channel,)
        )


@dataclass(frozen=True)
class FaultEffect:
    """Root mean square of what the injected faults did to the fused rate, rad/s; None: no sample to take it of."""

    before_detection: float | None = None
    after_detection: float | None = None
    without_monitor: float | None = None  # To the least-squares rate of all channels.


@dataclass(frozen=True)
class Scores:
    """What was injected against what was declared."""

    samples: int
    duration_s: float
    faults: tuple[Outcome, ...]
    declared: tuple[StateChange, ...]
    """Declarations that no injected fault explains; all of them where none is injected."""
    fault_effect_rad_s: FaultEffect
    start_s: float  # Of the first sample, s from the first message.
    samples_judged: int
    samples_with_rate: int
    alarms: int  # Samples with an alarm.
    events: tuple[StateChange, ...]

    @property
    def end_s(self) -> float:
        """Of the last sample, s from the first message."""
        return self.start_s + self.duration_s

    @property
    def struck(self) -> set[str]:
        """Channels that a fault is injected into."""
        return {name for fault in self.faults for name in fault.channels}

    @property
    def isolated(self) -> int:
        """Number of faults that were isolated."""
        return sum(fault.isolated for fault in self.faults)


GRACE = 1.0  # a declaration this long after the stop of a fault is attributed to it, s
SQUARED = 1e150  # squares of anything smaller are finite, and so are sums of very many
_UNCHECKED = np.isin(
    np.arange(len(ChannelState)), [ChannelState[name] for name in UNCHECKED_STATES]
)
"""By state, whether nothing checks a channel."""


class Followed:
    """One injected fault, the numbers of the channels that it is injected into, and what has become of it so far."""

    def __init__(
        self, fault: Fault, channels: Sequence[int], names: Sequence[str]
    ) -> None:
        self.fault, self.channels, self.begun = fault, channels, False
        struck = tuple(names[i] for i in channels)
        self.outcome = Outcome(
            fault.channel,
            struck,
            fault.kind.name,
            fault.size,
            fault.start,
            finite(fault.stop),
        )
        self.detected_stamp: int | None = (
            None  # of the first declaration that names one of its channels, ns
        )
        self._declared: dict[
            str, bool
        ] = {}  # channels that were declared, and whether by themselves
        self.false: set[str] = (
            set()
        )  # states in which healthy channels were declared while it lasted

    def explains(self, since: float, channels: Collection[str]) -> bool:
        """Whether the fault is a reason for a declaration of some channels, or of one of them, at a time, s."""
        return self.is_active(since) and not set(channels).isdisjoint(
            self.outcome.channels
        )

    def is_active(self, since: float) -> bool:
        """Whether what is declared at a time, s, may come of the fault."""
        return self.fault.start <= since < self.fault.stop + GRACE

    def add(self, stamp: int, change: StateChange) -> None:
        """Take in a declaration that this fault explains."""
        own, at, delay = (
            self.outcome,
            change.at_s,
            round(change.at_s - self.fault.start, 9),
        )
        if self.detected_stamp is None:
            self.detected_stamp = stamp
            own = replace(
                own, detected_at_s=at, delay_s=delay, detected_as=change.state
            )
        for name in change.named:
            # Other channels that are named later have reasons of their own.
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
        """Return what has become of it."""
        false, found = self.false, self.detected_stamp is not None
        kind = outcome_of(
            "FAULTY" in false, self.outcome.isolated, found, "AMBIGUOUS" in false
        )
        return replace(self.outcome, outcome=kind.value)


class Evaluation:
    """Scores one monitor on one stream with the faults of an injector, block after block."""

    def __init__(
        self, injector: Injector, geometry: Geometry, names: Sequence[str] = ()
    ) -> None:
        """``geometry``: of the gyros. ``names``: of all channels; empty: of the gyros."""
        self.injector = injector
        self.names = tuple(names) or geometry.channel_names
        n = len(self.names)
        pairs = zip(injector.faults, injector.channels, strict=True)
        self.faults = [
            Followed(fault, channels, self.names) for fault, channels in pairs
        ]
        self.events: list[StateChange] = []
        self.samples, self._counts = (
            0,
            np.zeros(3, dtype=np.int64),
        )  # those judged, with a rate, with an alarm
        self.without_rate = 0
        """Number of samples without a fused rate after the first one with a rate."""
        self.without_rate_from: float | None = None
        """Time of the first of these samples, s from the first message."""
        self._has_had_rate = False
        self._unexplained: list[StateChange] = []
        self._unchecked = np.zeros(n)  # samples in which nothing checked the channel
        self._residuals = np.zeros((2, n))
        """Of each channel while it is OK: sum of the squared residuals, and their number."""
        self._least_squares = geometry.least_squares
        self._state = [ChannelState.OK] * n
        self._declared: dict[int, ChannelState] = {}
        self._first: int | None = None
        self.last = 0  # stamp of the last sample, ns
        self._effects = np.zeros((2, 3))
        """Of the faults before and after detection, and without a monitor: sum of the squares, and their number."""

    def add(self, output: Output, clean: Array | None = None) -> None:
        """Take in the next samples.

        ``clean`` (N, 3): what the same monitor fuses of them without the faults, rad/s; NaN: not to be compared.
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
        unchecked = [
            _UNCHECKED[half.state] | ~np.isfinite(half.threshold)[:, None]
            for half in output.halves
        ]
        self._unchecked += np.hstack(unchecked).sum(axis=0)
        fine = (output.state == ChannelState.OK) & (np.abs(output.residual) < SQUARED)
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
        """Count the samples without a rate; those before the first rate belong to the start-up."""
        rows = np.flatnonzero(~output.valid)
        if not self._has_had_rate:
            if not output.valid.any():
                return
            self._has_had_rate = True
            rows = rows[rows > int(output.valid.argmax())]
        if len(rows) and self.without_rate_from is None:
            self.without_rate_from = round(self.time(int(output.stamp[rows[0]])), 9)
        self.without_rate += len(rows)

    def add_unmonitored(self, faulty: Block, healthy: Block) -> None:
        """Take in what the faults do to the plain least-squares rate of all channels; NaN: not to be compared."""
        rows = self.injector.active(faulty.stamp).any(axis=1)
        if rows.any():
            # What is recorded may be infinite.
            with np.errstate(invalid="ignore", over="ignore"):
                effect = (faulty.z[rows] - healthy.z[rows]) @ self._least_squares.T
            self._add_effect(2, effect)

    def _add_effect(self, which: int, effect: Array) -> None:
        """Take in errors (k, 3) of the rate; one that is not finite, or too large to be squared, does not count."""
        effect = effect[(np.abs(effect) < SQUARED).all(axis=1)]
        self._effects[:, which] += float((effect**2).sum()), len(effect)

    def time(self, stamp: int) -> float:
        """Seconds from the first message to a stamp, ns."""
        return float(self.injector.time(np.array([stamp]))[0])

    def begin_stretch(self) -> None:
        """Nothing stands declared any more."""
        self._state = [ChannelState.OK] * len(self.names)
        self._declared = {}

    def _begin(self, time: float) -> None:
        """Note the faults that have begun up to this time, s: before what the sample of this time brings."""
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
            event.after not in STANDING
            or self._declared.get(event.channel) == event.after
        ):
            # What is declared already and was only hidden for a while (the channel gave nothing) is not declared anew.
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
    def unchecked(self) -> Array:
        """(n,) share of the samples in which nothing checked a channel."""
        return self._unchecked / max(1, self.samples)

    @property
    def residual_rms(self) -> list[float | None]:
        """Of each channel while OK, rad/s; None: it never was."""
        return [rms(*one) for one in self._residuals.T.tolist()]

    def scores(self) -> Scores:
        """Return the figures."""
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
    """Root mean square of a sum of squares; None of nothing."""
    return math.sqrt(squares / count) if count else None


# Counts of trials, which add up whatever blocks they come from, and the estimates made of them ------------------------


Z95 = 1.959963984540054  # normal quantile of a two-sided 95 % interval


def added(a: Any, b: Any) -> Any:
    """Sum of what two blocks of trials give: numbers, None, and lists or mappings of these, added item by item."""
    if a is None:
        return b
    if isinstance(a, Mapping):
        return {**a, **{name: added(a.get(name), value) for name, value in b.items()}}
    if isinstance(a, list):
        return [added(x, y) for x, y in zip(a, b, strict=True)]
    return a + b


@dataclass(frozen=True)
class Estimate:
    """A figure with its 95 % interval; a value of NaN: no trials."""

    value: float
    low: float
    high: float


def share(count: float, trials: float, z: float = Z95) -> Estimate:
    """Share of trials with its 95 % interval (Wilson 1927); effective numbers need not be whole; z: the quantile."""
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
    """Mean with its 95 % interval from a sum and a sum of squares; None if there is nothing to average."""
    if count == 0:
        return None
    mean = total / count
    error = math.sqrt(max(squares / count - mean**2, 0.0) / count)
    return Estimate(mean, mean - Z95 * error, mean + Z95 * error)


def quantiles(histogram: Mapping[str, int]) -> dict[str, int | None]:
    """Median and more of whole numbers counted as ``{"number": count}``; None if there are none."""
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
    """Return a value, or None where it is not finite."""
    return value if math.isfinite(value) else None
