# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a replay finds, as values and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from fdi_ros.monitor.output import time_index
from fdi_ros.replay.episodes import NOTHING_HAPPENED, Story
from fdi_ros.replay.outcomes import UNCHECKED_STATES, Scores
from fdi_ros.system import require

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class ChannelResult:
    """A channel at the end: with the last sample of all channels that deliver to the end."""

    name: str
    state: str
    since_s: (
        float | None
    )  # When it came into its state, s from the first message; None: it began in it.
    reason: str
    bias_followed: float  # Of its bias against the others, rad/s.
    noise: float | None  # Lately, over noise_std; None: not measured.
    unchecked: float  # Share of the samples in which nothing checked it.
    residual_rms_rad_s: float | None
    """Root mean square of what it differs by from the fused rate while OK; None: it never was."""
    spikes: int = 0
    """Times that a few values were far off, left out of the fused rate."""


@dataclass(frozen=True)
class DelayResult:
    """By how much a unit's stamps are late against the others."""

    unit: str
    late_s: float
    std_s: float


@dataclass(frozen=True)
class BiasResult:
    """The biases at the end."""

    state: str
    value: tuple[float, ...]  # Per channel, rad/s.
    far: tuple[str, ...] = ()
    """Channels that began with more than four ``bias.turn_on_std``: learned, as a fault from before would be."""


@dataclass(frozen=True)
class ProtectionLevel:
    """Bound on the error of the fused rate with one undetected fault, per axis, rad/s; None: none can be given."""

    at_end: tuple[float | None, ...]
    after_one_more_loss: tuple[float | None, ...]


@dataclass(frozen=True)
class MonitorResult:
    """The monitor at the end."""

    channels: tuple[ChannelResult, ...]
    delays: tuple[DelayResult, ...]
    degraded: tuple[
        str, ...
    ]  # What is worse than it should be without being declared, in sentences.
    bias: BiasResult
    note: str
    protection_level: ProtectionLevel
    us_per_sample: float


@dataclass(frozen=True)
class SampleRate:
    """Samples per second, Hz."""

    configured_hz: float
    recorded_hz: float | None  # None: too few samples to say.


@dataclass(frozen=True)
class StreamResult:
    """The recording itself."""

    sample_rate: SampleRate
    origin_ns: (
        int | None
    )  # Stamp of the first message, from which all times count; None: there is none.
    messages: int  # Used.
    malformed: dict[str, int]  # By topic.
    disordered: int
    alignment: dict[str, dict[str, int]]  # Counters by topic.
    damage: tuple[str, ...]


@dataclass(frozen=True)
class Judgement:
    """What a monitor made of a stream."""

    detector: str
    scores: Scores
    monitor: MonitorResult
    story: Story = NOTHING_HAPPENED  # What happened.

    @property
    def unchecked_channels(self) -> list[ChannelResult]:
        """Channels that end without being checked, but for those that a fault is injected into up to the end."""
        lasting = [
            fault
            for fault in self.scores.faults
            if fault.stop_s is None or fault.stop_s >= self.scores.end_s
        ]
        struck = {name for fault in lasting for name in fault.channels}
        return [
            one
            for one in self.monitor.channels
            if one.state in UNCHECKED_STATES and one.name not in struck
        ]


@dataclass(frozen=True)
class AutopilotText:
    """What the autopilot of a flight log said of itself."""

    at_s: float  # s from the first message.
    kind: str  # MSG, ERR (a lane switch of the EKF among them), STATUSTEXT, or the level of PX4.
    text: str


@dataclass(frozen=True, kw_only=True)
class Summary(Judgement):
    """What a monitor made of a recording."""

    bag: str
    stream: StreamResult
    seconds: float  # That the replay took.
    autopilot: tuple[AutopilotText, ...] = ()  # From the first sample to the last.

    def to_pandas(self) -> pandas.DataFrame:
        """Return the changes of state as a table; needs pandas.

        Columns: ``channel``, ``before``, ``state``, ``reason``, ``group`` and ``error`` (rad/s), as of `StateChange`.
        The index is the time of each, as of `fdi_ros.monitor.output.time_index`.
        """
        require("Summary.to_pandas", ("pandas",))
        import pandas

        columns = ["channel", "before", "state", "reason", "group", "error"]
        rows = [
            [getattr(event, name) for name in columns] for event in self.scores.events
        ]
        stamps = [
            (self.stream.origin_ns or 0) + round(event.at_s * 1e9)
            for event in self.scores.events
        ]
        return pandas.DataFrame(rows, index=time_index(stamps), columns=columns)


def as_json(summary: Summary) -> dict[str, Any]:
    """Return the figures under the names of the fields, those of the parts of a summary side by side."""
    return {
        "bag": summary.bag,
        "detector": summary.detector,
        **asdict(summary.scores),
        **asdict(summary.monitor),
        **asdict(summary.stream),
        "stretches": [asdict(one) for one in summary.story.stretches],
        "episodes": [
            {**asdict(one), "duration_s": one.duration_s}
            for one in summary.story.episodes
        ],
        "more_episodes": summary.story.more,
        "autopilot": list(map(asdict, summary.autopilot)),
        "seconds": summary.seconds,
    }
