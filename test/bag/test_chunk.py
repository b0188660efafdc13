# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Records in a run of bytes: those that a plain reading of the format finds, however the bytes are damaged."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.bag.mcap_file import CHANNEL, CHUNK, FOOTER, MESSAGE, SCHEMA, STATISTICS, walk

contents = st.one_of(st.binary(max_size=40), st.binary(min_size=22, max_size=60))
records = st.lists(
    st.tuples(st.sampled_from([SCHEMA, CHANNEL, MESSAGE, MESSAGE, MESSAGE, 0x0F]), contents), max_size=20
)
lengths = st.sampled_from([0, 21, 2**31, 2**62, 2**63 - 1, 2**63, 2**64 - 1])


def plainly_read(data: bytes, outside: bool):
    """Messages (channel, log time, content), schemas and channels (opcode, content), and the end, record by record."""
    messages, topics, at = [], [], 0
    while at + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, at)
        if at + 9 + length > len(data) or (outside and opcode in (CHUNK, STATISTICS, FOOTER)):
            break
        content = data[at + 9 : at + 9 + length]
        if opcode == MESSAGE and length >= 22:
            channel, _, log_time = struct.unpack_from("<HIq", content)
            messages.append((channel, log_time, content[22:]))
        elif opcode in (SCHEMA, CHANNEL):
            topics.append((opcode, content))
        at += 9 + length
    return messages, topics, at


@given(records, st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 7)), max_size=4), lengths, st.data())
def test_records_are_those_of_a_plain_reading(drawn, flips, absurd, more):
    data = bytearray(b"".join(struct.pack("<BQ", opcode, len(content)) + content for opcode, content in drawn))
    for byte, bit in flips if data else ():
        data[byte % len(data)] ^= 1 << bit
    if len(data) >= 9 and more.draw(st.booleans()):
        struct.pack_into("<Q", data, 1, absurd)
    data = bytes(data[: more.draw(st.integers(0, len(data)))])
    for outside in (False, True):
        found = walk(data, outside)
        rows = zip(found.channel.tolist(), found.log_time.tolist(), found.offset, found.length, strict=True)
        messages = [(channel, time, data[start : start + size]) for channel, time, start, size in rows]
        assert (messages, found.topics, found.end) == plainly_read(data, outside)
