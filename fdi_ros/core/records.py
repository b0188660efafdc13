# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Every record of the sample path, in the order of a sample; `Core` is what one monitor has and remembers.

Settings are in `PathSettings`, figures of the present sample alone in `Current`. Most
of the rest is memory. Methods have records of their own.
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

MAX_PENDING = 1024  # messages of one unit that wait at most
RING = (
    MAX_PENDING + 2
)  # messages kept of one unit: those that wait, one too many, and the one before them
# kept to bring all units to the instant of the one that is late most: 60 ms at 16 kHz
RESTAMP_SAMPLES = 1024
BIAS_PORTIONS = 15  # into which the time of the average at the start is divided
# that the window of the angular acceleration spans; of a longer one the last count
ACCELERATION_SAMPLES = 1024
DECISION_SAMPLES = 1000  # samples in the longest window of the votes
Matrix = Annotated[NDArray[np.float64], "f8", (3, 3)]


@record
class Inlet:
    """What was counted of one input topic."""

    received: Whole  # messages
    malformed: Whole  # messages
    error: Whole  # why the last malformed one was refused
    stamp: Whole  # of the last good message, ns; `NEVER` where there was none
    lag: Whole  # least lag behind the other inputs since `NEVER` was written here, ns


@record
class Counters:
    """What one unit has delivered; messages, but for the last two, which count samples."""

    received: Whole
    duplicate: Whole  # the stamp of the message before, again
    backward: Whole  # an older stamp than the message before
    ahead: Whole  # a stamp ahead of the clock
    jumped: Whole  # a stamp ahead of the common time by more than the timeout
    late: Whole  # a stamp that the samples had already gone past
    interpolated: Whole
    missing: Whole


@record
class Accepted:
    """A message that was accepted."""

    stamp: Whole  # ns
    rate: Vector  # rad/s
    force: Vector  # specific force, m/s^2; all NaN: the message has none
    step: Whole  # since the message before, ns
    bridges: Flag  # the span since the message before may be interpolated


@record
class Unit:
    """One stream of messages: the last one that samples have passed, and those that wait.

    Messages are numbered from 0 in each time base. Message k lies at k % `RING`.
    """

    begin: Whole  # number of the first that waits; the one before it is the last passed
    end: Whole  # number of the next
    used: Whole  # number after the last that entered a sample as it is
    usual: Annotated[NDArray[np.int64], "i8", (2,)]  # the last two steps, ns
    newest: Whole  # stamp of the last accepted message, ns, if any
    lag: Whole  # how far the last stood behind the common time, ns
    heard: Flag  # there was a message
    before: Whole  # stamp of the last message, accepted or not, ns
    passed: Annotated[
        NDArray[np.int64], "i8", (MAX_UNITS,)
    ]  # by each other unit since the last accepted, ns
    delay: Whole  # by how much its stamps are late, ns; taken off every one
    leapt: Flag  # its stamps jumped back by more than the timeout, and none was accepted since
    parted: Flag  # without a jump it has fallen behind the common time by more than the timeout
    off: Flag  # the last messages stood outside the time base
    off_first: Whole  # first stamp of the present run outside the time base, ns
    off_last: Whole  # last stamp of the run, ns
    off_rate: Vector  # rad/s
    off_force: Vector  # m/s^2
    counters: Counters
    messages: Annotated[list[Accepted], RING]


@record
class Aligner:
    """What alignment remembers; stamps as in the messages, less the delay of their unit, without the shift."""

    n: Whole  # units
    max_skew: Whole  # ns
    timeout: Whole  # ns
    bridge: Whole  # longest span that is interpolated, ns
    begun: Flag  # a message was accepted
    common: Whole  # newest stamp that two units have reached, or the only ones that deliver, ns
    formed: Flag  # a sample was formed in this time base
    last: Whole  # stamp of the last sample, ns
    shift: Whole  # added to the stamps of the samples, ns; 0 until all clocks were set back
    restarts: Whole  # times that the time base began anew
    # _IDLE: nothing to be formed before the next message; _RESTARTING: the time base
    # moves after it
    phase: Whole
    force: Whole  # samples up to this stamp are formed without waiting, ns
    moved_to: Whole  # stamp outside the time base where it begins anew, ns
    rate: Vector  # of the message that is entered, rad/s
    felt: Vector  # its specific force, m/s^2; all NaN: it has none
    units: Annotated[list[Unit], MAX_UNITS]


@record
class Sample:
    """One sample of all units, three channels each."""

    stamp: Whole  # ns
    shift: Whole  # stamp minus that of the message, ns
    z: Channels  # rad/s, NaN where nothing was received
    received: Flags
    force: Channels  # of the accelerometers, m/s^2, NaN where nothing was received
    felt: Flags  # `received` of the accelerometers


@record
class Sensors:
    """Error model of the channels of one set, in order, without gaps."""

    n: Whole  # channels
    axes: Axes  # sensitivity axes in the body frame
    noise_std: Channels  # rad/s
    scale_std: Channels  # 1
    timing_std: Channels  # s
    constant: Flag  # the variance depends on neither rate nor acceleration
    gain: Axes  # row i: share of channel i in the least-squares rate, weights all equal
    share: Channels  # S_ii: what of a channel's own error stays in its residual
    detectable: Flags  # a fault of the channel reaches the parity vector
    alike: Annotated[
        NDArray[np.uint8], "u1", (MAX_CHANNELS, MAX_CHANNELS)
    ]  # channels that cannot be told apart


@record
class Estimate:
    """What the estimator knows of the errors of the sensors in a sample."""

    known: Flag  # the rest is of this sample
    checked: Mask  # channels whose uncertainty hides no fault
    corrected: Channels  # values less their estimated errors, rad/s
    variance: Channels  # of their noise at the moment, (rad/s)^2
    covariance: Square  # of the estimated errors, (rad/s)^2
    # largest variance of a residual over the one expected, at least 1; only where it is
    # asked for
    excess: Real
    bias: Channels  # of each, beyond the one at the start, rad/s
    bias_std: Channels  # standard deviation of that, rad/s
    # by how much the stamps of each unit are surely late, s: `restamp` makes up for it
    late: Units
    behind: Real  # by how much the values lie before the stamp, if the earliest unit is in time, s
    spread: Real  # largest delay between units, s
    spikes: Counts  # of each channel so far: a few values far off, left out of the rate


@record
class SampleInput:
    """A sample of one set of channels: values in order, without gaps.

    Of a method that takes any set of channels: of all channels, those in ``mask`` are
    there. Other masks and `bias_std` are of all channels that there are.
    """

    stamp: Whole  # ns
    z: Channels  # rad/s
    mask: Mask
    out: Mask  # channels taken out of use, which may be there all the same
    beyond: Mask  # channels out of range, or unfit for use in this sample by themselves
    acceleration: Vector  # body angular acceleration, rad/s^2
    bias_std: Channels  # standard deviation of each channel's bias at first, rad/s
    interrupted: Flag  # a hole in the stream precedes this sample
    held: Flag  # a manoeuvre has just driven a channel out of range: evidence is void
    # a unit gives old values against the motion of the others: no evidence is taken
    repeated: Flag
    wants_excess: Flag  # another method is to judge the corrected values
    # filled by the method, if it estimates the errors of the sensors; until the next
    # one it stands
    estimate: Estimate


@record
class SampleVerdict:
    """Verdict of a method on one sample; channels as in `SampleInput`."""

    statistic: Real
    threshold: Real  # alarm where the statistic reaches it
    alarm: Flag
    isolated: Flag  # every suspect is faulty
    suspects: Flags
    error: Channels  # estimated error of each suspect, rad/s; 0 elsewhere
    scores: Channels  # the method's own figure per channel; NaN for one not judged
    outliers: Flags  # too far off to be used in this sample, which is no alarm
    noise: Channels  # lately, over noise_std, by a method that measures it; 0: not measured


@record
class Bank:
    """Where the constants and the memory of a method lie, and which row serves which channels."""

    n: Whole  # channels of all
    takes_any: Flag  # the first row serves all sets of channels
    period: Whole  # of samples without stamps, ns
    clock: Whole  # stamp of the next sample without one, ns
    judge: Whole  # address of the method's function
    constants: Whole  # address of the first row
    constants_size: Whole  # bytes of a row
    states: Whole  # address of the first row
    states_size: Whole  # bytes of a row
    rows: Whole  # rows in use
    row: Annotated[
        NDArray[np.int64], "i8", (1 << MAX_CHANNELS,)
    ]  # by the bits of the channels present
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
class Health:
    """What the checks remember of the samples before, and how each channel fares in this one."""

    begun: Whole  # samples so far
    stamp: Whole  # of the last sample, ns
    value: Channels  # last finite value delivered, rad/s; NaN before the first
    run_stamp: Stamps  # when it was first seen, ns
    received_stamp: Stamps  # of the last sample that the channel delivered, ns
    limit: Channels  # values from here on are out of range, rad/s
    extreme: Channels  # largest size of a value so far, rad/s
    repeats: Counts  # how often the last value has come in a row
    bad_stamp: Stamps  # start of the present run of non-finite values, ns, or `NOT_BAD`
    condition: Flags  # `Condition` in this sample
    counts: Annotated[
        NDArray[np.int64], "i8", (len(Condition), MAX_CHANNELS)
    ]  # samples in each condition
    samples: Counts  # samples delivered
    stuck: Counts  # samples that repeated a value against the motion of the others
    noisy: Counts  # samples in which it was much noisier than the other units
    usual_noise: Channels  # over noise_std: of late, what is louder counting slowly
    gone: Channels  # share of the values lately received that are not finite
    absent: Channels  # share of the samples lately without a value
    lapses: Channels  # how often lately one without a value came after one with it
    complete_stamp: Stamps  # since when hardly a sample is without a value, ns
    complete: Mask  # channels that were so for long
    returning: Counts  # values that are still left out of the rate after one that is not finite
    leaves: Channels  # how often lately one that is not finite came after one that is
    # smallest change of the value so far, rad/s: the step of a quantised sensor; 0
    # before any
    step: Channels


@record
class BufferedSample:
    """One sample as it was aligned."""

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
    """Units that give the values of another one."""

    stamp: Whole  # of the last comparison, ns
    hits: Annotated[
        NDArray[np.int64], "i8", (MAX_UNITS, MAX_UNITS)
    ]  # comparisons in which two units agreed
    original: Annotated[
        NDArray[np.int64], "i8", (MAX_UNITS,)
    ]  # number from 1 of the unit that each repeats; 0: none
    channels: Mask  # of the units that repeat another one
    found: Flag  # in the last sample: all that was declared may rest on it
    # While two are compared:
    change: Annotated[NDArray[np.float64], "f8", (6,)]  # of either's channels, rad/s
    products: Annotated[
        NDArray[np.float64], "f8", (6, 6)
    ]  # sums of products of the changes, (rad/s)^2


@record
class ValueGroup:
    """Values of one channel that are taken together."""

    count: Whole
    total: Real  # rad/s
    squares: Real  # (rad/s)^2
    low: Real  # rad/s
    high: Real  # rad/s


@record
class Portion:
    """Groups of each channel that ended in one portion of the time."""

    count: Counts  # groups
    total: Channels  # of their means, rad/s
    squares: Channels  # of their mean squares about their means, (rad/s)^2


@record
class Bias:
    """Bias of each channel, and the average that is being taken."""

    given: Flag  # by the settings
    value: Channels  # subtracted from each channel, rad/s
    # channels of which it is valid: the others were lost, silent or restless at that
    # time
    known: Mask
    duration: Whole  # of the average, ns
    centre: Channels  # what each average is expected about, rad/s
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
    outcome: Small  # where the bias comes from; or why the last average was refused
    average: Channels  # of the last average, rad/s
    scatter: Channels  # of the last average, rad/s
    heard: Mask  # channels that gave enough values in the last average
    restless: Mask  # heard channels that were not at rest
    common_rate: Real  # that the averages agree on, rad/s
    max_common_rate: Real  # at rest, with biases as those seemed to be, rad/s
    sway: Real  # of the portions, in the part that a rate explains, a channel, rad/s
    max_sway: Real  # at rest, rad/s
    # While an average is concluded:
    ordered: Annotated[
        NDArray[np.float64], "f8", (BIAS_PORTIONS,)
    ]  # values being sorted
    part: Channels  # values to be split into what a rate explains and the rest, rad/s
    turn: Vector  # the rate that explains them, rad/s
    middle: Channels  # sum of the means of the portions used, rad/s


@record
class Subset:
    """Weighted least squares over one set of channels; zero for the others."""

    gain: Axes  # row i: share of channel i in the rate, weights 1 / noise_std^2
    sensitivity: Channels  # what of a channel's own error stays in its residual, 0 to 1
    spans: Flag  # the channels span space
    spare: Flag  # well enough to leave the others out for a mere suspicion
    refused: Flag  # enough channels, and the method cannot run on them
    detectable: Mask  # channels whose fault the method sees
    has_level: Flag  # level and limit were worked out
    # protection level of each body axis while all errors are as noise_std says, rad/s
    level: Vector
    limit: Channels  # largest residual that passes the separation test then, rad/s
    share: Axes  # row i: weight of the variance of channel i in the level of each axis, at most


@record
class TimedRate:
    """A body rate and its time."""

    stamp: Whole  # ns
    rate: Vector  # rad/s; NaN where there was none


@record
class Acceleration:
    """Rates of the last samples.

    The acceleration is the difference of the rate to the latest sample at least
    `window` older that had one. Over one sample at 1 kHz a fault's own step would make
    so much of it that the timing term hides the fault.
    """

    window: Whole  # ns
    count: Whole  # samples so far
    oldest: Whole  # number of the sample that the difference is taken to
    history: Annotated[
        list[TimedRate], ACCELERATION_SAMPLES
    ]  # by number of the sample, modulo `ACCELERATION_SAMPLES`
    known: TimedRate  # last rate there was up to the oldest
    has_known: Whole  # 0: there was none yet
    value: Vector  # rad/s^2; zero where it is not known


@record
class Parity:
    """Information A and gain G, and the room to work them out."""

    information: Square  # A, s^2/rad^2; until then room
    gain: Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]  # G
    weight: Square  # W = M^-1, s^2/rad^2
    place: Counts  # channels that are there, in order
    weighted: Axes  # W H, s^2/rad^2; also room
    normal: Matrix
    inverse: Matrix


@record
class Evidence:
    """What the decision gets of one sample."""

    stamp: Whole  # ns
    suspected: (
        Mask  # suspects of the verdict; where evidence decides, channels that are stuck
    )
    outliers: Mask  # channels too far off to be used for now, which counts towards no declaration
    isolated: Flag  # every suspect is faulty
    certain: Mask  # channels that are faulty by accumulated evidence
    undecided: Mask  # a set that holds a faulty one, by accumulated evidence
    drifted: Mask  # channels whose bias is surely beyond what a bias may be
    judged: Flag  # there was a verdict
    held: Flag  # an alarm of this sample is a suspicion, but does not count towards a declaration
    interrupted: Flag  # a hole in the stream precedes this sample
    checked: Mask  # channels whose fault would have shown
    agrees: Mask  # channels that agree with the others; looked at for declared ones
    broken: Mask  # channels that have given nothing but non-finite values for long
    flickers: Mask  # channels whose values seem to come and go
    intermittent: Mask  # channels of which that is certain
    repeats: Mask  # channels that have repeated one value for long
    error: Channels  # each channel minus the rate of the channels in use along its axis, rad/s


@record
class Decision:
    """Declarations, and the alarms of the last window."""

    faulty: Mask  # declared faulty
    ambiguous: Mask  # a set one of which is faulty
    voted: Mask  # part of the set declared by votes
    why: Flags  # why each channel was declared
    at: Whole  # place of the last sample in the window
    sets: Annotated[
        NDArray[np.int64], "i8", (4, DECISION_SAMPLES)
    ]  # of each sample of the window, by kind
    count: Annotated[
        NDArray[np.int64], "i8", (4, MAX_CHANNELS)
    ]  # samples of the window whose set holds a channel, by kind
    alarms: Whole  # samples of the window with an alarm that counts
    last_bad: Stamps  # last sample at which a declared channel still disagreed or was unusable, ns
    renewed: Stamps  # when the sum of its errors was begun, ns
    error_sum: Channels  # of its errors since then, rad/s
    error_count: Counts  # of its samples since then
    earlier_sum: Channels  # of its errors in the clean time before that, rad/s
    earlier_count: Counts
    last_doubt: Whole  # last sample with an alarm, or that could not be judged, ns
    suspicion: Mask  # named by an alarm in the window


@record
class OutputRow:
    """Results of one sample."""

    stamp: Whole  # ns
    instant: Whole  # that the rate is of, ns: before the stamp, where units are late
    rate: Vector  # fused body rate, rad/s; NaN without one
    covariance: Symmetric  # of the fused rate, (rad/s)^2; NaN without one
    valid: Flag  # a fused rate exists
    alarm: Flag  # the detector's, before confirmation
    state: Flags  # `ChannelState` after the sample
    statistic: Real  # the detector's; NaN where the sample could not be judged
    threshold: Real  # the detector's; NaN where the sample could not be judged
    # bias-free channel minus fused rate along its axis, rad/s; NaN where either is
    # missing
    residual: Channels
    level: Vector  # protection level of the fused rate, rad/s; infinite where unknown


@record
class EventRow:
    """One change of state of one channel."""

    row: Whole  # of the sample in its block
    stamp: Whole  # ns
    channel: Whole  # among all channels of the monitor, gyros first
    before: Small  # `ChannelState`
    after: Small  # `ChannelState`
    reason: Small  # place in `REASONS`
    group: Mask  # AMBIGUOUS: the channels one of which is faulty; otherwise the channel alone
    # estimated error in the unit of the quantity; 0 where the reason is neither
    # disagreement nor drift
    error: Real


@record
class PathSettings:
    """Settings, which samples do not change. A change of the detector changes some."""

    n: Whole  # channels
    first: Whole  # number of the first of them among all channels of the monitor
    # what 1 rad/s stands for in the unit of the quantity: values are divided by it as
    # they enter
    natural: Real
    places: Counts  # of each accelerometer among those of a sample
    arms: Axes  # position of each accelerometer from the first unit, m
    lever: Flag  # any of them is not zero
    sensors: Sensors
    largest_noise: Real  # noise_std of the noisiest channel, rad/s
    units: Whole
    members: Annotated[
        NDArray[np.int64], "i8", (MAX_UNITS,)
    ]  # bits of the channels of each
    # Of the checks:
    max_rate: Channels  # rad/s
    non_finite_time: Whole  # ns
    stuck_time: Whole  # ns; 0: never stuck
    frozen_time: Whole  # ns; 0: never frozen
    stale_time: Whole  # ns
    recovery_time: Whole  # ns
    # When a fault is declared, and whether it is forgiven:
    # an alarm is accumulated evidence, and declares at once; votes count for stuck
    # channels only
    by_evidence: Flag
    alarms: Whole  # that confirm a fault
    window: Whole  # samples among which they count
    latch: Flag
    clean_time: Whole  # ns
    mean_limit: Channels  # largest mean error of a channel that returns, rad/s
    # largest difference of a channel that agrees again, in its standard deviations
    return_limit: Real
    period: Real  # of the samples, s
    # Of estimate and fusion:
    publish_under_doubt: (
        Flag  # a rate of channels under doubt, where they cannot be left out
    )
    # the alarms of the estimator's own detector declare, not those of another method
    guard_declares: Flag
    max_drift: Real  # a bias beyond it is a fault, rad/s; 0: none is
    risk: (
        Real  # allowed probability of an error above the level at a sample; 0: no level
    )
    reach: Real  # standard deviations that it stands for
    prior: Channels  # odds that a channel is faulty unnoticed
    turn_on: Real  # standard deviation of a bias that was not learned, rad/s
    learned: Channels  # of one averaged at the start, standard deviation, rad/s


@record
class Current:
    """Of the sample on its way; of an earlier one only whether it still waits for the detector."""

    repeated: Mask  # channels of units that give old values in this sample
    all_repeat: Flag  # all channels repeat their values
    noisy: Mask  # channels much noisier than expected, and than the others
    waiting: Flag  # `prepare_sample` is done, the detector is to follow
    learned_from: (
        Flag  # the bias was learned from the sample, and nothing else is done with it
    )
    aligned: Channels  # values of the instant that it stands for, rad/s
    # values less errors estimated at the last sample, after the estimator now, rad/s
    corrected: Channels
    input: Channels  # values of all channels as the detector takes them, rad/s
    plain: Mask  # delivered and in range
    in_use: Mask  # plain and in use
    usable: Mask  # in use and fine by themselves
    doubtful: Mask  # channels suspected, or of a set, in this sample or just before
    fused: Mask  # channels whose least-squares rate is given
    withheld: Flag  # there would be a rate, but of channels under doubt
    rate: Vector  # least-squares rate of the channels in use, rad/s
    along: Channels  # that rate along each axis, rad/s
    others_rate: (
        Vector  # of the channels by which motion is measured in `update_stuck`, rad/s
    )
    # sum of the squares by which the others of each channel disagree, (rad/s)^2
    disagreement: Channels
    doubt: Vector  # an error of the rate whose square is added to its covariance, rad/s
    shared_error: (
        Axes  # C G', covariance of each channel's error with the rate's, (rad/s)^2
    )
    prediction: (
        Channels  # of each channel by the others, rad/s; NaN where they give none
    )
    variance: (
        Channels  # of noise and what else differs from sample to sample, (rad/s)^2
    )
    uncertainty: (
        Channels  # `variance` plus the variance of the estimated errors, (rad/s)^2
    )
    parity: Parity
    rival: Channels  # A z of channels fused and left out, s/rad
    gain: Annotated[NDArray[np.float64], "f8", (3, MAX_CHANNELS)]  # of the fused rate
    tested: Channels  # differences from the rate with weights as expected, rad/s
    common: Symmetric  # covariance of the rate by the errors of the sensors, (rad/s)^2
    lagging: Vector  # change of the rate up to the instant that is stated, rad/s
    plain_rate: Vector  # of the channels fused, with weights as expected, rad/s
    growth: Channels  # error variance with the remaining bias, in noise_std^2
    guard: SampleVerdict  # of the estimator's own detector
    verdict: SampleVerdict  # of the method that declares
    scaled: Channels  # corrected values with residuals in the noise expected, rad/s
    asked: SampleInput  # corrected values, where another method declares
    evidence: Evidence


@record
class Core:
    """What one monitor has beside its detector, its table of sets and its inputs."""

    settings: PathSettings
    health: Health
    bias: Bias
    line: DelayBuffer
    copies: Copies
    sample: SampleInput  # input of the estimator and its detector, with the estimate
    unit_rate: Annotated[
        NDArray[np.float64], "f8", (MAX_UNITS, 3)
    ]  # when each unit last gave a new value, rad/s
    correction: (
        Channels  # last estimated error of each channel, taken off its value, rad/s
    )
    # what residuals show of the unknown errors of each channel, standard deviation,
    # rad/s
    remaining: Channels
    acceleration: Acceleration
    decision: Decision
    excluded: Mask  # taken out by the operator
    # prediction of each channel by the others when its present value was first seen,
    # rad/s; or NaN
    reference: Channels
    witnesses: Counts  # channels that the reference of each is predicted from
    saturated: Flag  # a manoeuvre has driven a channel out of range
    saturated_stamp: Whole  # last sample of that, ns
    samples: Whole  # so far
    last_stamp: Whole  # of the last sample, ns
    state: Flags  # `ChannelState` after the last sample
    reason: Flags  # of each state, place in `REASONS`
    since: Stamps  # of the sample that brought the state, ns
    group: Mask  # after the last sample: the channels one of which is faulty
    error: Channels  # estimated error when the state came, rad/s
    wanted: (
        Mask  # channels fused whose protection level is still to be worked out; 0: none
    )
    last: OutputRow
    now: Current
    given: Sample  # the sample on its way, its values as the path takes them
    # half of the monitor that is to work the sample: 0 gyros, 1 accelerometers
    half: Whole


@record
class Live:
    """What a live monitor needs beside its record."""

    fused_at: Whole  # where the rate begins in the fused message
    integrity_at: Whole  # where the values begin in the integrity message
    channels: Whole  # of all inputs
    ready: Flag  # a sample is to be worked
    sample: Sample
    events: Whole  # of the last sample
    shift: Whole  # to be taken off the stamp of the last sample to have that of its message, ns
    without_rate: Whole  # samples
    last_stamp: Whole  # of the last array, ns
    clock_shift: (
        Whole  # added to the stamps of arrays, ns; 0 until the clock was set back
    )
    restarts: Whole  # times that it was
    inlets: Annotated[list[Inlet], MAX_UNITS]
