# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One live message at a time: from what a source has read of it to the bytes of the fused message.

Each kind of input has a compiled `take` of its own (`fdi_ros.sources`), made of its reading and `take_stamped` or
`take_arrived`. The samples that are complete then go through `work`.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from fdi_ros.arrays import Bytes
from fdi_ros.compiling.compiled import compiled
from fdi_ros.core.alignment import enter, next_sample
from fdi_ros.core.messages import GOOD, fill_imu, fill_integrity
from fdi_ros.core.path import step
from fdi_ros.core.records import Aligner, Live

WORKED, HAS_RATE, HAS_EVENTS, MORE, SUPPLY, MALFORMED = 1, 2, 4, 8, 16, 32
"""Bits of what taking and working a message returns: a sample was worked; it has a fused rate; it brought
events; another is to be worked; the path wants something prepared (before the next call, which goes on with the
sample if none was worked); the message was refused."""
NEVER = -1
STEP_BACK = 100_000_000
"""A clock set back by more than this is followed, ns; less is waited out."""


@compiled
def take_stamped(live: Live, aligner: Aligner, unit: int, stamp: int) -> int:
    """Take what was read of a message of a unit, its rate into `live.rate`; return `MALFORMED`, `MORE` or 0.

    Parameters
    ----------
    live, aligner
        Records.
    unit
        Number of the unit.
    stamp
        Of the message, ns; or what is wrong with it, negative.
    """
    inlet = live.inlets[unit]
    inlet.received += 1
    if stamp < 0:
        inlet.error = -stamp
        inlet.malformed += 1
        return MALFORMED
    inlet.error, inlet.stamp = GOOD, stamp
    enter(aligner, unit, stamp, live.rate)
    lag = aligner.units[unit].lag
    inlet.lag = lag if inlet.lag == NEVER else min(lag, inlet.lag)
    if not live.ready and next_sample(aligner, live.sample):
        live.ready = True
    return MORE if live.ready else 0


@compiled
def take_arrived(live: Live, code: int, stamp: int) -> int:
    """Take what was read of a message of all channels, their values into `live.sample.z`; return `MALFORMED` or `MORE`.

    Parameters
    ----------
    live
        Record.
    code
        What reading said.
    stamp
        When the message arrived, ns.
    """
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
    live.ready = True
    return MORE


@compiled
def work(
    core: NDArray[Any],
    bank: NDArray[Any],
    memory: Bytes,
    subsets: NDArray[Any],
    aligner: NDArray[Any],
    live: NDArray[Any],
    events: NDArray[Any],
    fused: Bytes,
    integrity: Bytes,
) -> int:
    """Work the next sample that is complete.

    Parameters
    ----------
    core, bank, memory, subsets
        As for `fdi_ros.core.path.run`.
    aligner, live
        (1,) records.
    events
        Takes the events of the sample.
    fused, integrity
        Take the messages to be published about it.

    Returns
    -------
    Bits of `WORKED` and so on; 0: there is none before the next message.
    """
    own, main = live[0], core[0]
    if not own.ready:
        return 0
    sample = own.sample
    count = step(main, bank[0], memory, subsets, sample, 0, events, 0)
    if count < 0:
        return SUPPLY | MORE
    own.events = count
    told = WORKED | HAS_EVENTS if count > 0 else WORKED
    if main.last.valid:
        fill_imu(fused, own.fused_at, main.last.instant - sample.shift, main.last.rate, main.last.covariance)
        told |= HAS_RATE
    else:
        own.without_rate += 1
    if main.wanted:
        told |= SUPPLY
    fill_integrity(integrity, own.integrity_at, main.last, main.settings.n)
    own.shift = sample.shift
    own.ready = next_sample(aligner[0], sample)
    return told | MORE if own.ready else told
