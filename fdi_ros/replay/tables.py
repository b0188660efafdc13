"""Summaries as tables that a person reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fdi_ros.faults.kinds import KINDS
from fdi_ros.replay.verdict import notes, sample_rate_notes, verdict
from fdi_ros.report.unit import RADIANS, Unit
from fdi_ros.text import shown

_MOST_DECLARED = 20
"""Rows of the table of declarations."""


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns of text, each as wide as its widest entry."""
    rows = [[shown(word) for word in row] for row in rows]
    widths = [max(len(row[i]) for row in (head, *rows)) for i in range(len(head))]
    lines = ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    return "".join(f"  {line.rstrip()}\n" for line in lines)


def number(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return a number with a unit, or a dash."""
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def summary_text(summary: dict[str, Any], unit: Unit = RADIANS) -> str:
    """Words and tables for one replay."""
    rate = summary["messages"] / summary["seconds"] if summary["seconds"] else 0.0
    parts = [
        *(f"{line}\n" for line in verdict(summary)),
        f"\n{shown(summary['bag'])}: {summary['samples']} samples, {summary['duration_s']:.2f} s,"
        f" detector {summary['detector']}, replayed in {summary['seconds']:.2f} s ({rate:.0f} messages/s)\n",
    ]
    if summary["faults"]:
        parts += ["\ninjected faults\n", fault_table(summary["faults"], unit)]
    parts += ["\ndeclarations that no injected fault explains", _declared(summary["declared"])]
    parts.append(_effect(summary, unit))
    parts += [f"note: {line}\n" for line in (*summary["degraded"], *notes(summary))]
    return "".join(parts)


def fault_table(faults: Sequence[dict[str, Any]], unit: Unit = RADIANS) -> str:
    """Lay out the injected faults and what became of them."""
    head = ("channel", "kind", "size", "start", "detected", "delay", "isolated after", "named")
    rows = []
    for fault in faults:
        missed = "declared before" if fault["declared_before"] else "no"
        detected = missed if fault["detected_at_s"] is None else f"{fault['detected_at_s']:.3f} s"
        isolated = _milliseconds(fault["isolation_delay_s"]) if fault["isolated"] else "no"
        declared = " ".join(fault["declared_channels"]) or "-"
        start = f"{fault['start_s']:g} s"
        delay = _milliseconds(fault["delay_s"])
        rows.append((fault["channel"], fault["kind"], _size(fault, unit), start, detected, delay, isolated, declared))
    return table(head, rows)


def _milliseconds(seconds: float | None) -> str:
    return number(None if seconds is None else 1000 * seconds, 1, " ms")


def _size(fault: dict[str, Any], unit: Unit) -> str:
    """Size of a fault; where it is a rate, in the unit asked for."""
    if fault["size"] is None:
        return "-"
    option = KINDS[fault["kind"]].options()["size"].unit
    if not option.startswith(RADIANS.name):
        return f"{fault['size']:g} {option}".rstrip()
    return f"{fault['size'] * unit.factor:g} {unit.named(option)}"


def _declared(declared: Sequence[dict[str, Any]]) -> str:
    if not declared:
        return ": none\n"
    shown = declared[:_MOST_DECLARED]
    rows = [(d["channel"], f"{d['at_s']:.3f} s", d["state"], d["reason"], " ".join(d["group"])) for d in shown]
    more = f"  and {len(declared) - len(shown)} more\n" if len(declared) > len(shown) else ""
    return "\n" + table(("channel", "at", "state", "reason", "one of"), rows) + more


def _effect(summary: dict[str, Any], unit: Unit) -> str:
    if not summary["faults"]:
        return ""
    effect = summary["fault_effect_rad_s"]
    return (
        "\neffect of the faults on the rate, rms, against the same samples without them, saturated ones left out:\n"
        f"  fused rate until detection {unit.words(effect['before_detection'])},"
        f" after it {unit.words(effect['after_detection'])};"
        f" least squares of all channels, no monitor: {unit.words(effect['without_monitor'])}\n"
    )


def comparison_text(summaries: Sequence[dict[str, Any]], unit: Unit = RADIANS) -> str:
    """One table of all detectors on one stream."""
    head = ("detector", "detected", "isolated", "mean delay", "false", "rms effect after detection", "us a sample")
    rows = [_comparison_row(summary, unit) for summary in summaries if "refused" not in summary]
    refused = [f"{s['detector']} cannot run here: {s['refused']}\n" for s in summaries if "refused" in s]
    run = [summary for summary in summaries if "refused" not in summary]
    noted = [f"note: {line}\n" for summary in run[:1] for line in sample_rate_notes(**summary["sample_rate"])]
    return table(head, rows) + "".join([*refused, *noted])


def _comparison_row(summary: dict[str, Any], unit: Unit) -> tuple[str, ...]:
    faults = summary["faults"]
    delays = [fault["delay_s"] for fault in faults if fault["delay_s"] is not None]
    return (
        summary["detector"],
        f"{len(delays)} of {len(faults)}",
        f"{sum(fault['isolated'] for fault in faults)} of {len(faults)}",
        number(1000 * sum(delays) / len(delays) if delays else None, 1, " ms"),
        str(len(summary["declared"])),
        unit.words(summary["fault_effect_rad_s"]["after_detection"]),
        f"{summary['us_per_sample']:.1f}",
    )
