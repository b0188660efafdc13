# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the pipeline gives for a block of samples: the figures of each sample, and changes of state as events."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.channel_set import members
from fdi_ros.core.compiled import allocate
from fdi_ros.core.output import REASONS, ChannelState, OutputRow, Reason

Array = NDArray[np.float64]

__all__ = ["ChannelState", "Event", "Events", "Output", "Reason"]

_FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
"""Where the nine entries of a symmetric (3, 3) matrix stand in its upper triangle."""
_FLAG = np.dtype(np.bool_)


@dataclass(frozen=True)
class Event:
    """One change of state of one channel."""

    stamp: int
    """Stamp of the sample that brought it, ns."""
    channel: int
    before: ChannelState
    after: ChannelState
    reason: Reason
    group: tuple[int, ...]
    """AMBIGUOUS: the channels one of which is faulty; otherwise the channel alone."""
    error: float
    """Estimated error of the channel, rad/s; 0 where the reason is neither disagreement nor drift."""

    row: int = field(default=0, compare=False)
    """Row of that sample in its output."""

    @property
    def declares(self) -> bool:
        """Whether this is a declaration: the channel is faulty, or one of a named set is."""
        return self.after in (ChannelState.FAULTY, ChannelState.AMBIGUOUS)


class Events(Sequence[Event]):
    """Changes of state in order, made from their records when they are looked at.

    Parameters
    ----------
    rows
        (E,) records.
    """

    def __init__(self, rows: NDArray[Any]) -> None:
        self.rows = rows

    def __len__(self) -> int:
        return len(self.rows)

    @overload
    def __getitem__(self, index: int) -> Event: ...
    @overload
    def __getitem__(self, index: slice) -> Events: ...
    def __getitem__(self, index: int | slice) -> Event | Events:
        if isinstance(index, slice):
            return Events(self.rows[index])
        return _event(self.rows[index])

    def __iter__(self) -> Iterator[Event]:
        return map(_event, self.rows)


def _event(row: Any) -> Event:
    mask = int(row["group"])
    return Event(
        stamp=int(row["stamp"]),
        channel=int(row["channel"]),
        before=ChannelState(row["before"]),
        after=ChannelState(row["after"]),
        reason=REASONS[row["reason"]],
        group=members(mask),
        error=float(row["error"]),
        row=int(row["row"]),
    )


class Output:
    """Results for N consecutive samples of n channels.

    Parameters
    ----------
    rows
        (N,) records of `fdi_ros.core.output.Output`.
    n
        Number of channels.
    events
        Changes of state within these samples, in order.
    """

    def __init__(self, rows: NDArray[Any], n: int, events: Sequence[Event] = ()) -> None:
        self.rows = rows
        self.n = n
        self.events = events

    def __len__(self) -> int:
        return len(self.rows)

    @classmethod
    def from_arrays(cls, n: int, events: Sequence[Event] = (), **fields: Any) -> Output:
        """Output made of arrays, named as the attributes; the covariance as (N, 3, 3)."""
        rows = allocate(OutputRow, len(fields["stamp"]))
        for name, values in fields.items():
            if name == "covariance":
                rows[name] = np.reshape(values, (-1, 9))[:, [0, 1, 2, 4, 5, 8]]
            elif name in ("state", "residual"):
                rows[name][:, :n] = values
            else:
                rows[name] = values
        return cls(rows, n, events)

    @property
    def stamp(self) -> NDArray[np.int64]:
        """(N,) ns."""
        return self.rows["stamp"]

    @property
    def rate(self) -> Array:
        """(N, 3) fused body rate, rad/s; NaN where there is none: never to be published."""
        return self.rows["rate"]

    @property
    def covariance(self) -> Array:
        """(N, 3, 3) of the fused rate, (rad/s)^2; NaN where there is none."""
        return np.asarray(self.rows["covariance"][:, _FULL].reshape(-1, 3, 3))

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(N,) whether there is a fused rate."""
        return self.rows["valid"].view(_FLAG)

    @property
    def statistic(self) -> Array:
        """(N,) the detector's; NaN where the sample could not be judged."""
        return self.rows["statistic"]

    @property
    def threshold(self) -> Array:
        """(N,) the detector's; NaN where the sample could not be judged."""
        return self.rows["threshold"]

    @property
    def alarm(self) -> NDArray[np.bool_]:
        """(N,) the detector's, before confirmation."""
        return self.rows["alarm"].view(_FLAG)

    @property
    def state(self) -> NDArray[np.uint8]:
        """(N, n) ChannelState of each channel after the sample."""
        return np.asarray(self.rows["state"][:, : self.n])

    @property
    def residual(self) -> Array:
        """(N, n) bias-free channel minus fused rate along its axis, rad/s; NaN where either is missing."""
        return np.asarray(self.rows["residual"][:, : self.n])

    @property
    def level(self) -> Array:
        """(N, 3) protection level of the fused rate, rad/s; inf where there is none."""
        return self.rows["level"]
