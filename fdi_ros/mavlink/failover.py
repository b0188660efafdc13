# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Failover of ArduPilot: whether an IMU is taken out of use, and when it is put back.

The policy, `decide`, is a pure function: it is given what it has decided before (`FailoverState`) and what is known now
(`Known`), and returns the next state and what is to be done. It has no clock, no link and no memory, so every sequence
of events can be tried.

- An IMU that is declared FAULTY is taken out if nothing speaks against it (`objection`).
- It is put back on the ground, when an operator asks, and when somebody else has taken out all the others. In flight it
  stays out, also when it seems healthy again, but for one case: another IMU is declared FAULTY while as many are out as
  may be. Then one that has been healthy for `HEALED` is put back first, and the faulty one taken out in its place.
- What is, or may be, out of use by our hand has an `Order` until the autopilot has confirmed that it is in use again.

`Failover` gives it what the autopilot's parameters and the monitor say, and does what it decides. INS_USE, INS_USE2,
INS_USE3 outlive the autopilot's power, so what is out of use by our hand stands in a file. It is written right after
the parameter is sent: the disk may take longer than the vehicle has. `failover_text` asks the same policy about a
recorded flight.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from fdi_ros.core.states import ChannelState
from fdi_ros.errors import ConfigError
from fdi_ros.mavlink.protocol import ARDUPILOT, MS, NS
from fdi_ros.mavlink.report import CRITICAL, INFO, LENGTH, WARNING
from fdi_ros.mavlink.vehicle import Vehicle
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.system.files import read_trusted, replacing

YOUNG = NS  # a declaration is acted on up to this age, ns: with what is older the vehicle has flown, the pilot decides
HEALED = (
    2 * NS
)  # so long an IMU that is out must have been well before it changes places with a faulty one, ns
GROUNDED = (
    2 * NS
)  # disarmed is what all heartbeats have said for so long, ns: a single forged one is not enough
RETRY, TRIES = (
    100 * MS,
    10,
)  # between two attempts to set a parameter, ns, and their number
AGAIN = 10 * NS  # an IMU that could not be put back is tried again after so long, ns
SETTLED = (
    2 * NS
)  # what was sent so long ago has arrived, or never will, ns: what is heard later is the truth


class FailoverUnit(NamedTuple):
    """What is known of one IMU; times in ns."""

    use: bool | None = (
        None  # whether its parameter says that it is in use; None: the autopilot has not said of late.
    )
    heard: int = 0  # when the autopilot said so last
    declared: int | None = (
        None  # when the newest of its channels that are FAULTY by name was declared; None: none is.
    )
    ok: bool = False  # whether all its channels are OK: healthy and checked
    well: int | None = (
        None  # since when none of its channels is FAULTY, without data or excluded; None: one is.
    )
    delivers: bool = False  # whether its samples come


class Known(NamedTuple):
    """What is known now."""

    units: tuple[FailoverUnit, ...]
    linked: bool = (
        False  # whether an ArduPilot is heard that sends each IMU under its own name
    )
    armed: bool = False
    disarmed: int = (
        0  # for how long all its heartbeats have said that it is not armed, ns
    )
    monitored: bool = (
        False  # whether the monitor, and nobody else in its place, reports
    )
    restore: bool = False  # an operator asks now for all to be put back


class Order(NamedTuple):
    """What a parameter is to say, for an IMU that is, or may be, out of use by our hand; times in ns."""

    use: bool
    tries: int = 0
    begun: int = 0
    sent: int = 0  # first and last attempt
    confirmed: bool = False

    @property
    def is_out(self) -> bool:
        """Whether the IMU may be out of use."""
        return not (self.use and self.confirmed)


@dataclass
class FailoverState:
    """What was decided before, by IMU."""

    orders: dict[int, Order] = field(
        default_factory=dict
    )  # of those that are, or may be, out of use by our hand
    seen: dict[int, bool] = field(default_factory=dict)  # what each parameter said last
    left_alone: set[int] = field(
        default_factory=set
    )  # set by somebody else: left alone until it is disarmed
    answered: dict[int, int] = field(
        default_factory=dict
    )  # declarations acted on, or refused: when made, ns

    @classmethod
    def resumed(cls, ours: Iterable[int]) -> FailoverState:
        """State after a start, of IMUs that were out by our hand: they are put back, and left alone in this flight."""
        orders = {unit: Order(False, TRIES + 1) for unit in ours}
        return cls(orders, left_alone=set(orders))


class Action(NamedTuple):
    """What is to be done."""

    kind: str  # ``set``; or what is to be told: ``out``, ``back``, ``not out``, ``not back``, ``changed``, ``stays``
    unit: int
    use: bool = False
    why: str = ""  # why an IMU that was declared stays in use


def objection(state: FailoverState, known: Known, unit: int, limit: int) -> str:
    """Say what speaks against taking an IMU, from 0, out of use, but for the age of its declaration; empty: nothing."""
    one = known.units[unit]
    out = {k for k, order in state.orders.items() if k != unit and order.is_out}
    # One that we may have taken out is no reserve, though its parameter was last heard to say that it is in use.
    reserves = [
        other for k, other in enumerate(known.units) if k != unit and k not in out
    ]
    checks = (
        (known.linked, "no ArduPilot that sends each IMU"),
        (known.armed, "not armed"),
        (known.monitored, "the monitor is in doubt"),
        (one.declared is not None, "not declared"),
        (all(other.use is not None for other in known.units), "INS_USE not known"),
        (one.use, "out already"),
        (unit not in state.left_alone, "set by others"),
        (
            any(other.use and other.delivers and other.ok for other in reserves),
            "no other is healthy",
        ),
        (len(out) < limit, "limit"),
    )
    return next((words for holds, words in checks if not holds), "")


def decide(
    state: FailoverState, known: Known, now: int, limit: int = 1
) -> tuple[FailoverState, list[Action]]:
    """Return the next state, and what is to be done, in this order, at a time now, ns.

    ``state``: what was decided before, which stays as it is. ``limit``: at most so many IMUs are out of use by our
    hand, at most all but one.
    """
    state = FailoverState(
        dict(state.orders),
        dict(state.seen),
        set(state.left_alone),
        dict(state.answered),
    )
    actions: list[Action] = []
    for k, unit in enumerate(known.units):
        if unit.use is not None:
            _notice(state, k, unit, actions)
    if known.linked:
        _put_back(state, known)
        for k, unit in enumerate(known.units):
            if unit.declared is not None and unit.declared != state.answered.get(k):
                _answer(state, known, k, now, limit, actions)
        for k, order in state.orders.items():
            if not order.confirmed and now - order.sent >= RETRY:
                state.orders[k] = _sent(state, known, k, now, limit, actions)
    return state, actions


def _notice(
    state: FailoverState, k: int, unit: FailoverUnit, actions: list[Action]
) -> None:
    """Notice whether an order is confirmed, and what somebody else has set, or may have set."""
    assert unit.use is not None
    order, seen = state.orders.get(k), state.seen.get(k, unit.use)
    state.seen[k] = unit.use
    settled = order is not None and unit.heard - order.sent >= SETTLED
    changed = (
        unit.use != seen
        if order is None
        else unit.use and not order.use and order.confirmed and settled
    )
    if changed:
        actions.append(Action("changed", k))
        state.left_alone.add(k)
        state.orders.pop(k, None)
    elif order is not None and unit.use == order.use and unit.heard > order.begun:
        if not order.confirmed:
            actions.append(Action("back" if order.use else "out", k))
        if not order.confirmed and order.use and unit.heard - order.begun >= SETTLED:
            # Put back late: by our hand, or by somebody else's while ours was not answered.
            state.left_alone.add(k)
        state.orders[k] = order._replace(confirmed=True)
        if order.use and settled:
            del state.orders[k]
    elif order is not None and order.use and order.confirmed and not unit.use:
        # Out by what we sent before and came after it, or by somebody else's hand: back it goes.
        state.orders[k] = order._replace(tries=0, confirmed=False)
        if settled:
            state.left_alone.add(k)


def _put_back(state: FailoverState, known: Known) -> None:
    """Turn round all orders at the end of a flight, or earlier where that must be."""
    grounded = known.disarmed >= GROUNDED
    if known.restore:
        state.left_alone |= set(state.orders)
    if grounded:
        state.left_alone.clear()
    # The autopilot is never left without an IMU by what was done here, whoever has taken out the others.
    if known.restore or grounded or all(unit.use is False for unit in known.units):
        state.orders = {
            k: order if order.use else Order(True) for k, order in state.orders.items()
        }


def _answer(
    state: FailoverState,
    known: Known,
    k: int,
    now: int,
    limit: int,
    actions: list[Action],
) -> None:
    """Answer a declaration: take the IMU out, make room for that, or say why not."""
    unit, why = known.units[k], objection(state, known, k, limit)
    assert unit.declared is not None
    if now - unit.declared > YOUNG:
        if why not in ("not armed", "out already"):
            actions.append(Action("stays", k, True, why or "declared too long ago"))
    elif not why:
        state.orders[k] = Order(False)
    else:
        if why == "limit":
            _make_room(state, known, now)
        return
    state.answered[k] = unit.declared


def _make_room(state: FailoverState, known: Known, now: int) -> None:
    """Have one IMU put back that is out of use and has long been healthy, unless one is being put back."""
    for k, order in state.orders.items():
        if order.use and not order.confirmed:
            return
        unit = known.units[k]
        if (
            not order.use
            and unit.delivers
            and unit.ok
            and unit.well is not None
            and now - unit.well >= HEALED
        ):
            state.orders[k] = Order(True)
            return


def _sent(
    state: FailoverState,
    known: Known,
    k: int,
    now: int,
    limit: int,
    actions: list[Action],
) -> Order:
    """Send an order once more if that is to be."""
    order = state.orders[k]
    # One that may no longer be taken out is not asked for again; it may be out all the same.
    late = order.begun > 0 and now - order.begun >= YOUNG + TRIES * RETRY
    stands = order.use or not (late or objection(state, known, k, limit))
    tries = order.tries if stands else max(order.tries, TRIES)
    if order.use and now - order.sent >= AGAIN:
        tries = 0
    if tries < TRIES:
        actions.append(Action("set", k, order.use))
        return Order(order.use, tries + 1, order.begun or now, now)
    if tries == TRIES:
        actions.append(Action("not back" if order.use else "not out", k))
    return order._replace(tries=tries + 1)


# With an autopilot and a monitor -------------------------------------------------------------------------------------


PARAMETERS = ("INS_USE", "INS_USE2", "INS_USE3")
OUT = {
    ChannelState.FAULTY,
    ChannelState.STALE,
    ChannelState.EXCLUDED,
}  # not used at all; suspects may be healthy
_STEP = 20 * MS  # the policy is asked so often while a declaration is young, ns
_BEFORE = NS + HEALED  # time of the policy at the start of a recording, ns
READ_EVERY, FORGOTTEN = (
    NS // 2,
    10 * NS,
)  # parameters are read in turn so often; what is older counts as not known
SILENT, ABSENT = (
    NS // 2,
    5 * NS,
)  # an IMU or a monitor without a sample, a monitor without a report, for so long, ns
TEXTS = {
    "out": (CRITICAL, "out of use"),
    "back": (INFO, "in use again"),
    "not out": (CRITICAL, "out of use: not accepted"),
    "not back": (CRITICAL, "back in use: not accepted"),
    "changed": (WARNING, "set by others, left alone"),
    "stays": (CRITICAL, "stays: "),
}  # severity and words, by the kind of action
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
        self.channels: list[int | None] = [None] * (
            3 * count
        )  # when each that is FAULTY by name was declared, ns
        self.units = [
            FailoverUnit()
        ] * count  # of each IMU ``declared``, ``ok`` and ``well``

    def hear(self, states: Sequence[float], now: int) -> None:
        """Take the states of all channels, numbers of `ChannelState`, at a time, ns."""
        # What was declared while nobody listened is of unknown age.
        is_new = now - self.heard >= YOUNG
        declared = now - 2 * YOUNG if is_new else now
        self.begun = now if is_new else self.begun
        self.heard = now
        for i, state in enumerate(states):
            self.channels[i] = (
                (self.channels[i] or declared) if state == ChannelState.FAULTY else None
            )
        for k, before in enumerate(self.units):
            unit, stamps = (
                set(states[3 * k : 3 * k + 3]),
                self.channels[3 * k : 3 * k + 3],
            )
            well = None if unit & OUT else now if is_new else before.well or now
            newest = max((at for at in stamps if at is not None), default=None)
            self.units[k] = FailoverUnit(
                declared=newest, ok=unit == {ChannelState.OK}, well=well
            )


class Failover:
    """Takes faulty IMUs of one ArduPilot out of use, at most ``limit`` at a time, and puts them back.

    ``channels``: three for each IMU. ``path``: file in which those out stand; `ConfigError` if it is not ours.
    """

    def __init__(
        self, vehicle: Vehicle, channels: Sequence[str], limit: int, path: Path
    ) -> None:
        self._vehicle, self._channels, self._limit, self._path = (
            vehicle,
            channels,
            limit,
            path,
        )
        count = len(channels) // 3
        self.errors: dict[
            str, float
        ] = {}  # estimated error of each channel, as last reported, rad/s; NaN: none
        self.reported = 0  # when the monitor last reported as a whole, of these IMUs, ns; 0: not, or of others since
        self.is_alone = False  # whether nobody but the monitor publishes what is taken for its declarations
        self.declarations = Declarations(count)
        self._values: list[tuple[bool | None, int]] = [
            (None, 0)
        ] * count  # what each parameter said last, and when
        self._begun, self._read_at, self._next, self._save_at = 0, 0, 0, 0
        self._system, self._saved = (
            self._restore()
        )  # which IMUs of which system are out of use by our hand, as saved
        self._state = FailoverState.resumed(self._saved)
        self._save()

    @property
    def is_done(self) -> bool:
        """Whether nothing is to be put back now: none is out of use by our hand, or the vehicle is armed."""
        return (
            not self._state.orders or self._vehicle.armed or not self._vehicle.in_reach
        )

    def _known(self, now: int, restore: bool = False) -> Known:
        vehicle, units = self._vehicle, []
        # What another system says of its parameters is nothing about the one that an IMU was taken out of.
        ours = vehicle.system == self._system or not self._state.orders
        for k, (use, heard) in enumerate(self._values):
            delivers = k in vehicle.units and now - vehicle.units[k].last < SILENT
            use = use if ours and now - heard < FORGOTTEN else None
            units.append(
                self.declarations.units[k]._replace(
                    use=use, heard=heard, delivers=delivers
                )
            )
        reported = (
            self.reported >= self.declarations.begun and now - self.reported < ABSENT
        )
        return Known(
            units=tuple(units),
            linked=vehicle.in_reach
            and vehicle.autopilot == ARDUPILOT
            and vehicle.kind == "SCALED_IMU"
            and ours,
            armed=vehicle.armed,
            disarmed=vehicle.disarmed,
            monitored=self.is_alone
            and now - self.declarations.heard < SILENT
            and reported,
            restore=restore,
        )

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
            self._system, self._save_at = self._vehicle.system or 0, now
            try:
                self._save()
            except ConfigError as error:
                self._save_at = now + NS
                self._vehicle.events.append(str(error))

    def restore(self, now: int) -> tuple[bool, str]:
        """Put all back that is out of use by our hand; return whether that was asked of the autopilot, and words."""
        ours = ", ".join(
            format_imu(unit, self._channels) for unit in sorted(self._state.orders)
        )
        if not ours:
            return True, "no IMU is out of use by failover"
        if not self._known(now).linked:
            return False, f"{ours} cannot be put back: the autopilot is not heard"
        self.turn(now, restore=True)
        return True, f"{ours} is put back"

    def _read(self, now: int) -> None:
        vehicle = self._vehicle
        if vehicle.begun != self._begun:
            self._begun, self._values = vehicle.begun, [(None, 0)] * len(self._values)
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
        words = (
            "" if math.isnan(size) else f" {size if axis == 0 else -size:+.2f} rad/s"
        )
        return f" (gyro {'xyz'[axis]}{words})"

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
            raise ConfigError(
                f"failover_file {self._path} does not say which IMUs are out of use"
            ) from error
        except OSError as error:
            raise ConfigError(
                f"failover_file {self._path}: {error.strerror}"
            ) from error

    def _save(self) -> None:
        out = {
            "system_id": self._system,
            "out_of_use": [unit + 1 for unit in sorted(self._state.orders)],
        }
        try:
            with replacing(self._path) as file:
                file.write(json.dumps(out).encode())
        except OSError as error:
            raise ConfigError(
                f"failover_file {self._path} cannot be written: {error.strerror}"
            ) from error
        self._saved = frozenset(self._state.orders)

    def status(self, now: int) -> tuple[Level, str]:
        """Return level and words for the diagnostics: what is out, or what would speak against taking one out."""
        if out := [
            format_imu(k, self._channels)
            for k, order in self._state.orders.items()
            if order.is_out
        ]:
            unsaved = (
                ""
                if self._state.orders.keys() == self._saved
                else "; failover_file is not written"
            )
            return (
                Level.WARN,
                f"out of use: {', '.join(out)} of system {self._system}{unsaved}",
            )
        known = self._known(now)
        known = known._replace(
            armed=True, units=tuple(unit._replace(declared=now) for unit in known.units)
        )
        against = [
            objection(self._state, known, k, self._limit)
            for k in range(len(known.units))
        ]
        return (
            (Level.OK, "ready")
            if "" in against
            else (Level.WARN, f"no failover: {against[0]}")
        )


def failover_text(
    changes: Sequence[tuple[float, str, str]], channels: Sequence[str]
) -> str:
    """Say what failover would have done in a flight, by its changes: s since the start, channel, new state."""
    count = len(channels) // 3
    if not 2 <= count <= len(PARAMETERS) or len(channels) % 3:
        return ""
    declarations, states, state = (
        Declarations(count),
        [float(ChannelState.UNCHECKED)] * len(channels),
        FailoverState(),
    )
    use, done = [True] * count, []
    waiting = deque(
        (_BEFORE + round(at * NS), channel, name) for at, channel, name in changes
    )
    # It is asked at every change, and while what was declared is young.
    asked = {at for at, _, _ in waiting}
    asked |= {
        at + k * _STEP
        for at, _, name in waiting
        if name == "FAULTY"
        for k in range(YOUNG // _STEP + 3)
    }
    for now in sorted(asked):
        # Between two changes the monitor was heard all the time.
        declarations.heard = now - 1
        while waiting and waiting[0][0] <= now:
            _, channel, name = waiting.popleft()
            states[channels.index(channel)] = float(ChannelState[name])
        declarations.hear(states, now)
        stale = [ChannelState.STALE in states[3 * k : 3 * k + 3] for k in range(count)]
        said = zip(declarations.units, use, stale, strict=True)
        units = tuple(
            unit._replace(use=used, heard=now, delivers=not lost)
            for unit, used, lost in said
        )
        state, actions = decide(
            state, Known(units, linked=True, armed=True, monitored=True), now
        )
        for action in actions:
            if action.kind == "set":
                use[action.unit] = action.use
            else:
                words = TEXTS[action.kind][1] + action.why
                done.append(
                    f"{format_imu(action.unit, channels)} {words} at {(now - _BEFORE) / NS:.1f} s"
                )
    return f"failover, if armed: {'; '.join(done) or 'nothing to do'}"
