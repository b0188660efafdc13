# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a monitor publishes, as bytes: those that rosbags makes of the same message."""

from __future__ import annotations

import numpy as np
import pytest
from bag.recordings import STORE
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor.streams import output_of

from fdi_ros.monitor.diagnostics import DIAGNOSTICS, Level, StatusLine, encode_diagnostics
from fdi_ros.monitor.output import FUSED, INTEGRITY, OUTPUTS, Encoder

texts = st.text(st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=9)
lines = st.builds(
    StatusLine, st.sampled_from(Level), texts, texts, texts, st.lists(st.tuples(texts, texts), max_size=3).map(tuple)
)


@settings(max_examples=60)
@given(st.lists(lines, max_size=3), st.integers(0, 2**31 * 10**9 - 10**9))
def test_diagnostics_are_the_bytes_of_rosbags(drawn: list[StatusLine], now: int) -> None:
    data = encode_diagnostics(drawn, now).data
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
    stamp = STORE.deserialize_cdr(encode_diagnostics([], now).data, DIAGNOSTICS.type).header.stamp
    assert stamp.sec == (0 if now < 0 else 2**31 - 1)


def test_a_sample_gives_a_rate_where_there_is_one_and_always_its_integrity() -> None:
    covariance = np.arange(18.0).reshape(2, 3, 3)
    output = output_of(
        4,
        stamp=[10**9, 2 * 10**9],
        rate=[[1.0, 2.0, 3.0], [np.nan] * 3],
        covariance=covariance + covariance.transpose(0, 2, 1),
        valid=[True, False],
        statistic=[0.5, np.nan],
        threshold=[7.0, np.nan],
        state=[[0, 1, 2, 3], [4, 5, 6, 0]],
        level=[[0.1, 0.2, 0.3], [np.inf] * 3],
    )
    messages = list(Encoder("body", 4).encode(output, 10**8))
    assert [(message.topic, message.stamp) for message in messages] == [
        *((output.topic, 10**9) for output in OUTPUTS),
        *((output.topic, 2 * 10**9) for output in OUTPUTS if not output.needs_rate),
    ]
    read = [(message.topic, STORE.deserialize_cdr(message.data, message.topic.type)) for message in messages]
    (fused,) = [said for topic, said in read if topic is FUSED.topic]
    integrity = [said for topic, said in read if topic is INTEGRITY.topic]
    assert (fused.header.frame_id, fused.header.stamp.sec, fused.header.stamp.nanosec) == ("body", 0, 900_000_000)
    np.testing.assert_array_equal(fused.angular_velocity_covariance, output.covariance[0].ravel())
    np.testing.assert_array_equal(integrity[0].data, [0.5, 7.0, 0, 1, 2, 3, 0.1, 0.2, 0.3])
    np.testing.assert_array_equal(integrity[1].data, [np.nan, np.nan, 4, 5, 6, 0, *[np.inf] * 3])
