# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Live processing: a message enters the alignment, and complete samples the sample path.

Each kind of input has a compiled `receive` (`fdi_ros.core.sources`), which reads the
message and calls `receive_stamped` or `receive_arrived`. Then `process` takes each
complete sample.
"""

from __future__ import annotations

import math
from enum import IntEnum
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
from fdi_ros.core.records import Aligner, Inlet, Live
from fdi_ros.model.samples import Bytes


class LiveResult(IntEnum):
    """Bits of the results of `receive` and `process`."""

    #: a sample was processed
    WORKED = 1
    #: the sample has a fused rate
    HAS_RATE = 2
    #: the sample has events
    HAS_EVENTS = 4
    #: another sample is ready
    MORE = 8
    #: Something must be prepared before the next call, which continues with the same
    #: sample if none was processed.
    SUPPLY = 16
    #: the message was refused
    MALFORMED = 32


WORKED, HAS_RATE, HAS_EVENTS, MORE, SUPPLY, MALFORMED = map(int, LiveResult)
NO_STAMP = -1  #: In place of a stamp.
#: Largest time of a live stamp ahead of the clock, ns: clocks of computers differ.
AHEAD_OF_CLOCK = 1_000_000_000
#: A clock set back by more than this is followed, ns. Smaller steps are waited out.
STEP_BACK = 100_000_000


@compiled
def receive_stamped(
    live: Live, aligner: Aligner, unit: int, stamp: int, now: int
) -> int:
    """Process a message of a unit whose rate is in `aligner.rate`.

    Parameters
    ----------
    unit
        Unit, from 0.
    stamp
        Stamp of the message, ns, or a negative code of its error.
    now
        Time of arrival, ns. 0: unknown. A message ahead of this time by more than
        `AHEAD_OF_CLOCK` is counted and dropped.

    Returns
    -------
    int
        `MALFORMED`, `MORE` or 0.
    """
    inlet = live.inlets[unit]
    inlet.received += 1
    if stamp < 0:
        inlet.error = -stamp
        inlet.malformed += 1
        return MALFORMED
    inlet.error = GOOD
    inlet.stamp = stamp
    if now > 0 and stamp - now > AHEAD_OF_CLOCK:
        aligner.units[unit].counters.ahead += 1
        return MORE if live.ready else 0
    enter(aligner, unit, stamp)
    lag = aligner.units[unit].lag
    inlet.lag = lag if inlet.lag == NO_STAMP else min(lag, inlet.lag)
    if not live.ready and next_sample(aligner, live.sample):
        live.ready = True
    return MORE if live.ready else 0


@compiled
def receive_arrived(live: Live, code: int, stamp: int) -> int:
    """Process a message of all gyros, whose values are in `live.sample.z`.

    ``code`` is `GOOD` or the code of an error, ``stamp`` the time of arrival, ns. The
    sample takes the accelerations that arrived after the sample before. Return
    `MALFORMED` or `MORE`.
    """
    sample = live.sample
    if count_message(live.inlets[0], code) == MALFORMED:
        return MALFORMED
    # After a clock was set back, stamps of samples continue to increase, while
    # published messages follow the clock.
    if stamp + live.clock_shift <= live.last_stamp:
        if live.last_stamp - stamp - live.clock_shift > STEP_BACK:
            live.clock_shift = live.last_stamp - stamp
            live.restarts += 1
        stamp = live.last_stamp + 1 - live.clock_shift
    live.last_stamp = sample.stamp = stamp + live.clock_shift
    sample.shift = live.clock_shift
    for i in range(live.channels):
        sample.received[i] = True
    for i in range(live.accelerometers):
        sample.force[i] = live.force[i] if live.has_force else math.nan
        sample.felt[i] = live.has_force
    live.has_force = False
    live.ready = True
    return MORE


@compiled
def receive_force(live: Live, code: int) -> int:
    """Keep the values of all accelerometers, in `live.force`, for the next sample.

    ``code`` is `GOOD` or the code of an error. Return `MALFORMED` or 0.
    """
    if count_message(live.inlets[1], code) == MALFORMED:
        return MALFORMED
    live.has_force = True
    return 0


@compiled
def count_message(inlet: Inlet, code: int) -> int:
    """Count a message; ``code`` is `GOOD` or the code of an error. Return `MALFORMED` or 0."""
    inlet.received += 1
    inlet.error = code
    if code == GOOD:
        return 0
    inlet.malformed += 1
    return MALFORMED


@compiled
def fill_accelerometers(
    paths: tuple[Path, Path], live: Live, fused: Bytes, integrity: Bytes
) -> None:
    """Write the results of the accelerometers into the messages on the last sample."""
    gyros = paths[0].core[0].settings
    core = paths[1].core[0]
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
    """Process the next complete sample, and return bits of the result.

    `WORKED` and other bits; `SUPPLY` and `MORE` if a detector must be prepared first; 0
    if no sample is ready.

    Parameters
    ----------
    paths, halves
        As for `fdi_ros.core.path.run`.
    aligner, live
        Records, (1,).
    events
        Receives the events of the sample.
    fused, integrity
        Receive the messages to publish.
    """
    monitor = live[0]
    main = paths[0].core[0]
    if not monitor.ready:
        return 0
    sample = monitor.sample
    # If the accelerometers had to wait, the events of the gyros are already written.
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
