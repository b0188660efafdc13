# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Rules of failover: which IMUs of an ArduPilot are to be out of use now.

`decide` is a pure function, called at every tick (10 to 50 times a second), that takes
the present view and its own memory, and returns orders and the next memory. It has no
clock and no link. An order sets INS_USEk. `failover.words` has the texts for the pilot,
`failover.ready` the conditions of "ready".

Definitions
    apart    on an axis: raw rate differs by ``min_size`` or more, and more than scales explain,
             from the nearest IMU that is in use, trusted, or proven on this axis. The errors of
             both may add up
    moves    on an axis: within 5 s its rate has changed as that of another IMU has, and by more than
             noise explains
    proven   on an axis: it moves, and has done so since the monitor or the raw rates last found it
             bad on a further axis. So it is not dead. It was not apart there
    named    by the monitor, now or in its last report if that is not old, or by the raw
             rates: two of three IMUs agree, and the third is far off
    blamed   named on an axis that is apart now, and one of two
             a. outvoted: two others agree on that axis. Each is trusted and moves, or proven,
                and the monitor does not doubt them
             b. the name came with this difference: it is at most 0.3 s older than twice
                ``min_size``. The monitor doubts that axis of no IMU that counts there,
                one of these moves, and none may have failed like one that is known to be bad
    bad      blamed, and delivers. Else left in use.
    alive    delivers samples, and they change while other IMUs turn
    OK       by the monitor on all axes, which has doubted none since the IMU is apart there
    sound    alive, and OK or not apart
    reserve  for a bad IMU: sound. Or alive, OK on the axis on which the bad one is off most, and
             unchecked on others only because all other IMUs are FAULTY there
    trusted  all IMUs have agreed for 2 s since it was last apart, and in turns that show how it
             was bad. A bad one in use prevents that
    ours     out of use by our order, or perhaps so: from the moment the order is sent
             until the autopilot reports "in use" `SETTLED` after it
    seen     INS_USE as reported. A change that we have not ordered counts once it has
             stood for `CHANGE_STANDS`: ArduPilot may answer a read with the value from before
             our order
    held     wanted out of use

`failover.evidence.Evidence` finds which IMUs are apart, named and blamed.

Rules, in this order at each tick
    1. A held IMU goes back in use if the operator asks; if every other IMU is dead or out
       of use; or if the IMU has not been apart for a pause, counted from our order and from
       turns that would show its errors: at rest a gyro that has lost its scale agrees too.
       The pause is `FIRST_PAUSE`, doubled each time the IMU is taken out in one flight. In flight the
       last case needs a live monitor, and if all that are in use are bad, an IMU goes back
       at once that the monitor finds OK, or soon if it is off by a `LESSER`-th. On the
       ground the IMU stays out until the monitor finds it OK. An IMU that was out when the
       autopilot started has no notch filters: only the operator or rule 4 puts it back.
    2. In flight (`View.armed`), the worst bad IMU to which `objection` has nothing becomes held. At
       most ``limit`` IMUs are ours, without a limit all but one. Of two IMUs, one that has
       not agreed in a turn since it was bad is no reserve.
    3. Orders are sent until the autopilot reports the wanted state. An order to take an
       IMU out is sent only while rule 2 holds, so also each repetition needs a
       reserve whose "in use" was reported within `FRESH`.
    4. If the autopilot reports no IMU in use, all of ours go back. A report within
       `STALE_ANSWER` of our order "back" may be older than that order, and does not count.

No bad IMU goes back to make room for a worse one that is not the last: while an IMU is
out, its EKF lane runs on the first IMU in use, and would follow the one that came back.

An IMU that somebody else has set is left alone until the vehicle is disarmed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
#: An IMU counts as dead, or as off by less than those in use, after this time, ns, and as
#: a danger to be announced.
REACTION = NS
ACQUAINTED = 5 * NS  #: Agreement needed once before failover is ready, ns.
#: An IMU goes back beside the last ones in use if these are off by this many times as much.
#: At 2, 4 and 8 the worst IMU in use of 150 random flights is off by the same within 1 %.
LESSER = 4.0
LONG_AGO = -(10**18)  #: A time before all others, ns.


class PolicySettings(NamedTuple):
    """Settings of failover."""

    limit: int = 0  #: Most IMUs out of use by our orders. 0: all but one.
    min_size: float = 0.03  #: Smallest difference of two IMUs that is acted on, rad/s.


class Imu(NamedTuple):
    """Present state of one IMU. Times in ns."""

    use: bool | None = None  #: Last report of its INS_USE. None: no recent report.
    heard: int = LONG_AGO  #: Time of that report.
    named: bool | None = None  #: By the monitor or the raw rates. None: no reports.
    blamed: bool = False  #: Named on an axis that is apart, as defined above.
    worst: str = ""  #: Axis that is off most, if blamed, such as x.
    ok: bool = False  #: OK, as defined above.
    #: Axes that the monitor finds OK, such as xy. Empty if it does not judge another one, unless
    #: all other IMUs are FAULTY there.
    fine: str = ""
    delivers: bool = False  #: Its samples arrive.
    stuck: bool = False  #: They repeat one value while another IMU moves.
    unjudged: str = (
        ""  #: Axes, such as xz, that the monitor has not judged for a while.
    )
    declared: str = (
        ""  #: Axes, such as xz, that the monitor finds FAULTY or in a set, AMBIGUOUS.
    )
    lane: bool = True  #: The autopilot has an EKF lane for it, as far as is known.
    size: float = float("nan")
    """Largest raw difference of late to the IMU nearest on an axis, rad/s. NaN: unknown."""
    least: float = float("nan")
    """Present one to the nearest of all others, out of use or not, rad/s. NaN: unknown."""
    #: Not apart from a sound IMU since this time. None: apart, stuck or unknown. If the
    #: monitor doubts it, or it is out of use, or was in this flight, from the time of
    #: turns that would show its errors.
    agreed: int | None = None
    #: Axes, such as xz, that were bad and have not agreed in a turn that would show this.
    waits: str = ""
    votes: bool = True  #: Was not bad in this flight, or has agreed in turns about all axes since.


class View(NamedTuple):
    """All that is known now. Times in ns."""

    #: in the order of their numbers
    imus: tuple[Imu, ...]
    linked: bool = False  #: An ArduPilot that sends SCALED_IMU is heard.
    armed: bool = False  #: By the last heartbeat, which may be 1 s old.
    disarmed: int = 0  #: How long all heartbeats have reported "disarmed".
    #: The right monitor has sent diagnostics in the last 5 s, and has no imitator.
    monitored: bool = False
    boots: int = 0  #: Number of starts of the autopilot seen.
    restore: bool = False  #: The operator asks now to put all of ours back.


@dataclass
class Memory:
    """Memory of one IMU between ticks. Times in ns."""

    #: Out of use by our order, or perhaps so, as defined above.
    ours: bool = False
    #: Wanted out of use.
    held: bool = False
    seen: bool | None = None  #: INS_USE as last reported. None: not since the boot.
    out_sent: int = LONG_AGO  #: When the last order "out of use" was sent.
    back_sent: int = LONG_AGO  #: When the last order "in use" was sent.
    tries: int = 0  #: Copies sent of the present order.
    obeyed: bool | None = None  #: Whether the last order was. None: not known.
    taken: int = 0  #: Number of times taken out in this flight.
    #: Somebody else has set INS_USE: no order until the vehicle is disarmed.
    left_alone: bool = False
    without_notch: bool = False  #: Ours, and out of use at the autopilot's last start.
    acquainted: bool = False  #: Has once agreed with another IMU for `ACQUAINTED`.
    dead_since: int | None = None  #: Stuck, or without samples, since this time.
    lesser_since: int | None = None  #: Off by less than those in use, by `LESSER`.
    against_since: int | None = None  #: Since when reports contradict `seen`, ns.


class Order(NamedTuple):
    """One parameter to set now."""

    imu: int  #: From 0.
    #: The wanted INS_USE.
    use: bool


class PolicyState(NamedTuple):
    """Memory between two ticks."""

    #: One for each IMU.
    memories: tuple[Memory, ...]
    #: Number of starts of the autopilot seen at the last tick.
    boots: int = 0

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
            memories[k].taken = 1
        for k in without_notch:
            memories[k].without_notch = True
            # Not ours: reported in use since then.
            memories[k].seen = k not in ours
        return cls(memories)


class Decision(NamedTuple):
    """Result of one tick."""

    #: To be sent now.
    orders: tuple[Order, ...]
    #: For the next tick.
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


def is_reserve(imu: Imu, bad: Imu, settings: PolicySettings) -> bool:
    """Return whether the autopilot flies better with an IMU than with a bad one."""
    is_fine = is_alive(imu) and bool(bad.worst) and bad.worst in imu.fine
    return is_fine or is_sound(imu, settings)


def is_refused(memory: Memory) -> bool:
    """Return whether an IMU is reported in use after many orders to take it out."""
    return memory.held and memory.seen is True and memory.tries > QUICK_TRIES


def has_stood(since: int | None, duration: int, now: int) -> bool:
    """Return whether a condition that began at since, ns, has lasted for a duration, ns."""
    return since is not None and now - since >= duration


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
        and is_reserve(view.imus[j], view.imus[k], settings)
        # Of two IMUs the monitor does not know which one is wrong. Both in use, the
        # autopilot flies as without failover.
        and (len(memories) > 2 or not view.imus[j].waits)
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
    """Return orders and the next state at time now, ns."""
    memories = tuple(Memory(**vars(memory)) for memory in state.memories)
    for memory, imu in zip(memories, view.imus, strict=True):
        if view.boots != state.boots:
            _begin_anew(memory)
        _remember(memory, imu, view, now)
    _release(memories, view, now, settings)
    _hold_worst(memories, view, now, settings)
    orders = []
    for k, memory in enumerate(memories):
        if _is_due(k, memories, view, now, settings):
            orders.append(Order(k, not memory.held))
            _note_order(memory, now)
    doubtful = any(
        imu.named or (is_apart(imu, settings) and not imu.ok) for imu in view.imus
    )
    unsettled = any(
        memory.against_since or (memory.ours and memory.seen == memory.held)
        for memory in memories
    )
    return Decision(
        orders=tuple(orders),
        state=PolicyState(memories, view.boots),
        hurry=(view.armed and doubtful) or unsettled,
    )


def _begin_anew(memory: Memory) -> None:
    """Forget what a start of the autopilot ends. Parameters outlive it."""
    # The next report shows how it began.
    memory.seen = memory.obeyed = memory.against_since = None
    memory.tries = 0
    memory.held = memory.without_notch = memory.ours  # until reported in use


def _remember(memory: Memory, imu: Imu, view: View, now: int) -> None:
    """Update a memory from the present view, before any decision."""
    if view.restore and memory.ours:
        memory.left_alone = True
    if imu.use is not None:
        _hear(memory, imu.use, imu.heard)
    if view.disarmed >= GROUNDED:
        memory.left_alone = False
        memory.taken = 0
    if imu.agreed is not None and now - imu.agreed >= ACQUAINTED:
        memory.acquainted = True
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
    memory.seen = use
    if by_others or (memory.ours and is_over):
        memory.ours = memory.held = False
        memory.tries = 0
        memory.left_alone |= by_others


def _release(
    memories: Sequence[Memory], view: View, now: int, settings: PolicySettings
) -> None:
    """Rules 1 and 4: let go of IMUs that should be back in use."""
    pairs = list(zip(memories, view.imus, strict=True))
    # A link that brings no samples at all shows nothing about the IMUs.
    is_heard = any(imu.delivers for imu in view.imus)
    none_left = all(
        memory.ours
        or (imu.use is False and imu.heard - memory.back_sent >= STALE_ANSWER)
        or imu.stuck
        or (is_heard and has_stood(memory.dead_since, REACTION, now))
        for memory, imu in pairs
    )
    only_bad = all(memory.ours or is_bad(imu, settings) for memory, imu in pairs)
    in_use = [imu.size for memory, imu in pairs if not memory.ours]
    lesser = min(in_use, default=0.0) / LESSER
    for memory, imu in pairs:
        pause = min(FIRST_PAUSE << max(0, memory.taken - 1), LONGEST_PAUSE)
        is_paused = now - memory.out_sent < pause
        agrees = has_stood(imu.agreed, pause, now) and not is_paused
        may = view.monitored if view.armed else imu.ok
        heals = agrees and may and is_alive(imu)
        is_lesser = only_bad and imu.least < lesser
        memory.lesser_since = (memory.lesser_since or now) if is_lesser else None
        is_less = imu.ok or has_stood(memory.lesser_since, REACTION, now)
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
