"""From alarms to declarations: confirmation over a window, latching or return after a clean time.

All memory of verdicts lives here, and all of it is bounded: the last samples of one window, one stamp a channel. A
fault after ten hours is declared as fast as one after a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.config import DecisionConfig
from fdi_ros.detectors.base import Verdict
from fdi_ros.monitor.health import Condition
from fdi_ros.monitor.output import Reason

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]

BREAKS = {int(Condition.STUCK): Reason.STUCK, int(Condition.NON_FINITE_LASTING): Reason.NON_FINITE}
"""Conditions that declare a channel faulty by themselves."""
_STUCK, _NON_FINITE = BREAKS


@dataclass(frozen=True)
class Judgement:
    """Decision on N samples; nothing is remembered until `Decision.commit`."""

    suspicion: Mask
    """(N, n): named by an alarm among the last samples."""
    change: int
    """First row that changes what is declared; N if none does."""
    faulty: Mask
    """(n,) declared faulty from that row on."""
    ambiguous: Mask
    """(n,) the set one of which is faulty, from that row on."""
    suspects: Mask
    """(window - 1 + N, n) suspects of the window before and of these samples."""
    counted: Mask
    """(window - 1 + N, n) those of them that count towards a declaration."""
    isolated: Mask
    """(window - 1 + N,)"""
    last_bad: Stamps
    """(N, n): last sample at which a declared channel still disagreed or was unusable."""
    last_alarm: Stamps
    """(N,)"""


class Decision:
    """What is declared of n channels.

    A channel is FAULTY when at least `confirm_alarms` of the last `confirm_window` samples named it and at least half
    that many named nothing but faulty channels with it. When the alarms are as many but do not single it out, the
    channels that at least half of them named become AMBIGUOUS together; later evidence can still single one out.
    """

    def __init__(self, config: DecisionConfig, n: int) -> None:
        self._alarms = config.confirm_alarms
        self._window = config.confirm_window
        self._latch = config.latch
        self._clean_time = round(config.clean_time * 1e9)
        self.faulty: Mask = np.zeros(n, dtype=bool)
        self.ambiguous: Mask = np.zeros(n, dtype=bool)
        self.reasons: list[Reason] = [Reason.NONE] * n
        """Why each channel was declared."""
        self._last_bad: Stamps = np.zeros(n, dtype=np.int64)
        self._last_alarm = np.int64(0)
        self._suspects: Mask
        self._counted: Mask
        self._isolated: Mask
        self._forget_window()

    def reset(self) -> None:
        """Clear all that is declared or suspected."""
        self.faulty = np.zeros_like(self.faulty)
        self.ambiguous = np.zeros_like(self.ambiguous)
        self.reasons = [Reason.NONE] * len(self.reasons)
        self._forget_window()

    @property
    def calm(self) -> bool:
        """Whether nothing is under suspicion and nothing waits to return: a sample without alarm changes nothing."""
        waiting = self.faulty.any() and not self._latch
        return not (waiting or self.ambiguous.any() or self._suspects.any())

    def judge(
        self, stamp: Stamps, verdict: Verdict, condition: NDArray[np.uint8], agrees: Mask, held: Mask
    ) -> Judgement:
        """Judge N samples without remembering them.

        Parameters
        ----------
        stamp
            (N,) ns.
        verdict
            Of the detector on the channels not declared faulty.
        condition
            (N, n) Condition of each value.
        agrees
            (N, n): the value is usable and agrees with the fused rate; looked at for declared channels.
        held
            (N,): an alarm of this sample is a suspicion, but does not count towards a declaration.
        """
        named_now = verdict.suspects & ~self.faulty
        suspects: Mask = np.vstack([self._suspects, named_now])
        counted: Mask = np.vstack([self._counted, named_now & ~held[:, None]])
        isolated: Mask = np.concatenate([self._isolated, verdict.isolated])
        named = _rolling(counted, self._window)
        faulty = (named >= self._alarms) & (_rolling(counted & isolated[:, None], self._window) >= self._half)
        alarms = np.logical_or.reduce(counted, axis=1, keepdims=True)
        undecided = self._undecided(named, _rolling(alarms, self._window))
        # Named alone by most alarms, though never called isolated: there is no other channel to confuse it with.
        alone = undecided & (undecided.sum(axis=1) == 1)[:, None] & (named >= self._alarms)
        faulty |= alone
        undecided &= ~faulty.any(axis=1, keepdims=True)
        broken = ((condition == _STUCK) | (condition == _NON_FINITE)) & ~self.faulty
        last_bad = np.maximum.accumulate(np.where(agrees, self._last_bad, stamp[:, None]), axis=0)
        last_alarm = np.maximum.accumulate(np.where(suspects[self._window - 1 :].any(axis=1), stamp, self._last_alarm))
        returns, clears = self._returns(stamp, last_bad, last_alarm)
        news = (faulty | broken | (undecided & ~self.ambiguous) | returns).any(axis=1) | clears
        row = int(news.argmax()) if news.any() else len(stamp)
        after, unsure = self.faulty.copy(), self.ambiguous.copy()
        if row < len(stamp):
            after = (after | faulty[row] | broken[row]) & ~returns[row]
            # A set of which a member is now known to be faulty is explained by it.
            explained = bool((unsure & (faulty | broken)[row]).any()) or bool(clears[row])
            unsure = (np.zeros_like(unsure) if explained else unsure | undecided[row]) & ~after
        suspicion = _rolling(suspects, self._window) > 0
        return Judgement(suspicion, row, after, unsure, suspects, counted, isolated, last_bad, last_alarm)

    def commit(self, judgement: Judgement, rows: int, condition: NDArray[np.uint8]) -> bool:
        """Remember the first rows of a judgement; return whether that changed what is declared."""
        self._suspects = judgement.suspects[rows : rows + self._window - 1].copy()
        self._counted = judgement.counted[rows : rows + self._window - 1].copy()
        self._isolated = judgement.isolated[rows : rows + self._window - 1].copy()
        self._last_bad = judgement.last_bad[rows - 1].copy()
        self._last_alarm = judgement.last_alarm[rows - 1]
        if judgement.change != rows - 1:
            return False
        for i in np.flatnonzero(judgement.faulty & ~self.faulty):
            self.reasons[i] = BREAKS.get(int(condition[rows - 1, i]), Reason.DISAGREES)
        for i in np.flatnonzero(self.faulty & ~judgement.faulty):
            self.reasons[i] = Reason.NONE
        self.faulty, self.ambiguous = judgement.faulty, judgement.ambiguous
        self._forget_window()
        return True

    @property
    def _half(self) -> int:
        return (self._alarms + 1) // 2

    def _undecided(self, named: NDArray[np.int64], alarms: NDArray[np.int64]) -> Mask:
        """(N, n): the set that alarms point at when they are enough, or when all the window disagrees about it."""
        often = named >= self._half
        enough = (named >= self._alarms).any(axis=1, keepdims=True)
        conflicting = (alarms == self._window) & ~enough
        members = np.where(often.any(axis=1, keepdims=True), often, named > 0)
        return members & (enough | conflicting)

    def _returns(self, stamp: Stamps, last_bad: Stamps, last_alarm: Stamps) -> tuple[Mask, Mask]:
        if self._latch:
            return np.zeros(last_bad.shape, dtype=bool), np.zeros(len(stamp), dtype=bool)
        returns: Mask = self.faulty & (stamp[:, None] - last_bad >= self._clean_time)
        clears: Mask = self.ambiguous.any() & (stamp - last_alarm >= self._clean_time)
        return returns, clears

    def _forget_window(self) -> None:
        self._suspects = np.zeros((self._window - 1, len(self.faulty)), dtype=bool)
        self._counted = np.zeros_like(self._suspects)
        self._isolated = np.zeros(self._window - 1, dtype=bool)


def _rolling(flags: Mask, window: int) -> NDArray[np.int64]:
    """Count of the flags in each window: (window - 1 + N, n) to (N, n)."""
    total = np.cumsum(flags, axis=0, dtype=np.int64)
    counts = total[window - 1 :].copy()
    counts[1:] -= total[: len(counts) - 1]
    return counts
