# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading recordings of every make, whole and damaged."""

import bz2
import contextlib
import os
import resource
import shutil
import sqlite3
import struct
import tempfile

import numpy as np
import pytest
from bag.recordings import (
    ARRAY,
    MAKES,
    PARAMETERS,
    START,
    STEP,
    TOPICS,
    array,
    flight,
    imu,
    split,
    write_bag,
    write_mcap,
    write_ros1,
)  # fmt: skip
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin

from fdi_ros.bag.mcap_file import CHANNEL, CHUNK, FOOTER, MESSAGE, SCHEMA, STATISTICS, walk
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples, check_sample_rate
from fdi_ros.config.config import Config
from fdi_ros.errors import BagError

CONFIG = Config.from_parameters(PARAMETERS)
SAMPLES = 300


def read(path, config=CONFIG, channels=6, **span):
    """All samples of a recording, and the reader of them."""
    with Recording(path) as recording:
        samples = Samples(recording, config, channels, **span)
        blocks = list(samples.blocks())
    stamp = np.concatenate([block.stamp for block in blocks])
    return stamp, np.vstack([block.z for block in blocks]), samples


@pytest.mark.parametrize("make", MAKES)
def test_every_make_of_recording_gives_the_same_samples(make, tmp_path):
    messages, z = flight(SAMPLES)
    stamp, values, samples = read(MAKES[make](tmp_path / "bag", messages))
    np.testing.assert_array_equal(stamp, START + STEP * np.arange(SAMPLES))
    np.testing.assert_array_equal(values, z)
    assert samples.progress == pytest.approx(1, abs=0.1)
    assert samples.recording.damage.report() == (
        ("there is no metadata.yaml: the recording was cut off, the files were read without it",)
        if "three" in make
        else ()
    )


def test_messages_out_of_order_come_in_the_order_of_recording(tmp_path):
    messages, z = flight(SAMPLES)
    random = np.random.default_rng(1)
    order = np.argsort(np.arange(len(messages)) + random.uniform(0, 200, len(messages)))
    shuffled = [messages[i] for i in order]
    for path in (
        write_mcap(tmp_path / "bag.mcap", shuffled),
        write_bag(tmp_path / "b", shuffled, StoragePlugin.SQLITE3),
    ):
        stamp, values, _ = read(path)
        np.testing.assert_array_equal(stamp, START + STEP * np.arange(SAMPLES))
        np.testing.assert_array_equal(values, z)


def test_other_topics_in_the_recording_do_not_matter(tmp_path):
    messages, z = flight(SAMPLES)
    noise = [("/other", log_time, array([1.0])) for _, log_time, _ in messages[::7]]
    mixed = sorted(messages + noise, key=lambda message: message[1])
    path = write_mcap(tmp_path / "bag.mcap", mixed, types={"/other": ARRAY})
    np.testing.assert_array_equal(read(path)[1], z)
    with Recording(path) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [
            (TOPICS[0], SAMPLES),
            (TOPICS[1], SAMPLES),
            ("/other", len(noise)),
        ]


def test_a_part_is_read_by_seconds_from_the_first_message(tmp_path):
    messages, z = flight(SAMPLES)
    path = write_mcap(tmp_path / "bag.mcap", messages)
    stamp, values, samples = read(path, start=1.0, end=2.0)
    assert samples.origin == START
    np.testing.assert_array_equal(stamp, START + STEP * np.arange(100, 200))
    np.testing.assert_array_equal(values, z[100:200])


def test_a_topic_that_stops_leaves_the_other_one(tmp_path):
    messages, z = flight(SAMPLES)
    stops = [m for m in messages if m[0] == TOPICS[0] or m[1] < START + 100 * STEP]
    with Recording(write_mcap(tmp_path / "bag.mcap", stops)) as recording:
        blocks = list(Samples(recording, CONFIG, 6).blocks())
    values = np.vstack([block.z for block in blocks])
    np.testing.assert_array_equal(values[:, :3], z[:, :3])
    np.testing.assert_array_equal(values[:100, 3:], z[:100, 3:])
    assert np.isnan(values[100:, 3:]).all()
    received = np.vstack([np.ones(b.z.shape, bool) if b.received is None else b.received for b in blocks])
    assert not received[100:, 3:].any()
    assert received[:, :3].all()


def test_arrays_are_stamped_by_the_time_of_recording(tmp_path):
    random = np.random.default_rng(0)
    z = random.normal(size=(50, 6))
    times = START + np.array([0, 0, 0, *range(3, 50)]) * STEP
    messages = [("/gyro_channels", int(t), array(list(row), ["a"])) for t, row in zip(times, z, strict=True)]
    messages.insert(20, ("/gyro_channels", messages[20][1], array([1.0] * 5)))
    path = write_mcap(tmp_path / "bag.mcap", messages, types={"/gyro_channels": ARRAY})
    stamp, values, samples = read(path, Config())
    np.testing.assert_array_equal(values, z)
    np.testing.assert_array_equal(stamp[:4], [START, START + 1, START + 2, START + 3 * STEP])
    assert samples.malformed == {"gyro_channels": 1}


def test_a_recording_cut_off_by_a_crash_is_read_up_to_the_cut(tmp_path):
    messages, z = flight(SAMPLES)
    for compression in (CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE):
        whole = write_mcap(tmp_path / "bag.mcap", messages, compression).read_bytes()
        (tmp_path / "bag.mcap").write_bytes(whole[: len(whole) // 2])
        stamp, values, samples = read(tmp_path / "bag.mcap")
        assert 0.3 * SAMPLES < len(stamp) < 0.7 * SAMPLES
        np.testing.assert_array_equal(values[:-1], z[: len(stamp) - 1])
        assert any("breaks off in the record at byte" in line for line in samples.recording.damage.report())


def contents(folder):
    """All that lies in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_write_ahead_log_beside_a_recording_is_read_and_nothing_is_left_there(tmp_path):
    messages, z = flight(SAMPLES)
    written = write_bag(tmp_path / "written", messages, StoragePlugin.SQLITE3) / "written.db3"
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    with contextlib.closing(sqlite3.connect(written)) as base:
        base.execute("PRAGMA journal_mode = WAL")
        rows = list(base.execute("SELECT * FROM messages WHERE id > ? ORDER BY id", (len(messages) // 2,)))
        base.execute("DELETE FROM messages WHERE id > ?", (len(messages) // 2,))
        base.commit()
        base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
        base.commit()
        # As a recorder leaves it that loses its power: the second half is in the log alone.
        for end in ("", "-wal"):
            shutil.copy(f"{written}{end}", crashed / f"bag.db3{end}")
    before, temporary = contents(crashed), set(os.listdir(tempfile.gettempdir()))
    _, values, samples = read(crashed)
    np.testing.assert_array_equal(values, z)
    assert contents(crashed) == before
    (crashed / "bag.db3-wal").unlink()
    _, values, samples = read(crashed / "bag.db3")
    np.testing.assert_array_equal(values, z[: SAMPLES // 2])
    assert os.listdir(crashed) == ["bag.db3"]
    assert not {name for name in set(os.listdir(tempfile.gettempdir())) - temporary if name.startswith("fdi_bag_")}
    assert samples.recording.damage.report() == ()


def test_a_transaction_that_was_not_finished_is_not_taken_back_and_nothing_is_left_there(tmp_path):
    messages, _ = flight(SAMPLES)
    written = write_bag(tmp_path / "written", messages, StoragePlugin.SQLITE3) / "written.db3"
    crashed = tmp_path / "crashed"
    crashed.mkdir()
    with contextlib.closing(sqlite3.connect(written)) as base:
        base.execute("PRAGMA cache_size = 1")
        base.execute("PRAGMA journal_mode = DELETE")
        base.execute("UPDATE messages SET timestamp = timestamp + 1")
        for end in ("", "-journal"):
            shutil.copy(f"{written}{end}", crashed / f"bag.db3{end}")
    before = contents(crashed)
    assert before["bag.db3-journal"]
    _, values, samples = read(crashed / "bag.db3")
    assert len(values) > SAMPLES // 2
    assert contents(crashed) == before
    assert "its last transaction was not finished" in samples.recording.damage.report()[0]


def test_a_damaged_chunk_is_left_out_and_said(tmp_path):
    messages, z = flight(SAMPLES)
    path = write_mcap(tmp_path / "bag.mcap", messages, CompressionType.NONE)
    data = bytearray(path.read_bytes())
    rate = imu(0, z[150, :3], "imu_1")[-8 * 24 :][:24]
    data[data.index(rate)] ^= 1
    path.write_bytes(bytes(data))
    stamp, _, samples = read(path)
    assert 0.8 * SAMPLES < len(stamp) < SAMPLES
    assert START + 150 * STEP not in stamp
    (line,) = samples.recording.damage.report()
    assert "fails its checksum and was left out" in line


def test_one_damaged_file_among_several_is_left_out_and_said(tmp_path):
    messages, z = flight(SAMPLES)
    path = split(tmp_path / "bag", messages, StoragePlugin.MCAP)
    (path / "bag_9.mcap").write_bytes(b"")
    _, values, samples = read(path)
    np.testing.assert_array_equal(values[:100], z[:100])
    # After the gap the aligner wants to see a second message before it believes the first.
    np.testing.assert_array_equal(values[100:], z[300 - len(values[100:]) :])
    assert len(values) >= 198
    assert any("bag_9.mcap is empty" in line for line in samples.recording.damage.report())


def pointer(path):
    """What git has in the place of a large file."""
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 99\n")
    return path


def unindexed(path):
    """A bag whose recorder was killed: the place of the index is not written."""
    data = write_ros1(path, flight(20)[0]).read_bytes()
    at = data.index(b"index_pos=") + 10
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    return path


LOST = ("log.bin", "log.BIN", "log.ulg", "log.tlog", "log.csv", "bag.bag", "bag.mcap", "bag.db3")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: p / "none", "no recording at"),
        (lambda p: (p / "bag.txt").write_text("x") and p / "bag.txt", "is not a recording"),
        (lambda p: (p / "bag.mcap").touch() or p / "bag.mcap", "is empty"),
        (lambda p: (p / "bag.mcap").write_bytes(b"#ROSBAG V2.0\n") and p / "bag.mcap", "is not an MCAP file"),
        (lambda p: (p / "bag.db3").write_bytes(b"x" * 999) and p / "bag.db3", "is not a readable rosbag2 database"),
        (lambda p: p, "is a folder without .mcap or .db3 files"),
        (lambda p: (p / "bag.bag").write_bytes(b"#ROSBAG V1.2\n" * 9) and p / "bag.bag", "is not a bag of ROS 1"),
        (lambda p: unindexed(p / "bag.bag"), "has no index, its recording was cut off: run rosbag reindex"),
        *((lambda p, s=s: pointer(p / s), "is a git-lfs pointer, not the recording: run git lfs pull") for s in LOST),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(make, words, tmp_path):
    with pytest.raises(BagError, match=words) as caught:
        Recording(make(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_topic_of_another_type_is_refused(tmp_path):
    messages, _ = flight(10)
    path = write_mcap(tmp_path / "bag.mcap", messages, types={TOPICS[0]: ARRAY})
    with pytest.raises(BagError, match=r"is std_msgs/msg/Float64MultiArray, expected sensor_msgs/msg/Imu"):
        read(path)


def test_a_database_that_another_program_damaged_is_read_as_far_as_it_goes(tmp_path):
    messages, z = flight(3000)
    path = write_bag(tmp_path / "bag", messages, StoragePlugin.SQLITE3)
    file = path / "bag.db3"
    with sqlite3.connect(file) as base:
        page = base.execute("PRAGMA page_size").fetchone()[0]
    base.close()
    data = bytearray(file.read_bytes())
    middle = len(data) // 2 // page * page
    data[middle : middle + 20 * page] = b"\xff" * (20 * page)
    file.write_bytes(bytes(data))
    stamp, values, samples = read(path)
    assert 0 < len(stamp) < 3000
    assert samples.recording.damage.report()
    known = np.isin(stamp, START + STEP * np.arange(3000))
    rows = (stamp[known] - START) // STEP
    complete = np.isfinite(values[known]).all(axis=1)
    np.testing.assert_array_equal(values[known][complete], z[rows[complete]])


# Records in a run of bytes: those that a plain reading of the format finds, however the bytes are damaged ------------

record_contents = st.one_of(st.binary(max_size=40), st.binary(min_size=22, max_size=60))
records = st.lists(
    st.tuples(st.sampled_from([SCHEMA, CHANNEL, MESSAGE, MESSAGE, MESSAGE, 0x0F]), record_contents), max_size=20
)
lengths = st.sampled_from([0, 21, 2**31, 2**62, 2**63 - 1, 2**63, 2**64 - 1])


def plainly_read(data, outside):
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
        found, topics, end = walk(data, outside)
        rows = zip(found.topic.tolist(), found.log_time.tolist(), found.offset, found.length, strict=True)
        messages = [(channel, time, data[start : start + size]) for channel, time, start, size in rows]
        assert (messages, topics, end) == plainly_read(data, outside)


def test_the_rate_of_samples_is_told_in_spite_of_losses_bursts_and_gaps():
    regular = START + STEP * np.arange(2000)
    random = np.random.default_rng(0)
    lossy = regular[random.random(2000) > 0.15]
    # Two by two, and a pause of an hour.
    bursts, pause = regular - STEP // 2 * (np.arange(2000) % 2), regular + 3600 * 10**9 * (np.arange(2000) > 1000)
    for stamp in (regular, lossy, bursts, pause):
        for configured in (100.0, 90.0, 110.0):
            check_sample_rate("bag", stamp, configured)
        for configured in (25.0, 400.0):
            with pytest.raises(BagError, match=rf"bag: sample_rate is {configured:g} Hz in the config"):
                check_sample_rate("bag", stamp, configured)
    check_sample_rate("bag", regular[:50], 1.0)


# Bags of ROS 1 -------------------------------------------------------------------------------------------------------


def test_a_bag_of_ros_1_becomes_one_of_ros_2(tmp_path, fdi):
    messages, z = flight(SAMPLES)
    others = [("/text", log_time, b"\1\0\0\0x") for _, log_time, _ in messages[::9]]
    path = write_ros1(
        tmp_path / "bag.bag", sorted(messages + others, key=lambda m: m[1]), types={"/text": "std_msgs/msg/String"}
    )
    assert fdi("convert", path, "--output", tmp_path / "out").code == 0
    for recording in (path, tmp_path / "out"):
        stamp, values, samples = read(recording)
        np.testing.assert_array_equal(values, z)
        np.testing.assert_array_equal(stamp, START + STEP * np.arange(SAMPLES))
        assert samples.recording.damage.report() == ()
    with Recording(path) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics][-1] == ("/text", len(others))
        sent = [batch.message(k) for batch in recording.batches([TOPICS[0]]) for k in range(len(batch))]
    assert sent == [data for topic, _, data in messages if topic == TOPICS[0]]


def test_a_chunk_that_unpacks_to_more_than_it_may_is_not_unpacked(tmp_path):
    path = write_ros1(tmp_path / "bag.bag", flight(20)[0], Ros1Writer.CompressionFormat.BZ2)
    data = path.read_bytes()
    at = data.index(b"BZh")
    size = struct.unpack_from("<I", data, at - 4)[0]
    bomb = bz2.compress(bytes(1 << 28))
    assert len(bomb) <= size
    path.write_bytes(data[:at] + bomb + bytes(size - len(bomb)) + data[at + size :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BagError, match="has no usable message on"):
        read(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 250_000


def test_an_index_without_end_is_refused(tmp_path):
    """Its chunks are one chunk, again and again: each has the whole index."""
    path = write_ros1(tmp_path / "bag.bag", flight(2000)[0])
    data = path.read_bytes()
    at = data.index(b"chunk_count=") + 12
    last = data[-124:]
    assert last[8:12] == b"op=\6"
    path.write_bytes(data[:at] + struct.pack("<I", 10_000) + data[at + 4 :] + last * 10_000)
    with pytest.raises(BagError, match="its index, or a part of it, is larger than that of any recorder"):
        Recording(path)
