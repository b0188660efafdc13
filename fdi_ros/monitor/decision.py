"""From alarms to declarations: confirmation over a window, latching or return after a clean time.

All memory of verdicts lives here, and all of it is bounded: the last samples of one window, one stamp a channel. A
fault after ten hours is declared as fast as one after a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Verdict
from fdi_ros.monitor.health import Condition
from fdi_ros.monitor.output import Reason
from fdi_ros.settings import DecisionConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]

RETURN_MEAN = 0.5
"""A channel returns only if, averaged over the clean time, it is off by less than this many noise_std."""
_QUANTUM = 2.0**-32
_NON_FINITE = int(Condition.NON_FINITE_LASTING)


@dataclass(frozen=True)
class Seen:
    """What was seen of N samples beside the verdict."""

    held: Mask
    """(N,): an alarm of this sample is a suspicion, but does not count towards a declaration."""
    checked: Mask
    """(N, n): a fault of the channel would have shown in this sample."""
    agrees: Mask
    """(N, n): the value agrees with the others; looked at for declared channels."""
    error: Array
    """(N, n) channel minus the rate of the others along its axis, rad/s."""
    interrupted: Mask
    """(N,): there is a hole in the stream before this sample."""


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
    checked: Mask
    """(window - 1 + N, n)"""
    vouched: Mask
    """(N, n): enough of the last samples of the channel were checked for a fault to be declared."""
    last_bad: Stamps
    """(N, n): last sample at which a declared channel still disagreed or was unusable."""
    clean: NDArray[np.int64]
    """(2, N, n): sum of the channel's errors since then, fixed-point, and their number."""
    last_doubt: Stamps
    """(N,): last sample with an alarm, or that could not be judged."""


class Decision:
    """What is declared of n channels.

    A channel is FAULTY when at least `confirm_alarms` of the last `confirm_window` samples named it and at least half
    that many named nothing but faulty channels with it. When the alarms are as many but do not single it out, the
    channels that at least half of them named become AMBIGUOUS together; later evidence can still single one out.
    """

    def __init__(self, config: DecisionConfig, noise_std: Array) -> None:
        n = len(noise_std)
        self._alarms = config.confirm_alarms
        self._window = config.confirm_window
        self._latch = config.latch
        self._clean_time = round(config.clean_time * 1e9)
        self.faulty: Mask = np.zeros(n, dtype=bool)
        self.ambiguous: Mask = np.zeros(n, dtype=bool)
        self.reasons: list[Reason] = [Reason.NONE] * n
        """Why each channel was declared."""
        self._last_bad: Stamps = np.zeros(n, dtype=np.int64)
        self._clean = np.zeros((2, n), dtype=np.int64)
        self._mean_limit = RETURN_MEAN * noise_std / _QUANTUM
        self._last_doubt = np.int64(0)
        self._checked: Mask = np.zeros((self._window - 1, n), dtype=bool)
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

    def judge(self, stamp: Stamps, verdict: Verdict, condition: NDArray[np.uint8], seen: Seen) -> Judgement:
        """Judge N samples without remembering them.

        Parameters
        ----------
        stamp
            (N,) ns.
        verdict
            Of the detector on the channels not declared faulty.
        condition
            (N, n) Condition of each value.
        seen
            What else was seen of them.
        """
        named_now = verdict.suspects & ~self.faulty
        suspects: Mask = np.vstack([self._suspects, named_now])
        counted: Mask = np.vstack([self._counted, named_now & ~seen.held[:, None]])
        isolated: Mask = np.concatenate([self._isolated, verdict.isolated])
        checked: Mask = np.vstack([self._checked, seen.checked])
        faulty, undecided = self._confirmed(counted, isolated)
        broken = (condition == _NON_FINITE) & ~self.faulty
        last_bad, clean = self._clean_since(stamp, seen)
        doubt = named_now.any(axis=1) | np.isnan(verdict.statistic) | seen.interrupted
        last_doubt = np.maximum.accumulate(np.where(doubt, stamp, self._last_doubt))
        returns, clears = self._returns(stamp, last_bad, clean, last_doubt)
        news = (faulty | broken | (undecided & ~self.ambiguous) | returns).any(axis=1) | clears
        row = int(news.argmax()) if news.any() else len(stamp)
        after, unsure = self.faulty.copy(), self.ambiguous.copy()
        if row < len(stamp):
            after = (after | faulty[row] | broken[row]) & ~returns[row]
            # A set of which a member is now known to be faulty is explained by it.
            explained = bool((unsure & (faulty | broken)[row]).any()) or bool(clears[row])
            unsure = (np.zeros_like(unsure) if explained else unsure | undecided[row]) & ~after
        suspicion = _rolling(suspects, self._window) > 0
        vouched = _rolling(checked, self._window) >= self._alarms
        return Judgement(
            suspicion, row, after, unsure, suspects, counted, isolated, checked, vouched, last_bad, clean, last_doubt
        )

    def commit(self, judgement: Judgement, rows: int, condition: NDArray[np.uint8], repeats: Mask) -> bool:
        """Remember the first rows of a judgement; return whether that changed what is declared.

        `repeats` (n,): the channel's value at the last of these rows is one that it has repeated for long.
        """
        kept = slice(rows, rows + self._window - 1)
        self._suspects, self._counted = judgement.suspects[kept].copy(), judgement.counted[kept].copy()
        self._isolated, self._checked = judgement.isolated[kept].copy(), judgement.checked[kept].copy()
        self._last_bad, self._clean = judgement.last_bad[rows - 1].copy(), judgement.clean[:, rows - 1].copy()
        self._last_doubt = judgement.last_doubt[rows - 1]
        if judgement.change != rows - 1:
            return False
        for i in np.flatnonzero(judgement.faulty & ~self.faulty):
            lasting = condition[rows - 1, i] == _NON_FINITE
            self.reasons[i] = Reason.NON_FINITE if lasting else Reason.STUCK if repeats[i] else Reason.DISAGREES
        for i in np.flatnonzero(self.faulty & ~judgement.faulty):
            self.reasons[i] = Reason.NONE
        self.faulty, self.ambiguous = judgement.faulty, judgement.ambiguous
        self._forget_window()
        return True

    def unvouch(self) -> None:
        """Forget that samples were checked."""
        self._checked = np.zeros_like(self._checked)

    def steady(self, checked: Mask) -> bool:
        """Whether all samples remembered were checked just like this one (n,): one more of them changes nothing."""
        return bool((self._checked == checked).all())

    def _confirmed(self, counted: Mask, isolated: Mask) -> tuple[Mask, Mask]:
        """(N, n): channels declared faulty by the alarms of each window, and sets one of which is."""
        named = _rolling(counted, self._window)
        faulty = (named >= self._alarms) & (_rolling(counted & isolated[:, None], self._window) >= self._half)
        alarms = np.logical_or.reduce(counted, axis=1, keepdims=True)
        undecided = self._undecided(named, _rolling(alarms, self._window))
        # Named alone by most alarms, though never called isolated: there is no other channel to confuse it with.
        alone = undecided & (undecided.sum(axis=1) == 1)[:, None] & (named >= self._alarms)
        faulty |= alone
        return faulty, undecided & ~faulty.any(axis=1, keepdims=True)

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

    def _clean_since(self, stamp: Stamps, seen: Seen) -> tuple[Stamps, NDArray[np.int64]]:
        """(N, n) last sample at which a declared channel disagreed, (2, N, n) sum and number of its errors since."""
        if self._latch or not self.faulty.any():
            last_bad = np.broadcast_to(stamp[:, None], seen.agrees.shape)
            return last_bad, np.zeros((2, *seen.agrees.shape), dtype=np.int64)
        bad = ~seen.agrees | seen.interrupted[:, None]
        rows = np.maximum.accumulate(np.where(bad, np.arange(len(stamp))[:, None], -1), axis=0)
        last_bad = np.where(rows >= 0, stamp[rows], self._last_bad)
        # Whole numbers: the sum must not depend on where the stream is cut.
        error = np.where(bad, 0.0, np.clip(np.where(bad, 0.0, seen.error), -1e3, 1e3))
        steps = np.stack([np.rint(error / _QUANTUM).astype(np.int64), (~bad).astype(np.int64)])
        total = np.cumsum(steps, axis=1)
        base = np.where(rows >= 0, np.take_along_axis(total, np.maximum(rows, 0)[None], axis=1), -self._clean[:, None])
        return last_bad, total - base

    def _returns(
        self, stamp: Stamps, last_bad: Stamps, clean: NDArray[np.int64], last_doubt: Stamps
    ) -> tuple[Mask, Mask]:
        """(N, n) channels that return, (N,) whether an ambiguous set is cleared."""
        if self._latch:
            return np.zeros(last_bad.shape, dtype=bool), np.zeros(len(stamp), dtype=bool)
        small = np.abs(clean[0]) <= self._mean_limit * clean[1]
        returns: Mask = self.faulty & (stamp[:, None] - last_bad >= self._clean_time) & small
        clears: Mask = self.ambiguous.any() & (stamp - last_doubt >= self._clean_time)
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
