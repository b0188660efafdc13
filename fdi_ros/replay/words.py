# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The verdict on a replay, the sentences below it, and the tables for a terminal."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from itertools import pairwise

from fdi_ros.core.states import Reason
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
    return unchecked_words(
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
    return [
        *lines,
        *_episode_lines(summary, unit),
        *spike_lines(summary),
        *noisy_lines(summary, unit),
    ]


def spike_lines(summary: Summary) -> list[str]:
    """Count the spikes of each channel."""
    found = [one for one in summary.monitor.channels if one.spikes]
    words = ", ".join(f"{one.name} {one.spikes}" for one in found)
    return [f"Spikes, left out of the fused rate: {words}."] if found else []


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


def unchecked_words(channels: Sequence[ChannelResult]) -> str:
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
