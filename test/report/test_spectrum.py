# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The spectrum on a page: its level, its lines, what may be folded, and pieces without a gap."""

from __future__ import annotations

import numpy as np
import pytest

from fdi_ros.report.spectrum import Spectrum

pytest.importorskip("scipy", reason="SciPy is not installed (extra: calibrate)")
RATE, STD = 100.0, 0.01


def noise(samples: int) -> np.ndarray:
    return np.random.default_rng(5).normal(0.0, STD, (samples, 2))


def spectrum(*parts: np.ndarray) -> Spectrum:
    made = Spectrum(("a", "b"), RATE)
    for part in parts:
        made.add(part)
    return made


def curves(made: Spectrum) -> list[np.ndarray]:
    section = made.section()
    assert section is not None
    return [np.array(trace["y"]) for trace in section.figures[0]["data"]]


def test_white_noise_has_the_level_of_its_variance_however_the_stream_is_cut():
    values = noise(40_000)
    whole, cut = curves(spectrum(values)), curves(spectrum(*np.array_split(values, 37)))
    for one, other in zip(whole, cut, strict=True):
        assert np.sqrt(np.mean(one**2)) == pytest.approx(STD * np.sqrt(2 / RATE), rel=0.02)
        assert one == pytest.approx(other, rel=0.5)
        assert np.mean(one) == pytest.approx(np.mean(other), rel=0.02)


def test_a_line_is_told_with_what_it_would_be_if_it_were_folded():
    values = noise(8000)
    values[:, 1] += 0.03 * np.sin(2 * np.pi * 143.0 * np.arange(8000) / RATE)
    section = spectrum(values).section()
    assert section is not None
    assert "Lines stand out at 43 Hz (57 Hz if folded)." in section.hint
    assert "white noise, or vibration beyond it that is folded down" in section.hint
    slow = np.cumsum(noise(8000), axis=0)
    section = spectrum(slow).section()
    assert section is not None
    assert "Lines stand out" not in section.hint
    assert "folded" not in section.hint


def test_a_channel_that_gives_nothing_leaves_the_others():
    values = noise(4000)
    values[1000:, 0] = np.nan
    first, second = curves(spectrum(values))
    assert np.isfinite(first).all()
    assert np.isfinite(second).all()
    values[:] = np.nan
    assert spectrum(values).section() is None
