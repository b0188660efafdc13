"""The page of a sweep: first the recording without a fault, then shares and delays against size, then every channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fdi_ros.study.figure_page import PALETTE, Section, html_table, page
from fdi_ros.study.sweep import Tried
from fdi_ros.study.sweep_plan import Plan
from fdi_ros.study.sweep_result import (
    HEAD,
    HINTS,
    SHORT_HINT,
    WANTED,
    Line,
    lines_of,
    rows_of,
    side_by_side,
    sound_lines,
    verdict_lines,
)
from fdi_ros.study.tally import share


def sweep_page(results: Sequence[Tried], plan: Plan, bag: str, about: Mapping[str, str]) -> str:
    """Lay out everything.

    Raises
    ------
    FdiError
        If plotly is not installed.
    """
    tried = [one for one in results if one.trials]
    sections = [
        Section("Without a fault", "What the monitor says of the recording as it is.", _sound_table(results)),
        *(
            [
                Section(
                    "Side by side",
                    f"{SHORT_HINT[0].upper()}{SHORT_HINT[1:]}.",
                    html_table(*side_by_side(results, plan)),
                )
            ]
            if len(tried) > 1
            else []
        ),
        *_curves(tried, plan),
        *(Section(_titled("Every channel", one, results), MAP_HINT, "", [_map(one, plan)]) for one in tried),
        *(
            Section(_titled("Figures", one, results), " ".join(_sentences(HINTS)), html_table(HEAD, rows_of(lines)))
            for one in tried
            for lines in [lines_of(one, plan)]
        ),
        *(Section(_titled("When", one, results), WHEN_HINT, html_table(WHEN_HEAD, _when(one))) for one in tried),
        Section("What was run", "", html_table(("", ""), list(about.items()))),
    ]
    return page(f"fdi_ros: faults found in {bag}", _summary(results, plan), sections)


LEAST_SIZES = 3
"""Of a kind for a curve; the map and the table show fewer as well."""
MAP_HINT = "Percent of the faults in which the channel was named, or was one of a set, by channel and fault."
WHEN_HINT = "Times from which faults were injected, and how fast the vehicle turned while they were watched."
WHEN_HEAD = ("from", "rate, median", "rate, largest")


def _titled(title: str, one: Tried, results: Sequence[Tried]) -> str:
    return f"{title}: {one.name}" if len(results) > 1 else title


def _sentences(lines: Sequence[str]) -> list[str]:
    return [f"{line[0].upper()}{line[1:]}." for line in lines]


def _summary(results: Sequence[Tried], plan: Plan) -> list[str]:
    lines = []
    for one in results:
        before = f"{one.name}: " if len(results) > 1 else ""
        lines += [f"{before}without a fault: {line}." for line in sound_lines(one)[:1]]
        lines += [f"{before}{line}." for line in verdict_lines(one, plan)]
    return [
        *lines,
        f"Counted as found: {WANTED:.0%} of the faults of a size, and of all larger ones, in {plan.within:g} s.",
    ]


def _sound_table(results: Sequence[Tried]) -> str:
    rows = [
        (one.name, one.config.detector.name, f"{line[0].upper()}{line[1:]}.")
        for one in results
        for line in sound_lines(one)
    ]
    return html_table(("monitor", "detector", "what it says"), rows)


def _curves(tried: Sequence[Tried], plan: Plan) -> list[Section]:
    """Draw shares and delays of each kind that has several sizes."""
    families: dict[str, int] = {}
    for swept in plan.faults:
        families[swept.family] = families.get(swept.family, 0) + 1
    sections = []
    for family in [name for name, sizes in families.items() if sizes >= LEAST_SIZES and tried]:
        own = [[line for line in lines_of(one, plan) if line.swept.family == family] for one in tried]
        names = [one.name for one in tried]
        hint = "Solid: named; dotted: named or in a set. Bars: 95 % interval of the share (Wilson)."
        sections.append(Section(f"{family}: share found", hint, "", [_shares(names, own)]))
        if any(np.isfinite(line.found_after[0]) for lines in own for line in lines):
            hint = "Until it was found; solid: half of all faults were, dotted: 95 %. No point: fewer were."
            sections.append(Section(f"{family}: delay", hint, "", [_delays(names, own)]))
    return sections


def _shares(names: Sequence[str], lines: Sequence[Sequence[Line]]) -> dict[str, Any]:
    data = []
    for k, (name, own) in enumerate(zip(names, lines, strict=True)):
        for words, dash, counts in (
            ("named", "solid", [line.counts["named"] for line in own]),
            ("found", "dot", [line.found for line in own]),
        ):
            found = [share(count, line.trials) for count, line in zip(counts, own, strict=True)]
            trace = _trace(k, _legend(names, name, words), dash, own, [100 * one["value"] for one in found])
            trace["error_y"] = {
                "type": "data",
                "symmetric": False,
                "array": [round(100 * (one["high"] - one["value"]), 2) for one in found],
                "arrayminus": [round(100 * (one["value"] - one["low"]), 2) for one in found],
                "thickness": 1,
            }
            data.append(trace)
    return {"data": data, "layout": _layout(lines, {"title": {"text": "%"}, "range": [-3, 103]})}


def _delays(names: Sequence[str], lines: Sequence[Sequence[Line]]) -> dict[str, Any]:
    data = []
    for k, (name, own) in enumerate(zip(names, lines, strict=True)):
        for place, words, dash in ((0, "median", "solid"), (1, "95 %", "dot")):
            values = [line.found_after[place] for line in own]
            data.append(_trace(k, _legend(names, name, words), dash, own, values))
    return {"data": data, "layout": _layout(lines, {"title": {"text": "s"}, "rangemode": "tozero"})}


def _legend(names: Sequence[str], name: str, words: str) -> str:
    return f"{name}, {words}" if len(names) > 1 else words


def _trace(k: int, name: str, dash: str, lines: Sequence[Line], values: Sequence[float]) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": name,
        "x": [f"{line.swept.size:g}" for line in lines],
        "y": [round(value, 4) if np.isfinite(value) else None for value in values],
        "line": {"color": PALETTE[k % len(PALETTE)], "dash": dash},
    }


def _layout(lines: Sequence[Sequence[Line]], yaxis: dict[str, Any]) -> dict[str, Any]:
    swept = lines[0][0].swept
    title = f"size, {swept.unit}" if swept.unit else "size"
    legend = {"orientation": "h", "y": 1.12}
    return {"xaxis": {"type": "category", "title": {"text": title}}, "yaxis": yaxis, "legend": legend, "height": 360}


def _map(one: Tried, plan: Plan) -> dict[str, Any]:
    """Share found by channel and fault."""
    rows = [lines_of(one, plan, channel) for channel in one.used]
    found = [[round(100 * line.found / line.trials) for line in lines] for lines in rows]
    heat = {
        "type": "heatmap",
        "z": found,
        "x": [line.swept.words for line in rows[0]],
        "y": [one.channels[channel] for channel in one.used],
        "zmin": 0,
        "zmax": 100,
        "colorscale": "Cividis",
        "text": found,
        "texttemplate": "%{text}",
        "xgap": 1,
        "ygap": 1,
        "hovertemplate": "%{y}, %{x}: found in %{z} %<extra></extra>",
    }
    axes = {"xaxis": {"tickangle": -60, "automargin": True}, "yaxis": {"autorange": "reversed", "automargin": True}}
    return {"data": [heat], "layout": {**axes, "height": 200 + 28 * len(rows)}}


def _when(one: Tried) -> list[tuple[str, ...]]:
    assert one.sound is not None
    return [
        (f"{at:.1f} s", *(f"{value:.3g} rad/s" if np.isfinite(value) else "-" for value in speeds))
        for at, speeds in zip(one.times, one.speeds, strict=True)
    ]
