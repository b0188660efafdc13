# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Long series on a page: decimation loses no spike; the spectrum has its level, its lines, and what may be folded."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.report.layout import FINE, PageStore
from fdi_ros.report.spectrum import Spectrum

RATE, STD = 100.0, 0.01


def noise(samples):
    return np.random.default_rng(5).normal(0.0, STD, (samples, 2))


def spectrum(*parts):
    pytest.importorskip("scipy", reason="SciPy is not installed (extra: calibrate)")
    made = Spectrum(("a", "b"), RATE)
    for part in parts:
        made.add(part)
    return made


def curves(made):
    section = made.section()
    assert section is not None
    return [np.array(trace["y"]) for trace in section.figures[0]["data"]]


def test_white_noise_has_the_level_of_its_variance_however_the_stream_is_cut():
    values = noise(40_000)
    whole, cut = curves(spectrum(values)), curves(spectrum(*np.array_split(values, 37)))
    for one, other in zip(whole, cut, strict=True):
        assert np.sqrt(np.mean(one**2)) == pytest.approx(
            STD * np.sqrt(2 / RATE), rel=0.02
        )
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


@given(
    rows=st.integers(1, 400),
    most=st.integers(2, 40),
    cuts=st.lists(st.integers(0, 400), max_size=8),
    seed=st.integers(0, 99),
)
def test_every_value_lies_within_its_span_and_every_extreme_is_reached(
    rows, most, cuts, seed
):
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(0.1, 1, rows))
    values = random.normal(size=(rows, 3))
    values[random.random(rows) < 0.2, 1] = np.nan
    store = PageStore(dict.fromkeys("abc", FINE), most)
    for first, last in itertools.pairwise(
        sorted({0, rows, *(min(cut, rows) for cut in cuts)})
    ):
        store.add(time[first:last], values[first:last])
    start, low, high = store.spans()
    assert len(start) <= most + 1
    if rows <= most:
        # What fits is kept as it is.
        np.testing.assert_array_equal(start, time)
    assert (np.diff(start) > 0).all()
    span = np.searchsorted(start, time, side="right") - 1
    for k in range(len(start)):
        inside = values[span == k]
        for column in range(3):
            finite = inside[np.isfinite(inside[:, column]), column]
            if len(finite):
                assert (low[k, column], high[k, column]) == (finite.min(), finite.max())
            else:
                assert np.isnan(low[k, column])
                assert np.isnan(high[k, column])
