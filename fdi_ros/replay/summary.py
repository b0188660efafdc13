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
    REPORTED,
    WHOLE,
    ChannelHealth,
    Concern,
    RateHealth,
    Trouble,
    UnitHealth,
    Word,
    concerns_of,
    repeating,
)
from fdi_ros.replay.episodes import NOTHING_HAPPENED, Story
from fdi_ros.replay.outcomes import UNCHECKED_STATES, Scores
from fdi_ros.report.layout import Severity
from fdi_ros.system import require
from fdi_ros.system.text import figures, percent

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


def _of_several(words: str) -> str:
    """Return words on the stamps of one unit as they are said of several."""
    verb, _, rest = words.partition(" ")
    verbs = {"has": "have", "repeats": "repeat"}
    return f"{verbs[verb]} {rest}".replace(" its ", " their ")


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
    steps_back: dict[str, tuple[float, float]] = field(default_factory=dict)
    """Time at which the clock of each topic was set back, s from the first message, and by how
    much, s. No entry: never."""
    set_back_s: float = 0.0
    """By how much the stamps of all units were set back together, s. 0: never."""
    facts: tuple[str, ...] = ()
    """What readers of the recording must know, and is no damage."""
    lost: bool = False
    """Whether messages are missing because the recording is damaged."""
    cut_off: bool = False
    """Whether the recording ends before its recorder closed it."""
    holes: tuple[tuple[float, float], ...] = ()
    """Begin and end of the times in which no unit delivered, s from the first message."""

    @property
    def damage_concerns(self) -> list[Concern]:
        """Reasons not to trust that the recording is whole.

        A recording that ends where the power goes is whole up to there.
        """
        who = ("the recording",)
        concerns = []
        # Between two flights in one recording nothing is missing, as far as that is known.
        holes = [
            (begin, end)
            for begin, end in self.holes
            if self.lost or end - begin < WHOLE.pause
        ]
        if holes:
            begin, end = holes[0]
            seconds = sum(end - begin for begin, end in holes)
            damaged = "is damaged and " if self.lost else ""
            when = f"from {begin:.1f} s to {end:.1f} s"
            if len(holes) > 1:
                when = f"in {len(holes)} parts, the first {when}"
            words = f"{damaged}lacks {seconds:.1f} s of all units, {when}"
            trouble = Trouble.DAMAGE if self.lost else Trouble.HOLE
            concerns.append(Concern(Word.LOOK, trouble, who, words))
        elif self.lost:
            words = "is damaged: some messages are missing, at its end or between"
            concerns.append(Concern(Word.LOOK, Trouble.DAMAGE, who, words))
        return concerns

    def stamp_concerns(
        self, units: Sequence[UnitHealth], samples: int
    ) -> list[Concern]:
        """Return concerns about units whose stamps are wrong while their messages come."""
        alike: dict[str, list[str]] = {}
        for unit in units:
            if words := self._stamp_words(unit, samples):
                alike.setdefault(words, []).append(unit.name)
        return [
            Concern(
                Word.LOOK,
                Trouble.STAMPS,
                tuple(names),
                words if len(names) == 1 else _of_several(words),
            )
            for words, names in alike.items()
        ]

    def _stamp_words(self, unit: UnitHealth, samples: int) -> str:
        """Return what is wrong with the stamps of a unit. Empty: nothing."""
        counters = self.alignment.get(unit.topic, {})
        received = max(1, counters.get("received", 0))
        ahead = counters.get("jumped", 0)
        # Together they are ahead of nobody.
        jumped = [one.get("jumped", 0) for one in self.alignment.values()]
        if min(jumped, default=0) == ahead:
            ahead = 0
        if ahead >= WHOLE.stamps * received:
            share = percent(ahead / received)
            return f"has stamps far ahead of those of the other units in {share} of its messages: these were not used"
        old = counters.get("duplicate", 0) + counters.get("backward", 0)
        back = self.steps_back.get(unit.topic)
        if back is not None and not self.set_back_s:
            at, by = back
            return f"has stamps that go back by {figures(by, 2)} s at {at:.1f} s, as if its clock was set"
        if old >= WHOLE.stamps * received:
            return f"repeats old stamps in {percent(old / received)} of its messages: these were not used"
        missing = counters.get("missing", 0)
        came = received >= WHOLE.messages * samples
        if came and missing >= (1.0 - REPORTED.delivered) * samples:
            return (
                f"has stamps so irregular that {percent(missing / samples)} of the samples lack its value,"
                " though its messages came"
            )
        return ""

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
    def is_cut_off(self) -> bool:
        """Whether the recording ends before its recorder closed it."""
        return False

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
        said = {name for one in self.story.declared for name in one.ever}
        others = [one for one in self.monitor.channels if one.name not in said]
        found = concerns_of(channels, self.monitor.units, rate=self.monitor.rate)
        return [*found, *repeating(others)]


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
    def is_cut_off(self) -> bool:
        """Whether the recording ends before its recorder closed it."""
        return self.stream.cut_off

    @property
    def concerns(self) -> list[Concern]:
        """Reasons not to call the recording healthy, topics that were not judged included."""
        unused = concerns_of((), (), self.stream.unused)
        stream = self.stream
        monitor = self.monitor
        stamps = stream.stamp_concerns(monitor.units, self.scores.samples)
        wrong = {name for one in stamps for name in one.who}
        unit_of = {one.name: one.unit for one in monitor.channels}
        others = []
        for one in super().concerns:
            units = {unit_of.get(name, name) for name in one.who}
            is_of_stamps = bool(units) and units <= wrong
            # What lacks a value, or is at a wrong time, is so by the stamps.
            if is_of_stamps and one.trouble is Trouble.DELIVERY:
                continue
            if is_of_stamps and one.trouble is Trouble.NOISE:
                one = one._replace(trouble=Trouble.DELAY)
            others.append(one)
        return [
            *stream.damage_concerns,
            *stream.clock_concerns,
            *stamps,
            *others,
            *unused,
        ]

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
