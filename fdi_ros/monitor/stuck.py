"""A value that repeats while the others see motion along its axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fdi_ros.detectors.base import Verdict

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Stamps = NDArray[np.int64]

MOTION = 6.0
"""Motion that counts against a repeated value, in standard deviations of the difference between channel and others."""


class Stuck:
    """Compares what the other channels predict with what they predicted when the present value was first seen.

    The others vouch for the motion only if they agree among themselves: in a sample whose alarm names any channel
    but this one, nothing is held against it. So a fault of another channel never makes a quantised sensor at rest
    look stuck, and of two parallel channels neither is called stuck on the word of the other.

    Parameters
    ----------
    noise_std
        (n,) rad/s.
    stuck_time
        Time for which a value must repeat, s; 0: never stuck.
    """

    def __init__(self, noise_std: Array, stuck_time: float) -> None:
        self._noise_std = noise_std
        self._time = round(stuck_time * 1e9)
        self._reference = np.full(len(noise_std), np.nan)

    def repeats(self, stamp: Stamps, run_stamp: Stamps) -> Mask:
        """(N, n): the value has been the same for the stuck time."""
        repeated: Mask = stamp[:, None] - run_stamp >= self._time
        return repeated if self._time else np.zeros_like(repeated)

    def inspect(
        self, stamp: Stamps, run_stamp: Stamps, prediction: Array, sensitivity: Array, usable: Mask, verdict: Verdict
    ) -> tuple[Mask, Array]:
        """Evidence (N, n) that a channel is stuck, and the predictions (N, n) at the start of each run of values.

        Parameters
        ----------
        stamp
            (N,) ns.
        run_stamp
            (N, n) when the present value was first seen, ns.
        prediction
            (N, n) what the other channels, without those under alarm, say of each; NaN where they cannot.
        sensitivity
            (N, n) what of a channel's own error stays in its residual; 0: it took no part in the prediction.
        usable
            (N, n)
        verdict
            Of the detector.
        """
        rows = np.arange(len(stamp))[:, None]
        start = np.maximum.accumulate(np.where(run_stamp == stamp[:, None], rows, -1), axis=0)
        reference = np.where(start >= 0, np.take_along_axis(prediction, start, axis=0), self._reference)
        repeats = self.repeats(stamp, run_stamp) & usable
        if not repeats.any():
            return repeats, reference
        spread = self._noise_std / np.sqrt(np.where(sensitivity > 0, sensitivity, 0.5))
        moved = np.abs(prediction - reference) > MOTION * spread
        alone = verdict.suspects & verdict.isolated[:, None]
        return repeats & moved & (alone | ~verdict.alarm[:, None]), reference

    def commit(self, reference: Array) -> None:
        """Remember the reference (n,) after the last sample."""
        self._reference = reference.copy()

    def pass_over(self, started: Mask, prediction: Array) -> None:
        """Remember one sample (n,) in which some values were new."""
        self._reference = np.where(started, prediction, self._reference)

    def forget(self) -> None:
        """Begin anew: the predictions so far were made with another bias."""
        self._reference = np.full_like(self._reference, np.nan)


def with_stuck(verdict: Verdict, evidence: Mask, residual: Array) -> Verdict:
    """Return the verdict that names stuck channels as well; statistic and alarm stay the detector's."""
    if not evidence.any():
        return verdict
    only = evidence.any(axis=1) & ~verdict.alarm
    return verdict._replace(
        suspects=verdict.suspects | evidence,
        isolated=verdict.isolated | only,
        error=np.where(evidence & (verdict.error == 0), residual, verdict.error),
    )
