# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fields: of what type and within what range a value may be, declared once and checked in one way.

Parameters of the node, settings of a Monte-Carlo study and options of a fault are all fields. On a dataclass a field
is declared with `setting`; its type is the annotation.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from fdi_ros.errors import FdiError

Value = bool | int | float | str | tuple[float, ...] | tuple[str, ...]

REQUIRED = dataclasses.MISSING
"""Default of a field that must be given."""


@dataclass(frozen=True)
class Field:
    """What a value may be."""

    kind: str
    """One of: bool, int, float, text, numbers, texts; or another one, which its reader checks."""
    default: Any
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    """Of a text; empty: any text."""
    unit: str = ""
    description: str = ""
    runtime: bool = False
    """Of a parameter: whether it may be changed while the node runs."""
    per: str = ""
    """Of a list: channel or triad, for each of which it has `each` values; empty: it may be of any length."""
    each: int = 1
    other_lengths: tuple[int, ...] = ()
    """Lengths that such a list may have besides."""

    @property
    def unit_suffix(self) -> str:
        """The unit as it follows a number."""
        return f" {self.unit}" if self.unit else ""


def setting(
    default: Any,
    description: str,
    unit: str = "",
    low: float = -math.inf,
    high: float = math.inf,
    **about: Any,
) -> Any:
    """Declare a field of a dataclass; parameters as of `Field`."""
    metadata = {"description": description, "unit": unit, "low": low, "high": high, **about}
    return dataclasses.field(default=default, metadata=metadata)


_KINDS = {
    "bool": "bool",
    "int": "int",
    "float": "float",
    "float | None": "float",
    "str": "text",
    "tuple[float, ...]": "numbers",
    "tuple[str, ...]": "texts",
}
"""Annotations, as they are written."""


def fields_of(owner: Any) -> dict[str, Field]:
    """Fields of a dataclass that are declared with `setting`, by name."""
    declared = (field for field in dataclasses.fields(owner) if "description" in field.metadata)
    return {field.name: Field(_KINDS[str(field.type)], field.default, **field.metadata) for field in declared}


def check(field: Field, value: Any, name: str, error: type[FdiError]) -> Any:
    """Check a value and give it the type of its field.

    Parameters
    ----------
    field
        What it may be.
    value
        As given: a list may be given as its only item, a number as text (PyYAML reads 1e-3, without a point, as text;
        ROS reads it as the number it is).
    name
        The value is called this in errors.
    error
        Class of the errors.

    Raises
    ------
    FdiError
        Of that class, if the value is of another type or out of range.
    """
    if field.kind not in ("numbers", "texts"):
        return _check_one(field, field.kind, value, name, error)
    # ROS hands an empty array over as an empty byte array: it has no type of its own.
    items = list(value) if isinstance(value, (list, tuple)) or hasattr(value, "tolist") else [value]
    kind = "float" if field.kind == "numbers" else "text"
    return tuple(_check_one(field, kind, item, name, error) for item in items)


def check_length(field: Field, values: Any, count: int, name: str, error: type[FdiError]) -> None:
    """Check the length of a list that has values for each of count channels or triads; name and error as of `check`.

    Raises
    ------
    FdiError
        If it is none of those that the field allows.
    """
    lengths = (*field.other_lengths, field.each * count)
    if len(values) not in lengths:
        each = "one" if field.each == 1 else field.each
        expected = f"{' or '.join(map(str, lengths))} ({each} per {field.per})"
        raise error(f"{name} has {len(values)} values, expected {expected}")


_EXPECTED = {"bool": "true or false", "text": "a text", "float": "a number", "int": "a whole number"}


def _check_one(field: Field, kind: str, value: object, name: str, error: type[FdiError]) -> Any:
    if kind in ("int", "float"):
        number = _as_number(value)
        if number is not None:
            return _check_number(field, kind, number, name, error)
    elif isinstance(value, bool if kind == "bool" else str):
        if field.choices and value not in field.choices:
            raise error(f"{name} is {value!r}, expected one of: {', '.join(field.choices)}")
        return value
    raise error(f"{name} is {value!r}, expected {_EXPECTED[kind]}")


def _check_number(field: Field, kind: str, value: float, name: str, error: type[FdiError]) -> float:
    unit = field.unit_suffix
    if not field.low <= value <= field.high:
        raise error(f"{name} is {value:g}{unit}, expected {field.low:g} to {field.high:g}{unit}")
    if kind == "float":
        return float(value)
    if not float(value).is_integer():
        raise error(f"{name} is {value:g}{unit}, expected a whole number")
    return int(value)


def _as_number(value: object) -> float | None:
    """Return a number, or what a text says; None if it is none."""
    if isinstance(value, bool):
        return None
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return None
    return value if isinstance(value, (int, float)) else None
