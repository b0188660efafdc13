# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file with the IMUs that failover left out of use: INS_USE outlives power and companion."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

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
    axes: tuple[str, ...] = ()  #: Axes on which each IMU of `out` was bad, such as xy.

    @property
    def lasting(self) -> tuple[object, ...]:
        """What does not change from tick to tick."""
        return self.system, self.out, self.without_notch, self.axes


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
        return Saved(
            system=int(found["system_id"]),
            out=out,
            booted=float(found.get("autopilot_booted", 0.0)),
            after=float(found.get("after_computer", math.nan)),
            computer=str(found.get("computer_boot", "")),
            without_notch=bare,
            axes=axes,
        )

    def encode(self, content: Saved) -> dict[str, Any]:
        """Return content as JSON is made of it."""
        found: dict[str, Any] = {
            "system_id": content.system,
            "out_of_use": [imu + 1 for imu in content.out],
            "autopilot_booted": round(content.booted, 1),
            "without_notch": [imu + 1 for imu in content.without_notch],
            "bad_axes": list(content.axes),
        }
        if content.computer:
            found["after_computer"] = round(content.after, 1)
            found["computer_boot"] = content.computer
        return found
