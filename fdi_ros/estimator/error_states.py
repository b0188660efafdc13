# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Errors of the sensors as one error state: bias, scale, misalignment, delay, and their rates of change.

Channel i of unit u shows ``z_i(t) = h_i w(t - d_u) + E_i w + b_i + e_i``. Each kind of
error is one `StateKind` of the table `ERROR_KINDS`. Its states enter a channel, each
multiplied by a signal (`fill_signals`): ``y = C x + H w + e`` with row i of C the
signals of channel i at the places of its states. States without a signal are rates of
change of other states.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    MAX_UNITS,
    Axes,
    Real,
    Square,
    Whole,
    compiled,
    record,
)
from fdi_ros.core.algebra import along
from fdi_ros.model.samples import Array

ONE, RATE_X, RATE_Y, RATE_Z, TURN, SPEED = range(6)
"""Multipliers of a state in a channel: one, the body rate about an axis, the negative
angular acceleration along the channel, or the absolute rate along it. All but the first
are motion, and zero at rest."""
GIVEN = math.nan  # in the table: the caller of `prepare_layout` gives the size


class StateKind(NamedTuple):
    """One kind of error."""

    #: as in reports: ``bias``
    name: str
    #: of a state. Empty: dimensionless
    unit: str
    #: one for each unit but the first, the reference. Otherwise one for each channel
    per_unit: bool
    by: tuple[int, ...]
    """Multiplier of each state; empty: a single state, the rate of change of `feeds`."""
    #: standard deviation at the start, where `prepare_layout` is given no other
    prior: float
    #: random walk, per sqrt(s), where `prepare_layout` is given no other
    walk: float = 0.0
    #: time constant with which a rate of change fades (Gauss-Markov process), s. 0: it
    #: stays
    memory: float = 0.0
    #: name of the kind whose rate of change this is. Empty: of none
    feeds: str = ""


ERROR_KINDS = (
    StateKind("bias", "rad/s", False, (ONE,), GIVEN, GIVEN),
    # 0.006 % of scale an hour, by temperature.
    StateKind("scale", "", False, (RATE_X, RATE_Y, RATE_Z), GIVEN, 1e-6),
    # 0.1 ms of delay in a second, by load.
    StateKind("delay", "s", True, (TURN,), GIVEN, 1e-4),
    # 6 mrad/s in the 20 min in which a sensor warms up.
    StateKind("bias rate", "rad/s^2", False, (), 5e-6, memory=1200.0, feeds="bias"),
    # 100 ppm: two quartzes of 50 ppm.
    StateKind("clock rate", "s/s", True, (), 1e-4, memory=7200.0, feeds="delay"),
    # Half the difference between the scale factors of positive and negative rates.
    StateKind("asymmetry", "", False, (SPEED,), GIVEN, 1e-6),
)
"""Biases come first. Add new kinds at the end."""
MULTIPLIERS = tuple(by for kind in ERROR_KINDS for by in kind.by)
"""Of each signal of a channel, those of all kinds in order."""
SIGNALS = len(MULTIPLIERS)
MAX_STATES = sum(
    (MAX_UNITS - 1 if kind.per_unit else MAX_CHANNELS) * max(len(kind.by), 1)
    for kind in ERROR_KINDS
)

States = Annotated[NDArray[np.float64], "f8", (MAX_STATES,)]
Places = Annotated[NDArray[np.int64], "i8", (MAX_STATES,)]
Covariance = Annotated[NDArray[np.float64], "f8", (MAX_STATES, MAX_STATES)]
Entries = Annotated[NDArray[np.int64], "i8", (MAX_CHANNELS, SIGNALS)]
Signals = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS, SIGNALS)]
Columns = Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS, MAX_STATES)]


@record
class Layout:
    """Which states exist, and how they change with time."""

    n: Whole  # channels
    axes: Axes  # sensitivity axes (n, 3)
    count: Whole  # states
    by: Annotated[NDArray[np.int64], "i8", (SIGNALS,)]  # what each signal is
    place: Entries  # state of each signal of a channel, or -1
    prior: States  # standard deviation, in the unit of each
    walk: States  # per sqrt(s)
    # standard deviation, per axis of the body, of the scale errors common to all channels
    shared_scale: Real
    memory: States  # time constant, s, or 0 if infinite
    feeds: Places  # state of which this one is the rate of change, or -1
    delays: Annotated[
        NDArray[np.int64], "i8", (MAX_UNITS,)
    ]  # state of the delay of each unit, or -1


@record
class ErrorStates:
    """Estimates x of all states and their covariance P."""

    x: States
    p: Covariance


@record
class Projection:
    """Effect of the states on the channels."""

    signals: Signals
    columns: Columns  # (P C')', one row a channel
    covariance: Square  # C P C', (rad/s)^2
    weighted: Columns  # (P C' A)'
    share: States  # of its gain that each state takes, 0 to 1


def places_of(name: str, n: int, units: int) -> list[list[int]]:
    """States of a kind: of each channel, or of each unit but the first, one list."""
    at = 0
    for kind in ERROR_KINDS:
        owners = max(units - 1, 0) if kind.per_unit else n
        each = max(len(kind.by), 1)
        if kind.name == name:
            return [
                [at + owner * each + k for k in range(each)] for owner in range(owners)
            ]
        at += owners * each
    raise KeyError(name)


def prepare_layout(
    layout: NDArray[np.void],
    axes: Array,
    unit: NDArray[np.int64],
    units: int,
    priors: Mapping[str, float | Array],
    walks: Mapping[str, float | Array],
) -> None:
    """Fill a record of `Layout` from the axes (n, 3) and the number of the unit of each channel, unit (n,).

    ``priors``, ``walks``: standard deviations and random walks by the names of kinds,
    scalar or (n,), that stand in place of the table's. `ValueError` if one is in
    neither. With priors of zero the last kind has no states.
    """
    n = len(unit)
    layout["axes"][:n] = axes
    layout["n"] = n
    layout["by"] = MULTIPLIERS
    layout["place"] = -1
    layout["feeds"] = -1
    layout["delays"] = -1
    count = signals = 0
    for kind in ERROR_KINDS:
        owners = places_of(kind.name, n, units)
        own = slice(signals, signals + len(kind.by))
        signals = own.stop
        prior, walk = (
            np.broadcast_to(given.get(kind.name, usual), max(n, len(owners)))
            for given, usual in ((priors, kind.prior), (walks, kind.walk))
        )
        if np.isnan(prior).any() or np.isnan(walk).any():
            raise ValueError(f"prior and walk of the {kind.name} must be given")
        if kind is ERROR_KINDS[-1] and not prior.any():
            # No state depends on the places of the last kind, so it costs nothing.
            break
        for owner, places in enumerate(owners):
            count += len(places)
            layout["prior"][places] = prior[owner]
            layout["walk"][places] = walk[owner]
            layout["memory"][places] = kind.memory
            if kind.feeds:
                layout["feeds"][places] = places_of(kind.feeds, n, units)[owner]
            if kind.name == "delay":
                layout["delays"][owner + 1] = places[0]
            for i in np.flatnonzero(unit == owner + 1) if kind.per_unit else [owner]:
                layout["place"][i, own] = places[: len(kind.by)]
    layout["count"] = count


@compiled
def begin_states(layout: Layout, states: ErrorStates, bias_std: Array) -> None:
    """Begin with the priors, and with standard deviations (n,) of the biases, rad/s."""
    for r in range(layout.count):
        states.x[r] = 0.0
        for c in range(layout.count):
            states.p[r, c] = 0.0
        std = bias_std[r] if r < layout.n else layout.prior[r]
        states.p[r, r] = std * std
    add_shared_scale(layout, states)


@compiled
def shared_variance(layout: Layout, at: Projection, i: int) -> float:
    """Return the variance of channel i by scale errors that all channels share, (rad/s)^2."""
    if layout.shared_scale == 0.0:
        return 0.0
    variance = 0.0
    for signal in range(SIGNALS):
        axis = layout.by[signal] - RATE_X
        if 0 <= axis < 3:
            scale = layout.shared_scale * layout.axes[i, axis]
            variance += (scale * at.signals[i, signal]) ** 2
    return variance


@compiled
def add_shared_scale(layout: Layout, states: ErrorStates) -> None:
    """Add the covariance of scale errors, one for each axis of the body, that all channels share."""
    variance = layout.shared_scale * layout.shared_scale
    for signal in range(SIGNALS):
        axis = layout.by[signal] - RATE_X
        if not 0 <= axis < 3 or variance == 0.0:
            continue
        for i in range(layout.n):
            for j in range(layout.n):
                shared = variance * layout.axes[i, axis] * layout.axes[j, axis]
                states.p[layout.place[i, signal], layout.place[j, signal]] += shared


@compiled
def predict(layout: Layout, states: ErrorStates, seconds: float) -> None:
    """Predict the states over a time, s: rates of change integrate, and every state walks at random."""
    x = states.x
    p = states.p
    count = layout.count
    for r in range(count):
        to = layout.feeds[r]
        if to >= 0:
            fade = math.exp(-seconds / layout.memory[r])
            run = layout.memory[r] * (1.0 - fade)
            x[to] += run * x[r]
            x[r] *= fade
            for c in range(count):
                p[to, c] += run * p[r, c]
                p[r, c] *= fade
            for c in range(count):
                p[c, to] += run * p[c, r]
                p[c, r] *= fade
            p[r, r] += layout.prior[r] * layout.prior[r] * (1.0 - fade * fade)
        p[r, r] += seconds * layout.walk[r] * layout.walk[r]


@compiled
def fill_signals(
    layout: Layout, rate: Array, angular_acceleration: Array, signals: Array
) -> None:
    """Signals (n, `SIGNALS`) at a body rate (3,) rad/s and an angular acceleration along each channel (n,) rad/s^2."""
    for i in range(layout.n):
        for k in range(SIGNALS):
            by = layout.by[k]
            if by == ONE:
                signals[i, k] = 1.0
            elif by == TURN:
                signals[i, k] = -angular_acceleration[i]
            elif by == SPEED:
                signals[i, k] = abs(along(layout.axes[i], rate))
            else:
                signals[i, k] = rate[by - RATE_X]


@compiled
def project(layout: Layout, states: ErrorStates, at: Projection) -> None:
    """Work out P C' and C P C' for ``at.signals``."""
    n = layout.n
    count = layout.count
    for i in range(n):
        row = at.columns[i]
        for r in range(count):
            row[r] = 0.0
        for k in range(SIGNALS):
            place = layout.place[i, k]
            share = at.signals[i, k]
            if place >= 0 and share != 0.0:
                # P is symmetric: a row is read in place of a column.
                for r in range(count):
                    row[r] += share * states.p[place, r]
    for i in range(n):
        for j in range(n):
            total = 0.0
            for k in range(SIGNALS):
                place = layout.place[j, k]
                share = at.signals[j, k]
                if place >= 0 and share != 0.0:
                    total += share * at.columns[i, place]
            at.covariance[i, j] = total


@compiled
def subtract_errors(
    layout: Layout, states: ErrorStates, signals: Array, values: Array, out: Array
) -> None:
    """Subtract the estimated errors from values (n,), rad/s."""
    for i in range(layout.n):
        total = values[i]
        for k in range(SIGNALS):
            place = layout.place[i, k]
            if place >= 0:
                total -= states.x[place] * signals[i, k]
        out[i] = total


@compiled
def reduce_row(row: Array, r: int, gain: float, share: Array, column: Array) -> None:
    """Take the gain of state r off the lower part of its row of the covariance."""
    if share[r] == 1.0:
        # The whole gain, as of most states: the same in fewer operations.
        for c in range(r + 1):
            row[c] -= gain * column[c]
        return
    for c in range(r + 1):
        taken = 1.0 - (1.0 - share[r]) * (1.0 - share[c])
        row[c] -= taken * gain * column[c]


@compiled
def update(
    layout: Layout,
    states: ErrorStates,
    at: Projection,
    information: Array,
    innovation: Array,
    weight: float,
    least: Array,
) -> None:
    """Update the states by a measurement: x += D P C' A (y - C x), P -= D G + G D - D G D.

    Here G = P C' A C P, and D is diagonal. As A M A = A, this is the covariance for any
    D (Joseph). D, in ``at.share``, leaves every state its least variance.

    Parameters
    ----------
    information
        A (n, n), s^2/rad^2. Rows of channels left out are zero.
    innovation
        y - C x (n,), rad/s. Entries of channels left out are not read.
    weight
        Of the measurement, 0 to 1.
    least
        Least variance of each state (states,), 0 without a bound.
    """
    count = layout.count
    share = at.share
    for j in range(layout.n):
        if information[j, j] != 0.0:
            fill_gain(layout, at, information, j, weight)
    fill_shares(layout, states, at, information, least)
    for j in range(layout.n):
        if information[j, j] != 0.0:
            gain = at.weighted[j]
            column = at.columns[j]
            for r in range(count):
                states.x[r] += share[r] * gain[r] * innovation[j]
                reduce_row(states.p[r], r, gain[r], share, column)
    for r in range(count):
        for c in range(r):
            states.p[c, r] = states.p[r, c]


@compiled
def fill_shares(
    layout: Layout,
    states: ErrorStates,
    at: Projection,
    information: Array,
    least: Array,
) -> None:
    """Find the share of the gain that each state takes, so that every state keeps its least variance (states,).

    A share d of the gain takes ``(1 - (1 - d)^2) G_rr`` off the variance.
    """
    for r in range(layout.count):
        at.share[r] = 1.0
        if least[r] > 0.0:
            gained = variance_gained(layout, at, information, r)
            variance = states.p[r, r]
            if gained > 0.0 and variance - gained < least[r]:
                allowed = min(max(variance - least[r], 0.0) / gained, 1.0)
                at.share[r] = 1.0 - math.sqrt(1.0 - allowed)
        elif layout.feeds[r] >= layout.n:
            # A rate of change is learned together with its state.
            at.share[r] = at.share[layout.feeds[r]]


@compiled
def variance_gained(
    layout: Layout, at: Projection, information: Array, r: int
) -> float:
    """Variance G_rr that the full gain takes off state r."""
    gained = 0.0
    for j in range(layout.n):
        if information[j, j] != 0.0:
            gained += at.weighted[j, r] * at.columns[j, r]
    return gained


@compiled
def keep_least_variance(
    layout: Layout, i: int, by: int, variance: float, least: Array
) -> None:
    """Bound the variance of the states of channel i with multiplier ``by``. A unit takes its best axis."""
    for k in range(SIGNALS):
        place = layout.place[i, k]
        if layout.by[k] == by and place >= 0:
            known = least[place]
            least[place] = variance if known == 0.0 else min(known, variance)


@compiled
def fill_gain(
    layout: Layout, at: Projection, information: Array, j: int, weight: float
) -> None:
    """Column j of P C' A, into ``at.weighted``."""
    row = at.weighted[j]
    for r in range(layout.count):
        row[r] = 0.0
    for i in range(layout.n):
        share = weight * information[i, j]
        if share != 0.0:
            for r in range(layout.count):
                row[r] += share * at.columns[i, r]


@compiled
def bound_variance(
    layout: Layout, states: ErrorStates, place: int, value: float, variance: float
) -> None:
    """Bound the variance of a state to the variance of a value, which moves the state towards it.

    A value adds only the information that the state does not have yet, however often it is given.
    """
    before = states.p[place, place]
    if before <= variance:
        return
    share = (before - variance) / before
    step = share * (value - states.x[place])
    for r in range(layout.count):
        states.x[r] += step * states.p[r, place] / before
        if r != place:
            for c in range(layout.count):
                if c != place:
                    product = states.p[r, place] * states.p[place, c]
                    states.p[r, c] -= share * product / before
    for r in range(layout.count):
        states.p[r, place] *= 1.0 - share
        states.p[place, r] = states.p[r, place]


@compiled
def copy_states(layout: Layout, source: ErrorStates, target: ErrorStates) -> None:
    """Copy all states."""
    for r in range(layout.count):
        target.x[r] = source.x[r]
        for c in range(layout.count):
            target.p[r, c] = source.p[r, c]
