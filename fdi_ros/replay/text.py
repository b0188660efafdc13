# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Summaries as a person reads them on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from fdi_ros.episodes.comparison import brief, shared_episodes
from fdi_ros.episodes.story import Episode, Story
from fdi_ros.episodes.words import detail_words, episode_words
from fdi_ros.faults.kinds import KINDS
from fdi_ros.replay.summary import FaultResult, Refusal, Scores, Summary
from fdi_ros.replay.verdict import notes, sample_rate_notes, unchecked_by_detector, verdict
from fdi_ros.report.text_table import indented, milliseconds, number, table
from fdi_ros.report.unit import RADIANS, Unit
from fdi_ros.text import shown

_MOST_TOLD = 20
"""Episodes told of with all that is known."""
_MOST_SHARED = 5
"""Episodes of a comparison."""


def summary_text(summary: Summary, unit: Unit = RADIANS) -> str:
    """Words and tables for one replay."""
    scores = summary.scores
    rate = summary.stream.messages / summary.seconds if summary.seconds else 0.0
    parts = [
        *(f"{line}\n" for line in verdict(summary, unit)),
        f"\n{shown(summary.bag)}: {scores.samples} samples, {scores.duration_s:.2f} s,"
        f" detector {summary.detector}, replayed in {summary.seconds:.2f} s ({rate:.0f} messages/s)\n",
    ]
    if scores.faults:
        parts += ["\ninjected faults\n", fault_table(scores.faults, unit)]
    parts.append(_episodes(summary.story, bool(scores.faults), unit))
    parts.append(_effect(scores, unit))
    parts += [f"note: {line}\n" for line in (*summary.monitor.degraded, *notes(summary))]
    return "".join(parts)


def fault_table(faults: Sequence[FaultResult], unit: Unit = RADIANS) -> str:
    """Lay out the injected faults and what became of them."""
    head = ("channel", "kind", "size", "start", "detected", "delay", "isolated after", "declared, or one of")
    return indented(table(head, [_fault_row(fault, unit) for fault in faults], figures=False))


def _fault_row(fault: FaultResult, unit: Unit) -> tuple[str, ...]:
    missed = "declared before" if fault.declared_before else "no"
    return (
        fault.channel,
        fault.kind,
        size_of(fault, unit),
        f"{fault.start_s:g} s",
        missed if fault.detected_at_s is None else number(fault.detected_at_s, 3, " s"),
        milliseconds(fault.delay_s),
        milliseconds(fault.isolation_delay_s) if fault.isolated else "no",
        " ".join(fault.declared_channels) or "-",
    )


def size_of(fault: FaultResult, unit: Unit = RADIANS) -> str:
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
        lines += [f"       {title}: {words}\n" for title, words in _details(one, scored, unit)]
    more = len(story.episodes) - len(told) + story.more
    return "".join([*lines, f"  and {more} more\n"] if more else lines)


def _details(one: Episode, scored: bool, unit: Unit) -> list[tuple[str, str]]:
    injected = [("injected there", ", ".join(one.injected) or "nothing")] if scored else []
    return [*detail_words(one, unit), *injected]


def _effect(scores: Scores, unit: Unit) -> str:
    if not scores.faults:
        return ""
    effect = scores.fault_effect_rad_s
    return (
        "\neffect of the faults on the rate, rms, against the same samples without them, saturated ones left out:\n"
        f"  fused rate until detection {unit.words(effect.before_detection)},"
        f" after it {unit.words(effect.after_detection)};"
        f" least squares of all channels, no monitor: {unit.words(effect.without_monitor)}\n"
    )


def comparison_text(results: Sequence[Summary | Refusal], unit: Unit = RADIANS) -> str:
    """Say what each detector makes of one recording; of injected faults, where there are any, the scores."""
    ran = [result for result in results if isinstance(result, Summary)]
    refused = [result for result in results if isinstance(result, Refusal)]
    noted = [*unchecked_by_detector(ran), *(sample_rate_notes(ran[0].stream.sample_rate) if ran else [])]
    scored = bool(ran and ran[0].scores.faults)
    costs = ("us per sample",)
    head = ("detector", *(_SCORED if scored else ()), "episodes", *costs)
    return "".join(
        [
            indented(table(head, [_comparison_row(summary, unit) for summary in ran], figures=False)),
            _shared(ran),
            *(f"{one.detector} cannot run here: {one.refused}\n" for one in refused),
            *(f"note: {line}\n" for line in noted),
        ]
    )


_SCORED = ("detected", "isolated", "mean delay", "false", "rms effect after detection")


def _comparison_row(summary: Summary, unit: Unit) -> tuple[str, ...]:
    scores, told = summary.scores, str(len(summary.story.declared) + summary.story.more)
    cost = f"{summary.monitor.us_per_sample:.1f}"
    if not scores.faults:
        return summary.detector, told, cost
    return (
        summary.detector,
        f"{len(scores.detected)} of {len(scores.faults)}",
        f"{scores.isolated} of {len(scores.faults)}",
        milliseconds(scores.mean_delay),
        str(len(scores.declared)),
        unit.words(scores.fault_effect_rad_s.after_detection),
        told,
        cost,
    )


def _shared(ran: Sequence[Summary]) -> str:
    """Lay out what each detector says of the same episodes."""
    found = shared_episodes({summary.detector: summary.story for summary in ran})
    parts = []
    for place, shared in enumerate(found[:_MOST_SHARED], 1):
        rows = [(summary.detector, brief(shared.told.get(summary.detector))) for summary in ran]
        parts.append(f"\nepisode {place}, from {shared.start_s:.3f} s\n")
        parts.append(indented(table(("detector", "says"), rows, figures=False)))
    more = len(found) - _MOST_SHARED
    return "".join([*parts, f"  and {more} more\n"] if more > 0 else parts)
