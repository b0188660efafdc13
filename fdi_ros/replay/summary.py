# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results of a replay, as records and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from fdi_ros.bag.flight_context import FlightContext
from fdi_ros.monitor.output import time_index
from fdi_ros.monitor.soundness import (
    ChannelHealth,
    Concern,
    RateHealth,
    Trouble,
    UnitHealth,
    Word,
    concerns_of,
)
from fdi_ros.replay.episodes import NOTHING_HAPPENED, Story
from fdi_ros.replay.outcomes import UNCHECKED_STATES, Scores
from fdi_ros.report.layout import Severity
from fdi_ros.system import require
from fdi_ros.system.text import figures

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, kw_only=True)
class ChannelResult(ChannelHealth):
    """A channel at the end, which is the last sample of all channels that deliver so long."""

    state: str
    """Name of its state."""
    since_s: float | None
    """Time at which it came into the state, s from the first message. None: from the start."""
    reason: str
    """Reason for the state. Empty: none."""
    residual_rms_rad_s: float | None
    """Root mean square of its difference from the fused rate while it was OK, rad/s.
    None: never OK."""
    noise: float | None
    """Its noise at the end, in ``noise.noise_std``. None: not measured."""
    unchecked: float
    """Share of its values whose fault no other channel could have shown: 1 less `checked`."""


@dataclass(frozen=True)
class DelayResult:
    """Delay of the stamps of a unit against the others."""

    unit: str
    """Name of the unit."""
    late_s: float
    """Delay, s. Negative: early."""
    std_s: float
    """Standard deviation of the delay, s."""


@dataclass(frozen=True)
class FarBias:
    """A bias at the start that no healthy sensor is expected to have."""

    channel: str
    """Name of the channel."""
    size: float
    """Size of the bias, in `unit`."""
    limit: float
    """Largest size that is expected, four ``turn_on_std``, in `unit`."""
    unit: str
    """rad/s of a gyro, m/s^2 of an accelerometer."""


@dataclass(frozen=True)
class BiasResult:
    """Biases at the end."""

    state: str
    """How they were found, in words."""
    value: tuple[float, ...]
    """Bias of each channel, rad/s."""
    far: tuple[str, ...] = ()
    """Channels that began with more than four ``bias.turn_on_std``, which is learned, as a
    fault from before the start would be."""
    far_biases: tuple[FarBias, ...] = ()
    """Their biases."""


@dataclass(frozen=True)
class ProtectionLevel:
    """Bound on the error of the fused rate with one undetected fault, per body axis, rad/s.

    None: no bound can be given.
    """

    at_end: tuple[float | None, ...]
    """Level at the last sample."""
    after_one_more_loss: tuple[float | None, ...]
    """Level after the loss of one more channel, on each axis the worst one."""


@dataclass(frozen=True)
class MonitorResult:
    """The monitor at the end."""

    channels: tuple[ChannelResult, ...]
    """The channels, in their order."""
    delays: tuple[DelayResult, ...]
    """Delays of units against the first one."""
    degraded: tuple[str, ...]
    """Sentences on what is worse than it should be without a declaration."""
    bias: BiasResult
    """The biases."""
    note: str
    """Why checking is limited, in words. Empty: it is not."""
    protection_level: ProtectionLevel
    """Bound on the error of the fused rate."""
    us_per_sample: float
    """Time that the monitor took for a sample, us."""
    units: tuple[UnitHealth, ...] = ()
    """The units, in the order of their topics."""
    rate: RateHealth = field(default_factory=RateHealth)
    """How the fused rate was published."""


@dataclass(frozen=True)
class SampleRate:
    """Samples per second."""

    configured_hz: float
    """``sample_rate`` of the settings, Hz."""
    recorded_hz: float | None
    """Usual rate of the recording, Hz. None: too few samples."""


@dataclass(frozen=True)
class StreamResult:
    """The recording itself."""

    sample_rate: SampleRate
    """Configured and recorded rate."""
    origin_ns: int | None
    """Stamp of the first message, from which all times count, ns. None: no message."""
    messages: int
    """Number of messages that were used."""
    malformed: dict[str, int]
    """Number of malformed messages by topic."""
    disordered: int
    """Number of messages left out because they were recorded after later ones."""
    alignment: dict[str, dict[str, int]]
    """Counters of the alignment by topic."""
    damage: tuple[str, ...]
    """What could not be read, one line for each place."""
    unused: tuple[tuple[str, str], ...] = ()
    """Topics of gyros that were left out, and why."""
    set_back_s: float = 0.0
    """By how much the stamps of all units were set back together, s. 0: never."""
    facts: tuple[str, ...] = ()
    """What readers of the recording must know, and is no damage."""

    @property
    def clock_concerns(self) -> list[Concern]:
        """Reasons not to trust the times of the recording."""
        if not self.set_back_s:
            return []
        who = ("the clocks of all units",)
        words = f"were set back by {figures(self.set_back_s)} s during the recording"
        return [Concern(Word.LOOK, Trouble.CLOCK, who, words)]


class ReplayVerdict(NamedTuple):
    """The verdict on a replay."""

    word: str
    """HEALTHY, LOOK, CANNOT TELL or FAULTY. With injected faults FOUND, NOT ALL FOUND or
    FALSE ALARM."""
    sentence: str
    """The verdict in full. Without injected faults it begins with the word."""
    channels: tuple[str, ...]
    """Channels that the word is about. Also units or topics if it is LOOK."""

    @property
    def severity(self) -> Severity:
        """How urgent it is. An exit code follows from that."""
        if self.word in ("HEALTHY", "FOUND"):
            return Severity.GOOD
        urgent = self.word in ("FAULTY", "FALSE ALARM")
        return Severity.BAD if urgent else Severity.UNKNOWN


NO_VERDICT = ReplayVerdict("", "", ())
"""Verdict of a summary that nobody judged."""


@dataclass(frozen=True)
class Judgement:
    """What a monitor made of a stream."""

    detector: str
    """Name of the detector."""
    scores: Scores
    """Injected faults and declarations."""
    monitor: MonitorResult
    """The monitor at the end."""
    story: Story = NOTHING_HAPPENED
    """What happened, in stretches and episodes."""

    @property
    def unchecked_channels(self) -> list[ChannelResult]:
        """Channels unchecked at the end. Those with an injected fault to the end are left out."""
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

    @property
    def has_only_brief_sets(self) -> bool:
        """Whether all that was declared are sets that ended within `EPISODE_TIMES.brief`.

        Evidence for one channel does not last while its error changes its sign, as noise does.
        """
        return all(one.is_brief for one in self.story.declared)

    def _was_faulty(self, channel: ChannelHealth) -> bool:
        """Whether a channel was named faulty while it was noisy."""
        end = channel.noisy_from_s + channel.noisy_s
        return any(
            one.state == "FAULTY"
            and channel.name in one.ever
            and one.start_s < end
            and one.end_s > channel.noisy_from_s
            for one in self.story.declared
        )

    @property
    def concerns(self) -> list[Concern]:
        """Reasons not to call the recording healthy, beside declared faults.

        A fault that lasts disturbs the comparison of noise, and may look like noise itself.
        """
        channels: Sequence[ChannelHealth] = self.monitor.channels
        if self.story.declared and not self.has_only_brief_sets:
            channels = [
                replace(one, own_noise_rad_s=None, noisy_s=0.0)
                if self._was_faulty(one)
                else replace(one, own_noise_rad_s=None)
                for one in channels
            ]
        return concerns_of(channels, self.monitor.units, rate=self.monitor.rate)


@dataclass(frozen=True)
class AutopilotText:
    """A message of the autopilot in a flight log."""

    at_s: float
    """Time, s from the first message."""
    kind: str
    """MSG, ERR (a lane switch of the EKF among them), STATUSTEXT, or the level of PX4."""
    text: str
    """The message."""


@dataclass(frozen=True, kw_only=True)
class Summary(Judgement):
    """What a monitor made of a recording."""

    bag: str
    """Path of the recording."""
    stream: StreamResult
    """The recording itself."""
    seconds: float
    """Time that the replay took, s."""
    autopilot: tuple[AutopilotText, ...] = ()
    """Messages of the autopilot from the first sample to the last."""
    verdict: ReplayVerdict = NO_VERDICT
    """The verdict."""
    context: FlightContext = field(default_factory=FlightContext)
    """Temperatures, throttle and flight modes of a flight log."""

    @property
    def concerns(self) -> list[Concern]:
        """Reasons not to call the recording healthy, topics that were not judged included."""
        unused = concerns_of((), (), self.stream.unused)
        return [*self.stream.clock_concerns, *super().concerns, *unused]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the changes of state as a table. Needs pandas.

        Columns: ``channel``, ``before``, ``state``, ``reason``, ``group`` and ``error`` (rad/s),
        as in `StateChange`. The index has their times, as in
        `fdi_ros.monitor.output.time_index`.
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
    """Return all figures by the names of the fields, the parts of a summary side by side."""
    verdict = summary.verdict
    return {
        "bag": summary.bag,
        "verdict": {
            "severity": verdict.severity.value,
            "word": verdict.word,
            "words": verdict.sentence,
            "channels": verdict.channels,
        },
        "detector": summary.detector,
        **asdict(summary.scores),
        **asdict(summary.monitor),
        **asdict(summary.stream),
        "concerns": list(map(str, summary.concerns)),
        "stretches": [asdict(one) for one in summary.story.stretches],
        "episodes": [
            {**asdict(one), "duration_s": one.duration_s}
            for one in summary.story.episodes
        ],
        "more_episodes": summary.story.more,
        "autopilot": list(map(asdict, summary.autopilot)),
        "seconds": summary.seconds,
    }
