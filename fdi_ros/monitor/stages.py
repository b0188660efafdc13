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
from fdi_ros.monitor.decision import Decision, Judgement
from fdi_ros.monitor.fusion import Fusion
from fdi_ros.monitor.health import Condition, Health, Trace
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.states import Declared, States

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
        self.health = Health(config.health, noise.noise_std)
        self.bias = BiasLearner(config.bias, noise.noise_std)
        self.fusion = Fusion(geometry, noise)
        self.acceleration = Acceleration(config.noise.acceleration_window) if noise.timing_std.any() else None
        self.decision = Decision(config.decision, geometry.n)
        self._latch = config.decision.latch
        self._return_limit = normal_isf(RETURN_PROBABILITY / 2)
        self._recovery = round(config.health.range_recovery_time * 1e9)
        self._last_saturated = np.int64(-(2**62))

    def commit(self, work: Work, rows: int) -> bool:
        """Remember the first rows of a work; return whether that changed what is declared."""
        self.health.commit(work.trace, rows)
        if self.acceleration is not None and work.history is not None:
            self.acceleration.commit(work.history, rows)
        self._last_saturated = work.saturated[rows - 1]
        return self.decision.commit(work.judgement, rows, work.trace.condition)

    def work(self, block: Block, detector: Detector, declared: Declared, verdict: Verdict | None) -> Work:
        """Work some rows; a verdict that the detector has already given on them is taken as it is."""
        z = block.z - self.bias.bias
        received = block.delivered
        plain = self.health.plain(block.z, received)
        base = plain & ~declared.out
        rate0, sensitivity = self.fusion.rate(z, base)
        along = transform(self.fusion.axes_transposed, rate0)
        prediction = _predicted(z, along, sensitivity)
        trace = self.health.inspect(block.stamp, block.z, received, prediction)
        usable = base & (trace.condition == Condition.FINE)
        fed = np.where(usable, z, np.nan)
        self._feed_rails(fed, z, along, trace.condition, declared)
        acceleration: Array | None = None
        history: History | None = None
        if self.acceleration is not None:
            acceleration, history = self.acceleration.inspect(block.stamp, rate0)
        if verdict is None:
            verdict = detector.detect(fed, acceleration)
        agrees = self._agrees(z, along, rate0, acceleration, plain)
        saturated = self._saturated(block.stamp, trace.condition, fed, declared)
        held = block.stamp - saturated <= self._recovery
        judgement = self.decision.judge(block.stamp, verdict, trace.condition, agrees, held)
        state = declared.states(trace.condition, judgement.suspicion)
        output = self._fused(block, z, usable, judgement.suspicion, acceleration, verdict, state)
        return Work(trace, fed, acceleration, history, saturated, verdict, judgement, output)

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
            variance = variance + np.where(kept, verdict.error**2, 0.0)
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


def _predicted(z: Array, along: Array, sensitivity: Array) -> Array:
    """Return what the others say of each channel: leave-one-out where it took part, else the estimate itself."""
    residual = np.where(sensitivity > 0, z - along, 0.0)
    seen = sensitivity > 1e-3
    share = np.divide(residual, sensitivity, out=np.zeros_like(residual), where=seen)
    return np.where(sensitivity == 0, along, np.where(seen, along + residual - share, np.nan))
