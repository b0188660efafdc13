"""The page of a comparison: all detectors on one recording, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.output import ChannelState
from fdi_ros.monitor.output import Output
from fdi_ros.replay.report_tables import comparison_table, found_table
from fdi_ros.replay.timeline import MARKS_HINT, MOST_MARKS, marks, shades, timeline
from fdi_ros.report.page import CHANNEL_COLOURS, Section, html_pairs, html_table, page, time_layout
from fdi_ros.report.store import SMALL, PageStore

Array = NDArray[np.float64]

_WORST_FIRST = ("FAULTY", "AMBIGUOUS", "STALE", "SUSPECT", "UNCHECKED", "EXCLUDED", "OK")


class Comparison:
    """Collects what monitors with different detectors say of the same samples, and lays it out."""

    def __init__(self) -> None:
        self.names: list[str] = []
        """Detectors that run, in their order."""
        self._store: PageStore | None = None
        self._waiting: dict[str, Array] = {}
        self._first: dict[str, list[str]] = {}

    def add(self, detector: str, time: Array, output: Output) -> None:
        """Take in the next samples from one detector; time (N,) s; every detector gets the same samples in turn."""
        if not len(output):
            return
        if detector not in self._first:
            self._first[detector] = [ChannelState(state).name for state in output.state[0].tolist()]
        with np.errstate(invalid="ignore", divide="ignore"):
            self._waiting[detector] = output.statistic / output.threshold
        if len(self._waiting) == len(self.names):
            if self._store is None:
                self._store = PageStore(dict.fromkeys(self.names, SMALL))
            self._store.add(time, [self._waiting[name] for name in self.names])
            self._waiting = {}

    def html(self, bag: str, summaries: Sequence[Mapping[str, Any]], about: Mapping[str, str]) -> str:
        """Lay out the page.

        Parameters
        ----------
        bag
            What was replayed.
        summaries
            Of each detector; of one that cannot run: its name and the reason under ``refused``.
        about
            What was run: shown as a table.
        """
        ran = [summary for summary in summaries if "refused" not in summary]
        refused = [(s["detector"], s["refused"]) for s in summaries if "refused" in s]
        false = [
            (s["detector"], f"{d['at_s']:.3f} s", d["channel"], d["state"], d["reason"], ", ".join(d["group"]))
            for s in ran
            for d in s["declared"][:MOST_MARKS]
        ]
        sections = [
            Section("Figures", "", comparison_table(ran)),
            *([Section("Faults, by detector", "", found_table(ran))] if ran[0]["faults"] else []),
            Section("Declared, by detector", f"Worst state of all channels. {MARKS_HINT}", "", [self._states(ran)]),
            Section("Statistic over threshold, by detector", "Alarm above 1.", "", self._ratios(ran)),
            Section(
                "Declarations that no injected fault explains",
                "",
                html_table(("detector", "at", "channel", "state", "reason", "one of"), false)
                if false
                else "<p>None.</p>",
            ),
            *([Section("Cannot run here", "", html_table(("detector", "why"), refused))] if refused else []),
            Section("What was run", "", html_pairs(about.items())),
        ]  # fmt: skip
        return page(f"fdi_ros: detectors on {bag}", _gist(ran), sections, self._store)

    def _states(self, ran: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        events = [event for summary in ran for event in _worst(summary, self._first.get(summary["detector"], []))]
        first = [_worst_of(self._first[s["detector"]]) for s in ran] if self._first else []
        drawn = timeline([s["detector"] for s in ran], first, {**ran[0], "events": events})
        found = [{**mark, "row": row} for row, summary in enumerate(ran) for mark in marks(summary)]
        drawn["layout"] |= {"shapes": shades(ran[0]["faults"]), "marks": found}
        return drawn

    def _ratios(self, ran: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        one = {"type": "line", "y0": 1.0, "line": {"dash": "dash"}}
        figures = []
        for k, summary in enumerate(ran if self._store else []):
            name = summary["detector"]
            line = {"color": CHANNEL_COLOURS[k % len(CHANNEL_COLOURS)], "width": 1.2}
            curve = {"type": "scatter", "packed": name, "name": name, "line": line, "showlegend": False}
            shapes = [*shades(summary["faults"]), one]
            layout = time_layout(
                112, k == len(ran) - 1, yaxis={"type": "log"}, title=name, shapes=shapes, marks=marks(summary)
            )
            figures.append({"data": [curve], "layout": layout})
        return figures


def _worst(summary: Mapping[str, Any], first: Sequence[str]) -> list[dict[str, Any]]:
    """Return changes of the worst state of all channels, as events of the detector."""
    names = [channel["name"] for channel in summary["channels"]]
    state = dict(zip(names, first, strict=False))
    worst, found = _worst_of(list(state.values())), []
    for event in summary["events"]:
        state[event["channel"]] = event["state"]
        now = _worst_of(list(state.values()))
        if now != worst:
            common = {"channel": summary["detector"], "at_s": event["at_s"], "reason": event["channel"]}
            found.append({**common, "before": worst, "state": now})
            worst = now
    return found


def _worst_of(states: Sequence[str]) -> str:
    return next((state for state in _WORST_FIRST if state in states), "UNCHECKED")


def _gist(ran: Sequence[Mapping[str, Any]]) -> list[str]:
    quiet = [s["detector"] for s in ran if not s["declared"]]
    lines = [f"No false declaration: {', '.join(quiet) or 'no detector'}."]
    if ran and ran[0]["faults"]:
        every = [s["detector"] for s in ran if all(fault["isolated"] for fault in s["faults"])]
        count = len(ran[0]["faults"])
        what = "The fault" if count == 1 else f"All {count} faults"
        lines.insert(0, f"{what} isolated by: {', '.join(every) or 'no detector'}.")
    return lines
