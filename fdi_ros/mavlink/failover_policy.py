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

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from fdi_ros.mavlink.clock import MS, NS

YOUNG = NS
"""A declaration is acted on up to this age, ns: with what is older the vehicle has flown, and the pilot decides."""
HEALED = 2 * NS
"""So long an IMU that is out must have been well before it changes places with a faulty one, ns."""
GROUNDED = 2 * NS
"""A vehicle is disarmed when its heartbeats have all said so for so long, ns: a single forged one is not enough."""
RETRY, TRIES = 100 * MS, 10
"""Between two attempts to set a parameter, ns, and their number."""
AGAIN = 10 * NS
"""An IMU that could not be put back is tried again after so long, ns."""
SETTLED = 2 * NS
"""What was sent so long ago has arrived, or never will, ns: what is heard later is the truth, or somebody else's."""


class FailoverUnit(NamedTuple):
    """What is known of one IMU; times in ns."""

    use: bool | None = None
    """Whether its parameter says that it is in use; None: the autopilot has not said of late."""
    heard: int = 0
    """When the autopilot said so last."""
    declared: int | None = None
    """When the newest of its channels that are FAULTY by name was declared; None: none is."""
    ok: bool = False
    """Whether all its channels are OK: healthy and checked."""
    well: int | None = None
    """Since when none of its channels is FAULTY, without data or taken out by an operator; None: one is."""
    delivers: bool = False
    """Whether its samples come."""


class Known(NamedTuple):
    """What is known now."""

    units: tuple[FailoverUnit, ...]
    linked: bool = False
    """Whether an ArduPilot is heard that sends each IMU under its own name."""
    armed: bool = False
    disarmed: int = 0
    """For how long all its heartbeats have said that it is not armed, ns."""
    monitored: bool = False
    """Whether the monitor, and nobody else in its place, reports."""
    restore: bool = False
    """An operator asks now for all to be put back."""


class Order(NamedTuple):
    """What a parameter is to say, for an IMU that is, or may be, out of use by our hand; times in ns."""

    use: bool
    tries: int = 0
    begun: int = 0
    sent: int = 0
    """First and last attempt."""
    confirmed: bool = False

    @property
    def is_out(self) -> bool:
        """Whether the IMU may be out of use."""
        return not (self.use and self.confirmed)


@dataclass(frozen=True)
class FailoverState:
    """What was decided before, by IMU; never changed in place."""

    orders: Mapping[int, Order] = field(default_factory=dict)
    """Of those that are, or may be, out of use by our hand."""
    seen: Mapping[int, bool] = field(default_factory=dict)
    """What each parameter said last."""
    left_alone: frozenset[int] = frozenset()
    """Those that somebody else has taken out or put back: left alone until the vehicle is disarmed."""
    answered: Mapping[int, int] = field(default_factory=dict)
    """Declarations that were acted on, or of which it was said why not: when they were made, ns."""

    @classmethod
    def resumed(cls, ours: Iterable[int]) -> FailoverState:
        """State after a start, of IMUs that were out of use by our hand before, and may be still.

        What somebody else has set meanwhile is not known: they are put back, and not taken out again in this flight.
        """
        units = frozenset(ours)
        return cls(orders={unit: Order(False, TRIES + 1) for unit in units}, left_alone=units)


class Action(NamedTuple):
    """What is to be done."""

    kind: str
    """``set``; or what is to be told: ``out``, ``back``, ``not out``, ``not back``, ``changed``, ``stays``."""
    unit: int
    use: bool = False
    why: str = ""
    """Why an IMU that was declared stays in use."""


def objection(state: FailoverState, known: Known, unit: int, limit: int) -> str:
    """Say what speaks against taking an IMU out of use, but for the age of its declaration; empty if nothing does.

    Parameters
    ----------
    state, known, limit
        As for `decide`.
    unit
        Which IMU, from 0.
    """
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
    """Decide what is to be done.

    Parameters
    ----------
    state
        What was decided before.
    known
        What is known now.
    now
        ns.
    limit
        At most so many IMUs are out of use by our hand, at most all but one.

    Returns
    -------
    state, actions
        The next state, and what is to be done, in this order.
    """
    state, actions = _notice(state, known)
    if known.linked:
        state = _answer(_put_back(state, known), known, now, limit, actions)
        state = _send(state, known, now, limit, actions)
    return state, actions


def _notice(state: FailoverState, known: Known) -> tuple[FailoverState, list[Action]]:
    """Notice which orders are confirmed, and what somebody else has set, or may have set."""
    orders, seen, left_alone, actions = dict(state.orders), dict(state.seen), set(state.left_alone), []
    for k, unit in enumerate(known.units):
        if unit.use is None:
            continue
        order, kind, ours = _compared(orders.get(k), unit, seen.get(k, unit.use))
        if order is not None:
            orders[k] = order
        else:
            orders.pop(k, None)
        if kind:
            actions.append(Action(kind, k))
        if not ours:
            left_alone.add(k)
        seen[k] = unit.use
    return replace(state, orders=orders, seen=seen, left_alone=frozenset(left_alone)), actions


def _compared(order: Order | None, unit: FailoverUnit, seen: bool) -> tuple[Order | None, str, bool]:
    """Compare an order with what the parameter says: what is left of it, what is to be told, and whether it is ours."""
    if order is None:
        return (None, "", True) if unit.use == seen else (None, "changed", False)
    settled = unit.heard - order.sent >= SETTLED
    if unit.use == order.use and unit.heard > order.begun:
        kind = "" if order.confirmed else "back" if order.use else "out"
        # Put back late: by our hand, or by somebody else's while ours was not answered.
        ours = order.confirmed or not order.use or unit.heard - order.begun < SETTLED
        return (None if order.use and settled else order._replace(confirmed=True)), kind, ours
    if unit.use == order.use or not order.confirmed:
        return order, "", True
    if order.use:
        # Out by what we sent before and came after it, or by somebody else's hand: back it goes.
        return order._replace(tries=0, confirmed=False), "", not settled
    return (None, "changed", False) if settled else (order, "", True)


def _put_back(state: FailoverState, known: Known) -> FailoverState:
    """Turn round all orders at the end of a flight, or earlier where that must be."""
    grounded = known.disarmed >= GROUNDED
    # The autopilot is never left without an IMU by what was done here, whoever has taken out the others.
    none_left = all(unit.use is False for unit in known.units)
    left_alone = frozenset() if grounded else state.left_alone | (set(state.orders) if known.restore else set())
    orders = dict(state.orders)
    if known.restore or grounded or none_left:
        orders = {k: order if order.use else Order(True) for k, order in orders.items()}
    return replace(state, orders=orders, left_alone=left_alone)


def _answer(state: FailoverState, known: Known, now: int, limit: int, actions: list[Action]) -> FailoverState:
    """Answer declarations: take an IMU out, make room for that, or say why not."""
    for k, unit in enumerate(known.units):
        if unit.declared is None or unit.declared == state.answered.get(k):
            continue
        why = objection(state, known, k, limit)
        if now - unit.declared > YOUNG:
            if why not in ("not armed", "out already"):
                actions.append(Action("stays", k, True, why or "declared too long ago"))
        elif not why:
            state = replace(state, orders={**state.orders, k: Order(False)})
        else:
            if why == "limit":
                state = _make_room(state, known, now)
            continue
        state = replace(state, answered={**state.answered, k: unit.declared})
    return state


def _make_room(state: FailoverState, known: Known, now: int) -> FailoverState:
    """Have one IMU put back that is out of use and has long been healthy, unless one is being put back."""
    for k, order in state.orders.items():
        if order.use and not order.confirmed:
            return state
        unit = known.units[k]
        if not order.use and unit.delivers and unit.ok and unit.well is not None and now - unit.well >= HEALED:
            return replace(state, orders={**state.orders, k: Order(True)})
    return state


def _send(state: FailoverState, known: Known, now: int, limit: int, actions: list[Action]) -> FailoverState:
    """Send the orders that are due, once more if need be."""
    orders = dict(state.orders)
    for k, order in state.orders.items():
        if order.confirmed or now - order.sent < RETRY:
            continue
        # One that may no longer be taken out is not asked for again; it may be out all the same.
        late = order.begun > 0 and now - order.begun >= YOUNG + TRIES * RETRY
        stands = order.use or not (late or objection(state, known, k, limit))
        tries = order.tries if stands else max(order.tries, TRIES)
        if order.use and now - order.sent >= AGAIN:
            tries = 0
        orders[k] = order._replace(tries=tries + 1)
        if tries < TRIES:
            orders[k] = Order(order.use, tries + 1, order.begun or now, now)
            actions.append(Action("set", k, order.use))
        elif tries == TRIES:
            actions.append(Action("not back" if order.use else "not out", k))
    return replace(state, orders=orders)
