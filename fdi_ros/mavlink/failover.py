# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failover of ArduPilot: what its parameters and the monitor say goes to the policy, and what that decides is done.

INS_USE, INS_USE2, INS_USE3 outlive the autopilot's power, so what is out of use by our hand stands in a file. It is
written right after the parameter is sent: the disk may take longer than the vehicle has. `failover_text` asks the same
policy about a recorded flight.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from fdi_ros.core.states import ChannelState
from fdi_ros.errors import ConfigError
from fdi_ros.mavlink.clock import MS, NS
from fdi_ros.mavlink.failover_policy import HEALED, YOUNG, FailoverState, FailoverUnit, Known, decide, objection
from fdi_ros.mavlink.imu import ARDUPILOT
from fdi_ros.mavlink.report import CRITICAL, INFO, LENGTH, WARNING
from fdi_ros.mavlink.vehicle import Vehicle
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.system.files import read_trusted, replacing

PARAMETERS = ("INS_USE", "INS_USE2", "INS_USE3")
OUT = {ChannelState.FAULTY, ChannelState.STALE, ChannelState.EXCLUDED}
"""States of a channel that is not used at all; under doubt for a moment are also healthy ones."""
_STEP = 20 * MS  # the policy is asked so often while a declaration is young, ns
_BEFORE = NS + HEALED  # time of the policy at the start of a recording, ns
READ_EVERY, FORGOTTEN = NS // 2, 10 * NS
"""Parameters are read in turn so often, ns; what was said longer ago counts as not known."""
SILENT, ABSENT = NS // 2, 5 * NS
"""A monitor without a sample, or without a report, for so long is silent, ns; and an IMU without a sample."""
TEXTS = {
    "out": (CRITICAL, "out of use"),
    "back": (INFO, "in use again"),
    "not out": (CRITICAL, "out of use: not accepted"),
    "not back": (CRITICAL, "back in use: not accepted"),
    "changed": (WARNING, "set by others, left alone"),
    "stays": (CRITICAL, "stays: "),
}
"""Severity and words, by the kind of action."""
LARGEST = 4096  # bytes of the file, at most


def format_imu(unit: int, channels: Sequence[str]) -> str:
    """Name an IMU, from 0, as the autopilot counts it and as the topics name it: ``IMU 1 (imu_0)``."""
    name = channels[3 * unit].rpartition(".")[0]
    return f"IMU {unit + 1} ({name})" if name else f"IMU {unit + 1}"


class Declarations:
    """What a monitor says of some IMUs, three channels each, and since when."""

    def __init__(self, count: int) -> None:
        self.heard = 0  # when the monitor was heard last, ns
        self.begun = 0  # since when it has been heard without a break, ns
        self.channels: list[int | None] = [None] * (3 * count)  # when each that is FAULTY by name was declared, ns
        self._ok = [False] * count
        self._well: list[int | None] = [None] * count

    def hear(self, states: Sequence[float], now: int) -> None:
        """Take the states of all channels, numbers of `ChannelState`, at a time, ns."""
        # What was declared while nobody listened is of unknown age.
        declared = now
        if now - self.heard >= YOUNG:
            declared, self.begun, self._well = now - 2 * YOUNG, now, [None] * len(self._well)
        self.heard = now
        for i, state in enumerate(states):
            self.channels[i] = (self.channels[i] or declared) if state == ChannelState.FAULTY else None
        for k in range(len(self._ok)):
            unit = set(states[3 * k : 3 * k + 3])
            self._ok[k] = unit == {ChannelState.OK}
            self._well[k] = None if unit & OUT else self._well[k] or now

    def of(self, k: int) -> tuple[int | None, bool, int | None]:
        """Return what `FailoverUnit` holds of one IMU: ``declared``, ``ok``, ``well``."""
        found = [at for at in self.channels[3 * k : 3 * k + 3] if at is not None]
        return max(found, default=None), self._ok[k], self._well[k]


class Failover:
    """Takes faulty IMUs of one ArduPilot out of use, and puts them back; ``vehicle``: the conversation with it.

    ``channels``: names of the monitor's channels, three for each IMU. ``limit``: at most so many IMUs are out of use by
    our hand at a time. ``path``: file in which they stand; `ConfigError` if it cannot be read and written, or is not
    ours.
    """

    def __init__(self, vehicle: Vehicle, channels: Sequence[str], limit: int, path: Path) -> None:
        self._vehicle, self._channels, self._limit, self._path = vehicle, channels, limit, path
        count = len(channels) // 3
        self.errors: dict[str, float] = {}
        """Estimated error of each channel, as the monitor last reported it, rad/s; NaN: it reported none."""
        self.reported = 0
        """When the monitor last reported as a whole, of these IMUs, ns; 0: it has not, or of others since."""
        self.is_alone = False  # whether nobody but the monitor publishes what is taken for its declarations
        self.declarations = Declarations(count)
        self._values: list[tuple[bool, int] | None] = [None] * count
        self._begun, self._read_at, self._next, self._save_at = 0, 0, 0, 0
        self._system, self._saved = self._restore()
        """Of which system IMUs are out of use by our hand, and which, as the file says."""
        self._state = FailoverState.resumed(self._saved)
        self._save()

    @property
    def is_done(self) -> bool:
        """Whether nothing is to be put back now: none is out of use by our hand, or the vehicle is armed."""
        return not self._state.orders or self._vehicle.armed or not self._vehicle.in_reach

    # What is known -----------------------------------------------------------------------------------------------

    def _known(self, now: int, restore: bool = False) -> Known:
        vehicle = self._vehicle
        # What another system says of its parameters is nothing about the one that an IMU was taken out of.
        ours = vehicle.system == self._system or not self._state.orders
        units = []
        for k, said in enumerate(self._values):
            use, heard = said or (None, 0)
            delivers = k in vehicle.units and now - vehicle.units[k].last < SILENT
            use = use if ours and now - heard < FORGOTTEN else None
            units.append(FailoverUnit(use, heard, *self.declarations.of(k), delivers))
        reported = self.reported >= self.declarations.begun and now - self.reported < ABSENT
        return Known(
            units=tuple(units),
            linked=vehicle.in_reach and vehicle.autopilot == ARDUPILOT and vehicle.kind == "SCALED_IMU" and ours,
            armed=vehicle.armed,
            disarmed=vehicle.disarmed,
            monitored=self.is_alone and now - self.declarations.heard < SILENT and reported,
            restore=restore,
        )

    # What is done ------------------------------------------------------------------------------------------------

    def turn(self, now: int, restore: bool = False) -> None:
        """Do what is to be done at a time, ns; restore: put all back that is out by our hand."""
        self._read(now)
        known = self._known(now, restore)
        self._state, actions = decide(self._state, known, now, self._limit)
        for action in actions:
            if action.kind == "set":
                self._vehicle.set_parameter(PARAMETERS[action.unit], float(action.use))
            else:
                self._announce(action.kind, action.unit, action.why)
        if self._state.orders.keys() != self._saved and now >= self._save_at:
            self._system, self._save_at = self._vehicle.system or 0, now + NS
            try:
                self._save()
                self._save_at = now
            except ConfigError as error:
                self._vehicle.events.append(str(error))

    def restore(self, now: int) -> tuple[bool, str]:
        """Put all back that is out of use by our hand; return whether that was asked of the autopilot, and words."""
        ours = ", ".join(format_imu(unit, self._channels) for unit in sorted(self._state.orders))
        if not ours:
            return True, "no IMU is out of use by failover"
        if not self._known(now).linked:
            return False, f"{ours} cannot be put back: the autopilot is not heard"
        self.turn(now, restore=True)
        return True, f"{ours} is put back"

    def _read(self, now: int) -> None:
        vehicle = self._vehicle
        if vehicle.begun != self._begun:
            self._begun, self._values = vehicle.begun, [None] * len(self._values)
        while vehicle.parameters:
            name, value = vehicle.parameters.popleft()
            if name in PARAMETERS[: len(self._values)]:
                self._values[PARAMETERS.index(name)] = (value != 0, now)
        if vehicle.in_reach and now >= self._read_at:
            self._read_at = now + READ_EVERY
            vehicle.read_parameter(PARAMETERS[self._next])
            self._next = (self._next + 1) % len(self._values)

    def _announce(self, kind: str, unit: int, why: str) -> None:
        severity, words = TEXTS[kind]
        words += why or (self._size(unit) if kind == "out" else "")
        text = f"FDI: {format_imu(unit, self._channels)} {words}"
        if len(text) > LENGTH:
            text = f"FDI: IMU {unit + 1} {words}"[:LENGTH]
        self._vehicle.send_text(severity, text)
        self._vehicle.events.append(text)

    def _size(self, unit: int) -> str:
        """Say of which axis an IMU is faulty, and by how much, in the autopilot's axes: y to the right, z down."""
        declared = self.declarations.channels[3 * unit : 3 * unit + 3]
        axis = max(range(3), key=lambda axis: declared[axis] or 0)
        if declared[axis] is None:
            return ""
        size = self.errors.get(self._channels[3 * unit + axis], math.nan)
        words = "" if math.isnan(size) else f" {size if axis == 0 else -size:+.2f} rad/s"
        return f" (gyro {'xyz'[axis]}{words})"

    # The file, and what is said of it all ------------------------------------------------------------------------

    def _restore(self) -> tuple[int, frozenset[int]]:
        try:
            saved = json.loads(read_trusted(self._path, LARGEST))
            units = frozenset(int(unit) - 1 for unit in saved["out_of_use"])
            if not units <= set(range(len(self._values))):
                raise ValueError
            return int(saved["system_id"]), units
        except FileNotFoundError:
            return 0, frozenset()
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"failover_file {self._path} does not say which IMUs are out of use") from error
        except OSError as error:
            raise ConfigError(f"failover_file {self._path}: {error.strerror}") from error

    def _save(self) -> None:
        out = {"system_id": self._system, "out_of_use": [unit + 1 for unit in sorted(self._state.orders)]}
        try:
            with replacing(self._path) as file:
                file.write(json.dumps(out).encode())
        except OSError as error:
            raise ConfigError(f"failover_file {self._path} cannot be written: {error.strerror}") from error
        self._saved = frozenset(self._state.orders)

    def status(self, name: str, now: int) -> tuple[Level, str, str]:
        """Return level, name and words for the diagnostics: what is out, or what would speak against taking one out."""
        if out := [format_imu(k, self._channels) for k, order in self._state.orders.items() if order.is_out]:
            unsaved = "" if self._state.orders.keys() == self._saved else "; failover_file is not written"
            return Level.WARN, name, f"out of use: {', '.join(out)} of system {self._system}{unsaved}"
        known = self._known(now)
        known = known._replace(armed=True, units=tuple(unit._replace(declared=now) for unit in known.units))
        against = [objection(self._state, known, k, self._limit) for k in range(len(known.units))]
        return (Level.OK, name, "ready") if "" in against else (Level.WARN, name, f"no failover: {against[0]}")


def failover_text(changes: Sequence[tuple[float, str, str]], channels: Sequence[str]) -> str:
    """Say in a line what failover would have done in a recorded flight: armed, all in use, parameters set at once.

    ``changes`` of state of a recording, in order: when, s since its start, name of the channel, new state.
    ``channels``: their names, three for each IMU; where failover would not run, nothing is said.
    """
    count = len(channels) // 3
    if not 2 <= count <= len(PARAMETERS) or len(channels) % 3:
        return ""
    declarations, states, state = Declarations(count), [float(ChannelState.UNCHECKED)] * len(channels), FailoverState()
    use, done = [True] * count, []
    waiting = deque((_BEFORE + round(at * NS), channel, name) for at, channel, name in changes)
    # It is asked at every change, and while what was declared is young.
    asked = {at for at, _, _ in waiting}
    asked |= {at + k * _STEP for at, _, name in waiting if name == "FAULTY" for k in range(YOUNG // _STEP + 3)}
    for now in sorted(asked):
        # Between two changes the monitor was heard all the time.
        declarations.heard = now - 1
        while waiting and waiting[0][0] <= now:
            _, channel, name = waiting.popleft()
            states[channels.index(channel)] = float(ChannelState[name])
        declarations.hear(states, now)
        stale = [ChannelState.STALE in states[3 * k : 3 * k + 3] for k in range(count)]
        units = tuple(FailoverUnit(use[k], now, *declarations.of(k), delivers=not stale[k]) for k in range(count))
        state, actions = decide(state, Known(units, linked=True, armed=True, monitored=True), now)
        for action in actions:
            if action.kind == "set":
                use[action.unit] = action.use
            else:
                words = TEXTS[action.kind][1] + action.why
                done.append(f"{format_imu(action.unit, channels)} {words} at {(now - _BEFORE) / NS:.1f} s")
    return f"failover, if armed: {'; '.join(done) or 'nothing to do'}"
