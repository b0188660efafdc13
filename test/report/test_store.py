# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decimation that loses no spike."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.report.layout import FINE, PageStore


def fed(time, values, most, cuts):
    store = PageStore(dict.fromkeys("abc"[: values.shape[1]], FINE), most)
    edges = sorted({0, len(time), *(min(cut, len(time)) for cut in cuts)})
    for first, last in itertools.pairwise(edges):
        store.add(time[first:last], values[first:last])
    return store


@given(
    rows=st.integers(1, 400),
    most=st.integers(2, 40),
    cuts=st.lists(st.integers(0, 400), max_size=8),
    seed=st.integers(0, 99),
)
def test_every_value_lies_within_its_span_and_every_extreme_is_reached(rows, most, cuts, seed):
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(0.1, 1, rows))
    values = random.normal(size=(rows, 3))
    values[random.random(rows) < 0.2, 1] = np.nan
    start, low, high = fed(time, values, most, cuts).spans()
    assert len(start) <= most + 1
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


def test_what_fits_is_kept_as_it_is():
    time, values = np.arange(50.0), np.random.default_rng(0).normal(size=(50, 2))
    start, low, high = fed(time, values, 50, [7, 20]).spans()
    np.testing.assert_array_equal(start, time)
    np.testing.assert_array_equal(low, values)
    np.testing.assert_array_equal(high, values)
