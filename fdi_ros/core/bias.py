"""Bias of each channel: fixed, or averaged over a first time at rest."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.compiled import compiled
from fdi_ros.core.record import Channels, Counts, Flag, Mask, Real, Small, Whole, record

LEAST_ROWS = 10
"""Samples that an average takes at least."""
LARGEST = 1e3
"""rad/s; a value beyond it counts as this in an average."""
AT_REST = 1.0
"""rad/s; beyond it there is no rest, whatever the exact figure."""
FIXED, LEARNING, LEARNED, RESTORED, TOO_FEW, NOT_AT_REST = range(6)
"""Where the bias comes from; or why the last average was refused."""


@record
class Bias:
    """Bias of each channel, and the average that is being taken.

    A time that was not at rest is refused and a new one begun.
    """

    given: Flag  # by the settings
    value: Channels  # subtracted from each channel, rad/s
    known: Mask  # the others were silent or restless while the average was taken
    duration: Whole  # of the average, ns
    max_rate: Real  # mean at rest, rad/s
    max_std: Channels  # at rest, rad/s
    learning: Flag
    started: Flag  # an average has begun
    start: Whole  # stamp of its first sample, ns
    rows: Whole  # samples in it
    count: Counts  # values of each channel
    total: Channels  # rad/s
    squares: Channels  # (rad/s)^2
    outcome: Small  # where the bias comes from; or why the last average was refused
    average: Channels  # of the last average, rad/s
    scatter: Channels  # of the last average, rad/s
    heard: Mask  # channels that gave enough values in the last average
    restless: Mask  # those of them that were not at rest


@compiled
def take_for_bias(own: Bias, n: int, stamp: int, z: NDArray[np.float64], good: int, lost: int) -> bool:
    """Take one sample into the average.

    Parameters
    ----------
    own
        The average.
    n
        Number of channels.
    stamp
        ns.
    z
        (n,) rad/s, as delivered.
    good
        Bits of the channels that are finite and in range.
    lost
        Bits of the channels declared faulty or taken out: they say nothing about rest, and keep their bias.

    Returns
    -------
    Whether the sample was used; False if with it the bias is learned.
    """
    if own.started and stamp >= own.start + own.duration:
        conclude(own, n, lost)
        if not own.learning:
            return False
    if not own.started:
        own.started, own.start, own.rows = True, stamp, 0
        for i in range(n):
            own.count[i] = 0
            own.total[i] = own.squares[i] = 0.0
    own.rows += 1
    for i in range(n):
        if good >> i & 1:
            own.count[i] += 1
            own.total[i] += min(max(z[i], -LARGEST), LARGEST)
            square = min(abs(z[i]), AT_REST)
            own.squares[i] += square * square
    return True


@compiled
def conclude(own: Bias, n: int, lost: int) -> None:
    """Accept the time as rest and set the bias, or note why not."""
    heard = at_rest = resting = restless = 0
    for i in range(n):
        count = max(own.count[i], 1)
        own.average[i] = own.total[i] / count
        own.scatter[i] = math.sqrt(max(own.squares[i] / count - own.average[i] * own.average[i], 0.0))
        if own.count[i] * 2 > own.rows and not lost >> i & 1:
            heard |= 1 << i
            if abs(own.average[i]) <= own.max_rate and own.scatter[i] <= own.max_std[i]:
                at_rest |= 1 << i
                resting += 1
            else:
                restless += 1
    own.started = False
    own.heard, own.restless = heard, heard & ~at_rest
    # One channel that does not look at rest is a bad channel; if more do, the vehicle moves.
    if restless <= 1 and resting >= 3 and own.rows >= LEAST_ROWS:
        for i in range(n):
            if at_rest >> i & 1:
                own.value[i] = own.average[i]
        own.known = at_rest | lost
        own.learning, own.outcome = False, LEARNED
    else:
        own.outcome = NOT_AT_REST if own.restless else TOO_FEW
