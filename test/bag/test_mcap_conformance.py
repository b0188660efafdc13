# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""MCAP files of every form that its specification allows.

The cases are those of the MCAP project's conformance suite, written here by its own library:
records of every kind, with and without chunks, indexes, summary, checksums and padding.
"""

import io
import itertools
import struct

import numpy as np
import pytest
from bag.recordings import IMU, START, imu, write_mcap
from mcap.writer import CompressionType, IndexType, Writer

from fdi_ros.bag.reader import Recording
from fdi_ros.errors import BagError

TOPIC = "/imu"
FEATURES = (
    "use_chunking",
    "use_statistics",
    "repeat_channels",
    "repeat_schemas",
    "use_summary_offsets",
    "enable_crcs",
    "enable_data_crcs",
)
INDEXES = (IndexType.NONE, IndexType.MESSAGE, IndexType.ALL)
CASES = {
    "no data": (),
    "one message": ("message",),
    "one attachment": ("attachment",),
    "one metadata": ("metadata",),
    "one message without schema": ("schemaless",),
    "ten messages": ("message",) * 10,
    "of everything": (
        *("metadata", "message", "attachment", "schemaless", "message", "attachment"),
        *("message", "metadata"),
    ),
}


def write(parts, options):
    """Return the bytes of a file with these parts, and its messages of the topic."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=700, **options)
    writer.start(profile="ros2", library="test")
    schema = writer.register_schema(IMU, "ros2msg", b"")
    channel = writer.register_channel(TOPIC, "cdr", schema, {"a": "b"})
    other = writer.register_channel("/other", "json", 0)
    sent = []
    for k, part in enumerate(parts):
        at = START + k * 1000
        if part == "attachment":
            writer.add_attachment(at, at, "file.txt", "text/plain", b"content")
        elif part == "metadata":
            writer.add_metadata("about", {"key": "value"})
        elif part == "schemaless":
            writer.add_message(other, at, b"{}", at, k)
        else:
            sent.append((at, imu(at, (0.1 * k, 0.0, 0.0))))
            writer.add_message(channel, *sent[-1], at, k)
    writer.finish()
    return out.getvalue(), sent


def padded(data):
    """The file with four bytes more at the end of every record, as a later version may have.

    Places and checksums that other records keep are no longer true.
    """
    out, at = [data[:8]], 8
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        content = data[at + 9 : at + 9 + length]
        # A message and a chunk end with data, a footer has a fixed place.
        extra = b"" if opcode in (0x02, 0x05, 0x06) else b"\1\2\3\4"
        out.append(struct.pack("<BQ", opcode, length + len(extra)) + content + extra)
        at += 9 + length
    return b"".join([*out, data[-8:]])


def read(path):
    """Messages of the topic, all topics, and what was noted."""
    with Recording(path) as recording:
        found = [
            (at, batch.message(k))
            for batch in recording.batches([TOPIC])
            for k, at in enumerate(batch.log_time.tolist())
        ]
        topics = {topic.name: topic.count for topic in recording.topics}
        return found, topics, recording.damage.report()


@pytest.mark.parametrize("compression", list(CompressionType), ids=lambda one: one.name)
@pytest.mark.parametrize("name", CASES)
def test_every_form_of_a_file_gives_its_messages(name, compression, tmp_path):
    """All options of the writer, each on and off: one at a time, and all at once."""
    path = tmp_path / "case.mcap"
    flags = [dict.fromkeys(FEATURES, True), dict.fromkeys(FEATURES, False)]
    flags += [{**flags[0], one: False} for one in FEATURES]
    flags += [{**flags[1], one: True} for one in FEATURES]
    for options, index in itertools.product(flags, INDEXES):
        chosen = {**options, "index_types": index, "compression": compression}
        data, sent = write(CASES[name], chosen)
        for content in (data, padded(data)):
            path.write_bytes(content)
            found, topics, damage = read(path)
            assert found == sent, chosen
            assert topics.get(TOPIC, 0) == len(sent)
            assert damage == ()


def test_a_file_of_another_version_is_refused(tmp_path):
    path = tmp_path / "case.mcap"
    data, _ = write(("message",), {})
    path.write_bytes(data.replace(b"\x89MCAP0", b"\x89MCAP1", 1))
    with pytest.raises(BagError, match="is not an MCAP file"):
        Recording(path)


# Other producers


TIMES = np.arange(0.0, 14.0, 0.02)


def ros1_imu(stamp, rate):
    """A sensor_msgs/Imu as ROS 1 serialises it."""
    head = struct.pack("<III", 7, stamp // 10**9, stamp % 10**9)
    frame = struct.pack("<I", 3) + b"imu"
    zeros = [0.0] * 9
    values = (0.0, 0.0, 0.0, 1.0, *zeros, *rate, *zeros, 0.0, 0.0, 0.0, *zeros)
    return head + frame + struct.pack("<37d", *values)


def produced(path, kind, schema, encoding, content, topic_by_topic=False, **options):
    """Write three units, the second one off by 0.3 rad/s about y from 10 s on."""
    random = np.random.default_rng(4)
    turn = 0.4 * np.sin(np.outer(TIMES, (0.7, 1.0, 2.0)))
    turn *= np.clip(TIMES - 4.0, 0.0, 1.0)[:, None]
    messages = []
    for k in range(3):
        rates = turn + random.normal(0.0, 0.003, turn.shape)
        rates[(TIMES >= 10.0) & (k == 1), 1] += 0.3
        for time, rate in zip(TIMES, rates, strict=True):
            at = START + round(1e9 * time)
            messages.append((at, k, content(at, rate)))
    if not topic_by_topic:
        messages.sort(key=lambda one: one[0])
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=20_000, **options)
        writer.start(profile="", library="another")
        number = writer.register_schema(kind, schema, b"")
        channels = [
            writer.register_channel(f"/imu_{k}", encoding, number) for k in range(3)
        ]
        for at, k, data in messages:
            writer.add_message(channels[k], at, data, at)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("kind", "schema", "encoding", "content", "options"),
    [
        ("sensor_msgs/msg/Imu", "ros2idl", "cdr", imu, {}),
        ("sensor_msgs::msg::Imu", "omgidl", "cdr", imu, {"use_chunking": False}),
        (
            "sensor_msgs::msg::dds_::Imu_",
            "omgidl",
            "CDR",
            imu,
            {"compression": CompressionType.LZ4, "topic_by_topic": True},
        ),
        (
            "sensor_msgs/Imu",
            "ros1msg",
            "ros1",
            ros1_imu,
            {"index_types": IndexType.NONE, "use_statistics": False},
        ),
    ],
)
def test_recordings_of_other_producers_are_judged(
    kind, schema, encoding, content, options, tmp_path, fdi
):
    path = produced(tmp_path / "a.mcap", kind, schema, encoding, content, **options)
    first = fdi("replay", path).out.splitlines()[0]
    assert first.startswith("FAULTY: imu_1.y from 10.")


@pytest.mark.parametrize(
    ("kind", "encoding", "words"),
    [
        (
            "sensor_msgs/msg/Imu",
            "json",
            "/imu_0: its messages are encoded as json, not as cdr",
        ),
        ("foxglove.Imu", "protobuf", "it has /imu_0 (foxglove.Imu, protobuf)"),
    ],
)
def test_messages_that_are_not_read_are_named(kind, encoding, words, tmp_path, refused):
    path = produced(tmp_path / "a.mcap", kind, "", encoding, lambda at, rate: b"{}")
    assert words in refused("replay", path)


def test_messages_in_no_order_are_no_higher_rate(tmp_path, refused):
    random = np.random.default_rng(2)
    messages = [
        (
            f"/imu_{k}",
            START + round(1e9 * time),
            imu(START + round(1e9 * time), (0,) * 3),
        )
        for time in TIMES
        for k in range(3)
    ]
    random.shuffle(messages)
    said = refused("replay", write_mcap(tmp_path / "a.mcap", messages))
    assert "/imu_0: its messages are not in the order of time: sort the file" in said
