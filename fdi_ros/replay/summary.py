# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a replay finds, as values and JSON, and in sentences and tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fdi_ros.faults.kinds import KINDS
from fdi_ros.monitor.diagnostics import ODD
from fdi_ros.monitor.receiver import RATE_TOLERANCE
from fdi_ros.replay.episodes import (
    DECLARED,
    MOST_TOLD,
    NOTHING_HAPPENED,
    Story,
    detail_words,
    episode_words,
    story_lines,
    stretch_words,
)
from fdi_ros.replay.outcomes import OutcomeKind
from fdi_ros.report.layout import RADIANS, Columns, Section, Unit, head_and_rows, milliseconds, number, section_text
from fdi_ros.system.text import shown

UNCHECKED_STATES = ("STALE", "UNCHECKED")
"""States of a channel that nothing checks, and that no fault was declared of."""


@dataclass(frozen=True)
class Outcome:
    """What became of one injected fault; times in s from the first message."""

    channel: str
    """As it was asked for: one name, or several separated by commas."""
    channels: tuple[str, ...]
    """Names of the channels that it is injected into."""
    kind: str
    size: float | None
    """In the unit of the kind's option; None: the kind has no size."""
    start_s: float
    stop_s: float | None
    """None: it lasts to the end."""
    detected_at_s: float | None = None
    """Of the first declaration that names one of its channels."""
    delay_s: float | None = None
    """From its start to its detection, s."""
    detected_as: str | None = None
    """State that the first declaration brought."""
    isolated: bool = False
    """All its channels were declared, each by itself."""
    isolated_at_s: float | None = None
    isolation_delay_s: float | None = None
    declared_channels: tuple[str, ...] = ()
    """Named by its first declaration, and those of its channels that were named by themselves later."""
    declared_before: bool = False
    """All its channels were declared already when it began: there is nothing left to be detected."""
    outcome: str = OutcomeKind.MISSED.value
    """As a sweep has it: one of `fdi_ros.replay.outcomes.OutcomeKind`."""

    @property
    def other_channels(self) -> list[str]:
        """Channels that were named with the fault and that it is not injected into."""
        return [name for name in self.declared_channels if name not in self.channels]


@dataclass(frozen=True)
class StateChange:
    """A change of the state of a channel."""

    channel: str
    at_s: float
    """s from the first message."""
    state: str
    """After the change."""
    before: str
    reason: str
    group: tuple[str, ...]
    """Channels of which one is faulty; the channel itself where it is declared by itself."""
    error: float | None
    """Estimated error of the channel, rad/s; None: the method gives none."""

    @property
    def declares(self) -> bool:
        """Whether this is a declaration: the channel is faulty, or one of a set is."""
        return self.state in DECLARED

    @property
    def named(self) -> tuple[str, ...]:
        """The channels that it is about: the one, or all of the set."""
        return tuple(dict.fromkeys((self.channel, *self.group))) if self.state == "AMBIGUOUS" else (self.channel,)


@dataclass(frozen=True)
class FaultEffect:
    """Root mean square of what the injected faults did to the fused rate, rad/s; None: no sample to take it of."""

    before_detection: float | None = None
    after_detection: float | None = None
    without_monitor: float | None = None
    """To the least-squares rate of all channels."""


@dataclass(frozen=True)
class Scores:
    """What was injected against what was declared."""

    samples: int
    duration_s: float
    faults: tuple[Outcome, ...]
    declared: tuple[StateChange, ...]
    """Declarations that no injected fault explains; all of them where none is injected."""
    fault_effect_rad_s: FaultEffect
    start_s: float
    """Of the first sample, s from the first message."""
    samples_judged: int
    samples_with_rate: int
    alarms: int
    """Samples with an alarm."""
    events: tuple[StateChange, ...]

    @property
    def detected(self) -> list[Outcome]:
        """The faults that were detected."""
        return [fault for fault in self.faults if fault.detected_at_s is not None]

    @property
    def isolated(self) -> int:
        """Number of faults that were isolated."""
        return sum(fault.isolated for fault in self.faults)


@dataclass(frozen=True)
class ChannelResult:
    """A channel at the end."""

    name: str
    state: str
    since_s: float | None
    """When it came into its state, s from the first message; None: it began in it."""
    reason: str
    bias_followed: float
    """Of its bias against the others, rad/s."""
    noise: float | None
    """Lately, over noise_std; None: not measured."""


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
    value: tuple[float, ...]
    """Per channel, rad/s."""


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
    degraded: tuple[str, ...]
    """What is worse than it should be without being declared, in sentences."""
    bias: BiasResult
    note: str
    protection_level: ProtectionLevel
    us_per_sample: float


@dataclass(frozen=True)
class SampleRate:
    """Samples per second, Hz."""

    configured_hz: float
    recorded_hz: float | None
    """None: too few samples to say."""


@dataclass(frozen=True)
class StreamResult:
    """The recording itself."""

    sample_rate: SampleRate
    messages: int
    """Used."""
    malformed: dict[str, int]
    """By topic."""
    disordered: int
    alignment: dict[str, dict[str, int]]
    """Counters by topic."""
    damage: tuple[str, ...]


@dataclass(frozen=True)
class Judgement:
    """What a monitor made of a stream."""

    detector: str
    scores: Scores
    monitor: MonitorResult
    story: Story = NOTHING_HAPPENED
    """What happened."""

    @property
    def unchecked_channels(self) -> list[ChannelResult]:
        """Channels that end without being checked, but for those that a fault is injected into up to the end."""
        end = self.scores.start_s + self.scores.duration_s
        lasting = [fault for fault in self.scores.faults if fault.stop_s is None or fault.stop_s >= end]
        struck = {name for fault in lasting for name in fault.channels}
        return [one for one in self.monitor.channels if one.state in UNCHECKED_STATES and one.name not in struck]


@dataclass(frozen=True, kw_only=True)
class Summary(Judgement):
    """What a monitor made of a recording."""

    bag: str
    stream: StreamResult
    seconds: float
    """That the replay took."""


def as_json(summary: Summary) -> dict[str, Any]:
    """Return the figures under the names of the fields, those of the parts of a summary side by side."""
    parts = (summary.scores, summary.monitor, summary.stream)
    figures = {name: value for part in parts for name, value in asdict(part).items()}
    story = {
        "stretches": [asdict(one) for one in summary.story.stretches],
        "episodes": [{**asdict(one), "duration_s": one.duration_s} for one in summary.story.episodes],
        "more_episodes": summary.story.more,
    }
    return {"bag": summary.bag, "detector": summary.detector, **figures, **story, "seconds": summary.seconds}


# In sentences and tables ----------------------------------------------------------------------------------------------


MOSTLY_JUDGED = 0.5
"""Share of the samples that must have been judged for a replay to say something."""


def verdict(summary: Summary, unit: Unit = RADIANS) -> list[str]:
    """Return the sentences that stand at the top of a report."""
    return [*unchecked_lines(summary), *_fault_lines(summary.scores), *_episode_lines(summary, unit)]


def unchecked_lines(summary: Summary) -> list[str]:
    """Return what was not checked: samples that were not judged, channels that end unchecked."""
    samples, judged = summary.scores.samples, summary.scores.samples_judged
    lines = []
    if judged == 0:
        state = summary.monitor.bias.state
        lines.append(f"NOTHING WAS CHECKED: not one of {samples} samples was judged; bias {state}.")
    elif judged < MOSTLY_JUDGED * samples:
        lines.append(f"ONLY {100 * judged / samples:.1f} % of {samples} samples were judged.")
    lost, total = summary.unchecked_channels, len(summary.monitor.channels)
    return [*lines, f"{len(lost)} OF {total} CHANNELS END UNCHECKED: {unchecked_words(lost)}."] if lost else lines


def unchecked_words(channels: Sequence[ChannelResult]) -> str:
    """Say which channels end how, from when on and why."""
    alike: dict[str, list[str]] = {}
    for one in channels:
        since = "from the start" if one.since_s is None else f"from {one.since_s:.3f} s on"
        why = f" ({one.reason})" if one.reason else ""
        alike.setdefault(f"{one.state} {since}{why}", []).append(one.name)
    return "; ".join(f"{', '.join(names)} {words}" for words, names in alike.items())


def notes(summary: Summary) -> list[str]:
    """Return what else a reader must know: damage, what was left out, what the monitor could not do."""
    stream, scores = summary.stream, summary.scores
    lines = [f"damaged recording: {line}" for line in stream.damage]
    lines += sample_rate_notes(stream.sample_rate)
    lines += [f"{count} malformed messages on {topic}" for topic, count in stream.malformed.items() if count]
    if stream.disordered:
        lines.append(f"{stream.disordered} messages left out: recorded after later ones")
    for topic, counters in stream.alignment.items():
        odd = ", ".join(f"{ODD.get(name, name)} ({n})" for name, n in counters.items() if n and name != "received")
        lines += [f"{topic}: {odd}"] if odd else []
    missing = scores.samples - scores.samples_with_rate
    if missing:
        lines.append(f"{missing} samples without a fused rate; bias {summary.monitor.bias.state}")
    lines += [line for line in stretch_words(summary.story) if line]
    return [*lines, summary.monitor.note] if summary.monitor.note else lines


def sample_rate_notes(rate: SampleRate) -> list[str]:
    """Say so where the configured sample rate is not that of the recording."""
    if rate.recorded_hz is None or abs(rate.recorded_hz / rate.configured_hz - 1) <= RATE_TOLERANCE:
        return []
    return [
        f"sample_rate is {rate.configured_hz:g} Hz in the config, the recording has {rate.recorded_hz:.4g} Hz: the"
        " false-alarm rate is wrong by as much"
    ]


def _fault_lines(scores: Scores) -> list[str]:
    faults, detected = scores.faults, scores.detected
    if not faults:
        return []
    plural = "fault" if len(faults) == 1 else "faults"
    lines = [f"{len(detected)} of {len(faults)} injected {plural} detected, {scores.isolated} isolated."]
    lines += [f"{fault.kind} on {fault.channel}: {_detection_words(fault)}." for fault in detected]
    for fault in faults:
        if fault.detected_at_s is None:
            why = "its channels had been declared before" if fault.declared_before else "not detected"
            lines.append(f"{fault.kind} on {fault.channel}: {why}.")
    return lines


def _detection_words(fault: Outcome) -> str:
    """Say when a fault was detected and when it was isolated, of what set it was one meanwhile."""
    words = f"detected after {_time(fault.delay_s)}"
    if fault.isolated_at_s == fault.detected_at_s:
        return f"{words}, isolated"
    if fault.other_channels:
        words += f" as one of {', '.join(fault.declared_channels)}"
    elif len(fault.channels) > 1:
        words += f", declared: {', '.join(fault.declared_channels)}"
    return f"{words}, isolated after {_time(fault.isolation_delay_s)}" if fault.isolated else f"{words}, not isolated"


def _episode_lines(summary: Summary, unit: Unit) -> list[str]:
    """Tell what was declared; where faults are injected, what of it they do not explain."""
    scores, story = summary.scores, summary.story
    told = [one for one in story.declared if not one.injected]
    if told:
        lines = story_lines(story, told, unit)
        if not scores.faults:
            return lines
        count = f"{len(told)} episode{'s' if len(told) > 1 else ''}"
        first = f", the first {MOST_TOLD}" if len(told) > MOST_TOLD else ""
        return [f"{count} that no injected fault explains{first}:", *lines]
    if scores.samples_judged == 0:
        return []
    struck = {name for fault in scores.faults for name in fault.channels}
    doubted = list(
        dict.fromkeys(name for fault in scores.faults for name in fault.other_channels if name not in struck)
    )
    if doubted:
        return [f"No other channel was declared faulty by itself; under doubt with them: {', '.join(doubted)}."]
    other = "other " if scores.faults else ""
    before = " while it was checked" if summary.unchecked_channels else ""
    return [f"No {other}channel was declared faulty{before}."]


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1000 * seconds:.0f} ms" if seconds < 10 else f"{seconds:.1f} s"


# Tables for a terminal -----------------------------------------------------------------------------------------------


_MOST_TOLD = 20
"""Episodes told of with all that is known."""


def summary_text(summary: Summary, unit: Unit = RADIANS) -> str:
    """Words and tables for one replay."""
    scores = summary.scores
    rate = summary.stream.messages / summary.seconds if summary.seconds else 0.0
    parts = [
        *(f"{line}\n" for line in verdict(summary, unit)),
        f"\n{shown(summary.bag)}: {scores.samples} samples, {scores.duration_s:.2f} s,"
        f" detector {summary.detector}, replayed in {summary.seconds:.2f} s ({rate:.0f} messages/s)\n",
        _episodes(summary.story, bool(scores.faults), unit),
        *(f"\n{section_text(section)}" for section in fault_sections(scores, unit)),
        *(f"note: {line}\n" for line in (*summary.monitor.degraded, *notes(summary))),
    ]
    return "".join(parts)


def fault_sections(scores: Scores, unit: Unit = RADIANS) -> list[Section]:
    """Lay out the injected faults, what became of them and what they did; without any there is no section."""
    if not scores.faults:
        return []
    columns: Columns = {
        "channel": lambda fault: fault.channel,
        "kind": lambda fault: fault.kind,
        "size": lambda fault: size_of(fault, unit),
        "start": lambda fault: number(fault.start_s, "g", " s"),
        "stop": lambda fault: number(fault.stop_s, "g", " s"),
        "detected": _detected,
        "delay": lambda fault: milliseconds(fault.delay_s),
        "as": lambda fault: fault.detected_as or "-",
        "isolated after": lambda fault: milliseconds(fault.isolation_delay_s) if fault.isolated else "no",
        "declared, or one of": lambda fault: ", ".join(fault.declared_channels) or "-",
    }
    effect = scores.fault_effect_rad_s
    rows = [
        ("fused rate until detection", unit.words(effect.before_detection)),
        ("fused rate after it", unit.words(effect.after_detection)),
        ("least squares of all channels, no monitor", unit.words(effect.without_monitor)),
    ]
    hint = "Rms, against the same samples without the faults, saturated ones left out."
    return [
        Section("Injected faults", "", head_and_rows(columns, scores.faults)),
        Section("Effect of the faults on the rate", hint, (("rate", "rms effect"), rows)),
    ]


def _detected(fault: Outcome) -> str:
    if fault.detected_at_s is None:
        return "declared before" if fault.declared_before else "no"
    return number(fault.detected_at_s, unit=" s")


def size_of(fault: Outcome, unit: Unit = RADIANS) -> str:
    """Size of a fault with its unit; where it is a rate, in the unit asked for."""
    if fault.size is None:
        return "-"
    option = KINDS[fault.kind].options()["size"].unit
    if not option.startswith(RADIANS.name):
        return f"{fault.size:g} {option}".rstrip()
    return f"{fault.size * unit.factor:g} {unit.named(option)}"


def _episodes(story: Story, scored: bool, unit: Unit) -> str:
    """Tell of every episode: who, when and how much, and what is known of it beside."""
    told = story.episodes[:_MOST_TOLD]
    if not told:
        return ""
    several = len(story.stretches) > 1
    lines = ["\nwhat happened\n"]
    for place, one in enumerate(told, 1):
        where = f" (stretch {one.stretch})" if several else ""
        lines.append(f"  {place}. {episode_words(one, unit)}{where}\n")
        injected = [("injected there", ", ".join(one.injected) or "nothing")] if scored else []
        lines += [f"       {title}: {words}\n" for title, words in (*detail_words(one, unit), *injected)]
    more = len(story.episodes) - len(told) + story.more
    return "".join([*lines, f"  and {more} more\n"] if more else lines)
