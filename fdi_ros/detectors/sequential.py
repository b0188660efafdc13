# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The flight detector: the path of a sample through the estimator, the sums, and the case that they open.

The estimator (`fdi_ros.estimator.estimator`) turns samples into innovations, which are
white with variance one while the model of the sensors holds. The sums
(`fdi_ros.detectors.sums`) accumulate evidence that they are not. A case
(`fdi_ros.detectors.case`) ends when its evidence is gone, or its channels are excluded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fdi_ros.compiling.compiled import callback, compiled
from fdi_ros.core.records import SampleInput, SampleVerdict
from fdi_ros.core.subsets import all_sets, mask_of
from fdi_ros.detectors.base import Detector
from fdi_ros.detectors.case import (
    State,
    fade_fits,
    follow_case,
    follow_moves,
    forget_evidence,
    forget_fits,
    goes_too_far,
    keep_information,
    look_for_case,
    look_for_change_in_hole,
    look_for_drift,
    undo_move,
    unfit_channels,
)
from fdi_ros.detectors.sums import (
    fill_scores,
    mean_of,
    update_from_block,
    update_from_sample,
)
from fdi_ros.errors import ConfigError
from fdi_ros.estimator.blocks import (
    judge_block,
    learn,
    predict_innovation_covariance,
    update_angular_acceleration,
    update_excess,
    update_fast_motion,
    update_incoherent,
)
from fdi_ros.estimator.delays import (
    learn_delays_of_gyros,
    transfer_delays,
    update_time_offsets,
)
from fdi_ros.estimator.displacement import close_turn, follow_displacement
from fdi_ros.estimator.error_states import (
    begin_states,
    fill_signals,
    predict,
    prepare_layout,
    project,
    shared_variance,
)
from fdi_ros.estimator.estimator import (
    BLOCK_TIME,
    BLOCKS_PER_COARSE,
    FEWEST_BLOCKS,
    LONG_TIME,
    SNAPSHOT_TIME,
    Constants,
    Estimator,
    add_sample,
    correct_sample,
    drop_block,
    follow_gaps,
    forget_motion,
    update_statistics,
    update_weights,
    watch_for_motion,
)
from fdi_ros.estimator.g_sensitivity import follow_force, renew_reference
from fdi_ros.estimator.noise import (
    MOTION,
    REST,
    THREE_SIGMA,
    begin_noise,
    change_regime,
    follow_loudness,
    update_largest_rate,
    update_sample_variance,
    update_unknown,
)
from fdi_ros.estimator.outliers import find_outliers, forget_doubt
from fdi_ros.estimator.rectification import follow_vibration
from fdi_ros.estimator.rest import REST_STD, update_rest
from fdi_ros.estimator.shared_noise import (
    begin_shared,
    update_line,
    update_shape,
    update_shared,
    update_shared_level,
)
from fdi_ros.estimator.snapshots import inflate_delays, keep_snapshot, pass_hole
from fdi_ros.estimator.start_bias import doubt_start
from fdi_ros.model.geometry import MIN_CHANNELS, MIN_SINGULAR_RATIO, Geometry
from fdi_ros.model.noise import FalseAlarmRate, NoiseModel
from fdi_ros.model.samples import MAX_RATE, Array

# shortest fault that is declared, s: two samples at 100 Hz, because one value decides nothing
LEAST_TIME = 0.02
LONGEST_HOLE = 5.0
"""Longest hole in the stream, s, that keeps the learned slow noise. After a longer one the
vehicle may move differently."""
LEAST_SCALE, LEAST_TIMING, LEAST_NONLINEARITY = 1e-3, 3e-4, 3e-4
"""Smallest believable standard deviations of any channel, even a calibrated one: scale
error, sampling instant in s, and nonlinearity."""
SAME_NAMES = (
    "confidence",
    "turn_on_std",
    "bias_move",
    "rectified",
    "largest_move",
    "gain_is_fault",
    "louder",
)
"""Options of `Sequential` that its constants have under the same name."""
# Largest ratio of statistic to threshold that is published while there is no alarm.
SHORT = 1.0 - 1e-9


@compiled
def begin(params: Constants, state: State, sample: SampleInput) -> None:
    """Start the states and the noise from their priors."""
    kf = state.estimator
    n = params.sensors.n
    state.begun = True
    if not state.restored:
        begin_states(params.layout, kf.states, sample.bias_std)
    begin_noise(kf.noise, n, params.expected)
    begin_shared(kf.shared, n, params.expected)
    fill_signals(params.layout, kf.zero, kf.angular_acceleration, kf.at.signals)
    project(params.layout, kf.states, kf.at)


@compiled
def pass_time(params: Constants, state: State, sample: SampleInput) -> float:
    """Advance the time to this sample and return the step, s; restart all evidence after a hole."""
    kf = state.estimator
    if not state.begun:
        begin(params, state, sample)
        state.stamp = sample.stamp
    seconds = 1e-9 * (sample.stamp - state.stamp)
    state.stamp = sample.stamp
    kf.seconds += seconds
    if sample.interrupted and kf.samples > 0:
        forget_motion(kf, params.sensors.n)
        forget_evidence(params, state)
        # In a hole biases walk farther than those from before a move allow for.
        state.case.references.count = 0
        pass_hole(params, kf, seconds)
        if seconds > LONGEST_HOLE:
            kf.noise.regime_seconds[REST] = kf.noise.regime_seconds[MOTION] = 0.0
            update_unknown(kf.noise, params.sensors.n, 0.0)
        kf.mask = 0
    return seconds


@compiled
def update_mask(params: Constants, state: State, sample: SampleInput) -> None:
    """Adopt the set of present channels, and end the case once its channels are excluded."""
    kf = state.estimator
    case = state.case
    blamed = case.isolated if case.isolated else case.suspects
    if case.open and blamed & ~sample.out == 0:
        forget_evidence(params, state)
        forget_fits(case, params.sensors.n, math.inf)
        kf.mask = 0
    for i in range(params.sensors.n):
        if sample.out >> i & 1 and kf.doubt[i] > 0.0:
            forget_doubt(kf, params.sensors.n)
    if sample.mask != kf.mask or sample.beyond != kf.beyond:
        kf.mask = sample.mask
        kf.beyond = sample.beyond
        update_weights(params, kf)
        if sample.wants_excess:
            update_excess(params, kf)


@compiled
def process_block(params: Constants, state: State, sample: SampleInput) -> None:
    """Process a complete block: noise, states, and evidence on the longer time scales."""
    kf = state.estimator
    case = state.case
    learns = not case.open
    fade_fits(case, params.sensors.n, kf.span if learns else 0.0)
    close_turn(params, kf)
    follow_block_noise(params, kf, learns)
    predict(params.layout, kf.states, kf.seconds - kf.learned_at)
    kf.learned_at = kf.seconds
    follow_reference(params, state)
    follow_moves(params, state)
    if kf.blocks < FEWEST_BLOCKS:
        return
    kf.unseen = False
    update_angular_acceleration(params, kf)
    weight = judge_block(params, kf)
    update_incoherent(params, kf)
    update_fast_motion(kf)
    if kf.judged:
        update_from_block(params, kf, state.scales, learns)
        keep_information(params, state)
    update_rest(params, kf)
    if kf.rest and kf.noise.regime == MOTION and learns:
        change_regime(kf.noise, params.sensors.n, REST, False)
    learn_from_block(params, state, weight)
    if learns:
        compensate_delays(params, state, sample)
    predict_innovation_covariance(params, kf)
    if sample.wants_excess:
        update_excess(params, kf)
    if kf.all_blocks % BLOCKS_PER_COARSE == 0:
        look_for_slow_faults(params, state)
        doubt_start(params, kf, not state.restored)


@compiled
def follow_block_noise(params: Constants, kf: Estimator, learns: bool) -> None:
    """Follow the noise of the channels, of its own and shared, with the values of a block."""
    noise = kf.noise
    n = params.sensors.n
    rate = kf.rates[0]
    update_largest_rate(noise, rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    follow_loudness(noise, n, params.louder, kf.span)
    update_unknown(noise, n, kf.span)
    update_sample_variance(
        noise,
        n,
        kf.masks[0],
        params.length,
        kf.all_blocks,
        params.adaptation_gain,
        params.expected,
        learns,
    )
    update_shared_level(params, kf)
    follow_vibration(params, kf)


@compiled
def learn_from_block(params: Constants, state: State, weight: float) -> None:
    """Correct the states by a block of this weight, unless a fault has been suspected for a short time."""
    kf = state.estimator
    learns = not state.case.open
    suspicious = mean_of(params, kf, state.scales) > math.sqrt(params.limit)
    kf.held_seconds = kf.held_seconds + kf.span if suspicious else 0.0
    if learns and not suspicious:
        # These channels belonged to a case that was refused.
        kf.under_test = 0
        update_line(params, kf)
    holds = learns and 0.0 < kf.held_seconds <= LONG_TIME
    # Without redundancy, errors show only at rest.
    if not holds and (kf.judged or kf.rest):
        learn(params, kf, weight)
    quiet = learns and not suspicious and kf.force_variance == 0.0
    if quiet and kf.seconds - kf.snapshot_at >= SNAPSHOT_TIME:
        kf.snapshot_at = kf.seconds
        keep_snapshot(params, kf)


@compiled
def follow_reference(params: Constants, state: State) -> None:
    """Let the biases belong to the specific force that lasts."""
    if renew_reference(params, state.estimator, not state.case.open):
        # The evidence so far belongs to other biases.
        forget_evidence(params, state)


@compiled
def compensate_delays(params: Constants, state: State, sample: SampleInput) -> None:
    """Learn delays of the gyros, and compensate well-known ones in the values to come, once a second."""
    kf = state.estimator
    if params.units > 1 and kf.seconds - kf.delays_checked_at > 1.0:
        kf.delays_checked_at = kf.seconds
        learn_delays_of_gyros(params, kf, sample)
        if transfer_delays(params, kf):
            # The evidence so far belongs to other sampling instants.
            forget_evidence(params, state)


@compiled
def look_for_slow_faults(params: Constants, state: State) -> None:
    """Look for slow faults, which show in the states but not in the sums."""
    kf = state.estimator
    case = state.case
    if kf.judged and not case.open and kf.samples >= case.retry:
        look_for_drift(params, state)
        look_for_change_in_hole(params, state)


@compiled
def forget_suspicion(params: Constants, state: State) -> None:
    """Drop all suspicion and restart the search.

    A clock that was set is not a lasting fault, so the delay of a unit that was declared
    as a whole is estimated again.
    """
    kf = state.estimator
    case = state.case
    inflate_delays(
        params, kf, state.declared | (case.isolated | case.suspects if case.open else 0)
    )
    state.cleared = False
    state.declared = 0
    forget_evidence(params, state)
    forget_fits(case, params.sensors.n, math.inf)
    forget_doubt(kf, params.sensors.n)
    forget_motion(kf, params.sensors.n)
    kf.mask = 0


@compiled
def is_blind(kf: Estimator) -> bool:
    """Whether the errors of a sample in motion are unknown, as shortly after a hole."""
    return kf.unseen and kf.noise.regime == MOTION


@compiled
def process_sample(params: Constants, state: State, sample: SampleInput) -> None:
    """Process one sample: correction, noise, outliers, and evidence on the short time scales."""
    kf = state.estimator
    for i in range(params.sensors.n):
        sample.z[i] = min(max(sample.z[i], -MAX_RATE), MAX_RATE)
        kf.start_bias[i] = sample.start_bias[i]
    # After such a pause a new block begins.
    if kf.seconds - kf.used_at > max(1.5 * BLOCK_TIME, 2.5 * params.period):
        drop_block(kf, params.sensors.n)
    kf.used_at = kf.seconds
    kf.samples += 1
    follow_gaps(params, kf)
    update_time_offsets(params, kf)
    correct_sample(params, kf, sample.z, kf.fused.gain)
    watch_for_motion(params, kf)
    if kf.blocks < FEWEST_BLOCKS and kf.noise.regime == MOTION:
        # No block gives the motion yet, but the sample does.
        project(params.layout, kf.states, kf.at)
        update_weights(params, kf)
    follow_displacement(params, kf, sample)
    follow_force(params, kf, sample)
    update_statistics(params, kf)
    find_outliers(params, kf, sample.z)
    if kf.judged == 0:
        update_shared(params, kf)
    elif not is_blind(kf):
        update_from_sample(params, kf, state.scales, not state.case.open)


@compiled
def fill_delays(params: Constants, kf: Estimator, sample: SampleInput) -> None:
    """Fill the estimated delays of the units."""
    estimate = sample.estimate
    estimate.behind = kf.behind
    estimate.largest_delay = kf.largest_delay
    for u in range(1, params.units):
        place = params.layout.delays[u]
        estimate.late[u] = kf.late[u]
        estimate.delay[u] = kf.late[u] + kf.states.x[place]
        estimate.delay_variance[u] = kf.states.p[place, place]


@compiled
def fill_verdict(
    params: Constants, state: State, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Fill the verdict, and the estimated sensor errors of the sample."""
    kf = state.estimator
    case = state.case
    n = params.sensors.n
    unsure = case.open and case.isolated == 0
    # The channels may disagree beyond the model, as in a shock at unequal sampling instants.
    chi_ratio = 1.0 if case.open else kf.chi_ratio
    fill_scores(params, state.estimator, state.scales, verdict.scores)
    sample.estimate.unclear = unfit_channels(case, n)
    for i in range(n):
        variance = kf.shared.level[i] * chi_ratio
        # What other channels share with this one is no noise of its own.
        own = kf.noise.now.sample[i] * kf.noise.recent_ratio[i]
        verdict.noise[i] = math.sqrt(own / params.expected[i])
        sample.estimate.corrected[i] = kf.corrected[i]
        sample.estimate.variance[i] = variance
        sample.estimate.bias[i] = kf.states.x[i]
        sample.estimate.spikes[i] = kf.spikes[i]
        sample.estimate.bias_std[i] = math.sqrt(kf.states.p[i, i])
        sample.estimate.far_bias[i] = kf.far_bias[i]
        sample.estimate.common[i] = kf.bias_error[i] ** 2 + kf.alike_bias[i] ** 2
        sample.estimate.common[i] += shared_variance(params.layout, kf.at, i)
        for j in range(n):
            # Until the faulty channels are named, each one may have the error that the
            # hypotheses give it.
            doubt = case.inference.error_products[i, j] if unsure else 0.0
            # So may all biases, if one that the states have learned is a fault.
            doubt += kf.bias_error[i] * kf.bias_error[j]
            doubt += kf.alike_bias[i] * kf.alike_bias[j]
            sample.estimate.covariance[i, j] = kf.at.covariance[i, j] + doubt
        if (kf.mask & ~kf.judged) >> i & 1:
            # The channels that it differed from are missing.
            sample.estimate.covariance[i, i] += kf.doubt[i]
        if (unsure and kf.mask >> i & 1) or kf.outliers >> i & 1:
            # Where no hypothesis explains a deviation, the deviation itself counts.
            innovation = kf.innovation[i]
            if innovation * innovation > THREE_SIGMA * (
                sample.estimate.covariance[i, i] + variance
            ):
                sample.estimate.covariance[i, i] += innovation * innovation
    sample.estimate.excess = kf.excess
    sample.estimate.doubtful = case.doubtful
    sample.estimate.checked = 0 if is_blind(kf) else kf.checked & ~case.doubtful
    fill_delays(params, kf, sample)
    suspects = (case.isolated if case.isolated else case.suspects) & kf.mask
    if case.open and suspects:
        verdict.alarm = True
        verdict.isolated = case.isolated != 0
        for i in range(n):
            if suspects >> i & 1:
                verdict.suspects[i] = True
                verdict.error[i] = case.inference.error[i]
        verdict.statistic = max(verdict.statistic, verdict.threshold)
    else:
        # Evidence that fails against the noise of the same time is no alarm.
        verdict.statistic = min(verdict.statistic, SHORT * verdict.threshold)


@callback(Constants, State, SampleInput, SampleVerdict)
def judge(
    params: Constants, state: State, sample: SampleInput, verdict: SampleVerdict
) -> None:
    """Judge one sample: update estimator and sums, follow the case or open one, fill the verdict."""
    kf = state.estimator
    verdict.threshold = math.log(1.0 + params.limit)
    seconds = pass_time(params, state, sample)
    if state.cleared:
        forget_suspicion(params, state)
    update_mask(params, state, sample)
    if not params.determines[kf.mask]:
        verdict.statistic = verdict.threshold = math.nan
        return
    if sample.in_recovery:
        if kf.excluded_from_rate:
            kf.mask = 0
        forget_evidence(params, state)
        forget_motion(kf, params.sensors.n)
        verdict.statistic = 0.0
        sample.estimate.checked = 0
        return
    if sample.repeated:
        verdict.statistic = min(
            math.log(1.0 + mean_of(params, state.estimator, state.scales)),
            SHORT * verdict.threshold,
        )
        return
    update_shape(params, kf)
    process_sample(params, state, sample)
    if add_sample(params, kf, sample.z, seconds):
        process_block(params, state, sample)
        # The block has changed the covariance of this sample.
        has_spike = kf.spiked != 0 and kf.spiked != kf.mask
        gain = kf.clean.gain if has_spike else kf.fused.gain
        correct_sample(params, kf, sample.z, gain)
    sample.estimate.is_current = True
    if kf.judged:
        follow_evidence(params, state, verdict)
    fill_verdict(params, state, sample, verdict)
    if kf.judged == 0:
        # Rate and covariance continue, but the channels are unchecked.
        verdict.statistic = verdict.threshold = math.nan


@compiled
def follow_evidence(params: Constants, state: State, verdict: SampleVerdict) -> None:
    """Follow the open case, or look for one where the mean of the sums reaches the limit."""
    kf = state.estimator
    case = state.case
    mean = mean_of(params, kf, state.scales)
    verdict.statistic = math.log(1.0 + mean)
    outliers = kf.outliers
    if outliers == 0 and case.open:
        outliers = kf.excluded_from_rate
    for i in range(params.sensors.n):
        verdict.outliers[i] = outliers >> i & 1
    if case.open:
        follow_case(params, state)
    elif kf.filled == 0 and goes_too_far(params, state):
        undo_move(params, state)
    elif mean < params.limit:
        case.doubtful = 0
    elif kf.samples >= case.retry:
        look_for_case(params, state)


class Sequential(Detector):
    r"""Shiryaev-Roberts sums of the innovations of an error-state estimator, with names by posterior odds.

    The estimator tracks bias, scale error, misalignment and delay of the channels, each
    with its uncertainty, and the present noise. Sums over channels, signs, sizes and time
    scales of a fault grow where the innovations are not white. Where the mean of the sums
    reaches `run_length`, a hypothesis that explains the values since the onset must stand
    against every uncertainty of the sensors. While the alarm lasts, the detector names the
    smallest set of hypotheses that holds the truth with probability `confidence`. The
    fault is `isolated` if these hypotheses have a channel in common and the best one
    leaves only noise. `Verdict.statistic` is the logarithm of one plus the mean of all
    sums: below the threshold without an alarm, at or above the threshold with one, 0
    while no evidence counts, and NaN while no channel is judged. docs/methods.md has
    the details.

    Parameters
    ----------
    geometry
        Sensitivity axes.
    noise
        Error model of a healthy channel. The estimator starts from `scale_std` and
        `bias_std`.
    run_length
        Mean number of samples to a false alarm of the whole detector, 2 to 1e15; default
        3.6e8 (1e-3 per hour at 100 Hz).
    false_alarms_per_hour
        Alternative to `run_length`, with `sample_rate`.
    sample_rate
        Sample rate, Hz; sets the length of the blocks. Default 100.
    confidence
        Probability that the named set holds the truth, above 0.5 and below 1.
    bias_walk
        Random walk of the bias of each channel, scalar or (n,), rad/s/sqrt(s).
    turn_on_std
        Standard deviation of the bias of a healthy sensor from one start to the next, rad/s;
        0: not known. A bias far beyond it widens the covariance.
    bias_move
        By which a healthy bias may move within seconds, standard deviation, rad/s: a
        fault has to be beyond that, unless it is sudden.
    largest_move
        By which all healthy biases may move together within half a minute, rad/s; 0: they
        never do.
    shared_scale_std
        Standard deviation, per axis of the body, of the scale errors that all channels have in
        common: no comparison shows these.
    g_sensitivity_std
        Standard deviation of the change of a bias with the specific force, where the
        samples have one, (rad/s)/(m/s^2).
    delay_std
        Standard deviation of the delay of one unit against another, s.
    rectified
        Standard deviation of the move of a bias as vibration begins or ends, over the root
        mean square of the vibration.
    gain_is_fault
        Whether a wrong gain of a unit makes its channels faulty, as it does of
        accelerometers: gravity always shows it as an error of the vertical channel.
    louder
        Ratio of the noise variance of a channel to its largest so far, from which its
        slow noise is learned again.
    """

    name = "sequential"
    Constants = Constants
    State = State
    judge = judge
    takes_any = True

    def __init__(
        self,
        geometry: Geometry,
        noise: NoiseModel,
        *,
        run_length: float | None = None,
        false_alarms_per_hour: float | None = None,
        sample_rate: float | None = None,
        confidence: float = 0.999,
        bias_walk: float | Sequence[float] = 5e-5,
        turn_on_std: float = 0.0,
        bias_move: float = 0.0,
        rectified: float = 0.0,
        largest_move: float = 0.0,
        shared_scale_std: float = 0.0,
        g_sensitivity_std: float = 0.0,
        delay_std: float = 0.001,
        gain_is_fault: bool = False,
        louder: float = math.inf,
    ) -> None:
        if not 0.5 < confidence < 1:
            raise ConfigError(
                f"confidence is {confidence:g}, expected above 0.5 and below 1"
            )
        self.run_length = FalseAlarmRate(
            run_length, None, false_alarms_per_hour, sample_rate
        ).mean_run_length()
        self.sample_rate = 100.0 if sample_rate is None else sample_rate
        walk = np.broadcast_to(np.asarray(bias_walk, dtype=np.float64), geometry.n)
        options = {
            "run_length": self.run_length,
            "sample_rate": self.sample_rate,
            "confidence": confidence,
            "bias_walk": float(walk.max()),
            "turn_on_std": turn_on_std,
            "bias_move": bias_move,
            "rectified": rectified,
            "largest_move": largest_move,
            "shared_scale_std": shared_scale_std,
            "g_sensitivity_std": g_sensitivity_std,
            "delay_std": delay_std,
            "gain_is_fault": gain_is_fault,
            "louder": louder,
        }
        super().__init__(geometry, noise, options)
        self._fill_units()
        self._fill_times()
        self._fill_sets()
        self._fill_noise(walk, delay_std)
        params = self.constants[0]
        params["layout"]["shared_scale"] = shared_scale_std
        params["g_sensitivity"] = g_sensitivity_std
        params["limit"] = self.run_length
        params["rest_std"] = REST_STD
        for name in SAME_NAMES:
            params[name] = options[name]

    def _fill_noise(self, bias_walk: Array, delay_std: float) -> None:
        """Fill the error states and what the noise model says of the channels."""
        n = self.geometry.n
        noise = self.noise
        params = self.constants[0]
        priors: dict[str, float | Array] = {
            "bias": noise.bias_std,
            "scale": np.maximum(noise.scale_std, LEAST_SCALE),
            "delay": delay_std,
            "asymmetry": noise.nonlinearity_std,
        }
        prepare_layout(
            params["layout"],
            self.geometry.axes,
            params["unit"][:n],
            len(self.geometry.units),
            priors,
            {"bias": bias_walk},
        )
        params["expected"][:n] = noise.noise_std**2
        params["timing"][:n] = np.maximum(noise.timing_std, LEAST_TIMING)
        params["nonlinearity"][:n] = np.maximum(
            noise.nonlinearity_std, LEAST_NONLINEARITY
        )

    def _fill_units(self) -> None:
        """Fill the unit of each channel and the channels of each unit."""
        params = self.constants[0]
        units = self.geometry.units
        params["units"] = len(units)
        for number, channels in enumerate(units):
            params["unit"][list(channels)] = number
            params["members"][number] = mask_of(channels)

    def _fill_times(self) -> None:
        """Fill the lengths that depend on the sample rate."""
        params = self.constants[0]
        length = max(round(BLOCK_TIME * self.sample_rate), 1)
        params["length"] = length
        params["stride"] = max(round(0.5 * BLOCK_TIME * self.sample_rate), 1)
        params["period"] = 1.0 / self.sample_rate
        params["adaptation_gain"] = 1.0 / max(0.5 * self.sample_rate / length, 8.0)
        params["least"] = math.ceil(LEAST_TIME * self.sample_rate)

    def _fill_sets(self) -> None:
        """Fill the sets of channels that give a rate, and those that also have redundancy."""
        params = self.constants[0]
        n = self.geometry.n
        used = all_sets(n)
        axes = used[:, :, None] * self.geometry.axes
        singular = np.linalg.svd(axes, compute_uv=False)
        spans = singular[:, -1] >= MIN_SINGULAR_RATIO * singular[:, 0]
        count = used.sum(axis=1)
        determines = (count >= 3) & spans
        params["determines"][: 1 << n] = determines
        params["spans"][: 1 << n] = (count >= MIN_CHANNELS) & determines

    def clear(self, declared: int = 0) -> None:
        """Drop all suspicion; keep the sensor errors, except the delay of a unit declared as a whole."""
        self.states["cleared"] = True
        self.states["declared"] |= declared
