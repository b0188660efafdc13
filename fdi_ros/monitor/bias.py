"""Bias of each channel: fixed, or averaged over a first time at rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fdi_ros.errors import ConfigError
from fdi_ros.settings import BiasConfig

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

REST_NOISE = 4.0
"""At rest the standard deviation of a channel is at most this many noise_std."""

LEAST_ROWS = 10
"""Samples that an average takes at least."""

# Sums of fixed-point numbers do not depend on where the stream is cut. A quantum of 2^-32 rad/s is far below any
# gyro's, and 600 s at 10 kHz of 1000 rad/s still fit.
_QUANTUM = 2.0**-32
_SQUARE_QUANTUM = 2.0**-20


class BiasLearner:
    """Averages each channel over a time at rest; a time that was not at rest is refused and a new one begun.

    Parameters
    ----------
    config
        Duration and what counts as rest.
    noise_std
        (n,) rad/s.
    names
        Of the channels.
    """

    def __init__(self, config: BiasConfig, noise_std: Array, names: Sequence[str]) -> None:
        n = len(noise_std)
        self._names = names
        if len(config.fixed) not in (0, n):
            raise ConfigError(f"bias.fixed has {len(config.fixed)} values, expected {n} (one a channel)")
        self.bias = np.array(config.fixed, dtype=np.float64) if config.fixed else np.zeros(n)
        self._duration = round(config.startup_bias_duration * 1e9)
        self._max_rate = config.max_rest_rate
        self._max_std = REST_NOISE * noise_std
        self.learning = self._duration > 0
        self.known: Mask = np.ones(n, dtype=bool)
        """(n,): the bias of the channel is known; one that was silent or restless while the others were averaged is
        left out until the bias is learned anew."""
        self.words = "learning" if self.learning else ("fixed" if config.fixed else "zero")
        self._begin(None)

    def restart(self) -> None:
        """Learn anew; without a duration in the configuration, over two seconds."""
        self._duration = self._duration or 2_000_000_000
        self.learning, self.words = True, "learning"
        self._begin(None)

    def take(self, stamp: NDArray[np.int64], z: Array, good: Mask, lost: Mask) -> int:
        """Take samples until the bias is learned.

        Parameters
        ----------
        stamp
            (N,) ns.
        z
            (N, n) rad/s, as delivered.
        good
            (N, n): finite and in range.
        lost
            (n,): declared faulty or taken out; says nothing about rest, and keeps its bias.

        Returns
        -------
        How many rows were used up: N, or fewer when the bias is learned within them.
        """
        taken = 0
        while taken < len(stamp) and self.learning:
            if self._start is None:
                self._begin(int(stamp[taken]))
            assert self._start is not None
            end = int(np.searchsorted(stamp, self._start + self._duration))
            self._add(z[taken:end], good[taken:end])
            taken = max(end, taken)
            if end < len(stamp):
                self._conclude(lost)
        return taken

    def _begin(self, start: int | None) -> None:
        n = len(self.bias)
        self._start = start
        self._count = np.zeros(n, dtype=np.int64)
        self._total = np.zeros(n, dtype=np.int64)
        self._squares = np.zeros(n, dtype=np.int64)
        self._rows = 0

    def _add(self, z: Array, good: Mask) -> None:
        value = np.where(good, z, 0.0)
        self._rows += len(z)
        self._count += good.sum(axis=0)
        self._total += np.rint(np.clip(value, -1e3, 1e3) / _QUANTUM).astype(np.int64).sum(axis=0)
        # Beyond 1 rad/s it is no rest whatever the exact figure; clipping keeps the sum of squares within 64 bits.
        steps = np.rint(np.clip(value, -1, 1) / _SQUARE_QUANTUM).astype(np.int64)
        self._squares += (steps * steps).sum(axis=0)

    def _conclude(self, lost: Mask) -> None:
        """Accept the time as rest and set the bias, or say why not and begin again."""
        count = np.maximum(self._count, 1)
        mean = self._total * _QUANTUM / count
        std = np.sqrt(np.maximum(self._squares * _SQUARE_QUANTUM**2 / count - mean * mean, 0.0))
        heard = (self._count * 2 > self._rows) & ~lost
        calm = heard & (np.abs(mean) <= self._max_rate) & (std <= self._max_std)
        restless = heard & ~calm
        # One channel that does not look at rest is a bad channel; if more do, the vehicle moves.
        if restless.sum() <= 1 and calm.sum() >= 3 and self._rows >= LEAST_ROWS:
            self.bias = np.where(calm, mean, self.bias)
            self.known = calm | lost
            missed = [self._names[i] for i in np.flatnonzero(~self.known).tolist()]
            self.learning = False
            self.words = f"learned, but not of {', '.join(missed)}" if missed else "learned"
            return
        self.words = self._refusal(heard, restless, mean, std)
        self._begin(None)

    def _refusal(self, heard: Mask, restless: Mask, mean: Array, std: Array) -> str:
        if not restless.any():
            return f"refused: {heard.sum()} channels gave {self._rows} samples, expected 3 and {LEAST_ROWS} at least"
        worst = int(np.argmax(np.where(restless, np.abs(mean) / self._max_rate + std / self._max_std, 0)))
        return (
            f"refused, not at rest: {self._names[worst]} had mean {mean[worst]:.3g} rad/s (at most {self._max_rate:g})"
            f" and standard deviation {std[worst]:.3g} rad/s (at most {self._max_std[worst]:.3g})"
        )
