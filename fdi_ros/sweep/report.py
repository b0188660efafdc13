# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The page of a sweep: first the recording as it is, then shares and delays against size, then every channel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fdi_ros.report.page import PALETTE, Section, html_pairs, html_table, page
from fdi_ros.scoring.outcome import Outcome
from fdi_ros.scoring.tally import share
from fdi_ros.sweep.plan import Plan
from fdi_ros.sweep.result import Line, lines_of
from fdi_ros.sweep.sweep import MonitorResult
from fdi_ros.sweep.text import (
    HEAD,
    HINTS,
    SHORT_HINT,
    rows_of,
    side_by_side,
    smallest_hint,
    sound_lines,
    verdict_lines,
)


def sweep_page(results: Sequence[MonitorResult], plan: Plan, bag: str, about: Mapping[str, str]) -> str:
    """Lay out everything."""
    tried = [one for one in results if one.trials]
    sections = [
        Section("Nothing injected", "What the monitor says of the recording as it is.", _sound_table(results)),
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
        *(replace(_map(one, plan), title=_titled("Every channel", one, results)) for one in tried),
        *(
            Section(_titled("Figures", one, results), " ".join(_sentences(HINTS)), html_table(HEAD, rows_of(lines)))
            for one in tried
            for lines in [lines_of(one, plan)]
        ),
        *(Section(_titled("When", one, results), WHEN_HINT, html_table(WHEN_HEAD, _when(one))) for one in tried),
        Section("What was run", "", html_pairs(about.items())),
    ]
    return page(f"fdi_ros: faults detected in {bag}", _summary(results, plan), sections)


LEAST_SIZES = 3
"""Of a kind for a curve; the map and the table show fewer as well."""
MAP_HINT = "Share of the faults that were detected, by channel and fault: isolated, or one of a set."
WHEN_HINT = "Times from which faults were injected, and how fast the vehicle turned while they were watched."
WHEN_HEAD = ("from", "rate, median", "rate, largest")


def _titled(title: str, one: MonitorResult, results: Sequence[MonitorResult]) -> str:
    return f"{title}: {one.name}" if len(results) > 1 else title


def _sentences(lines: Sequence[str]) -> list[str]:
    return [f"{line[0].upper()}{line[1:]}." for line in lines]


def _summary(results: Sequence[MonitorResult], plan: Plan) -> list[str]:
    lines = []
    for one in results:
        before = f"{one.name}: " if len(results) > 1 else ""
        lines += [f"{before}nothing injected: {line}." for line in sound_lines(one)[:1]]
        verdict = verdict_lines(one, plan)
        # Of several, the table side by side says the rest.
        lines += [f"{before}{line}." for line in (verdict if len(results) == 1 else [*verdict[:1], *verdict[-2:]])]
    hint = smallest_hint(plan)
    return [*lines[:1], f"{hint[0].upper()}{hint[1:]}:", *lines[1:]]


def _sound_table(results: Sequence[MonitorResult]) -> str:
    rows = [
        (one.name, one.config.detector.name, f"{line[0].upper()}{line[1:]}.")
        for one in results
        for line in sound_lines(one)
    ]
    return html_table(("monitor", "detector", "what it says"), rows)


def _curves(tried: Sequence[MonitorResult], plan: Plan) -> list[Section]:
    """Draw shares and delays of each kind that has several sizes."""
    families: dict[str, int] = {}
    for swept in plan.faults:
        families[swept.family] = families.get(swept.family, 0) + 1
    sections = []
    for family in [name for name, sizes in families.items() if sizes >= LEAST_SIZES and tried]:
        own = [[line for line in lines_of(one, plan) if line.swept.family == family] for one in tried]
        names = [one.name for one in tried]
        hint = "Solid: isolated; dashed: detected; dotted: 95 % interval of the share isolated (Wilson 1927)."
        sections.append(Section(f"{family}: share detected", hint, "", [_shares(names, own)]))
        if any(np.isfinite(line.found_after[0]) for lines in own for line in lines):
            hint = "Until it was detected; solid: half of all faults were, dashed: 95 %. No point: fewer were."
            sections.append(Section(f"{family}: delay", hint, "", [_delays(names, own)]))
    return sections


def _shares(names: Sequence[str], lines: Sequence[Sequence[Line]]) -> dict[str, Any]:
    data = []
    for k, own in enumerate(lines):
        named = [share(line.counts[Outcome.ISOLATED], line.trials) for line in own]
        found = [share(line.found, line.trials) for line in own]
        data.append(_trace(k, names, "isolated", "solid", own, [100 * one.value for one in named]))
        data.append(_trace(k, names, "detected", "dash", own, [100 * one.value for one in found]))
        if len(lines) == 1:
            data += [
                {**_trace(k, names, f"95 %, {name}", "dot", own, ends), "mode": "lines"}
                for name, ends in (
                    ("low", [100 * one.low for one in named]),
                    ("high", [100 * one.high for one in named]),
                )
            ]
    return {"data": data, "layout": _layout(lines, {"title": {"text": "share of the faults, %"}, "range": [-3, 103]})}


def _delays(names: Sequence[str], lines: Sequence[Sequence[Line]]) -> dict[str, Any]:
    data = []
    for k, own in enumerate(lines):
        for place, words, dash in ((0, "median", "solid"), (1, "95 %", "dash")):
            values = [line.found_after[place] for line in own]
            data.append(_trace(k, names, words, dash, own, values))
    return {"data": data, "layout": _layout(lines, {"title": {"text": "delay, s"}, "type": "log"})}


def _trace(
    k: int, names: Sequence[str], words: str, dash: str, lines: Sequence[Line], values: Sequence[float]
) -> dict[str, Any]:
    alone = len(names) == 1
    return {
        "type": "scatter",
        "mode": "lines+markers",
        "name": words if alone else names[k],
        "x": [line.swept.size for line in lines],
        "y": [round(value, 4) if np.isfinite(value) else None for value in values],
        "line": {"color": PALETTE[k % len(PALETTE)], "dash": dash},
        "showlegend": alone or dash == "solid",
    }


def _layout(lines: Sequence[Sequence[Line]], yaxis: dict[str, Any]) -> dict[str, Any]:
    swept = lines[0][0].swept
    title = f"size, {swept.unit}" if swept.unit else "size"
    legend = {"orientation": "h", "y": 1.12}
    return {"xaxis": {"type": "log", "title": {"text": title}}, "yaxis": yaxis, "legend": legend, "height": 360}


def _map(one: MonitorResult, plan: Plan) -> Section:
    """Share found by channel and fault, as shades and figures."""
    rows = [lines_of(one, plan, channel) for channel in one.used]
    found = [[round(line.found / line.trials, 2) for line in lines] for lines in rows]
    names, words = [one.channels[channel] for channel in one.used], [line.swept.words for line in rows[0]]
    heat = {"type": "heatmap", "z": found, "x": words, "y": names, "zmin": 0, "zmax": 1, "colorscale": "Cividis"}
    shown = {"text": found, "texttemplate": "%{text}", "xgap": 1, "ygap": 1}
    axes = {"xaxis": {"tickangle": -60, "automargin": True}, "yaxis": {"autorange": "reversed", "automargin": True}}
    figure = {"data": [{**heat, **shown}], "layout": {**axes, "height": 200 + 28 * len(rows)}}
    cells = [(name, *(f"{value:.0%}" for value in values)) for name, values in zip(names, found, strict=True)]
    return Section("", MAP_HINT, html_table(("channel", *words), cells), [figure])


def _when(one: MonitorResult) -> list[tuple[str, ...]]:
    assert one.sound is not None
    return [
        (f"{at:.1f} s", *(f"{value:.3g} rad/s" if np.isfinite(value) else "-" for value in speeds))
        for at, speeds in zip(one.times, one.speeds, strict=True)
    ]
