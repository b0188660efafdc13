# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether failover is ready. Pure functions that return the first reason against it.

`doubt`
    Why no fault at all is sure to be answered: the first three reasons stop all orders,
    with the others an order may come late or not at all.
`not_ready`
    The same, and why a fault of some IMU might go unanswered. Failover is ready if there is
    no reason, so never while an IMU is out of use.

`not_again`
    Why, beside an IMU that is out of use, no other one could go out.

The reasons stand in the order in which they count.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from fdi_ros.mavlink.failover.policy import (
    Memory,
    PolicySettings,
    View,
    is_apart,
    objection,
)
from fdi_ros.mavlink.protocol import MS

#: Parameters of the autopilot: 1 if it uses an IMU.
INS_USE = ("INS_USE", "INS_USE2", "INS_USE3")
#: Bit mask of the IMUs that have an EKF lane. ArduPilot takes it over at its start.
EKF_LANES = "EK3_IMU_MASK"
EKF_PRIMARY = "EK3_PRIMARY"  #: EKF lane that ArduPilot flies with from arming on.
LARGEST_AGE = 1.0  #: Age of the newest judged sample from which the monitor is late, s.
LARGEST_LOSS = 0.1  #: Largest share of lost messages.
LARGEST_READY_TRIP = 300 * MS  #: Longest round trip, ns.
MONITOR_LATE = "the monitor is late"
NO_OTHER = "no other IMU can go out of use"
#: By whether the autopilot sets a parameter, as far as is known.
ORDER_WORDS = {
    False: "setting {} has no effect",
    None: "setting {} is not answered",
}


class Facts(NamedTuple):
    """All that counts beside the view and the memories of the policy."""

    age: float = math.nan  #: Age of the newest judged sample, s. NaN: unknown.
    lost: float = math.nan  #: Share of messages lost of late. NaN: unknown.
    trip: int | None = None  #: Round trip, ns. None: unknown.
    is_slow: bool = (
        False  #: An IMU comes so slowly that vibration may look like an error.
    )
    other: int | None = None  #: System of the file, if the vehicle is another one.
    is_file_fine: bool = True  #: The file can be read and written.
    is_mixed: bool = False  #: Two senders use the system id of the autopilot.
    has_lanes: bool = True  #: `EKF_LANES` is reported.
    #: Whether the autopilot sets INS_USE of each IMU. None: unknown.
    obeys: tuple[bool | None, ...] = ()


def doubt(view: View, facts: Facts) -> str:
    """Return why no fault at all is sure to be answered now. Empty: no reason."""
    trip = facts.trip
    checks = (
        (facts.other is not None, f"failover_file is of system {facts.other}"),
        (not view.linked, "no ArduPilot that sends each IMU"),
        (not view.monitored, "monitor silent or not alone"),
        (facts.is_mixed, "two senders with one system id"),
        (not abs(facts.age) <= LARGEST_AGE, MONITOR_LATE),
        (facts.lost > LARGEST_LOSS, "link loses messages"),
        (facts.is_slow, "IMUs come too slowly"),
        (trip is None or trip > LARGEST_READY_TRIP, "link is slow"),
    )
    return next((words for holds, words in checks if holds), "")


def not_ready(
    memories: Sequence[Memory],
    view: View,
    facts: Facts,
    now: int,
    settings: PolicySettings,
) -> str:
    """Return why a fault might go unanswered at time now, ns. Empty: no reason."""
    return doubt(view, facts) or next(
        _reasons(memories, view, facts, now, settings), ""
    )


def not_again(
    memories: Sequence[Memory],
    view: View,
    facts: Facts,
    now: int,
    settings: PolicySettings,
) -> str:
    """Return why, beside an IMU that is out, no other one could go out. Empty: no reason."""
    view = _without_late_answers(memories, view, now)
    against = _objections(memories, view, now, settings)
    none_can = all(
        words
        for memory, words in zip(memories, against, strict=True)
        if not memory.ours
    )
    return doubt(view, facts) or (NO_OTHER if none_can else "")


def _reasons(
    memories: Sequence[Memory],
    view: View,
    facts: Facts,
    now: int,
    settings: PolicySettings,
) -> Iterator[str]:
    view = _without_late_answers(memories, view, now)
    apart = [str(k + 1) for k, imu in enumerate(view.imus) if is_apart(imu, settings)]
    # Of two that differ from each other, either may be the bad one.
    differ = f"IMUs {', '.join(apart)} differ" if len(apart) > 1 else ""
    found = []
    for k, (memory, imu) in enumerate(zip(memories, view.imus, strict=True)):
        name = f"IMU {k + 1}"
        checks = (
            (memory.without_notch, "reboot before flight"),
            (imu.use is None, f"use of {name} is not reported"),
            (imu.use is False, f"{name} not in use"),
            (memory.left_alone, f"{name} left alone in this flight"),
            (imu.blamed, f"{name} faulty and in use"),
            (is_apart(imu, settings), differ or f"{name} differs and is in use"),
            (not imu.delivers, f"{name} sends nothing"),
            # In flight failover acts beside a declared gyro that does not differ.
            (
                imu.declared and not view.armed,
                f"{name} {', '.join(imu.declared)} faulty or in a set",
            ),
            (not memory.acquainted, f"{name} not seen to agree yet"),
            (imu.agreed is None, f"{name} agrees with none"),
            (imu.unjudged, f"{name} {', '.join(imu.unjudged)} not judged"),
            (not imu.lane, f"{EKF_LANES} is without {name}"),
        )
        found.append(checks)
    # The gravest reason of any IMU first.
    for same in zip(*found, strict=True):
        yield from (words for holds, words in same if holds)
    orders = zip(INS_USE, facts.obeys, strict=False)
    yield from (ORDER_WORDS[obeys].format(name) for name, obeys in orders if not obeys)
    whole = (
        (not facts.has_lanes, f"{EKF_LANES} is not reported"),
        (not facts.is_file_fine, "failover_file is not usable"),
        (len(memories) < 3, "two IMUs: no third to decide"),
        (sum(imu.votes for imu in view.imus) == 1, "two were bad: no vote"),
    )
    yield from (words for holds, words in whole if holds)
    yield from filter(None, _objections(memories, view, now, settings))


def _without_late_answers(memories: Sequence[Memory], view: View, now: int) -> View:
    """Return the view with fresh reports, and without those that the policy ignores.

    Soon after an order ArduPilot may answer a read with the value from before it.
    """
    imus = []
    for memory, imu in zip(memories, view.imus, strict=True):
        is_ignored = imu.use is not None and memory.against_since is None
        use = memory.seen if is_ignored else imu.use
        imus.append(imu._replace(use=use, heard=now))
    return view._replace(imus=tuple(imus))


def _objections(
    memories: Sequence[Memory], view: View, now: int, settings: PolicySettings
) -> list[str]:
    """Return what there would be against an order for each IMU, if it was bad in flight."""
    against = []
    for k, imu in enumerate(view.imus):
        bad = imu._replace(blamed=True, size=math.inf, delivers=True)
        trial = view._replace(
            armed=True, imus=(*view.imus[:k], bad, *view.imus[k + 1 :])
        )
        against.append(objection(k, memories, trial, now, settings))
    return against
