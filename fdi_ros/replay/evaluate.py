# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What was injected against what was declared: delays, names, the effect on the fused rate."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.decision import ChannelState
from fdi_ros.faults.fault import Fault, Injector
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Array, Block
from fdi_ros.monitor.output import Event, Output
from fdi_ros.monitor.status import ChannelStatus
from fdi_ros.replay.episodes import Episode, Story
from fdi_ros.replay.outcomes import ALONE, finite, outcome_of
from fdi_ros.replay.size import SQUARED
from fdi_ros.replay.summary import UNCHECKED_STATES, ChannelResult, FaultEffect, Outcome, Scores, StateChange

GRACE = 1.0  # a declaration this long after the stop of a fault is attributed to it, s
_DECLARED = (*ALONE, ChannelState.AMBIGUOUS)
_UNCHECKED = np.isin(np.arange(len(ChannelState)), [ChannelState[name] for name in UNCHECKED_STATES])
"""By state, whether nothing checks a channel."""


class Followed:
    """One injected fault, the numbers of the channels that it is injected into, and what has become of it so far."""

    def __init__(self, fault: Fault, channels: Sequence[int], names: Sequence[str]) -> None:
        self.fault, self.channels = fault, channels
        struck = tuple(names[i] for i in channels)
        self._asked = Outcome(fault.channel, struck, fault.kind.name, fault.size, fault.start, finite(fault.stop))
        self._found: dict[str, Any] = {}  # what is to be changed of that
        self.declared_before: bool | None = None
        """Whether all its channels were declared when it began; None: it has not begun."""
        self.detected_stamp: int | None = None  # of the first declaration that names one of its channels, ns
        self._declared: dict[str, bool] = {}  # channels that were declared, and whether by themselves
        self.false: set[str] = set()  # states in which healthy channels were declared while it lasted

    def explains(self, since: float, channels: Collection[str]) -> bool:
        """Whether the fault is a reason for a declaration of some channels, or of one of them, at a time, s."""
        return self.is_active(since) and not set(channels).isdisjoint(self._asked.channels)

    def is_active(self, since: float) -> bool:
        """Whether what is declared at a time, s, may come of the fault."""
        return self.fault.start <= since < self.fault.stop + GRACE

    def add(self, stamp: int, change: StateChange) -> None:
        """Take in a declaration that this fault explains."""
        at, delay = change.at_s, round(change.at_s - self.fault.start, 9)
        if self.detected_stamp is None:
            self.detected_stamp = stamp
            self._found |= {"detected_at_s": at, "delay_s": delay, "detected_as": change.state}
        for name in change.named:
            # Other channels that are named later have reasons of their own.
            if stamp == self.detected_stamp or name in self._asked.channels:
                self._declared.setdefault(name, False)
        if change.state != "AMBIGUOUS":
            self._declared[change.channel] = True
            if "isolated" not in self._found and all(self._declared.get(name) for name in self._asked.channels):
                self._found |= {"isolated": True, "isolated_at_s": at, "isolation_delay_s": delay}

    def outcome(self) -> Outcome:
        """Return what has become of it."""
        isolated, found, false = "isolated" in self._found, self.detected_stamp is not None, self.false
        came_of_it = outcome_of("FAULTY" in false, isolated, found, "AMBIGUOUS" in false)
        own = replace(self._asked, declared_channels=tuple(self._declared), outcome=came_of_it.value)
        return replace(own, declared_before=bool(self.declared_before), **self._found)


class Evaluation:
    """Scores one monitor on one stream with the faults of an injector, block after block."""

    def __init__(self, injector: Injector, geometry: Geometry) -> None:
        self.injector = injector
        self.names = geometry.channel_names
        pairs = zip(injector.faults, injector.channels, strict=True)
        self._faults = [Followed(fault, channels, self.names) for fault, channels in pairs]
        self._unexplained: list[StateChange] = []
        self._events: list[StateChange] = []
        self.samples = self._judged = self._with_rate = self._alarms = 0
        self._unchecked = np.zeros(geometry.n)  # samples in which nothing checked the channel
        self._residuals = np.zeros((2, geometry.n))
        """Of each channel while it is OK: sum of the squared residuals, and their number."""
        self._least_squares = geometry.least_squares
        self._state = [ChannelState.OK] * geometry.n
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
        self._with_rate += int(output.valid.sum())
        self._judged += int(judged.sum())
        self._alarms += int(output.alarm.sum())
        self._unchecked += (_UNCHECKED[output.state] | ~judged[:, None]).sum(axis=0)
        fine = (output.state == ChannelState.OK) & (np.abs(output.residual) < SQUARED)
        self._residuals += (np.where(fine, output.residual, 0.0) ** 2).sum(axis=0), fine.sum(axis=0)
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
            for one, rows in zip(self._faults, active.T, strict=True):
                if not one.declared_before:
                    until = self.last if one.detected_stamp is None else one.detected_stamp
                    undetected |= rows & (output.stamp <= until)
            effect = output.rate - clean
            self._add_effect(0, effect[undetected])
            self._add_effect(1, effect[active.any(axis=1) & ~undetected])

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

    def channel_at(self, end: float, i: int, status: ChannelStatus) -> ChannelResult:
        """Return a channel as it was at a time near the end, s, with what its status at the end says beside."""
        changes = [one for one in self._events if one.channel == self.names[i]]
        before = [one for one in changes if one.at_s <= end]
        state, since, reason = status.state.name, None, status.reason.value
        if before:
            state, since, reason = before[-1].state, before[-1].at_s, before[-1].reason
        elif changes:
            state, reason = changes[0].before, ""
        return ChannelResult(
            name=self.names[i],
            state=state,
            since_s=since,
            reason=reason,
            bias_followed=status.drift,
            noise=status.noise or None,
            unchecked=float(self._unchecked[i]) / max(1, self.samples),
            residual_rms_rad_s=_rms(*self._residuals[:, i].tolist()),
        )

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

        def explaining(one: Episode) -> tuple[str, ...]:
            known = [followed.fault for followed in self._faults if followed.explains(one.start_s, one.ever)]
            return tuple(f"{fault.kind.name} on {fault.channel}" for fault in known)

        return replace(story, episodes=tuple(replace(one, injected=explaining(one)) for one in story.episodes))

    def _begin(self, time: float) -> None:
        """Note the faults that have begun up to this time, s: before what the sample of this time brings."""
        for one in self._faults:
            if one.declared_before is None and one.fault.start <= time:
                one.declared_before = all(self._state[i] in ALONE for i in one.channels)

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
        explaining = [one for one in self._faults if one.explains(time, change.named)]
        for one in explaining:
            one.add(event.stamp, change)
        if not explaining and event.declares:
            self._unexplained.append(change)
            for one in self._faults:
                if one.is_active(time):
                    one.false.add(change.state)

    def scores(self) -> Scores:
        """Return the figures."""
        first = self.last if self._first is None else self._first
        return Scores(
            samples=self.samples,
            duration_s=round((self.last - first) * 1e-9, 9),
            faults=tuple(one.outcome() for one in self._faults),
            declared=tuple(self._unexplained),
            fault_effect_rad_s=FaultEffect(*(_rms(*one) for one in self._effects.T.tolist())),
            start_s=0.0 if self._first is None else round(self.time(first), 9),
            samples_judged=self._judged,
            samples_with_rate=self._with_rate,
            alarms=self._alarms,
            events=tuple(self._events),
        )


def _rms(squares: float, count: float) -> float | None:
    """Root mean square of a sum of squares; None of nothing."""
    return math.sqrt(squares / count) if count else None
