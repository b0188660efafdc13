# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A study's result for people: tables, and the page with its curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

from fdi_ros.experiments.montecarlo import Figures, StudyResult
from fdi_ros.replay.outcomes import Estimate
from fdi_ros.report.layout import PALETTE, Section, number, page, text_of

LIMIT = "best possible"
DASHES = ("solid", "dash", "dot")
SIZE = "fault, standard deviations"

Say = Callable[
    [Any], str
]  # words of the figures of a method, or of the limit, in a cell
ByDetector = tuple[str, Mapping[str, Any], Say]
"""A column of a table: its head, the figures of each detector, and their words, or None."""
Curve = tuple[
    Sequence[float], Sequence[Estimate]
]  # x, and for each x a figure with its confidence interval


class Group(NamedTuple):
    """Cells of a section that are on one geometry."""

    #: name of the geometry
    mounting: str
    #: figures of each cell
    cells: Sequence[Figures]
    #: of the section
    settings: Mapping[str, Any]

    @property
    def faults(self) -> list[Figures]:
        """Cells with a fault of some size."""
        return [cell for cell in self.cells if cell["size"]]


Shows = Callable[[Group], list[Section]]  # how the cells of a protocol are shown


def _shown(result: StudyResult, how: Mapping[str, Shows]) -> list[Section]:
    """Parts of all sections in their order, as their protocols show them."""
    parts = []
    for section in result.sections:
        for spec, cells in groupby(
            section.cells, lambda cell: cell.get("geometry", "")
        ):
            if section.kind in how:
                mounting = spec if isinstance(spec, str) else f"{len(spec)} given axes"
                parts += how[section.kind](
                    Group(mounting, list(cells), section.settings)
                )
    return parts


def tables(result: StudyResult) -> list[Section]:
    """Return all tables of a result by section. Detectors of equal figures share a row."""
    return _shown(result, _TABLES)


def headline(result: StudyResult) -> str:
    """Tables as text."""
    return text_of(
        [f"{result.title or result.study}, seed {result.seed}"], tables(result)
    )


def report(result: StudyResult) -> str:
    """Lay out the page: curves with their confidence bands, tables, what did not run, settings."""
    sections = [*_shown(result, _CURVES), *tables(result)]
    for section in result.sections:
        refused = [
            (g, name, why)
            for g, names in section.not_run.items()
            for name, why in names.items()
        ]
        if refused:
            sections.append(
                Section(
                    f"Not run: {section.kind}",
                    "",
                    (("mounting", "detector", "why"), refused),
                )
            )
    settings = [
        (s.kind, name, str(value))
        for s in result.sections
        for name, value in s.settings.items()
    ]
    sections.append(
        Section(
            "Settings",
            f"Seed {result.seed}.",
            (("section", "setting", "value"), settings),
        )
    )
    return page(f"fdi_ros: {result.title or result.study}", [], sections)


def _table(title: str, hint: str, columns: Sequence[ByDetector]) -> Section:
    """Lay out a table with a row for each detector."""
    names = dict.fromkeys(name for _, figures, _ in columns for name in figures)
    rows = [
        (name, *(say(figures.get(name)) for _, figures, say in columns))
        for name in names
    ]
    return _alike_together(
        title, hint, ("detector", *(head for head, _, _ in columns)), rows
    )


def _alike_together(
    title: str, hint: str, head: Sequence[str], rows: Sequence[Sequence[str]]
) -> Section:
    """Lay out a table whose first column has the detectors: those of equal figures share a row."""
    alike: dict[tuple[str, ...], list[str]] = {}
    for name, *words in rows:
        alike.setdefault(tuple(words), []).append(name)
    joined = [(", ".join(names), *words) for words, names in alike.items()]
    return Section(title, hint, (head, joined))


def _of(name: str) -> Say:
    """Words of one share, in percent, or a dash."""

    def say(at: Figures | None) -> str:
        figure = None if at is None else at.get(name)
        if figure is None or math.isnan(figure.value):
            return "-"
        percent = 100 * figure.value
        return (
            f"{percent:.1f}"
            if figure.value >= 0.01 or not percent
            else f"{percent:.2g}"
        )

    return say


def _at(cell: Figures, k: int = 0) -> dict[str, Figures]:
    """Figures by method at one of the false-alarm rates."""
    return {name: at[k] for name, at in cell["methods"].items()}


def _plot(
    title: str,
    curves: Mapping[str, Curve],
    x: str,
    y: str,
    log: str = "",
    limit: tuple[Sequence[float], Sequence[float]] = ((), ()),
) -> Section:
    """Curves with their confidence bands, beside the best possible where it is known: x, y."""
    data: list[dict[str, Any]] = []
    for k, (name, (at, figures)) in enumerate(curves.items()):
        line = {
            "color": PALETTE[k % len(PALETTE)],
            "dash": DASHES[k // len(PALETTE) % len(DASHES)],
            "width": 2,
        }
        common = {"name": name, "x": list(at), "line": line}
        band = {"low": [f.low for f in figures], "high": [f.high for f in figures]}
        data.append({"type": "band", **common, **band, "showlegend": False})
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                **common,
                "y": [f.value for f in figures],
            }
        )
    if limit[1]:
        line = {"color": "#7f7f7f", "dash": "dashdot", "width": 3}
        known = {"x": list(limit[0]), "y": list(limit[1]), "line": line}
        data.append({"type": "scatter", "mode": "lines", "name": LIMIT, **known})
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": x}},
        "yaxis": {"title": {"text": y}},
        "height": 420,
    }
    if log:
        layout[log]["type"] = "log"
    return Section(title, "", "", [{"data": data, "layout": layout}])


def _snapshot(group: Group) -> list[Section]:
    if group.settings["faults"] == 2:
        return [_double(group, cell) for cell in group.faults]
    alarms = group.settings["false_alarms"]
    if len(alarms) > 1:
        return [
            _table(
                _rates_title(group, cell),
                "Percent declared, by false-alarm rate.",
                [
                    (f"{alarm:g}", _at(cell, k), _of("declared"))
                    for k, alarm in enumerate(alarms)
                ],
            )
            for cell in group.faults
        ]
    healthy, *faults = group.cells
    columns: list[ByDetector] = [("healthy", _at(healthy), _of("declared"))]
    right = _of("right")
    declared = _of("declared")
    columns += [
        (f"{cell['size']:g}", _at(cell), lambda at: f"{right(at)} ({declared(at)})")
        for cell in faults
    ]
    hint = "Percent declared with the right channel named first (declared at all), by size in standard deviations."
    found = [_table(f"One fault, {group.mounting}", hint, columns)]
    columns = []
    for cell in faults:
        ranking = {name: at for name, at in _at(cell).items() if "identified" in at}
        columns += (
            [(f"{cell['size']:g}", ranking, _of("identified"))] if ranking else []
        )
    if columns:
        title = f"Largest residual is the right one, {group.mounting}"
        found.append(_table(title, "Percent, alarm or not.", columns))
    return found


def _rates_title(group: Group, cell: Figures) -> str:
    return f"Detection of {cell['size']:g} standard deviations, {group.mounting}"


def _double(group: Group, cell: Figures) -> Section:
    def mean(at: Figures) -> str:
        sizes = at["set_sizes"]
        suspects = sum(k * n for k, n in enumerate(sizes))
        return f"{suspects / max(sum(sizes), 1):.2f}"

    words = {
        "declared": _of("declared"),
        "suspects cover both": _of("covered_when_declared"),
        "pair isolated": _of("isolated_right"),
        "isolated wrongly": _of("isolated_wrong"),
        "suspects, mean": mean,
    }
    title = f"Two faults of {cell['size']:g} standard deviations, {group.mounting}"
    return _table(
        title,
        "Percent; coverage of what was declared.",
        [(head, _at(cell), words[head]) for head in words],
    )


def _snapshot_curves(group: Group) -> list[Section]:
    alarms = group.settings["false_alarms"]
    faults = group.faults
    if group.settings["faults"] != 1:
        return []
    if len(alarms) == 1:
        sizes = [cell["size"] for cell in faults]
        curves = {
            name: (sizes, [_at(cell)[name]["right"] for cell in faults])
            for name in _at(faults[0])
        }
        return [
            _plot(
                f"Right declarations, {group.mounting}",
                curves,
                SIZE,
                "declared, right channel named",
            )
        ]
    found = []
    for cell in faults:
        curves = {
            name: (alarms, [at["declared"] for at in points])
            for name, points in cell["methods"].items()
        }
        found.append(
            _plot(
                _rates_title(group, cell),
                curves,
                "false alarms per sample",
                "declared",
                log="xaxis",
            )
        )
    return found


def _delay(group: Group) -> list[Section]:
    def mean(at: Figures) -> str:
        figure = at["mean_delay"]
        return number(figure.value if isinstance(figure, Estimate) else figure, ".1f")

    asked = group.settings["run_length"]
    hint = f"Mean samples to the alarm at a mean run length of {asked:g} samples, by size in standard deviations."
    columns: list[ByDetector] = []
    for cell in group.cells:
        limit = {LIMIT: {"mean_delay": cell["limit"]["moustakides"]}}
        columns.append((f"{cell['size']:g}", cell["methods"] | limit, mean))
    return [_table(f"Delay, {group.mounting}", hint, columns)]


def _delay_curves(group: Group) -> list[Section]:
    curves = {}
    for name in group.cells[0]["methods"]:
        known = [
            (cell["size"], mean)
            for cell in group.cells
            if (mean := cell["methods"][name]["mean_delay"])
        ]
        if known:
            curves[name] = (
                [size for size, _ in known],
                [figure for _, figure in known],
            )
    limit = (
        [cell["size"] for cell in group.cells],
        [cell["limit"]["moustakides"] for cell in group.cells],
    )
    return [
        _plot(
            f"Delay, {group.mounting}",
            curves,
            SIZE,
            "mean delay, samples",
            "yaxis",
            limit,
        )
    ]


def _flight(group: Group) -> list[Section]:
    def delays(at: Figures) -> str:
        median = at["delay_s"]["p50"]
        late = at["delay_s"]["p90"]
        return "-" if median is None else f"{median:.2f} / {late:.2f}"

    def rms(at: Figures) -> str:
        return number(at["rms_after"], ".4f")

    said: Sequence[tuple[str, str, Say]] = (
        (
            "Declared, and no healthy channel with it",
            "Percent of flights.",
            _of("right"),
        ),
        ("A healthy channel declared", "Percent of flights.", _of("wrong")),
        ("Delay to the declaration", "Median and 90 % quantile, s.", delays),
        ("Error of the fused rate from the onset on", "Root mean square, rad/s.", rms),
    )
    return [
        _table(
            title, hint, [(cell["fault"], cell["methods"], say) for cell in group.cells]
        )
        for title, hint, say in said
    ]


def _search(group: Group) -> list[Section]:
    """Return shares by selection: of the paper's searches, then of all methods by rate."""
    found = []
    settings = group.settings
    for cell in group.cells:
        rows = [
            (name, "tolerance (8)", shares)
            for name, shares in cell["paper_tolerance"].items()
        ]
        for k, alarm in enumerate(settings["false_alarms"]):
            rows += [
                (name, f"{alarm:g}", shares) for name, shares in _at(cell, k).items()
            ]
        words = [word for word in rows[0][2] if word != "false_alarm"] if rows else []
        title = f"Protocol of 2019, {cell['selection'].replace('_', ' ')}"
        ratio = settings["sigma_ratio"]
        hint = f"Percent of {cell['trials']} trials kept of {cell['drawn']}; sigma_0 = {ratio:g} sigma_k max_rate."
        head = (
            "detector",
            "false alarms",
            *(word.replace("_", ", ") for word in words),
        )
        said = [
            (name, alarm, *(_of(word)(shares) for word in words))
            for name, alarm, shares in rows
        ]
        found.append(_alike_together(title, hint, head, said))
    return found


_TABLES: Mapping[str, Shows] = {
    "snapshot": _snapshot,
    "delay": _delay,
    "flight": _flight,
    "residual_search": _search,
}
_CURVES: Mapping[str, Shows] = {"snapshot": _snapshot_curves, "delay": _delay_curves}
