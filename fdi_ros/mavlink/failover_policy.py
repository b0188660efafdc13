# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether an IMU is taken out of use, and when it is put back: a pure function of what is known and the time.

`decide` is given what it has decided before (`FailoverState`) and what is known now (`Known`), and returns the next
state and what is to be done. It has no clock, no link and no memory, so every sequence of events can be tried.

- An IMU that is declared FAULTY is taken out if nothing speaks against it (`objection`).
- It is put back on the ground, when an operator asks, and when somebody else has taken out all the others. In flight it
  stays out, also when it seems healthy again, but for one case: another IMU is declared FAULTY while as many are out as
  may be. Then one that has been healthy for `HEALED` is put back first, and the faulty one taken out in its place.
- What is, or may be, out of use by our hand has an `Order` until the autopilot has confirmed that it is in use again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from fdi_ros.mavlink.clock import MS, NS

YOUNG = NS
"""A declaration is acted on up to this age, ns: with what is older the vehicle has flown, and the pilot decides."""
HEALED = 2 * NS  # so long an IMU that is out must have been well before it changes places with a faulty one, ns
GROUNDED = 2 * NS
"""A vehicle is disarmed when its heartbeats have all said so for so long, ns: a single forged one is not enough."""
RETRY, TRIES = 100 * MS, 10  # between two attempts to set a parameter, ns, and their number
AGAIN = 10 * NS  # an IMU that could not be put back is tried again after so long, ns
SETTLED = 2 * NS
"""What was sent so long ago has arrived, or never will, ns: what is heard later is the truth, or somebody else's."""


class FailoverUnit(NamedTuple):
    """What is known of one IMU; times in ns."""

    use: bool | None = None  # whether its parameter says that it is in use; None: the autopilot has not said of late.
    heard: int = 0  # when the autopilot said so last
    declared: int | None = None  # when the newest of its channels that are FAULTY by name was declared; None: none is.
    ok: bool = False  # whether all its channels are OK: healthy and checked
    well: int | None = None
    """Since when none of its channels is FAULTY, without data or taken out by an operator; None: one is."""
    delivers: bool = False  # whether its samples come


class Known(NamedTuple):
    """What is known now."""

    units: tuple[FailoverUnit, ...]
    linked: bool = False  # whether an ArduPilot is heard that sends each IMU under its own name
    armed: bool = False
    disarmed: int = 0  # for how long all its heartbeats have said that it is not armed, ns
    monitored: bool = False  # whether the monitor, and nobody else in its place, reports
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

    orders: dict[int, Order] = field(default_factory=dict)  # of those that are, or may be, out of use by our hand
    seen: dict[int, bool] = field(default_factory=dict)  # what each parameter said last
    left_alone: set[int] = field(default_factory=set)
    """Those that somebody else has taken out or put back: left alone until the vehicle is disarmed."""
    answered: dict[int, int] = field(default_factory=dict)
    """Declarations that were acted on, or of which it was said why not: when they were made, ns."""

    @classmethod
    def resumed(cls, ours: Iterable[int]) -> FailoverState:
        """State after a start, of IMUs that were out of use by our hand before, and may be still.

        What somebody else has set meanwhile is not known: they are put back, and not taken out again in this flight.
        """
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
    reserves = [other for k, other in enumerate(known.units) if k != unit and k not in out]
    checks = (
        (known.linked, "no ArduPilot that sends each IMU"),
        (known.armed, "not armed"),
        (known.monitored, "the monitor is in doubt"),
        (one.declared is not None, "not declared"),
        (all(other.use is not None for other in known.units), "INS_USE not known"),
        (one.use, "out already"),
        (unit not in state.left_alone, "set by others"),
        (any(other.use and other.delivers and other.ok for other in reserves), "no other is healthy"),
        (len(out) < limit, "limit"),
    )
    return next((words for holds, words in checks if not holds), "")


def decide(state: FailoverState, known: Known, now: int, limit: int = 1) -> tuple[FailoverState, list[Action]]:
    """Return the next state, and what is to be done, in this order, at a time now, ns.

    ``state``: what was decided before, which stays as it is. ``limit``: at most so many IMUs are out of use by our
    hand, at most all but one.
    """
    state = FailoverState(dict(state.orders), dict(state.seen), set(state.left_alone), dict(state.answered))
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


def _notice(state: FailoverState, k: int, unit: FailoverUnit, actions: list[Action]) -> None:
    """Notice whether an order is confirmed, and what somebody else has set, or may have set."""
    assert unit.use is not None
    order, seen = state.orders.get(k), state.seen.get(k, unit.use)
    state.seen[k] = unit.use
    settled = order is not None and unit.heard - order.sent >= SETTLED
    changed = unit.use != seen if order is None else unit.use and not order.use and order.confirmed and settled
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
        state.orders = {k: order if order.use else Order(True) for k, order in state.orders.items()}


def _answer(state: FailoverState, known: Known, k: int, now: int, limit: int, actions: list[Action]) -> None:
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
        if not order.use and unit.delivers and unit.ok and unit.well is not None and now - unit.well >= HEALED:
            state.orders[k] = Order(True)
            return


def _sent(state: FailoverState, known: Known, k: int, now: int, limit: int, actions: list[Action]) -> Order:
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
