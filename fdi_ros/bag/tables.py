"""Summaries as tables that a person reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fdi_ros.study.verdict import notes, verdict
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


def summary_text(summary: dict[str, Any]) -> str:
    """Words and tables for one replay."""
    rate = summary["messages"] / summary["seconds"] if summary["seconds"] else 0.0
    parts = [
        *(f"{line}\n" for line in verdict(summary)),
        f"\n{shown(summary['bag'])}: {summary['samples']} samples, {summary['duration_s']:.2f} s,"
        f" detector {summary['detector']}, replayed in {summary['seconds']:.2f} s ({rate:.0f} messages/s)\n",
    ]
    if summary["faults"]:
        parts += ["\ninjected faults\n", _faults(summary["faults"])]
    parts += ["\ndeclarations that no injected fault explains", _declared(summary["declared"])]
    parts.append(_rms(summary))
    parts += [f"note: {line}\n" for line in (*summary["degraded"], *notes(summary))]
    return "".join(parts)


def _faults(faults: Sequence[dict[str, Any]]) -> str:
    head = ("channel", "kind", "size", "start", "detected", "delay", "isolated", "declared")
    rows = []
    for fault in faults:
        delay = None if fault["delay_s"] is None else 1000 * fault["delay_s"]
        missed = "declared before" if fault["declared_before"] else "no"
        size = "-" if fault["size"] is None else f"{fault['size']:g}"
        detected = missed if fault["detected_at_s"] is None else f"{fault['detected_at_s']:.3f} s"
        isolated = "yes" if fault["isolated"] else "no"
        declared = " ".join(fault["declared_channels"]) or "-"
        start = f"{fault['start_s']:g} s"
        rows.append(
            (fault["channel"], fault["kind"], size, start, detected, number(delay, 1, " ms"), isolated, declared)
        )
    return table(head, rows)


def _declared(declared: Sequence[dict[str, Any]]) -> str:
    if not declared:
        return ": none\n"
    shown = declared[:_MOST_DECLARED]
    rows = [(d["channel"], f"{d['at_s']:.3f} s", d["state"], d["reason"], " ".join(d["group"])) for d in shown]
    more = f"  and {len(declared) - len(shown)} more\n" if len(declared) > len(shown) else ""
    return "\n" + table(("channel", "at", "state", "reason", "one of"), rows) + more


def _rms(summary: dict[str, Any]) -> str:
    if not summary["faults"]:
        return ""
    rms = summary["rms_error"]
    words = {
        "before_detection": "before detection",
        "after_detection": "after",
        "without_monitor": "least squares of all channels",
    }
    figures = ", ".join(f"{words[name]} {_rate(value)}" for name, value in rms.items())
    return f"\nrms error of the fused rate: {figures}\n"


def _rate(value: float | None) -> str:
    return "-" if value is None else f"{value:.6f} rad/s"


def comparison_text(summaries: Sequence[dict[str, Any]]) -> str:
    """One table of all detectors on one stream."""
    head = ("detector", "detected", "isolated", "mean delay", "false", "rms after detection", "us a sample")
    rows = [_comparison_row(summary) for summary in summaries if "refused" not in summary]
    refused = [f"{s['detector']} cannot run here: {s['refused']}\n" for s in summaries if "refused" in s]
    return table(head, rows) + "".join(refused)


def _comparison_row(summary: dict[str, Any]) -> tuple[str, ...]:
    faults = summary["faults"]
    delays = [fault["delay_s"] for fault in faults if fault["delay_s"] is not None]
    return (
        summary["detector"],
        f"{len(delays)} of {len(faults)}",
        f"{sum(fault['isolated'] for fault in faults)} of {len(faults)}",
        number(1000 * sum(delays) / len(delays) if delays else None, 1, " ms"),
        str(len(summary["declared"])),
        _rate(summary["rms_error"]["after_detection"]),
        f"{summary['us_per_sample']:.1f}",
    )
