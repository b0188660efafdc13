# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Records of fixed size: classes whose annotated fields are a NumPy structured type.

A field is declared as one line, ``name: Real  # unit, meaning``. A type checker sees plain numbers, arrays and other
records; `record` makes the NumPy dtype of the same layout. Records nest, and lists of records are arrays of them.
"""

from __future__ import annotations

import typing
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

MAX_CHANNELS = 12
MAX_UNITS = 4

Real = Annotated[float, "f8"]
Whole = Annotated[int, "i8"]
Mask = Annotated[int, "i8"]
"""A set of channels, one bit each."""
Small = Annotated[int, "u1"]
Flag = Annotated[bool, "u1"]
Vector = Annotated[NDArray[np.float64], "f8", (3,)]
Channels = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS,)]
Axes = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS, 3)]
Square = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS, MAX_CHANNELS)]
Symmetric = Annotated[NDArray[np.float64], "f8", (6,)]
"""Upper triangle of a symmetric (3, 3) matrix: xx, xy, xz, yy, yz, zz."""
Units = Annotated[NDArray[np.float64], "f8", (MAX_UNITS,)]
Stamps = Annotated[NDArray[np.int64], "i8", (MAX_CHANNELS,)]
Counts = Annotated[NDArray[np.int64], "i8", (MAX_CHANNELS,)]
Flags = Annotated[NDArray[np.uint8], "u1", (MAX_CHANNELS,)]

T = TypeVar("T")


def record(kind: type[T]) -> type[T]:
    """Give a class of annotated fields the attribute `dtype`, the NumPy type of the same fields."""
    hints = typing.get_type_hints(kind, include_extras=True)
    taken = hints.keys() & set(dir(np.record))
    if taken:
        # In plain Python a record is an np.record: a field may not hide behind an attribute of it.
        raise TypeError(f"{kind.__name__} has fields named like attributes of np.record: {', '.join(sorted(taken))}")
    layout = [_field(name, hint) for name, hint in hints.items()]
    kind.dtype = np.dtype(layout, align=True)  # type: ignore[attr-defined]
    return kind


def is_record(kind: type) -> bool:
    """Whether a class is a record."""
    return isinstance(getattr(kind, "dtype", None), np.dtype)


def _field(name: str, hint: Any) -> tuple[Any, ...]:
    if is_record(hint):
        return (name, hint.dtype)
    about = hint.__metadata__
    if isinstance(about[0], str):
        return (name, *about)
    # A list of records of a fixed length.
    (element,) = typing.get_args(hint.__origin__)
    return (name, element.dtype, about)
