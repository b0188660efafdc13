"""What the pipeline says: states, events, the fused rate, and a snapshot of the whole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class ChannelState(IntEnum):
    """State of one channel; the number is what ``~/integrity`` carries."""

    OK = 0
    """Delivers, is checked against the others and agrees."""
    SUSPECT = 1
    """Left out of the fused rate for now: under suspicion, not confirmed."""
    AMBIGUOUS = 2
    """One of a named set of channels is faulty; the evidence cannot tell which."""
    FAULTY = 3
    """Declared faulty and left out."""
    STALE = 4
    """Gives nothing, or nothing new."""
    UNCHECKED = 5
    """Delivers, but nothing can check it: too few others, bias not learned, or the detector cannot run."""
    EXCLUDED = 6
    """Taken out by the operator."""


class Reason(str, Enum):
    """Why a channel is in its state, in words."""

    NONE = ""
    DISAGREES = "disagrees with the others"
    NON_FINITE = "not a finite number"
    OUT_OF_RANGE = "out of range"
    STUCK = "stuck: repeats one value while the others move"
    FROZEN = "frozen: has repeated one value for long"
    NO_DATA = "gives no data"
    TOO_FEW = "too few channels left to check it"
    LATELY = "too few of its last samples could be checked"
    CANNOT_RUN = "the detector cannot run on the channels left"
    BIAS = "bias not learned yet"
    OPERATOR = "taken out by the operator"


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
    """Estimated error of the channel, rad/s; 0 where the reason is no disagreement."""

    @property
    def declares(self) -> bool:
        """Whether this is a declaration: the channel is faulty, or one of a named set is."""
        return self.after in (ChannelState.FAULTY, ChannelState.AMBIGUOUS)


@dataclass(frozen=True)
class Output:
    """What the pipeline says of N consecutive samples."""

    stamp: NDArray[np.int64]
    """(N,) ns."""
    rate: Array
    """(N, 3) fused body rate, rad/s; NaN where there is none: never to be published."""
    covariance: Array
    """(N, 3, 3) of the fused rate, (rad/s)^2; NaN where there is none."""
    valid: NDArray[np.bool_]
    """(N,) whether there is a fused rate."""
    statistic: Array
    """(N,) the detector's; NaN where the sample could not be judged."""
    threshold: Array
    """(N,) the detector's; NaN where the sample could not be judged."""
    alarm: NDArray[np.bool_]
    """(N,) the detector's, before confirmation."""
    state: NDArray[np.uint8]
    """(N, n) ChannelState of each channel after the sample."""
    residual: Array
    """(N, n) bias-free channel minus fused rate along its axis, rad/s; NaN where either is missing."""
    events: tuple[Event, ...]
    """Changes of state within these samples, in order."""

    def __len__(self) -> int:
        return len(self.stamp)

    @classmethod
    def nothing(cls, stamp: NDArray[np.int64], state: NDArray[np.uint8]) -> Output:
        """Output on samples (N,) that were not judged and gave no rate, with states (N, n)."""
        unknown, no = np.full(len(stamp), np.nan), np.zeros(len(stamp), dtype=bool)
        rate, covariance = np.full((len(stamp), 3), np.nan), np.full((len(stamp), 3, 3), np.nan)
        residual = np.full(state.shape, np.nan)
        return cls(stamp, rate, covariance, no, unknown, unknown.copy(), no.copy(), state, residual, ())

    def first(self, rows: int) -> Output:
        """Return the output on the first rows alone, without events."""
        return replace(self, events=(), **{name: getattr(self, name)[:rows] for name in _ARRAYS})

    @staticmethod
    def joined(parts: Sequence[Output]) -> Output:
        """Put consecutive outputs together."""
        arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS}
        return replace(parts[0], events=tuple(event for part in parts for event in part.events), **arrays)


_ARRAYS = tuple(f.name for f in fields(Output) if f.name != "events")


@dataclass(frozen=True)
class ChannelStatus:
    """One channel as it stands."""

    name: str
    state: ChannelState
    reason: Reason
    since: int
    """Stamp of the sample that brought the state, ns; 0 before the first sample."""
    group: tuple[str, ...]
    """AMBIGUOUS: names of the set one of which is faulty."""
    error: float
    """Estimated error when declared or suspected, rad/s."""
    residual: float
    """Of the last sample, rad/s; NaN where missing."""
    last_received: int
    """Stamp of the last sample it delivered, ns; 0 if none."""
    samples: int
    non_finite: int
    out_of_range: int
    stuck: int
    missing: int


@dataclass(frozen=True)
class Status:
    """The whole monitor as it stands after the last sample."""

    stamp: int
    """Of the last sample, ns; 0 before the first."""
    samples: int
    detector: str
    channels: tuple[ChannelStatus, ...]
    statistic: float
    threshold: float
    has_rate: bool
    """Whether the last sample gave a fused rate."""
    can_detect: tuple[str, ...]
    """Channels whose fault would be seen."""
    can_isolate: tuple[str, ...]
    """Channels whose fault would be seen and named."""
    bias: tuple[float, ...]
    """Subtracted from each channel, rad/s."""
    bias_state: str
    """Words: fixed, learned, learning, refused and why."""
    note: str
    """Why checking is limited, in words; empty if it is not."""
    protection_level: tuple[float, float, float] = (math.inf,) * 3
    """Of the fused rate in the last sample, a body axis each, rad/s; inf: none can be given."""
    protection_level_after_loss: tuple[float, float, float] = (math.inf,) * 3
    """What it becomes when one more channel is lost, on each axis the worst one, rad/s."""
