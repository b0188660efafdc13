"""The tables of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

MOST_ROWS = 1000
"""Of the table of events; the first ones."""


def about_table(about: Mapping[str, str]) -> str:
    """Lay out what was run."""
    return "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in about.items())


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
    return _table(head, rows)


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
    return _table(head, rows) + more


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    top = "".join(f"<th>{escape(word)}</th>" for word in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(word)}</td>" for word in row) + "</tr>" for row in rows)
    return f"<div class='scroll'><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"


def _seconds(value: float | None, missing: str = "-") -> str:
    return missing if value is None else f"{value:.3f} s"


def _milliseconds(value: float | None) -> str:
    return "-" if value is None else f"{1000 * value:.1f} ms"
