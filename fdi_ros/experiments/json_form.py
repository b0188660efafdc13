# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results as JSON and back: the one place where dataclasses become plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints


def to_json(value: Any) -> Any:
    """Return a value in the types of JSON, None for what is not finite.

    A dataclass becomes an object of its fields, unless it has a method ``as_json`` that gives another form.
    """
    if hasattr(value, "as_json"):
        return to_json(value.as_json())
    if is_dataclass(value):
        return {field.name: to_json(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(name): to_json(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def from_json(kind: Any, value: Any) -> Any:
    """Return a value of a type from its JSON: dataclasses, lists, mappings and unions of these.

    Raises
    ------
    TypeError, ValueError, KeyError
        If the JSON is not of that type.
    """
    origin, inner = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        kind = next(
            (one for one in inner if isinstance(value, dict) and value.keys() == get_type_hints(one).keys()), None
        )
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{name: from_json(hints[name], item) for name, item in value.items()})
    if origin is list:
        return [from_json(inner[0], item) for item in value]
    if origin is dict:
        return {inner[0](name): from_json(inner[1], item) for name, item in value.items()}
    return value
