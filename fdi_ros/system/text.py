# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Text from outside, and dates, made fit to be shown: on a terminal, on a page, in a comment of a file."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from datetime import datetime, timezone

from fdi_ros.system.files import EARLIEST, LATEST

WORD, LINE = (
    120,
    4000,
)  # characters of a text from a file, and of a whole line with such texts, that are shown


def shown(text: object, most: int = WORD) -> str:
    r"""Return a text on one line, shortened, with nothing in it that a terminal obeys.

    Escape codes, line breaks, invisible characters and those that turn the direction of writing are written as
    ``\x1b``, ``\n``, ``\u202e``.
    """
    text = str(text)
    if len(text) > most:
        text = f"{text[: most - 3]}..."
    return visible(text, "")


def visible(text: str, kept: str = "\n\t") -> str:
    """Return a text of any length with nothing in it that a terminal or browser obeys, but for some characters."""
    if text.isprintable():
        return text
    return "".join(
        c
        if c.isprintable() or c in kept
        else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def plus_minus(value: float, std: float) -> str:
    """Write a value with its standard error to its first figure, to two where that is 1: `0.10 +- 0.03`."""
    if not math.isfinite(std) or std <= 0.0:
        return f"{value:.3g}"
    exponent = math.floor(math.log10(std))
    places = max(0, min(9, (1 if std < 2 * 10**exponent else 0) - exponent))
    return f"{value:.{places}f} +- {std:.{places}f}"


def html_table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[object]]
) -> str:
    """Return a table as a notebook shows it."""

    def line(cells: Iterable[object], tag: str) -> str:
        return f"<tr>{''.join(f'<{tag}>{html.escape(shown(cell, LINE))}</{tag}>' for cell in cells)}</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<table><caption>{html.escape(shown(caption, LINE))}</caption>{line(head, 'th')}{body}</table>"


def storable(text: str) -> str:
    r"""Return a text as Unicode: bytes of a name that are none, which Python keeps as surrogates, become ``\udcff``."""
    return text.encode("utf-8", "backslashreplace").decode()


def date_of(ns: int) -> datetime | None:
    """Return the date of a stamp, UTC; None: it counts from the start of an autopilot or of a simulation."""
    return (
        datetime.fromtimestamp(ns * 1e-9, timezone.utc)
        if EARLIEST <= ns <= LATEST
        else None
    )
