"""A report to be looked at: one HTML file that needs nothing else, no network, no other file."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from html import escape
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.output import ChannelState
from fdi_ros.errors import FdiError
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Output
from fdi_ros.study.envelope import Envelope
from fdi_ros.study.report_tables import about_table, event_table, fault_table
from fdi_ros.study.verdict import notes, verdict

Array = NDArray[np.float64]

SPANS = 350_000
"""Spans of all series together: the file stays below 10 MB, plotly.js with its 4.8 MB included."""
MOST_CHANGES = 2000
"""Changes of state in the timeline at most."""
SEES_AXIS = 0.3
"""Share of a body axis in a channel's own axis from which on the channel's reading of it is shown."""
_AXES = "xyz"


class Report:
    """Collects what the monitor says, in bounded memory, and lays it out.

    A channel's reading of a body axis is the fused rate, moved along the channel's own axis until the channel agrees.

    Parameters
    ----------
    geometry
        Of the monitor.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.names = geometry.channel_names
        norm = np.linalg.norm(geometry.axes, axis=1)
        sees = np.abs(geometry.axes) >= SEES_AXIS * norm[:, None]
        self._channel, self._axis = (index.tolist() for index in np.nonzero(sees))
        self._gain = geometry.axes[sees] / norm[self._channel] ** 2
        self._series = [
            *("statistic", "threshold"),
            *(f"{what}.{axis}" for what in ("rate", "upper", "lower") for axis in _AXES),
            *(f"reading.{_AXES[a]}.{i}" for i, a in zip(self._channel, self._axis, strict=True)),
            *(f"residual.{i}" for i in range(geometry.n)),
        ]
        self._envelope = Envelope(len(self._series), SPANS // len(self._series))
        self._first_states: list[str] = []

    def add(self, time: Array, output: Output) -> None:
        """Take in the next samples; time (N,) s from the first one."""
        if not self._first_states and len(output):
            self._first_states = [ChannelState(state).name for state in output.state[0].tolist()]
        rate, deviation = output.rate, np.sqrt(np.diagonal(output.covariance, axis1=1, axis2=2))
        reading = rate[:, self._axis] + self._gain * output.residual[:, self._channel]
        columns = [output.statistic, output.threshold, rate, rate + 2 * deviation, rate - 2 * deviation]
        self._envelope.add(time, np.column_stack([*columns, reading, output.residual]))

    def html(self, summary: Mapping[str, Any], about: Mapping[str, str]) -> str:
        """Lay out the page.

        Parameters
        ----------
        summary
            Of the replay.
        about
            What was run: shown as a table.

        Raises
        ------
        FdiError
            If plotly is not installed.
        """
        parts = {
            "TITLE": escape(f"fdi_ros: {summary['bag']}"),
            "VERDICT": "".join(f"<li>{escape(line)}</li>" for line in verdict(summary)),
            "NOTES": "".join(f"<li>{escape(line)}</li>" for line in notes(summary)) or "<li>None.</li>",
            "ABOUT": about_table(about),
            "FAULTS": fault_table(summary["faults"]),
            "EVENTS": event_table(summary["events"]),
            "STYLE": _resource("report.css"),
            "DATA": _safe_json(self._data(summary)),
            "PLOTLY": plotly_script(),
            "SCRIPT": _resource("report.js"),
        }
        # In one pass: what is put in is not searched for places.
        return re.sub("<!--([A-Z]+)-->", lambda place: parts[place[1]], _resource("report.html"))

    def _data(self, summary: Mapping[str, Any]) -> dict[str, Any]:
        time, low, high = self._envelope.spans()
        decimated = self._envelope.width > 1
        series = {}
        for k, name in enumerate(self._series):
            columns = [low[:, k], high[:, k]] if decimated else [low[:, k]]
            series[name] = _packed(np.column_stack(columns), "<f4")
        events = [event for event in summary["events"] if event["before"] != event["state"]]
        return {
            "names": list(self.names),
            "time": _packed(time, "<f8"),
            "end": float(summary["start_s"] + summary["duration_s"]),
            "start": float(summary["start_s"]),
            "decimated": decimated,
            "width": self._envelope.width,
            "series": series,
            "firstStates": self._first_states,
            "events": events[:MOST_CHANGES],
            "dropped": max(0, len(events) - MOST_CHANGES),
            "faults": summary["faults"],
        }


def plotly_script() -> str:
    """Return plotly.js, whole.

    Raises
    ------
    FdiError
        If plotly is not installed.
    """
    try:
        from plotly.offline import get_plotlyjs
    except ImportError as error:
        raise FdiError("a report needs plotly: pip install 'fdi_ros[report]'") from error
    return str(get_plotlyjs())


def _packed(values: Array, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode("ascii")


def _safe_json(data: Any) -> str:
    # Within a script element the only thing that could end it is a tag.
    return json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")


def _resource(name: str) -> str:
    return resources.files("fdi_ros.study").joinpath(name).read_text(encoding="utf-8")
