# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that are damaged, or made to be too large or without end: each ends soon, in bounded memory, in words."""

import contextlib
import os
import sqlite3
import struct
from functools import partial

import pytest
import zstandard
from bag import fuzz
from bag.fuzz import SOUND as SOUND_DRAW
from bag.recordings import (
    ARRAY,
    IMU,
    MAKES,
    PARAMETERS,
    START,
    bounded,
    write_bag,
    write_config,
    write_mcap,
)
from bag.recordings import flight as fly
from mcap.writer import CompressionType
from rosbags.rosbag2 import StoragePlugin

from fdi_ros.bag.raw import Damage
from fdi_ros.bag.reader import Recording
from fdi_ros.bag.sqlite_file import SqliteFile
from fdi_ros.config.config import Config, read_parameter_file
from fdi_ros.errors import BagError, ConfigError, FdiError, StudyError
from fdi_ros.experiments.montecarlo import load_study
from fdi_ros.faults.fault import load_scenario
from fdi_ros.inspection.topics import inspect
from fdi_ros.replay.run import replay
from fdi_ros.system.text import shown

CONFIG = Config.from_parameters(PARAMETERS)
SAMPLES = 200
TWO_IMUS = {name: PARAMETERS[name] for name in ("input", "imus.topics", "sample_rate")}
record, text = partial(fuzz.record, SOUND_DRAW), SOUND_DRAW.text


def message(channel=0, at=START, data=b""):
    return record(5, struct.pack("<HIQQ", channel, 0, at, at) + data)


def channel(number, name):
    return record(
        4,
        struct.pack("<HH", number, 1) + text(name) + text("cdr") + struct.pack("<I", 0),
    )


def chunk(inside):
    return fuzz.chunk(SOUND_DRAW, inside, "zstd", [], 0)


MAGIC = b"\x89MCAP0\r\n"
SCHEMA = record(3, struct.pack("<H", 1) + text(IMU) + text("ros2msg") + text(""))
END = record(15, bytes(4)) + record(2, bytes(20)) + MAGIC


@pytest.mark.parametrize("number", range(int(os.environ.get("FUZZ_CASES", "40"))))
def test_a_hostile_file_ends_in_words(number, compiled):
    """The first of what `make fuzz` draws; a case is held to its time without that of compiling."""
    words, wrong = fuzz.run_case(number)
    assert not wrong, " ".join(words)


def made(folder, records):
    """An MCAP file of a schema and these records."""
    path = folder / "bag.mcap"
    path.write_bytes(MAGIC + SCHEMA + records + END)
    return path


@pytest.mark.parametrize(
    ("records", "received", "words"),
    [
        (
            lambda: chunk(SCHEMA + channel(0, "/a") + message() * (1 << 19)) * 24,
            None,
            "unpacks to more than",
        ),
        (
            lambda: channel(0, "/a") + (message() + record(200, b"")) * 100_000,
            100_000,
            "",
        ),
        (
            lambda: b"".join(channel(k, f"/t{k}") for k in range(65_535)) + message(),
            1,
            "more than 4096 topics",
        ),
        (
            lambda: (
                channel(0, "/a") + message() + message(data=bytes(5 << 20)) + message()
            ),
            3,
            "",
        ),
        (lambda: record(200, b"") * 320_000, 0, "more records than its size explains"),
        (
            lambda: (
                chunk(SCHEMA + channel(0, "/a") + record(3, b"") * 7_000_000)
                + message()
            ),
            1,
            "a message definition is damaged",
        ),
    ],
    ids=[
        *("packed", "unknown records", "topics", "a long message", "empty records"),
        "empty schemas in a chunk",
    ],
)
def test_bombs_are_read_as_far_as_their_size_explains(
    tmp_path, records, received, words
):
    path = made(tmp_path, records())
    with bounded():
        reports, damage, *_ = inspect(path)
    assert len(reports) <= 4096
    assert words in " ".join(damage)
    count = sum(report.received for report in reports)
    assert 0 < count < 24 << 19 if received is None else count == received


def test_a_packed_file_is_unpacked_as_far_as_its_size_explains(tmp_path):
    packed, packer = (
        tmp_path / "bomb.mcap.zstd",
        zstandard.ZstdCompressor().compressobj(),
    )
    parts = [MAGIC + SCHEMA + channel(0, "/a") + message(), *[bytes(1 << 20)] * 512]
    packed.write_bytes(b"".join(map(packer.compress, parts)) + packer.flush())
    with bounded(), Recording(packed) as recording:
        assert "unpacks to more than it should" in recording.damage.lines[0]
        assert recording.topics[0].name == "/a"
    whole = zstandard.compress(parts[0] + message(data=os.urandom(1 << 20)))
    packed.write_bytes(whole[: len(whole) // 2] + b"\xff" * (len(whole) // 2))
    with Recording(packed) as recording:
        assert "cannot be unpacked to its end" in recording.damage.lines[0]


def test_names_and_descriptions_that_are_too_long_are_left_out(tmp_path):
    names = (
        channel(0, "/a")
        + channel(1, "/" + "b" * 300)
        + record(3, struct.pack("<H", 2) + bytes(1 << 21))
    )
    made(tmp_path, names + message() + message(1) + message(0, 2**63 + 5))
    reports, damage, *_ = inspect(tmp_path / "bag.mcap")
    assert [(r.topic.name, r.received) for r in reports] == [("/a", 1)]
    for line, words in zip(
        damage,
        ("than 255", "than 1048576 bytes", "before 1970 or after 2038"),
        strict=True,
    ):
        assert words in line


SOUND = (
    "zstd chunks",
    "lz4 chunks",
    "plain chunks",
    "no checksums",
    "no chunks",
    "rosbag2 sqlite3",
    "ros 1, bz2",
)


@pytest.mark.parametrize("make", SOUND)
def test_of_a_damaged_recording_nothing_is_lost_without_a_word(make, tmp_path):
    """Cut, left out, repeated, inserted, or a bit flipped."""
    sound = MAKES[make](tmp_path / "bag", fly(SAMPLES)[0])
    sound = sound / "bag.db3" if sound.is_dir() else sound
    data, draw = sound.read_bytes(), fuzz.Draw(make)
    draw.oddness = 1.0
    path = tmp_path / f"damaged{sound.suffix}"
    for _ in range(8):
        path.write_bytes(draw.damaged(data))
        with bounded(5):
            words = outcome(path)
            assert words
            assert "\n" not in words
            with contextlib.suppress(BagError):
                inspect(path)


def outcome(path):
    """The error, or what is said of a partial result; empty if something is missing and nothing is said."""
    try:
        summary = replay(path, CONFIG)
    except BagError as error:
        return str(error)
    counts = [
        item for counts in summary.stream.alignment.values() for item in counts.items()
    ]
    said = [*summary.stream.damage] + [
        name for name, count in counts if count and name != "received"
    ]
    said += [topic for topic, count in summary.stream.malformed.items() if count]
    return " ".join(said) or ("complete" if summary.scores.samples == SAMPLES else "")


def test_a_chunk_that_claims_to_be_enormous_or_is_and_does_not_say_so_is_not_unpacked(
    tmp_path,
):
    path = write_mcap(tmp_path / "bag.mcap", fly(SAMPLES)[0])
    data = path.read_bytes()
    at = data.index(b"\x04\x00\x00\x00zstd")
    path.write_bytes(data[: at - 12] + struct.pack("<Q", 1 << 40) + data[at - 4 :])
    summary = replay(path, CONFIG)
    assert 0 < summary.scores.samples < SAMPLES
    assert "claims 1099511627776 bytes, expected at most" in summary.stream.damage[0]
    size = struct.unpack_from("<Q", data, at + 8)[0]
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 29))
    bomb = bomb + bytes(size - len(bomb)) if len(bomb) < size else bomb[:size]
    path.write_bytes(data[: at + 16] + bomb + data[at + 16 + size :])
    with bounded(growth=200_000):
        assert replay(path, CONFIG).stream.damage


def test_a_file_that_breaks_off_before_the_content_of_its_first_chunk_has_no_gyros(
    tmp_path, fdi
):
    path = write_mcap(tmp_path / "bag.mcap", fly(SAMPLES)[0])
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"\x04\x00\x00\x00zstd") + 16])
    done = fdi("inspect", path)
    assert done.code == 3
    assert "is cut off after 0 of" in done.out


def test_damaged_metadata_is_done_without_and_a_file_that_is_not_there_is_said(
    tmp_path,
):
    path = write_bag(tmp_path / "bag", fly(20)[0])

    def said():
        with bounded(5):
            summary = replay(path, CONFIG)
        assert summary.scores.samples == 20
        return summary.stream.damage

    (path / "bag.mcap").rename(path / "other.mcap")
    assert said() == ("bag.mcap is named in metadata.yaml and not there",)
    for text in (
        *YAML,
        "",
        "x: [",
        "rosbag2_bagfile_information: 3",
        "- 1",
        "\x00\x01",
        "a: !!python/none x",
    ):
        (path / "metadata.yaml").write_text(text)
        assert "metadata.yaml is damaged" in said()[0]


def database(path, messages):
    base = sqlite3.connect(path)
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
    )
    base.execute("INSERT INTO topics VALUES(1, '/imu_1/data_raw', ?, 'cdr')", (IMU,))
    base.execute(messages)
    base.commit()
    return base


@pytest.mark.parametrize("messages", fuzz.COMPUTED.values(), ids=fuzz.COMPUTED)
def test_a_database_that_computes_is_refused(messages, tmp_path):
    database(tmp_path / "bag.db3", messages).close()
    with (
        bounded(5),
        pytest.raises(BagError, match=r"is no plain table|has computed columns"),
    ):
        Recording(tmp_path / "bag.db3")


def test_large_and_packed_messages_of_a_database_are_read_in_portions(tmp_path):
    path = tmp_path / "bag"
    write_bag(path, fly(20)[0], StoragePlugin.SQLITE3)
    base = sqlite3.connect(path / "bag.db3")
    packed = zstandard.compress(bytes(1 << 26))
    base.executemany(
        "INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, ?)",
        [(START, packed)] * 7,
    )
    base.execute("UPDATE topics SET type = CAST(x'fffe' AS TEXT) WHERE id = 2")
    base.commit()
    with bounded():
        _, damage, *_ = inspect(path)
    assert "more bytes than it should" in damage[0]
    base.execute(
        "UPDATE messages SET data = zeroblob(70000000) WHERE id = (SELECT MAX(id) FROM messages)"
    )
    base.execute("DELETE FROM messages WHERE data = ?", (packed,))
    base.commit()
    base.close()
    with bounded():
        _, damage, *_ = inspect(path)
    assert "of none or more than 67108864 bytes were left out" in damage[0]


def test_messages_of_a_database_are_sorted_without_being_loaded(tmp_path):
    """Without an index by time, SQLite keeps what it sorts in memory."""
    base = database(tmp_path / "bag.db3", fuzz.PLAIN)
    add = "INSERT INTO messages(topic_id, timestamp, data) VALUES(1, ?, zeroblob(60000000))"
    base.executemany(add, [(START + 1000 * k,) for k in reversed(range(8))])
    base.commit()
    base.close()
    with bounded(growth=330_000), Recording(tmp_path / "bag.db3") as recording:
        topics = [topic.name for topic in recording.topics]
        times = [
            at for batch in recording.batches(topics) for at in batch.log_time.tolist()
        ]
    assert times == [START + 1000 * k for k in range(8)]


def test_an_array_that_announces_what_it_does_not_hold_takes_no_memory(tmp_path, fdi):
    lies = struct.pack("<BBBBIII", 0, 1, 0, 0, 0, 0, 1_200_000_000)
    path = write_bag(
        tmp_path / "bag",
        [("/gyros", START + k, lies) for k in range(5)],
        types={"/gyros": ARRAY},
    )
    with bounded():
        code, out, _ = fdi("inspect", path)
    assert code == 3
    assert "/gyros: 1200000000 values, not 4 to 12" in out


def test_a_query_ends_by_itself(tmp_path):
    """A database whose pages point at each other is endless for SQLite; so is, for a moment, a large one."""
    database(tmp_path / "bag.db3", fuzz.PLAIN).close()
    file = SqliteFile(tmp_path / "bag.db3", Damage(), 1 << 30)
    file._steps = 1 << 20
    with bounded(5), pytest.raises(sqlite3.OperationalError, match="more steps"):
        next(file._query(f"SELECT MAX(x) FROM ({fuzz.ENDLESS} SELECT x FROM c)"))
    file.close()


ALIASES = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n"
    for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
YAML = {
    "x: !!int zz": "'zz' is no int",
    f"x: {'9' * 5000}": "a number of 5000 characters, expected at most 64",
    "x: 99999999999999999999": "does not fit into 64 bits",
    "[" * 500: "nested deeper than 50",
    # Newer versions of libyaml end this by a limit of their own.
    "[" * 5000: "nest",
    "x: &x {y: *x}": r"the alias \*x stands for nothing before it",
    ALIASES: "more than 50000 values, aliases followed",
    "x: " + "[1, " * 10 + "1, " * 60_000 + "1]" * 10: "more than 50000 values",
    "x: !!python/object/apply:os.system [true]": "could not determine a constructor",
    "x: !!timestamp 2020-13-45": "could not determine a constructor",
    "x: !!bool maybe": "neither true nor false",
    "x" * (1 << 21): "longer than 1048576 bytes",
    "x: \x1b[2J": "not YAML",
    "/**:\n  ros__parameters: {a: 1}\n/**:\n  ros__parameters: {a: 2}\n": r"line 3: the key '/\*\*' is given twice",
    "x: {y: 1, z: {y: 2, w: 3}, 'y': 4}": "line 1: the key 'y' is given twice",
}


@pytest.mark.parametrize(
    ("read", "error"),
    [
        (read_parameter_file, ConfigError),
        (load_scenario, FdiError),
        (load_study, StudyError),
    ],
)
def test_hostile_yaml_is_refused_wherever_yaml_is_read(read, error, tmp_path):
    path = tmp_path / "hostile.yaml"
    for content, words in YAML.items():
        path.write_text(content)
        with bounded(5), pytest.raises(error, match=words):
            read(path)


def test_what_a_file_says_is_shown_and_not_obeyed(fdi, refused, tmp_path):
    """Topics that would be YAML or obeyed by a terminal, in a file of such a name."""
    assert shown("a\n\x1b[2Jb\u202ec\u2028\x00") == r"a\n\x1b[2Jb\u202ec\u2028\x00"
    assert shown("x" * 500, 10) == "xxxxxxx..."
    names = ("/a\n/**:\n  ros__parameters: {input: x}", "/\x1b]0;owned\x07", "/\u202eb")
    messages = [
        (names[k % 3], START + 10**7 * k, data)
        for k, (_, _, data) in enumerate(fly(60)[0])
    ]
    path = write_mcap(
        tmp_path / "b\n\x1b[2J: 1\ng.mcap", messages, CompressionType.NONE
    )
    made, config = (
        tmp_path / "made.yaml",
        write_config(tmp_path / "c.yaml", {**TWO_IMUS, "imus.topics": ["/a", "/b"]}),
    )
    inspected = fdi("inspect", path, "--write", made)
    assert (inspected.code, inspected.err.count("\n")) == (2, 1)
    replayed, set_up = (
        refused("replay", path, "--config", config),
        refused("setup", path, "--output", made),
    )
    for told in (inspected.out, inspected.err, set_up):
        assert r"/a\n/**:\n  ros__parameters: {input: x}" in told
    assert all(
        line.isprintable()
        for line in "".join((*inspected[1:], replayed, set_up)).split("\n")
    )
    assert not made.exists()
    path = write_mcap(
        tmp_path / "x\n  bad: [.mcap",
        [(f"/imu_{k % 2}", t, m) for k, (_, t, m) in enumerate(fly(60)[0])],
    )
    assert fdi("inspect", path, "--write", made).code == 0
    assert Config.from_file(made).imus.topics == ("/imu_0", "/imu_1")


def test_names_in_a_config_are_names():
    for topic in ("/a b", "/a//b", "/a/", "/1a", "~a", "/a\n", "a" * 300, "~", "/"):
        with pytest.raises(ConfigError, match="is no ROS name"):
            Config.from_parameters({"input": "channels", "channels.topic": topic})
    for topic in ("/a/b_1", "a", "~/a", "{node}/x", "/_a"):
        Config.from_parameters({"input": "channels", "channels.topic": topic})
    for name in ("channels.names", "imus.names", "hardware_id", "body_frame"):
        with pytest.raises(ConfigError, match="is no name"):
            Config.from_parameters({name: "a\x1b[2J"})
