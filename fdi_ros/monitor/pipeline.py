"""The one path of a sample, online and offline: health, detector, decision, fusion.

How a stream is cut into blocks changes nothing: every stage works on a block without remembering it, the first row
that changes a state is found, the rows up to it are remembered, and the rest is worked again from there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config import PARAMETERS, Config
from fdi_ros.detectors.base import Verdict
from fdi_ros.errors import ConfigError
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import spans_space
from fdi_ros.monitor.build import build_detector, build_geometry, build_noise
from fdi_ros.monitor.capability import Capabilities
from fdi_ros.monitor.health import LASTING, Condition
from fdi_ros.monitor.integrity import Integrity
from fdi_ros.monitor.output import ChannelState, Output, Reason, Status
from fdi_ros.monitor.record import Record
from fdi_ros.monitor.stages import Stages
from fdi_ros.monitor.states import Declared
from fdi_ros.monitor.steady import Steady

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHUNK = 4096
"""Rows worked at once: large enough for NumPy, small enough for the cache."""
SHORT = 32
"""Rows worked at once right after an event: more are likely to follow."""


class Pipeline:
    """Monitor of one vehicle's gyros.

    Parameters
    ----------
    config
        All settings.

    Raises
    ------
    FdiError
        If the settings do not fit each other.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.geometry = build_geometry(config)
        self.noise = build_noise(config, self.geometry.n)
        self.channel_names = self.geometry.channel_names
        self._stages = Stages(config, self.geometry, self.noise)
        self._record = Record(self.geometry.n)
        self._last_stamp: int | None = None
        self._equip(config)

    @classmethod
    def from_config(cls, config: Config) -> Pipeline:
        """Build from settings."""
        return cls(config)

    def reconfigure(self, config: Config) -> None:
        """Take over another detector, its options or other excluded channels; bias and declarations stay.

        Raises
        ------
        FdiError
            If the new settings do not fit, or change what cannot change at run time; then nothing is changed.
        """
        before = self.config.parameters()
        fixed = [name for name, v in config.parameters().items() if v != before[name] and not PARAMETERS[name].runtime]
        if fixed:
            raise ConfigError(f"{', '.join(fixed)} cannot change while the monitor runs")
        self._equip(config)
        self.config = config

    def reset(self) -> None:
        """Clear all that is declared or suspected; bias and counters stay."""
        self._stages.decision.reset()
        self._detector.reset()
        self._unsettle()

    def relearn_bias(self) -> None:
        """Learn the bias anew from the next time at rest; until then nothing is checked and there is no rate."""
        self._stages.bias.restart()
        self._unsettle()

    def process(self, block: Block) -> Output:
        """Judge and fuse a block of samples, of any length."""
        parts = list(self.steps(block))
        if not parts:
            return Output.nothing(block.stamp, np.empty(block.z.shape, dtype=np.uint8))
        return parts[0] if len(parts) == 1 else Output.joined(parts)

    def steps(self, block: Block) -> Iterator[Output]:
        """Judge and fuse a block, in parts that each end at a sample that brought events, or at the end.

        Raises
        ------
        ConfigError
            If the block has another number of channels, or stamps that do not increase.
        """
        self._check(block)
        row, span = 0, CHUNK
        while row < len(block):
            part = block[row : row + span]
            verdict: Verdict | None = None
            output = self._learn(part) if self._stages.bias.learning else None
            if output is None and len(part) == 1:
                output, verdict = self._step(part)
            if output is None:
                output = self._advance(part, verdict)
            row += len(output)
            span = SHORT if output.events else min(2 * span, CHUNK)
            yield output

    def status(self) -> Status:
        """Snapshot after the last sample."""
        alive = ~np.isin(self._record.state, (ChannelState.FAULTY, ChannelState.STALE, ChannelState.EXCLUDED))
        capability = self._declared.capabilities.of(alive)
        return self._record.status(
            self._detector.name, self.channel_names, self._stages.health, capability, self._stages.bias, self._integrity
        )

    def protection(self, output: Output) -> Array:
        """Protection level of the fused rate in every sample of an output, (N, 3) rad/s; inf where there is none."""
        return self._integrity.levels(output)

    def _equip(self, config: Config) -> None:
        for name in config.excluded_channels:
            if name not in self.channel_names:
                raise ConfigError(
                    f"excluded_channels names {name!r}, expected some of: {', '.join(self.channel_names)}"
                )
        excluded = np.array([name in config.excluded_channels for name in self.channel_names])
        if not spans_space(self.geometry.axes[~excluded]):
            left = ", ".join(name for name in self.channel_names if name not in config.excluded_channels) or "none"
            raise ConfigError(f"excluded_channels leaves no rate: {left} do not span three dimensions")
        detector = build_detector(config, self.geometry, self.noise)
        capabilities = Capabilities(detector)
        capabilities.prepare([list(unit) for unit in self.geometry.units])
        integrity = Integrity.from_config(config, self.geometry, self.noise)
        integrity.prepare()
        self._detector = detector
        self._integrity = integrity
        self._declared = Declared(self._stages.decision, self._stages.bias, excluded, capabilities)
        self._unsettle()

    def _unsettle(self) -> None:
        """Send the next sample the full way."""
        self._steady: Steady | None = None
        self._settled = False
        self._condition = np.zeros(self.geometry.n, dtype=np.uint8)

    def _check(self, block: Block) -> None:
        n = self.geometry.n
        if block.z.ndim != 2 or block.z.shape[1] != n:
            raise ConfigError(f"samples have shape {block.z.shape}, expected (N, {n})")
        if len(block) == 0:
            return
        if len(block) > 1 and bool((block.stamp[1:] <= block.stamp[:-1]).any()):
            raise ConfigError("stamps of the samples do not increase")
        if self._last_stamp is not None and block.stamp[0] <= self._last_stamp:
            raise ConfigError(f"stamp {block.stamp[0]} ns does not come after the last one, {self._last_stamp} ns")
        self._last_stamp = int(block.stamp[-1])

    def _learn(self, block: Block) -> Output | None:
        """Give samples to the bias being learned; None if it needed none of them."""
        received = block.delivered
        rows, n = block.z.shape
        trace = self._stages.health.inspect(block.stamp, block.z, received)
        state = np.full((rows, n), ChannelState.UNCHECKED, dtype=np.uint8)
        self._declared.overlay(state, trace.condition)
        cut = slice(self._record.first_event(state) + 1)
        plain = self._stages.health.plain(block.z[cut], received[cut])
        used = self._stages.bias.take(block.stamp[cut], block.z[cut], plain, self._declared.lost)
        if not self._stages.bias.learning:
            self._detector.reset()
        if used == 0:
            return None
        self._stages.pass_over_learning(trace, block.stamp[:used])
        output = Output.nothing(block.stamp[:used], state[:used])
        return self._recorded(output, trace.condition[used - 1], np.zeros(n))

    def _step(self, block: Block) -> tuple[Output | None, Verdict | None]:
        """Work one sample the short way, if nothing speaks against it."""
        if self._steady is None:
            if not (self._settled and self._stages.decision.calm):
                return None, None
            used = ~self._declared.out & (self._condition == Condition.FINE)
            self._steady = Steady(self._stages, used, self._declared.out, self._condition, self._record.state)
        if not self._steady.possible:
            return None, None
        output, verdict = self._steady.step(block, self._detector)
        if output is not None:
            self._record.pass_over(output)
        return output, verdict

    def _advance(self, block: Block, verdict: Verdict | None = None) -> Output:
        """Work some rows, remember those up to the first event, and return them.

        A verdict that the detector has already given on them is taken as it is: a detector with a memory must not
        see a sample twice.
        """
        memory = self._detector.snapshot() if len(block) > 1 else None
        work = self._stages.work(block, self._detector, self._declared, verdict)
        state = work.output.state
        rows = min(self._record.first_event(state), work.judgement.change, len(block) - 1) + 1
        if rows < len(block) and memory is not None:
            self._detector.restore(memory)
            self._detector.detect(work.fed[:rows], None if work.acceleration is None else work.acceleration[:rows])
        condition = work.trace.condition[rows - 1]
        changed = self._stages.commit(work, rows)
        if changed:
            self._detector.reset()
            state[rows - 1] = self._declared.states(
                work.trace.condition[rows - 1 : rows],
                np.zeros((1, state.shape[1]), dtype=bool),
                work.judgement.vouched[rows - 1 : rows],
            )
        self._steady = None
        lasting = not condition.any() or bool((np.isin(condition, LASTING) | self._declared.out).all())
        checked = work.judgement.checked[rows - 1 + self.config.decision.confirm_window - 1]
        calm = not (work.judgement.suspicion[rows - 1] | (work.judgement.vouched[rows - 1] != checked)).any()
        self._settled = lasting and calm and not changed and self._stages.decision.steady(checked)
        self._condition = condition.copy()
        error = np.where(
            work.verdict.error[rows - 1] != 0, work.verdict.error[rows - 1], work.output.residual[rows - 1]
        )
        return self._recorded(
            work.output if rows == len(block) else work.output.first(rows),
            condition,
            error,
        )

    def _recorded(self, output: Output, condition: NDArray[np.uint8], error: Array) -> Output:
        state, alive = output.state[-1], self._declared.alive(condition[None, :])[0]
        reasons = [Reason.NONE] * len(state)
        for i in np.flatnonzero(state):
            reasons[i] = self._declared.reason(int(i), ChannelState(state[i]), Condition(condition[i]), alive)
        group = tuple(int(i) for i in np.flatnonzero(self._stages.decision.ambiguous))
        events = self._record.take(output, reasons, error, group)
        return replace(output, events=events) if events else output
