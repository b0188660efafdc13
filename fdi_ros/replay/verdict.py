# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What came out of a replay, in sentences: for the terminal, the page and the check."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_ros.episodes.words import MOST_TOLD, story_lines, stretch_words
from fdi_ros.monitor.diagnostics import ODD
from fdi_ros.replay.summary import ChannelResult, FaultResult, SampleRate, Scores, Summary
from fdi_ros.report.unit import RADIANS, Unit

MOSTLY_JUDGED = 0.5
"""Share of the samples that must have been judged for a replay to say something."""
RATE_TOLERANCE = 0.1
"""Share by which the rate of a recording may differ from the configured one."""


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


def unchecked_by_detector(summaries: Sequence[Summary]) -> list[str]:
    """Return what was not checked with several detectors on one recording, and by which of them."""
    detectors: dict[str, list[str]] = {}
    for summary in summaries:
        for line in unchecked_lines(summary):
            detectors.setdefault(line, []).append(summary.detector)
    every = [summary.detector for summary in summaries]
    return [f"{_which(names, every)}: {line}" for line, names in detectors.items()]


def _which(names: Sequence[str], every: Sequence[str]) -> str:
    """Name some of the detectors, or those that are none of them where these are fewer."""
    others = [name for name in every if name not in names]
    if len(others) >= len(names):
        return ", ".join(names)
    return f"all detectors{' but ' if others else ''}{', '.join(others)}"


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


def _detection_words(fault: FaultResult) -> str:
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
        return [f"{count} that no injected fault explains{_first_of(len(told))}:", *lines]
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


def _first_of(count: int) -> str:
    return f", the first {MOST_TOLD}" if count > MOST_TOLD else ""


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1000 * seconds:.0f} ms" if seconds < 10 else f"{seconds:.1f} s"
