"""The tables of a study's result: for the terminal, the page and the documents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fdi_ros.experiments.study_file import geometry_words
from fdi_ros.report.text_table import table

Cells = Sequence[Mapping[str, Any]]
LIMIT = "best possible"


@dataclass(frozen=True)
class Table:
    """One table of words."""

    title: str
    hint: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def tables(result: Mapping[str, Any]) -> list[Table]:
    """All tables of a result, in the order of its sections; detectors of equal figures share a row."""
    return [_shared(t) for section in result["sections"] for t in _KINDS[section["kind"]](section)]


def _shared(one: Table) -> Table:
    names: dict[tuple[str, ...], list[str]] = {}
    for name, *figures in one.rows:
        names.setdefault(tuple(figures), []).append(name)
    rows = tuple((", ".join(found), *figures) for figures, found in names.items())
    return Table(one.title, one.hint, one.head, rows)


def headline(result: Mapping[str, Any]) -> str:
    """Tables as text."""
    lines = [f"{result['title'] or result['study']}, seed {result['seed']}"]
    for one in tables(result):
        lines += ["", one.title, *([one.hint] if one.hint else []), *table(one.head, one.rows)]
    return "\n".join(lines)


def markdown(one: Table) -> list[str]:
    """Lines of a table in Markdown."""
    rows = ["| " + " | ".join(row) + " |" for row in (one.head, ("---",) * len(one.head), *one.rows)]
    return [f"**{one.title}**" + (f" {one.hint}" if one.hint else ""), "", *rows]


def percent(figure: Mapping[str, float | None] | None) -> str:
    """Share in percent."""
    value = None if figure is None else figure["value"]
    return "-" if value is None else f"{100 * value:.1f}" if value >= 0.01 or value == 0 else f"{100 * value:.2g}"


def by_geometry(cells: Cells) -> list[tuple[Any, list[Mapping[str, Any]]]]:
    """Cells of each geometry, in the order met."""
    groups: list[tuple[Any, list[Mapping[str, Any]]]] = []
    for cell in cells:
        if not groups or groups[-1][0] != cell["geometry"]:
            groups.append((cell["geometry"], []))
        groups[-1][1].append(cell)
    return groups


def _snapshot(section: Mapping[str, Any]) -> list[Table]:
    if section["settings"]["faults"] == 2:
        return [t for spec, cells in by_geometry(section["cells"]) for t in _double(spec, cells)]
    found = []
    alarms = section["settings"]["false_alarms"]
    for spec, cells in by_geometry(section["cells"]):
        faults = [cell for cell in cells if cell["size"]]
        if len(alarms) == 1:
            found.append(_power(spec, cells))
            if any("identified" in at[0] for at in faults[0]["methods"].values()):
                found.append(_identified(spec, faults))
        else:
            found += [_roc(spec, cell, alarms) for cell in faults]
    return found


def _power(spec: Any, cells: Cells) -> Table:
    faults = [cell for cell in cells if cell["size"]]
    sound = cells[0]
    rows = []
    for name in sound["methods"]:
        right = [
            f"{percent(c['methods'][name][0]['right'])} ({percent(c['methods'][name][0]['declared'])})" for c in faults
        ]
        rows.append((name, percent(sound["methods"][name][0]["declared"]), *right))
    if faults[0]["limit"]:
        best = [c["limit"][0] for c in faults]
        shown = (f"{100 * b['right']:.1f} ({100 * b['declared']:.1f})" for b in best)
        rows.append((LIMIT, f"{100 * best[0]['false_alarm']:.2g}", *shown))
    hint = "Percent declared with the right channel named first (declared at all), by size in standard deviations."
    head = ("detector", "sound", *(f"{c['size']:g}" for c in faults))
    return Table(f"One fault, {geometry_words(spec)}", hint, head, tuple(rows))


def _identified(spec: Any, faults: Cells) -> Table:
    methods = [name for name, at in faults[0]["methods"].items() if "identified" in at[0]]
    rows = tuple((name, *(percent(c["methods"][name][0]["identified"]) for c in faults)) for name in methods)
    head = ("detector", *(f"{c['size']:g}" for c in faults))
    return Table(f"Largest residual is the right one, {geometry_words(spec)}", "Percent, alarm or not.", head, rows)


def _roc(spec: Any, cell: Mapping[str, Any], alarms: Sequence[float]) -> Table:
    rows = [(name, *(percent(at["declared"]) for at in points)) for name, points in cell["methods"].items()]
    if cell["limit"]:
        rows.append((LIMIT, *(f"{100 * point['declared']:.1f}" for point in cell["limit"])))
    title = f"Detection of {cell['size']:g} standard deviations, {geometry_words(spec)}"
    return Table(
        title, "Percent declared, by false-alarm rate.", ("detector", *(f"{a:g}" for a in alarms)), tuple(rows)
    )


def _double(spec: Any, cells: Cells) -> list[Table]:
    found = []
    for cell in cells:
        if not cell["size"]:
            continue
        rows = []
        for name, (at,) in cell["methods"].items():
            sizes = at["set_sizes"]
            mean = sum(k * count for k, count in enumerate(sizes)) / max(sum(sizes), 1)
            shares = (at["declared"], at["covered_when_declared"], at["isolated_right"], at["isolated_wrong"])
            rows.append((name, *(percent(figure) for figure in shares), f"{mean:.2f}"))
        head = ("detector", "declared", "suspects cover both", "pair isolated", "isolated wrongly", "suspects, mean")
        title = f"Two faults of {cell['size']:g} standard deviations, {geometry_words(spec)}"
        found.append(Table(title, "Percent; coverage of what was declared.", head, tuple(rows)))
    return found


def _delay(section: Mapping[str, Any]) -> list[Table]:
    run_length = section["settings"]["run_length"]
    found = []
    for spec, cells in by_geometry(section["cells"]):
        rows = [(name, *(_mean(c["methods"][name]) for c in cells)) for name in cells[0]["methods"]]
        rows.append((LIMIT, *(f"{c['limit']['moustakides']:.1f}" for c in cells)))
        hint = (
            f"Mean samples to the alarm at a mean run length of {run_length:g} samples, by size in standard deviations."
        )
        head = ("detector", *(f"{c['size']:g}" for c in cells))
        found.append(Table(f"Delay, {geometry_words(spec)}", hint, head, tuple(rows)))
    return found


def _mean(figures: Mapping[str, Any]) -> str:
    mean = figures["mean_delay"]
    return "-" if mean is None else f"{mean['value']:.1f}"


def _flight(section: Mapping[str, Any]) -> list[Table]:
    cells = section["cells"]
    methods = list(cells[0]["methods"])

    def laid_out(title: str, hint: str, word: Callable[[Mapping[str, Any]], str]) -> Table:
        rows = tuple((name, *(word(c["methods"][name]) for c in cells)) for name in methods)
        return Table(title, hint, ("detector", *(c["fault"] for c in cells)), rows)

    return [
        laid_out("Declared, and no sound channel with it", "Percent of flights.", lambda m: percent(m["right"])),
        laid_out("A sound channel declared", "Percent of flights.", lambda m: percent(m["wrong"])),
        laid_out("Delay to the declaration", "Median and 90 % quantile, s.", _delay_words),
        laid_out(
            "Error of the fused rate from the onset on", "Root mean square, rad/s.", lambda m: _small(m["rms_after"])
        ),
    ]


def _delay_words(figures: Mapping[str, Any]) -> str:
    delay = figures["delay_s"]
    return "-" if delay["p50"] is None else f"{delay['p50']:.2f} / {delay['p90']:.2f}"


def _small(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _residual_search(section: Mapping[str, Any]) -> list[Table]:
    found = []
    for cell in section["cells"]:
        rows: list[tuple[str, ...]] = []
        for name, shares in cell["paper_tolerance"].items():
            rows.append((name, "tolerance (8)", *(percent(figure) for figure in shares.values())))
        for k, alarm in enumerate(section["settings"]["false_alarms"]):
            for name, points in cell["methods"].items():
                figures = (percent(f) for f in points[k].values() if isinstance(f, Mapping))
                rows.append((name, f"{alarm:g}", *figures))
            if cell["limit"]:
                best = cell["limit"][k]
                wrong = f"{100 * (best['declared'] - best['right']):.1f}"
                rows.append((LIMIT, f"{alarm:g}", f"{100 * best['right']:.1f}", "", wrong, ""))
        outcomes = tuple(next(iter(cell["paper_tolerance"].values())))
        head = ("detector", "false alarms", *(name.replace("_", ", ") for name in outcomes))
        ratio = section["settings"]["sigma_ratio"]
        hint = f"Percent of {cell['trials']} trials kept of {cell['drawn']}; sigma_0 = {ratio:g} sigma_k max_rate."
        found.append(Table(f"Protocol of 2019, {cell['selection'].replace('_', ' ')}", hint, head, tuple(rows)))
    return found


_KINDS: Mapping[str, Callable[[Mapping[str, Any]], list[Table]]] = {
    "snapshot": _snapshot,
    "delay": _delay,
    "flight": _flight,
    "residual_search": _residual_search,
}
