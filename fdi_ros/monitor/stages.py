"""The stages that a block passes, worked out without remembering anything: health, detector, decision, fusion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config import Config
from fdi_ros.detectors.base import Detector, Verdict
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.noise import NoiseModel
from fdi_ros.model.rows import transform
from fdi_ros.model.thresholds import normal_isf
from fdi_ros.monitor.acceleration import Acceleration, History
from fdi_ros.monitor.bias import BiasLearner
from fdi_ros.monitor.decision import Decision, Judgement, Seen
from fdi_ros.monitor.fusion import Fusion, patterns
from fdi_ros.monitor.health import Condition, Health, Trace
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.states import Declared, States
from fdi_ros.monitor.stuck import Stuck, with_stuck

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RAIL_MARGIN = 0.9
"""A value out of range while the others predict less than this share of the range is a fault, not a manoeuvre."""
RETURN_PROBABILITY = 1e-6
"""Probability with which a sound channel disagrees by chance in one sample, where it is to return."""


@dataclass(frozen=True)
class Work:
    """All that was worked out on some rows, before any of it is remembered."""

    trace: Trace
    fed: Array
    """(N, n) what the detector saw: NaN for a channel left out."""
    acceleration: Array | None
    history: History | None
    saturated: NDArray[np.int64]
    """(N,) stamp of the last sample in which a channel in use was out of range, ns."""
    stuck: Mask
    """(N, n) evidence that a channel is stuck."""
    reference: Array
    """(N, n) of `Stuck`."""
    doubt: Array
    """(N, n) last estimate of each channel's error, rad/s."""
    verdict: Verdict
    judgement: Judgement
    output: Output


class Stages:
    """Health, bias, acceleration, fusion and decision of one pipeline.

    Parameters
    ----------
    config
        All settings.
    geometry, noise
        Of the channels.
    """

    def __init__(self, config: Config, geometry: Geometry, noise: NoiseModel) -> None:
        self.geometry = geometry
        self.noise = noise
        self.health = Health(config.health, geometry.n)
        self.bias = BiasLearner(config.bias, noise.noise_std, geometry.channel_names)
        self.fusion = Fusion(geometry, noise)
        self.acceleration = Acceleration(config.noise.acceleration_window) if noise.timing_std.any() else None
        self.decision = Decision(config.decision, noise.noise_std)
        self.stuck = Stuck(noise.noise_std, config.health.stuck_time)
        self._doubt = np.zeros(geometry.n)
        self._hole = round(config.health.stale_timeout * 1e9)
        self.last_stamp: int | None = None
        """Stamp of the last sample remembered, ns."""
        self._latch = config.decision.latch
        self._return_limit = normal_isf(RETURN_PROBABILITY / 2)
        self._recovery = round(config.health.range_recovery_time * 1e9)
        self._last_saturated = np.int64(-(2**62))

    def commit(self, work: Work, rows: int) -> bool:
        """Remember the first rows of a work; return whether that changed what is declared."""
        self.health.commit(work.trace, rows)
        if self.acceleration is not None and work.history is not None:
            self.acceleration.commit(work.history, rows)
        row = rows - 1
        self._last_saturated, self._doubt = work.saturated[row], work.doubt[row].copy()
        self.stuck.commit(work.reference[row])
        self.health.stuck += work.stuck[:rows].sum(axis=0)
        stamp = work.output.stamp[row : row + 1]
        self.last_stamp = int(stamp[0])
        repeats = self.stuck.repeats(stamp, work.trace.memory.run_stamp[row : row + 1])[0]
        return self.decision.commit(work.judgement, rows, work.trace.condition, repeats)

    def pass_over_learning(self, trace: Trace, stamp: NDArray[np.int64]) -> None:
        """Remember samples (N,) that only the bias was learned from."""
        self.health.commit(trace, len(stamp))
        self.stuck.forget()
        self.decision.unvouch()
        self.last_stamp = int(stamp[-1])

    def work(self, block: Block, detector: Detector, declared: Declared, verdict: Verdict | None) -> Work:
        """Work some rows; a verdict that the detector has already given on them is taken as it is."""
        z = block.z - self.bias.bias
        plain = self.health.plain(block.z, block.delivered)
        base = plain & ~declared.out
        rate0, sensitivity = self.fusion.rate(z, base)
        along = transform(self.fusion.axes_transposed, rate0)
        trace = self.health.inspect(block.stamp, block.z, block.delivered)
        usable = base & (trace.condition == Condition.FINE)
        fed = np.where(usable, z, np.nan)
        self._feed_rails(fed, z, along, trace.condition, declared)
        acceleration: Array | None = None
        history: History | None = None
        if self.acceleration is not None:
            acceleration, history = self.acceleration.inspect(block.stamp, rate0)
        if verdict is None:
            verdict = detector.detect(fed, acceleration)
        stuck, reference = self._stuck(block.stamp, z, trace, base, (along, sensitivity), usable, verdict)
        verdict = with_stuck(verdict, stuck, z - along)
        saturated = self._saturated(block.stamp, trace.condition, fed, declared)
        seen = Seen(
            held=block.stamp - saturated <= self._recovery,
            checked=_checked(fed, verdict, declared),
            agrees=self._agrees(z, along, rate0, acceleration, plain),
            error=z - along,
            interrupted=np.diff(block.stamp, prepend=self._before(block)) > self._hole,
        )
        judgement = self.decision.judge(block.stamp, verdict, trace.condition, seen)
        doubt = _last_nonzero(verdict.error, self._doubt)
        state = declared.states(trace.condition, judgement.suspicion, judgement.vouched)
        output = self._fused(block, z, usable, judgement.suspicion, acceleration, verdict, doubt, state)
        return Work(trace, fed, acceleration, history, saturated, stuck, reference, doubt, verdict, judgement, output)

    def _before(self, block: Block) -> int:
        return int(block.stamp[0]) if self.last_stamp is None else self.last_stamp

    def _stuck(
        self,
        stamp: NDArray[np.int64],
        z: Array,
        trace: Trace,
        base: Mask,
        of_base: tuple[Array, Array],
        usable: Mask,
        verdict: Verdict,
    ) -> tuple[Mask, Array]:
        """Evidence of stuck channels, judged by the channels that are not under alarm themselves."""
        along, sensitivity = of_base
        clear = usable & ~verdict.suspects
        if not (clear == base).all():
            rate, sensitivity = self.fusion.rate(z, clear)
            along = transform(self.fusion.axes_transposed, rate)
        prediction = predicted(z, along, sensitivity)
        return self.stuck.inspect(stamp, trace.memory.run_stamp, prediction, sensitivity, usable, verdict)

    def _feed_rails(self, fed: Array, z: Array, along: Array, condition: NDArray[np.uint8], declared: Declared) -> None:
        """Let the detector judge values out of range that no manoeuvre explains: a hard-over is a fault."""
        railed = condition == Condition.OUT_OF_RANGE
        if not railed.any():
            return
        with np.errstate(invalid="ignore"):
            railed &= np.abs(along) < RAIL_MARGIN * self.health.max_rate
        railed &= ~declared.out
        limit = np.broadcast_to(10 * self.health.max_rate, z.shape)
        fed[railed] = np.clip(z, -limit, limit)[railed]

    def _saturated(
        self, stamp: NDArray[np.int64], condition: NDArray[np.uint8], fed: Array, declared: Declared
    ) -> NDArray[np.int64]:
        """(N,) stamp of the last sample with a value out of range by a manoeuvre: not one that the detector judges.

        A chip takes its time to come back from its limit, and the manoeuvre that drove it there is beyond what the
        error model was made for: what disagrees meanwhile is left out, but not condemned.
        """
        beyond = (condition == Condition.OUT_OF_RANGE) & np.isnan(fed) & ~declared.out
        return np.maximum.accumulate(np.where(beyond.any(axis=1), stamp, self._last_saturated))

    def _agrees(self, z: Array, along: Array, rate: Array, acceleration: Array | None, plain: Mask) -> Mask:
        """(N, n): a channel declared faulty agrees again with the others."""
        if self._latch or not self.decision.faulty.any():
            return np.zeros(z.shape, dtype=bool)
        variance = self.noise.variance(self.geometry, rate, acceleration)
        with np.errstate(invalid="ignore"):
            # The prediction of n - 1 channels is at worst as uncertain as the channel itself on a sane mounting.
            return plain & (np.abs(np.where(plain, z - along, np.nan)) <= self._return_limit * np.sqrt(2 * variance))

    def _fused(
        self,
        block: Block,
        z: Array,
        usable: Mask,
        suspicion: Mask,
        acceleration: Array | None,
        verdict: Verdict,
        doubt: Array,
        state: States,
    ) -> Output:
        doubtful = suspicion | self.decision.ambiguous
        trusted = self.fusion.trusted(usable, doubtful)
        rate, _ = self.fusion.rate(z, trusted)
        valid = ~np.isnan(rate[:, 0])
        variance = self.noise.variance(self.geometry, rate, acceleration)
        kept = trusted & doubtful
        if kept.any():
            # It could not be left out: what it may be wrong by belongs into the covariance.
            variance = variance + np.where(kept, doubt * doubt, 0.0)
        residual = np.where(np.isfinite(z), z, np.nan) - transform(self.fusion.axes_transposed, rate)
        covariance = self.fusion.covariance(variance, trusted)
        return Output(
            block.stamp,
            rate,
            covariance,
            valid,
            verdict.statistic,
            verdict.threshold,
            verdict.alarm,
            state,
            residual,
            (),
        )


def predicted(z: Array, along: Array, sensitivity: Array) -> Array:
    """Return what the others say of each channel: leave-one-out where it took part, else the estimate itself."""
    residual = np.where(sensitivity > 0, z - along, 0.0)
    seen = sensitivity > 1e-3
    share = np.divide(residual, sensitivity, out=np.zeros_like(residual), where=seen)
    return np.where(sensitivity == 0, along, np.where(seen, along + residual - share, np.nan))


def _checked(fed: Array, verdict: Verdict, declared: Declared) -> Mask:
    """(N, n): a fault of the channel would have shown in the sample."""
    checked = np.zeros(fed.shape, dtype=bool)
    for rows, pattern in patterns(np.isfinite(fed)):
        checked[rows] = declared.capabilities.of(pattern).detectable
    return checked & ~np.isnan(verdict.statistic)[:, None]


def _last_nonzero(values: Array, before: Array) -> Array:
    """Last nonzero value of each column so far, (N, n)."""
    rows = np.maximum.accumulate(np.where(values != 0, np.arange(len(values))[:, None], -1), axis=0)
    return np.where(rows >= 0, np.take_along_axis(values, np.maximum(rows, 0), axis=0), before)
