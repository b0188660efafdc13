# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One live message at a time: into the alignment, and through the sample path what it completes.

Each kind of input has a compiled `receive` (`fdi_ros.core.sources`), made of its
reading and `receive_stamped` or `receive_arrived`. The samples that are complete then
go through `process`.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.alignment import enter, next_sample
from fdi_ros.core.messages import (
    GOOD,
    fill_force,
    fill_half,
    fill_imu,
    fill_integrity,
)
from fdi_ros.core.path import Path, step_halves, wants_supply
from fdi_ros.core.records import Aligner, Live
from fdi_ros.model.samples import Bytes

WORKED, HAS_RATE, HAS_EVENTS, MORE, SUPPLY, MALFORMED = 1, 2, 4, 8, 16, 32
"""Bits of what taking and working a message returns: a sample was worked; it has a
fused rate; it brought events; another is to be worked; the path wants something
prepared (before the next call, which goes on with the sample if none was worked); the
message was refused."""
NEVER = -1  # instead of a stamp
# ns that a live stamp may be: clocks of two computers differ, and simulators step
AHEAD_OF_CLOCK = 1_000_000_000
# ns; a clock set back by more is followed, less is waited out: NTP slews that within
# minutes
STEP_BACK = 100_000_000


@compiled
def receive_stamped(
    live: Live, aligner: Aligner, unit: int, stamp: int, now: int
) -> int:
    """Take what was read of a message of a unit, its rate into `aligner.rate`; return `MALFORMED`, `MORE` or 0.

    ``stamp``: of the message, ns; or what is wrong with it, negative. ``now``: when it
    arrived, ns; 0: not known. What is ahead of the clock by more than `AHEAD_OF_CLOCK`
    cannot have been measured yet: it is counted and left.
    """
    inlet = live.inlets[unit]
    inlet.received += 1
    if stamp < 0:
        inlet.error = -stamp
        inlet.malformed += 1
        return MALFORMED
    inlet.error, inlet.stamp = GOOD, stamp
    if now > 0 and stamp - now > AHEAD_OF_CLOCK:
        aligner.units[unit].counters.ahead += 1
        return MORE if live.ready else 0
    enter(aligner, unit, stamp)
    lag = aligner.units[unit].lag
    inlet.lag = lag if inlet.lag == NEVER else min(lag, inlet.lag)
    if not live.ready and next_sample(aligner, live.sample):
        live.ready = True
    return MORE if live.ready else 0


@compiled
def receive_arrived(live: Live, code: int, stamp: int) -> int:
    """Take what was read of all channels, into `live.sample.z`, stamped on arrival; return `MALFORMED` or `MORE`."""
    inlet, sample = live.inlets[0], live.sample
    inlet.received += 1
    inlet.error = code
    if code != GOOD:
        inlet.malformed += 1
        return MALFORMED
    # A clock set back: the samples go on, and the messages keep the time of the clock.
    if stamp + live.clock_shift <= live.last_stamp:
        if live.last_stamp - stamp - live.clock_shift > STEP_BACK:
            live.clock_shift = live.last_stamp - stamp
            live.restarts += 1
        stamp = live.last_stamp + 1 - live.clock_shift
    live.last_stamp = sample.stamp = stamp + live.clock_shift
    sample.shift = live.clock_shift
    for i in range(live.channels):
        sample.received[i] = True
        sample.felt[i] = False
    live.ready = True
    return MORE


@compiled
def fill_accelerometers(
    paths: tuple[Path, Path], live: Live, fused: Bytes, integrity: Bytes
) -> None:
    """Write what the accelerometers gave into the messages about the last sample."""
    gyros, core = paths[0].core[0].settings, paths[1].core[0]
    natural = core.settings.natural
    if core.last.valid:
        fill_force(fused, live.fused_at, natural, core.last.rate, core.last.covariance)
    behind = live.integrity_at + 8 * (gyros.n + 7)
    fill_half(integrity, behind, core.last, core.settings.n, natural)


@compiled
def process(
    paths: tuple[Path, Path],
    halves: int,
    aligner: NDArray[Any],
    live: NDArray[Any],
    events: NDArray[Any],
    fused: Bytes,
    integrity: Bytes,
) -> int:
    """Work the next sample that is complete: `WORKED` and other bits, 0 if there is none before the next message.

    ``paths``, ``halves``: as for `run`. ``aligner``, ``live``: (1,) records. ``events``
    takes its events, ``fused`` and ``integrity`` the messages to be published about it.
    """
    monitor, main = live[0], paths[0].core[0]
    if not monitor.ready:
        return 0
    sample = monitor.sample
    # Those of the gyros stand already where the accelerometers waited.
    begun = monitor.events if main.half > 0 else 0
    count, waits = step_halves(paths, halves, sample, 0, events, begun)
    monitor.events = count
    if waits:
        return SUPPLY | MORE
    flags = WORKED | HAS_EVENTS if count > 0 else WORKED
    if main.last.valid:
        fill_imu(
            fused,
            monitor.fused_at,
            main.last.instant - sample.shift,
            main.last.rate,
            main.last.covariance,
        )
        flags |= HAS_RATE
    else:
        monitor.without_rate += 1
    if wants_supply(paths, halves):
        flags |= SUPPLY
    fill_integrity(
        integrity, monitor.integrity_at, main.last, main.settings.n, sample.shift
    )
    if halves == 2:
        fill_accelerometers(paths, monitor, fused, integrity)
    monitor.shift = sample.shift
    monitor.ready = next_sample(aligner[0], sample)
    return flags | MORE if monitor.ready else flags
