# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers in sentences."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.system.text import figures, percent


@given(st.floats(1e-3, 1e12), st.integers(2, 6))
def test_a_number_in_a_sentence_has_no_exponent_and_its_digits(value, digits):
    written = figures(value, digits)
    assert "e" not in written
    assert abs(float(written) / value - 1.0) <= 0.5 * 10.0 ** (1 - digits)
    assert float(figures(-value, digits)) == -float(written)
    assert figures(value, digits, "+") == f"+{written}"


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.0, "0 %"),
        (3e-5, "below 0.01 %"),
        (0.0004, "0.04 %"),
        (0.004, "0.4 %"),
        (0.005, "0.5 %"),
        (0.006, "1 %"),
        (0.514, "51 %"),
        (0.992, "99 %"),
        (0.995, "99.5 %"),
        (0.9968, "99.7 %"),
        (0.99999, "above 99.99 %"),
        (1.0, "100 %"),
        (1.04, "104 %"),
        (None, "-"),
        (float("nan"), "-"),
    ],
)
def test_only_none_and_all_are_0_and_100_percent(share, words):
    assert percent(share) == words
