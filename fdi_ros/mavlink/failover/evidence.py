# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence for failover: raw rates of the IMUs compared, beside the monitor's states.

The monitor removes learned errors from the samples and remembers declarations. The raw
comparison does neither and shows the present difference of the autopilot's own gyros.

`Evidence.look` lists the steps. Each rule of docs/failover.md has a module:

=====================  ==================================================================
`failover.records`     memory of each IMU, and the present comparison of all
`failover.apart`       how far two IMUs are apart
`failover.off`         whether an IMU is off
`failover.moves`       which axes move
`failover.trust`       which IMUs have trust, on all axes or on some
`failover.counts`      which IMUs count on an axis
`failover.outvoted`    on which axes two IMUs outvote the third
`failover.accused`     which IMU is accused by a set, or bad without an accusation
`failover.bad`         when an IMU is bad: the rule that takes it out
`failover.agrees`      since when an IMU agrees
`failover.turns`       how an IMU is bad, and which turns show that it measures again
`failover.alike`       IMUs that fail alike: agreement that proves nothing
`failover.wrong`       how large the error of an axis was in proportion to the rate
`failover.size`        the size of an error in a text
=====================  ==================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover.accused import Accusation, Standing, accusation
from fdi_ros.mavlink.failover.agrees import note_agreement
from fdi_ros.mavlink.failover.apart import PairMemory, steady_differences
from fdi_ros.mavlink.failover.bad import bad_axes
from fdi_ros.mavlink.failover.counts import partners
from fdi_ros.mavlink.failover.moves import LastTurns, note_moves
from fdi_ros.mavlink.failover.off import (
    is_forgotten,
    least_difference,
    note_nearest,
    note_sizes,
)
from fdi_ros.mavlink.failover.policy import Imu
from fdi_ros.mavlink.failover.raw import RawComparison
from fdi_ros.mavlink.failover.records import AXES, Present, Track
from fdi_ros.mavlink.failover.size import error_of
from fdi_ros.mavlink.failover.trust import (
    agreement_of_all,
    note_proven,
    note_trust,
)
from fdi_ros.mavlink.failover.turns import note_wrong
from fdi_ros.mavlink.failover.wrong import Wrong
from fdi_ros.mavlink.protocol import NS

SILENCE = NS // 2  #: An IMU without samples for this time does not deliver, ns.
STATES_KNOWN_FOR_NS = 5 * NS  #: Older states of the monitor are unknown, ns.

#: An axis counts as judged for this time after the monitor last judged it, ns: it leaves all
#: axes out for up to 0.5 s where a turn begins.
JUDGED_FOR_NS = NS

#: States of channels that the monitor has declared: alone, or with others of which one is faulty.
DECLARED = {ChannelState.AMBIGUOUS, ChannelState.FAULTY}
#: States of channels of which a fault would not be seen.
UNJUDGED = {ChannelState.UNCHECKED, ChannelState.EXCLUDED, ChannelState.STALE}
JUDGED = set(ChannelState) - UNJUDGED
STATES = {int(state): state for state in ChannelState}


class Evidence:
    """Joins the monitor's states and the raw comparison to an `Imu` for each IMU.

    Parameters
    ----------
    count
        Number of IMUs. The monitor has three channels for each.
    interval
        Time between two samples of an IMU, ns.
    min_size
        Smallest difference at which an IMU is off, rad/s. 5 % of the smaller of the two
        rates add to it.
    """

    def __init__(self, count: int, interval: int, min_size: float) -> None:
        self.heard = 0  #: Time of the monitor's last states, ns. 0: none.
        self.begun = 0  #: Time from which states have come without a break, ns.
        self.raw = RawComparison(count, interval)
        self.imus: tuple[Imu, ...] = (Imu(),) * count
        self.tracks = [Track() for _ in range(count)]
        self._interval = interval
        self._min_size = min_size
        self._looked_at = 0  # ns
        self._pairs = PairMemory()
        self._last_turns = LastTurns()
        self._all_agree_since: int | None = None  # ns
        self._standing = Standing()

    def remember(self, bad: Mapping[int, Mapping[str, Wrong]]) -> None:
        """Take how IMUs were bad before a restart, by axis."""
        for k, axes in bad.items():
            track = self.tracks[k]
            track.wrong = {AXES.index(name): wrong for name, wrong in axes.items()}
            track.was_off = set(track.wrong)

    def bad(self, unit: int) -> dict[str, Wrong]:
        """Return how an IMU is or was bad, by axis, in steps that a file can keep."""
        wrong = sorted(self.tracks[unit].wrong.items())
        return {AXES[axis]: one.in_steps() for axis, one in wrong}

    def bound(self, unit: int) -> float:
        """Return a bound on the difference of an IMU to the nearest other one now, rad/s."""
        return self.tracks[unit].bound

    def error(self, unit: int, now: int) -> tuple[str, float] | None:
        """Return the axis on which an IMU is off most, and by how much, rad/s, if known."""
        return error_of(self.raw, self.imus, unit, self._interval, now)

    def hear(self, states: Sequence[float], now: int) -> None:
        """Take the states of all channels, numbers of `ChannelState`, at time now, ns."""
        if now - self.heard >= SILENCE:
            self.begun = now
        self.heard = now
        found = [STATES[int(state)] for state in states]
        for k, track in enumerate(self.tracks):
            before = track.faulty_axes
            track.states = tuple(found[3 * k : 3 * k + 3])
            declared = track.faulty_axes - before
            in_sets = track.axes(ChannelState.AMBIGUOUS)
            for axis in declared | ({0, 1, 2} - before - in_sets):
                track.accused_at[axis] = now
            for axis in track.axes(*JUDGED):
                track.judged_at[axis] = now

    def look(
        self,
        delivers: Sequence[bool],
        out: Sequence[int],
        now: int,
        taken: Sequence[int] = (),
    ) -> tuple[Imu, ...]:
        """Return the IMUs at time now, ns.

        Parameters
        ----------
        delivers
            Whether each IMU delivers samples.
        out
            IMUs, from 0, out of use by our orders. Two bad IMUs may agree with each
            other, so agreement with these counts only while they are trusted.
        taken
            IMUs that our orders took out of use in this flight, back in use or not.
        """
        self._forget_old_states(now)
        self.raw.leave_out(out)
        present = self._compare(delivers, out, now, taken)
        note_moves(present, self._last_turns)
        self._note_trust(present)
        accused = self._standing.lasting(accusation(present), now)
        for unit, track in enumerate(self.tracks):
            track.partners = partners(present, unit)
            note_nearest(present, unit)
        # In turn: others may fail like an IMU whose errors were noted just before.
        self.imus = tuple(
            self._judge(present, unit, accused) for unit in range(len(self.tracks))
        )
        return self.imus

    def _forget_old_states(self, now: int) -> None:
        """Forget the states of a monitor that is silent."""
        if now - self.heard >= STATES_KNOWN_FOR_NS:
            for track in self.tracks:
                track.states = ()

    def _compare(
        self,
        delivers: Sequence[bool],
        out: Sequence[int],
        now: int,
        taken: Sequence[int],
    ) -> Present:
        """Return the present comparison of all IMUs."""
        units = [k for k, does in enumerate(delivers) if does]
        steady = steady_differences(self.raw, units, now)
        self._pairs.update(self.raw, units, steady, now)
        elapsed = now - self._looked_at
        self._looked_at = now
        all_taken = {*out, *taken}
        return Present(
            now=now,
            elapsed=elapsed,
            min_size=self._min_size,
            units=units,
            out=set(out),
            taken=all_taken,
            # One that is back regains its vote by turns about all axes: dead, it had not
            # agreed.
            no_voters={
                k for k in all_taken if k in out or len(self.tracks[k].shown) < 3
            },
            raw=self.raw,
            pairs=self._pairs.compared,
            steady=steady,
            tracks=self.tracks,
        )

    def _note_trust(self, present: Present) -> None:
        """Note which IMUs have trust, on all axes or on some."""
        self._all_agree_since = agreement_of_all(present, self._all_agree_since)
        for unit in present.units:
            note_trust(present, unit, self._all_agree_since)
            note_proven(present, unit)

    def _judge(self, present: Present, unit: int, accused: Accusation) -> Imu:
        """Note whether an IMU agrees, and how it is bad, and return it."""
        track = self.tracks[unit]
        agreed = note_agreement(present, unit)
        note_sizes(present, unit, agreed)
        is_accused = unit == accused.unit
        axes: Set[int] = track.faulty_axes
        if is_accused:
            axes |= accused.axes
        bad = bad_axes(present, unit, axes)
        if unit in present.out or bad:
            note_wrong(present, unit, axes)
        elif is_forgotten(present, agreed):
            track.wrong.clear()
        return self._described(present, unit, is_accused, bad, agreed)

    def _described(
        self,
        present: Present,
        unit: int,
        is_accused: bool,
        bad: set[int],
        agreed: int | None,
    ) -> Imu:
        """Return what the policy must know of an IMU."""
        track = self.tracks[unit]
        named = bool(track.faulty_axes) or is_accused
        is_known = bool(track.states) or is_accused
        fine = self._fine_axes(unit)
        is_stuck = self.raw.is_stuck(unit)
        unjudged = {
            axis
            for axis, at in enumerate(track.judged_at)
            if present.now - at >= JUDGED_FOR_NS
        }
        return Imu(
            named=named if is_known else None,
            blamed=bool(bad),
            worst=_worst_axis(track, bad),
            ok=track.is_ok and bool(fine) and not is_stuck,
            fine=fine,
            delivers=unit in present.units,
            stuck=is_stuck,
            unjudged=_names(unjudged),
            declared=_names(track.axes(*DECLARED)),
            size=max(track.sizes),
            least=least_difference(present, unit),
            agreed=agreed,
            waits=_names(track.waits),
            votes=unit not in present.no_voters,
        )

    def _fine_axes(self, unit: int) -> str:
        """Return the axes that the monitor finds OK, such as xy.

        Empty if there is another one, unless it is unchecked because all other IMUs are FAULTY
        there: nothing is left that could show a fault of the last one. Empty if the monitor has
        doubted an axis since the IMU is off there: it may have withdrawn that for a moment.
        """
        track = self.tracks[unit]
        if track.questioned:
            return ""
        others = [other for k, other in enumerate(self.tracks) if k != unit]
        faulty = [other.faulty_axes for other in others]
        alone = track.axes(ChannelState.UNCHECKED).intersection(*faulty)
        fine = track.axes(ChannelState.OK)
        return _names(fine) if len(fine | alone) == 3 else ""


def _worst_axis(track: Track, bad: set[int]) -> str:
    """Return the axis that is off most, if it is bad there."""
    axis = max(range(3), key=track.sizes.__getitem__)
    return AXES[axis] if axis in bad else ""


def _names(axes: set[int]) -> str:
    """Return the names of axes, such as xz."""
    return "".join(AXES[axis] for axis in sorted(axes))
