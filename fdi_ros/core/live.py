"""Bytes of a message in, bytes of the fused message out: alignment and the sample path, one message at a time."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.alignment import Aligner, Sample, enter, next_sample
from fdi_ros.core.compiled import compiled
from fdi_ros.core.core import Core
from fdi_ros.core.messages import GOOD, Message, fill_channels, fill_imu, read_channels, read_imu
from fdi_ros.core.path import step
from fdi_ros.core.record import MAX_CHANNELS, MAX_UNITS, Flag, Whole, record

Bytes = NDArray[np.uint8]

WORKED, HAS_RATE, HAS_EVENTS, MORE, SUPPLY, MALFORMED = 1, 2, 4, 8, 16, 32
"""Bits of what `receive` returns: a sample was worked; it has a fused rate; it brought
events; another is to be worked; the path wants something prepared (before the next call, which goes on with the
sample if none was worked); the message was refused."""
NEVER = -1
NO_MESSAGE = -1
STEP_BACK = 100_000_000
"""A clock set back by more than this is followed, ns; less is waited out."""


@record
class Inlet:
    """What was counted of one input topic."""

    received: Whole  # messages
    malformed: Whole  # of them
    error: Whole  # why the last malformed one was refused
    stamp: Whole  # of the last good message, ns; `NEVER` where there was none
    lag: Whole  # least lag behind the other inputs since `NEVER` was written here, ns


@record
class Live:
    """What a live monitor needs beside its record."""

    fused_at: Whole  # where the rate begins in the fused message
    integrity_at: Whole  # where the values begin in the integrity message
    channels: Whole  # values in an array; 0: the inputs are Imus
    ready: Flag  # a sample is to be worked
    sample: Sample
    message: Message
    events: Whole  # of the last sample
    shift: Whole  # to be taken off the stamp of the last sample to have that of its message, ns
    without_rate: Whole  # samples
    last_stamp: Whole  # of the last array, ns
    clock_shift: Whole  # added to the stamps of arrays, ns; 0 until the clock was set back
    restarts: Whole  # times that it was
    values: Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS + 5,)]  # of the integrity message
    inlets: Annotated[list[Inlet], MAX_UNITS]


@compiled
def receive(
    core: NDArray[Any],
    bank: NDArray[Any],
    memory: Bytes,
    subsets: NDArray[Any],
    aligner: NDArray[Any],
    live: NDArray[Any],
    events: NDArray[Any],
    fused: Bytes,
    integrity: Bytes,
    inlet: int,
    data: Bytes,
    stamp: int,
) -> int:
    """Take one message, and work the first sample that it completes; or work the next sample.

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
    inlet
        Number of the input topic; `NO_MESSAGE`: no message, work the next sample.
    data
        Bytes of the message: a sensor_msgs/Imu, or a std_msgs/Float64MultiArray of all channels.
    stamp
        Of an array, ns, later than the one before.

    Returns
    -------
    Bits of `WORKED` and so on.
    """
    own, main = live[0], core[0]
    if inlet != NO_MESSAGE:
        if not 0 <= inlet < aligner[0].n:
            return 0
        taken = take_array(own, data, stamp) if own.channels else take_imu(own, aligner[0], inlet, data)
        if not taken:
            return MALFORMED
    if not own.ready and not next_sample(aligner[0], own.sample):
        return 0
    sample = own.sample
    own.ready = True
    count = step(main, bank[0], memory, subsets, sample.stamp, sample.z, sample.received, 0, events, 0)
    if count < 0:
        return SUPPLY | MORE
    own.events = count
    told = WORKED | HAS_EVENTS if count > 0 else WORKED
    if main.last.valid:
        fill_imu(fused, own.fused_at, sample.stamp - sample.shift, main.last.rate, main.last.covariance)
        told |= HAS_RATE
    else:
        own.without_rate += 1
    if main.wanted:
        told |= SUPPLY
    fill_integrity(main, own, integrity)
    own.shift = sample.shift
    own.ready = next_sample(aligner[0], sample)
    return told | MORE if own.ready else told


@compiled
def take_imu(live: Live, aligner: Aligner, unit: int, data: Bytes) -> bool:
    """Take one sensor_msgs/Imu of a unit; False if it is none."""
    inlet = live.inlets[unit]
    inlet.received += 1
    inlet.error = read_imu(data, 0, len(data), live.message)
    if inlet.error != GOOD:
        inlet.malformed += 1
        return False
    inlet.stamp = live.message.stamp
    enter(aligner, unit, inlet.stamp, live.message.rate)
    lag = aligner.units[unit].lag
    inlet.lag = lag if inlet.lag == NEVER else min(lag, inlet.lag)
    return True


@compiled
def take_array(live: Live, data: Bytes, stamp: int) -> bool:
    """Take one std_msgs/Float64MultiArray of all channels, stamped when it arrived; False if it is none."""
    inlet, sample = live.inlets[0], live.sample
    inlet.received += 1
    inlet.error = read_channels(data, 0, len(data), live.channels, sample.z)
    if inlet.error != GOOD:
        inlet.malformed += 1
        return False
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
    return True


@compiled
def fill_integrity(core: Core, live: Live, integrity: Bytes) -> None:
    """Write statistic, threshold, states and protection level of the last sample into the integrity message."""
    n, values, last = core.settings.n, live.values, core.last
    values[0], values[1] = last.statistic, last.threshold
    for i in range(n):
        values[2 + i] = last.state[i]
    for a in range(3):
        values[2 + n + a] = last.level[a]
    fill_channels(integrity, live.integrity_at, values, n + 5)
