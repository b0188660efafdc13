# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file with the IMUs that failover left out of use: INS_USE outlives power and companion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fdi_ros.mavlink.failover.wrong import UNKNOWN, Wrong
from fdi_ros.mavlink.kept_file import KeptFile


class Saved(NamedTuple):
    """Content of the file."""

    system: int = 0  #: System id of the autopilot. 0: none yet.
    out: tuple[int, ...] = ()  #: IMUs out of use by our orders, from 0.
    booted: float = 0.0  #: Unix time at which the autopilot started, s.
    #: Time of the autopilot's start after that of this computer, s. NaN: unknown.
    after: float = math.nan
    computer: str = ""  #: Identity of that start of this computer. Empty: unknown.
    #: IMUs, out of use or not, that were out when the autopilot started.
    without_notch: tuple[int, ...] = ()
    bad: tuple[
        Mapping[str, Wrong], ...
    ] = ()  #: How each IMU of `out` was bad, by axis.

    @property
    def lasting(self) -> tuple[object, ...]:
        """What does not change from tick to tick."""
        return self.system, self.out, self.without_notch, self.bad


def _wrong(numbers: Any) -> Wrong:
    """Return how an axis was bad, of what `_numbers` made of it."""
    if numbers is None:
        return UNKNOWN
    rate, share = numbers
    wrong = Wrong(math.inf if rate is None else float(rate), float(share))
    if not (wrong.rate > 0.0 and 0.0 < wrong.share < math.inf):
        raise ValueError
    return wrong


def _numbers(wrong: Wrong) -> list[float | None] | None:
    """Return rate and share as JSON has them: an infinite rate is null, and so is `UNKNOWN`."""
    if wrong == UNKNOWN:
        return None
    rate = wrong.rate if math.isfinite(wrong.rate) else None
    return [rate, wrong.share]


class FailoverFile(KeptFile[Saved]):
    """Keeps which of the count IMUs of a vehicle are out of use."""

    name = "failover_file"
    unfit = "does not list the IMUs out of use"

    def __init__(self, path: Path, count: int) -> None:
        self._count = count
        super().__init__(path, Saved())

    def is_same(self, one: Saved, other: Saved) -> bool:
        """Return whether two contents differ at most in what changes from tick to tick."""
        return one.lasting == other.lasting

    def decode(self, found: Any) -> Saved:
        """Return the content of parsed JSON."""
        out = tuple(int(imu) - 1 for imu in found["out_of_use"])
        bare = tuple(int(imu) - 1 for imu in found.get("without_notch", ()))
        axes = tuple(map(str, found.get("bad_axes", ["xyz"] * len(out))))
        if not {*out, *bare} <= set(range(self._count)):
            raise ValueError
        if len(axes) != len(out) or not set("".join(axes)) <= set("xyz"):
            raise ValueError
        # Older files tell no more than the axes.
        errors = found.get("bad_errors", [dict.fromkeys(names) for names in axes])
        bad = tuple({axis: _wrong(one) for axis, one in by.items()} for by in errors)
        if list(map(set, bad)) != list(map(set, axes)):
            raise ValueError
        return Saved(
            system=int(found["system_id"]),
            out=out,
            booted=float(found.get("autopilot_booted", 0.0)),
            after=float(found.get("after_computer", math.nan)),
            computer=str(found.get("computer_boot", "")),
            without_notch=bare,
            bad=bad,
        )

    def encode(self, content: Saved) -> dict[str, Any]:
        """Return content as JSON is made of it."""
        found: dict[str, Any] = {
            "system_id": content.system,
            "out_of_use": [imu + 1 for imu in content.out],
            "autopilot_booted": round(content.booted, 1),
            "without_notch": [imu + 1 for imu in content.without_notch],
            "bad_axes": ["".join(by) for by in content.bad],
            "bad_errors": [
                {axis: _numbers(wrong) for axis, wrong in by.items()}
                for by in content.bad
            ],
        }
        if content.computer:
            found["after_computer"] = round(content.after, 1)
            found["computer_boot"] = content.computer
        return found
