"""A page of tables and figures in one HTML file that needs nothing else: for calibration and geometry."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from typing import Any

from fdi_ros.study.report import plotly_script

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c564b", "#7f7f7f", "#b8a500")
"""Colours that also people who see no red or green tell apart (after Okabe and Ito)."""
_DRAW = """
const page = JSON.parse(document.getElementById("data").textContent);
function draw() {
  const css = getComputedStyle(document.documentElement);
  const colour = name => css.getPropertyValue(name).trim();
  const axis = {gridcolor: colour("--line"), zerolinecolor: colour("--line")};
  page.forEach((figure, k) => {
    const layout = Object.assign({paper_bgcolor: colour("--page"), plot_bgcolor: colour("--page"),
      font: {color: colour("--text")}, margin: {t: 20, r: 20}, height: 420}, figure.layout);
    for (const name of ["xaxis", "yaxis"]) layout[name] = Object.assign({}, axis, layout[name]);
    if (layout.scene) for (const name of ["xaxis", "yaxis", "zaxis"])
      layout.scene[name] = Object.assign({}, axis, layout.scene[name]);
    Plotly.react("figure" + k, figure.data, layout, {displaylogo: false, responsive: true});
  });
}
document.getElementById("theme").onclick = () => { document.documentElement.classList.toggle("dark"); draw(); };
if (matchMedia("(prefers-color-scheme: dark)").matches) document.documentElement.classList.add("dark");
draw();
"""


@dataclass(frozen=True)
class Section:
    """One part of a page."""

    title: str
    hint: str = ""
    table: str = ""
    """HTML."""
    figures: Sequence[Mapping[str, Any]] = field(default_factory=tuple)
    """Each a plotly figure: data and layout."""


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Lay out a table."""
    cells = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>'


def page(title: str, summary: Sequence[str], sections: Sequence[Section]) -> str:
    """Lay out a page.

    Raises
    ------
    FdiError
        If plotly is not installed.
    """
    style = resources.files("fdi_ros.study").joinpath("report.css").read_text(encoding="utf-8")
    parts: list[str] = []
    figures: list[Mapping[str, Any]] = []
    for section in sections:
        parts.append(f"<section><h2>{escape(section.title)}</h2>")
        parts.append(f'<p class="hint">{escape(section.hint)}</p>' if section.hint else "")
        parts.append(section.table)
        for figure in section.figures:
            parts.append(f'<div id="figure{len(figures)}" class="plot"></div>')
            figures.append(figure)
        parts.append("</section>")
    data = json.dumps(figures, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    lines = "".join(f"<li>{escape(line)}</li>" for line in summary)
    return (
        f'<!DOCTYPE html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; script-src 'unsafe-inline';"
        " style-src 'unsafe-inline'; img-src data: blob:\">"
        f'<link rel="icon" href="data:,"><style>{style}</style></head><body><header><h1>{escape(title)}</h1>'
        f'<button id="theme" type="button">light / dark</button><ul id="verdict">{lines}</ul></header>{"".join(parts)}'
        f"<script>{plotly_script()}</script>"
        f'<script id="data" type="application/json">{data}</script><script>{_DRAW}</script></body></html>\n'
    )
