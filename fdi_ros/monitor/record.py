"""What stands after the last sample: the state of every channel, since when and why."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros.monitor.bias import BiasLearner
from fdi_ros.monitor.capability import Capability
from fdi_ros.monitor.health import Condition, Health
from fdi_ros.monitor.integrity import Integrity
from fdi_ros.monitor.output import ChannelState, ChannelStatus, Event, Output, Reason, Status

Array = NDArray[np.float64]


class Record:
    """Keeps the last state of every channel and tells its changes as events."""

    def __init__(self, n: int) -> None:
        self.state = np.full(n, ChannelState.UNCHECKED, dtype=np.uint8)
        self._reason = [Reason.NO_DATA] * n
        self._since = np.zeros(n, dtype=np.int64)
        self._error = np.zeros(n)
        self._group: tuple[int, ...] = ()
        self._last: Output | None = None
        self._samples = 0

    def first_event(self, state: NDArray[np.uint8]) -> int:
        """First row of states (N, n) that differs from the one before it; N if none does."""
        if len(state) == 1:
            return int(bool((state[0] == self.state).all()))
        before = np.vstack([self.state, state[:-1]])
        changed = (state != before).any(axis=1)
        return int(changed.argmax()) if changed.any() else len(state)

    def take(
        self, output: Output, reasons: Sequence[Reason], error: Array, group: tuple[int, ...]
    ) -> tuple[Event, ...]:
        """Take over the state after an output whose states change in its last row at most; return the changes.

        Parameters
        ----------
        output
            Its events are ignored.
        reasons
            Of each channel's state after the last row.
        error
            (n,) estimated error of each channel at the last row, rad/s.
        group
            The channels that are AMBIGUOUS together.
        """
        events = []
        stamp = int(output.stamp[-1])
        for i in np.flatnonzero(output.state[-1] != self.state).tolist():
            before, after = ChannelState(self.state[i]), ChannelState(output.state[-1, i])
            members = group if after == ChannelState.AMBIGUOUS else (i,)
            self._error[i] = error[i] if reasons[i] == Reason.DISAGREES else 0.0
            events.append(Event(stamp, i, before, after, reasons[i], members, float(self._error[i])))
            self._since[i] = stamp
        self.state = output.state[-1].copy()
        self._reason, self._group = list(reasons), group
        self._last = output
        self._samples += len(output)
        return tuple(events)

    def pass_over(self, output: Output) -> None:
        """Take over an output that changed no state."""
        self._last = output
        self._samples += len(output)

    def status(
        self,
        detector: str,
        names: Sequence[str],
        health: Health,
        capability: Capability,
        bias: BiasLearner,
        integrity: Integrity,
    ) -> Status:
        """Snapshot of everything."""
        last = self._last
        now, after_loss = integrity.standing(last)
        seen = capability.detectable & (self.state != ChannelState.UNCHECKED)
        return Status(
            stamp=0 if last is None else int(last.stamp[-1]),
            samples=self._samples,
            detector=detector,
            channels=tuple(self._channel(i, names, health) for i in range(len(names))),
            statistic=float("nan") if last is None else float(last.statistic[-1]),
            threshold=float("nan") if last is None else float(last.threshold[-1]),
            has_rate=last is not None and bool(last.valid[-1]),
            can_detect=tuple(names[i] for i in np.flatnonzero(seen).tolist()),
            can_isolate=tuple(names[i] for i in np.flatnonzero(capability.isolable & seen).tolist()),
            bias=tuple(bias.bias.tolist()),
            bias_state=bias.words,
            note=capability.note,
            protection_level=now,
            protection_level_after_loss=after_loss,
        )

    def _channel(self, i: int, names: Sequence[str], health: Health) -> ChannelStatus:
        state = ChannelState(self.state[i])
        count = health.counts[:, i]
        received = health.last_received
        return ChannelStatus(
            name=names[i],
            state=state,
            reason=self._reason[i],
            since=int(self._since[i]),
            group=tuple(names[j] for j in self._group) if state == ChannelState.AMBIGUOUS else (),
            error=float(self._error[i]),
            residual=float("nan") if self._last is None else float(self._last.residual[-1, i]),
            last_received=0 if received is None or not health.samples[i] else int(received[i]),
            samples=int(health.samples[i]),
            non_finite=int(count[Condition.NON_FINITE] + count[Condition.NON_FINITE_LASTING]),
            out_of_range=int(count[Condition.OUT_OF_RANGE]),
            stuck=int(health.stuck[i] + count[Condition.FROZEN]),
            missing=int(count[Condition.MISSING] + count[Condition.SILENT]),
        )
