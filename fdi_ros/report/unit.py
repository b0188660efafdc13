# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""In what angular rates are printed: rad/s, as everywhere inside, or deg/s."""

from __future__ import annotations

import math
from typing import NamedTuple


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
