# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a replay finds, in words: the verdict, the sentences below it, the tables for a terminal; and whether it passes.

What it must show to pass is asked as in ``fdi replay --check 'delay<1 isolated false=0'``, or ``'imu_2.y faulty'``.
"""

from __future__ import annotations

import math
import operator
import re
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from fdi_ros.core.decision import Reason
from fdi_ros.errors import ConfigError
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.monitor.diagnostics import ODD
from fdi_ros.monitor.receiver import RATE_TOLERANCE
from fdi_ros.replay.episodes import (
    MOST_TOLD,
    Episode,
    Story,
    detail_words,
    episode_words,
    stretch_words,
)
from fdi_ros.replay.outcomes import UNCHECKED_STATES, Outcome, Scores
from fdi_ros.replay.summary import ChannelResult, Judgement, SampleRate, Summary
from fdi_ros.report.layout import (
    RADIANS,
    Columns,
    Section,
    Severity,
    Unit,
    Verdict,
    first_of,
    head_and_rows,
    milliseconds,
    number,
    section_text,
)
from fdi_ros.system.text import shown

MOSTLY_JUDGED = (
    0.5  # share of the samples that must have been judged for a replay to say something
)
LONGEST_UNCHECKED = 0.5
"""Share of a recording that a channel may be unchecked for without a break where the recording is called healthy."""
LASTING = 1.0  # what a channel does at the end for less, s, is not told: recordings end with the power
NOISIER = 3.0  # a channel is much noisier than the others where its residual is so many times their median


def verdict(summary: Summary, unit: Unit = RADIANS) -> Verdict:
    """Say in one line what came out: what became of injected faults; or healthy, faulty, or that it cannot be told."""
    if summary.scores.faults:
        return _verdict_on_faults(summary)
    if told := _faulty(summary):
        others = dict.fromkeys(one.who for one in told[1:] if one.who != told[0].who)
        more = f"; then also {first_of(list(others), MOST_TOLD)}" if others else ""
        return Verdict(Severity.BAD, f"FAULTY: {_without_state(told[0], unit)}{more}.")
    if why := _untold(summary):
        return Verdict(Severity.UNKNOWN, f"CANNOT TELL: {why}.")
    return Verdict(Severity.GOOD, f"HEALTHY: {_healthy_words(summary)}.")


def _faulty(summary: Summary) -> list[Episode]:
    """Return the episodes that make a recording faulty: what was declared, names first; units silent for good."""
    silent = [
        one
        for one in summary.story.episodes
        if one.stands
        and one.duration_s >= LASTING
        and one.evidence.reason == Reason.NO_DATA.value
    ]
    declared = sorted(summary.story.declared, key=lambda one: one.state != "FAULTY")
    return [*declared, *(one for one in silent if not one.declares)]


def _without_state(one: Episode, unit: Unit) -> str:
    """Tell of an episode behind the word FAULTY."""
    untold = (
        ", which of them cannot be told,"
        if len(one.channels) > 1
        else ", to be confirmed,"
    )
    state = {"FAULTY": "", "AMBIGUOUS": untold, "STALE": " silent"}[one.state]
    return episode_words(one, unit).replace(f" {one.state} from", f"{state} from", 1)


def _verdict_on_faults(summary: Summary) -> Verdict:
    """Say how many of the injected faults were detected."""
    faults, isolated = summary.scores.faults, summary.scores.isolated
    detected = sum(fault.detected_at_s is not None for fault in faults)
    plural = "fault" if len(faults) == 1 else "faults"
    words = (
        f"{detected} of {len(faults)} injected {plural} detected, {isolated} isolated."
    )
    if _wrongly_named(summary) or any(
        not one.injected for one in summary.story.declared
    ):
        return Verdict(Severity.BAD, words)
    return Verdict(
        Severity.GOOD if isolated == len(faults) else Severity.UNKNOWN, words
    )


def _wrongly_named(summary: Summary) -> list[str]:
    """Return the channels that are declared faulty by themselves and that no injected fault strikes."""
    faulty = dict.fromkeys(
        one.channel for one in summary.scores.declared if one.state == "FAULTY"
    )
    return [name for name in faulty if name not in summary.scores.struck]


def _untold(summary: Summary) -> str:
    """Say why a recording in which nothing was declared is not called healthy; empty: it is."""
    samples, judged = summary.scores.samples, summary.scores.samples_judged
    if judged == 0:
        return f"not one of {samples} samples was judged; bias {summary.monitor.bias.state}"
    if judged < MOSTLY_JUDGED * samples:
        return f"only {100 * judged / samples:.1f} % of {samples} samples were judged"
    if longest := _unchecked_longest(summary):
        words = ", ".join(
            f"{name} for {seconds:.1f} s" for name, seconds in longest.items()
        )
        return f"not checked without a break, of {summary.scores.duration_s:.1f} s: {words}"
    if far := summary.monitor.bias.far:
        return f"{', '.join(far)} began with a bias far beyond bias.turn_on_std, as after a fault before the start"
    return ""


def _unchecked_longest(summary: Summary) -> dict[str, float]:
    """Return the channels that were unchecked for too long without a break, and for how long, s."""
    scores, found = summary.scores, {}
    for channel in summary.monitor.channels:
        changes = [one for one in scores.events if one.channel == channel.name]
        states = [
            changes[0].before if changes else channel.state,
            *(one.state for one in changes),
        ]
        edges = pairwise([scores.start_s, *(one.at_s for one in changes), scores.end_s])
        spans = [
            b - a
            for state, (a, b) in zip(states, edges, strict=True)
            if state in UNCHECKED_STATES
        ]
        if max(spans, default=0.0) > LONGEST_UNCHECKED * scores.duration_s:
            found[channel.name] = max(spans)
    return found


def _healthy_words(summary: Summary) -> str:
    channels, end = summary.monitor.channels, _unchecked_at_the_end(summary)
    checked = 1.0 - max((one.unchecked for one in channels), default=0.0)
    share = (
        "all checked"
        if checked > 0.995
        else f"each checked in {checked:.0%} of the samples or more"
    )
    more = f"; at the end not checked: {end}" if end else ""
    return f"no fault declared in {summary.scores.duration_s:.1f} s; {len(channels)} channels, {share}{more}"


def _unchecked_at_the_end(summary: Summary) -> str:
    end, unchecked = summary.scores.end_s, summary.unchecked_channels
    return _unchecked_words(
        [
            one
            for one in unchecked
            if one.since_s is not None and end - one.since_s >= LASTING
        ]
    )


def sentences(summary: Summary, unit: Unit = RADIANS) -> list[str]:
    """Return what stands below the verdict."""
    faults = sorted(
        summary.scores.faults, key=lambda fault: fault.detected_at_s is None
    )
    lines = [
        f"{fault.kind} on {fault.channel}: {_detection_words(fault)}."
        for fault in faults
    ]
    return [*lines, *_episode_lines(summary, unit), *noisy_lines(summary, unit)]


def noisy_lines(judgement: Judgement, unit: Unit = RADIANS) -> list[str]:
    """Tell of channels that are much noisier than the others."""
    # What is wrong already is said.
    channels = () if judgement.story.declared else judgement.monitor.channels
    rms = {
        one.name: one.residual_rms_rad_s for one in channels if one.residual_rms_rad_s
    }
    lines = []
    for name, size in rms.items():
        others = statistics.median(
            [value for other, value in rms.items() if other != name] or [size]
        )
        if size > NOISIER * others:
            theirs, own = (f"{value * unit.factor:.2g}" for value in (others, size))
            lines.append(
                f"{name} is much noisier than the others: it differs from the fused rate by {own} {unit.name} rms, they"
                f" by {theirs}. Look at its mount; smaller faults hide in this noise."
            )
    return lines


def _unchecked_words(channels: Sequence[ChannelResult]) -> str:
    """Say which channels end how, from when on and why."""
    alike: dict[tuple[str, str], list[ChannelResult]] = {}
    for one in channels:
        alike.setdefault((one.state, one.reason), []).append(one)
    words = []
    for (state, reason), group in alike.items():
        since = sorted({one.since_s or 0.0 for one in group})
        when = (
            f"from {since[0]:.3f} to {since[-1]:.3f} s on"
            if len(since) > 1
            else f"from {since[0]:.3f} s on"
        )
        when = when if since[-1] else "from the start"
        words.append(
            f"{', '.join(one.name for one in group)} {state} {when}{f' ({reason})' if reason else ''}"
        )
    return "; ".join(words)


def notes(summary: Summary) -> list[str]:
    """Return what else a reader must know: damage, what was left out, what the monitor could not do."""
    stream, scores = summary.stream, summary.scores
    lines = [*stream.damage, *sample_rate_notes(stream.sample_rate)]
    lines += [
        f"{count} malformed messages on {topic}"
        for topic, count in stream.malformed.items()
        if count
    ]
    if stream.disordered:
        lines.append(
            f"{stream.disordered} messages left out: recorded after later ones"
        )
    for topic, counters in stream.alignment.items():
        odd = ", ".join(
            f"{ODD.get(name, name)} ({n})"
            for name, n in counters.items()
            if n and name != "received"
        )
        lines += [f"{topic}: {odd}"] if odd else []
    if missing := scores.samples - scores.samples_with_rate:
        lines.append(
            f"{missing} samples without a fused rate; bias {summary.monitor.bias.state}"
        )
    lines += stretch_words(summary.story)
    return [*lines, summary.monitor.note] if summary.monitor.note else lines


def sample_rate_notes(rate: SampleRate) -> list[str]:
    """Say so where the configured sample rate is not that of the recording."""
    if (
        rate.recorded_hz is None
        or abs(rate.recorded_hz / rate.configured_hz - 1) <= RATE_TOLERANCE
    ):
        return []
    return [
        f"sample_rate is {rate.configured_hz:g} Hz in the config, the recording has {rate.recorded_hz:.4g} Hz: the"
        " false-alarm rate is wrong by as much"
    ]


def _detection_words(fault: Outcome) -> str:
    """Say when a fault was detected and when it was isolated, of what set it was one meanwhile."""
    if fault.detected_at_s is None:
        return (
            "its channels had been declared before"
            if fault.declared_before
            else "not detected"
        )
    words = f"detected after {_time(fault.delay_s)}"
    if fault.isolated_at_s == fault.detected_at_s:
        return f"{words}, isolated"
    if fault.other_channels:
        words += f" as one of {', '.join(fault.declared_channels)}"
    elif len(fault.channels) > 1:
        words += f", declared: {', '.join(fault.declared_channels)}"
    return (
        f"{words}, isolated after {_time(fault.isolation_delay_s)}"
        if fault.isolated
        else f"{words}, not isolated"
    )


def _episode_lines(summary: Summary, unit: Unit) -> list[str]:
    """Tell what was declared; where faults are injected, what of it they do not explain."""
    scores, story = summary.scores, summary.story
    told = [one for one in story.declared if not one.injected]
    if not scores.faults:
        # What was declared, and that a healthy one was not checked at the end, the verdict says.
        lost = (
            ""
            if verdict(summary).severity is Severity.GOOD
            else _unchecked_at_the_end(summary)
        )
        return [f"At the end not checked: {lost}."] if lost else []
    if told:
        count = f"{len(told)} episode{'s' if len(told) > 1 else ''}"
        first = f", the first {MOST_TOLD}" if len(told) > MOST_TOLD else ""
        stretches = [
            f"stretch {one.stretch}: " if len(story.stretches) > 1 else ""
            for one in told[:MOST_TOLD]
        ]
        lines = [
            f"{where}{episode_words(one, unit)}."
            for where, one in zip(stretches, told, strict=False)
        ]
        if more := len(told[MOST_TOLD:]) + story.more:
            lines.append(f"And {more} more episode{'s' if more > 1 else ''}.")
        return [f"{count} that no injected fault explains{first}:", *lines]
    if wrong := _wrongly_named(summary):
        return [f"Declared faulty, and not struck by a fault: {', '.join(wrong)}."]
    if why := _untold(summary):
        return [f"Of the others it cannot be told: {why}."]
    doubted = dict.fromkeys(
        name for fault in scores.faults for name in fault.other_channels
    )
    doubted = {name: None for name in doubted if name not in scores.struck}
    if doubted:
        return [
            f"No other channel was declared faulty by itself; under doubt with them: {', '.join(doubted)}."
        ]
    return ["No other channel was declared faulty."]


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1000 * seconds:.0f} ms" if seconds < 10 else f"{seconds:.1f} s"


# Tables for a terminal -----------------------------------------------------------------------------------------------


_MOST_TOLD = 20  # episodes told of with all that is known


def summary_text(summary: Summary, unit: Unit = RADIANS) -> str:
    """Words and tables for one replay."""
    scores = summary.scores
    rate = summary.stream.messages / summary.seconds if summary.seconds else 0.0
    parts = [
        *(
            f"{line}\n"
            for line in (verdict(summary, unit).words, *sentences(summary, unit))
        ),
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
        "isolated after": lambda fault: (
            milliseconds(fault.isolation_delay_s) if fault.isolated else "no"
        ),
        "declared, or one of": lambda fault: ", ".join(fault.declared_channels) or "-",
    }
    effect = scores.fault_effect_rad_s
    rows = [
        ("fused rate until detection", unit.words(effect.before_detection)),
        ("fused rate after it", unit.words(effect.after_detection)),
        (
            "least squares of all channels, no monitor",
            unit.words(effect.without_monitor),
        ),
    ]
    hint = "Rms, against the same samples without the faults, saturated ones left out."
    return [
        Section("Injected faults", "", head_and_rows(columns, scores.faults)),
        Section(
            "Effect of the faults on the rate", hint, (("rate", "rms effect"), rows)
        ),
    ]


def _detected(fault: Outcome) -> str:
    missed = "declared before" if fault.declared_before else "no"
    return (
        missed
        if fault.detected_at_s is None
        else number(fault.detected_at_s, unit=" s")
    )


def size_of(fault: Outcome, unit: Unit = RADIANS) -> str:
    """Size of a fault with its unit; where it is a rate, in the unit asked for."""
    if fault.size is None:
        return "-"
    option = FAULT_KINDS[fault.kind].options()["size"].unit
    if not option.startswith(RADIANS.name):
        return f"{fault.size:g} {option}".rstrip()
    return f"{fault.size * unit.factor:g} {unit.named(option)}"


def _episodes(story: Story, scored: bool, unit: Unit) -> str:
    """Tell of every episode: who, when and how much, and what is known of it beside."""
    told = story.episodes[:_MOST_TOLD]
    lines = ["\nwhat happened\n"] if told else []
    for place, one in enumerate(told, 1):
        where = f" (stretch {one.stretch})" if len(story.stretches) > 1 else ""
        lines.append(f"  {place}. {episode_words(one, unit)}{where}\n")
        lines += [
            f"       {title}: {words}\n"
            for title, words in detail_words(one, unit, scored)
        ]
    more = len(story.episodes) - len(told) + story.more
    return "".join([*lines, f"  and {more} more\n"] if more else lines)


# What it must show to pass --------------------------------------------------------------------------------------------


_COMPARED: dict[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    "=": operator.eq,
    ">": operator.gt,
    ">=": operator.ge,
}
_TERM = re.compile(r"([^<>=]*)(<=|>=|<|>|=)?(.*)", re.DOTALL)
_OF_FAULTS = {"detected": ("",), "delay": ("<", "<="), "isolated": ("", "<", "<=")}
"""Every injected fault is detected; it is, within so many seconds; it is isolated, or so within so many seconds."""
_OF_ALL = {
    "false": ("<", "<=", "="),  # number of declarations that no injected fault explains
    "declared": (
        "<",
        "<=",
        "=",
    ),  # number of episodes in which a fault was declared, injected or not
    "judged": (">", ">="),  # share of the samples that was judged
    "unchecked": ("<", "<=", "="),  # number of channels that end STALE or UNCHECKED
}
_FORMS = (
    _OF_FAULTS | _OF_ALL
)  # how each quantity may be compared with a number; empty: it may stand without one
CHANNEL_STATES = ("faulty", "ambiguous", "stale", "ok")
"""What a channel may be asked to have been: declared by itself, in a set, silent; or none of these."""
_IMPLIED = (
    f"judged>={MOSTLY_JUDGED:g}",
    "unchecked=0",
)  # what must hold where nothing is said of it


@dataclass(frozen=True)
class Condition:
    """One condition, as it was written."""

    text: str
    name: str  # of a quantity, or of a state of channels
    sign: str = ""
    bound: float = math.nan
    channels: tuple[
        str, ...
    ] = ()  # that are asked for: one, or those of a unit; empty: it is about a quantity

    def reasons(self, judgement: Judgement) -> list[str]:
        """Return why it does not hold, one line per reason; empty: it does."""
        if self.channels:
            return [
                f"{name}: {why}"
                for name in self.channels
                if (why := self._of_channel(name, judgement))
            ]
        if self.name in _OF_ALL:
            value, words = _measure(self.name, judgement)
            return [] if self._holds(value) else [words]
        if judgement.scores.faults:
            return [
                why
                for fault in judgement.scores.faults
                if (why := self._of_fault(fault))
            ]
        told = judgement.story.declared
        return (
            [episode_words(one) for one in told if one.state != "FAULTY"]
            if told
            else ["nothing was declared"]
        )

    def _holds(self, value: float) -> bool:
        return not self.sign or _COMPARED[self.sign](value, self.bound)

    def _of_fault(self, fault: Outcome) -> str:
        """Say why an injected fault does not fulfil it; empty: it does."""
        named, when, done = (
            f"{fault.kind} on {fault.channel}",
            fault.delay_s,
            "detected",
        )
        if when is None:
            missed = (
                "declared before it began: nothing was left to detect"
                if fault.declared_before
                else "not detected"
            )
            return f"{named}: {missed}"
        if self.name == "isolated":
            when, done = fault.isolation_delay_s, "isolated"
        if when is None:
            return f"{named}: detected, not isolated; declared: {', '.join(fault.declared_channels)}"
        return "" if self._holds(when) else f"{named}: {done} after {when:.3f} s"

    def _of_channel(self, channel: str, judgement: Judgement) -> str:
        """Say what was declared of a channel where that is not what was asked for; otherwise nothing."""
        episodes = judgement.story.episodes
        told = {one.state: one for one in episodes if channel in one.channels}
        if self.name == "ambiguous":
            told |= {
                step.state: one
                for one in episodes
                for step in one.steps
                if channel in step.channels
            }
        if not told if self.name == "ok" else self.name.upper() in told:
            return ""
        return (
            "; ".join(dict.fromkeys(map(episode_words, told.values())))
            or "nothing was declared of it"
        )


def _measure(name: str, judgement: Judgement) -> tuple[float, str]:
    """Return the value of a quantity of the whole recording, and how it is said."""
    scores, story = judgement.scores, judgement.story
    if name == "judged":
        share = scores.samples_judged / max(1, scores.samples)
        return (
            share,
            f"{scores.samples_judged} of {scores.samples} samples were judged, {share:.4f}",
        )
    if name == "unchecked":
        lost, total = judgement.unchecked_channels, len(judgement.monitor.channels)
        return (
            len(lost),
            f"{len(lost)} of {total} channels end unchecked{': ' if lost else ''}{_unchecked_words(lost)}",
        )
    if name == "declared":
        count, told = (
            len(story.declared) + story.more,
            "; ".join(map(episode_words, story.declared[:MOST_TOLD])),
        )
        which = f"episode{'s' if count != 1 else ''}"
    else:
        count, first = len(scores.declared), scores.declared[:MOST_TOLD]
        told = "; ".join(
            f"{one.channel} {one.state} at {one.at_s:.3f} s" for one in first
        )
        which = (
            "declarations that no injected fault explains"
            if scores.faults
            else "declarations, of channels"
        )
    return count, f"{count} {which}{f': {told}' if told else ''}"


def failures(required: Sequence[Condition], judgement: Judgement) -> list[str]:
    """Return why what a monitor made of a recording does not pass, one line per reason; empty: it passes.

    What was mostly not judged does not pass unless the conditions say what is enough, nor do channels that end
    unchecked unless they say how many may.
    """
    named = {one.name for one in required}
    implied = [
        one for one in map(_on_quantity, _IMPLIED) if required and one.name not in named
    ]
    return [
        f"{one.text}: {why}"
        for one in (*required, *implied)
        for why in one.reasons(judgement)
    ]


def parse_check(text: str, faults: int, names: Sequence[str] = ()) -> list[Condition]:
    """Read conditions separated by blanks or commas, ``delay<1 isolated false=0``; all must hold.

    ``faults``: how many are injected. ``names``: of the channels, which may be asked for, as may their units.
    `ConfigError` names the part that is wrong and what is allowed.
    """
    parts = re.sub(r"\s*(<=|>=|<|>|=)\s*", r"\1", text).replace(",", " ").split()
    if not parts:
        raise ConfigError(
            f"--check is empty, expected conditions on: {', '.join(_FORMS)}"
        )
    found: list[Condition] = []
    while parts:
        part = parts.pop(0)
        if parts and parts[0].lower() in CHANNEL_STATES:
            text = f"{part} {parts[0].lower()}"
            meant = tuple(
                name for name in names if name == part or name.startswith(f"{part}.")
            )
            if not meant:
                raise ConfigError(
                    f"--check: {text!r} names no channel, expected one of: {', '.join(names)}"
                )
            found.append(Condition(text, parts.pop(0).lower(), channels=meant))
            continue
        condition = _on_quantity(part)
        if not faults and condition.name in _OF_FAULTS and part != "isolated":
            raise ConfigError(
                f"--check: {part!r} is about injected faults, and none is given by --fault; of a recording as it is ask"
                " declared=0, isolated, or CHANNEL faulty"
            )
        found.append(condition)
    return found


def _on_quantity(part: str) -> Condition:
    match = _TERM.fullmatch(part)
    assert match is not None
    name, sign, number = match[1], match[2] or "", match[3]
    if name not in _FORMS:
        raise ConfigError(
            f"--check: {part!r} begins with {name!r}, expected one of: {', '.join(_FORMS)}"
        )
    if sign not in _FORMS[name]:
        expected = " or ".join(
            f"{name}{form}NUMBER" if form else name for form in _FORMS[name]
        )
        what = f"is compared by {sign!r}" if sign else "has no bound"
        raise ConfigError(f"--check: {part!r} {what}, expected {expected}")
    if not sign:
        return Condition(part, name)
    try:
        bound = float(number)
    except ValueError:
        bound = math.nan
    if not 0 <= bound < math.inf:
        raise ConfigError(
            f"--check: {part!r} has the bound {number!r}, expected a number from 0 on"
        )
    # No quantity is below 0, no share above 1, no count a fraction.
    most = 1.0 if name == "judged" else math.inf
    if (
        (sign, bound) in (("<", 0.0), (">", most))
        or bound > most
        or (sign == "=" and bound % 1 != 0)
    ):
        raise ConfigError(f"--check: {part!r} can never hold")
    return Condition(part, name, sign, bound)
