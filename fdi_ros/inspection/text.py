# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is in a recording, in words and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fdi_ros.arrays import Array, Int
from fdi_ros.inspection.inspect import BELIEVED, DEGREES_WORDS, TopicReport, clocks_apart
from fdi_ros.report.text_table import RADIANS, Unit, indented, table
from fdi_ros.text import date_of, shown


def recording_text(reports: Sequence[TopicReport], bag: Path) -> str:
    """Describe when it was recorded, how long it is and how large."""
    size = _size(bag) / 1e6
    if (span := _span(reports)) is None:
        return f"{shown(bag.name)}: no messages, {size:.1f} MB\n\n"
    first, last = span
    date = date_of(first)
    begun = f"{date:%Y-%m-%d %H:%M:%S} UTC" if date is not None else f"{first * 1e-9:.1f} s after a start, date unknown"
    return f"{shown(bag.name)}: {(last - first) * 1e-9:.1f} s from {begun}, {size:.1f} MB\n\n"


def recording_figures(reports: Sequence[TopicReport], bag: Path, damage: Sequence[str]) -> dict[str, object]:
    """All figures by name, SI units: for programs."""
    span = _span(reports)
    date = None if span is None else date_of(span[0])
    return {
        "bag": str(bag),
        "start_ns": None if span is None else span[0],
        "start": None if date is None else date.isoformat(),
        "duration_s": None if span is None else (span[1] - span[0]) * 1e-9,
        "size_bytes": _size(bag),
        "damage": list(damage),
        "topics": [_topic_figures(report) for report in reports],
    }


def _topic_figures(report: TopicReport) -> dict[str, object]:
    figures: dict[str, object] = {
        "name": report.topic.name,
        "type": report.topic.type,
        "messages": report.received,
        "rate_hz": report.rate,
        "gaps": report.gaps,
        "longest_gap_s": report.longest,
        "malformed": report.malformed,
        "could_be_gyros": report.could_be_gyros,
    }
    if report.could_be_gyros:
        figures |= {
            "values": report.channels,
            "not_finite": report.not_finite,
            "beyond_all_rates": report.beyond,
            "repeated": report.repeated,
            "stamps_not_increasing": report.backward,
            "stamps_ahead_s": report.ahead,
            "largest": report.largest,
            "quiet_noise": report.stretches.quiet_noise(),
            "moving_noise": report.stretches.moving_noise(),
            "moving_share": report.stretches.moving_share(),
        }
    return figures


def _span(reports: Sequence[TopicReport]) -> tuple[int, int] | None:
    """Return the times of recording of the first and the last message, ns."""
    recorded = [report for report in reports if report.received]
    return (min(report.first for report in recorded), max(report.last for report in recorded)) if recorded else None


def _size(bag: Path) -> int:
    """Bytes of all files."""
    paths = [path for path in bag.rglob("*") if path.is_file()] if bag.is_dir() else [bag]
    return sum(path.stat().st_size for path in paths)


def topics_text(reports: Sequence[TopicReport], damage: Sequence[str], unit: Unit = RADIANS) -> str:
    """Lay out the topics."""
    head = ("topic", "type", "messages", "rate", "gaps", "longest gap", "noise at its quietest", "in motion", "gyros?")
    rows = [
        (
            shown(report.topic.name),
            shown(report.topic.type or "unknown"),
            str(report.received),
            f"{report.rate:.1f} Hz",
            str(report.gaps),
            f"{1000 * report.longest:.1f} ms",
            *(
                _noise(values * unit.factor) if report.could_be_gyros else "-"
                for values in (report.stretches.quiet_noise(), report.stretches.moving_noise())
            ),
            _gyros(report, unit),
        )
        for report in reports
    ]
    notes = [f"note: damaged recording: {line}\n" for line in damage]
    if apart := clocks_apart([report for report in reports if report.could_be_gyros]):
        notes.append(f"note: {apart}\n")
    if any(report.could_be_gyros for report in reports):
        notes.insert(
            0, f"noise: {unit.name} a sample of each value, vibration included; motion slower than it is left out\n"
        )
    return indented(table(head, rows, figures=False)) + "".join(notes)


def _noise(values: Array) -> str:
    if not np.isfinite(values).any():
        return "-"
    if len(values) > 3:
        return f"{np.nanmin(values):.2g} to {np.nanmax(values):.2g}"
    return " ".join(f"{value:.2g}" for value in values)


def _gyros(report: TopicReport, unit: Unit) -> str:
    if not report.could_be_gyros:
        return "no"
    largest = f"up to {report.largest * unit.factor:.3g} {unit.name}"
    words = [f"{report.channels} values", largest if math.isfinite(report.largest) else "none of them a rate"]
    words += ["never all of them usable"] if math.isfinite(report.largest) and not report.complete else []
    words += [DEGREES_WORDS.partition("?")[0] + "?"] if report.looks_like_degrees else []
    words += [f"in motion for {report.stretches.moving_share():.0%}"] if report.complete else []
    words += [f"not finite: {_counts(report, report.not_finite)}"] if report.not_finite.any() else []
    beyond = f"beyond {BELIEVED * unit.factor:.3g} {unit.name}"
    words += [f"{beyond}: {_counts(report, report.beyond)}"] if report.beyond.any() else []
    words += [f"frozen: {_counts(report, report.repeated)}"] if report.repeated.any() else []
    words += [f"{report.malformed} malformed"] if report.malformed else []
    words += [f"{report.backward} stamps do not increase"] if report.backward else []
    return ", ".join(words)


def _counts(report: TopicReport, counts: Int) -> str:
    """Format counts of values (c,) by their places in the message."""
    places = report.kind.value_names(report.channels) if report.kind is not None else []
    counted = zip(places, counts.tolist(), strict=True)
    return " and ".join(f"{count} of {place}" for place, count in counted if count)
