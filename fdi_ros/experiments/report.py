# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A study's result for people: tables for terminal, page and documents; advice; and the page with its curves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from fdi_ros.experiments.montecarlo import SectionResult, StudyResult
from fdi_ros.experiments.protocols.flight import NONE
from fdi_ros.experiments.study import Figures, geometry_words
from fdi_ros.report.layout import PALETTE, Section, html_table, number, page, table
from fdi_ros.scoring import Estimate

LIMIT = "best possible, approximate"
"""For one sample it is integrated to 0.05 %, for the protocol of 2019 approximated. In both a method's figure has the
errors of its trials and of its threshold, and may come out above."""
DASHES = ("solid", "dash", "dot")
ALIKE_HINT = "Curves within each other's confidence bands are drawn once; the tables have the figures of each."
GOOD = 0.9
"""Share of faults declared with the right name from which on a size counts as found."""

Curve = tuple[Sequence[float], Sequence[Estimate]]
"""x, and for each x a figure with its confidence interval."""


@dataclass(frozen=True)
class Table:
    """One table of words."""

    title: str
    hint: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(result: StudyResult) -> list[Table]:
    """All tables of a result, in the order of its sections; detectors of equal figures share a row."""
    return [_shared(one) for section in result.sections for one in _VIEWS[section.kind].tables(section)]


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
    return [line for section in result.sections for line in _VIEWS[section.kind].advice(section)]


def report(result: StudyResult) -> str:
    """Lay out the page: what to use and what it misses, curves with their confidence bands, tables."""
    sections = [drawn for section in result.sections for drawn in _VIEWS[section.kind].figures(section)]
    sections += [Section(one.title, one.hint, html_table(one.head, one.rows)) for one in tables(result)]
    for section in result.sections:
        refused = [(g, name, why) for g, names in section.not_run.items() for name, why in names.items()]
        if refused:
            rows = html_table(("mounting", "detector", "why"), refused)
            sections.append(Section(f"Not run: {section.kind}", "", rows))
    settings = [(s.kind, name, str(value)) for s in result.sections for name, value in s.settings.items()]
    sections.append(Section("Settings", f"Seed {result.seed}.", html_table(("section", "setting", "value"), settings)))
    return page(f"fdi_ros: {result.title or result.study}", advice(result), sections)


# One sample


def _snapshot_tables(section: SectionResult) -> list[Table]:
    if section.settings["faults"] == 2:
        return [one for spec, cells in _by_geometry(section.cells) for one in _double_tables(spec, cells)]
    found = []
    alarms = section.settings["false_alarms"]
    for spec, cells in _by_geometry(section.cells):
        faults = [cell for cell in cells if cell["size"]]
        if len(alarms) > 1:
            found += [_roc_table(spec, cell, alarms) for cell in faults]
            continue
        found.append(_power_table(spec, cells[0], faults))
        if any(at[0].get("identified") for at in faults[0]["methods"].values()):
            found.append(_identified_table(spec, faults))
    return found


def _power_table(spec: Any, sound: Figures, faults: Sequence[Figures]) -> Table:
    rows = []
    for name, (at,) in sound["methods"].items():
        figures = [cell["methods"][name][0] for cell in faults]
        shown = [f"{_percent(one['right'])} ({_percent(one['declared'])})" for one in figures]
        rows.append((name, _percent(at["declared"]), *shown))
    best = [cell["limit"][0] for cell in faults if cell["limit"]]
    if best:
        shown = [f"{100 * b['right']:.1f} ({100 * b['declared']:.1f})" for b in best]
        rows.append((LIMIT, f"{100 * best[0]['false_alarm']:.2g}", *shown))
    hint = "Percent declared with the right channel named first (declared at all), by size in standard deviations."
    head = ("detector", "healthy", *_sizes(faults))
    return Table(f"One fault, {geometry_words(spec)}", hint, head, tuple(rows))


def _identified_table(spec: Any, faults: Sequence[Figures]) -> Table:
    methods = [name for name, at in faults[0]["methods"].items() if at[0].get("identified")]
    rows = tuple((name, *(_percent(c["methods"][name][0]["identified"]) for c in faults)) for name in methods)
    title = f"Largest residual is the right one, {geometry_words(spec)}"
    return Table(title, "Percent, alarm or not.", ("detector", *_sizes(faults)), rows)


def _roc_table(spec: Any, cell: Figures, alarms: Sequence[float]) -> Table:
    rows = [(name, *(_percent(at["declared"]) for at in points)) for name, points in cell["methods"].items()]
    if cell["limit"]:
        rows.append((LIMIT, *(f"{100 * point['declared']:.1f}" for point in cell["limit"])))
    head = ("detector", *(f"{a:g}" for a in alarms))
    return Table(_roc_title(spec, cell), "Percent declared, by false-alarm rate.", head, tuple(rows))


def _roc_title(spec: Any, cell: Figures) -> str:
    return f"Detection of {cell['size']:g} standard deviations, {geometry_words(spec)}"


def _double_tables(spec: Any, cells: Sequence[Figures]) -> list[Table]:
    head = ("detector", "declared", "suspects cover both", "pair isolated", "isolated wrongly", "suspects, mean")
    found = []
    for cell in cells:
        if cell["size"]:
            rows = tuple((name, *_double_row(at)) for name, (at,) in cell["methods"].items())
            title = f"Two faults of {cell['size']:g} standard deviations, {geometry_words(spec)}"
            found.append(Table(title, "Percent; coverage of what was declared.", head, rows))
    return found


def _double_row(at: Figures) -> tuple[str, ...]:
    mean = sum(k * count for k, count in enumerate(at["set_sizes"])) / max(sum(at["set_sizes"]), 1)
    shares = (at["declared"], at["covered_when_declared"], at["isolated_right"], at["isolated_wrong"])
    return (*(_percent(figure) for figure in shares), f"{mean:.2f}")


def _snapshot_advice(section: SectionResult) -> list[str]:
    if section.settings["faults"] != 1:
        return []
    return [_geometry_advice(spec, cells) for spec, cells in _by_geometry(section.cells)]


def _geometry_advice(spec: Any, cells: Sequence[Figures]) -> str:
    faults = [cell for cell in cells if cell["size"]]
    middle = faults[len(faults) // 2]
    right = {name: at[0]["right"] for name, at in middle["methods"].items()}
    top = max(right, key=lambda name: right[name].value)
    among_best = [name for name, figure in right.items() if figure.high >= right[top].low]
    words = (
        f"{geometry_words(spec)}, one sample: best at {middle['size']:g} standard deviations: {', '.join(among_best)}"
    )
    words += f" ({_percent(right[top])} % declared and rightly named"
    words += f" of about {100 * middle['limit'][0]['right']:.1f} % possible)" if middle["limit"] else ")"
    found = [cell["size"] for cell in faults if cell["methods"][top][0]["right"].value >= GOOD]
    if found:
        return f"{words}; it misses more than {1 - GOOD:.0%} of faults below {min(found):g} standard deviations."
    return f"{words}; it misses more than {1 - GOOD:.0%} of all sizes tried."


def _snapshot_figures(section: SectionResult) -> list[Section]:
    if section.settings["faults"] != 1:
        return []
    if len(section.settings["false_alarms"]) > 1:
        return [_roc(spec, cell) for spec, cells in _by_geometry(section.cells) for cell in cells if cell["size"]]
    return [_power(spec, cells) for spec, cells in _by_geometry(section.cells)]


def _power(spec: Any, cells: Sequence[Figures]) -> Section:
    faults = [cell for cell in cells if cell["size"]]
    sizes = [cell["size"] for cell in faults]
    curves = {name: (sizes, [cell["methods"][name][0]["right"] for cell in faults]) for name in cells[0]["methods"]}
    limit = (sizes, [cell["limit"][0]["right"] for cell in faults if cell["limit"]])
    title = f"Right declarations, {geometry_words(spec)}"
    return _plot(title, curves, limit, "fault, standard deviations", "declared, right channel named")


def _roc(spec: Any, cell: Figures) -> Section:
    def declared(points: Sequence[Figures]) -> tuple[list[float], list[Any]]:
        return [at["false_alarm"] for at in points], [at["declared"] for at in points]

    curves = {name: declared(points) for name, points in cell["methods"].items()}
    limit = declared(cell["limit"] or ())
    return _plot(_roc_title(spec, cell), curves, limit, "false alarms per sample", "declared", log="xaxis")


# Streams


def _delay_tables(section: SectionResult) -> list[Table]:
    run_length = section.settings["run_length"]
    hint = f"Mean samples to the alarm at a mean run length of {run_length:g} samples, by size in standard deviations."
    found = []
    for spec, cells in _by_geometry(section.cells):
        rows = [(name, *(_mean(cell["methods"][name]) for cell in cells)) for name in cells[0]["methods"]]
        rows.append((LIMIT, *(f"{cell['limit']['moustakides']:.1f}" for cell in cells)))
        found.append(Table(f"Delay, {geometry_words(spec)}", hint, ("detector", *_sizes(cells)), tuple(rows)))
    return found


def _mean(figures: Figures) -> str:
    return "-" if figures["mean_delay"] is None else f"{figures['mean_delay'].value:.1f}"


def _delay_advice(section: SectionResult) -> list[str]:
    lines = []
    for spec, cells in _by_geometry(section.cells):
        words = []
        for cell in cells:
            known = {name: at["mean_delay"].value for name, at in cell["methods"].items() if at["mean_delay"]}
            if known:
                top = min(known, key=lambda name: known[name])
                words.append(
                    f"{cell['size']:g}: {top} ({known[top]:.1f}, possible about {cell['limit']['moustakides']:.1f})"
                )
        lines.append(f"{geometry_words(spec)}, soonest alarm in samples by size: {'; '.join(words)}.")
    return lines


def _delay(spec: Any, cells: Sequence[Figures]) -> Section:
    curves: dict[str, Curve] = {}
    for name in cells[0]["methods"]:
        known = [(cell["size"], mean) for cell in cells if (mean := cell["methods"][name]["mean_delay"])]
        if known:
            curves[name] = ([size for size, _ in known], [figure for _, figure in known])
    limit = ([cell["size"] for cell in cells], [cell["limit"]["moustakides"] for cell in cells])
    title = f"Delay, {geometry_words(spec)}"
    return _plot(title, curves, limit, "fault, standard deviations", "mean delay, samples", log="yaxis")


# Flights


def _flight_tables(section: SectionResult) -> list[Table]:
    cells = section.cells
    head = ("detector", *(cell["fault"] for cell in cells))

    def laid_out(title: str, hint: str, words: Callable[[Figures], str]) -> Table:
        rows = tuple((name, *(words(cell["methods"][name]) for cell in cells)) for name in cells[0]["methods"])
        return Table(title, hint, head, rows)

    rms_title = "Error of the fused rate from the onset on"
    return [
        laid_out("Declared, and no healthy channel with it", "Percent of flights.", lambda at: _percent(at["right"])),
        laid_out("A healthy channel declared", "Percent of flights.", lambda at: _percent(at["wrong"])),
        laid_out("Delay to the declaration", "Median and 90 % quantile, s.", _delay_words),
        laid_out(rms_title, "Root mean square, rad/s.", lambda at: number(at["rms_after"], ".4f")),
    ]


def _delay_words(figures: Figures) -> str:
    median, late = figures["delay_s"]["p50"], figures["delay_s"]["p90"]
    return "-" if median is None else f"{median:.2f} / {late:.2f}"


def _flight_advice(section: SectionResult) -> list[str]:
    cells = section.cells
    faults = [cell for cell in cells if cell["fault"] != NONE]
    sound = [cell for cell in cells if cell["fault"] == NONE]
    lines = []
    for name in cells[0]["methods"]:
        missed = [cell["fault"] for cell in faults if cell["methods"][name]["right"].value < GOOD]
        wrong = f"; {_percent(sound[0]['methods'][name]['wrong'])} % of healthy flights blamed" if sound else ""
        lines.append(f"{name} misses or misnames more than {1 - GOOD:.0%} of: {', '.join(missed) or 'nothing'}{wrong}.")
    return lines


# The protocol of 2019


def _search_tables(section: SectionResult) -> list[Table]:
    cells = section.cells
    ratio = section.settings["sigma_ratio"]
    found = []
    for cell in cells:
        outcomes = tuple(next(iter(cell["paper_tolerance"].values())))
        head = ("detector", "false alarms", *(name.replace("_", ", ") for name in outcomes))
        hint = f"Percent of {cell['trials']} trials kept of {cell['drawn']}; sigma_0 = {ratio:g} sigma_k max_rate."
        rows = tuple(_search_rows(cell, section.settings["false_alarms"]))
        found.append(Table(f"Protocol of 2019, {cell['selection'].replace('_', ' ')}", hint, head, rows))
    return found


def _search_rows(cell: Figures, alarms: Sequence[float]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for name, shares in cell["paper_tolerance"].items():
        rows.append((name, "tolerance (8)", *(_percent(figure) for figure in shares.values())))
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

    tables: Callable[[SectionResult], list[Table]]
    advice: Callable[[SectionResult], list[str]] = lambda section: []
    figures: Callable[[SectionResult], list[Section]] = lambda section: []


_VIEWS: Mapping[str, _View] = {
    "snapshot": _View(_snapshot_tables, _snapshot_advice, _snapshot_figures),
    "delay": _View(_delay_tables, _delay_advice, lambda section: [_delay(*one) for one in _by_geometry(section.cells)]),
    "flight": _View(_flight_tables, _flight_advice),
    "residual_search": _View(_search_tables),
}


# What they share


def _shared(one: Table) -> Table:
    """Put detectors of equal figures into one row."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, *figures in one.rows:
        names.setdefault(tuple(figures), []).append(name)
    rows = tuple((", ".join(found), *figures) for figures, found in names.items())
    return Table(one.title, one.hint, one.head, rows)


def _percent(figure: Estimate | None) -> str:
    """Share in percent; a dash where there is none."""
    if figure is None or figure.value != figure.value:
        return "-"
    return f"{100 * figure.value:.1f}" if figure.value >= 0.01 or figure.value == 0 else f"{100 * figure.value:.2g}"


def _by_geometry(cells: Sequence[Figures]) -> list[tuple[Any, list[Figures]]]:
    """Cells of each geometry, in their order."""
    groups: list[tuple[Any, list[Figures]]] = []
    for cell in cells:
        if not groups or groups[-1][0] != cell["geometry"]:
            groups.append((cell["geometry"], []))
        groups[-1][1].append(cell)
    return groups


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
