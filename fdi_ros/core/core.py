# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""All that one monitor is given and remembers, as one record."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.core.acceleration import Acceleration
from fdi_ros.core.bank import Circumstances, Estimate, SampleVerdict, Sensors
from fdi_ros.core.bias import Bias
from fdi_ros.core.decision import Decision, DecisionSettings, Evidence
from fdi_ros.core.health import Health, HealthSettings
from fdi_ros.core.output import OutputRow
from fdi_ros.core.parity import Gain, Parity
from fdi_ros.core.record import MAX_UNITS, Channels, Flag, Flags, Mask, Real, Stamps, Symmetric, Vector, Whole, record
from fdi_ros.core.restamp import Line

Members = Annotated[NDArray[np.int64], "i8", (MAX_UNITS,)]
UnitRates = Annotated[NDArray[np.float64], "f8", (MAX_UNITS, 3)]


@record
class Settings:
    """What the samples do not change; some of it a change of the detector does."""

    n: Whole  # channels
    sensors: Sensors
    health: HealthSettings
    decision: DecisionSettings
    return_limit: Real  # largest difference of a channel that agrees again, in its standard deviations
    needs_acceleration: Flag
    publish_under_doubt: Flag  # a rate of channels under doubt, where they cannot be left out
    estimates: Flag  # the detector estimates the errors of the sensors
    max_drift: Real  # a bias beyond it is a fault, rad/s; 0: none is
    reach: Real  # standard deviations that the allowed risk stands for
    turn_on: Real  # standard deviation of a bias that was not learned, rad/s
    learned: Channels  # of one averaged at the start, rad/s
    units: Whole
    members: Members  # bits of the channels of each


@record
class Core:
    """All that one monitor is given and remembers."""

    settings: Settings
    health: Health
    bias: Bias
    line: Line
    known: Circumstances  # what is known beside the values, for the detector
    repeated: Mask  # channels of units that give old values in this sample
    unit_rate: UnitRates  # when each unit last gave a new value, rad/s
    frozen: Flag  # all channels repeat their values
    noisy: Mask  # channels much noisier than expected, and than the others
    estimate: Estimate  # of the errors of the sensors, by a detector that estimates them
    correction: Channels  # of the values by that, in the last sample, rad/s
    remaining: (
        Channels  # what is not known of each channel's errors and shows in the residuals, standard deviation, rad/s
    )
    acceleration: Acceleration
    decision: Decision
    excluded: Mask  # taken out by the operator
    reference: Channels  # prediction of each channel by the others when its present value was first seen, rad/s; or NaN
    doubt: Channels  # last estimate of each channel's error that was not zero, rad/s
    saturated: Flag  # a manoeuvre has driven a channel out of range
    saturated_stamp: Whole  # last sample of that, ns
    samples: Whole  # so far
    last_stamp: Whole  # of the last sample, ns
    state: Flags  # `ChannelState` after the last sample
    reason: Flags  # of each state, place in `REASONS`
    since: Stamps  # of the sample that brought the state, ns
    group: Mask  # after the last sample: the channels one of which is faulty
    error: Channels  # estimated error when the state came, rad/s
    wanted: Mask  # channels fused whose protection level is still to be worked out; 0: none
    last: OutputRow
    # Of the sample on its way:
    waiting: Flag  # `prepare_sample` is done, the detector is to follow
    learned_from: Flag  # the bias was learned from the sample, and nothing else is done with it
    moved: Channels  # values of the instant that it stands for, rad/s
    z: Channels  # values less what is known of their errors, rad/s
    fed: Channels  # what the detector sees, rad/s, of the channels in fed_mask
    fed_mask: Mask
    plain: Mask  # delivered and in range
    in_use: Mask  # of these, those in use
    usable: Mask  # of these, those that are well by themselves
    fused: Mask  # channels whose least-squares rate the last sample gave
    withheld: Flag  # there would be a rate, but of channels under doubt
    rate: Vector  # least-squares rate of the channels in use, rad/s
    along: Channels  # that rate along each axis, rad/s
    others_rate: Vector  # least-squares rate of the channels that motion is measured by in `stuck`, rad/s
    prediction: Channels  # of each channel by the others, rad/s; NaN where they give none
    variance: Channels  # of noise and what else differs from sample to sample, (rad/s)^2
    parity: Parity
    gain: Gain  # of the fused rate
    tested: Channels  # differences from the rate with weights as expected, rad/s
    common: Symmetric  # covariance of the rate by the errors of the sensors, (rad/s)^2
    lagging: Vector  # change of the rate up to the instant that is stated, rad/s
    plain_rate: Vector  # of the channels fused, with weights as expected, rad/s
    growth: Channels  # of that with the bias that remains, in noise_std^2
    verdict: SampleVerdict
    evidence: Evidence
