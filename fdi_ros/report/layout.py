# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pages in one HTML file that need nothing else (no network, no other file, no library), and tables for a terminal.

The plots are drawn in the browser by the scripts beside this file. A figure is a mapping of ``data`` and ``layout`` in
the form of plotly's figures, of which the scripts draw:

- traces ``scatter`` (x, y, mode, name, line, legendgroup, showlegend, and ``rank`` in the legend), ``heatmap``,
  ``scatter3d`` (lines);
- axes with title, type ``log``, range; shapes ``rect`` over all y; height;

and beyond that: traces ``band`` (x, low, high) and ``spans`` (row, from, to, text, pattern); series of a `PageStore`
(``packed``, with ``plus`` or ``spread``); layout ``title``; ``link`` (plots of one name share zoom and cursor),
``scale`` (plots of one name share the scale of values), ``robust`` (what shows only for a short time does not set the
scale), ``needed`` (times that must be within it), ``marks`` (x, kind, text, ``label``), ``rows`` of spans.
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
from typing import Any, NamedTuple
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from fdi_ros.model.samples import Array
from fdi_ros.system.text import LINE, WORD, date_of, shown, visible


class Severity(Enum):
    """How bad a verdict is; the value is its class on a page."""

    GOOD = "good"  # nothing to do
    UNKNOWN = "unknown"  # the data do not tell, or not enough
    BAD = "bad"  # somebody must act

    @property
    def exit_code(self) -> int:
        """Of a verb that ends with such a verdict; 1 is an unmet ``--check``, 2 a request that is wrong."""
        return {Severity.GOOD: 0, Severity.UNKNOWN: 4, Severity.BAD: 3}[self]


class Verdict(NamedTuple):
    """One line, and how bad it is."""

    severity: Severity
    words: str  # begins with the word of the verdict in capitals: ``HEALTHY: ...``


class Unit(NamedTuple):
    """A unit of angular rate."""

    name: str
    factor: float  #: of it in one rad/s

    def words(self, value: float | None, digits: int = 6) -> str:
        """Return a rate, rad/s, in this unit, or a dash."""
        return "-" if value is None else f"{value * self.factor:.{digits}f} {self.name}"

    def named(self, text: str) -> str:
        """Return a title or the like that says rad/s with this unit instead."""
        return text.replace(RADIANS.name, self.name)


RADIANS, DEGREES = Unit("rad/s", 1.0), Unit("deg/s", math.degrees(1.0))
FORCES = Unit("m/s^2", 1.0)  # of accelerometers, whatever unit rates are printed in


def unit_of(degrees: bool) -> Unit:
    """Return the unit that was asked for."""
    return DEGREES if degrees else RADIANS


Rows = tuple[
    Sequence[str], Sequence[Sequence[str]]
]  # head and rows of a table, as `table` and `html_table` take them
Columns = Mapping[str, Callable[[Any], str]]
"""Columns of a table by their heads: what each says of that which a row is about."""


def head_and_rows(columns: Columns, items: Iterable[Any]) -> Rows:
    """Lay out a row for each item."""
    return tuple(columns), [
        tuple(say(item) for say in columns.values()) for item in items
    ]


class Column(NamedTuple):
    """A figure of all that a table has rows of: by name for programs, in SI units, and in words for people."""

    name: str  #: empty: for people alone
    values: (
        Sequence[Any] | NDArray[Any]
    )  #: one for each row; of several heads one for each of them
    heads: Sequence[str] = ()  #: empty: for programs alone
    say: str | Callable[[Any], str] = (
        ""  #: words of a value, or the format that makes them
    )
    factor: float = 1.0  #: of what people are told over the SI unit


def figures_of(columns: Iterable[Column]) -> list[dict[str, Any]]:
    """Return a row for each item, for programs: its figures by name."""
    named = [column for column in columns if column.name]
    rows = zip(*(column.values for column in named), strict=True)
    return [
        dict(zip((column.name for column in named), row, strict=True)) for row in rows
    ]


def told(columns: Iterable[Column], unit: Unit = RADIANS) -> Rows:
    """Lay out a row for each item, for people, with this unit in the heads."""
    shown_ones, cells = [column for column in columns if column.heads], []
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


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], figures: bool = True
) -> list[str]:
    """Lay out lines of words in columns as wide as their widest entries; what a terminal would obey is escaped.

    ``figures``: the columns after the first hold figures, which end below each other. Else all hold words, which begin
    below each other; long ones are shortened.
    """
    most = LINE if figures else WORD
    lines = [tuple(head), *(tuple(shown(cell, most) for cell in row) for row in rows)]
    width = [max(map(len, column)) for column in zip(*lines, strict=True)]
    form = "  ".join(
        f"{{:{'>' if figures and k else '<'}{wide}}}" for k, wide in enumerate(width)
    )
    return [form.format(*line).rstrip() for line in lines]


def indented(lines: Iterable[str]) -> str:
    """Return lines as one text, set in by two blanks."""
    return "".join(f"  {line}\n" for line in lines)


def number(value: float | None, form: str = ".3f", unit: str = "") -> str:
    """Return a number with a unit, or a dash where it is not known, or not finite."""
    return "-" if value is None or not math.isfinite(value) else f"{value:{form}}{unit}"


def milliseconds(seconds: float | None) -> str:
    """Return a time, s, in ms, or a dash."""
    return "-" if seconds is None else f"{1000 * seconds:.1f} ms"


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
"""Colours that differ for colour-blind people too (after Okabe and Ito)."""
CHANNEL_COLOURS = (
    *PALETTE,
    "#9a4dff",
    "#e20134",
    "#00b4a0",
)  # as many as there may be channels
LONG = 24  # characters from which on the text of a cell may go on in a second line
TERMINAL = 110  # characters in a line of sentences
PAPER_ROWS = 60  # of a table, as page.css has it
FEWEST_LINKED = 4  # sections from which on a page has a table of contents
TIME_AXIS = "s from the first sample"
_SCRIPTS = (
    "plot_data.js",
    "plot_scale.js",
    "plot_chart.js",
    "plot_other.js",
    "table.js",
    "page.js",
)


Figure = dict[str, Any]
"""Traces under ``data``, axes and the like under ``layout``: JSON for the scripts, as described above."""


Content = str | Rows | list[str] | Mapping[str, str]
"""What a section tells beside its plots: HTML; or a table, sentences, names with what they stand for."""


@dataclass(frozen=True)
class Section:
    """One part of a page."""

    title: str
    hint: str = ""
    content: Content = ""
    figures: Sequence[Mapping[str, Any]] = field(
        default_factory=tuple
    )  #: each a `Figure`


def section_lines(section: Section) -> list[str]:
    """Lay out a section for a terminal, without its plots; its content is a table or sentences."""
    lines = [section.title, *textwrap.wrap(section.hint, TERMINAL)]
    return [
        *lines,
        *(
            table(*section.content)
            if isinstance(section.content, tuple)
            else section.content or ["none"]
        ),
    ]


def text_of(lines: Sequence[str], sections: Iterable[Section]) -> str:
    """Lay out lines, and sections below them, for a terminal."""
    return "\n".join(
        [
            *lines,
            *(line for section in sections for line in ("", *section_lines(section))),
        ]
    )


def section_text(section: Section) -> str:
    """Lay out a section for a terminal as a text of its own: what is below the title is set in."""
    title, *lines = section_lines(section)
    return f"{title}\n{indented(lines)}"


def html_table(
    head: Sequence[str], rows: Iterable[Sequence[str]], sort: bool = False
) -> str:
    """Lay out a table that scrolls by itself; on paper it has the first rows; a reader may sort and filter it."""
    rows = list(rows)
    cells = "".join(_cell(name, "th scope=col") for name in head)
    body = "".join("<tr>" + "".join(map(_cell, row)) + "</tr>" for row in rows)
    paper = f'<p class="paper">On paper the first {PAPER_ROWS} of {len(rows)} rows.</p>'
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="table">'
        f"<table{' class=sort' if sort else ''}><thead><tr>{cells}</tr></thead><tbody>{body}</tbody></table></div>"
        + (paper if len(rows) > PAPER_ROWS else "")
    )


def escape(text: str) -> str:
    """Return a text, which may come from a file, as HTML that shows it."""
    return html.escape(visible(text))


class Link(str):
    """A text that leads to another page; `page` is its path from this one, empty: none."""

    page: str

    def __new__(cls, text: str, page: str) -> Link:
        """Return a text with the path of a page."""
        link = super().__new__(cls, text)
        link.page = page
        return link


def _cell(text: str, tag: str = "td") -> str:
    # Figures and names are not broken over lines; sentences are.
    content = escape(text)
    if isinstance(text, Link) and text.page:
        content = f'<a href="{html.escape(quote(text.page))}">{content}</a>'
    return f"<{tag}{' class=long' if len(text) > LONG else ''}>{content}</{tag[:2]}>"


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
                "".join(f"<li>{escape(line)}</li>" for line in content)
                or "<li>None.</li>"
            )
            + "</ul>"
        )
    # On a narrow screen one below the other.
    rows = (
        f'<tr><th scope="row">{escape(name)}</th><td>{escape(words)}</td></tr>'
        for name, words in content.items()
    )
    return f'<div class="scroll fold"><table class="about"><tbody>{"".join(rows)}</tbody></table></div>'


def page(
    title: str,
    summary: Sequence[str],
    sections: Sequence[Section],
    store: PageStore | None = None,
    severity: Severity | None = None,
    origin: int | None = None,
) -> str:
    """Lay out a page.

    ``summary``: sentences at the top, of which the first is the verdict, in the colour of its ``severity`` (None: there
    is no verdict). ``store`` holds the long series that figures name by ``packed``. ``origin``: UTC that times count
    from, ns; None: not known.
    """
    looks = [
        "" if severity is None else f" class={severity.value}",
        *[""] * len(summary),
    ]
    links = "".join(
        f'<a href="#{_anchor(section)}">{escape(section.title)}</a>'
        for section in sections
    )
    body: list[str] = []
    figures: list[Mapping[str, Any]] = []
    for section in (_speaking(section, store) for section in sections):
        body += _section(section, len(figures))
        figures += section.figures
    parts = {
        "TITLE": escape(title),
        "VERDICT": "".join(
            f"<li{look}>{escape(line)}</li>"
            for look, line in zip(looks, summary, strict=False)
        ),
        "CONTENTS": f'<nav aria-label="contents">{links}</nav>'
        if len(sections) >= FEWEST_LINKED
        else "",
        "BODY": "\n".join(part for part in body if part),
        "STYLE": _resource("page.css"),
        "DATA": _safe_json(
            {
                "figures": figures,
                "store": None if store is None else store.data(),
                "origin": None
                if origin is None or date_of(origin) is None
                else origin // 1_000_000,
            }
        ),
        "SCRIPT": "".join(map(_resource, _SCRIPTS)),
    }
    # In one pass: what is put in is not searched for places.
    return re.sub(
        "<!--([A-Z]+)-->", lambda place: parts[place[1]], _resource("page.html")
    )


def _anchor(section: Section) -> str:
    """Name of a section in a link."""
    return re.sub("[^a-z0-9]+", "-", section.title.lower()).strip("-")


def _speaking(section: Section, store: PageStore | None) -> Section:
    """Return a section without the plots in which nothing would be drawn; if none is left, it says so."""
    figures = [
        figure
        for figure in section.figures
        if any(_draws(trace, store) for trace in figure["data"])
    ]
    if len(figures) == len(section.figures):
        return section
    words = "" if figures else "Nothing to draw: there are no values."
    return replace(section, figures=figures, hint=f"{section.hint} {words}".strip())


def _draws(trace: Mapping[str, Any], store: PageStore | None) -> bool:
    """Whether a trace has any value."""
    if "packed" in trace:
        return store is not None and store.shows(trace["packed"])
    values = trace.get(
        {"band": "low", "spans": "row", "heatmap": "z"}.get(trace["type"], "y"), ()
    )
    return any(value is not None for value in values)


def _section(section: Section, number: int) -> list[str]:
    """Lay out a section; its figures are numbered from `number`."""
    head = f"<h2>{escape(section.title)}</h2>" + (
        f'<p class="hint">{escape(section.hint)}</p>' if section.hint else ""
    )
    if not section.figures:
        return [
            f'<section id="{_anchor(section)}">{head}{html_of(section.content)}</section>'
        ]
    numbers = range(number, number + len(section.figures))
    places = [
        f'<figure data-figure="{k}"><div class="stage" tabindex="0"></div></figure>'
        for k in numbers
    ]
    # On paper the head stays with the first plot.
    first = f'<div class="keep">{head}<div class="legend"></div>{places[0]}</div>'
    begin, end = (
        f'<section id="{_anchor(section)}" class="plots">{first}',
        f"{html_of(section.content)}</section>",
    )
    return [begin, *places[1:], end]


def time_layout(height: int, last: bool = True, **more: Any) -> dict[str, Any]:
    """Layout of a plot over time, linked with all others; of plots below each other the last has the axis."""
    axis: dict[str, Any] = {"title": {"text": TIME_AXIS}, "hidden": not last}
    return {"height": height + 30 * last, "link": "time", "xaxis": axis, **more}


def colour_of(channel: int) -> str:
    """Return the colour of a channel."""
    return CHANNEL_COLOURS[channel % len(CHANNEL_COLOURS)]


def drawn(value: float | None) -> float | None:
    """Return a value as a figure has it: to four digits, None where it is not known, or not finite."""
    return float(f"{value:.4g}") if value is not None and math.isfinite(value) else None


def _safe_json(data: Any) -> str:
    # Within a script element the only thing that could end it is a tag.
    return json.dumps(_visible(data), separators=(",", ":"), allow_nan=False).replace(
        "<", "\\u003c"
    )


def _visible(data: Any) -> Any:
    """Return figures, of plain types, with texts that a browser shows as they are."""
    if isinstance(data, str):
        return visible(data)
    if isinstance(data, Mapping):
        return {visible(name): _visible(value) for name, value in data.items()}
    return (
        [_visible(value) for value in data] if isinstance(data, (list, tuple)) else data
    )


def _resource(name: str) -> str:
    return resources.files("fdi_ros.report").joinpath(name).read_text(encoding="utf-8")


# Series of any length, made small: few bytes per value, and no more values than a page may have ----------------------


BYTES = 600_000  # text that the series of a page may take
FINE, SMALL = "f4", "f2"
"""Kinds of a series: 24 bits, for values that are looked at against each other; 11 bits, 0.05 % of the value."""
LARGEST_HALF = 65504.0
_TEXT = 4 / 3  # characters of base64 per byte


class PageStore:
    """Series over one time, of which a page keeps all samples, or the extremes of spans of samples; memory is bounded.

    When there are too many spans, neighbours are put together and the next spans are twice as long. ``kinds``: name and
    kind of each of c series. ``most``: spans that are kept, 2 or more, half of them once samples are put together (a
    span of several samples is two values); None: as many as a page may hold.
    """

    def __init__(self, kinds: Mapping[str, str], most: int | None = None) -> None:
        self.kinds = dict(kinds)
        size = 8 + sum(int(kind[1]) for kind in kinds.values())
        self._most = most or max(200, int(BYTES / _TEXT / size))
        self.width = 1  # samples in a new span
        self._time = np.empty(0)
        self._low = self._high = np.empty((0, len(kinds)))
        self._waiting = (np.empty(0), np.empty((0, len(kinds))))

    def add(self, time: Array, values: Array) -> None:
        """Take in the next samples: time (N,) s, values (N, c) of every series in order."""
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
            time, low, high = self._time, self._low, self._high
            self._time, self._low, self._high = time[:0], low[:0], high[:0]
            even = len(time) // 2 * 2
            self._store(time[:even:2], low[:even], high[:even], 2)
            self._store(time[even:], low[even:], high[even:], 1)
            self.width *= 2

    def _store(self, time: Array, low: Array, high: Array, together: int) -> None:
        low, high = _extremes(low, high, together)
        self._time = np.concatenate([self._time, time])
        self._low, self._high = (
            np.vstack([self._low, low]),
            np.vstack([self._high, high]),
        )

    def spans(self) -> tuple[Array, Array, Array]:
        """Return what there is: time of the first sample (k,), smallest and largest values (k, c)."""
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
        return bool(np.isfinite(self.spans()[1][:, list(self.kinds).index(name)]).any())

    def data(self) -> dict[str, Any]:
        """Return what the page's script reads."""
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
        values = np.clip(values, -LARGEST_HALF, LARGEST_HALF)
    return base64.b64encode(
        np.ascontiguousarray(values, dtype=f"<{kind}").tobytes()
    ).decode("ascii")


def _extremes(low: Array, high: Array, together: int) -> tuple[Array, Array]:
    """Smallest and largest of every `together` rows; NaN only where all are."""
    shape = (-1, together, low.shape[1])
    return np.fmin.reduce(low.reshape(shape), axis=1), np.fmax.reduce(
        high.reshape(shape), axis=1
    )
