# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reading recordings of every make, whole and damaged."""

import bz2
import contextlib
import os
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
    bounded,
    flight,
    imu,
    write_bag,
    write_mcap,
    write_ros1,
)  # fmt: skip
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin

from fdi_ros.bag import ros1_file
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples, check_sample_rate, joined
from fdi_ros.config.config import Config
from fdi_ros.errors import BagError
from fdi_ros.system.files import LOGS

CONFIG = Config.from_parameters(PARAMETERS)
SAMPLES = 300
STAMP = START + STEP * np.arange(SAMPLES)


def read(path, config=CONFIG, **span):
    """All samples of a recording, and the reader of them."""
    with Recording(path) as recording:
        samples = Samples(recording, config, **span)
        block = joined(list(samples.blocks()))
    return block.stamp, block.z, samples


@pytest.mark.parametrize("make", MAKES)
def test_every_make_of_recording_gives_the_same_samples(make, tmp_path):
    messages, z = flight(SAMPLES)
    stamp, values, samples = read(MAKES[make](tmp_path / "bag", messages))
    np.testing.assert_array_equal(stamp, STAMP)
    np.testing.assert_array_equal(values, z)
    assert samples.progress == pytest.approx(1, abs=0.1)
    assert samples.recording.damage.report() == (
        (
            "there is no metadata.yaml: the recording was cut off, the files were read without it",
        )
        if "three" in make
        else ()
    )


@pytest.mark.parametrize("make", ["zstd chunks", "rosbag2 sqlite3"])
def test_messages_out_of_order_and_of_other_topics_do_not_matter(make, tmp_path):
    messages, z = flight(SAMPLES)
    noise = [("/other", log_time, messages[0][2]) for _, log_time, _ in messages[::7]]
    mixed = sorted(messages + noise, key=lambda message: message[1])
    late = np.random.default_rng(1).uniform(0, 200, len(mixed))
    path = MAKES[make](
        tmp_path / "bag", [mixed[i] for i in np.argsort(np.arange(len(mixed)) + late)]
    )
    stamp, values, _ = read(path)
    np.testing.assert_array_equal(stamp, STAMP)
    np.testing.assert_array_equal(values, z)
    with Recording(path) as recording:
        counts = {topic.name: topic.count for topic in recording.topics}
    assert counts == {**dict.fromkeys(TOPICS, SAMPLES), "/other": len(noise)}


def test_a_part_is_read_by_seconds_from_the_first_message(tmp_path):
    messages, z = flight(SAMPLES)
    stamp, values, samples = read(
        write_mcap(tmp_path / "bag.mcap", messages), start=1.0, end=2.0
    )
    assert samples.origin == START
    np.testing.assert_array_equal(stamp, STAMP[100:200])
    np.testing.assert_array_equal(values, z[100:200])


def test_arrays_are_stamped_by_the_time_of_recording(tmp_path):
    z = np.random.default_rng(0).normal(size=(50, 6))
    times = START + np.array([0, 0, 0, *range(3, 50)]) * STEP
    messages = [
        ("/gyro_channels", int(t), array(list(row), ["a"]))
        for t, row in zip(times, z, strict=True)
    ]
    messages.insert(20, ("/gyro_channels", messages[20][1], array([1.0] * 5)))
    path = write_mcap(tmp_path / "bag.mcap", messages, types={"/gyro_channels": ARRAY})
    stamp, values, samples = read(path, Config())
    np.testing.assert_array_equal(values, z)
    np.testing.assert_array_equal(
        stamp[:4], [START, START + 1, START + 2, START + 3 * STEP]
    )
    assert samples.malformed == {"gyro_channels": 1}


def test_stamps_of_arrays_increase_across_blocks(tmp_path):
    """Blocks of 1 ns: stamps that were moved forward overtake the block that follows."""
    times = START + np.array([0, 0, 0, 0, 1, 1, 7])
    messages = [("/gyro_channels", int(t), array([0.1] * 6)) for t in times]
    path = write_mcap(tmp_path / "bag.mcap", messages, types={"/gyro_channels": ARRAY})
    stamp, _, _ = read(path, Config(), period=1)
    np.testing.assert_array_equal(stamp - START, [0, 1, 2, 3, 4, 5, 7])


def cut_off(path, z):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def with_a_flipped_bit(path, z):
    data = bytearray(path.read_bytes())
    data[data.index(z[150, :3].tobytes())] ^= 1
    path.write_bytes(data)


def with_an_empty_file(path, z):
    (path / "bag_9.mcap").write_bytes(b"")


@pytest.mark.parametrize(
    ("make", "damage", "least", "most", "words"),
    [
        *(
            (make, cut_off, 90, 209, "breaks off in the record at byte")
            for make in ("zstd chunks", "lz4 chunks")
        ),
        ("plain chunks", cut_off, 90, 209, "breaks off in the record at byte"),
        (
            "plain chunks",
            with_a_flipped_bit,
            240,
            299,
            "fails its checksum and was left out",
        ),
        # After the gap the aligner wants to see a second message before it believes the first.
        ("three mcap files", with_an_empty_file, 198, 200, "bag_9.mcap is empty"),
    ],
)
def test_what_is_damaged_is_left_out_and_said(
    make, damage, least, most, words, tmp_path
):
    messages, z = flight(SAMPLES)
    path = MAKES[make](tmp_path / "bag", messages)
    damage(path, z)
    stamp, values, samples = read(path)
    assert least <= len(stamp) <= most
    whole = np.isfinite(values).all(axis=1)
    assert (~whole).sum() <= 2
    np.testing.assert_array_equal(values[whole], z[(stamp[whole] - START) // STEP])
    found = samples.recording.damage
    assert any(words in line for line in found.report())
    assert (found.cut_off, found.lost) == (damage is cut_off, damage is not cut_off)


def contents(folder):
    """All that lies in a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.fixture
def crashed(tmp_path):
    """A database being written, what it holds, and what copies it as a recorder that loses its power leaves it."""
    messages, z = flight(SAMPLES)
    folder, written = (
        tmp_path / "crashed",
        write_bag(tmp_path / "bag", messages, StoragePlugin.SQLITE3) / "bag.db3",
    )
    folder.mkdir()

    def crash(end):
        for part in ("", end):
            shutil.copy(f"{written}{part}", folder)
        return folder, contents(folder)

    with contextlib.closing(sqlite3.connect(written)) as base:
        yield base, z, crash


def test_a_write_ahead_log_beside_a_recording_is_read_and_nothing_is_left_there(
    crashed, tmp_path, monkeypatch
):
    base, z, crash = crashed
    base.execute("PRAGMA journal_mode = WAL")
    rows = list(
        base.execute("SELECT * FROM messages WHERE id > ? ORDER BY id", (SAMPLES,))
    )
    base.execute("DELETE FROM messages WHERE id > ?", (SAMPLES,))
    base.commit()
    base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    base.commit()
    # The second half is in the log alone.
    folder, before = crash("-wal")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    np.testing.assert_array_equal(read(folder)[1], z)
    assert contents(folder) == before
    (folder / "bag.db3-wal").unlink()
    _, values, samples = read(folder / "bag.db3")
    np.testing.assert_array_equal(values, z[: SAMPLES // 2])
    assert os.listdir(folder) == ["bag.db3"]
    assert not os.listdir(tmp_path / "temporary")
    assert samples.recording.damage.report() == ()


def test_a_transaction_that_was_not_finished_is_not_taken_back_and_nothing_is_left_there(
    crashed,
):
    base, _, crash = crashed
    base.execute("PRAGMA cache_size = 1")
    base.execute("PRAGMA journal_mode = DELETE")
    base.execute("UPDATE messages SET timestamp = timestamp + 1")
    folder, before = crash("-journal")
    assert before["bag.db3-journal"]
    _, values, samples = read(folder / "bag.db3")
    assert len(values) > SAMPLES // 2
    assert contents(folder) == before
    assert (
        "its last transaction was not finished" in samples.recording.damage.report()[0]
    )


def pointer(path):
    """What git has in the place of a large file."""
    path.write_text(
        f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 99\n"
    )
    return path


def unindexed(path):
    """A bag whose recorder was killed: the place of the index is not written."""
    data = write_ros1(path, flight(20)[0]).read_bytes()
    at = data.index(b"index_pos=") + 10
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 :])
    return path


LOST = (
    "log.bin",
    "log.BIN",
    "log.ulg",
    "log.tlog",
    "log.csv",
    "bag.bag",
    "bag.mcap",
    "bag.db3",
)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: p / "none", "no recording at"),
        (
            lambda p: (p / "bag.txt").write_text("x") and p / "bag.txt",
            "is not a recording",
        ),
        (lambda p: (p / "bag.mcap").touch() or p / "bag.mcap", "is empty"),
        (
            lambda p: (
                (p / "bag.mcap").write_bytes(b"#ROSBAG V2.0\n") and p / "bag.mcap"
            ),
            "is not an MCAP file",
        ),
        (
            lambda p: (p / "bag.db3").write_bytes(b"x" * 999) and p / "bag.db3",
            "is not a readable rosbag2 database",
        ),
        (lambda p: p, "is a folder without .mcap, .db3, .csv or .tsv files"),
        (
            lambda p: (
                (p / "bag.bag").write_bytes(b"#ROSBAG V1.2\n" * 9) and p / "bag.bag"
            ),
            "is not a bag of ROS 1",
        ),
        (
            lambda p: unindexed(p / "bag.bag"),
            "has no index, its recording was cut off: run rosbag reindex",
        ),
        *(
            (
                lambda p, s=s: pointer(p / s),
                "is a git-lfs pointer, not the recording: run git lfs pull",
            )
            for s in LOST
        ),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(make, words, tmp_path):
    with pytest.raises(BagError, match=words) as caught:
        Recording(make(tmp_path))
    assert "\n" not in str(caught.value)


def test_a_topic_of_another_type_is_refused(tmp_path):
    messages, _ = flight(10)
    path = write_mcap(tmp_path / "bag.mcap", messages, types={TOPICS[0]: ARRAY})
    with pytest.raises(
        BagError,
        match=r"is std_msgs/msg/Float64MultiArray, expected sensor_msgs/msg/Imu",
    ):
        read(path)


def test_the_rate_of_samples_is_told_in_spite_of_losses_bursts_and_gaps():
    regular = START + STEP * np.arange(2000)
    random = np.random.default_rng(0)
    lossy = regular[random.random(2000) > 0.15]
    # Two by two, and a pause of an hour.
    bursts, pause = (
        regular - STEP // 2 * (np.arange(2000) % 2),
        regular + 3600 * 10**9 * (np.arange(2000) > 1000),
    )
    for stamp in (regular, lossy, bursts, pause):
        for configured in (100.0, 90.0, 110.0):
            check_sample_rate("bag", stamp, configured)
        for configured in (25.0, 400.0):
            with pytest.raises(
                BagError, match=rf"bag: sample_rate is {configured:g} Hz in the config"
            ):
                check_sample_rate("bag", stamp, configured)
    check_sample_rate("bag", regular[:50], 1.0)


# Bags of ROS 1 -------------------------------------------------------------------------------------------------------


def test_a_bag_of_ros_1_becomes_one_of_ros_2(tmp_path, fdi, refused):
    """All of what can be read and nothing else; it is replaced only if asked for, and only what fdi has made."""
    messages, z = flight(SAMPLES)
    others = [("/text", log_time, b"\1\0\0\0x") for _, log_time, _ in messages[::9]]
    mixed = sorted(messages + others, key=lambda m: m[1])
    path = write_ros1(
        tmp_path / "bag.bag", mixed, types={"/text": "std_msgs/msg/String"}
    )
    words, out = ["convert", path, "--output", tmp_path / "out"], tmp_path / "out"
    assert fdi(*words).out.startswith(f"{TOPICS[0]}: 300 messages\n")
    for recording in (path, out):
        stamp, values, samples = read(recording)
        np.testing.assert_array_equal(values, z)
        np.testing.assert_array_equal(stamp, STAMP)
        assert samples.recording.damage.report() == ()
        with Recording(recording) as opened:
            assert ("/text" in [topic.name for topic in opened.topics]) == (
                recording == path
            )
            sent = [
                batch.message(k)
                for batch in opened.batches([TOPICS[0]])
                for k in range(len(batch))
            ]
        assert sent == [data for topic, _, data in messages if topic == TOPICS[0]]
    assert "--force" in refused(*words)
    assert fdi(*words, "--force", "--quiet").code == 0
    bag = write_bag(tmp_path / "bag", messages)
    assert "holds more than a recording made by fdi" in refused(
        "convert", out, "--output", bag, "--force"
    )


def test_a_chunk_that_unpacks_to_more_than_it_may_is_not_unpacked(tmp_path):
    path = write_ros1(
        tmp_path / "bag.bag", flight(20)[0], Ros1Writer.CompressionFormat.BZ2
    )
    data = path.read_bytes()
    at = data.index(b"BZh")
    size = struct.unpack_from("<I", data, at - 4)[0]
    packer = bz2.BZ2Compressor()
    bomb = b"".join([*map(packer.compress, [bytes(1 << 20)] * 256), packer.flush()])
    assert len(bomb) <= size
    path.write_bytes(data[:at] + bomb + bytes(size - len(bomb)) + data[at + size :])
    with (
        bounded(growth=250_000),
        pytest.raises(BagError, match="has no usable message on"),
    ):
        read(path)


def test_an_index_without_end_is_refused(tmp_path, monkeypatch):
    """Its chunks are one chunk, again and again: each has the whole index."""
    # A twentieth of the bound, which takes half a minute to reach.
    monkeypatch.setattr(ros1_file._Bounded, "left", LOGS.ros1_index_bytes // 20)
    path = write_ros1(tmp_path / "bag.bag", flight(2000)[0])
    data = path.read_bytes()
    at = data.index(b"chunk_count=") + 12
    last = data[-124:]
    assert last[8:12] == b"op=\6"
    path.write_bytes(
        data[:at] + struct.pack("<I", 10_000) + data[at + 4 :] + last * 10_000
    )
    with pytest.raises(
        BagError,
        match="its index, or a part of it, is larger than that of any recorder",
    ):
        Recording(path)


def set_back(at, stamped=False, steps=120):
    """Messages before and after the clock was set back at a sample, and their values.

    ``stamped``: by this clock, too. ``steps``: by so many sampling intervals.
    """
    z = np.random.default_rng(0).normal(size=(SAMPLES, 6))
    recorded = STAMP.copy()
    recorded[at:] -= steps * STEP
    stamps = recorded if stamped else STAMP
    messages = [
        (topic, time + 1000 * k, imu(stamp, row[3 * k : 3 * k + 3]))
        for time, stamp, row in zip(recorded.tolist(), stamps.tolist(), z, strict=True)
        for k, topic in enumerate(TOPICS)
    ]
    return messages, z


# Third parts of the messages are the files of a split recording.
@pytest.mark.parametrize(
    ("make", "at"),
    [
        ("zstd chunks", SAMPLES // 2),
        ("rosbag2 sqlite3", SAMPLES // 2),
        ("ros 1", SAMPLES // 2),
        ("three mcap files", 2 * SAMPLES // 3),
        ("three sqlite3 files", 2 * SAMPLES // 3),
    ],
)
@pytest.mark.parametrize("all_clocks", [False, True])
def test_messages_after_a_clock_was_set_back_follow_those_before(
    make, at, all_clocks, tmp_path
):
    """Sorted by time, those of two times would be mixed, and equal stamps be lost."""
    messages, z = set_back(at, all_clocks)
    path = MAKES[make](tmp_path / "bag", messages)
    stamp, values, samples = read(path)
    # One value is lost where the samples begin anew.
    there = np.isfinite(values)
    assert (~there).sum() <= (3 if all_clocks else 0)
    np.testing.assert_array_equal(values[there], z[there])
    assert (np.diff(stamp) > 0).all()
    (fact,) = samples.recording.damage.facts
    assert "the clock of the recorder was set back by 1.19 s" in fact
    # The time between the last message before the step and the first one after it is not known.
    _, values, _ = read(path, start=1.0, end=2.0)
    assert 100 <= len(values) <= 101
    expected = np.where(np.isnan(values), values, z[100 : 100 + len(values)])
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("make", ["three mcap files", "three sqlite3 files"])
def test_a_file_of_times_wholly_before_the_first_one_comes_last(make, tmp_path):
    messages, z = set_back(2 * SAMPLES // 3, steps=10 * SAMPLES)
    stamp, values, samples = read(MAKES[make](tmp_path / "bag", messages))
    np.testing.assert_array_equal(stamp, STAMP)
    np.testing.assert_array_equal(values, z)
    (fact,) = samples.recording.damage.facts
    assert "the clock of the recorder was set back by 30 s" in fact


def test_files_of_several_recorders_are_read_together(tmp_path):
    """One after the other, all messages of the first would wait in memory for those of the second."""
    messages, z = flight(SAMPLES)
    (folder := tmp_path / "bag").mkdir()
    for k, topic in enumerate(TOPICS):
        of_topic = [message for message in messages if message[0] == topic]
        write_mcap(folder / f"imu_{k}.mcap", of_topic)
    stamp, values, samples = read(folder)
    np.testing.assert_array_equal(stamp, STAMP)
    np.testing.assert_array_equal(values, z)
    assert samples.recording.damage.facts == []
    with Recording(folder) as recording:
        first, second, *_ = recording.batches(TOPICS)
    assert (set(first.topic), set(second.topic)) == ({0}, {1})


@pytest.mark.parametrize("make", ["zstd chunks", "rosbag2 sqlite3", "ros 1"])
def test_parts_of_a_file_may_be_in_any_order(make, tmp_path):
    messages, z = flight(SAMPLES)
    late = messages[len(messages) // 2 :]
    path = MAKES[make](tmp_path / "bag", late + messages[: -len(late)])
    stamp, values, samples = read(path)
    np.testing.assert_array_equal(stamp, STAMP)
    np.testing.assert_array_equal(values, z)
    assert samples.recording.damage.facts == []
