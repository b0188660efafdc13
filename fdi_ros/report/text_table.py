# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables for a terminal, the numbers in the cells of all tables, and the unit of angular rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from fdi_ros.limits import LINE, WORD
from fdi_ros.text import shown


class Unit(NamedTuple):
    """A unit of angular rate."""

    name: str
    factor: float
    """Of it in one rad/s."""

    def words(self, value: float | None, digits: int = 6) -> str:
        """Return a rate, rad/s, in this unit, or a dash."""
        return "-" if value is None else f"{value * self.factor:.{digits}f} {self.name}"

    def named(self, text: str) -> str:
        """Return a title or the like that says rad/s with this unit instead."""
        return text.replace(RADIANS.name, self.name)

    def head(self, columns: tuple[str, ...]) -> tuple[str, ...]:
        """Return the heads of columns with this unit instead of rad/s."""
        return tuple(self.named(column) for column in columns)


RADIANS, DEGREES = Unit("rad/s", 1.0), Unit("deg/s", math.degrees(1.0))


def unit_of(degrees: bool) -> Unit:
    """Return the unit that was asked for."""
    return DEGREES if degrees else RADIANS


Columns = Mapping[str, Callable[[Any], str]]
"""Columns of a table by their heads: what each says of that which a row is about."""


def head_and_rows(columns: Columns, items: Iterable[Any]) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Lay out a row for each item: head and rows, as `table` and `page.html_table` take them."""
    return tuple(columns), [tuple(say(item) for say in columns.values()) for item in items]


def table(head: Sequence[str], rows: Iterable[Sequence[str]], figures: bool = True) -> list[str]:
    """Lay out rows of words in columns as wide as their widest entries.

    Parameters
    ----------
    head
        Names of the columns.
    rows
        Texts that may come from a file: what a terminal would obey is escaped.
    figures
        The columns after the first hold figures, which end below each other. Else all hold words, which begin below
        each other; long ones are shortened.

    Returns
    -------
    The lines.
    """
    most = LINE if figures else WORD
    lines = [tuple(head), *(tuple(shown(cell, most) for cell in row) for row in rows)]
    width = [max(len(line[k]) for line in lines) for k in range(len(head))]
    right = [figures and k > 0 for k in range(len(head))]
    return [
        "  ".join(
            cell.rjust(wide) if to_right else cell.ljust(wide)
            for cell, wide, to_right in zip(line, width, right, strict=True)
        ).rstrip()
        for line in lines
    ]


def indented(lines: Iterable[str]) -> str:
    """Return lines as one text, set in by two blanks."""
    return "".join(f"  {line}\n" for line in lines)


def number(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Return a number with a unit, or a dash."""
    return "-" if value is None else f"{value:.{digits}f}{unit}"


def milliseconds(seconds: float | None) -> str:
    """Return a time, s, in ms, or a dash."""
    return "-" if seconds is None else f"{1000 * seconds:.1f} ms"
