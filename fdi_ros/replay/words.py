# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sentences and tables of a replay for a terminal. The verdict itself is in `verdict`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple
from typing import Any, NamedTuple

from fdi_ros.config.unit_names import short_names
from fdi_ros.faults.fault import ACCELEROMETERS
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.monitor.diagnostics import UNUSED_COUNTERS
from fdi_ros.monitor.receiver import RATE_TOLERANCE
from fdi_ros.monitor.soundness import REPORTED, Concern, Trouble, UnitHealth, Word
from fdi_ros.replay.episodes import (
    ROOM,
    Episode,
    Story,
    detail_words,
    episode_words,
    stretch_words,
)
from fdi_ros.replay.outcomes import Outcome, Scores
from fdi_ros.replay.summary import ChannelResult, SampleRate, Summary
from fdi_ros.replay.verdict import (
    SILENT_TO_END,
    noise_behind,
    set_clocks,
    silent_units,
    unjudged_words,
    verdict_of,
    wrongly_named,
)
from fdi_ros.report.layout import (
    FORCES,
    RADIANS,
    Columns,
    Section,
    Unit,
    head_and_rows,
    milliseconds,
    number,
    section_text,
)
from fdi_ros.system.text import figures, first_of, listed, percent, shown, span

AUTOPILOT_LOGS = (".bin", ".tlog")
"""Suffixes of the logs of ArduPilot."""


class _TerminalRoom(NamedTuple):
    """What a terminal shows of the episodes."""

    #: episodes without data for one reason from which on they are shown as one
    folded: int = 4
    #: episodes with all their details
    episodes: int = 20


TERMINAL_ROOM = _TerminalRoom()


def sentences(summary: Summary, unit: Unit = RADIANS) -> list[str]:
    """Return the sentences below the verdict."""
    faults = sorted(
        summary.scores.faults, key=lambda fault: fault.detected_at_s is None
    )
    lines = [
        f"{fault.kind} on {fault.channel}: {_detection_words(fault)}."
        for fault in faults
    ]
    if faults:
        lines += _unexplained_lines(summary, unit)
    elif verdict_of(summary).word != Word.HEALTHY.value:
        lines += _unchecked_lines(summary)
    return [*lines, *_concern_lines(summary), *_name_lines(summary)]


def _concern_lines(summary: Summary) -> list[str]:
    """Return the concerns that the verdict does not list."""
    word = verdict_of(summary).word
    deciding = [one for one in summary.concerns if one.word.value == word]
    said = [
        *deciding[: REPORTED.concerns],
        *noise_behind(summary)[: REPORTED.concerns],
        *([] if summary.scores.faults else set_clocks(summary)),
    ]
    others = [one for one in _beside_silence(summary) if one not in said]
    return [one.sentence for one in others]


def _beside_silence(summary: Summary) -> list[Concern]:
    """Return the concerns, without those that repeat that a unit is silent to the end."""
    silent = silent_units(summary)
    explained = {
        one.name
        for one in summary.monitor.units
        if one.name in silent
        and one.slow_to_s is None
        and one.slow_from_s is not None
        and one.slow_from_s >= silent[one.name] - SILENT_TO_END
    }
    return [
        one
        for one in summary.concerns
        if not (one.trouble is Trouble.DELIVERY and explained.issuperset(one.who))
    ]


def _name_lines(summary: Summary) -> list[str]:
    """Return which topic each unit is, or which message of the log, once."""
    units = summary.monitor.units
    lines = []
    if any(one.topic.strip("/") != one.name.strip("/") for one in units):
        topics = ", ".join(f"{one.name} is {one.topic}" for one in units)
        lines.append(f"Topics: {topics}.")
    origins = [f"{one.name} is {one.origin}" for one in units if one.origin]
    return [*lines, f"In the log, {'; '.join(origins)}."] if origins else lines


def unchecked_words(channels: Sequence[ChannelResult]) -> str:
    """Describe the last state of channels, with its time and reason."""
    alike: dict[tuple[str, str], list[ChannelResult]] = {}
    for one in channels:
        alike.setdefault((one.state, one.reason), []).append(one)
    words = []
    for (state, reason), group in alike.items():
        since = sorted({one.since_s or 0.0 for one in group})
        if not since[-1]:
            when = "from the start"
        else:
            first = f"{since[0]:.1f} s"
            last = f"{since[-1]:.1f} s"
            when = f"from {first} on"
            when += f", the last from {last} on" if last != first else ""
        names = listed(short_names([one.name for one in group]))
        why = f" ({reason})" if reason else ""
        words.append(f"{names} {state} {when}{why}")
    return "; ".join(words)


def _unchecked_lines(summary: Summary) -> list[str]:
    """Name the channels that were not checked at the end, unless the verdict does."""
    silent = silent_units(summary)
    lost = [
        one
        for one in summary.unchecked_channels
        if one.unit not in silent
        and one.since_s is not None
        and summary.scores.end_s - one.since_s >= SILENT_TO_END
    ]
    return [f"Not checked at the end: {unchecked_words(lost)}."] if lost else []


def notes(summary: Summary) -> list[str]:
    """Return notes on damage, unused messages and limits of the monitor."""
    stream = summary.stream
    scores = summary.scores
    lines = [*stream.facts, *stream.damage, *sample_rate_notes(stream.sample_rate)]
    lines += [
        f"{topic}: malformed messages: {count}"
        for topic, count in stream.malformed.items()
        if count
    ]
    if stream.disordered:
        lines.append(
            f"{stream.disordered} messages not used: they were recorded out of order"
        )
    lines += _unused_words(stream.alignment)
    if missing := scores.samples - scores.samples_with_rate:
        lines.append(_rate_words(summary, missing))
    lines += stretch_words(summary.story)
    if summary.monitor.note:
        lines.append(f"at the end, {summary.monitor.note}")
    return lines


def _unused_words(alignment: Mapping[str, Mapping[str, int]]) -> list[str]:
    """Return lines on messages of each topic that were not used as they came."""
    lines = []
    silent = {"received"}
    jumps = {counters.get("jumped", 0) for counters in alignment.values()}
    if len(alignment) > 1 and len(jumps) == 1 and 0 not in jumps:
        # Together they are ahead of nobody.
        silent.add("jumped")
        times = "once" if jumps == {1} else f"{jumps.pop()} times"
        lines.append(
            f"the stamps of all units jumped together, {times}: a gap, or their clocks were set"
        )
    for topic, counters in alignment.items():
        unused = ", ".join(
            f"{UNUSED_COUNTERS.get(name, f'samples {name}')}: {n}"
            for name, n in counters.items()
            if n and name not in silent
        )
        lines += [f"{topic}: {unused}"] if unused else []
    return lines


def _rate_words(summary: Summary, missing: int) -> str:
    """Describe the samples without a fused rate: how many, and how many at the start."""
    of = f"{missing} of {summary.scores.samples} samples"
    bias = summary.monitor.bias.state
    if bias != "learned":
        why = "" if bias == "fixed" else f" (start-up bias: {bias})"
        return f"no fused rate in {of}{why}"
    # The rate counts as missing only from its first sample on.
    later = summary.monitor.rate.missing_s
    if not later:
        return f"no fused rate in the first {of}, while the biases were learned"
    return f"no fused rate in {of}, at first because the biases were being learned"


def sample_rate_notes(rate: SampleRate) -> list[str]:
    """Return a line if the configured sample rate differs from the recording's."""
    if rate.recorded_hz is None:
        return []
    if abs(rate.recorded_hz / rate.configured_hz - 1) <= RATE_TOLERANCE:
        return []
    return [
        f"sample_rate is {rate.configured_hz:g} Hz in the config and {figures(rate.recorded_hz, 4)} Hz"
        " in the recording: the false-alarm rate is wrong by the same factor"
    ]


def _detection_words(fault: Outcome) -> str:
    """Describe detection and isolation of an injected fault."""
    if fault.detected_at_s is None:
        if fault.declared_before:
            return "not counted, because its channels were already declared"
        if fault.kind in ("noise", "spike"):
            return "not declared faulty: noise and spikes are only reported"
        return "not detected"
    words = f"detected after {_time(fault.delay_s)}"
    if fault.isolated_at_s == fault.detected_at_s:
        return f"{words}, isolated"
    if fault.other_channels:
        words += f" as one of {', '.join(fault.declared_channels)}"
    elif len(fault.channels) > 1:
        words += f", declared: {', '.join(fault.declared_channels)}"
    if not fault.isolated:
        return f"{words}, not isolated"
    return f"{words}, isolated after {_time(fault.isolation_delay_s)}"


def _unexplained_lines(summary: Summary, unit: Unit) -> list[str]:
    """Describe declarations that no injected fault explains."""
    scores = summary.scores
    story = summary.story
    unexplained = [one for one in story.declared if not one.injected]
    if unexplained:
        count = f"{len(unexplained)} episode{'s' if len(unexplained) > 1 else ''}"
        first = (
            f", the first {ROOM.episodes}" if len(unexplained) > ROOM.episodes else ""
        )
        lines = [f"{count} that no injected fault explains{first}:"]
        for one in unexplained[: ROOM.episodes]:
            where = f"stretch {one.stretch}: " if len(story.stretches) > 1 else ""
            lines.append(f"{where}{episode_words(one, unit)}.")
        if more := len(unexplained[ROOM.episodes :]) + story.more:
            lines.append(f"And {more} more episode{'s' if more > 1 else ''}.")
        return lines
    if wrong := wrongly_named(summary):
        return [f"Declared faulty without an injected fault: {', '.join(wrong)}."]
    if why := unjudged_words(summary):
        return [f"The verdict on all other channels is CANNOT TELL: {why}."]
    doubted = dict.fromkeys(
        name
        for fault in scores.faults
        for name in fault.other_channels
        if name not in scores.struck
    )
    if doubted:
        verb = "was a candidate" if len(doubted) == 1 else "were candidates"
        names = listed(list(doubted))
        return [f"No other channel was declared faulty, but {names} {verb} for a time."]
    return ["No other channel was declared faulty."]


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{figures(seconds)} s"


# Tables for a terminal


def summary_text(summary: Summary, unit: Unit = RADIANS) -> str:
    """Return sentences and tables for one replay."""
    scores = summary.scores
    rate = summary.stream.messages / summary.seconds if summary.seconds else 0.0
    lines = [verdict_of(summary, unit).sentence, *sentences(summary, unit)]
    health = health_section(summary, unit)
    parts = [
        *(f"{line}\n" for line in lines),
        f"\n{shown(summary.bag)}: {scores.samples} samples, {scores.duration_s:.2f} s,"
        f" detector {summary.detector}, replayed in {summary.seconds:.2f} s"
        f" ({rate:.0f} messages/s)\n",
        _episodes(summary.story, bool(scores.faults), unit),
        f"\n{section_text(health)}" if health.content else "",
        *(f"\n{section_text(section)}" for section in fault_sections(scores, unit)),
        *(f"note: {line}\n" for line in summary.monitor.degraded),
        *(f"note: {line}\n" for line in notes(summary)),
    ]
    return "".join(parts)


def health_section(summary: Summary, unit: Unit = RADIANS) -> Section:
    """Lay out the health of each unit, the worst of its channels in each column."""
    channels = summary.monitor.channels
    units = summary.monitor.units
    rows = [
        (one, [each for each in channels if each.unit == one.name] or list(channels))
        for one in units
    ]
    reference = next((one.delay_to for one in units if one.delay_to), "")
    delay = f"delay to {reference}" if reference else "delay"
    columns: dict[str, Callable[[Any], str]] = {
        "unit": lambda row: row[0].name,
        "delivered": lambda row: percent(row[0].delivered),
        "messages per s": lambda row: number(row[0].rate_hz, ".3g"),
        "checked": lambda row: percent(min(one.checked for one in row[1])),
        "spikes": lambda row: str(sum(one.spikes for one in row[1])),
        "at end of range": lambda row: (
            f"{figures(max(one.saturated_s for one in row[1]), 2)} s"
        ),
        f"noise, {unit.name}": lambda row: number(_noise(row[1], unit), ".2g"),
        f"noise, {FORCES.name}": lambda row: number(_noise(row[1], FORCES), ".2g"),
        "temperature": lambda row: _temperature_words(row[0]),
        delay: lambda row: milliseconds(row[0].delay_s),
        "trouble": lambda row: _trouble_words(summary, row[0].name, row[1]),
    }
    if all(one.delay_s is None for one in units):
        del columns[delay]
    if all(one.temperature_c is None for one in units):
        del columns["temperature"]
    if all(one.measured_in != FORCES.name for one in channels):
        del columns[f"noise, {FORCES.name}"]
    return Section(
        "Health of each unit", "", head_and_rows(columns, rows) if rows else ""
    )


def _temperature_words(unit: UnitHealth) -> str:
    """Return the range of the temperature of a unit. A dash: not logged."""
    if unit.temperature_c is None:
        return "-"
    return f"{span(*unit.temperature_c, '.0f')} °C"


def _noise(channels: Sequence[ChannelResult], unit: Unit) -> float | None:
    """Return the largest noise of the channels measured in a unit. None: not measured."""
    known = [
        one.own_noise_rad_s * unit.factor
        for one in channels
        if one.own_noise_rad_s is not None
        and (one.measured_in == FORCES.name) == (unit == FORCES)
    ]
    return max(known, default=None)


def _trouble_words(
    summary: Summary, unit: str, channels: Sequence[ChannelResult]
) -> str:
    """Describe the troubles of a unit. A dash: none."""
    own = [one.name for one in channels]
    names = {unit, *own}
    own_episodes = [
        one for one in summary.story.episodes if not names.isdisjoint(one.channels)
    ]
    words = _count_words(own_episodes)
    for one in _beside_silence(summary):
        about = [name for name in own if name in one.who]
        if about and len(about) < len(own):
            axes = listed([name.rpartition(".")[2] for name in short_names(about)])
            words.append(f"{axes} {one.words}")
        elif about or unit in one.who:
            words.append(one.words)
    return "; ".join(words) or "-"


def _count_words(episodes: Sequence[Episode]) -> list[str]:
    """Describe the worst state in some episodes, and when it was. Empty: no episodes."""
    for state in ("FAULTY", "AMBIGUOUS", "STALE"):
        alike = [one for one in episodes if one.state == state]
        if not alike:
            continue
        last = alike[-1]
        until = "to the end" if last.stands else f"to {last.end_s:.1f} s"
        if len(alike) == 1:
            return [f"{state.lower()} from {last.start_s:.1f} s {until}"]
        times = f"{state.lower()} {len(alike)} times"
        return [
            f"{times}, first from {alike[0].start_s:.1f} s,"
            f" last from {last.start_s:.1f} s {until}"
        ]
    return []


def fault_sections(scores: Scores, unit: Unit = RADIANS) -> list[Section]:
    """Lay out the injected faults with their results and effect. Empty: no faults."""
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
        "detected as": lambda fault: fault.detected_as or "-",
        "isolated after": lambda fault: (
            milliseconds(fault.isolation_delay_s) if fault.isolated else "no"
        ),
        "candidates": lambda fault: ", ".join(fault.declared_channels) or "-",
    }
    effect = scores.fault_effect_rad_s
    rows = [
        ("fused rate before the detection", unit.words(effect.before_detection)),
        ("fused rate after the detection", unit.words(effect.after_detection)),
        (
            "least squares of all channels, without a monitor",
            unit.words(effect.without_monitor),
        ),
    ]
    hint = "RMS difference from a replay without the faults. Saturated samples do not count."
    faults = Section("Injected faults", "", head_and_rows(columns, scores.faults))
    if not any(astuple(effect)):
        # The faults are in accelerometers alone.
        return [faults]
    rates = ("rate", "rms effect"), rows
    return [faults, Section("Effect of the faults on the rate", hint, rates)]


def _detected(fault: Outcome) -> str:
    missed = "declared before" if fault.declared_before else "no"
    return (
        missed
        if fault.detected_at_s is None
        else number(fault.detected_at_s, unit=" s")
    )


def size_of(fault: Outcome, unit: Unit = RADIANS) -> str:
    """Return the size of a fault with its unit, and rates in the given unit."""
    if fault.size is None:
        return "-"
    option = FAULT_KINDS[fault.kind].options()["size"].unit
    if ACCELEROMETERS in fault.channel:
        option = option.replace(RADIANS.name, FORCES.name)
    if not option.startswith(RADIANS.name):
        return f"{fault.size:g} {option}".rstrip()
    return f"{fault.size * unit.factor:g} {unit.named(option)}"


def _episodes(story: Story, scored: bool, unit: Unit) -> str:
    """List the episodes: channels, time and size, then the details."""
    silent, folded = _folded(story)
    shown_ones = [one for one in story.episodes if one not in silent]
    first = shown_ones[: TERMINAL_ROOM.episodes]
    lines = ["\nwhat happened\n"] if first else []
    for place, one in enumerate(first, 1):
        where = f" (stretch {one.stretch})" if len(story.stretches) > 1 else ""
        lines.append(f"  {place}. {episode_words(one, unit)}{where}\n")
        lines += [
            f"       {title}: {words}\n"
            for title, words in detail_words(one, unit, scored)
        ]
    numbered = enumerate(folded, len(first) + 1)
    lines += [f"  {k}. {words}\n" for k, words in numbered]
    if folded and not first:
        lines.insert(0, "\nwhat happened\n")
    more = len(shown_ones) - len(first) + story.more
    return "".join([*lines, f"  and {more} more\n"] if more else lines)


def _folded(story: Story) -> tuple[list[Episode], list[str]]:
    """Return the episodes without data that are alike, and a sentence for each kind."""
    alike: dict[str, list[Episode]] = {}
    for one in story.episodes:
        if not one.declares and not one.injected:
            alike.setdefault(one.evidence.reason, []).append(one)
    alike = {
        why: some for why, some in alike.items() if len(some) >= TERMINAL_ROOM.folded
    }
    words = []
    for why, some in alike.items():
        channels = sorted({name for one in some for name in one.channels})
        who = first_of(short_names(channels), ROOM.episodes)
        begin = some[0].start_s
        end = max(one.end_s for one in some)
        words.append(
            f"STALE {len(some)} times between {begin:.1f} and {end:.1f} s: {who} ({why})"
        )
    return [one for some in alike.values() for one in some], words
