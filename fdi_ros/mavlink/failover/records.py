# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Records on which the rules of failover judge: the memory, and the present comparison.

`Track` is the memory of one IMU. `Present` is the comparison of all IMUs at one time:
rules read it and change nothing in it. Functions named ``note_...`` write into tracks.

docs/failover.md, "Words", has *doubt*. "When an IMU is bad" has *named for this difference*: the
difference is twice ``failover_min_size``, and the accusation came at most 0.3 s before the
difference reached this size (`Track.is_newly_accused`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import NamedTuple

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.policy import LONG_AGO
from fdi_ros.mavlink.failover.raw import UNKNOWN_RATES, RawComparison
from fdi_ros.mavlink.failover.wrong import Wrong
from fdi_ros.mavlink.protocol import MS, Vector

AXES = "xyz"

#: States of channels that are a doubt.
DOUBTS = {
    ChannelState.SUSPECT,
    ChannelState.AMBIGUOUS,
    ChannelState.FAULTY,
    ChannelState.STALE,
}

#: A name is for a difference that reached twice ``min_size`` at most this time after the
#: accusation, ns. An earlier accusation is for another error.
NEW_FOR_NS = 300 * MS

#: Multiple of ``min_size`` that an error must reach without an outvote, because the errors of
#: both IMUs may add up. A set of several IMUs and a suspicion need it as well.
BOTH_ERRORS = 2.0

#: Two IMUs, in either order.
Pair = tuple[int, int]


class Compared(NamedTuple):
    """How far two IMUs are apart now, by axis, rad/s. NaN: unknown."""

    #: Their difference, if steady, or a wild oscillation. 0: neither.
    apart: Vector
    bound: Vector  #: The same, steady or not, or a scatter that is not calm.
    mean: Vector  #: Their mean difference, steady or not, less what scales and delays explain.
    full: Vector  #: Their mean difference, steady or not, less what delays explain.


UNCOMPARED = Compared(*[UNKNOWN_RATES] * 4)


class Partners(NamedTuple):
    """IMUs that count for an IMU: it is compared with these."""

    on: tuple[Set[int], ...] = (frozenset(),) * 3  #: By axis.
    common: Set[int] = frozenset()  #: On all axes.
    are_fit: bool = False  #: They are in use, trusted or proven.


NO_PARTNERS = Partners()


@dataclass
class Track:
    """Memory of one IMU. Times in ns."""

    #: States of its three channels. Empty: unknown.
    states: tuple[ChannelState, ...] = ()
    #: When the monitor last judged each axis.
    judged_at: list[int] = field(default_factory=lambda: [LONG_AGO] * 3)
    #: When each axis became FAULTY, or was last not accused.
    accused_at: list[int] = field(default_factory=lambda: [0] * 3)
    #: Doubts of the monitor at the last look.
    last_doubts: set[ChannelState] = field(default_factory=set)
    doubts_since: int = 0  #: Since when the doubts are these.

    # The difference to the IMUs that count.
    partners: Partners = NO_PARTNERS  #: IMUs that count.
    nearest: Vector = UNKNOWN_RATES  #: Difference to the nearest partner, rad/s.
    bound: float = math.nan  #: A bound on that, rad/s.
    sizes: Vector = UNKNOWN_RATES  #: Largest difference of late, by axis, rad/s.
    #: When the size of each axis was last below twice ``min_size``.
    near_at: list[int] = field(default_factory=lambda: [0] * 3)
    #: Axes that are off, and that the monitor has doubted since.
    questioned: set[int] = field(default_factory=set)

    # Moves and trust.
    #: When the last motion of each axis began.
    moved_at: list[int] = field(default_factory=lambda: [LONG_AGO] * 3)
    moves: set[int] = field(default_factory=set)  #: Axes that move.
    #: Axes that have moved since the IMU was last found bad on a further axis.
    proven: set[int] = field(default_factory=set)
    #: Axes on which the IMU is found bad, and whether by the monitor.
    found_bad: set[tuple[int, bool]] = field(default_factory=set)
    found_bad_at: int = 0  #: When a further one was found.
    #: Axes that were off from all others since the IMU was last trusted. A gyro that has lost
    #: its scale agrees with another bad one at some rate, so these are not proven.
    was_off: set[int] = field(default_factory=set)
    #: Doubts of the monitor that agreement has refuted. None: the IMU is not trusted.
    refuted: set[ChannelState] | None = None
    #: Has agreed in a turn since the IMU was last off from all others.
    has_turned: bool = False

    # Agreement.
    agreed_since: int | None = None  #: Since when the IMU agrees with another.
    agreed_at: int = 0  #: When the IMU last agreed.
    #: Since when it agrees, from a turn on that shows all its errors.
    turned_since: int | None = None
    wrong: dict[int, Wrong] = field(default_factory=dict)  #: How each axis was bad.
    #: Axes that have agreed in a turn that shows how they were bad, or that they are not
    #: dead, since the IMU agrees.
    shown: set[int] = field(default_factory=set)

    @property
    def is_ok(self) -> bool:
        """The monitor finds all channels OK."""
        return set(self.states) == {ChannelState.OK}

    @property
    def is_trusted(self) -> bool:
        """The IMU has trust on all axes."""
        return self.refuted is not None

    @property
    def doubts(self) -> set[ChannelState]:
        """Doubts that the monitor has now."""
        return DOUBTS.intersection(self.states)

    @property
    def doubted_axes(self) -> set[int]:
        """Axes that the monitor doubts now."""
        return self.axes(*DOUBTS)

    @property
    def faulty_axes(self) -> set[int]:
        """Axes that the monitor finds FAULTY now."""
        return self.axes(ChannelState.FAULTY)

    @property
    def waits(self) -> set[int]:
        """Axes that were bad, and have not agreed in a turn that shows this."""
        return self.wrong.keys() - self.shown

    def is_newly_accused(self, axis: int) -> bool:
        """Return whether the accusation of an axis came with its present difference."""
        return self.near_at[axis] - self.accused_at[axis] < NEW_FOR_NS

    def axes(self, *wanted: ChannelState) -> set[int]:
        """Return the axes to which the monitor gives a wanted state."""
        return {axis for axis, state in enumerate(self.states) if state in wanted}


class Present(NamedTuple):
    """The present comparison of all IMUs. Rules only read it."""

    now: int  #: ns
    elapsed: int  #: Time since the comparison before this one, ns.
    min_size: float  #: Smallest difference at which an IMU is off, rad/s.
    units: Sequence[int]  #: IMUs that deliver samples, in the order of their numbers.
    out: Set[int]  #: IMUs out of use by our orders.
    taken: Set[
        int
    ]  #: IMUs that our orders took out in this flight, back in use or not.
    no_voters: Set[int]  #: IMUs of `taken` that are no voters.
    raw: RawComparison  #: Raw rates of all IMUs.
    #: How far each pair is apart.
    pairs: Mapping[Pair, Compared]
    #: The smallest steady difference of each pair within 50 ms, by axis, rad/s.
    steady: Mapping[Pair, Vector]
    tracks: Sequence[Track]  #: Memory of each IMU.

    @property
    def both_errors(self) -> float:
        """Twice ``min_size``, rad/s: the errors of both IMUs may add up."""
        return BOTH_ERRORS * self.min_size

    def others(self, unit: int) -> list[int]:
        """Return the IMUs that deliver samples, without one."""
        return [k for k in self.units if k != unit]
