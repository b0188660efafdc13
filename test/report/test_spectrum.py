# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Spectrum of a page: Welch's method against SciPy's, and the lines that are named."""

import sys

import numpy as np
import pytest

from fdi_ros.report.spectrum import PIECE, Spectrum, _welch


@pytest.mark.parametrize("samples", [PIECE, PIECE + 100, 5 * PIECE])
def test_the_density_is_that_of_scipy(samples: int) -> None:
    from scipy.signal import welch

    values = np.cumsum(np.random.default_rng(3).normal(size=(samples, 4)), axis=0)
    _, power = welch(values, 200.0, nperseg=PIECE, axis=0, detrend="linear")
    np.testing.assert_allclose(_welch(values, 200.0), power, rtol=1e-9)


def test_lines_are_named_without_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("scipy", "scipy.signal", "scipy.ndimage"):
        monkeypatch.setitem(sys.modules, name, None)
    time = np.arange(20 * PIECE) / 200.0
    values = np.random.default_rng(4).normal(0.0, 0.01, (len(time), 2))
    values[:, 0] += 0.02 * np.sin(2.0 * np.pi * 31.25 * time)
    spectrum = Spectrum(("imu_1.x", "imu_1.y"), 200.0)
    spectrum.add(values)
    section = spectrum.section()
    assert section is not None
    words = "Lines stand out at 31.2 Hz (169 Hz if folded). It does not fall off"
    assert words in section.hint
