# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What happened when: states of channels in rows over time, and the marks of faults in every plot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from fdi_ros.episodes.story import Episode, Story
from fdi_ros.replay.summary import FaultResult, Scores, StateChange, Summary
from fdi_ros.report.page import Figure, time_layout

MOST_CHANGES = 2000
"""Changes of state shown at most."""
MOST_MARKS = 200
"""Declarations marked at most."""
IN_VIEW = 1.0
"""What residuals do so long after the begin of a fault, and after its detection, is not left off the scale, s."""
STATES = {
    "OK": ("#8fbf9f", ""),
    "SUSPECT": ("#e6c84f", "slashes"),
    "AMBIGUOUS": ("#e08a3c", "crosses"),
    "FAULTY": ("#c0392b", "crosses"),
    "STALE": ("#5b6b8c", "dots"),
    "UNCHECKED": ("#b8bec6", ""),
    "EXCLUDED": ("#7a5c99", "lines"),
}
"""Colour and pattern of each state."""
MARKS_HINT = "✕ an episode begins, ◆ its channel is isolated."
GAPS_HINT = "Grey: gaps; each stretch between them is judged for itself."
SCORED_HINT = "Shaded: injected faults; ▼ detected, ◆ isolated, ✕ declared without an injected fault that explains it."


def timeline(
    names: Sequence[str],
    first: Sequence[str],
    events: Iterable[StateChange],
    span: tuple[float, float],
    holes: Sequence[tuple[float, float]] = (),
) -> Figure:
    """Draw the states of the channels.

    Parameters
    ----------
    names
        Of the channels, one row per channel.
    first
        State of each with the first sample; empty: none came.
    events
        Changes of state, in the order of time.
    span
        Begin and end of the samples, s.
    holes
        Begin and end of what is not recorded in between, s.
    """
    begin, end = span
    current = {name: (first[i] if first else "UNCHECKED", begin, "") for i, name in enumerate(names)}
    spans: dict[str, dict[str, list[Any]]] = {}

    def close(name: str, until: float) -> None:
        state, since, reason = current[name]
        into = spans.setdefault(state, {"row": [], "from": [], "to": [], "text": []})
        for low, high in _recorded(since, max(until, since), holes):
            into["row"].append(names.index(name))
            into["from"].append(low)
            into["to"].append(high)
            into["text"].append(f"{name} {state} {reason} from {low:.3f} s to {high:.3f} s")

    changes = [event for event in events if event.before != event.state]
    for event in changes[:MOST_CHANGES]:
        close(event.channel, event.at_s)
        current[event.channel] = (event.state, event.at_s, event.reason)
    for name in names:
        close(name, end)
    data = [
        {"type": "spans", "name": state, "line": {"color": colour}, "pattern": pattern, **spans[state]}
        for state, (colour, pattern) in STATES.items()
        if state in spans
    ]
    layout = time_layout(36 + 24 * len(names), rows=list(names), title="States")
    layout["xaxis"]["range"] = [begin, end]
    return {"data": data, "layout": layout}


def _recorded(since: float, until: float, holes: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Parts of a time, s, that are recorded."""
    parts = []
    for begin, end in holes:
        if since < end and begin < until:
            if since < begin:
                parts.append((since, begin))
            since = end
    return [*parts, (since, until)] if since <= until else parts


def span_of(scores: Scores) -> tuple[float, float]:
    """Return begin and end of the samples of a replay, s; never empty."""
    return scores.start_s, scores.start_s + max(scores.duration_s, 1e-9)


def shades(faults: Sequence[FaultResult]) -> list[dict[str, Any]]:
    """Shade the times of the injected faults."""
    return [{"type": "rect", "kind": "fault", "x0": fault.start_s, "x1": fault.stop_s} for fault in faults]


def faults_in_view(faults: Sequence[FaultResult], episodes: Sequence[Episode] = ()) -> list[list[float]]:
    """Return times, s, that scales must cover: when faults begin and are detected, and when episodes come to a name."""
    times = [time for fault in faults for time in (fault.start_s, fault.detected_at_s) if time is not None]
    times += [one.since_s for one in episodes if one.declares]
    return [[time, time + IN_VIEW] for time in times[:MOST_MARKS]]


def marks(faults: Sequence[FaultResult], episodes: Sequence[Episode]) -> list[dict[str, Any]]:
    """Mark when injected faults were detected and isolated, and episodes that no injected fault explains."""
    found = []
    for fault in faults:
        words = f"{fault.kind} on {fault.channel}"
        for kind, at in (("detected", fault.detected_at_s), ("isolated", fault.isolated_at_s)):
            if at is not None:
                found.append({"x": at, "kind": kind, "text": f"{words}: {kind} at {at:.3f} s"})
    why = ", no injected fault explains it" if faults else ""
    for one in [one for one in episodes if one.declares and not one.injected][:MOST_MARKS]:
        first = one.steps[0]
        found.append(
            {"x": one.start_s, "kind": "declared", "text": f"{first.who} {first.state} at {one.start_s:.3f} s{why}"}
        )
        if one.state == "FAULTY" and one.since_s > one.start_s:
            found.append(
                {"x": one.since_s, "kind": "isolated", "text": f"{one.who} {one.state} at {one.since_s:.3f} s{why}"}
            )
    return found


def marks_hint(summary: Summary) -> str:
    """Say what the marks and shades are."""
    hint = SCORED_HINT if summary.scores.faults else MARKS_HINT
    return f"{hint} {GAPS_HINT}" if summary.story.gaps else hint


def gaps(story: Story) -> list[dict[str, Any]]:
    """Shade what lies between the stretches: nothing is recorded there."""
    return [{"type": "rect", "kind": "gap", "x0": begin, "x1": end} for begin, end in story.gaps]
