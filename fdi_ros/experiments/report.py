"""The page of a study: what to use and what it misses, curves with their confidence bands, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fdi_ros.errors import StudyError
from fdi_ros.experiments.study_file import geometry_words
from fdi_ros.experiments.table import LIMIT, Cells, by_geometry, percent, tables
from fdi_ros.report.page import PALETTE, Section, html_table, page

Curve = tuple[Sequence[float], Sequence[Mapping[str, float]]]
"""x, and for each x a figure with its confidence interval: value, low, high."""

DASHES = ("solid", "dash", "dot")
ALIKE_HINT = "Curves within each other's confidence bands are drawn once; the tables have the figures of each."
GOOD = 0.9
"""Share of faults declared with the right name from which on a size counts as found."""


def write_report(result: Mapping[str, Any], path: Path) -> None:
    """Write the page.

    Raises
    ------
    StudyError
        If the file cannot be written.
    """
    text = report(result)
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StudyError(f"cannot write {path}: {error.strerror}") from error


def report(result: Mapping[str, Any]) -> str:
    """Lay out the page."""
    sections = [drawn for section in result["sections"] for drawn in _figures(section)]
    sections += [Section(one.title, one.hint, html_table(one.head, one.rows)) for one in tables(result)]
    for section in result["sections"]:
        refused = [(g, name, why) for g, names in section["not_run"].items() for name, why in names.items()]
        if refused:
            rows = html_table(("mounting", "detector", "why"), refused)
            sections.append(Section(f"Not run: {section['kind']}", "", rows))
    settings = [(s["kind"], name, str(value)) for s in result["sections"] for name, value in s["settings"].items()]
    sections.append(
        Section("Settings", f"Seed {result['seed']}.", html_table(("section", "setting", "value"), settings))
    )
    return page(f"fdi_ros: {result['title'] or result['study']}", advice(result), sections)


def advice(result: Mapping[str, Any]) -> list[str]:
    """Which detector on which mounting, and what it will miss, in sentences."""
    lines: list[str] = []
    for section in result["sections"]:
        if section["kind"] == "snapshot" and section["settings"]["faults"] == 1:
            lines += [_snapshot_advice(spec, cells) for spec, cells in by_geometry(section["cells"])]
        elif section["kind"] == "delay":
            lines += [_delay_advice(spec, cells) for spec, cells in by_geometry(section["cells"])]
        elif section["kind"] == "flight":
            lines += _flight_advice(section["cells"])
    return lines


def _snapshot_advice(spec: Any, cells: Cells) -> str:
    faults = [cell for cell in cells if cell["size"]]
    middle = faults[len(faults) // 2]
    right = {name: at[0]["right"] for name, at in middle["methods"].items()}
    top = max(right, key=lambda name: right[name]["value"])
    alike = [name for name, figure in right.items() if figure["high"] >= right[top]["low"]]
    words = f"{geometry_words(spec)}, one sample: best at {middle['size']:g} standard deviations: {', '.join(alike)}"
    words += f" ({percent(right[top])} % declared and rightly named"
    words += f" of {100 * middle['limit'][0]['right']:.1f} % possible)" if middle["limit"] else ")"
    found = [c["size"] for c in faults if c["methods"][top][0]["right"]["value"] >= GOOD]
    if found:
        return f"{words}; it misses more than {1 - GOOD:.0%} of faults below {min(found):g} standard deviations."
    return f"{words}; it misses more than {1 - GOOD:.0%} of all sizes tried."


def _delay_advice(spec: Any, cells: Cells) -> str:
    words = []
    for cell in cells:
        known = {name: f["mean_delay"] for name, f in cell["methods"].items() if f["mean_delay"]}
        if known:
            top = min(known, key=lambda name: known[name]["value"])
            words.append(
                f"{cell['size']:g}: {top} ({known[top]['value']:.1f}, possible {cell['limit']['moustakides']:.1f})"
            )
    return f"{geometry_words(spec)}, soonest alarm in samples by size: {'; '.join(words)}."


def _flight_advice(cells: Cells) -> list[str]:
    faults = [cell for cell in cells if cell["fault"] != "none"]
    lines = []
    for name in cells[0]["methods"]:
        missed = [cell["fault"] for cell in faults if cell["methods"][name]["right"]["value"] < GOOD]
        sound = [cell for cell in cells if cell["fault"] == "none"]
        wrong = f"; {percent(sound[0]['methods'][name]['wrong'])} % of sound flights blamed" if sound else ""
        lines.append(f"{name} misses or misnames more than {1 - GOOD:.0%} of: {', '.join(missed) or 'nothing'}{wrong}.")
    return lines


def _figures(section: Mapping[str, Any]) -> list[Section]:
    if section["kind"] == "snapshot" and section["settings"]["faults"] == 1:
        if len(section["settings"]["false_alarms"]) > 1:
            return [_roc(spec, cell) for spec, cells in by_geometry(section["cells"]) for cell in cells if cell["size"]]
        return [_power(spec, cells) for spec, cells in by_geometry(section["cells"])]
    if section["kind"] == "delay":
        return [_delay(spec, cells) for spec, cells in by_geometry(section["cells"])]
    return []


def _power(spec: Any, cells: Cells) -> Section:
    faults = [cell for cell in cells if cell["size"]]
    sizes = [cell["size"] for cell in faults]
    curves = {name: (sizes, [cell["methods"][name][0]["right"] for cell in faults]) for name in cells[0]["methods"]}
    data = _curves(curves)
    if faults[0]["limit"]:
        data.append(_limit(sizes, [cell["limit"][0]["right"] for cell in faults]))
    layout = _layout("fault, standard deviations", "declared, right channel named")
    return _section(f"Right declarations, {geometry_words(spec)}", data, layout)


def _roc(spec: Any, cell: Mapping[str, Any]) -> Section:
    data = _curves(
        {
            name: ([p["false_alarm"] for p in points], [p["declared"] for p in points])
            for name, points in cell["methods"].items()
        }
    )
    if cell["limit"]:
        data.append(_limit([p["false_alarm"] for p in cell["limit"]], [p["declared"] for p in cell["limit"]]))
    layout = _layout("false alarms per sample", "declared")
    layout["xaxis"]["type"] = "log"
    return _section(f"Detection of {cell['size']:g} standard deviations, {geometry_words(spec)}", data, layout)


def _delay(spec: Any, cells: Cells) -> Section:
    sizes = [cell["size"] for cell in cells]
    curves = {}
    for name in cells[0]["methods"]:
        known = [(c["size"], c["methods"][name]["mean_delay"]) for c in cells if c["methods"][name]["mean_delay"]]
        if known:
            curves[name] = ([size for size, _ in known], [figure for _, figure in known])
    data = _curves(curves)
    data.append(_limit(sizes, [cell["limit"]["moustakides"] for cell in cells]))
    layout = _layout("fault, standard deviations", "mean delay, samples")
    layout["yaxis"]["type"] = "log"
    return _section(f"Delay, {geometry_words(spec)}", data, layout)


def _section(title: str, data: list[dict[str, Any]], layout: dict[str, Any]) -> Section:
    return Section(
        title,
        ALIKE_HINT if any(", " in t.get("name", "") for t in data) else "",
        "",
        [{"data": data, "layout": layout}],
    )


def alike(curves: Mapping[str, Curve]) -> list[list[str]]:
    """Group the names of curves that lie within each other's confidence bands at every point.

    Parameters
    ----------
    curves
        x, and for each x the figures value, low and high.
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


def _same(a: Mapping[str, float], b: Mapping[str, float]) -> bool:
    return a["low"] <= b["value"] <= a["high"] and b["low"] <= a["value"] <= b["high"]


def _curves(curves: Mapping[str, Curve]) -> list[dict[str, Any]]:
    """Curves with their confidence bands; those that cannot be told apart are drawn once."""
    data: list[dict[str, Any]] = []
    for k, group in enumerate(alike(curves)):
        data += _banded(k, ", ".join(group), *curves[group[0]])
    return data


def _banded(k: int, name: str, x: Sequence[float], figures: Sequence[Mapping[str, float]]) -> list[dict[str, Any]]:
    """Curve with its confidence band."""
    line = {"color": PALETTE[k % len(PALETTE)], "dash": DASHES[k // len(PALETTE) % len(DASHES)], "width": 2}
    band = {"low": [f["low"] for f in figures], "high": [f["high"] for f in figures]}
    return [
        {"type": "band", "name": name, "x": list(x), **band, "line": line, "showlegend": False},
        {
            "type": "scatter",
            "mode": "lines+markers",
            "name": name,
            "x": list(x),
            "y": [f["value"] for f in figures],
            "line": line,
        },
    ]


def _limit(x: Sequence[float], y: Sequence[float]) -> dict[str, Any]:
    line = {"color": "#7f7f7f", "dash": "dashdot", "width": 3}
    return {"type": "scatter", "mode": "lines", "name": LIMIT, "x": list(x), "y": list(y), "line": line}


def _layout(x: str, y: str) -> dict[str, Any]:
    return {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}, "height": 420}
