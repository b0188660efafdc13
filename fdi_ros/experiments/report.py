# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A study's result for people: tables for terminal, page and documents; advice; and the page with its curves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any, NamedTuple

from fdi_ros.experiments.montecarlo import StudyResult
from fdi_ros.experiments.protocols.flight import NONE
from fdi_ros.experiments.study import Figures, geometry_words
from fdi_ros.replay.outcomes import Estimate
from fdi_ros.report.layout import PALETTE, Section, number, page, table

LIMIT = "best possible, approximate"
"""For one sample it is integrated to 0.05 %, for the protocol of 2019 approximated. In both a method's figure has the
errors of its trials and of its threshold, and may come out above."""
DASHES = ("solid", "dash", "dot")
ALIKE_HINT = "Curves within each other's confidence bands are drawn once; the tables have the figures of each."
GOOD = 0.9
"""Share of faults declared with the right name from which on a size counts as found."""

Curve = tuple[Sequence[float], Sequence[Estimate]]
"""x, and for each x a figure with its confidence interval."""


class Table(NamedTuple):
    """One table of words."""

    title: str
    hint: str
    head: Sequence[str]
    rows: Sequence[tuple[str, ...]]


class Group(NamedTuple):
    """Cells of a section that are on one geometry."""

    spec: Any
    """As in the file of the study; None: the section has but one."""
    cells: Sequence[Figures]
    settings: Mapping[str, Any]
    """Of the section."""

    @property
    def mounting(self) -> str:
        """Name of the geometry."""
        return geometry_words(self.spec)

    @property
    def faults(self) -> list[Figures]:
        """Cells with a fault of some size."""
        return [cell for cell in self.cells if cell["size"]]


def _groups(result: StudyResult) -> Iterator[tuple[_View, Group]]:
    """Yield the groups of all sections in their order, and how each is shown."""
    for section in result.sections:
        for spec, cells in groupby(section.cells, lambda cell: cell.get("geometry")):
            yield _VIEWS[section.kind], Group(spec, list(cells), section.settings)


def tables(result: StudyResult) -> list[Table]:
    """All tables of a result, in the order of its sections; detectors of equal figures share a row."""
    return [_shared(one) for view, group in _groups(result) for one in view.tables(group)]


def headline(result: StudyResult) -> str:
    """Tables as text."""
    lines = [f"{result.title or result.study}, seed {result.seed}"]
    for one in tables(result):
        lines += ["", one.title, *([one.hint] if one.hint else []), *table(one.head, one.rows)]
    return "\n".join(lines)


def markdown(one: Table) -> list[str]:
    """Lines of a table in Markdown."""
    rows = ["| " + " | ".join(row) + " |" for row in (one.head, ("---",) * len(one.head), *one.rows)]
    return [f"**{one.title}**" + (f" {one.hint}" if one.hint else ""), "", *rows]


def advice(result: StudyResult) -> list[str]:
    """Which detector on which mounting, and what it will miss, in sentences."""
    return [line for view, group in _groups(result) for line in view.advice(group)]


def report(result: StudyResult) -> str:
    """Lay out the page: what to use and what it misses, curves with their confidence bands, tables."""
    sections = [drawn for view, group in _groups(result) for drawn in view.figures(group)]
    sections += [Section(one.title, one.hint, (one.head, one.rows)) for one in tables(result)]
    for section in result.sections:
        refused = [(g, name, why) for g, names in section.not_run.items() for name, why in names.items()]
        if refused:
            rows = (("mounting", "detector", "why"), refused)
            sections.append(Section(f"Not run: {section.kind}", "", rows))
    settings = [(s.kind, name, str(value)) for s in result.sections for name, value in s.settings.items()]
    sections.append(Section("Settings", f"Seed {result.seed}.", (("section", "setting", "value"), settings)))
    return page(f"fdi_ros: {result.title or result.study}", advice(result), sections)


# One sample


def _snapshot_tables(group: Group) -> list[Table]:
    if group.settings["faults"] == 2:
        return [_double_table(group, cell) for cell in group.faults]
    if len(group.settings["false_alarms"]) > 1:
        return [_roc_table(group, cell) for cell in group.faults]
    faults, sizes = group.faults, _sizes(group.faults)
    rows = _rows(group.cells, lambda at: _percent(at[0]["declared"]), lambda at: _both(at[0], _percent))
    best = [cell["limit"][0] for cell in faults if cell["limit"]]
    if best:
        shown = (_both(one, lambda figure: f"{100 * figure:.1f}") for one in best)
        rows.append((LIMIT, f"{100 * best[0]['false_alarm']:.2g}", *shown))
    hint = "Percent declared with the right channel named first (declared at all), by size in standard deviations."
    found = [Table(f"One fault, {group.mounting}", hint, ("detector", "healthy", *sizes), rows)]
    ranking = [name for name, at in faults[0]["methods"].items() if at[0].get("identified")]
    if ranking:
        rows = [row for row in _rows(faults, lambda at: _percent(at[0].get("identified"))) if row[0] in ranking]
        title = f"Largest residual is the right one, {group.mounting}"
        found.append(Table(title, "Percent, alarm or not.", ("detector", *sizes), rows))
    return found


def _both(at: Figures, say: Callable[[Any], str]) -> str:
    return f"{say(at['right'])} ({say(at['declared'])})"


def _roc_table(group: Group, cell: Figures) -> Table:
    rows = [(name, *(_percent(at["declared"]) for at in points)) for name, points in cell["methods"].items()]
    if cell["limit"]:
        rows.append((LIMIT, *(f"{100 * point['declared']:.1f}" for point in cell["limit"])))
    head = ("detector", *(f"{alarm:g}" for alarm in group.settings["false_alarms"]))
    return Table(_roc_title(group, cell), "Percent declared, by false-alarm rate.", head, rows)


def _roc_title(group: Group, cell: Figures) -> str:
    return f"Detection of {cell['size']:g} standard deviations, {group.mounting}"


def _double_table(group: Group, cell: Figures) -> Table:
    head = ("detector", "declared", "suspects cover both", "pair isolated", "isolated wrongly", "suspects, mean")
    rows = []
    for name, (at,) in cell["methods"].items():
        mean = sum(k * count for k, count in enumerate(at["set_sizes"])) / max(sum(at["set_sizes"]), 1)
        shares = (at["declared"], at["covered_when_declared"], at["isolated_right"], at["isolated_wrong"])
        rows.append((name, *map(_percent, shares), f"{mean:.2f}"))
    title = f"Two faults of {cell['size']:g} standard deviations, {group.mounting}"
    return Table(title, "Percent; coverage of what was declared.", head, rows)


def _snapshot_advice(group: Group) -> list[str]:
    if group.settings["faults"] != 1:
        return []
    faults = group.faults
    middle = faults[len(faults) // 2]
    right = {name: at[0]["right"] for name, at in middle["methods"].items()}
    top = max(right, key=lambda name: right[name].value)
    among_best = [name for name, figure in right.items() if figure.high >= right[top].low]
    words = f"{group.mounting}, one sample: best at {middle['size']:g} standard deviations: {', '.join(among_best)}"
    words += f" ({_percent(right[top])} % declared and rightly named"
    words += f" of about {100 * middle['limit'][0]['right']:.1f} % possible)" if middle["limit"] else ")"
    found = [cell["size"] for cell in faults if cell["methods"][top][0]["right"].value >= GOOD]
    if found:
        return [f"{words}; it misses more than {1 - GOOD:.0%} of faults below {min(found):g} standard deviations."]
    return [f"{words}; it misses more than {1 - GOOD:.0%} of all sizes tried."]


def _snapshot_figures(group: Group) -> list[Section]:
    if group.settings["faults"] != 1:
        return []
    if len(group.settings["false_alarms"]) > 1:
        return [_roc(group, cell) for cell in group.faults]
    faults = group.faults
    sizes = [cell["size"] for cell in faults]
    curves = {
        name: (sizes, [cell["methods"][name][0]["right"] for cell in faults]) for name in group.cells[0]["methods"]
    }
    limit = (sizes, [cell["limit"][0]["right"] for cell in faults if cell["limit"]])
    title = f"Right declarations, {group.mounting}"
    return [_plot(title, curves, limit, "fault, standard deviations", "declared, right channel named")]


def _roc(group: Group, cell: Figures) -> Section:
    def declared(points: Sequence[Figures]) -> tuple[list[float], list[Any]]:
        return [at["false_alarm"] for at in points], [at["declared"] for at in points]

    curves = {name: declared(points) for name, points in cell["methods"].items()}
    limit = declared(cell["limit"] or ())
    return _plot(_roc_title(group, cell), curves, limit, "false alarms per sample", "declared", log="xaxis")


# Streams


def _delay_tables(group: Group) -> list[Table]:
    run_length, cells = group.settings["run_length"], group.cells
    hint = f"Mean samples to the alarm at a mean run length of {run_length:g} samples, by size in standard deviations."
    rows = _rows(cells, lambda at: "-" if at["mean_delay"] is None else f"{at['mean_delay'].value:.1f}")
    rows.append((LIMIT, *(f"{cell['limit']['moustakides']:.1f}" for cell in cells)))
    return [Table(f"Delay, {group.mounting}", hint, ("detector", *_sizes(cells)), rows)]


def _delay_advice(group: Group) -> list[str]:
    words = []
    for cell in group.cells:
        known = {name: at["mean_delay"].value for name, at in cell["methods"].items() if at["mean_delay"]}
        if known:
            top, possible = min(known, key=lambda name: known[name]), cell["limit"]["moustakides"]
            words.append(f"{cell['size']:g}: {top} ({known[top]:.1f}, possible about {possible:.1f})")
    return [f"{group.mounting}, soonest alarm in samples by size: {'; '.join(words)}."]


def _delay_figures(group: Group) -> list[Section]:
    cells, curves = group.cells, {}
    for name in cells[0]["methods"]:
        known = [(cell["size"], mean) for cell in cells if (mean := cell["methods"][name]["mean_delay"])]
        if known:
            curves[name] = ([size for size, _ in known], [figure for _, figure in known])
    limit = ([cell["size"] for cell in cells], [cell["limit"]["moustakides"] for cell in cells])
    title = f"Delay, {group.mounting}"
    return [_plot(title, curves, limit, "fault, standard deviations", "mean delay, samples", log="yaxis")]


# Flights


def _flight_tables(group: Group) -> list[Table]:
    head = ("detector", *(cell["fault"] for cell in group.cells))

    def delays(at: Figures) -> str:
        median, late = at["delay_s"]["p50"], at["delay_s"]["p90"]
        return "-" if median is None else f"{median:.2f} / {late:.2f}"

    said: Sequence[tuple[str, str, Callable[[Figures], str]]] = (
        ("Declared, and no healthy channel with it", "Percent of flights.", lambda at: _percent(at["right"])),
        ("A healthy channel declared", "Percent of flights.", lambda at: _percent(at["wrong"])),
        ("Delay to the declaration", "Median and 90 % quantile, s.", delays),
        (
            "Error of the fused rate from the onset on",
            "Root mean square, rad/s.",
            lambda at: number(at["rms_after"], ".4f"),
        ),
    )
    return [Table(title, hint, head, _rows(group.cells, words)) for title, hint, words in said]


def _flight_advice(group: Group) -> list[str]:
    cells = group.cells
    faults = [cell for cell in cells if cell["fault"] != NONE]
    healthy = [cell for cell in cells if cell["fault"] == NONE]
    lines = []
    for name in cells[0]["methods"]:
        missed = [cell["fault"] for cell in faults if cell["methods"][name]["right"].value < GOOD]
        wrong = f"; {_percent(healthy[0]['methods'][name]['wrong'])} % of healthy flights blamed" if healthy else ""
        lines.append(f"{name} misses or misnames more than {1 - GOOD:.0%} of: {', '.join(missed) or 'nothing'}{wrong}.")
    return lines


# The protocol of 2019


def _search_tables(group: Group) -> list[Table]:
    ratio, found = group.settings["sigma_ratio"], []
    for cell in group.cells:
        outcomes = tuple(next(iter(cell["paper_tolerance"].values())))
        head = ("detector", "false alarms", *(name.replace("_", ", ") for name in outcomes))
        hint = f"Percent of {cell['trials']} trials kept of {cell['drawn']}; sigma_0 = {ratio:g} sigma_k max_rate."
        rows = _search_rows(cell, group.settings["false_alarms"])
        found.append(Table(f"Protocol of 2019, {cell['selection'].replace('_', ' ')}", hint, head, rows))
    return found


def _search_rows(cell: Figures, alarms: Sequence[float]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, shares in cell["paper_tolerance"].items():
        rows.append((name, "tolerance (8)", *map(_percent, shares.values())))
    for k, alarm in enumerate(alarms):
        for name, points in cell["methods"].items():
            shares = [figure for word, figure in points[k].items() if word != "false_alarm"]
            rows.append((name, f"{alarm:g}", *map(_percent, shares)))
        if cell["limit"]:
            best = cell["limit"][k]
            wrong = f"{100 * (best['declared'] - best['right']):.1f}"
            rows.append((LIMIT, f"{alarm:g}", f"{100 * best['right']:.1f}", "", wrong, ""))
    return rows


class _View(NamedTuple):
    """How the sections of one protocol are shown."""

    tables: Callable[[Group], list[Table]]
    advice: Callable[[Group], list[str]] = lambda group: []
    figures: Callable[[Group], list[Section]] = lambda group: []


_VIEWS: Mapping[str, _View] = {
    "snapshot": _View(_snapshot_tables, _snapshot_advice, _snapshot_figures),
    "delay": _View(_delay_tables, _delay_advice, _delay_figures),
    "flight": _View(_flight_tables, _flight_advice),
    "residual_search": _View(_search_tables),
}


# What they share


def _shared(one: Table) -> Table:
    """Put detectors of equal figures into one row."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, *figures in one.rows:
        names.setdefault(tuple(figures), []).append(name)
    return one._replace(rows=[(", ".join(found), *figures) for figures, found in names.items()])


def _rows(cells: Sequence[Figures], *say: Callable[[Any], str]) -> list[tuple[str, ...]]:
    """Make a row for each method, in words on each cell; the last of them for all cells that are left."""
    each = [say[min(k, len(say) - 1)] for k in range(len(cells))]
    names = cells[0]["methods"]
    return [(name, *(words(cell["methods"][name]) for words, cell in zip(each, cells, strict=True))) for name in names]


def _percent(figure: Estimate | None) -> str:
    """Share in percent; a dash where there is none."""
    if figure is None or figure.value != figure.value:
        return "-"
    return f"{100 * figure.value:.1f}" if figure.value >= 0.01 or figure.value == 0 else f"{100 * figure.value:.2g}"


def _sizes(cells: Sequence[Figures]) -> tuple[str, ...]:
    return tuple(f"{cell['size']:g}" for cell in cells)


def _plot(
    title: str,
    curves: Mapping[str, Curve],
    limit: tuple[Sequence[float], Sequence[float]],
    x: str,
    y: str,
    log: str = "",
) -> Section:
    """Curves with their confidence bands, indistinguishable ones drawn once, beside the best possible."""
    groups = alike(curves)
    data = [trace for k, group in enumerate(groups) for trace in _banded(k, ", ".join(group), *curves[group[0]])]
    if limit[1]:
        line = {"color": "#7f7f7f", "dash": "dashdot", "width": 3}
        known = {"x": list(limit[0]), "y": list(limit[1]), "line": line}
        data.append({"type": "scatter", "mode": "lines", "name": LIMIT, **known})
    layout: dict[str, Any] = {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}, "height": 420}
    if log:
        layout[log]["type"] = "log"
    hint = ALIKE_HINT if any(len(group) > 1 for group in groups) else ""
    return Section(title, hint, "", [{"data": data, "layout": layout}])


def alike(curves: Mapping[str, Curve]) -> list[list[str]]:
    """Group the names of curves that lie within each other's confidence bands at every point.

    Parameters
    ----------
    curves
        x, and for each x an estimate.
    """
    groups: list[list[str]] = []
    for name, (x, figures) in curves.items():
        for group in groups:
            x0, first = curves[group[0]]
            if list(x0) == list(x) and all(map(_same, first, figures)):
                group.append(name)
                break
        else:
            groups.append([name])
    return groups


def _same(a: Estimate, b: Estimate) -> bool:
    return a.low <= b.value <= a.high and b.low <= a.value <= b.high


def _banded(k: int, name: str, x: Sequence[float], figures: Sequence[Estimate]) -> list[dict[str, Any]]:
    """Curve with its confidence band."""
    line = {"color": PALETTE[k % len(PALETTE)], "dash": DASHES[k // len(PALETTE) % len(DASHES)], "width": 2}
    band = {"low": [f.low for f in figures], "high": [f.high for f in figures]}
    curve = {"mode": "lines+markers", "name": name, "x": list(x), "y": [f.value for f in figures], "line": line}
    return [
        {"type": "band", "name": name, "x": list(x), **band, "line": line, "showlegend": False},
        {"type": "scatter", **curve},
    ]
