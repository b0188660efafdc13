"""The tables of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from fdi_ros.report.page import html_table

MOST_ROWS = 1000
"""Of the table of events; the first ones."""


EFFECTS = {
    "before_detection": "before detection",
    "after_detection": "after detection",
    "without_monitor": "without a monitor, least squares of all channels",
}
"""Root mean squares of a summary, in words."""
CHANNEL_HEAD = ("channel", "rms residual while OK, rad/s", "rms in all, rad/s", "largest, rad/s", "at", "last state")


def channel_table(rows: Sequence[Sequence[str]]) -> str:
    """Lay out the figures of the channels' residuals."""
    return html_table(CHANNEL_HEAD, rows)


def effect_table(summary: Mapping[str, Any]) -> str:
    """Lay out what the injected faults did to the fused rate."""
    if not summary["faults"]:
        return ""
    figures = summary["fault_effect_rad_s"]
    rows = [(EFFECTS[name], "-" if value is None else f"{value:.6f} rad/s") for name, value in figures.items()]
    hint = "Difference of the fused rate to that of the same monitor without the faults."
    return f"<p class='hint'>{escape(hint)}</p>" + html_table(("samples", "rms effect of the faults"), rows)


def comparison_table(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Lay out what each detector made of the same recording."""
    effects = [f"rms effect {words}, rad/s" for words in EFFECTS.values()]
    head = ("detector", "detected", "isolated", "mean delay", "false declarations", *effects, "us per sample")
    shown = head if summaries[0]["faults"] else (head[0], head[4], head[-1])
    return html_table(shown, map(_compared, summaries))


def found_table(summaries: Sequence[Mapping[str, Any]]) -> str:
    """Lay out what each detector made of each injected fault."""
    faults = summaries[0]["faults"]
    head = ("detector", *(f"{f['kind']} on {f['channel']} at {f['start_s']:g} s" for f in faults))
    return html_table(head, [(s["detector"], *map(_found, s["faults"])) for s in summaries])


def _found(fault: Mapping[str, Any]) -> str:
    if fault["detected_at_s"] is None:
        return "declared before" if fault["declared_before"] else "missed"
    names = ", ".join(fault["declared_channels"])
    return f"{_milliseconds(fault['delay_s'])}, " + ("isolated" if fault["isolated"] else f"one of {names}")


def _compared(summary: Mapping[str, Any]) -> tuple[str, ...]:
    faults, false = summary["faults"], str(len(summary["declared"]))
    cost = f"{summary['us_per_sample']:.1f}"
    if not faults:
        return summary["detector"], false, cost
    delays = [fault["delay_s"] for fault in faults if fault["delay_s"] is not None]
    rms = summary["fault_effect_rad_s"]
    return (
        summary["detector"],
        f"{len(delays)} of {len(faults)}",
        f"{sum(fault['isolated'] for fault in faults)} of {len(faults)}",
        _milliseconds(sum(delays) / len(delays) if delays else None),
        false,
        *("-" if rms[name] is None else f"{rms[name]:.6f}" for name in EFFECTS),
        cost,
    )


def fault_table(faults: Sequence[Mapping[str, Any]]) -> str:
    """Lay out the injected faults with their delays."""
    if not faults:
        return "<p>None were injected.</p>"
    head = ("channel", "kind", "size", "start", "stop", "detected", "delay", "as", "isolated after", "named")
    rows = [
        (
            fault["channel"],
            fault["kind"],
            "-" if fault["size"] is None else f"{fault['size']:g}",
            _seconds(fault["start_s"]),
            _seconds(fault["stop_s"]),
            "declared before" if fault["declared_before"] else _seconds(fault["detected_at_s"], missing="not detected"),
            _milliseconds(fault["delay_s"]),
            fault["detected_as"] or "-",
            _milliseconds(fault["isolation_delay_s"]) if fault["isolated"] else "no",
            ", ".join(fault["declared_channels"]) or "-",
        )
        for fault in faults
    ]
    return html_table(head, rows)


def event_table(events: Sequence[Mapping[str, Any]]) -> str:
    """Lay out the changes of state."""
    if not events:
        return "<p>No channel changed its state.</p>"
    head = ("time", "channel", "from", "to", "reason", "one of", "error")
    rows = [
        (
            _seconds(event["at_s"]),
            event["channel"],
            event["before"],
            event["state"],
            event["reason"],
            ", ".join(event["group"]) if event["state"] == "AMBIGUOUS" else "",
            f"{event['error']:.4f} rad/s" if event["error"] else "",
        )
        for event in events[:MOST_ROWS]
    ]
    more = f"<p>{len(events) - MOST_ROWS} more.</p>" if len(events) > MOST_ROWS else ""
    return html_table(head, rows) + more


def _seconds(value: float | None, missing: str = "-") -> str:
    return missing if value is None else f"{value:.3f} s"


def _milliseconds(value: float | None) -> str:
    return "-" if value is None else f"{1000 * value:.1f} ms"
