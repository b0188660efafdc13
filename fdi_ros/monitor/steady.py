"""The same sample-by-sample result, faster, while nothing happens.

Almost every live sample finds all channels in use delivered, in range and moving, those lost still lost, nothing
suspected, and the states what they were. Then most of what the pipeline works out is known beforehand. Whatever else
it finds, it steps back before anything is remembered, and the sample goes the full way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Detector, Verdict
from fdi_ros.model.block import Block
from fdi_ros.model.rows import transform
from fdi_ros.monitor.acceleration import History
from fdi_ros.monitor.health import Trace
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.stages import Stages

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


class Steady:
    """What does not change from sample to sample while one set of channels is in use.

    Parameters
    ----------
    stages
        Of the pipeline.
    used
        (n,) channels in use: all but those declared faulty, taken out or silent.
    lost
        (n,) channels declared faulty or taken out.
    condition
        (n,) Condition of every channel; that of one not lost is one of `LASTING`.
    state
        (n,) ChannelState of every channel.
    """

    def __init__(
        self,
        stages: Stages,
        used: Mask,
        lost: Mask,
        condition: NDArray[np.uint8],
        state: NDArray[np.uint8],
    ) -> None:
        geometry, noise, fusion = stages.geometry, stages.noise, stages.fusion
        self._geometry, self._noise, self._fusion = geometry, noise, fusion
        self._stages = stages
        self._health, self._acceleration, self._bias = stages.health, stages.acceleration, stages.bias.bias
        self._estimator = fusion.estimator(used)
        self.possible = self._estimator.spans
        self._all_used = bool(used.all())
        self._lost = lost
        self._used, self._condition, self._state = used, condition, state[None, :].copy()
        self._state.flags.writeable = False
        self._valid = np.ones(1, dtype=bool)
        self._covariance: Array | None = None
        if noise.constant and self.possible:
            variance = np.broadcast_to(noise.noise_std * noise.noise_std, (1, geometry.n))
            self._covariance = fusion.covariance(np.ascontiguousarray(variance), used[None, :])
            self._covariance.flags.writeable = False
        self._seen = used & (self._estimator.sensitivity > 1e-3)
        self._sensitivity = np.where(self._seen, self._estimator.sensitivity, 1.0)

    def step(self, block: Block, detector: Detector) -> tuple[Output | None, Verdict | None]:
        """Work one sample.

        Returns
        -------
        Its output; None if the sample must go the full way. And the verdict, if the detector has given one.
        """
        received = None if block.received is None else block.received[0]
        simple = self._health.continues(block.stamp[0], block.z[0], received, self._condition)
        if not simple and not (self._lost.any() and self._health.plain(block.z, block.delivered)[0, self._used].all()):
            return None, None
        z = block.z - self._bias
        known = z if self._all_used else np.where(self._used, z, 0.0)
        rate = transform(self._estimator.gain, known)
        along = transform(self._fusion.axes_transposed, rate)
        prediction = self._predicted(z, along)
        trace: Trace | None = None
        if not simple:
            # Whatever a channel that is out of use does, stuck or beyond its range, it is counted and no more.
            trace = self._health.inspect(block.stamp, block.z, block.delivered)
            repeats = self._stages.stuck.repeats(block.stamp, trace.memory.run_stamp)[0]
            if ((repeats | (trace.condition[0] != self._condition)) & ~self._lost).any():
                return None, None
        acceleration: Array | None = None
        history: History | None = None
        if self._acceleration is not None:
            acceleration, history = self._acceleration.inspect(block.stamp, rate)
        verdict = detector.detect(z if self._all_used else np.where(self._used, z, np.nan), acceleration)
        if verdict.alarm[0]:
            return None, verdict
        if trace is None:
            started = self._health.pass_over(block.stamp[0], block.z[0], self._condition)
        else:
            started = trace.memory.run_stamp[0] == block.stamp[0]
            self._health.commit(trace, 1)
        self._stages.stuck.pass_over(started, prediction[0])
        self._stages.last_stamp = int(block.stamp[0])
        if self._acceleration is not None and history is not None:
            self._acceleration.commit(history, 1)
        return self._output(block, z, rate, along, acceleration, verdict), verdict

    def _predicted(self, z: Array, along: Array) -> Array:
        if self._all_used and self._seen.all():
            residual = z - along
            return along + residual - residual / self._sensitivity
        residual = np.where(self._used, z - along, 0.0)
        share = np.where(self._seen, residual / self._sensitivity, 0.0)
        return np.where(self._used & ~self._seen, np.nan, np.where(self._used, along + residual - share, along))

    def _output(
        self, block: Block, z: Array, rate: Array, along: Array, acceleration: Array | None, verdict: Verdict
    ) -> Output:
        covariance = self._covariance
        if covariance is None:
            variance = self._noise.variance(self._geometry, rate, acceleration)
            covariance = self._fusion.covariance(variance, self._used[None, :])
        return Output(
            block.stamp,
            rate,
            covariance,
            self._valid,
            verdict.statistic,
            verdict.threshold,
            verdict.alarm,
            self._state,
            (z if self._all_used else np.where(np.isfinite(z), z, np.nan)) - along,
            (),
        )
