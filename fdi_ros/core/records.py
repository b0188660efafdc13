# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""All records of the sample path, in the order in which a sample passes them.

`Core` is the whole record of one monitor. Settings are in `PathSettings`, figures that
last for one sample in `Current`. Most other fields are memory between samples. Detection
methods have their own records.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from fdi_ros.compiling.compiled import (
    MAX_CHANNELS,
    MAX_UNITS,
    Axes,
    Channels,
    Counts,
    Flag,
    Flags,
    Mask,
    Real,
    Small,
    Square,
    Stamps,
    Symmetric,
    Units,
    Vector,
    Whole,
    record,
)

#: Largest number of waiting messages of one unit.
MAX_PENDING = 1024
#: Stored messages of one unit: the waiting ones, one too many, and the previous one.
RING = MAX_PENDING + 2
#: Samples stored to bring all units to the instant of the latest unit: 60 ms at 16 kHz.
RESTAMP_SAMPLES = 1024
#: Portions into which the time of the start-up average is divided.
BIAS_PORTIONS = 15
#: Largest number of samples in the window of the angular acceleration.
ACCELERATION_SAMPLES = 1024
#: Samples in the longest voting window.
DECISION_SAMPLES = 1000
Matrix = Annotated[NDArray[np.float64], "f8", (3, 3)]


@record
class Inlet:
    """Counters of one input topic."""

    received: Whole  # messages
    malformed: Whole  # messages
    error: Whole  # reason why the last malformed message was refused
    stamp: Whole  # of the last good message, ns, or `NO_STAMP`
    # least lag behind the other inputs since `NO_STAMP` was written here, ns
    lag: Whole


@record
class Counters:
    """Counts of the messages of one unit. The last two fields count samples."""

    received: Whole
    duplicate: Whole  # same stamp as the previous message
    backward: Whole  # older stamp than the previous message
    ahead: Whole  # stamp ahead of the clock
    jumped: Whole  # stamp ahead of the common time by more than the timeout
    late: Whole  # stamp older than the last sample
    interpolated: Whole  # samples
    missing: Whole  # samples


@record
class Accepted:
    """A message that was accepted."""

    stamp: Whole  # ns
    rate: Vector  # rad/s
    force: Vector  # specific force, m/s^2, or NaN if the message has none
    step: Whole  # since the previous message, ns
    bridges: Flag  # the span since the previous message may be interpolated


@record
class Unit:
    """Messages of one unit: the waiting ones, and the last one that samples have passed.

    Messages are numbered from 0 in each time base. Message k is at index k % `RING`.
    """

    begin: Whole  # number of the first waiting message
    end: Whole  # number of the next message
    used: Whole  # number after the last message that entered a sample unchanged
    usual: Annotated[NDArray[np.int64], "i8", (2,)]  # the last two steps, ns
    newest: Whole  # stamp of the last accepted message, ns
    lag: Whole  # of the last message behind the common time, ns
    heard: Flag  # a message has come
    before: Whole  # stamp of the last message, accepted or not, ns
    # time that each other unit has gone on since the last accepted message, ns
    passed: Annotated[NDArray[np.int64], "i8", (MAX_UNITS,)]
    delay: Whole  # of the stamps, subtracted from each, ns
    leapt: Flag  # stamps jumped back by more than the timeout; none accepted since
    parted: Flag  # fell behind the common time by more than the timeout without a jump
    off: Flag  # the last messages were outside the time base
    off_first: Whole  # first stamp of the present run outside the time base, ns
    off_last: Whole  # last stamp of the run, ns
    off_rate: Vector  # rad/s
    off_force: Vector  # m/s^2
    counters: Counters
    messages: Annotated[list[Accepted], RING]


@record
class Aligner:
    """Memory of the alignment.

    Stamps are those of the messages less the delay of their unit, without the shift.
    """

    n: Whole  # units
    max_skew: Whole  # ns
    timeout: Whole  # ns
    bridge: Whole  # longest interpolated span, ns
    begun: Flag  # a message was accepted
    common: Whole  # newest stamp that two units have reached, ns
    formed: Flag  # a sample was formed in this time base
    last: Whole  # stamp of the last sample, ns
    shift: Whole  # added to the stamps of samples, ns
    restarts: Whole  # number of new time bases
    # _IDLE: no sample before the next message. _RESTARTING: the time base moves after
    # the next sample.
    phase: Whole
    force: Whole  # samples up to this stamp are formed without waiting, ns
    moved_to: Whole  # stamp at which the new time base begins, ns
    rate: Vector  # of the message being entered, rad/s
    felt: Vector  # specific force of that message, m/s^2, or NaN if it has none
    units: Annotated[list[Unit], MAX_UNITS]


@record
class Sample:
    """One sample of all channels."""

    stamp: Whole  # ns
    shift: Whole  # stamp less the message's, ns
    z: Channels  # rates, rad/s, NaN where not received
    received: Flags  # by gyro
    force: Channels  # specific forces, m/s^2, NaN where not received
    felt: Flags  # received, by accelerometer


@record
class Sensors:
    """Error model of the channels of one set, in order, without gaps."""

    n: Whole  # channels
    axes: Axes  # sensitivity axes in the body frame
    noise_std: Channels  # rad/s
    scale_std: Channels  # 1
    timing_std: Channels  # s
    constant: Flag  # the variance depends on neither rate nor acceleration
    gain: Axes  # row i: share of channel i in the least-squares rate of equal weights
    share: Channels  # S_ii: share of a channel's own error in its residual
    detectable: Flags  # a fault of the channel reaches the parity vector
    # pairs of channels that no residual distinguishes
    alike: Annotated[NDArray[np.uint8], "u1", (MAX_CHANNELS, MAX_CHANNELS)]


@record
class Estimate:
    """Estimated errors of the sensors in one sample."""

    is_current: Flag  # the other fields belong to this sample
    checked: Mask  # channels whose uncertainty hides no fault
    doubtful: Mask  # channels that may be faulty, by evidence too weak to declare
    corrected: Channels  # values less their estimated errors, rad/s
    variance: Channels  # of the present noise, (rad/s)^2
    covariance: Square  # of the estimated errors, (rad/s)^2
    common: Channels  # part of its diagonal that no weights reduce, (rad/s)^2
    # largest ratio of a residual's variance to the expected one, at least 1; valid only
    # after `wants_excess`
    excess: Real
    bias: Channels  # in addition to the bias from the start, rad/s
    bias_std: Channels  # standard deviation of `bias`, rad/s
    far_bias: Channels  # bias that no healthy sensor has, rad/s, or 0
    # channels whose `bias` may be errors of others: a fault of each alone did not explain
    # the values
    unclear: Mask
    late: Units  # certain delay of the stamps of each unit, s, which `restamp` corrects
    behind: Real  # time from measurement to stamp, if the earliest unit is not late, s
    largest_delay: Real  # largest delay between units, s
    delay: Units  # estimated delay of each unit against the first, s
    delay_variance: Units  # of `delay`, s^2
    spikes: Counts  # short outliers of each channel so far, left out of the rate


@record
class SampleInput:
    """A sample of one set of channels: values in order, without gaps.

    A method that takes any set of channels gets all channels, and ``mask`` has those
    that are present. Other masks, `start_bias` and `bias_std` refer to all channels.
    """

    stamp: Whole  # ns
    z: Channels  # rad/s
    mask: Mask
    out: Mask  # channels taken out of use, which may still be present
    beyond: Mask  # channels out of range, or unusable in this sample by themselves
    acceleration: Vector  # body angular acceleration, rad/s^2
    start_bias: Channels  # bias from the start that ``z`` does not contain, rad/s
    bias_std: Channels  # its standard deviation, rad/s
    # variance by the unknown positions of accelerometers in the present turn, (rad/s)^2
    displaced: Channels
    # rate of the body beside that, from the gyros, rad/s
    spin: Vector
    # standard deviation of the positions, m over the natural size of the quantity
    position_std: Channels
    # fused specific force of the sample before, m/s^2, beside gyros
    force: Vector
    has_force: Flag
    # delay of each unit against the first by its gyros, beside accelerometers, s, and the
    # variance of that, s^2; 0: unknown
    delay: Units
    delay_variance: Units
    interrupted: Flag  # a hole in the stream precedes this sample
    # a manoeuvre has just driven a channel out of range: evidence is void
    in_recovery: Flag
    repeated: Flag  # a unit seems to repeat old values in coarse steps: no evidence
    wants_excess: Flag  # another method is to judge the corrected values
    estimate: Estimate  # written by the estimator, valid until the next sample


@record
class SampleVerdict:
    """Verdict of a method on one sample; channels as in `SampleInput`."""

    statistic: Real
    threshold: Real  # the statistic from which on the method alarms
    alarm: Flag
    isolated: Flag  # every suspect is faulty
    suspects: Flags
    error: Channels  # estimated error of each suspect, rad/s, otherwise 0
    scores: Channels  # figure of the method for each channel, NaN if not judged
    outliers: Flags  # too far off to be used in this sample, without an alarm
    noise: Channels  # recent noise relative to noise_std, 0 if not measured


@record
class Bank:
    """Addresses of a method's constants and memory, and the row for each set of channels."""

    n: Whole  # number of all channels
    takes_any: Flag  # the first row serves all sets of channels
    period: Whole  # of samples without stamps, ns
    clock: Whole  # stamp of the next sample without one, ns
    judge: Whole  # address of the method's function
    constants: Whole  # address of the first row
    constants_size: Whole  # bytes of a row
    states: Whole  # address of the first row
    states_size: Whole  # bytes of a row
    rows: Whole  # rows in use
    # row for each set of present channels, by its mask
    row: Annotated[NDArray[np.int64], "i8", (1 << MAX_CHANNELS,)]
    judged: SampleVerdict


class Condition(IntEnum):
    """Defect of a single value. The larger number wins."""

    FINE = 0
    MISSING = 1
    NON_FINITE = 2
    OUT_OF_RANGE = 3
    FROZEN = 4
    SILENT = 5
    NON_FINITE_LASTING = 6


@record
class NoisySpell:
    """A time in which a channel was noisy, with breaks below `NOISY_BREAK`."""

    since: Stamps  # first noisy sample, ns; 0: there was none
    until: Stamps  # last noisy sample so far, ns
    samples: Counts  # noisy samples
    times: Channels  # their mean noise, over the noise expected


@record
class Health:
    """Memory of the checks of single channels, and their result in this sample."""

    begun: Whole  # samples so far
    stamp: Whole  # of the last sample, ns
    value: Channels  # last finite value delivered, rad/s, NaN before the first
    run_stamp: Stamps  # when that value first came, ns
    received_stamp: Stamps  # of the last sample that the channel delivered, ns
    limit: Channels  # size from which on a value is out of range, rad/s
    extreme: Channels  # largest size of a value so far, rad/s
    repeats: Counts  # number of times the last value has come in a row
    ended: Counts  # the same of the value before
    run_length: Channels  # usual number of equal values in a row
    bad_stamp: Stamps  # start of the present run of non-finite values, ns, or `NOT_BAD`
    condition: Flags  # `Condition` in this sample
    # samples in each condition
    counts: Annotated[NDArray[np.int64], "i8", (len(Condition), MAX_CHANNELS)]
    samples: Counts  # samples delivered
    # samples with a finite value in which the others could have shown a fault
    checked: Counts
    stuck: Counts  # samples that repeated a value against the motion of the others
    noisy: Counts  # samples in which the channel was much noisier than the other units
    # recent noise relative to noise_std, slow to follow increases
    usual_noise: Channels
    last_noisy: NoisySpell
    longest_noisy: NoisySpell
    gone: Channels  # share of non-finite values among the recent ones
    absent: Channels  # share of recent samples without a value
    lapses: Channels  # recent number of samples without a value after one with a value
    complete_stamp: Stamps  # since when nearly every sample has a value, ns
    complete: Mask  # channels with a value in nearly every sample for long
    returning: Counts  # values still left out of the rate after a non-finite one
    leaves: Channels  # recent number of non-finite values after a finite one
    # smallest change of the value so far, rad/s, 0 before any: the step of a quantised
    # sensor
    step: Channels


@record
class BufferedSample:
    """One aligned sample."""

    stamp: Whole  # ns
    values: Channels  # rad/s
    received: Mask
    plain: Mask  # finite and in range


@record
class DelayBuffer:
    """The last samples."""

    count: Whole
    step: Whole  # usual, ns
    rows: Annotated[list[BufferedSample], RESTAMP_SAMPLES]


@record
class Copies:
    """Units that deliver the values of another unit."""

    stamp: Whole  # of the last comparison, ns
    # number of comparisons in which two units agreed
    hits: Annotated[NDArray[np.int64], "i8", (MAX_UNITS, MAX_UNITS)]
    # number, from 1, of the unit that each unit repeats, or 0
    original: Annotated[NDArray[np.int64], "i8", (MAX_UNITS,)]
    channels: Mask  # of the units that repeat another unit
    found: Flag  # found in the last sample: earlier declarations may rest on it
    # During a comparison of two units: changes of the channels of both, rad/s, and sums
    # of products of the changes, (rad/s)^2
    change: Annotated[NDArray[np.float64], "f8", (6,)]
    products: Annotated[NDArray[np.float64], "f8", (6, 6)]


@record
class ValueGroup:
    """Consecutive values of one channel, averaged as one."""

    count: Whole
    total: Real  # rad/s
    squares: Real  # (rad/s)^2
    low: Real  # rad/s
    high: Real  # rad/s


@record
class Portion:
    """Groups of each channel that ended in one portion of the averaging time."""

    count: Counts  # groups
    total: Channels  # of their means, rad/s
    squares: Channels  # of their mean squares about their means, (rad/s)^2


@record
class Bias:
    """Bias of each channel, and the average in progress."""

    given: Flag  # by the settings
    value: Channels  # subtracted from each channel, rad/s
    # channels with a valid bias; the others were silent or restless
    channels_known: Mask
    duration: Whole  # of the average, ns
    centre: Channels  # expected average, rad/s
    max_rate: Real  # mean at rest, rad/s
    max_std: Channels  # at rest, rad/s
    turn_ratio: Channels  # largest C / s^2 at rest of k channels, at k - 1
    # largest C / P of the portions' deviations at rest of k channels, at k - 1
    sway_ratio: Channels
    learning: Flag
    started: Flag  # an average has begun
    start: Whole  # stamp of its first sample, ns
    rows: Whole  # samples in it
    count: Counts  # values of each channel
    groups: Annotated[list[ValueGroup], MAX_CHANNELS]  # of each channel, not ended
    portions: Annotated[list[Portion], BIAS_PORTIONS]
    outcome: Small  # source of the bias, or reason why the last average was refused
    average: Channels  # of the last average, rad/s
    scatter: Channels  # of the last average, rad/s
    heard: Mask  # channels that gave enough values in the last average
    restless: Mask  # heard channels that were not at rest
    common_rate: Real  # rate on which the averages agree, rad/s
    max_common_rate: Real  # largest at rest, with the biases found, rad/s
    sway: Real  # deviation of the portions explained by a rate, per channel, rad/s
    max_sway: Real  # largest at rest, rad/s
    # While an average is concluded: values being sorted; values being split into a rate
    # and the rest, rad/s; that rate, rad/s; sum of the means of the portions used, rad/s
    ordered: Annotated[NDArray[np.float64], "f8", (BIAS_PORTIONS,)]
    part: Channels
    turn: Vector
    middle: Channels


@record
class Subset:
    """Weighted least squares over one set of channels. Zero for channels outside the set."""

    gain: Axes  # row i: share of channel i in the rate, weights 1 / noise_std^2
    sensitivity: Channels  # share of a channel's own error in its residual, 0 to 1
    spans: Flag  # the channels span space
    spare: Flag  # the geometry suffices to leave the others out on mere suspicion
    refused: Flag  # enough channels, but the method cannot run on them
    detectable: Mask  # channels whose fault the method detects
    has_level: Flag  # level, limit and share are calculated
    # protection level of each body axis if all errors have noise_std, rad/s
    level: Vector
    limit: Channels  # largest residual that then passes the separation test, rad/s
    # row i: largest weight of channel i's variance in the level of each axis
    share: Axes


@record
class TimedRate:
    """A body rate and its time."""

    stamp: Whole  # ns
    rate: Vector  # rad/s, or NaN


@record
class Acceleration:
    """Rates of the last samples.

    The acceleration is the difference between the present rate and the rate of the
    latest sample with a rate that is older by at least `window`. Over one sample at
    1 kHz the step of a fault would give such a large acceleration that the timing term
    would hide the fault.
    """

    window: Whole  # ns
    count: Whole  # samples so far
    oldest: Whole  # number of the sample at the start of the difference
    # by number of the sample, modulo `ACCELERATION_SAMPLES`
    history: Annotated[list[TimedRate], ACCELERATION_SAMPLES]
    last_rate: TimedRate  # last rate up to the oldest sample
    has_last_rate: Whole  # 1 if `last_rate` is valid
    value: Vector  # rad/s^2, zero if unknown


@record
class Turning:
    """Rotation of the body without the noise of single samples, for lever arms."""

    stamp: Whole  # of the last sample, ns
    rate: Vector  # fused rate through a low pass of the first order, rad/s
    acceleration: Vector  # its derivative, rad/s^2
    newest: Vector  # fused rate of the last sample that had one, rad/s
    usable: Vector  # fused rate of this sample, NaN if not sure enough, rad/s
    unsmoothed: Acceleration  # of the rates above
    known: Flag  # rate and angular acceleration of this sample are known
    part: Channels  # what it adds to each accelerometer, in the unit of the path
    hidden: Mask  # accelerometers that it moves by an unknown amount


@record
class Parity:
    """Information A and gain G, and working memory for both."""

    information: Square  # A, s^2/rad^2, first used as working memory
    gain: Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]  # G
    weight: Square  # W = M^-1, s^2/rad^2
    place: Counts  # present channels, in order
    weighted: Axes  # W H, s^2/rad^2, also used as working memory
    normal: Matrix
    inverse: Matrix


@record
class Evidence:
    """Input of the decision from one sample."""

    stamp: Whole  # ns
    # suspects of the verdict, or, if accumulated evidence decides, stuck channels
    suspected: Mask
    outliers: Mask  # channels too far off to be used now, without a declaration
    isolated: Mask  # suspects each of which is faulty
    certain: Mask  # channels that are faulty by accumulated evidence
    undecided: Mask  # a set that contains a faulty one, by accumulated evidence
    drifted: Mask  # channels whose bias is certainly beyond `max_drift`
    judged: Flag  # the method gave a verdict
    no_votes: Flag  # an alarm is suspicion only and counts towards no declaration
    interrupted: Flag  # a hole in the stream precedes this sample
    checked: Mask  # channels whose fault would have shown
    unclear: Mask  # members of the set that have not agreed with others
    agrees: Mask  # channels that agree with the others, used for declared ones
    broken: Mask  # channels with only non-finite values for long
    flickers: Mask  # channels whose values seem to come and go
    intermittent: Mask  # channels whose values certainly come and go
    repeats: Mask  # channels that have repeated one value for long
    # channel less the rate of the channels in use, along its axis, rad/s
    error: Channels


@record
class Decision:
    """Declarations, and the alarms of the last window."""

    faulty: Mask  # declared faulty
    ambiguous: Mask  # a set that contains a faulty channel
    voted: Mask  # part of the set declared by votes
    why: Flags  # reason for the declaration of each channel
    at: Whole  # index of the last sample in the window
    # channels of each sample of the window, by kind of evidence
    sets: Annotated[NDArray[np.int64], "i8", (4, DECISION_SAMPLES)]
    # samples of the window whose set contains a channel, by kind of evidence
    count: Annotated[NDArray[np.int64], "i8", (4, MAX_CHANNELS)]
    alarms: Whole  # samples of the window with an alarm that counts
    last_bad: Stamps  # last disagreement or unusable sample of a declared channel, ns
    renewed: Stamps  # start of the present sum of its errors, ns
    error_sum: Channels  # of its errors since then, rad/s
    error_count: Counts  # of its samples since then
    earlier_sum: Channels  # of its errors in the previous clean time, rad/s
    earlier_count: Counts  # of its samples in the previous clean time
    # last sample with an alarm, without a verdict, or with unclear members, ns
    last_doubt: Whole
    suspicion: Mask  # named by an alarm in the window


@record
class OutputRow:
    """Results of one sample."""

    stamp: Whole  # ns
    instant: Whole  # of the rate, ns: before the stamp if units are late
    rate: Vector  # fused body rate, rad/s, or NaN
    covariance: Symmetric  # of the fused rate, (rad/s)^2, or NaN
    valid: Flag  # a fused rate exists
    alarm: Flag  # of the detector, before confirmation
    state: Flags  # `ChannelState` after the sample
    statistic: Real  # of the detector, NaN if the sample could not be judged
    threshold: Real  # of the detector, NaN if the sample could not be judged
    # bias-free channel less the fused rate along its axis, rad/s, NaN if either is
    # missing
    residual: Channels
    level: Vector  # protection level of the fused rate, rad/s, infinite if unknown


@record
class EventRow:
    """One change of state of one channel."""

    row: Whole  # of the sample in its block
    stamp: Whole  # ns
    channel: Whole  # among all channels of the monitor, gyros first
    before: Small  # `ChannelState`
    after: Small  # `ChannelState`
    reason: Small  # place in `REASONS`
    group: Mask  # the channel, or if AMBIGUOUS the set that contains the faulty one
    # estimated error in the unit of the quantity, 0 unless the reason is disagreement
    # or drift
    error: Real


@record
class PathSettings:
    """Settings, constant over samples. A change of the detector changes some."""

    n: Whole  # channels
    first: Whole  # number of the first channel among all channels of the monitor
    # size in the unit of the quantity that corresponds to 1 rad/s: values are divided
    # by it on entry
    natural: Real
    places: Counts  # index of each accelerometer in a sample
    arms: Axes  # position of each accelerometer from the first unit, m
    # of each accelerometer's position along one axis, m over the natural size
    position_std: Channels
    sensors: Sensors
    largest_noise: Real  # noise_std of the noisiest channel, rad/s
    units: Whole
    members: Annotated[NDArray[np.int64], "i8", (MAX_UNITS,)]  # mask of each unit
    # Checks of single channels:
    max_rate: Channels  # rad/s
    non_finite_time: Whole  # ns
    stuck_time: Whole  # ns, 0: no check
    frozen_time: Whole  # ns, 0: no check
    stale_time: Whole  # ns
    recovery_time: Whole  # ns
    # Declaration and recovery:
    # an alarm is accumulated evidence and declares at once; votes are for stuck
    # channels only
    by_evidence: Flag
    alarms: Whole  # number that confirms a fault
    window: Whole  # samples in which alarms are counted
    latch: Flag
    clean_time: Whole  # ns
    mean_limit: Channels  # largest mean error of a channel that recovers, rad/s
    return_limit: Real  # largest difference of a channel that recovers, in its std
    period: Real  # of the samples, s
    # Estimate and fusion:
    publish_under_doubt: Flag  # fuse doubted channels that cannot be left out
    guard_declares: Flag  # alarms of the estimator's own detector declare
    max_drift: Real  # a larger bias is a fault, rad/s, 0: no limit
    risk: Real  # allowed probability of an error above the level, 0: no level
    reach: Real  # standard deviations that correspond to the risk
    prior: Channels  # odds that a channel has an unnoticed fault
    turn_on_std: Real  # standard deviation of a bias that was not learned, rad/s
    learned: Channels  # standard deviation of a bias averaged at the start, rad/s


@record
class Current:
    """Figures of the present sample.

    `waiting` stands between two calls of `step` with the same sample.
    """

    repeated: Mask  # channels of units that repeat old values in this sample
    all_repeat: Flag  # all channels repeat their values
    noisy: Mask  # much noisier than expected or usual, and than the other units
    waiting: Flag  # `prepare_sample` is done, and the detector follows
    learned_from: Flag  # the sample served only to learn the bias
    aligned: Channels  # values at the instant of the sample, rad/s
    # values less the errors estimated at the last sample, or by the estimator now, rad/s
    corrected: Channels
    input: Channels  # values of all channels for the detector, rad/s
    plain: Mask  # delivered and in range
    in_use: Mask  # plain and in use
    usable: Mask  # in use and without a defect of their own
    doubtful: Mask  # channels suspected or in a set, in this sample or just before
    fused: Mask  # channels in the fused rate
    withheld: Flag  # the only possible rate would contain doubted channels
    rate: Vector  # least-squares rate of the channels in use, rad/s
    along: Channels  # that rate along each axis, rad/s
    others_rate: Vector  # rate by which `update_stuck` measures motion, rad/s
    # sum of squared residuals of the other channels, for each channel, (rad/s)^2
    disagreement: Channels
    course: Channels  # that the last two values of each lead to, rad/s, or NaN
    doubt: Vector  # an error of the rate whose square is added to its covariance, rad/s
    shared_error: Axes  # C G', covariance of channel errors with the rate, (rad/s)^2
    moved: Channels  # change of each channel since another one repeats its value, rad/s
    variance: Channels  # of noise and other errors of single samples, (rad/s)^2
    uncertainty: (
        Channels  # `variance` plus the variance of the estimated errors, (rad/s)^2
    )
    own: Channels  # the same without what all channels share: what weights reduce
    parity: Parity
    rival: Channels  # A z of channels fused and left out, s/rad
    gain: Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]  # of the fused rate
    tested: Channels  # residuals of the rate with expected weights, rad/s
    common: Symmetric  # covariance of the rate from the estimated errors, (rad/s)^2
    lagging: Vector  # change of the rate up to the stated instant, rad/s
    plain_rate: Vector  # of the fused channels with expected weights, rad/s
    error_ratio: Channels  # error variance with the remaining bias, in noise_std^2
    uncovered: Vector  # level without the rivals of the declared channels, rad/s
    covered: Vector  # largest level with the rivals of one channel, rad/s
    guard: SampleVerdict  # of the estimator's own detector
    verdict: SampleVerdict  # of the method that declares
    scaled: Channels  # corrected values, residuals scaled to the expected noise, rad/s
    asked: SampleInput  # corrected values for another method that declares
    evidence: Evidence


@record
class Core:
    """Settings and memory of one monitor, except detector, table of sets and inputs."""

    settings: PathSettings
    health: Health
    bias: Bias
    delay_buffer: DelayBuffer
    copies: Copies
    sample: SampleInput  # input of the estimator and its detector, with the estimate
    # rate at the last new value of each unit, rad/s
    unit_rate: Annotated[NDArray[np.float64], "f8", (MAX_UNITS, 3)]
    correction: Channels  # last estimated error, subtracted from each channel, rad/s
    remaining: Channels  # standard deviation of unknown errors by the residuals, rad/s
    acceleration: Acceleration
    turning: Turning
    decision: Decision
    excluded: Mask  # taken out by the operator
    # other channels that measured when the present value of each channel first came
    witnesses: Counts
    # values of all channels at that time, rad/s
    reference_input: Square
    before: Channels  # corrected values of the last sample, rad/s
    earlier: Channels  # and of the one before it
    leapt: Mask  # left out of the rate since a jump away from it
    # largest deviation from the others of a channel since it contradicts them or is in
    # doubt, rad/s
    deviation: Channels
    saturated: Flag  # a manoeuvre has driven a channel out of range
    saturated_stamp: Whole  # last sample with a saturated channel, ns
    samples: Whole  # so far
    last_stamp: Whole  # of the last sample, ns
    state: Flags  # `ChannelState` after the last sample
    reason: Flags  # of each state, place in `REASONS`
    since: Stamps  # start of the present state, ns
    group: Mask  # set that contains a faulty channel, after the last sample
    error: Channels  # estimated error at the start of the present state, rad/s
    wanted: Mask  # fused channels whose protection level must be calculated, or 0
    # by how much each declared channel, and the set, raised the level of each axis when
    # its values last came, rad/s
    raised: Annotated[NDArray[np.float64], "f8", (MAX_CHANNELS + 1, 3)]
    last: OutputRow
    now: Current
    given: Sample  # the present sample, with values in the unit of the path
    half: Whole  # half of the monitor that takes the sample: 0 gyros, 1 accelerometers


@record
class Live:
    """Memory of a live monitor in addition to `Core`."""

    fused_at: Whole  # offset of the rate in the fused message, bytes
    integrity_at: Whole  # offset of the values in the integrity message, bytes
    channels: Whole  # gyros of all inputs
    accelerometers: Whole  # values of a message of accelerometers
    force: Channels  # last such values, m/s^2
    has_force: Flag  # they arrived after the last sample
    ready: Flag  # a sample is ready for the pipeline
    sample: Sample
    events: Whole  # of the last sample
    shift: Whole  # stamp of the last sample less its message's, ns
    without_rate: Whole  # samples
    last_stamp: Whole  # of the last array, ns
    clock_shift: Whole  # added to the stamps of arrays, ns
    restarts: Whole  # number of times that the clock was set back
    inlets: Annotated[list[Inlet], MAX_UNITS]
