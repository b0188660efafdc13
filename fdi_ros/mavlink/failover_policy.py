# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether an IMU is taken out of use, and when it is put back: a pure function of what is known and the time.

`decide` is given what it has decided before (`State`) and what is known now (`Known`), and returns the next state and
what is to be done. It has no clock, no link and no memory of its own, so every sequence of events can be tried.

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
"""After so long a confirmed order stands, ns: what was sent before it has arrived, or never will."""


class Unit(NamedTuple):
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

    units: tuple[Unit, ...]
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
class State:
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
    def resumed(cls, ours: Iterable[int]) -> State:
        """State after a start, of IMUs that were out of use by our hand before, and may be still."""
        return cls(orders={unit: Order(False, TRIES + 1) for unit in ours})


class Action(NamedTuple):
    """What is to be done."""

    kind: str
    """``set``; or what is to be told: ``out``, ``back``, ``not out``, ``not back``, ``changed``, ``stays``."""
    unit: int
    use: bool = False
    why: str = ""
    """Why an IMU that was declared stays in use."""


def objection(state: State, known: Known, unit: int, limit: int) -> str:
    """Say what speaks against taking an IMU out of use, but for the age of its declaration; empty if nothing does.

    Parameters
    ----------
    state, known, limit
        As for `decide`.
    unit
        Which IMU, from 0.
    """
    one = known.units[unit]
    out = sum(order.is_out for k, order in state.orders.items() if k != unit)
    others = [other for k, other in enumerate(known.units) if k != unit]
    checks = (
        (known.linked, "no ArduPilot that sends each IMU"),
        (known.armed, "not armed"),
        (known.monitored, "the monitor is in doubt"),
        (one.declared is not None, "not declared"),
        (all(other.use is not None for other in known.units), "INS_USE not known"),
        (one.use, "out already"),
        (unit not in state.left_alone, "set by others"),
        (any(other.use and other.delivers and other.ok for other in others), "no other is healthy"),
        (out < limit, "limit"),
    )
    return next((words for holds, words in checks if not holds), "")


def decide(state: State, known: Known, now: int, limit: int = 1) -> tuple[State, list[Action]]:
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
    state, actions = _notice(state, known, now)
    if known.linked:
        state = _answer(_put_back(state, known), known, now, limit, actions)
        state = _send(state, known, now, limit, actions)
    return state, actions


def _notice(state: State, known: Known, now: int) -> tuple[State, list[Action]]:
    """Notice which orders are confirmed, and what somebody else has set."""
    orders, seen, actions = dict(state.orders), dict(state.seen), []
    changed, unsure = set(), set()
    for k, unit in enumerate(known.units):
        if unit.use is None:
            continue
        order = orders.get(k)
        if order is None:
            if seen.get(k, unit.use) != unit.use:
                changed.add(k)
        elif unit.use == order.use and unit.heard > order.begun:
            if not order.confirmed:
                actions.append(Action("back" if order.use else "out", k))
            orders[k] = order._replace(confirmed=True)
            if order.use and unit.heard - order.sent >= SETTLED:
                del orders[k]
        elif unit.use != order.use and order.confirmed:
            if order.use or now - order.sent < SETTLED:
                # By what was sent before the order, and came after it; one to be put back stands until that is past.
                orders[k] = order._replace(tries=0, confirmed=False)
                # Or, if that is long ago, by somebody else's hand: back it goes, and is left alone.
                unsure |= {k} if now - order.sent >= SETTLED else set()
            else:
                changed.add(k)
                del orders[k]
        seen[k] = unit.use
    actions += [Action("changed", k, seen[k]) for k in changed]
    return replace(state, orders=orders, seen=seen, left_alone=state.left_alone | changed | unsure), actions


def _put_back(state: State, known: Known) -> State:
    """Turn round all orders at the end of a flight, or earlier where that must be."""
    grounded = known.disarmed >= GROUNDED
    # The autopilot is never left without an IMU by what was done here, whoever has taken out the others.
    none_left = all(unit.use is False for unit in known.units)
    left_alone = frozenset() if grounded else state.left_alone | (set(state.orders) if known.restore else set())
    orders = dict(state.orders)
    if known.restore or grounded or none_left:
        orders = {k: order if order.use else Order(True) for k, order in orders.items()}
    return replace(state, orders=orders, left_alone=left_alone)


def _answer(state: State, known: Known, now: int, limit: int, actions: list[Action]) -> State:
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


def _make_room(state: State, known: Known, now: int) -> State:
    """Have one IMU put back that is out of use and has long been healthy, unless one is being put back."""
    for k, order in state.orders.items():
        if order.use and not order.confirmed:
            return state
        unit = known.units[k]
        if not order.use and unit.delivers and unit.ok and unit.well is not None and now - unit.well >= HEALED:
            return replace(state, orders={**state.orders, k: Order(True)})
    return state


def _send(state: State, known: Known, now: int, limit: int, actions: list[Action]) -> State:
    """Send the orders that are due, once more if need be."""
    orders = dict(state.orders)
    for k, order in state.orders.items():
        if order.confirmed or now - order.sent < RETRY:
            continue
        # One that may no longer be taken out is not asked for again; it may be out all the same.
        tries = order.tries if order.use or not objection(state, known, k, limit) else max(order.tries, TRIES)
        if order.use and now - order.sent >= AGAIN:
            tries = 0
        orders[k] = order._replace(tries=tries + 1)
        if tries < TRIES:
            orders[k] = Order(order.use, tries + 1, order.begun or now, now)
            actions.append(Action("set", k, order.use))
        elif tries == TRIES:
            actions.append(Action("not back" if order.use else "not out", k))
    return replace(state, orders=orders)
