# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Foreign text and dates, made safe for a terminal, a page or a comment in a file."""

from __future__ import annotations

import difflib
import html
import math
import re
from collections.abc import Collection, Iterable, Sequence
from datetime import datetime, timezone

from fdi_ros.system.files import TIMES

#: choices that are listed beside the closest one
MOST_CHOICES = 30
#: characters of a text from a file, and of a whole line with such texts, that are shown
WORD, LINE = (
    120,
    4000,
)

#: numbers from this size on are written without an exponent
LEAST_IN_FULL = 1e-9


def shown(text: object, most: int = WORD) -> str:
    r"""Return a short single-line text without characters that control a terminal.

    Escape codes, line breaks, invisible characters and changes of the writing direction
    appear as ``\x1b``, ``\n``, ``\u202e``.
    """
    text = str(text)
    if len(text) > most:
        text = f"{text[: most - 3]}..."
    return visible(text, "")


def visible(text: str, kept: str = "\n\t") -> str:
    """Escape all control characters of a text, except those kept."""
    if text.isprintable():
        return text
    return "".join(
        c
        if c.isprintable() or c in kept
        else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def listed(words: Sequence[str], last: str = "and") -> str:
    """Join words as a sentence lists them: ``a, b and c``."""
    before = ", ".join(words[:-1])
    return f" {last} ".join(filter(None, [before, words[-1]]))


_NUMBER = re.compile(r"([A-Za-z]*)_?([0-9]+)")
LONGEST_NUMBER = 9
"""Digits of a number that may tell names apart; longer ones are serial numbers."""


def own_numbers(names: Sequence[str], words: Collection[str] = ()) -> list[int]:
    """Return the first number of each name that tells all names apart, or nothing.

    The word before it is the same in all names, and one of ``words`` if any are given:
    ``/imu_4/data`` and ``/imu_5/data`` give 4 and 5.
    """
    found = [_NUMBER.findall(name) for name in names]
    for numbered in zip(*found, strict=False):
        before = {word.lower() for word, _ in numbered}
        numbers = [
            int(digits) for _, digits in numbered if len(digits) <= LONGEST_NUMBER
        ]
        same = len(before) == 1 and (not words or before <= set(words))
        if same and len(set(numbers)) == len(names):
            return numbers
    return []


def first_of(
    words: Sequence[str], most: int, between: str = ", ", last: str = " and"
) -> str:
    """Return the first of some words, and how many more there are."""
    return between.join(words[:most]) + (
        f"{last} {len(words) - most} more" if len(words) > most else ""
    )


def did_you_mean(word: str, choices: Sequence[str]) -> str:
    """Return a hint for a word that is none of the choices: the closest one, and a short list."""
    # Comparing very long words takes long and cannot succeed.
    # The dashes of options make all options alike.
    plain = {choice.lstrip("-"): choice for choice in choices}
    short = word.lstrip("-") if len(word) <= WORD else ""
    close = [plain[one] for one in difflib.get_close_matches(short, plain, n=1)]
    # Which other number was meant, nobody can guess.
    other_number = close and _without_digits(word) == _without_digits(close[0])
    hint = f"did you mean {close[0]!r}?" if close and not other_number else ""
    if hint and len(choices) > MOST_CHOICES:
        return hint
    known = f"expected one of: {', '.join(choices) or 'none'}"
    return f"{hint} {known[0].upper()}{known[1:]}" if hint else known


def _without_digits(word: str) -> str:
    return "".join(letter for letter in word if not letter.isdigit())


def figures(value: float, digits: int = 3, sign: str = "") -> str:
    """Write a number with some significant digits, and without an exponent down to 1e-9.

    ``1250``, not ``1.2e+03``; ``0.000015``, not ``1.5e-05``.
    ``sign``: ``+`` writes the sign of positive numbers too.
    """
    text = f"{value:{sign}.{digits}g}"
    if "e+" in text:
        return f"{value:{sign}.0f}"
    if "e-" in text and abs(value) >= LEAST_IN_FULL:
        places = digits - 1 - math.floor(math.log10(abs(value)))
        return f"{value:{sign}.{places}f}".rstrip("0")
    return text


def percent(share: float | None) -> str:
    """Write a share in percent, or a dash: ``51 %``, ``0.4 %``, ``99.7 %``.

    Only none and all are ``0 %`` and ``100 %``.
    """
    if share is None or not math.isfinite(share):
        return "-"
    value = 100.0 * share
    from_end = min(value, 100.0 - value)
    if not 1e-9 < from_end <= 0.5:
        return f"{value:.0f} %"
    if from_end < 0.01:
        return "below 0.01 %" if value < 50.0 else "above 99.99 %"
    return f"{value:.{1 if from_end >= 0.1 else 2}f} %"


def span(low: float, high: float, form: str) -> str:
    """Write a range, or one number if both ends read alike: ``28 to 35``."""
    first, last = f"{low:{form}}", f"{high:{form}}"
    return first if first == last else f"{first} to {last}"


def plus_minus(value: float, std: float) -> str:
    """Write a value with its standard error, rounded to the error: `0.10 +- 0.03`."""
    if not math.isfinite(std) or std <= 0.0:
        return figures(value)
    exponent = math.floor(math.log10(std))
    further = 1 if std < 2 * 10**exponent else 0
    places = max(0, min(9, further - exponent))
    return f"{value:.{places}f} +- {std:.{places}f}"


def html_table(
    caption: str, head: Sequence[str], rows: Iterable[Sequence[object]]
) -> str:
    """Return an HTML table for a notebook."""

    def line(cells: Iterable[object], tag: str) -> str:
        texts = [html.escape(shown(cell, LINE)) for cell in cells]
        cells_there = "".join(f"<{tag}>{text}</{tag}>" for text in texts)
        return f"<tr>{cells_there}</tr>"

    body = "".join(line(row, "td") for row in rows)
    return f"<table><caption>{html.escape(shown(caption, LINE))}</caption>{line(head, 'th')}{body}</table>"


def storable(text: str) -> str:
    r"""Return valid Unicode: surrogates, as in names of files, become ``\udcff``."""
    return text.encode("utf-8", "backslashreplace").decode()


def date_of(ns: int) -> datetime | None:
    """Return the date of a stamp, UTC, None if the stamp counts from the start of a system."""
    return (
        datetime.fromtimestamp(ns * 1e-9, timezone.utc)
        if TIMES.earliest <= ns <= TIMES.latest
        else None
    )
