# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Texts of failover for the pilot: one sentence for each condition of an IMU.

Each IMU, and the vehicle, has one condition at a time: the first in its part of `Condition`
that holds. `announce` compares it with the last one announced:

1. A new condition is announced at once if it is urgent, else at the earliest `SPACED` after
   the last text about the same IMU or the vehicle.
2. A repeated one is announced again every `REPEAT` while it lasts.
3. While no condition holds, nothing is announced, and the last condition counts on.
   `OUT` after `WAITS` is no news.
4. At the start the last ones are `FINE` and `REDUNDANT`, so these two are announced only
   after another.
5. Without a link nothing is announced, and what was announced into a gap of the link counts
   as not announced (`controller.Failover`).

The text of `OUT` waits `SIZING` at most for the size of the error. `Readiness` announces
whether failover itself works.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum
from typing import NamedTuple

from fdi_ros.mavlink.failover.policy import (
    GROUNDED,
    LONG_AGO,
    QUICK_TRIES,
    REACTION,
    Memory,
    PolicySettings,
    View,
    has_stood,
    is_apart,
    is_bad,
)
from fdi_ros.mavlink.failover.ready import INS_USE, MONITOR_LATE, NO_OTHER
from fdi_ros.mavlink.protocol import MS, NS
from fdi_ros.mavlink.report import CRITICAL, INFO, TEXT_LENGTH, WARNING

#: An IMU that is apart, but not named, or that waits in flight, is announced after this, ns.
UNNAMED = 5 * NS
REPEAT = 10 * NS  #: Time between two announcements of a lasting danger, ns.
SPACED = NS  #: Least time between two announcements that are not urgent, ns.
SIZING = 200 * MS  #: Longest wait of a text for the size of an error, ns.
#: Readiness must have changed for this time to be announced, ns.
ANNOUNCED_AFTER = 3 * NS
#: Angle by which an EKF lane is lost, rad: what its IMU turned too much or too little. In
#: ArduCopter's simulation lanes recover from 0.4 rad within 10 s, and never from 3 rad.
LOST_LANE = 1.5
LANE_RECOVERY = 10.0  #: Time constant with which a lane recovers from less, s.
VEHICLE = -1  #: Key of the vehicle beside the numbers of the IMUs.


class Words(NamedTuple):
    """One sentence."""

    severity: int  #: MAV_SEVERITY.
    text: str  #: What follows "FDI: ", or for an IMU "FDI: IMU 1 ".
    urgent: bool = False  #: Announced at once.
    repeated: bool = False  #: Announced again every `REPEAT`.


class Condition(Enum):
    """Conditions and their sentences. The first that holds counts.

    `imu_condition` and `vehicle_condition` say when each holds, in the same order.
    """

    # Of an IMU.
    DANGER = Words(CRITICAL, "faulty AND IN USE: land", urgent=True, repeated=True)
    STUCK_OUT = Words(WARNING, "not back in use, though asked")
    REBOOT = Words(CRITICAL, "no notch: set {use} 1 and reboot")
    STAYS_OUT = Words(CRITICAL, "still faulty, stays out of use")
    FROZEN = Words(WARNING, "repeats one value, stays out")
    NOT_OK = Words(WARNING, "stays out, monitor does not find it OK")
    WAITS = Words(WARNING, "waits to agree in a turn about {axes}")
    OUT = Words(CRITICAL, "out of use", urgent=True)
    LEFT_ALONE = Words(WARNING, "left alone in this flight")
    UNUSED = Words(WARNING, "not in use, not by failover")
    APART = Words(WARNING, "differs from the others")
    NO_NOTCH = Words(CRITICAL, "no notch: reboot")
    FINE = Words(INFO, "in use, does not differ")
    # Of the vehicle.
    ALONE = Words(
        CRITICAL, "one IMU or none is alive: land", urgent=True, repeated=True
    )
    LAST_IMU = Words(CRITICAL, "one IMU left in use: land", urgent=True, repeated=True)
    LAST_LANE = Words(CRITICAL, "one EKF lane or none left: land", repeated=True)
    DISAGREE = Words(CRITICAL, "the IMUs disagree: land", repeated=True)
    REDUNDANT = Words(INFO, "two IMUs or more agree again")


class Note(NamedTuple):
    """What the words remember of one IMU. Times in ns."""

    bad_since: int | None = None  #: Bad, in use and armed since this time.
    apart_since: int | None = None  #: In use, apart, and no `DANGER`, since this time.
    #: Out by us, not apart, and without a turn that would show its error, since this time.
    waits_since: int | None = None
    lane_angle: float = 0.0  #: Angle by which its EKF lane was misled, rad.


class Announced(NamedTuple):
    """The last announcement about one IMU or the vehicle."""

    #: What was announced.
    condition: Condition
    at: int  #: Time, ns.


class WordsState(NamedTuple):
    """Memory between two ticks."""

    #: One for each IMU.
    notes: tuple[Note, ...]
    #: Last announcements, by the number of the IMU, from 0, or `VEHICLE`.
    announced: Mapping[int, Announced] = {}
    #: Number of starts of the autopilot seen at the last tick.
    boots: int = 0
    at: int = LONG_AGO  #: Time of the last tick, ns.


def announce(
    state: WordsState,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> tuple[WordsState, list[tuple[int, Condition]]]:
    """Return the next state, and the IMUs, or `VEHICLE`, with conditions to announce now.

    The memories are those of the policy after its decision at time now, ns.
    """
    notes = _note(state, memories, view, now, settings)
    found = {
        k: imu_condition(k, notes, memories, view, now, settings)
        for k in range(len(notes))
    }
    found[VEHICLE] = vehicle_condition(notes, memories, view, now, settings)
    announced = dict(state.announced)
    words = []
    for key, condition in found.items():
        usual = Condition.REDUNDANT if key == VEHICLE else Condition.FINE
        last = announced.get(key, Announced(usual, LONG_AGO))
        is_known = condition is Condition.OUT and last.condition is Condition.WAITS
        if condition is None or is_known or not view.linked:
            continue
        if condition is last.condition:
            is_due = condition.value.repeated and now - last.at >= REPEAT
        else:
            is_due = condition.value.urgent or now - last.at >= SPACED
        if is_due:
            announced[key] = Announced(condition, now)
            words.append((key, condition))
    return WordsState(notes, announced, view.boots, now), words


def is_odd_known(view: View, settings: PolicySettings) -> bool:
    """Return whether an IMU that differs is the odd one: others agree, and the monitor finds one OK."""
    two_agree = not all(is_apart(imu, settings) for imu in view.imus)
    return two_agree and any(imu.ok for imu in view.imus)


def imu_condition(
    k: int,
    notes: Sequence[Note],
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> Condition | None:
    """Return the condition of IMU k. None: nothing is to be announced."""
    memory = memories[k]
    imu = view.imus[k]
    is_out = memory.ours and memory.seen is False
    stays = is_out and not view.armed
    asked_back = memory.ours and not memory.held and memory.tries > QUICK_TRIES
    is_odd = has_stood(notes[k].apart_since, UNNAMED, now) and is_odd_known(
        view, settings
    )
    # Not so where it agrees with one that is out of use: then that one has healed.
    is_alone = imu.least >= settings.min_size
    checks = (
        (has_stood(notes[k].bad_since, REACTION, now), Condition.DANGER),
        (asked_back, Condition.STUCK_OUT),
        # On the way back.
        (is_out and not memory.held, None),
        (stays and memory.without_notch, Condition.REBOOT),
        (stays and imu.named is True, Condition.STAYS_OUT),
        (stays and imu.stuck, Condition.FROZEN),
        (stays and not imu.ok, Condition.NOT_OK),
        (stays and bool(imu.waits), Condition.WAITS),
        (is_out and has_stood(notes[k].waits_since, UNNAMED, now), Condition.WAITS),
        # It agrees, and goes back after its pause, or soon does.
        (stays, None),
        (is_out, Condition.OUT),
        (view.armed and memory.left_alone, Condition.LEFT_ALONE),
        (memory.seen is False, Condition.UNUSED),
        # Where it agrees again, the one that it differed from was bad.
        (is_odd and imu.agreed is None and is_alone, Condition.APART),
        (_is_in_use(memory) and memory.without_notch, Condition.NO_NOTCH),
        (_is_in_use(memory) and imu.size < settings.min_size, Condition.FINE),
    )
    return next((condition for holds, condition in checks if holds), None)


def vehicle_condition(
    notes: Sequence[Note],
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> Condition | None:
    """Return the condition of the vehicle. None: nothing is to be announced."""
    is_heard = any(imu.delivers for imu in view.imus)
    alive = sum(not has_stood(memory.dead_since, REACTION, now) for memory in memories)
    left = sum(memory.seen is not False for memory in memories)
    by_us = any(memory.ours and memory.seen is False for memory in memories)
    angles = [
        note.lane_angle for note, imu in zip(notes, view.imus, strict=True) if imu.lane
    ]
    lanes = sum(angle < LOST_LANE for angle in angles)
    differs = any(has_stood(note.apart_since, UNNAMED, now) for note in notes)
    agreeing = [
        imu.agreed is not None and _is_in_use(memory)
        for memory, imu in zip(memories, view.imus, strict=True)
    ]
    checks = (
        (view.armed and is_heard and alive <= 1, Condition.ALONE),
        (view.armed and by_us and left <= 1, Condition.LAST_IMU),
        (view.armed and lanes <= 1 and lanes < len(angles), Condition.LAST_LANE),
        (
            view.armed and differs and not is_odd_known(view, settings),
            Condition.DISAGREE,
        ),
        (sum(agreeing) > 1, Condition.REDUNDANT),
    )
    return next((condition for holds, condition in checks if holds), None)


def _is_in_use(memory: Memory) -> bool:
    """Return whether an IMU is in use by all reports, and no order "out" is under way."""
    return memory.seen is True and memory.against_since is None and not memory.held


def _note(
    state: WordsState,
    memories: Sequence[Memory],
    view: View,
    now: int,
    settings: PolicySettings,
) -> tuple[Note, ...]:
    """Return what is remembered of each IMU from now on.

    EKF lane k follows IMU k, or the first IMU in use while IMU k is out.
    """
    is_anew = view.boots != state.boots or view.disarmed >= GROUNDED
    seconds = min(max(now - state.at, 0), NS) / NS
    first = next((k for k, memory in enumerate(memories) if memory.seen), 0)
    notes = []
    for k, (note, memory) in enumerate(zip(state.notes, memories, strict=True)):
        imu = view.imus[k]
        in_use = memory.seen is not False
        is_danger = in_use and view.armed and is_bad(imu, settings)
        bad_since = (note.bad_since or now) if is_danger else None
        # The pilot has been warned: what is left of a danger is no news for a while.
        is_off = is_apart(imu, settings) and not has_stood(bad_since, REACTION, now)
        apart_since = (note.apart_since or now) if in_use and is_off else None
        angle = 0.0 if is_anew else note.lane_angle
        is_unshown = bool(imu.waits) and imu.size < settings.min_size
        is_waiting = memory.ours and not in_use and is_unshown
        waits_since = (note.waits_since or now) if is_waiting else None
        source = view.imus[k if in_use else first]
        # While two others are bad a healthy one, or one of a lesser error, is apart from both.
        is_bad_one = source.blamed or not (source.ok or source.named)
        is_misled = is_apart(source, settings) and is_bad_one
        if view.armed and source.delivers and is_misled:
            angle += source.size * seconds
        elif angle < LOST_LANE:
            angle *= max(0.0, 1.0 - seconds / LANE_RECOVERY)
        notes.append(Note(bad_since, apart_since, waits_since, angle))
    return tuple(notes)


class Readiness(NamedTuple):
    """Memory of the texts on failover itself.

    1. ``no failover: REASON`` once the reason has stood for `ANNOUNCED_AFTER` while armed and heard,
       a late monitor at once. An order may end a reason right after arming.
    2. ``failover is ready`` once no reason has stood for that time: the first time, and
       after such a text. While an IMU is out of use: ``failover acts again``, only after
       such a text.
    3. `NO_OTHER` is not announced: with the last IMU in use `LAST_IMU` is.
    """

    why: str | None = None  #: Present reason. Empty: none. None: not known yet.
    since: int = LONG_AGO  #: When it began, or could be announced since, ns.
    may_warn: bool = False  #: A reason could be announced.
    announced: str | None = None  #: Reason announced last.

    def hear(
        self, why: str, is_out: bool, may_warn: bool, now: int
    ) -> tuple[Readiness, Words | None]:
        """Return the next memory, and the words to announce now, or None.

        Parameters
        ----------
        why
            Reason against failover: `failover.ready.not_ready`, or, as an IMU that is out of
            use is announced by itself, `failover.ready.not_again` while one is.
        is_out
            Whether one is.
        may_warn
            Whether the vehicle is armed and heard.
        now
            Time, ns.
        """
        begins = why != self.why or (why and may_warn and not self.may_warn)
        since = now if begins else self.since
        state = self._replace(why=why, since=since, may_warn=may_warn)
        stands = why == MONITOR_LATE or now - state.since >= ANNOUNCED_AFTER
        warns = may_warn and why != NO_OTHER
        is_news = warns if why else bool(self.announced) or not is_out
        if why == self.announced or not stands or not is_news:
            return state, None
        fine = "failover acts again" if is_out else "failover is ready"
        words = Words(WARNING, f"no failover: {why}") if why else Words(INFO, fine)
        return state._replace(announced=why), words


def imu_name(imu: int, channels: Sequence[str]) -> str:
    """Return the autopilot's name of an IMU, from 0, and the topic's: IMU 1 (front).

    Without the topic's name if that only repeats the number: imu_1.
    """
    name = channels[3 * imu].rpartition(".")[0]
    repeats = name in ("", f"imu_{imu + 1}")
    return f"IMU {imu + 1}" if repeats else f"IMU {imu + 1} ({name})"


def text_of(
    key: int,
    condition: Condition,
    channels: Sequence[str],
    error: tuple[str, float] | None = None,
    waits: str = "",
) -> str:
    """Return the text for an IMU, from 0, or `VEHICLE`.

    Parameters
    ----------
    channels
        Channel names, three for each IMU.
    error
        Axis and size, rad/s, in REP-103 axes. The text has ArduPilot's: y to the right,
        z down.
    waits
        Axes about which a turn is needed.
    """
    words = condition.value.text
    if key == VEHICLE:
        return f"FDI: {words}"
    words = words.format(use=INS_USE[key], axes=", ".join(waits))
    if error is not None:
        axis, size = error
        words += f" (gyro {axis} {size if axis == 'x' else -size:+.2f} rad/s)"
    text = f"FDI: {imu_name(key, channels)} {words}"
    return text if len(text) <= TEXT_LENGTH else f"FDI: IMU {key + 1} {words}"
