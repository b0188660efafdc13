# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pages in one HTML file without network, other files or libraries, and tables for a terminal.

The scripts beside this file draw the plots in the browser. A figure is a mapping of ``data`` and
``layout`` in the form of plotly's figures. The scripts draw:

- traces ``scatter`` (x, y, mode, name, line, legendgroup, showlegend, and ``rank`` in the legend), ``heatmap``,
  ``scatter3d`` (lines),
- axes with title, type ``log``, range, shapes ``rect`` over all y, height.

They also draw traces ``band`` (x, low, high) and ``spans`` (row, from, to, text, pattern), and series of a
`PageStore` (``packed``, with ``plus`` or ``spread``). The layout has ``title``, ``link`` (plots with
this name share range, zoom and cursor), ``scale`` (plots with this name share the scale of values),
``robust`` (short peaks do not set the scale), ``needed`` (times that the scale must cover), ``marks``
(x, kind, text, ``label``) and ``rows`` of spans.
"""

from __future__ import annotations

import base64
import html
import json
import math
import re
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from importlib import resources
from itertools import zip_longest
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array
from fdi_ros.system.text import LINE, WORD, date_of, shown, visible


class Severity(Enum):
    """Severity of a verdict. The value is its class on a page."""

    GOOD = "good"
    """No action is needed."""
    UNKNOWN = "unknown"
    """The data leave a question open."""
    BAD = "bad"
    """Action is needed."""

    @property
    def exit_code(self) -> int:
        """Exit code of a verb. 1 means an unmet ``--check``, and 2 wrong arguments."""
        return {Severity.GOOD: 0, Severity.UNKNOWN: 4, Severity.BAD: 3}[self]


class Verdict(NamedTuple):
    """A verdict in one line, with its severity."""

    severity: Severity
    """The severity."""
    words: str
    """The verdict, which begins with its word in capitals: ``HEALTHY: ...``."""


class Unit(NamedTuple):
    """A unit of angular rate."""

    name: str
    """Name of the unit."""
    factor: float
    """Number of these units in 1 rad/s."""

    def words(self, value: float | None, digits: int = 6) -> str:
        """Return a rate, rad/s, in this unit, or a dash."""
        if value is None:
            return "-"
        return f"{value * self.factor:.{digits}f} {self.name}"

    def named(self, text: str) -> str:
        """Replace rad/s in a text by this unit."""
        return text.replace(RADIANS.name, self.name)


RADIANS, DEGREES = Unit("rad/s", 1.0), Unit("deg/s", math.degrees(1.0))
FORCES = Unit("m/s^2", 1.0)
"""Unit of accelerometers, whatever the unit of rates is."""


def unit_of(degrees: bool) -> Unit:
    """Return the unit for rates."""
    return DEGREES if degrees else RADIANS


Rows = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Head and rows of a table, for `table` and `html_table`."""
Columns = Mapping[str, Callable[[Any], str]]
"""Columns of a table by their heads. Each function returns the cell of an item."""


def head_and_rows(columns: Columns, items: Iterable[Any]) -> Rows:
    """Lay out a row for each item."""
    return tuple(columns), [
        tuple(say(item) for say in columns.values()) for item in items
    ]


class Column(NamedTuple):
    """A column of a table, in SI units for programs and as text for people."""

    name: str
    """Name for programs. Empty: the column is only for people."""
    values: Sequence[Any] | NDArray[Any]
    """One value per row. With several heads, one value per head in each row."""
    heads: Sequence[str] = ()
    """Heads for people. Empty: the column is only for programs."""
    say: str | Callable[[Any], str] = ""
    """Format of a value, or a function that returns its text."""
    factor: float = 1.0
    """Factor from the SI unit to the unit for people."""


def figures_of(columns: Iterable[Column]) -> list[dict[str, Any]]:
    """Return the figures of each row by name, for programs."""
    named = [column for column in columns if column.name]
    rows = zip(*(column.values for column in named), strict=True)
    return [
        dict(zip((column.name for column in named), row, strict=True)) for row in rows
    ]


def told(columns: Iterable[Column], unit: Unit = RADIANS) -> Rows:
    """Lay out a row for each item, for people, with the given unit in the heads."""
    shown_ones = [column for column in columns if column.heads]
    cells = []
    for column in shown_ones:
        say = column.say if callable(column.say) else f"{{:{column.say}}}".format
        for values in (
            zip(*column.values, strict=True)
            if len(column.heads) > 1
            else [column.values]
        ):
            cells += [
                [
                    say(value if column.factor == 1.0 else value * column.factor)
                    for value in values
                ]
            ]
    return tuple(
        unit.named(head) for column in shown_ones for head in column.heads
    ), list(zip(*cells, strict=True))


class _Lengths(NamedTuple):
    """How much fits beside and below one another."""

    #: characters of the longest figure with its error and unit. A longer cell is a
    #: text
    figure: int = 24
    #: length of a line of sentences in a terminal, characters
    terminal: int = 110
    #: rows of a table on paper, as in page.css
    paper_rows: int = 60


LENGTHS = _Lengths()


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], figures: bool = True
) -> list[str]:
    """Lay out lines of text in columns, with control characters escaped.

    ``figures``: the columns after the first hold figures and are aligned to the right, but for those
    with a cell longer than `LENGTHS.figure`. Otherwise all columns are aligned to the left, and long
    texts are shortened.
    """
    most = LINE if figures else WORD
    body = [tuple(shown(cell, most) for cell in row) for row in rows]
    lines = [tuple(head), *body]
    width = [max(map(len, column)) for column in zip(*lines, strict=True)]
    longest = [
        max(map(len, column), default=0) for column in zip(*lines[1:], strict=True)
    ]
    right = [
        figures and k > 0 and long <= LENGTHS.figure
        for k, long in enumerate(longest or width)
    ]
    form = "  ".join(
        f"{{:{'>' if to_right else '<'}{wide}}}"
        for wide, to_right in zip(width, right, strict=True)
    )
    return [form.format(*line).rstrip() for line in lines]


def indented(lines: Iterable[str]) -> str:
    """Return lines as one text, indented by two blanks."""
    return "".join(f"  {line}\n" for line in lines)


def number(value: float | None, form: str = ".3f", unit: str = "") -> str:
    """Return a number with a unit, or a dash if the number is unknown or not finite."""
    if value is None or not math.isfinite(value):
        return "-"
    text = f"{value:{form}}"
    return f"{f'{value:.0f}' if 'e+' in text else text}{unit}"


def milliseconds(seconds: float | None) -> str:
    """Return a time, s, in ms, or a dash."""
    # The sum turns a rounded -0.0 into 0.0.
    return "-" if seconds is None else f"{round(1000 * seconds, 1) + 0.0:.1f} ms"


PALETTE = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#8c564b",
    "#7f7f7f",
    "#b8a500",
)
"""Colours that colour-blind people can distinguish (after Okabe and Ito)."""
CHANNEL_COLOURS = (*PALETTE, "#9a4dff", "#e20134", "#00b4a0")
"""Colours of the channels."""
TIME_AXIS = "s from the first sample"
_SCRIPTS = (
    "plot_data.js",
    "plot_scale.js",
    "plot_chart.js",
    "plot_other.js",
    "plot_save.js",
    "table.js",
    "page.js",
)


Figure = dict[str, Any]
"""Traces under ``data`` and axes under ``layout``, as JSON for the scripts."""


Content = str | Rows | list[str] | Mapping[str, str]
"""Content of a section beside its plots: HTML, a table, sentences, or names with meanings."""


@dataclass(frozen=True)
class Section:
    """One part of a page."""

    title: str
    """Title of the section."""
    hint: str = ""
    """Sentence below the title."""
    content: Content = ""
    """Content beside the plots."""
    figures: Sequence[Mapping[str, Any]] = field(default_factory=tuple)
    """Plots, each a `Figure`."""


class Pair(NamedTuple):
    """The same part of two replays, one beside the other. None: one replay lacks it."""

    first: Section | None
    """Part of the first replay, on the left, or above on a narrow screen."""
    second: Section | None
    """Part of the second replay."""

    @property
    def title(self) -> str:
        """Title of both."""
        return self._shown.title

    @property
    def hint(self) -> str:
        """Sentence below the title."""
        return self._shown.hint

    @property
    def figures(self) -> list[Mapping[str, Any]]:
        """Plots of both in turn."""
        return [one for row in self.rows for one in row if one is not None]

    @property
    def rows(self) -> list[tuple[Mapping[str, Any] | None, ...]]:
        """Plots in rows of two. None: one replay has fewer plots."""
        columns = [[*one.figures] if one else [] for one in self]
        return list(zip_longest(*columns))

    @property
    def _shown(self) -> Section:
        shown_one = self.first or self.second
        assert shown_one is not None
        return shown_one


Part = Section | Pair
"""One part of a page, between two heads."""


def section_lines(section: Section) -> list[str]:
    """Lay out a section for a terminal, without plots. The content must be no HTML."""
    lines = [section.title, *textwrap.wrap(section.hint, LENGTHS.terminal)]
    return [
        *lines,
        *(
            table(*section.content)
            if isinstance(section.content, tuple)
            else section.content or ["none"]
        ),
    ]


def text_of(lines: Sequence[str], sections: Iterable[Section]) -> str:
    """Lay out lines and sections for a terminal."""
    return "\n".join(
        [
            *lines,
            *(line for section in sections for line in ("", *section_lines(section))),
        ]
    )


def section_text(section: Section) -> str:
    """Lay out a section for a terminal as a separate text, indented below the title."""
    title, *lines = section_lines(section)
    return f"{title}\n{indented(lines)}"


def html_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], sort: bool = False
) -> str:
    """Lay out a table that can be scrolled, sorted and filtered. Paper has the first rows."""
    rows = list(rows)
    cells = "".join(_cell(name, "th scope=col") for name in head)
    lines = ("".join(map(_cell, row)) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    paper = f'<p class="paper">On paper the first {LENGTHS.paper_rows} of {len(rows)} rows.</p>'
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="table">'
        f"<table{' class=sort' if sort else ''}><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"
        + (paper if len(rows) > LENGTHS.paper_rows else "")
    )


def escape(text: str) -> str:
    """Return a text from any source as safe HTML."""
    return html.escape(visible(text))


_BEFORE_UNIT = re.compile(r"(?<=\d) (?=(%|(m?rad|deg)/s|m/s\^2|k?Hz|m?s|h|deg)(?!\w))")
"""The blank between a number and its unit."""


def prose(text: str) -> str:
    """Return a text from any source as safe HTML in which no line ends between a number and its unit."""
    return _BEFORE_UNIT.sub("&nbsp;", escape(text))


class Link(str):
    """A text that links to another page. ``page``: relative path. Empty: no link."""

    page: str

    def __new__(cls, text: str, page: str) -> Link:
        """Return a text with the path of a page."""
        link = super().__new__(cls, text)
        link.page = page
        return link


def _cell(text: str, tag: str = "td") -> str:
    # Only sentences wrap, figures and names do not. Those of narrow tables do, but for percent.
    wraps = len(text) > 24
    content = prose(text) if wraps else escape(text).replace(" %", "&nbsp;%")
    if isinstance(text, Link) and text.page:
        content = f'<a href="{html.escape(quote(text.page))}">{content}</a>'
    return f"<{tag}{' class=long' if wraps else ''}>{content}</{tag[:2]}>"


def html_of(content: Content) -> str:
    """Lay out the content of a section."""
    if isinstance(content, str):
        return content
    if isinstance(content, tuple):
        return html_table(*content)
    if isinstance(content, list):
        return (
            "<ul>"
            + (
                "".join(f"<li>{prose(line)}</li>" for line in content)
                or "<li>None.</li>"
            )
            + "</ul>"
        )
    # On a narrow screen the entries are below each other.
    rows = (
        f'<tr><th scope="row">{escape(name)}</th><td>{prose(words)}</td></tr>'
        for name, words in content.items()
    )
    return f'<div class="scroll fold"><table class="about"><tbody>{"".join(rows)}</tbody></table></div>'


def page(
    title: str,
    summary: Sequence[str | Verdict],
    parts: Sequence[Part],
    stores: Sequence[PageStore] = (),
    origin: int | None = None,
) -> str:
    """Lay out a page.

    ``summary``: sentences at the top, verdicts in the colour of their severity. ``stores``: long
    series, which figures reference by ``packed``. ``origin``: time zero in UTC, ns. None: unknown.
    """
    links = "".join(
        f'<a href="#{_anchor(part)}">{escape(part.title)}</a>' for part in parts
    )
    body: list[str] = []
    figures: list[Mapping[str, Any]] = []
    for part in parts:
        drawn_part = _drawn_part(part, stores)
        body += _section(drawn_part, len(figures))
        figures += drawn_part.figures
    filled = {
        "TITLE": escape(title),
        "VERDICT": "".join(map(_summary_line, summary)),
        "CONTENTS": f'<nav aria-label="contents">{links}</nav>'
        if len(parts) >= 4
        else "",
        "BODY": "\n".join(line for line in body if line),
        "STYLE": _resource("page.css"),
        "DATA": _safe_json(
            {
                "figures": figures,
                "stores": [store.data() for store in stores],
                "origin": None
                if origin is None or date_of(origin) is None
                else origin // 1_000_000,
            }
        ),
        "SCRIPT": "".join(map(_resource, _SCRIPTS)),
    }
    # One pass, so that inserted text is not searched for placeholders.
    return re.sub(
        "<!--([A-Z]+)-->", lambda place: filled[place[1]], _resource("page.html")
    )


def _summary_line(line: str | Verdict) -> str:
    """Return one sentence at the top of the page."""
    if isinstance(line, Verdict):
        return f"<li class={line.severity.value}>{prose(line.words)}</li>"
    return f"<li>{prose(line)}</li>"


def _anchor(part: Part) -> str:
    """Return the name of a part in a link."""
    return re.sub("[^a-z0-9]+", "-", part.title.lower()).strip("-")


def _drawn_part(part: Part, stores: Sequence[PageStore]) -> Part:
    """Return a part without empty plots."""
    if isinstance(part, Section):
        return _speaking(part, stores)
    return Pair(*(one and _speaking(one, stores) for one in part))


def _speaking(section: Section, stores: Sequence[PageStore]) -> Section:
    """Return a section without empty plots. If no plot is left, a sentence states that."""
    figures = [
        figure
        for figure in section.figures
        if any(_draws(trace, stores) for trace in figure["data"])
    ]
    if len(figures) == len(section.figures):
        return section
    words = "" if figures else "Nothing to draw: there are no values."
    return replace(section, figures=figures, hint=f"{section.hint} {words}".strip())


def _draws(trace: Mapping[str, Any], stores: Sequence[PageStore]) -> bool:
    """Whether a trace has any value."""
    if "packed" in trace:
        name = trace["packed"]
        return any(name in store.kinds and store.shows(name) for store in stores)
    values = trace.get(
        {"band": "low", "spans": "row", "heatmap": "z"}.get(trace["type"], "y"), ()
    )
    return any(value is not None for value in values)


def _section(part: Part, number: int) -> list[str]:
    """Lay out a part with figures numbered from ``number``."""
    head = f"<h2>{escape(part.title)}</h2>" + (
        f'<p class="hint">{prose(part.hint)}</p>' if part.hint else ""
    )
    if isinstance(part, Section):
        content = html_of(part.content)
        rows = [_place(number + k) for k in range(len(part.figures))]
    else:
        content = _pair_row(html_of(one.content) if one else "" for one in part)
        numbers = iter(range(number, number + len(part.figures)))
        rows = [
            _pair_row("" if one is None else _place(next(numbers)) for one in row)
            for row in part.rows
        ]
    if not rows:
        return [f'<section id="{_anchor(part)}">{head}{content}</section>']
    # On paper the title stays with the first plot.
    first = f'<div class="keep">{head}<div class="legend"></div>{rows[0]}</div>'
    begin = f'<section id="{_anchor(part)}" class="plots">{first}'
    return [begin, *rows[1:], f"{content}</section>"]


def _place(number: int) -> str:
    """Return the place of a figure."""
    return f'<figure data-figure="{number}"><div class="stage" tabindex="0"></div></figure>'


def _pair_row(cells: Iterable[str]) -> str:
    """Return cells one beside the other, or nothing if all are empty."""
    row = "".join(f"<div>{cell}</div>" for cell in cells)
    return f'<div class="pair">{row}</div>' if row != "<div></div><div></div>" else ""


def time_layout(height: int, last: bool = True, **more: Any) -> dict[str, Any]:
    """Return the layout of a plot over time. Only the last of several plots has the axis."""
    axis: dict[str, Any] = {"title": {"text": TIME_AXIS}, "hidden": not last}
    return {"height": height + 30 * last, "link": "time", "xaxis": axis, **more}


def colour_of(channel: int) -> str:
    """Return the colour of a channel."""
    return CHANNEL_COLOURS[channel % len(CHANNEL_COLOURS)]


def drawn(value: float | None) -> float | None:
    """Return a value with four digits, or None if unknown or not finite."""
    return float(f"{value:.4g}") if value is not None and math.isfinite(value) else None


def _safe_json(data: Any) -> str:
    # Only a tag can end a script element.
    return json.dumps(_visible(data), separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )


def _visible(data: Any) -> Any:
    """Return figures of plain types, with control characters in texts escaped."""
    if isinstance(data, str):
        return visible(data)
    if isinstance(data, Mapping):
        return {visible(name): _visible(value) for name, value in data.items()}
    return (
        [_visible(value) for value in data] if isinstance(data, (list, tuple)) else data
    )


def _resource(name: str) -> str:
    return resources.files("fdi_ros.report").joinpath(name).read_text(encoding="utf-8")


# Series of any length in bounded memory


BYTES = 600_000
"""Largest size of the series of a page as text, bytes."""
FINE, SMALL = "f4", "f2"
"""Kinds of a series: 24 bits for values that are compared, 11 bits (0.05 %) for others."""


class PageStore:
    """Series over time in bounded memory: all samples, or the extremes of spans of samples.

    If spans become too many, neighbours are merged, and the next spans are twice as long.

    Parameters
    ----------
    kinds
        Name and kind of each of c series.
    most
        Largest number of spans, at least 2. Merged spans need two values each, so that half as many
        are kept. None: as many as a page can hold.
    """

    def __init__(self, kinds: Mapping[str, str], most: int | None = None) -> None:
        self.kinds = dict(kinds)
        size = 8 + sum(int(kind[1]) for kind in kinds.values())
        # base64 has 4 characters for 3 bytes.
        fitting = int(BYTES / (4 / 3) / size)
        self._most = most or max(200, fitting)
        self.width = 1
        """Number of samples in a new span."""
        self._time = np.empty(0)
        self._low = self._high = np.empty((0, len(kinds)))
        self._waiting = (np.empty(0), np.empty((0, len(kinds))))

    def add(self, time: Array, values: Array) -> None:
        """Add samples: time (N,), s, and values (N, c) of all series in order."""
        values = np.vstack(
            [self._waiting[1], np.where(np.isfinite(values), values, np.nan)]
        )
        time = np.concatenate([self._waiting[0], time])
        whole = len(time) // self.width * self.width
        self._waiting = time[whole:], values[whole:]
        if whole:
            self._store(
                time[: whole : self.width], values[:whole], values[:whole], self.width
            )
        while len(self._time) > (self._most if self.width == 1 else self._most // 2):
            time = self._time
            low = self._low
            high = self._high
            self._time = time[:0]
            self._low = low[:0]
            self._high = high[:0]
            even = len(time) // 2 * 2
            self._store(time[:even:2], low[:even], high[:even], 2)
            self._store(time[even:], low[even:], high[even:], 1)
            self.width *= 2

    def _store(self, time: Array, low: Array, high: Array, together: int) -> None:
        low, high = _extremes(low, high, together)
        self._time = np.concatenate([self._time, time])
        self._low = np.vstack([self._low, low])
        self._high = np.vstack([self._high, high])

    def spans(self) -> tuple[Array, Array, Array]:
        """Return the spans: time of the first sample (k,), smallest and largest values (k, c)."""
        time, values = self._waiting
        if len(time) == 0:
            return self._time, self._low, self._high
        low, high = _extremes(values, values, len(time))
        return (
            np.append(self._time, time[:1]),
            np.vstack([self._low, low]),
            np.vstack([self._high, high]),
        )

    def shows(self, name: str) -> bool:
        """Whether a series has any value."""
        lowest = self.spans()[1]
        values = lowest[:, list(self.kinds).index(name)]
        return bool(np.isfinite(values).any())

    def data(self) -> dict[str, Any]:
        """Return the series for the scripts of the page."""
        time, *extremes = self.spans()
        kept = extremes if self.width > 1 else extremes[:1]
        series = {
            name: (
                kind,
                _packed(np.column_stack([values[:, k] for values in kept]), kind),
            )
            for k, (name, kind) in enumerate(self.kinds.items())
        }
        return {"time": _packed(time, "f8"), "width": self.width, "series": series}


def _packed(values: Array, kind: str) -> str:
    if kind == SMALL:
        largest = float(np.finfo(np.float16).max)
        values = np.clip(values, -largest, largest)
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
    ).decode("ascii")


def _extremes(low: Array, high: Array, together: int) -> tuple[Array, Array]:
    """Return extremes of every ``together`` rows. NaN: all values are NaN."""
    shape = (-1, together, low.shape[1])
    return np.fmin.reduce(low.reshape(shape), axis=1), np.fmax.reduce(
        high.reshape(shape), axis=1
    )
