# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers in sentences."""

from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.system.text import figures


@given(st.floats(1e-3, 1e12), st.integers(2, 6))
def test_a_number_in_a_sentence_has_no_exponent_and_its_digits(value, digits):
    written = figures(value, digits)
    assert "e" not in written
    assert abs(float(written) / value - 1.0) <= 0.5 * 10.0 ** (1 - digits)
    assert float(figures(-value, digits)) == -float(written)
    assert figures(value, digits, "+") == f"+{written}"
