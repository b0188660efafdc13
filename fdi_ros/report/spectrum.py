# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Spectrum of the difference of each channel from the others, which shows vibration and aliasing.

Welch's method over pieces without a gap, in bounded memory. Vibration above half the sample rate is
aliased to a lower frequency. The spectrum cannot distinguish the two and only warns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdi_ros.model.samples import Array
from fdi_ros.report.layout import RADIANS, Section, Unit, colour_of, drawn
from fdi_ros.system.text import figures

PIECE = 512
"""Samples of each averaged spectrum."""
SAMPLES_AT_ONCE = 16 * PIECE
"""Samples that are transformed at once."""
LINE_HEIGHT = 4.0
"""Smallest ratio of a line to its baseline."""


class Spectrum:
    """Amplitude density of n channels, averaged over a stream of ``rate`` samples per second."""

    def __init__(self, names: Sequence[str], rate: float) -> None:
        self._names = names
        self._rate = rate
        self._waiting = np.empty((0, len(names)))
        """Samples that are not averaged yet, all of the same channels, and half a piece that is."""
        self._power = np.zeros((PIECE // 2 + 1, len(names)))
        self._weight = np.zeros(len(names))

    def add(self, values: Array) -> None:
        """Add samples (N, n), rad/s. A new piece begins if a channel disappears or returns."""
        values = np.vstack([self._waiting, values])
        there = np.isfinite(values)
        changes = (there[1:] != there[:-1]).any(axis=1)
        cuts = np.flatnonzero(changes) + 1
        for piece in np.split(values, cuts):
            self.begin_stretch()
            self._waiting = piece
        while len(self._waiting) >= SAMPLES_AT_ONCE:
            self._average(self._waiting[:SAMPLES_AT_ONCE])
            self._waiting = self._waiting[SAMPLES_AT_ONCE - PIECE // 2 :]

    def begin_stretch(self) -> None:
        """Begin a new piece at a gap."""
        if len(self._waiting) >= PIECE:
            self._average(self._waiting)
        self._waiting = self._waiting[:0]

    def section(self, unit: Unit = RADIANS) -> Section | None:
        """Draw the spectrum and name its lines. None: no piece was long enough."""
        self.begin_stretch()
        known = np.flatnonzero(self._weight).tolist()
        if not known:
            return None
        frequency = np.fft.rfftfreq(PIECE, 1.0 / self._rate)[1:]
        power = self._power[1:, known] / self._weight[known]
        density = np.sqrt(power) * unit.factor
        data = [
            {
                "type": "scatter",
                "mode": "lines",
                "name": self._names[i],
                "x": np.round(frequency, 4).tolist(),
                "y": list(map(drawn, density[:, k])),
                "line": {"color": colour_of(i), "width": 1.2},
            }
            for k, i in enumerate(known)
        ]
        layout = {
            "height": 320,
            "xaxis": {
                "title": {"text": "frequency, Hz"},
                "range": [0.0, self._rate / 2],
            },
            "yaxis": {
                "type": "log",
                "title": {"text": f"residual, {unit.name} per sqrt(Hz)"},
            },
        }
        hint = "Of each channel's residual: what it differs by from the fused rate."
        figure = {"data": data, "layout": layout}
        return Section(
            "Spectrum of the differences",
            f"{hint} {self._words(density)}",
            "",
            [figure],
        )

    def _words(self, density: Array) -> str:
        """Name the lines and likely aliases. ``density``: without 0 Hz."""
        # Imported late, because most users do not need SciPy.
        from scipy.ndimage import median_filter
        from scipy.signal import find_peaks

        half = self._rate / 2
        step = self._rate / PIECE
        # The median of 31 frequencies is the baseline of a line.
        around = median_filter(density, size=(31, 1), mode="nearest")
        peaks, about = find_peaks((density / around).max(axis=1), height=LINE_HEIGHT)
        highest = np.argsort(-about["peak_heights"])[:3]
        found = [(peaks[k] + 1) * step for k in highest]
        words = []
        if found:
            lines = ", ".join(
                f"{figures(at)} Hz ({figures(self._rate - at)} Hz if folded)"
                for at in found
            )
            words.append(f"Lines stand out at {lines}.")
        # Aliasing is likely from 0.8 of the usual density on.
        if (around[-1] > 0.8 * np.median(density, axis=0)).any():
            words.append(
                f"It does not fall off towards {figures(half)} Hz, half the sample rate: that is white noise, or"
                " vibration beyond it that is folded down into this picture. A recording at a higher rate tells which."
            )
        return " ".join(words)

    def _average(self, values: Array) -> None:
        from scipy.signal import welch

        known = np.isfinite(values[0])
        if known.any():
            weight = len(values) * 2 // PIECE - 1
            power = welch(
                values[:, known], self._rate, nperseg=PIECE, axis=0, detrend="linear"
            )[1]
            self._power[:, known] += weight * power
            self._weight[known] += weight
