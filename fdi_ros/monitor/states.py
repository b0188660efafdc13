"""The state of every channel at every sample, from what it shows by itself and what is declared of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.monitor.bias import BiasLearner
from fdi_ros.monitor.capability import Capabilities
from fdi_ros.monitor.decision import Decision
from fdi_ros.monitor.fusion import patterns
from fdi_ros.monitor.health import Condition
from fdi_ros.monitor.output import ChannelState, Reason

Mask = NDArray[np.bool_]
States = NDArray[np.uint8]

_CONDITION_STATE = {
    Condition.NON_FINITE: (ChannelState.SUSPECT, Reason.NON_FINITE),
    Condition.NON_FINITE_LASTING: (ChannelState.SUSPECT, Reason.NON_FINITE),
    Condition.OUT_OF_RANGE: (ChannelState.SUSPECT, Reason.OUT_OF_RANGE),
    Condition.FROZEN: (ChannelState.STALE, Reason.FROZEN),
    Condition.SILENT: (ChannelState.STALE, Reason.NO_DATA),
}

_SHOWN = np.array([_CONDITION_STATE.get(kind, (ChannelState.OK,))[0] for kind in Condition], dtype=np.uint8)
"""State that each condition shows; OK where it shows nothing of its own."""
_SILENT, _FROZEN = int(Condition.SILENT), int(Condition.FROZEN)


class Declared:
    """What stands of all channels between two changes: declarations, exclusions, what the rest can do."""

    def __init__(self, decision: Decision, bias: BiasLearner, excluded: Mask, capabilities: Capabilities) -> None:
        self._decision = decision
        self._bias = bias
        self.excluded = excluded
        self.capabilities = capabilities

    @property
    def lost(self) -> Mask:
        """(n,): declared faulty or taken out by the operator."""
        return self._decision.faulty | self.excluded

    @property
    def out(self) -> Mask:
        """(n,): not in use: lost, or of unknown bias."""
        return self.lost | ~self._bias.known

    def alive(self, condition: NDArray[np.uint8]) -> Mask:
        """(N, n): neither declared faulty, nor taken out, nor silent."""
        gone = (condition == _SILENT) | (condition == _FROZEN)
        return ~(gone | self.out)

    def states(self, condition: NDArray[np.uint8], suspicion: Mask, vouched: Mask) -> States:
        """(N, n) ChannelState of each sample under what is declared now."""
        alive = self.alive(condition)
        state = np.zeros(condition.shape, dtype=np.uint8)
        for rows, pattern in patterns(alive):
            seen = self.capabilities.of(pattern).detectable & vouched[rows]
            state[rows] = np.where(seen, ChannelState.OK, ChannelState.UNCHECKED)
        state[suspicion] = ChannelState.SUSPECT
        state[:, self._decision.ambiguous] = ChannelState.AMBIGUOUS
        self.overlay(state, condition)
        return state

    def overlay(self, state: States, condition: NDArray[np.uint8]) -> None:
        """Write what each value shows by itself, and what is declared, over the states."""
        if condition.any():
            shown = _SHOWN[condition]
            state[:] = np.where(shown, shown, state)
        state[:, self._decision.faulty] = ChannelState.FAULTY
        state[:, self.excluded] = ChannelState.EXCLUDED

    def reason(self, i: int, state: ChannelState, condition: Condition, alive: Mask) -> Reason:
        """Why channel i is in its state; alive (n,): the channels that can check each other."""
        if state == ChannelState.EXCLUDED:
            return Reason.OPERATOR
        if state == ChannelState.FAULTY:
            return self._decision.reasons[i]
        if state == ChannelState.UNCHECKED:
            return self._why_unchecked(i, alive)
        shown, reason = _CONDITION_STATE.get(condition, (None, Reason.DISAGREES))
        return reason if state == shown else Reason.DISAGREES

    def _why_unchecked(self, i: int, alive: Mask) -> Reason:
        if self._bias.learning or not self._bias.known[i]:
            return Reason.BIAS
        capability = self.capabilities.of(alive)
        return Reason.LATELY if capability.detectable[i] else capability.reason
