# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results of the monitor: states, reasons, the figures of one sample, changes of state."""

from __future__ import annotations

from enum import Enum, IntEnum

from fdi_ros.core.record import Channels, Flag, Flags, Mask, Real, Small, Symmetric, Vector, Whole, record


class ChannelState(IntEnum):
    """State of one channel; the number is what ``~/integrity`` carries."""

    OK = 0
    """Delivers, is checked against the others and agrees."""
    SUSPECT = 1
    """Left out of the fused rate for now: under suspicion, not confirmed."""
    AMBIGUOUS = 2
    """One of a named set of channels is faulty; the evidence cannot tell which."""
    FAULTY = 3
    """Declared faulty and left out."""
    STALE = 4
    """Gives nothing, or nothing new."""
    UNCHECKED = 5
    """Delivers, but nothing can check it: too few others, bias not learned, or the detector cannot run."""
    EXCLUDED = 6
    """Taken out by the operator."""


class Reason(str, Enum):
    """Why a channel is in its state, in words; records hold the place in this list."""

    NONE = ""
    DISAGREES = "disagrees with the others"
    NON_FINITE = "not a finite number"
    OUT_OF_RANGE = "out of range"
    STUCK = "stuck: repeats one value while the others move"
    FROZEN = "frozen: has repeated one value for long"
    NO_DATA = "gives no data"
    TOO_FEW = "too few channels left to check it"
    LATELY = "too few of its last samples could be checked"
    CANNOT_RUN = "the detector cannot run on the channels left"
    BIAS = "bias not learned yet"
    OPERATOR = "taken out by the operator"
    ALL_REPEAT = "all channels repeat their values: nothing new is measured"
    DRIFTED = "has drifted: its bias is beyond bias.max_drift"


REASONS = tuple(Reason)


@record
class OutputRow:
    """Results of one sample."""

    stamp: Whole  # ns
    instant: Whole  # that the rate is of, ns: before the stamp, where units are late
    rate: Vector  # fused body rate, rad/s; NaN where there is none
    covariance: Symmetric  # of the fused rate, (rad/s)^2; NaN where there is none
    valid: Flag  # there is a fused rate
    alarm: Flag  # the detector's, before confirmation
    state: Flags  # `ChannelState` after the sample
    statistic: Real  # the detector's; NaN where the sample could not be judged
    threshold: Real  # the detector's; NaN where the sample could not be judged
    residual: Channels  # bias-free channel minus fused rate along its axis, rad/s; NaN where either is missing
    level: Vector  # protection level of the fused rate, rad/s; infinite where there is none


@record
class EventRow:
    """One change of state of one channel."""

    row: Whole  # of the sample in its block
    stamp: Whole  # ns
    channel: Whole
    before: Small  # `ChannelState`
    after: Small  # `ChannelState`
    reason: Small  # place in `REASONS`
    group: Mask  # AMBIGUOUS: the channels one of which is faulty; otherwise the channel alone
    error: Real  # estimated error, rad/s; 0 where the reason is neither disagreement nor drift
