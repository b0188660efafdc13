# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a monitor publishes, as bytes: those that rosbags makes of the same message."""

from __future__ import annotations

import pytest
from bag.recordings import STORE
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.monitor.diagnostics import DIAGNOSTICS, Level, StatusLine, encode_diagnostics

texts = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=9)
lines = st.builds(
    StatusLine, st.sampled_from(Level), texts, texts, texts, st.lists(st.tuples(texts, texts), max_size=3).map(tuple)
)


@settings(max_examples=60)
@given(st.lists(lines, max_size=3), st.integers(0, 2**31 * 10**9 - 10**9))
def test_diagnostics_are_the_bytes_of_rosbags(drawn: list[StatusLine], now: int) -> None:
    data = encode_diagnostics(drawn, now)
    message = STORE.deserialize_cdr(data, DIAGNOSTICS.type)
    assert bytes(STORE.serialize_cdr(message, DIAGNOSTICS.type)) == data
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == now
    read = [
        (one.level, one.name, one.message, one.hardware_id, tuple((kv.key, kv.value) for kv in one.values))
        for one in message.status
    ]
    assert read == [(one.level, one.name, one.message, one.hardware_id, one.values) for one in drawn]


@pytest.mark.parametrize("now", [-5, 2**40 * 10**9])
def test_a_time_that_no_header_holds_is_moved_to_its_end(now: int) -> None:
    stamp = STORE.deserialize_cdr(encode_diagnostics([], now), DIAGNOSTICS.type).header.stamp
    assert stamp.sec == (0 if now < 0 else 2**31 - 1)
