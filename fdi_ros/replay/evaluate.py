# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What was injected against what was declared: delays, names, the effect on the fused rate.

And what a replay must show to pass: ``fdi replay --check 'delay<1 isolated false=0'``, or ``'imu_2.y faulty'``.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.states import ChannelState
from fdi_ros.errors import ConfigError
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.output import Event, Output
from fdi_ros.replay.episodes import MOST_TOLD, Episode, Story, episode_words
from fdi_ros.replay.outcomes import ALONE, Outcome, finite
from fdi_ros.replay.size import SQUARED
from fdi_ros.replay.summary import (
    MOSTLY_JUDGED,
    FaultEffect,
    FaultResult,
    Scores,
    StateChange,
    Summary,
    unchecked_words,
)

GRACE = 1.0
"""A declaration this long after the stop of a fault is attributed to it, s."""
_DECLARED = (*ALONE, ChannelState.AMBIGUOUS)


@dataclass
class FaultTracker:
    """Follows what becomes of one injected fault."""

    fault: Fault
    channels: tuple[int, ...]
    names: Sequence[str]
    """Of all channels."""
    result: FaultResult = field(init=False)
    """What has become of it so far."""
    begun: bool = False
    detected_stamp: int | None = None
    """Of the first declaration that names one of its channels, ns."""
    alone: set[int] = field(default_factory=set)
    """Channels that were declared by themselves."""

    def __post_init__(self) -> None:
        self.result = FaultResult(
            channel=self.fault.channel,
            channels=tuple(self.names[i] for i in self.channels),
            kind=self.fault.kind.name,
            size=self.fault.size,
            start_s=self.fault.start,
            stop_s=finite(self.fault.stop),
        )

    def explains(self, time: float, event: Event) -> bool:
        """Whether the fault is a reason for a declaration at this time, s."""
        active = self.fault.start <= time < self.fault.stop + GRACE
        return active and not set(_named(event)).isdisjoint(self.channels)

    def add(self, time: float, event: Event) -> None:
        """Take in a declaration that this fault explains."""
        named, delay = _named(event), round(time - self.fault.start, 9)
        if self.detected_stamp is None:
            self.detected_stamp = event.stamp
            self.note(detected_at_s=time, delay_s=delay, detected_as=event.after.name, outcome=Outcome.AMBIGUOUS.value)
        elif event.stamp != self.detected_stamp:
            # Other channels that are named later have reasons of their own.
            named = tuple(channel for channel in named if channel in self.channels)
        declared = (*self.result.declared_channels, *(self.names[i] for i in named))
        self.note(declared_channels=tuple(dict.fromkeys(declared)))
        if event.after in ALONE:
            self.alone.add(event.channel)
            if not self.result.isolated and self.alone >= set(self.channels):
                isolated = Outcome.ISOLATED.value
                self.note(isolated=True, isolated_at_s=time, isolation_delay_s=delay, outcome=isolated)

    def note(self, **changes: Any) -> None:
        """Take over what has become of the fault, under the names of `FaultResult`."""
        self.result = replace(self.result, **changes)


def _named(event: Event) -> tuple[int, ...]:
    """Channels that a declaration names: one, or the set of which one is faulty."""
    return (event.channel,) if event.after in ALONE else tuple(dict.fromkeys((event.channel, *event.group)))


@dataclass
class Rms:
    """Root mean square of the length of a vector."""

    squares: float = 0.0
    count: int = 0

    def add(self, vectors: Array) -> None:
        """Take in vectors (k, 3); one that is not finite, or too large to be squared, does not count."""
        vectors = vectors[(np.abs(vectors) < SQUARED).all(axis=1)]
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
        Of the faults in the stream.
    geometry
        Of the monitor: for the plain least-squares rate of all channels.
    """

    def __init__(self, injector: Injector, geometry: Geometry) -> None:
        self.injector = injector
        self.names = geometry.channel_names
        self._faults = [
            FaultTracker(fault, channels, self.names)
            for fault, channels in zip(injector.faults, injector.channels, strict=True)
        ]
        self._unexplained: list[StateChange] = []
        self._events: list[StateChange] = []
        self.samples = self._judged = self._with_rate = self._alarms = 0
        self._least_squares = geometry.least_squares
        self._state = [ChannelState.OK] * geometry.n
        self._declared: dict[int, ChannelState] = {}
        self._first: int | None = None
        self._last = 0
        self._before_detection, self._after_detection, self._without_monitor = Rms(), Rms(), Rms()

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
        self._with_rate += int(output.valid.sum())
        self._judged += int(np.isfinite(output.threshold).sum())
        self._alarms += int(output.alarm.sum())
        self._first = int(output.stamp[0]) if self._first is None else self._first
        self._last = int(output.stamp[-1])
        for event in output.events:
            time = self.time(event.stamp)
            self._begin(time)
            self._add_event(event, round(time, 9))
        self._begin(self.time(self._last))
        if clean is not None:
            self._add_effect(output, clean)

    def add_unmonitored(self, faulty: Block, healthy: Block) -> None:
        """Take in what the faults do to the plain least-squares rate of all channels; NaN: not to be compared."""
        rows = self.injector.active(faulty.stamp).any(axis=1)
        if rows.any():
            # What is recorded may be infinite.
            with np.errstate(invalid="ignore", over="ignore"):
                effect = (faulty.z[rows] - healthy.z[rows]) @ self._least_squares.T
            self._without_monitor.add(effect)

    def time(self, stamp: int) -> float:
        """Seconds from the first sample to a stamp, ns."""
        return float(self.injector.time(np.array([stamp]))[0])

    def times(self, stamp: NDArray[np.int64]) -> Array:
        """Seconds (N,) from the first sample to stamps (N,), ns; to the nanosecond."""
        return np.round(self.injector.time(stamp), 9)

    def begin_stretch(self) -> None:
        """Nothing stands declared any more."""
        self._state = [ChannelState.OK] * len(self.names)
        self._declared = {}

    def explained(self, story: Story) -> Story:
        """Return the story with the injected faults that explain each episode."""
        episodes = tuple(replace(one, injected=tuple(self._explaining(one))) for one in story.episodes)
        return replace(story, episodes=episodes)

    def _explaining(self, one: Episode) -> list[str]:
        return [
            f"{tracker.fault.kind.name} on {tracker.fault.channel}"
            for tracker in self._faults
            if tracker.fault.start <= one.start_s < tracker.fault.stop + GRACE
            and not one.ever.isdisjoint(self.names[i] for i in tracker.channels)
        ]

    def _begin(self, time: float) -> None:
        """Note the faults that have begun up to this time, s: before what the sample of this time brings."""
        for one in self._faults:
            if not one.begun and one.fault.start <= time:
                one.begun = True
                one.note(declared_before=all(self._state[i] in ALONE for i in one.channels))

    def _add_effect(self, output: Output, clean: Array) -> None:
        undetected = np.zeros(len(output), dtype=bool)
        active = self.injector.active(output.stamp)
        for one, rows in zip(self._faults, active.T, strict=True):
            if not one.result.declared_before:
                until = self._last if one.detected_stamp is None else one.detected_stamp
                undetected |= rows & (output.stamp <= until)
        effect = output.rate - clean
        self._before_detection.add(effect[undetected])
        self._after_detection.add(effect[active.any(axis=1) & ~undetected])

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
        )
        self._events.append(change)
        if event.after in (ChannelState.OK, ChannelState.UNCHECKED):
            self._declared.pop(event.channel, None)
        if event.after not in _DECLARED or self._declared.get(event.channel) == event.after:
            # What is declared already and was only hidden for a while (the channel gave nothing) is not declared anew.
            return
        if event.declares:
            self._declared[event.channel] = event.after
        explaining = [one for one in self._faults if one.explains(time, event)]
        for one in explaining:
            one.add(time, event)
        if not explaining and event.declares:
            self._unexplained.append(change)

    def scores(self) -> Scores:
        """Return the figures."""
        first = self._last if self._first is None else self._first
        return Scores(
            samples=self.samples,
            duration_s=round((self._last - first) * 1e-9, 9),
            faults=tuple(one.result for one in self._faults),
            declared=tuple(self._unexplained),
            fault_effect_rad_s=FaultEffect(
                self._before_detection.value, self._after_detection.value, self._without_monitor.value
            ),
            start_s=0.0 if self._first is None else round(self.time(first), 9),
            samples_judged=self._judged,
            samples_with_rate=self._with_rate,
            alarms=self._alarms,
            events=tuple(self._events),
        )


# What a replay must show to pass --------------------------------------------------------------------------------------


_BELOW = {"<": operator.lt, "<=": operator.le}
_ABOVE = {">": operator.gt, ">=": operator.ge}
_COUNT: dict[str, Callable[[float, float], bool]] = {**_BELOW, "=": operator.eq}
_TERM = re.compile(r"([^<>=]*)(<=|>=|<|>|=)?(.*)", re.DOTALL)


def _false_declarations(summary: Summary) -> tuple[float, str]:
    declared = summary.scores.declared
    told = "; ".join(f"{one.channel} {one.state} at {one.at_s:.3f} s" for one in declared[:5])
    which = "declarations that no injected fault explains" if summary.scores.faults else "declarations, of channels"
    return len(declared), f"{len(declared)} {which}{f': {told}' if told else ''}"


def _episodes(summary: Summary) -> tuple[float, str]:
    told = summary.story.declared
    count = len(told) + summary.story.more
    words = "; ".join(episode_words(one) for one in told[:MOST_TOLD])
    return count, f"{count} episode{'s' if count != 1 else ''}{f': {words}' if words else ''}"


def _judged_share(summary: Summary) -> tuple[float, str]:
    judged, samples = summary.scores.samples_judged, summary.scores.samples
    share = judged / max(1, samples)
    return share, f"{judged} of {samples} samples were judged, {share:.4f}"


def _unchecked(summary: Summary) -> tuple[float, str]:
    lost, total = summary.unchecked_channels, len(summary.monitor.channels)
    return len(lost), f"{len(lost)} of {total} channels end unchecked{': ' if lost else ''}{unchecked_words(lost)}"


class Quantity(NamedTuple):
    """Something that a check can ask for."""

    compared: Mapping[str, Callable[[float, float], bool]]
    alone: bool
    """It may stand without a number."""
    measure: Callable[[Summary], tuple[float, str]] | None
    """Its value and how it is said; None: it is of each injected fault."""


QUANTITIES = {
    # Every fault is detected; it is, within so many seconds; it is named by itself, or so within so many seconds.
    "detected": Quantity({}, True, None),
    "delay": Quantity(_BELOW, False, None),
    "isolated": Quantity(_BELOW, True, None),
    # Number of declarations that no injected fault explains; share of the samples that was judged; number of channels
    # that end STALE or UNCHECKED.
    "false": Quantity(_COUNT, False, _false_declarations),
    # Number of episodes in which a fault was declared, injected or not.
    "declared": Quantity(_COUNT, False, _episodes),
    "judged": Quantity(_ABOVE, False, _judged_share),
    "unchecked": Quantity(_COUNT, False, _unchecked),
}
"""Every quantity by name."""


CHANNEL_STATES = ("faulty", "ambiguous", "stale", "ok")
"""What a channel may be asked to have been: declared by itself, in a set, silent; or none of these."""


@dataclass(frozen=True)
class ChannelRequirement:
    """A condition on a channel of a recording, whether a fault was injected or not."""

    text: str
    channels: tuple[str, ...]
    """One, or those of a unit."""
    state: str

    def failures(self, summary: Summary) -> list[str]:
        """Return why a replay does not fulfil it, one line per channel."""
        lines = []
        for name in self.channels:
            episodes = summary.story.episodes
            told = {one.state: one for one in episodes if name in one.channels}
            if self.state == "ambiguous":
                told |= {step.state: one for one in episodes for step in one.steps if name in step.channels}
            if not told if self.state == "ok" else self.state.upper() in told:
                continue
            words = (
                "; ".join(dict.fromkeys(episode_words(one) for one in told.values())) or "nothing was declared of it"
            )
            lines.append(f"{self.text}: {name}: {words}")
        return lines


@dataclass(frozen=True)
class Requirement:
    """One condition, as it was written."""

    text: str
    name: str
    compare: Callable[[float, float], bool] | None = None
    bound: float = 0.0

    def failures(self, summary: Summary) -> list[str]:
        """Return why the summary of a replay does not fulfil it, one line per reason."""
        measure = QUANTITIES[self.name].measure
        if measure is None and not summary.scores.faults:
            told = summary.story.declared
            short = [f"{self.text}: {episode_words(one)}" for one in told if one.state != "FAULTY"]
            return short if told else [f"{self.text}: nothing was declared"]
        if measure is None:
            return [f"{self.text}: {why}" for fault in summary.scores.faults if (why := self._of_fault(fault))]
        value, words = measure(summary)
        return [f"{self.text}: {words}"] if self.compare and not self.compare(value, self.bound) else []

    def _of_fault(self, fault: FaultResult) -> str:
        """Say why a fault does not fulfil it, or nothing."""
        named, when = f"{fault.kind} on {fault.channel}", fault.delay_s
        if when is None:
            missed = "declared before it began: nothing was left to detect" if fault.declared_before else "not detected"
            return f"{named}: {missed}"
        done = "detected"
        if self.name == "isolated":
            done, when = "isolated", fault.isolation_delay_s
        if when is None:
            return f"{named}: detected, not isolated; declared: {', '.join(fault.declared_channels)}"
        if self.compare is None or self.compare(when, self.bound):
            return ""
        return f"{named}: {done} after {when:.3f} s"


Condition = Requirement | ChannelRequirement
"""One that must hold."""
_IMPLIED = (
    Requirement(f"judged>={MOSTLY_JUDGED:g}", "judged", operator.ge, MOSTLY_JUDGED),
    Requirement("unchecked=0", "unchecked", operator.eq, 0.0),
)
"""What must hold where the requirements say nothing of it."""


def parse_check(text: str, faults: int, geometry: Geometry | None = None) -> list[Condition]:
    """Read conditions separated by blanks or commas; all must hold.

    Parameters
    ----------
    text
        ``delay<1 isolated false=0``.
    faults
        Number of faults that are injected.
    geometry
        Of the monitor: its channels and units may be asked for.

    Raises
    ------
    ConfigError
        Naming the part that is wrong and what is allowed.
    """
    parts = re.sub(r"\s*(<=|>=|<|>|=)\s*", r"\1", text).replace(",", " ").split()
    if not parts:
        raise ConfigError(f"--check is empty, expected conditions on: {', '.join(QUANTITIES)}")
    found: list[Condition] = []
    while parts:
        part = parts.pop(0)
        if parts and parts[0].lower() in CHANNEL_STATES:
            found.append(_of_channel(part, parts.pop(0).lower(), geometry))
            continue
        requirement = _parsed(part)
        of_faults = QUANTITIES[requirement.name].measure is None
        if of_faults and not faults and (requirement.name != "isolated" or requirement.compare):
            raise ConfigError(
                f"--check: {part!r} is about injected faults, and none is given by --fault; of a recording as it is ask"
                " declared=0, isolated, or CHANNEL faulty"
            )
        found.append(requirement)
    return found


def _of_channel(name: str, state: str, geometry: Geometry | None) -> ChannelRequirement:
    names = geometry.channel_names if geometry else ()
    own = tuple(one for one in names if one == name or one.startswith(f"{name}."))
    if not own:
        raise ConfigError(f"--check: {f'{name} {state}'!r} names no channel, expected one of: {', '.join(names)}")
    return ChannelRequirement(f"{name} {state}", own, state)


def _parsed(part: str) -> Requirement:
    match = _TERM.fullmatch(part)
    assert match is not None
    name, sign, number = match.groups()
    if name not in QUANTITIES:
        raise ConfigError(f"--check: {part!r} begins with {name!r}, expected one of: {', '.join(QUANTITIES)}")
    quantity = QUANTITIES[name]
    if sign is None:
        if quantity.alone:
            return Requirement(part, name)
        raise ConfigError(f"--check: {part!r} has no bound, expected {_forms(name)}")
    if sign not in quantity.compared:
        raise ConfigError(f"--check: {part!r} is compared by {sign!r}, expected {_forms(name)}")
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not 0 <= bound < math.inf:
        raise ConfigError(f"--check: {part!r} has the bound {number!r}, expected a number from 0 on")
    if _never(name, sign, bound):
        raise ConfigError(f"--check: {part!r} can never hold")
    return Requirement(part, name, quantity.compared[sign], bound)


def _never(name: str, sign: str, bound: float) -> bool:
    """Whether no replay can fulfil a condition: no quantity is below 0, no share above 1, no count a fraction."""
    if name == "judged":
        return bound > 1 or (sign == ">" and bound == 1)
    return (sign == "<" and bound == 0) or (sign == "=" and bound % 1 != 0)


def _forms(name: str) -> str:
    quantity = QUANTITIES[name]
    forms = [name] if quantity.alone else []
    return " or ".join([*forms, *(f"{name}{sign}NUMBER" for sign in quantity.compared)])


def failures(requirements: Sequence[Condition], summary: Summary) -> list[str]:
    """Return why the summary of a replay does not pass, one line per reason; empty: it passes.

    What was mostly not judged does not pass unless the requirements say what is enough, nor do channels that end
    unchecked unless they say how many may.
    """
    named = {requirement.name for requirement in requirements if isinstance(requirement, Requirement)}
    asked = [*requirements, *(one for one in _IMPLIED if requirements and one.name not in named)]
    return [line for requirement in asked for line in requirement.failures(summary)]
