# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Spectrum of what channels differ by from the others: where vibration is, and what of it may be folded down.

Welch's method over pieces without a gap, in bounded memory. What vibrates faster than half the sample rate is sampled
as something slower: it cannot be told from a true line there, only be warned of.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fdi_ros.model.samples import Array
from fdi_ros.report.layout import RADIANS, Section, Unit, colour_of, drawn

PIECE = 512  # samples of one of the spectra that are averaged
AT_ONCE = 16 * PIECE  # samples of which spectra are taken at once
AROUND = 31  # frequencies whose median is the baseline next to a line
STANDS_OUT = (
    4.0  # a line has so many times the amplitude density that is usual next to it
)
FLAT = 0.8  # what has more than this share of the usual amplitude density at half the sample rate goes on beyond it
MOST_LINES = 3


class Spectrum:
    """Amplitude density of n channels, averaged over a stream of ``rate`` samples per second."""

    def __init__(self, names: Sequence[str], rate: float) -> None:
        self._names, self._rate = names, rate
        self._waiting = np.empty((0, len(names)))
        """Samples of which none is averaged yet, but for half a piece: all of the same channels."""
        self._power, self._weight = (
            np.zeros((PIECE // 2 + 1, len(names))),
            np.zeros(len(names)),
        )

    def add(self, values: Array) -> None:
        """Take in the next samples (N, n), rad/s; where a channel begins or ends to be missing a new piece begins."""
        values = np.vstack([self._waiting, values])
        there = np.isfinite(values)
        cuts = np.flatnonzero((there[1:] != there[:-1]).any(axis=1)) + 1
        for piece in np.split(values, cuts):
            self.begin_stretch()
            self._waiting = piece
        while len(self._waiting) >= AT_ONCE:
            self._average(self._waiting[:AT_ONCE])
            self._waiting = self._waiting[AT_ONCE - PIECE // 2 :]

    def begin_stretch(self) -> None:
        """Note that the next sample does not follow the last one."""
        if len(self._waiting) >= PIECE:
            self._average(self._waiting)
        self._waiting = self._waiting[:0]

    def section(self, unit: Unit = RADIANS) -> Section | None:
        """Draw it, and say where it stands out; None: no piece was long enough."""
        self.begin_stretch()
        known = np.flatnonzero(self._weight).tolist()
        if not known:
            return None
        frequency = np.fft.rfftfreq(PIECE, 1.0 / self._rate)[1:]
        density = np.sqrt(self._power[1:, known] / self._weight[known]) * unit.factor
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
        """Say where lines stand out (the density is without that at 0 Hz), and what of it may be folded."""
        # Imported here: readers of recordings do not need it.
        from scipy.ndimage import median_filter
        from scipy.signal import find_peaks

        half, step = self._rate / 2, self._rate / PIECE
        around = median_filter(density, size=(AROUND, 1), mode="nearest")
        peaks, about = find_peaks((density / around).max(axis=1), height=STANDS_OUT)
        found = [
            (peaks[k] + 1) * step
            for k in np.argsort(-about["peak_heights"])[:MOST_LINES]
        ]
        words = []
        if found:
            lines = ", ".join(
                f"{at:.3g} Hz ({self._rate - at:.3g} Hz if folded)" for at in found
            )
            words.append(f"Lines stand out at {lines}.")
        if (around[-1] > FLAT * np.median(density, axis=0)).any():
            words.append(
                f"It does not fall off towards {half:.3g} Hz, half the sample rate: that is white noise, or vibration"
                " beyond it that is folded down into this picture. A recording at a higher rate tells which."
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
