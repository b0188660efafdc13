# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The file with the IMUs that failover left out of use: INS_USE outlives power and companion.

A thread writes, because a card may hold fsync for seconds, or for ever, while the link must
go on. One write is under way at most. A file that cannot be read or written ends nothing:
the vehicle may be in flight.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from threading import Thread
from typing import NamedTuple

from fdi_ros.errors import ConfigError
from fdi_ros.mavlink.protocol import NS
from fdi_ros.system.files import read_trusted, replacing

LARGEST_FILE = 4096  #: Largest file that is read, bytes.
RETRY = NS  #: Time between two attempts to write, ns.
HANGING = 2 * NS  #: A write that takes longer is announced, ns.
LONGEST_END = 5.0  #: Longest wait for a write at the end, s.
UNANSWERED = "is not saved: the disk does not answer"


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


class FailoverFile:
    """Reads and writes the file of a vehicle with count IMUs.

    A file that cannot be read counts as one that lists no IMU, and is written anew.
    """

    def __init__(self, path: Path, count: int) -> None:
        self._path = path
        self.written = Saved()  #: Content on the disk, as far as known.
        #: Why the file is not read or not written. Empty: it is.
        self.trouble = ""
        self._error = ""  # of the last write
        self._writer: Thread | None = None
        self._begun = 0  # when the last write began, ns. 0: in the constructor
        try:
            self.written = self._read(count)
            # That it can be written shows before the flight.
            self._begin(self.written)
        except ConfigError as error:
            self.trouble = self._error = str(error)
        self._wanted = self.written

    def keep(self, saved: Saved, now: int) -> str:
        """Write new content in another thread. Return an error that is new, or an empty text."""
        before = self.trouble
        self._wanted = saved
        self._begun = self._begun or now
        if not self._is_writing:
            self.trouble = self._error
            pause = RETRY if self.trouble else 0
            if (self.trouble or self._is_behind) and now - self._begun >= pause:
                self._begun = now
                self._begin(saved)
        elif now - self._begun >= HANGING:
            self.trouble = f"failover_file {self._path} {UNANSWERED}"
        return self.trouble if self.trouble != before else ""

    def close(self) -> None:
        """Write the last content, if that has not been done. Raise `ConfigError` if it fails."""
        self._wait()
        if self._is_behind and not self._is_writing:
            self._begin(self._wanted)
            self._wait()
        if self._is_behind:
            hangs = f"failover_file {self._path} {UNANSWERED}"
            raise ConfigError(hangs if self._is_writing else self._error)

    @property
    def _is_writing(self) -> bool:
        return self._writer is not None and self._writer.is_alive()

    @property
    def _is_behind(self) -> bool:
        return self._wanted.lasting != self.written.lasting

    def _begin(self, saved: Saved) -> None:
        """Begin to write in a thread that does not hold up the end of the process."""
        self._writer = Thread(target=self._write, args=(saved,), daemon=True)
        self._writer.start()

    def _wait(self) -> None:
        if self._writer is not None:
            self._writer.join(LONGEST_END)

    def _read(self, count: int) -> Saved:
        try:
            found = json.loads(read_trusted(self._path, LARGEST_FILE))
            out = tuple(int(imu) - 1 for imu in found["out_of_use"])
            bare = tuple(int(imu) - 1 for imu in found.get("without_notch", ()))
            axes = tuple(map(str, found.get("bad_axes", ["xyz"] * len(out))))
            if not {*out, *bare} <= set(range(count)):
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
        except FileNotFoundError:
            return Saved()
        except (
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            OverflowError,
            RecursionError,
        ) as error:
            raise ConfigError(
                f"failover_file {self._path} does not list the IMUs out of use"
            ) from error
        except OSError as error:
            raise ConfigError(
                f"failover_file {self._path}: {error.strerror}"
            ) from error

    def _write(self, saved: Saved) -> None:
        content: dict[str, object] = {
            "system_id": saved.system,
            "out_of_use": [imu + 1 for imu in saved.out],
            "autopilot_booted": round(saved.booted, 1),
            "without_notch": [imu + 1 for imu in saved.without_notch],
            "bad_axes": list(saved.axes),
        }
        if saved.computer:
            content["after_computer"] = round(saved.after, 1)
            content["computer_boot"] = saved.computer
        try:
            with replacing(self._path) as file:
                file.write(json.dumps(content).encode())
        except OSError as error:
            self._error = (
                f"failover_file {self._path} cannot be written: {error.strerror}"
            )
        else:
            self._error = ""
            self.written = saved
