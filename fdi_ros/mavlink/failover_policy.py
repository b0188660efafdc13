# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rules of failover: which IMUs of an ArduPilot are to be out of use now.

`decide` is a pure function, called at every tick (10 to 50 times a second), that takes
the present view and its own memory, and returns orders, conditions to announce, and
the next memory. It has no clock and no link. An order sets INS_USEk.

Definitions
    apart    raw rate differs by ``min_size`` or more, and more than scales explain, from
             the nearest IMU that is in use or trusted
    named    by the monitor, now or in its last report if that is not old, or by the raw
             rates: two of three IMUs agree, and the third is far off
    blamed   named on an axis that is apart. A name from before the IMU last agreed counts
             only while two of three IMUs agree, and this one does not
    bad      blamed, and delivers. Else left in use.
    alive    delivers samples, and they change while other IMUs turn
    sound    alive, and the monitor finds it OK or it is not apart
    ours     out of use by our order, or perhaps so: from the moment the order is sent
             until the autopilot reports "in use" `SETTLED` after it
    seen     INS_USE as reported. A change that we have not ordered counts once it has
             stood for `CHANGE_STANDS`: ArduPilot may answer a read with the value from before
             our order
    held     wanted out of use

`failover_evidence.Evidence` finds which IMUs are apart, named and blamed.

Rules, in this order at each tick
    1. A held IMU goes back in use if the operator asks; if every other IMU is dead or out
       of use; or if the IMU has not been apart for a pause, counted from a turn that would
       show its error: at rest a gyro that has lost its scale agrees too. The pause is
       `FIRST_PAUSE`, doubled each time the IMU is taken out in one flight. In flight the
       last case needs a live monitor, and if all that are in use are bad, an IMU goes back
       at once that the monitor finds OK, or soon if it is off by a `LESSER`-th. On the
       ground the IMU stays out until the monitor finds it OK. An IMU that was out when the
       autopilot started has no notch filters: only the operator or rule 4 puts it back.
    2. In flight, the worst bad IMU to which `objection` has nothing becomes held. At
       most ``limit`` IMUs are ours, without a limit all but one.
    3. Orders are sent until the autopilot reports the wanted state. An order to take an
       IMU out is sent only while rule 2 holds, so also each repetition needs a sound
       other IMU whose "in use" was reported within `FRESH`.
    4. If the autopilot reports no IMU in use, all of ours go back.

No bad IMU goes back to make room for a worse one that is not the last: while an IMU is
out, its EKF lane runs on the first IMU in use, and would follow the one that came back.

An IMU that somebody else has set is left alone until the vehicle is disarmed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

from fdi_ros.mavlink.protocol import MS, NS

FRESH = 200 * MS  #: Largest age of the report on which an IMU counts as a reserve, ns.
#: After this time, ns, no report from before an order is still under way.
SETTLED = 2 * NS
#: A report against our order is ignored for this time after the order, ns: ArduPilot
#: answers a read up to 100 ms late, with the value from the time of reading.
STALE_ANSWER = NS // 2
CHANGE_STANDS = NS  #: A change that we have not ordered counts after this time, ns.
FIRST_PAUSE = 2 * NS  #: An IMU goes back after this time without being apart, ns.
LONGEST_PAUSE = 16 * NS  #: Bound of the doubled pause, ns.
QUICK_RETRY = 100 * MS  #: Time between the first `QUICK_TRIES` copies of an order, ns.
QUICK_TRIES = 10
SLOW_RETRY = NS  #: Time between further copies, ns.
GROUNDED = 2 * NS  #: The flight is over after this time disarmed, ns.
REACTION = NS  #: A bad IMU in use is announced after this time, ns.
UNNAMED = 5 * NS  #: An IMU that is apart, but not named, is announced after this, ns.
ACQUAINTED = 5 * NS  #: Agreement needed once before failover is ready, ns.
REPEAT = 10 * NS  #: Time between two announcements of a lasting danger, ns.
SPACED = NS  #: Least time between two announcements that are not urgent, ns.
#: Angle by which an EKF lane is lost, rad: what its IMU turned too much or too little. In
#: ArduCopter's simulation lanes recover from 0.4 rad within 10 s, and never from 3 rad.
LOST_LANE = 1.5
LANE_RECOVERY = 10.0  #: Time constant with which a lane recovers from less, s.
#: An IMU goes back beside the last ones in use if these are off by this many times as much.
#: At 2, 4 and 8 the worst IMU in use of 150 random flights is off by the same within 1 %.
LESSER = 4.0
LONG_AGO = -(10**18)  #: A time before all others, ns.


class Condition(Enum):
    """State of an IMU or of the vehicle, announced to the pilot at its beginning."""

    FINE = "in use and not bad"
    DANGER = "bad, in use, armed"
    OUT = "out of use by our order, armed"
    STAYS_OUT = "out of use by our order on the ground, because it is still named"
    NOT_OK = "out of use by our order on the ground, not named and not found OK"
    UNTURNED = "as before, and found OK, but not seen to agree while turning"
    REBOOT = (
        "on the ground, was out of use when the autopilot started: no notch filters"
    )
    STUCK_OUT = "ordered back, but not reported in use"
    LEFT_ALONE = "set by somebody else in this flight, or put back by the operator"
    UNUSED = "out of use, and not by our order"
    APART = "apart for long, while two others agree"
    DISAGREE = "an IMU in use is apart for long, armed, and the monitor finds none OK"
    ALONE = "one IMU is alive, or none but samples arrive, armed"
    REDUNDANT = "two or more IMUs in use that agree, and EKF lanes that are not lost"
    LAST_IMU = "one IMU in use, or none, because of our orders"
    LAST_LANE = "one EKF lane, or none, is not lost, and others are, armed"


#: Announced at once. The others change at most every `SPACED` for one IMU or the vehicle.
URGENT = {Condition.DANGER, Condition.OUT, Condition.ALONE, Condition.LAST_IMU}
#: Announced every `REPEAT`.
REPEATED = {
    Condition.DANGER,
    Condition.ALONE,
    Condition.DISAGREE,
    Condition.LAST_IMU,
    Condition.LAST_LANE,
}


class PolicySettings(NamedTuple):
    """Settings of failover."""

    limit: int = 0  #: Most IMUs out of use by our orders. 0: all but one.
    min_size: float = 0.03  #: Smallest error that is acted on, rad/s.


class Imu(NamedTuple):
    """Present state of one IMU. Times in ns."""

    use: bool | None = None  #: Last report of its INS_USE. None: no recent report.
    heard: int = LONG_AGO  #: Time of that report.
    named: bool | None = None  #: By the monitor or the raw rates. None: no reports.
    blamed: bool = False  #: Named on an axis that is apart, as defined above.
    ok: bool = False  #: The monitor finds all its channels OK.
    delivers: bool = False  #: Its samples arrive.
    stuck: bool = False  #: They repeat one value while another IMU moves.
    judged: bool = True  #: The monitor judges at least one of its channels.
    lane: bool = True  #: The autopilot has an EKF lane for it, as far as is known.
    size: float = float("nan")
    """Largest raw difference to the nearest IMU of late, rad/s. NaN: unknown."""
    least: float = float("nan")
    """Present one to the nearest of all others, out of use or not, rad/s. NaN: unknown."""
    #: Not apart from a sound IMU since this time. None: apart, stuck or unknown. If the
    #: monitor doubts it, or it is out of use, from the time of a turn that would show its
    #: error.
    agreed: int | None = None


class View(NamedTuple):
    """All that is known now. Times in ns."""

    imus: tuple[Imu, ...]
    linked: bool = False  #: An ArduPilot that sends SCALED_IMU is heard.
    armed: bool = False
    disarmed: int = 0  #: How long all heartbeats have reported "disarmed".
    monitored: bool = False  #: The right monitor is alive and has no imitator.
    boots: int = 0  #: Number of starts of the autopilot seen.
    restore: bool = False  #: The operator asks now to put all of ours back.


@dataclass
class Memory:
    """Memory of one IMU between ticks. Times in ns."""

    ours: bool = False
    held: bool = False
    seen: bool | None = None  #: INS_USE as last reported. None: not since the boot.
    out_sent: int = LONG_AGO  #: When the last order "out of use" was sent.
    back_sent: int = LONG_AGO  #: When the last order "in use" was sent.
    tries: int = 0  #: Copies sent of the present order.
    obeyed: bool | None = None  #: Whether the last order was. None: not known.
    taken: int = 0  #: Number of times taken out in this flight.
    left_alone: bool = False
    without_notch: bool = False  #: Ours, and out of use at the autopilot's last start.
    acquainted: bool = False  #: Has once agreed with another IMU for `ACQUAINTED`.
    bad_since: int | None = None
    apart_since: int | None = None
    dead_since: int | None = None  #: Stuck, or without samples, since this time.
    lesser_since: int | None = None  #: Off by less than those in use, by `LESSER`.
    against_since: int | None = None  #: Since when reports contradict `seen`, ns.
    lane_angle: float = 0.0  #: Angle by which its EKF lane was misled, rad.


class Order(NamedTuple):
    """One parameter to set now."""

    imu: int  #: From 0.
    use: bool


class Announced(NamedTuple):
    """The last announcement about one IMU or the vehicle."""

    condition: Condition
    at: int  #: Time, ns.


VEHICLE = -1  #: Key of the vehicle's own announcement beside those of the IMUs.


class PolicyState(NamedTuple):
    """Memory between two ticks."""

    memories: tuple[Memory, ...]
    announced: Mapping[int, Announced] = {}
    boots: int = 0
    at: int = LONG_AGO  #: Time of the last tick.

    @classmethod
    def begin(
        cls,
        count: int,
        ours: Sequence[int] = (),
        without_notch: Sequence[int] = (),
    ) -> PolicyState:
        """Return the state at a start of the companion.

        Parameters
        ----------
        count
            Number of IMUs.
        ours
            IMUs, from 0, that the last run left out of use.
        without_notch
            IMUs, from 0, that were out of use when the autopilot started.
        """
        memories = tuple(Memory() for _ in range(count))
        for k in ours:
            # Reported out, as far as known: an order may still be under way.
            memories[k].ours = memories[k].held = True
            memories[k].seen = False
            memories[k].without_notch = k in without_notch
        return cls(memories)


class Decision(NamedTuple):
    """Result of one tick."""

    orders: tuple[Order, ...]
    words: tuple[tuple[int, Condition], ...]  #: IMU, or `VEHICLE`, and its condition.
    state: PolicyState
    hurry: bool  #: All INS_USE should be read at once: an order may depend on them.


def is_apart(imu: Imu, settings: PolicySettings) -> bool:
    """Return whether the raw rate of an IMU differs from every other raw rate."""
    return imu.size >= settings.min_size


def is_bad(imu: Imu, settings: PolicySettings) -> bool:
    """Return whether an IMU is to be out of use. Of unknown size: no."""
    return imu.delivers and imu.blamed and is_apart(imu, settings)


def is_sound(imu: Imu, settings: PolicySettings) -> bool:
    """Return whether the autopilot can fly with an IMU alone."""
    return is_alive(imu) and (imu.ok or imu.size < settings.min_size)


def is_alive(imu: Imu) -> bool:
    """Return whether the samples of an IMU arrive and change."""
    return imu.delivers and not imu.stuck


def objection(
    k: int,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> str:
    """Return the reason against an order to take IMU k out of use now. Empty: none."""
    others = [j for j in range(len(memories)) if j != k]
    limit = settings.limit or len(others)
    reserve = any(
        view.imus[j].use
        and now - view.imus[j].heard <= FRESH
        and not memories[j].ours
        and is_sound(view.imus[j], settings)
        for j in others
    )
    checks = (
        (view.linked, "no ArduPilot that sends each IMU"),
        (view.armed, "not armed"),
        (view.monitored, "monitor silent or not alone"),
        (is_bad(view.imus[k], settings), "not bad"),
        (view.imus[k].use, "not reported in use"),
        (not memories[k].left_alone, "set by others"),
        (sum(memories[j].ours for j in others) < limit, "limit"),
        (reserve, "no sound IMU reported in use"),
    )
    return next((words for holds, words in checks if not holds), "")


def decide(
    state: PolicyState, view: View, now: int, settings: PolicySettings
) -> Decision:
    """Return orders, conditions to announce and the next state at time now, ns."""
    memories = tuple(Memory(**vars(memory)) for memory in state.memories)
    for memory, imu in zip(memories, view.imus, strict=True):
        if view.boots != state.boots:
            _begin_anew(memory)
        _remember(memory, imu, view, now, settings)
    _note_lanes(memories, view, now - state.at, settings)
    _release(memories, view, now, settings)
    _hold_worst(memories, view, now, settings)
    orders = []
    for k, memory in enumerate(memories):
        if _is_due(k, memories, view, now, settings):
            orders.append(Order(k, not memory.held))
            _note_order(memory, now)
    announced = dict(state.announced)
    words = []
    # Without a link nobody would read them.
    found = _conditions(memories, view, now) if view.linked else []
    for key, condition in found:
        is_fine = condition is Condition.FINE
        is_near = is_fine and view.imus[key].size < settings.min_size
        if is_fine and not (is_near and memories[key].seen):
            # Off, but not for long, or nobody is the odd one, or unknown.
            continue
        if condition is Condition.REDUNDANT and not _is_redundant(memories, view):
            continue
        usual = Condition.REDUNDANT if key == VEHICLE else Condition.FINE
        last = announced.get(key, Announced(usual, LONG_AGO))
        waits = 0 if condition in URGENT else SPACED
        is_changed = condition != last.condition and now - last.at >= waits
        is_late = condition in REPEATED and now - last.at >= REPEAT
        if is_changed or is_late:
            announced[key] = Announced(condition, now)
            words.append((key, condition))
    doubtful = any(
        imu.named or (is_apart(imu, settings) and not imu.ok) for imu in view.imus
    )
    unsettled = any(
        memory.against_since or (memory.ours and memory.seen == memory.held)
        for memory in memories
    )
    return Decision(
        orders=tuple(orders),
        words=tuple(words),
        state=PolicyState(memories, announced, view.boots, now),
        hurry=(view.armed and doubtful) or unsettled,
    )


def _begin_anew(memory: Memory) -> None:
    """Forget what a start of the autopilot ends. Parameters outlive it."""
    # The next report shows how it began.
    memory.seen = memory.obeyed = memory.against_since = None
    memory.lane_angle = 0.0
    memory.tries = 0
    memory.held = memory.without_notch = memory.ours  # until reported in use


def _remember(
    memory: Memory, imu: Imu, view: View, now: int, settings: PolicySettings
) -> None:
    """Update a memory from the present view, before any decision."""
    if view.restore and memory.ours:
        memory.left_alone = True
    if imu.use is not None:
        _hear(memory, imu.use, imu.heard)
    if view.disarmed >= GROUNDED:
        memory.left_alone = False
        memory.taken = 0
        memory.lane_angle = 0.0
    if imu.agreed is not None and now - imu.agreed >= ACQUAINTED:
        memory.acquainted = True
    is_danger = view.armed and is_bad(imu, settings)
    memory.bad_since = (memory.bad_since or now) if is_danger else None
    is_off = is_apart(imu, settings)
    memory.apart_since = (memory.apart_since or now) if is_off else None
    memory.dead_since = None if is_alive(imu) else (memory.dead_since or now)


def _hear(memory: Memory, use: bool, heard: int) -> None:
    """Compare a report of INS_USE, received at heard, ns, with our orders."""
    # The first report since the boot shows how it began.
    is_first = memory.seen is None and not memory.tries
    if use and is_first:
        memory.without_notch = False
    ordered_at = max(memory.out_sent, memory.back_sent)
    # Without an order of this run, the last run's order counts.
    ordered = memory.back_sent > memory.out_sent
    expected = (memory.seen,) if ordered_at == LONG_AGO else (memory.seen, ordered)
    if use not in expected and not is_first:
        since = heard if memory.against_since is None else memory.against_since
        if heard - ordered_at < STALE_ANSWER:
            return
        if heard - since < CHANGE_STANDS:
            memory.against_since = since
            return
    memory.against_since = None
    changed = memory.seen is not None and use != memory.seen
    if changed and memory.ours and use == ordered:
        memory.obeyed = True
    settled = heard - memory.out_sent >= SETTLED
    if not memory.ours:
        by_others = changed
    elif ordered:
        # Out again, long after our last order to take it out.
        by_others = not use and changed and settled
    else:
        # Out before and now in use: not by us. Never reported out to this run: the
        # order was lost.
        by_others = use and changed and memory.out_sent != LONG_AGO
    is_over = use and settled
    if memory.seen is False and use:
        memory.apart_since = None
    memory.seen = use
    if by_others or (memory.ours and is_over):
        memory.ours = memory.held = False
        memory.tries = 0
        memory.left_alone |= by_others


def _note_lanes(
    memories: Sequence[Memory], view: View, elapsed: int, settings: PolicySettings
) -> None:
    """Follow how far each EKF lane was misled in the time elapsed, ns.

    Lane k follows IMU k, or the first IMU in use while IMU k is out.
    """
    first = next((k for k, memory in enumerate(memories) if memory.seen), 0)
    seconds = min(max(elapsed, 0), NS) / NS
    for k, memory in enumerate(memories):
        source = view.imus[first if memory.seen is False else k]
        # While two others are bad a healthy one is apart from both.
        is_off = is_apart(source, settings) and (source.named or not source.ok)
        if view.armed and source.delivers and is_off:
            memory.lane_angle += source.size * seconds
        elif memory.lane_angle < LOST_LANE:
            memory.lane_angle *= max(0.0, 1.0 - seconds / LANE_RECOVERY)


def _release(
    memories: Sequence[Memory], view: View, now: int, settings: PolicySettings
) -> None:
    """Rules 1 and 4: let go of IMUs that should be back in use."""
    pairs = list(zip(memories, view.imus, strict=True))
    # A link that brings no samples at all shows nothing about the IMUs.
    is_heard = any(imu.delivers for imu in view.imus)
    none_left = all(
        memory.ours
        or imu.use is False
        or imu.stuck
        or (is_heard and _has_stood(memory.dead_since, REACTION, now))
        for memory, imu in pairs
    )
    only_bad = all(memory.ours or is_bad(imu, settings) for memory, imu in pairs)
    in_use = [imu.size for memory, imu in pairs if not memory.ours]
    lesser = min(in_use, default=0.0) / LESSER
    for memory, imu in pairs:
        pause = min(FIRST_PAUSE << max(0, memory.taken - 1), LONGEST_PAUSE)
        agrees = _has_stood(imu.agreed, pause, now)
        may = view.monitored if view.armed else imu.ok
        heals = agrees and may and is_alive(imu)
        is_lesser = only_bad and imu.least < lesser
        memory.lesser_since = (memory.lesser_since or now) if is_lesser else None
        is_less = imu.ok or _has_stood(memory.lesser_since, REACTION, now)
        is_better = only_bad and view.monitored and is_less and is_alive(imu)
        wanted = (heals or is_better) and not memory.without_notch
        if memory.held and (view.restore or none_left or wanted):
            memory.held = False
            memory.tries = 0


def _hold_worst(
    memories: Sequence[Memory], view: View, now: int, settings: PolicySettings
) -> None:
    """Rule 2: hold the worst bad IMU."""
    bad = [
        k
        for k, memory in enumerate(memories)
        if is_bad(view.imus[k], settings)
        and not memory.held
        and not objection(k, memories, view, now, settings)
    ]
    if bad:
        memory = memories[max(bad, key=lambda k: view.imus[k].size)]
        memory.taken += not memory.ours
        memory.held = True
        memory.tries = 0


def _is_due(
    k: int,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> bool:
    """Rule 3: return whether an order for IMU k is to be sent now."""
    memory = memories[k]
    imu = view.imus[k]
    last = memory.out_sent if memory.held else memory.back_sent
    pause = QUICK_RETRY if memory.tries < QUICK_TRIES else SLOW_RETRY
    if not view.linked or (memory.tries and now - last < pause):
        return False
    if memory.held:
        # After a report "out", another value is a late answer or another station's.
        is_open = memory.seen is not False
        return is_open and not objection(k, memories, view, now, settings)
    unanswered = not imu.use or imu.heard <= memory.back_sent
    return memory.ours and unanswered


def _note_order(memory: Memory, now: int) -> None:
    """Note that the wanted state of an IMU is ordered now."""
    memory.ours = True
    memory.tries += 1
    if memory.tries > QUICK_TRIES:
        memory.obeyed = False
    if memory.held:
        memory.out_sent = now
    else:
        memory.back_sent = now


def _conditions(
    memories: Sequence[Memory], view: View, now: int
) -> list[tuple[int, Condition]]:
    """Return the condition of each IMU and of the vehicle: the first that applies."""
    longest = [_has_stood(memory.apart_since, UNNAMED, now) for memory in memories]
    # Where no two agree, or the monitor finds none OK, nobody is the odd one.
    is_any_ok = any(imu.ok for imu in view.imus)
    is_odd_known = is_any_ok and not all(longest)
    found = [
        (k, _condition(memory, view.imus[k], view, now, longest[k] and is_odd_known))
        for k, memory in enumerate(memories)
    ]
    is_heard = any(imu.delivers for imu in view.imus)
    differs = any(
        is_long and memory.seen is not False
        for memory, is_long in zip(memories, longest, strict=True)
    )
    alive = sum(not _has_stood(memory.dead_since, REACTION, now) for memory in memories)
    left = sum(memory.seen is not False for memory in memories)
    pairs = zip(memories, view.imus, strict=True)
    angles = [memory.lane_angle for memory, imu in pairs if imu.lane]
    lanes = sum(angle < LOST_LANE for angle in angles)
    by_us = any(memory.ours and memory.seen is False for memory in memories)
    checks = (
        (view.armed and is_heard and alive <= 1, Condition.ALONE),
        (view.armed and by_us and left <= 1, Condition.LAST_IMU),
        (view.armed and lanes <= 1 and lanes < len(angles), Condition.LAST_LANE),
        (view.armed and differs and not is_any_ok, Condition.DISAGREE),
    )
    found.append((VEHICLE, _first(checks, Condition.REDUNDANT)))
    return found


def _is_redundant(memories: Sequence[Memory], view: View) -> bool:
    """Return whether two or more IMUs are in use and agree."""
    pairs = zip(memories, view.imus, strict=True)
    return sum(bool(m.seen and imu.agreed is not None) for m, imu in pairs) > 1


def _has_stood(since: int | None, duration: int, now: int) -> bool:
    return since is not None and now - since >= duration


def _condition(
    memory: Memory, imu: Imu, view: View, now: int, apart: bool
) -> Condition:
    is_out = memory.ours and memory.seen is False
    is_bad_long = _has_stood(memory.bad_since, REACTION, now)
    is_danger = view.armed and memory.seen is not False and is_bad_long
    asked_back = memory.ours and not memory.held and memory.tries > QUICK_TRIES
    checks = (
        (is_danger, Condition.DANGER),
        (asked_back, Condition.STUCK_OUT),
        (is_out and not view.armed and memory.without_notch, Condition.REBOOT),
        (is_out and not view.armed and imu.named is True, Condition.STAYS_OUT),
        (is_out and not view.armed and not imu.ok, Condition.NOT_OK),
        # Until it is reported in use, also once it has been ordered back.
        (is_out and not view.armed, Condition.UNTURNED),
        (is_out, Condition.OUT),
        (memory.left_alone, Condition.LEFT_ALONE),
        (memory.seen is False, Condition.UNUSED),
        (apart, Condition.APART),
    )
    return _first(checks, Condition.FINE)


def _first(checks: Sequence[tuple[bool, Condition]], usual: Condition) -> Condition:
    """Return the first condition that holds, or else the usual one."""
    return next((condition for holds, condition in checks if holds), usual)
