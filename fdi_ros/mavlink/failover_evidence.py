# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Evidence for failover: raw samples of the IMUs compared, beside the monitor's states.

The monitor removes learned errors from the samples and remembers declarations. The raw
comparison does neither and shows the present difference of the autopilot's own gyros.

Two of three IMUs can be wrong alike: both stand still, or both are remembered as faulty. So
they outvote the third on an axis only if both have moved of late (`MOVED_BY_RAD_S`), if each
is trusted (`TRUSTED`) or has moved since it was found bad on another axis, and if the monitor
has no doubt about them that it does not have about the third as well. Two that were both taken
out in this flight outvote one that was not only once one of them is back, and has
agreed in turns about all axes. An IMU that was bad proves nothing by agreeing with one that may
have lost a similar part of its scale (`Evidence._is_witness`).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

from fdi_ros.core.states import ChannelState
from fdi_ros.mavlink.failover_policy import Imu
from fdi_ros.mavlink.failover_raw import (
    LARGE_DIFFERENCE,
    UNKNOWN_RATES,
    Difference,
    RawComparison,
    nearest_zero,
    shift,
)
from fdi_ros.mavlink.failover_wrong import (
    ALIKE_SHARES,
    HEALTHY_SCALE,
    WITHOUT_SCALE,
    Wrong,
)
from fdi_ros.mavlink.protocol import MS, NS, Vector

#: Time constant with which the recent largest size decays, s. Once the IMU has agreed
#: for `SIZE_FORGOTTEN_NS`, only the present size counts.
DECAY = 0.5
REFUTING = 300 * MS  #: Agreement refutes a doubt that has stood for this time, ns.
BREAK = 100 * MS  #: A shorter break ends no agreement, and no difference, ns.
#: Time of agreement after which an earlier size is forgotten, ns.
SIZE_FORGOTTEN_NS = NS // 2
#: A set must stand for this time to name an IMU, ns, and a name is for a difference that
#: began at most this time after it.
SET_STANDS = 300 * MS
LONGEST_BREAK = 200 * MS  #: A set stands over a break of this length, ns.
#: Least error of the odd one in a set of several IMUs, or suspected, and of one that is
#: compared with only one other IMU, in ``min_size``.
VOTE = 2.0
SUSPECT_STANDS = NS  #: An IMU must be suspected, and the odd one, for this time, ns.
#: Difference from which the odd IMU needs no doubt of the monitor, rad/s. The monitor takes
#: 0.2 s to exclude a spike. An autopilot whose primary gyro reads zero is at 50 deg then.
CLEAR_DIFFERENCE = 0.5
#: An IMU that the monitor doubts agrees only while the difference scatters by less, rad/s.
CALM = 0.1
#: An IMU agrees, and is trusted, only once another one has turned by this on average, rad/s: a
#: dead gyro agrees with one at rest.
TURN_RATE = 0.1
#: One that was bad agrees only after a turn in which its error, if in proportion to the
#: rate, would be this multiple of ``min_size``, and at least one in which this was so of a
#: dead gyro.
SHOWN = 2.0
#: The same with the range of the driver set wrong: 2000 deg/s in place of 250 reads 8 times the
#: rate, an error of 7 times the rate.
MOST_RANGE_SHARE = 7.0
#: An axis moves if its mean rate and the one of another IMU change alike, by this or more, rad/s. A
#: steady rate is no motion: both axes may be stuck at it.
MOVED_BY_RAD_S = 0.005
#: The change must also exceed this multiple of the noise in the mean. At 3, two axes that died 10 s
#: apart in noise of 6 mrad/s outvote the third IMU in 2 of 12 flights, at 4 in none.
MOVES_SIGMAS = 4.0
MOVES_WITHIN = NS  #: Longest time of that change, ns.
#: An axis that has not moved for this time, ns, may be dead: it is no witness. In the logs of two
#: hovering quadcopters every axis moved all the time; without wind, in simulation, yaw for 87 %. A
#: fault that is flown with turns the vehicle, so that the healthy ones move.
MOVED_FOR = 5 * NS
#: An oscillation with this standard deviation is an error, rad/s.
WILD_OSCILLATION = 1.0
SIZED = 80 * MS  #: The size in a text is averaged over this time, ns.
SECOND_AXIS = 0.5  #: Share of the largest axis from which a second one is off as well.
ALIKE = 0.05  #: Two IMUs agree within this share of the odd one's difference, too.
TRUSTED = 2 * NS  #: IMUs are trusted after all have agreed for this time, ns.
#: States of channels that are a doubt.
DOUBTS = {
    ChannelState.SUSPECT,
    ChannelState.AMBIGUOUS,
    ChannelState.FAULTY,
    ChannelState.STALE,
}
#: States of channels that the monitor has declared: alone, or with others of which one is faulty.
DECLARED = {ChannelState.AMBIGUOUS, ChannelState.FAULTY}
STATES = {int(state): state for state in ChannelState}
#: States of channels of which a fault would not be seen.
UNJUDGED = {ChannelState.UNCHECKED, ChannelState.EXCLUDED, ChannelState.STALE}
JUDGED = set(ChannelState) - UNJUDGED
KNOWN_SIGMAS = 5.0  #: Standard deviations from which a size is known.
SILENCE = NS // 2  #: An IMU without samples for this time does not deliver, ns.
STATES_KNOWN_FOR = 5 * NS  #: Older states of the monitor are unknown, ns.
#: An axis counts as judged for this time after the monitor last judged it, ns: it leaves all
#: axes out for up to 0.5 s where a turn begins.
JUDGED_FOR = NS

AXES = "xyz"
NOBODY: tuple[int, set[int], int] = (-1, set(), 0)


class Compared(NamedTuple):
    """How far two IMUs are apart now, by axis, rad/s. NaN: unknown."""

    #: If steady, or a wild oscillation. 0: what a mean leaves of another.
    apart: Vector
    bound: Vector  #: A bound that two that agree keep: mean, or scatter from `CALM` on.
    mean: Vector  #: Steady or not.
    full: Vector  #: The same, with what scales explain.


class Partners(NamedTuple):
    """IMUs with which one is compared."""

    on: tuple[Set[int], ...] = (frozenset(),) * 3  #: By axis.
    common: Set[int] = frozenset()  #: On all axes.
    are_fit: bool = False  #: They are in use, trusted or proven.


NO_PARTNERS = Partners()


UNCOMPARED = Compared(*[UNKNOWN_RATES] * 4)


@dataclass
class Track:
    """What is remembered of one IMU. Times in ns."""

    #: States of its three channels. Empty: unknown.
    states: tuple[ChannelState, ...] = ()
    judged_at: list[int] = field(default_factory=lambda: [-NS] * 3)  #: Last, by axis.
    nearest: Vector = UNKNOWN_RATES  #: Difference to the nearest partner, rad/s.
    bound: float = math.nan  #: A bound on that, rad/s.
    sizes: Vector = UNKNOWN_RATES  #: Largest difference of late, by axis, rad/s.
    #: IMUs with which this one is compared
    partners: Partners = NO_PARTNERS
    #: When each axis was last not named, or became FAULTY.
    unnamed_at: list[int] = field(default_factory=lambda: [0] * 3)
    #: When each axis was last apart by less than `VOTE` times ``min_size``.
    near_at: list[int] = field(default_factory=lambda: [0] * 3)
    #: Axes that are apart, and that the monitor has doubted since.
    questioned: set[int] = field(default_factory=set)
    #: Doubts of the monitor that agreement has refuted. None: the IMU is not trusted.
    refuted: set[ChannelState] | None = None
    doubted: set[ChannelState] = field(default_factory=set)  #: Last doubts.
    doubted_at: int = 0  #: Since when they are these.
    agreed: int | None = None  #: Since when the IMU agrees with another.
    agreed_at: int = 0  #: When the IMU last agreed.
    #: The same, from a turn that shows an error in proportion to the rate.
    turned: int | None = None
    wrong: dict[int, Wrong] = field(
        default_factory=dict
    )  #: How it was bad last, by axis.
    #: Axes that have agreed in a turn that shows this, or that they are not dead, since the
    #: IMU agrees.
    shown: set[int] = field(default_factory=set)
    #: Has agreed in a turn since the last time apart from all others.
    has_shown: bool = False
    #: When the last motion of each axis began.
    moved_at: list[int] = field(default_factory=lambda: [-MOVED_FOR] * 3)
    moves: set[int] = field(default_factory=set)  #: Axes that have moved of late.
    #: Those that have done so since the monitor or the raw rates last found a further axis bad.
    proven: set[int] = field(default_factory=set)
    bad: set[tuple[int, bool]] = field(default_factory=set)  #: Axes, and by whom.
    unproven_at: int = 0  #: When the last one was found.
    #: Axes that were apart from all others since it was last trusted. A gyro that has lost its
    #: scale agrees with another bad one at some rate, so these are not proven.
    off: set[int] = field(default_factory=set)

    @property
    def is_ok(self) -> bool:
        """The monitor finds all channels OK."""
        return set(self.states) == {ChannelState.OK}

    @property
    def doubts(self) -> set[ChannelState]:
        """Doubts that the monitor has now."""
        return DOUBTS.intersection(self.states)

    @property
    def waits(self) -> set[int]:
        """Axes that were bad, and have not agreed in a turn that shows this."""
        return self.wrong.keys() - self.shown

    def is_new(self, axis: int) -> bool:
        """Return whether the name of an axis came with its present difference."""
        return self.near_at[axis] - self.unnamed_at[axis] < SET_STANDS

    def axes(self, *wanted: ChannelState) -> set[int]:
        """Return the axes to which the monitor gives a wanted state."""
        return {axis for axis, state in enumerate(self.states) if state in wanted}


def _worst(sizes: Vector, blamed: set[int]) -> str:
    """Return the axis that is off most, if it is blamed."""
    axis = max(range(3), key=sizes.__getitem__)
    return AXES[axis] if axis in blamed else ""


def _note_sizes(track: Track, agreed: int | None, share: float, now: int) -> None:
    """Note the sizes of late. share: what is left of the last ones."""
    is_healed = agreed is not None and now - agreed >= SIZE_FORGOTTEN_NS
    kept = 0.0 if is_healed else share
    x, y, z = (
        max(new, kept * old)
        for new, old in zip(track.nearest, track.sizes, strict=True)
    )
    track.sizes = x, y, z


def _compared(
    difference: Difference, quick: Vector, scale: float, shifts: Vector
) -> Compared:
    """Return how far two IMUs are apart, less what scales and delays explain.

    Parameters
    ----------
    difference
        Their mean difference.
    quick
        Their smallest difference of late, by axis, rad/s.
    scale
        What scales explain, rad/s.
    shifts
        What delays explain, by axis, rad/s.
    """
    axes = []
    for axis, mean in enumerate(difference.mean):
        spread = difference.spread[axis]
        full = max(0.0, abs(mean) - shifts[axis])
        size = max(0.0, full - scale)
        is_wild = math.hypot(mean, spread) >= WILD_OSCILLATION + scale
        is_steady = difference.steady[axis] or abs(quick[axis]) >= LARGE_DIFFERENCE
        apart = size if is_steady else WILD_OSCILLATION if is_wild else 0.0
        bound = max(size, spread if spread >= CALM else 0.0)
        axes.append((apart, bound, size, full))
    return Compared(*zip(*axes, strict=True))


class Evidence:
    """Joins the monitor's states and the raw comparison to an `Imu` for each IMU.

    Parameters
    ----------
    count
        Number of IMUs. The monitor has three channels for each.
    interval
        Time between two samples of an IMU, ns.
    min_size
        Smallest difference at which an IMU is apart, rad/s. `HEALTHY_SCALE` of the smaller of the
        two rates adds to it.
    """

    def __init__(self, count: int, interval: int, min_size: float) -> None:
        self.heard = 0  #: Time of the monitor's last states, ns. 0: none.
        self.begun = 0  #: Time from which states have come without a break, ns.
        self.raw = RawComparison(count, interval)
        self.imus: tuple[Imu, ...] = (Imu(),) * count
        # Each pair of IMUs, in either order, and when it was last known, ns.
        self._pairs: dict[tuple[int, int], Compared] = {}
        self._known_at: dict[tuple[int, int], int] = {}
        # The smallest steady difference of each at the last look, rad/s.
        self._steady: dict[tuple[int, int], Vector] = {}
        self._tracks = [Track() for _ in range(count)]
        self._delivering: set[int] = set()  # IMUs that send samples
        self._taken: set[int] = set()  # IMUs taken out in this flight
        self._once_bad: set[int] = set()  # those of them without a vote
        self._min_size = min_size
        self._sized = max(2, SIZED // interval)
        self._together: int | None = None  # since when all IMUs agree, ns
        self._odd = -1  # the IMU that is bad without a name, or -1
        self._odd_since = 0
        self._odd_seen = 0
        self._looked = 0
        self._turns: dict[int, Vector] = {}  # mean rates at some time, rad/s
        self._turned_at = 0  # that time, ns

    def remember(self, bad: Mapping[int, Mapping[str, Wrong]]) -> None:
        """Take how IMUs were bad before a restart, by axis."""
        for k, axes in bad.items():
            track = self._tracks[k]
            track.wrong = {AXES.index(name): wrong for name, wrong in axes.items()}
            track.off = set(track.wrong)

    def bad(self, unit: int) -> dict[str, Wrong]:
        """Return how an IMU is or was bad, by axis, in steps that a file can keep."""
        wrong = sorted(self._tracks[unit].wrong.items())
        return {AXES[axis]: one.in_steps() for axis, one in wrong}

    def hear(self, states: Sequence[float], now: int) -> None:
        """Take the states of all channels, numbers of `ChannelState`, at time now, ns."""
        if now - self.heard >= SILENCE:
            self.begun = now
        self.heard = now
        found = [STATES[int(state)] for state in states]
        for k, track in enumerate(self._tracks):
            before = track.axes(ChannelState.FAULTY)
            track.states = tuple(found[3 * k : 3 * k + 3])
            declared = track.axes(ChannelState.FAULTY) - before
            in_sets = track.axes(ChannelState.AMBIGUOUS)
            for axis in declared | ({0, 1, 2} - before - in_sets):
                track.unnamed_at[axis] = now
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
        if now - self.heard >= STATES_KNOWN_FOR:
            for track in self._tracks:
                track.states = ()
        units = [k for k, does in enumerate(delivers) if does]
        self._delivering = set(units)
        self.raw.leave_out(out)
        self._taken = {*out, *taken}
        # One that is back regains its vote by turns about all axes: dead, it had not agreed.
        self._once_bad = {
            k for k in self._taken if k in out or len(self._tracks[k].shown) < 3
        }
        self._compare(units, now)
        self._note_moves(units, now)
        self._note_trust(units, now)
        odd, accused = self._lasting_odd_one(units, now)
        for k, track in enumerate(self._tracks):
            track.partners = self._partners(k, units, out)
            track.nearest = self._nearest(k, track.partners)
            bounds = [max(self._pairs[k, j].bound) for j in track.partners.common]
            track.bound = min(bounds, default=math.nan)
        elapsed = now - self._looked
        held = math.exp(-elapsed / NS / DECAY)
        self._looked = now
        imus = []
        for k, track in enumerate(self._tracks):
            common = track.partners.common
            agreed = self._note_agreement(k, common, k in out, now, elapsed)
            _note_sizes(track, agreed, held, now)
            for axis, size in enumerate(track.sizes):
                if size < VOTE * self._min_size:
                    track.near_at[axis] = now
            near = {
                axis for axis, size in enumerate(track.sizes) if size < self._min_size
            }
            track.questioned = (track.questioned | track.axes(*DOUBTS)) - near
            faulty = track.axes(ChannelState.FAULTY)
            axes = faulty | accused if k == odd else faulty
            blamed = self._blamed_axes(k, axes, units)
            if k in out or blamed:
                self._note_wrong(track, track.partners, axes)
            elif agreed is not None and now - agreed >= SIZE_FORGOTTEN_NS:
                track.wrong.clear()
            is_known = track.states or k == odd
            found_now = Imu(
                named=bool(faulty or k == odd) if is_known else None,
                blamed=bool(blamed),
                worst=_worst(track.sizes, blamed),
                fine=self._fine(k),
                delivers=delivers[k],
                least=self._least(k, units),
                agreed=agreed,
            )
            imus.append(self._described(k, found_now, now))
        self.imus = tuple(imus)
        return self.imus

    def _fine(self, unit: int) -> str:
        """Return the axes that the monitor finds OK, such as xy.

        Empty if there is another one, unless it is unchecked because all other IMUs are FAULTY
        there: nothing is left that could show a fault of the last one. Empty if the monitor has
        doubted an axis since the IMU is apart there: it may have withdrawn that for a moment.
        """
        faulty = [
            track.axes(ChannelState.FAULTY)
            for k, track in enumerate(self._tracks)
            if k != unit
        ]
        track = self._tracks[unit]
        if track.questioned:
            return ""
        alone = track.axes(ChannelState.UNCHECKED).intersection(*faulty)
        fine = track.axes(ChannelState.OK)
        return "".join(AXES[k] for k in sorted(fine)) if len(fine | alone) == 3 else ""

    def _described(self, unit: int, found: Imu, now: int) -> Imu:
        """Add to what was found of an IMU what is remembered of it."""
        track = self._tracks[unit]
        stuck = self.raw.is_stuck(unit)
        unjudged = (
            axis
            for axis, at in zip(AXES, track.judged_at, strict=True)
            if now - at >= JUDGED_FOR
        )
        is_fine = bool(found.fine) and not stuck
        return found._replace(
            ok=track.is_ok and is_fine,
            stuck=stuck,
            size=max(track.sizes),
            votes=unit not in self._once_bad,
            waits="".join(AXES[axis] for axis in sorted(track.waits)),
            unjudged="".join(unjudged),
            declared="".join(AXES[axis] for axis in sorted(track.axes(*DECLARED))),
        )

    def _lasting_odd_one(self, units: Sequence[int], now: int) -> tuple[int, set[int]]:
        """Return the IMU that has been the odd one for long enough, and its axes, or `NOBODY`."""
        odd, axes, lasting = self._odd_one(units, now)
        if odd == self._odd:
            self._odd_seen = now
        elif odd >= 0 or now - self._odd_seen > LONGEST_BREAK:
            self._odd = odd
            self._odd_since = self._odd_seen = now
        return (odd, axes) if now - self._odd_since >= lasting else NOBODY[:2]

    def bound(self, unit: int) -> float:
        """Return a bound on the difference of an IMU to the nearest other one now, rad/s."""
        return self._tracks[unit].bound

    def _compare(self, units: Sequence[int], now: int) -> None:
        """Compare each pair of IMUs."""
        motions = {k: self.raw.motion(k) for k in units}
        for j, k in combinations(units, 2):
            difference = self.raw.between(j, k, now)
            x, y, z = quick = self.raw.steady(j, k, now)
            self._steady[j, k] = quick
            self._steady[k, j] = -x, -y, -z
            if difference is not None:
                self._known_at[j, k] = now
                one, other = motions[j], motions[k]
                scale = HEALTHY_SCALE * min(one.largest, other.largest)
                shifts = shift(one.gain, other.gain)
                found = _compared(difference, quick, scale, shifts)
            elif now - self._known_at.get((j, k), 0) > BREAK:
                found = UNCOMPARED
            else:
                # Of a lossy link: the last values hold.
                continue
            self._pairs[j, k] = self._pairs[k, j] = found

    def _note_moves(self, units: Sequence[int], now: int) -> None:
        """Note which axes move as those of another IMU do."""
        turns = {k: self.raw.motion(k).mean for k in units}
        if now - self._turned_at >= MOVES_WITHIN:
            self._turned_at = now
            self._turns = turns
        for pair in combinations(turns.keys() & self._turns.keys(), 2):
            noise = self.raw.noise(*pair)
            for axis in range(3):
                needed = max(MOVED_BY_RAD_S, MOVES_SIGMAS * noise[axis])
                one, other = (turns[k][axis] - self._turns[k][axis] for k in pair)
                least = abs(nearest_zero((one, other)))
                if least >= needed and abs(one - other) <= least:
                    for k in pair:
                        self._tracks[k].moved_at[axis] = self._turned_at
        for track in self._tracks:
            track.moves = {
                axis for axis, at in enumerate(track.moved_at) if now - at < MOVED_FOR
            }

    def _note_trust(self, units: Sequence[int], now: int) -> None:
        """Note whether all IMUs agree, and which are apart from all others."""
        pairs = list(combinations(units, 2))
        stuck = any(map(self.raw.is_stuck, units))
        agree = pairs and all(
            max(self._pairs[pair].apart) < self._min_size for pair in pairs
        )
        self._together = (self._together or now) if agree and not stuck else None
        for k in units:
            track = self._tracks[k]
            doubts = track.doubts
            if doubts != track.doubted:
                if ChannelState.FAULTY in doubts - track.doubted:
                    # Agreement from before says nothing of a gyro that died since then.
                    track.refuted = track.turned = None
                    track.has_shown = False
                    track.shown.clear()
                track.doubted = doubts
                track.doubted_at = now
            own = [max(self._pairs[k, j].apart) for j in units if j != k]
            is_turning = (
                not track.wrong and math.hypot(*self.raw.motion(k).mean) >= TURN_RATE
            )
            if track.turned is not None or (self._together and is_turning):
                track.has_shown = True
            if self._together is not None and now - self._together >= TRUSTED:
                is_old = now - track.doubted_at >= REFUTING
                if track.has_shown and not track.waits:
                    track.refuted = doubts if is_old else track.refuted or set()
                    track.off.clear()
            elif all(size >= self._min_size for size in own):
                track.refuted = None
                track.has_shown = False
            self._note_proven(k, units, now)

    def _note_proven(self, unit: int, units: Sequence[int], now: int) -> None:
        """Note the axes on which an IMU is known to measure.

        One that is found bad on a further axis may be dead: this counts anew on all. What is
        unknown, such as after a gap, is not bad.
        """
        track = self._tracks[unit]
        pairs = {k: self._pairs[unit, k] for k in units if k != unit}
        named = {(axis, True) for axis in track.axes(ChannelState.FAULTY)}
        off = {
            axis
            for axis in range(3)
            if pairs
            and all(pair.apart[axis] >= self._min_size for pair in pairs.values())
        }
        bad = named | {(axis, False) for axis in off}
        if not bad <= track.bad:
            track.unproven_at = now
        track.bad = bad
        track.off |= off
        # What is averaged may be from before.
        since = track.unproven_at + REFUTING
        moves = track.moves - track.off
        track.proven = {axis for axis in moves if track.moved_at[axis] >= since}

    def _note_agreement(
        self,
        unit: int,
        partners: Collection[int],
        is_out: bool,
        now: int,
        elapsed: int,
    ) -> int | None:
        """Return since when an IMU agrees with another, ns, or None.

        elapsed: time since the last look, ns.
        """
        track = self._tracks[unit]
        doubted = bool(track.doubts)
        # In a fast turn, what scales explain would hide the error of an IMU that was bad.
        was_bad = is_out or bool(track.wrong)
        fit = [
            k
            for k in partners
            if not was_bad or max(self._pairs[unit, k].full) < self._min_size
        ]
        agreeing = [k for k in fit if self._agree(unit, k, doubted)]
        contradicted = self._contradicted(unit, partners) if is_out else set()
        hides = is_out and self._hides(unit, partners)
        if agreeing:
            track.agreed_at = now
        if now - track.agreed_at > BREAK:
            track.agreed = track.turned = None
            track.shown.clear()
        elif contradicted:
            # It, or the other one, is wrong: this time does not count, and a turn about
            # these axes is needed once the two agree.
            track.wrong = dict.fromkeys(contradicted, WITHOUT_SCALE) | track.wrong
            track.shown -= contradicted
            track.turned = track.turned and track.turned + elapsed
        elif hides:
            track.turned = track.turned and track.turned + elapsed
        elif agreeing:
            track.agreed = track.agreed or now
            # A mean that is no steady error yet may be the begin or end of a turn.
            alike = [k for k in agreeing if self._agree(unit, k, doubted=True)]
            if any(self._shows_all(unit, k) for k in alike):
                track.turned = track.turned or now
        if unit in self._taken and track.waits:
            return None
        return track.turned if doubted or is_out else track.agreed

    def _least(self, unit: int, units: Sequence[int]) -> float:
        """Return the difference of an IMU to the nearest of all others, rad/s."""
        pairs = [(unit, k) for k in units if k != unit and unit in units]
        sizes = [max(self._pairs[pair].apart) for pair in pairs]
        return min((size for size in sizes if size >= 0.0), default=math.nan)

    def _note_wrong(self, track: Track, partners: Partners, named: set[int]) -> None:
        """Note the axes on which a bad IMU is off or named, and its errors as shares.

        In a hover an axis that is named may be dead without being off. Of an IMU that is
        out, and of which no axis is known, each axis may be.
        """
        off = {
            axis for axis, size in enumerate(track.nearest) if size >= self._min_size
        }
        for axis in off:
            # Of a gyro without scale the error is this rate at most.
            rate = max(self.raw.peaks(k)[axis] for k in partners.on[axis])
            before = track.wrong.get(axis, WITHOUT_SCALE)
            track.wrong[axis] = before.with_error(track.nearest[axis], rate)
        new = named - track.wrong.keys() or (set() if track.wrong else {0, 1, 2})
        track.wrong |= dict.fromkeys(new, WITHOUT_SCALE)
        if off or new:
            # A turn from before the error shows nothing.
            track.turned = None
            track.shown.clear()

    def _shows_all(self, unit: int, other: int) -> bool:
        """Return whether an IMU that agrees with another has done so in turns that show its errors.

        A bias was apart at rest too. A gyro that has lost its scale on one axis shows that
        only in turns about this axis, and after any error a gyro may be dead. Agreement with
        one that may have failed alike shows nothing.
        """
        track = self._tracks[unit]
        motion = self.raw.motion(other)
        turn = motion.mean
        dead = SHOWN * self._min_size
        # What scatters does not agree from `CALM` on: twice that is shown by a shake.
        shakes = [dead * shake / (2.0 * CALM) for shake in motion.std]
        for axis in range(3):
            needed = track.wrong.get(axis, WITHOUT_SCALE).shown_by(dead)
            if max(abs(turn[axis]), shakes[axis]) < needed:
                continue
            if axis in track.wrong and not self._is_witness(other, unit, axis):
                continue
            track.shown.add(axis)
        faulty = track.axes(ChannelState.FAULTY)
        if track.wrong or faulty:
            return not track.waits and faulty <= track.shown
        return math.hypot(*turn) >= TURN_RATE

    def _is_witness(self, unit: int, bad: int, axis: int) -> bool:
        """Return whether agreement with an IMU shows that a bad one measures an axis again.

        Not if a third IMU differs as if both had a similar error of scale, nor if a third one
        differs otherwise, the monitor doubts this one, and the bad one had an error of scale.
        """
        wrong = self._tracks[bad].wrong[axis]
        is_doubted = axis in self._tracks[unit].axes(*DOUBTS) and wrong.is_of_scale
        others = self._delivering - {unit, bad}
        return not any(
            self._differs_by(None if is_doubted else wrong, k, unit, axis)
            for k in others
        )

    def _differs_by(
        self, wrong: Wrong | None, unit: int, other: int, axis: int
    ) -> bool:
        """Return whether an IMU differs from another as if that one was wrong like this.

        None: in any way. A delay may explain the difference as well: as a turn begins, that is
        not known yet.
        """
        rate, found = (self.raw.motion(k).mean[axis] for k in (unit, other))
        least = self._min_size + HEALTHY_SCALE * abs(nearest_zero((rate, found)))
        differs = abs(found - rate) >= least
        return differs and (
            wrong is None or wrong.explains(rate, found, self._min_size)
        )

    def _fail_alike(self, unit: int, axis: int) -> bool:
        """Return whether the others may be wrong on an axis, and an IMU that differs be healthy.

        One that was bad there, and has not shown more, is near one with which this one is
        compared. They differ as if both had lost a similar part of their scale.
        """
        rate = abs(self.raw.motion(unit).mean[axis])
        tracks = self._tracks
        return any(
            axis in tracks[k].waits
            and self._pairs.get((k, other), UNCOMPARED).mean[axis]
            < ALIKE_SHARES * rate + self._min_size
            and self._differs_by(tracks[k].wrong[axis], unit, other, axis)
            for k in self._delivering - {unit}
            for other in self._tracks[unit].partners.on[axis] - {k}
        )

    def _partners(
        self, unit: int, units: Sequence[int], out: Sequence[int]
    ) -> Partners:
        """Return the IMUs with which one is compared: in use or trusted, or else all.

        One that is out of use counts on its proven axes. One that is stuck, or with an unknown
        difference, is no measure. For one that is FAULTY, those are that the monitor does not
        doubt, if there are any: two that are FAULTY may be so alike.
        """
        if unit not in units:
            return NO_PARTNERS
        tracks = self._tracks
        others = [k for k in units if k != unit and not self.raw.is_stuck(k)]
        known = {k for k in others if not math.isnan(max(self._pairs[unit, k].apart))}
        in_use = {k for k in others if k not in out or self._is_trusted(k)}
        if not in_use:
            return Partners((known,) * 3, known)
        fine = {k for k in known if tracks[k].states and not tracks[k].doubts}
        is_faulty = ChannelState.FAULTY in tracks[unit].states

        def measures(fit: set[int]) -> set[int]:
            return (is_faulty and fit & fine) or fit & known

        common = measures(in_use)
        if not common:
            return NO_PARTNERS
        proven = [{k for k in others if axis in tracks[k].proven} for axis in range(3)]
        on = tuple(measures(in_use | more) for more in proven)
        return Partners(on, common, are_fit=True)

    def _nearest(self, unit: int, partners: Partners) -> Vector:
        """Return the smallest difference of an IMU to its partners, by axis, rad/s."""
        x, y, z = (
            min((self._pairs[unit, k].apart[axis] for k in found), default=math.nan)
            for axis, found in enumerate(partners.on)
        )
        return x, y, z

    def _blamed_axes(self, unit: int, axes: set[int], units: Sequence[int]) -> set[int]:
        """Return the axes on which an IMU, named on these axes, is apart and the bad one.

        If two others outvote it, its name may be for an earlier error. Otherwise it may be the
        others that are wrong, or each by less than ``min_size``: its name must have come with this
        difference, which is `VOTE` times as large, and the monitor must not doubt that axis of
        those that it is compared with. One of these must move, and may not have failed like one
        that is known to be bad. While all others are out of use,
        all that counts is whether the last one is better.
        """
        track = self._tracks[unit]
        sure = self._odd_axes(unit, units) if track.partners.are_fit else axes
        blamed = set()
        for axis in axes:
            least = self._min_size
            if axis not in sure:
                least *= VOTE
                others = [self._tracks[k] for k in track.partners.on[axis]]
                is_doubted = any(axis in other.axes(*DOUBTS) for other in others)
                moves = any(axis in other.moves for other in others)
                if is_doubted or not moves or not track.is_new(axis):
                    continue
                if self._fail_alike(unit, axis):
                    continue
            if track.nearest[axis] >= least:
                blamed.add(axis)
        return blamed

    def _is_trusted(self, unit: int) -> bool:
        return self._tracks[unit].refuted is not None

    def _agree(self, unit: int, other: int, doubted: bool) -> bool:
        """Return whether an IMU agrees with a partner that is sound.

        doubted: by the monitor. Then an oscillation counts against it.
        """
        track = self._tracks[other]
        is_sound = track.is_ok or max(track.nearest) < self._min_size
        is_stuck = self.raw.is_stuck(unit) or self.raw.is_stuck(other)
        pair = self._pairs[unit, other]
        sizes = pair.bound if doubted else pair.apart
        return is_sound and not is_stuck and max(sizes) < self._min_size

    def _contradicted(self, unit: int, partners: Collection[int]) -> set[int]:
        """Return the axes on which an IMU differs from a partner that the monitor does not name.

        Two IMUs that fail alike agree with each other, but not with the third.
        """
        return {
            axis
            for k in partners
            if ChannelState.FAULTY not in self._tracks[k].states
            for axis, size in enumerate(self._pairs[unit, k].apart)
            if size >= self._min_size
        }

    def _hides(self, unit: int, partners: Collection[int]) -> bool:
        """Return whether a scale error could hide in the difference to a partner.

        The IMU may still have the error of scale that it had on this axis, if a partner that
        is not named differs by as much as a turn about other axes explains. Agreement with
        another partner then proves nothing: that one may have failed alike.
        """
        return any(
            self._pairs[unit, k].full[axis] >= self._hidden(wrong, unit, k, axis)
            for k in partners
            if ChannelState.FAULTY not in self._tracks[k].states
            for axis, wrong in self._tracks[unit].wrong.items()
            if wrong.share <= MOST_RANGE_SHARE
        )

    def _hidden(self, wrong: Wrong, unit: int, other: int, axis: int) -> float:
        """Return the least difference, rad/s, that half of the former error of scale makes now.

        A partner with a small error of scale of its own differs by less.
        """
        rates = (self.raw.motion(k).mean[axis] for k in (unit, other))
        # The share was measured without the part that scales explain.
        error = (wrong.share + HEALTHY_SCALE) * abs(nearest_zero(tuple(rates)))
        return max(self._min_size, error / 2.0)

    def _voters(self, unit: int, units: Sequence[int]) -> list[int]:
        """Return the two other IMUs, if they may outvote one, or none.

        Two that were bad in this flight may be so, and alike, unless turns have shown more.
        """
        others = [k for k in units if k != unit]
        may = unit in self._once_bad or not self._once_bad.issuperset(others)
        return others if len(others) == 2 and unit in units and may else []

    def _odd_axes(self, unit: int, units: Sequence[int]) -> set[int]:
        """Return the axes on which the two other IMUs agree, and nothing is against these two.

        Their values change. If this IMU is not stuck, they are trusted or proven there, and every
        doubt that the monitor has of them was refuted before, or is one that it has of this IMU
        too.
        """
        others = self._voters(unit, units)
        if not others:
            return set()
        size = min(max(self._pairs[unit, k].apart) for k in others)
        limit = max(self._min_size, ALIKE * size)
        between = self._pairs[others[0], others[1]].mean
        axes = {axis for axis, mean in enumerate(between) if mean < limit}
        if any(self.raw.repeats(k, self.raw.fewest) for k in others):
            return set()
        if self.raw.is_stuck(unit):
            return axes if len(axes) == 3 else set()
        for k in others:
            axes &= self._vouched_axes(k, self._tracks[unit])
        return axes

    def _vouched_axes(self, unit: int, accused: Track) -> set[int]:
        """Return the axes that move and on which an IMU may vote against another.

        All of them, if it is trusted. Else the proven ones on which the monitor does not doubt
        it, or doubts the other one alike, or names it anew. Names of this one are older than the
        proof, and refuted by it.
        """
        track = self._tracks[unit]
        if track.refuted is not None and track.doubts <= track.refuted | accused.doubts:
            return track.moves
        named = accused.axes(ChannelState.FAULTY)
        doubted = {
            axis
            for axis in track.axes(*DOUBTS - {ChannelState.FAULTY})
            if track.states[axis] is not accused.states[axis]
            and not (axis in named and accused.is_new(axis))
        }
        return (track.proven & track.moves) - doubted

    def _odd_one(self, units: Sequence[int], now: int) -> tuple[int, set[int], int]:
        """Return an IMU that is bad although the monitor does not name it.

        Also return its axes, and for how long this must last before it counts, ns.
        `NOBODY` if there is none.

        Of three IMUs it is the one that is off by `CLEAR_DIFFERENCE` while the two others
        agree, or by less if the monitor doubts it or it is stuck. Otherwise it is the
        only IMU with a set. If one of two others is not trusted, and this one is not stuck, a
        set proves nothing: two IMUs that fail alike put the healthy third one into a set.
        """
        # One that is out is odd as before: another one may be so on another axis.
        for k in sorted(units, key=self._taken.__contains__):
            odd = self._odd_axes(k, units)
            if not odd:
                continue
            if axes := odd & self._clear_axes(k, units, now):
                return k, axes, 0
            others = [j for j in units if j != k]
            sizes = [self._pairs[k, j].apart for j in others]
            least = [min(one, other) for one, other in zip(*sizes, strict=True)]
            vote = VOTE * self._min_size
            checks = (
                (range(3) if self.raw.is_stuck(k) else (), self._min_size, SET_STANDS),
                (self._tracks[k].axes(ChannelState.AMBIGUOUS), vote, SET_STANDS),
            )
            for doubted, size, stands in checks:
                if axes := {axis for axis in odd & {*doubted} if least[axis] >= size}:
                    return k, axes, stands
            suspected = odd & self._tracks[k].axes(ChannelState.SUSPECT)
            axes = {axis for axis in suspected if least[axis] >= vote}
            if axes := self._beyond_steps(axes, least, vote, others):
                return k, axes, SUSPECT_STANDS
        sets = {k: self._tracks[k].axes(ChannelState.AMBIGUOUS) for k in units}
        found = [(k, axes, SET_STANDS) for k, axes in sets.items() if axes]
        if len(found) != 1:
            return NOBODY
        unit = found[0][0]
        voters = self._voters(unit, units)
        trusted = voters and all(map(self._is_trusted, voters))
        sure = trusted or self.raw.is_stuck(unit) or len(units) < 3
        return found[0] if sure else NOBODY

    def _clear_axes(self, unit: int, units: Sequence[int], now: int) -> set[int]:
        """Return the axes on which an IMU is far off from both others, in one direction.

        Farther than scales explain, and than the others turn within `SKEW`.
        """
        others = [k for k in units if k != unit]
        least = LARGE_DIFFERENCE if self._tracks[unit].doubts else CLEAR_DIFFERENCE
        rows = zip(*(self._steady[unit, k] for k in others), strict=True)
        sizes = [abs(nearest_zero(row)) for row in rows]
        axes = {axis for axis, size in enumerate(sizes) if size >= least}
        if not axes:
            return axes
        limit = least + HEALTHY_SCALE * max(self.raw.motion(k).largest for k in others)
        return self._beyond_steps(axes, sizes, limit, others)

    def _beyond_steps(
        self,
        axes: set[int],
        sizes: Sequence[float],
        limit: float,
        others: Sequence[int],
    ) -> set[int]:
        """Return the axes with a size beyond a limit and what the others turn within `SKEW`."""
        if not axes:
            return axes
        steps = [self.raw.steps(k, self.raw.fewest) for k in others]
        bounds = [limit + max(step) for step in zip(*steps, strict=True)]
        return {axis for axis in axes if sizes[axis] >= bounds[axis]}

    def error(self, unit: int, now: int) -> tuple[str, float] | None:
        """Return the axis on which an IMU is off most, and by how much, rad/s.

        Measured against the IMU that the monitor finds OK, or else against the nearest.
        None: not known to `KNOWN_SIGMAS` standard deviations, or not of one axis.
        """
        found = [
            (not imu.ok, difference.size, difference)
            for k, imu in enumerate(self.imus)
            if k != unit and (difference := self.raw.between(unit, k, now, self._sized))
        ]
        if not found:
            return None
        mean, _, std, _ = min(found)[2]
        axis = max(range(3), key=lambda k: abs(mean[k]))
        others = [abs(mean[k]) for k in range(3) if k != axis]
        if max(others) > SECOND_AXIS * abs(mean[axis]):
            # A whole unit is off: its error is no more than the motion of the vehicle.
            return None
        if not abs(mean[axis]) > KNOWN_SIGMAS * std[axis]:
            return None
        return AXES[axis], mean[axis]
