# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Damaged recordings: each ends in one clear line or a stated partial result, in little time and memory."""

from __future__ import annotations

import contextlib
import random
import resource
import shutil
import struct
import time

import pytest
from bag.recordings import ARRAY, IMU, PARAMETERS, flight, write_bag, write_mcap
from mcap.writer import CompressionType
from rosbags.rosbag2 import StoragePlugin

from fdi_ros.config.config import Config
from fdi_ros.errors import BagError
from fdi_ros.inspection.inspect import inspect
from fdi_ros.replay.run import Request, replay

CONFIG = Config.from_parameters(PARAMETERS)
SAMPLES = 200
MOST_SECONDS = 5.0
MOST_MEMORY = 1 << 30
SOUND = {
    "zstd": lambda path, m: write_mcap(path / "bag.mcap", m),
    "lz4": lambda path, m: write_mcap(path / "bag.mcap", m, CompressionType.LZ4),
    "plain": lambda path, m: write_mcap(path / "bag.mcap", m, CompressionType.NONE),
    "no checksums": lambda path, m: write_mcap(path / "bag.mcap", m, CompressionType.NONE, enable_crcs=False),
    "no chunks": lambda path, m: write_mcap(path / "bag.mcap", m, use_chunking=False),
    "sqlite3": lambda path, m: write_bag(path / "bag", m, StoragePlugin.SQLITE3) / "bag.db3",
}


def truncated(data, draw):
    return data[: draw.randrange(len(data))]


def flipped(data, draw):
    out = bytearray(data)
    for _ in range(draw.choice([1, 3, 30])):
        out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    return bytes(out)


def random_bytes(data, draw):
    out = bytearray(data)
    size = draw.choice([8, 200, 5000])
    at = draw.randrange(len(out))
    out[at : at + size] = draw.randbytes(min(size, len(out) - at))
    return bytes(out)


def wrong_schema(data, draw):
    return data.replace(IMU.encode(), ARRAY[:19].encode().ljust(len(IMU), b"x"))


def absurd_lengths(data, draw):
    """A length made enormous: of a record, of a chunk unpacked or packed, of a text; in a database anywhere."""
    out = bytearray(data)
    places = [(at, ">H") for at in range(100, len(out) - 8, 3)]
    if data.startswith(b"\x89MCAP"):
        places, at = [], 8
        while at + 9 < len(data) - 8:
            opcode, length = struct.unpack_from("<BQ", data, at)
            places += [(at + 1, "<Q")] * (3 if opcode == 6 else 1)
            places += {
                6: [(at + 25, "<Q"), (at + 37, "<I"), (at + 45, "<Q")],
                4: [(at + 13, "<I")],
                3: [(at + 11, "<I")],
            }.get(opcode, [])
            at += 9 + length
    at, kind = draw.choice(places)
    width = struct.calcsize(kind)
    struct.pack_into(kind, out, at, draw.choice([256**width - 1, 256**width // 2, 256**width // 3]))
    return bytes(out)


DAMAGES = (truncated, flipped, random_bytes, wrong_schema, absurd_lengths)
EACH = 120 // (len(SOUND) * len(DAMAGES))


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("make", SOUND)
def test_a_damaged_recording_ends_in_words(make, damage, tmp_path):
    sound = SOUND[make](tmp_path, flight(SAMPLES)[0])
    data = sound.read_bytes()
    draw = random.Random(f"{make} {damage.__name__}")
    path = tmp_path / f"damaged{sound.suffix}"
    for _ in range(EACH):
        path.write_bytes(damage(data, draw))
        begun = time.process_time()
        words = outcome(path)
        assert words
        assert "\n" not in words
        with contextlib.suppress(BagError):
            inspect(path)
        assert time.process_time() - begun < MOST_SECONDS
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 < MOST_MEMORY


def outcome(path):
    """The error, or what is said of a partial result; empty if something is missing and nothing is said."""
    try:
        summary = replay(Request(path, CONFIG))
    except BagError as error:
        return str(error)
    counts = [item for counts in summary.stream.alignment.values() for item in counts.items()]
    said = [*summary.stream.damage] + [name for name, count in counts if count and name != "received"]
    said += [topic for topic, count in summary.stream.malformed.items() if count]
    return " ".join(said) or ("complete" if summary.scores.samples == SAMPLES else "")


def test_a_chunk_that_claims_to_be_enormous_is_not_believed(tmp_path):
    path = write_mcap(tmp_path / "bag.mcap", flight(SAMPLES)[0])
    data = bytearray(path.read_bytes())
    at = data.index(b"\x04\x00\x00\x00zstd")
    struct.pack_into("<Q", data, at - 12, 1 << 40)
    path.write_bytes(bytes(data))
    summary = replay(Request(path, CONFIG))
    assert 0 < summary.scores.samples < SAMPLES
    assert "claims 1099511627776 bytes, expected at most" in summary.stream.damage[0]


def test_a_small_file_that_unpacks_into_an_enormous_one_is_not_unpacked(tmp_path):
    import zstandard

    path = write_mcap(tmp_path / "bag.mcap", flight(50)[0])
    data = path.read_bytes()
    at = data.index(b"\x04\x00\x00\x00zstd")
    size = struct.unpack_from("<Q", data, at + 8)[0]
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 29))
    bomb = bomb + bytes(size - len(bomb)) if len(bomb) < size else bomb[:size]
    path.write_bytes(data[: at + 16] + bomb + data[at + 16 + size :])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    summary = replay(Request(path, CONFIG))
    assert summary.stream.damage
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200_000


@pytest.mark.parametrize(
    "text", ["", "x: [", "rosbag2_bagfile_information: 3", "- 1", "\x00\x01", "a: !!python/none x"]
)
def test_damaged_metadata_is_done_without(text, tmp_path):
    path = write_bag(tmp_path / "bag", flight(50)[0])
    (path / "metadata.yaml").write_text(text)
    summary = replay(Request(path, CONFIG))
    assert summary.scores.samples == 50
    assert "metadata.yaml is damaged" in summary.stream.damage[0]


def test_a_file_named_in_the_metadata_that_is_not_there_is_said(tmp_path):
    path = write_bag(tmp_path / "bag", flight(50)[0])
    shutil.move(path / "bag.mcap", path / "other.mcap")
    summary = replay(Request(path, CONFIG))
    assert summary.scores.samples == 50
    assert summary.stream.damage == ("bag.mcap is named in metadata.yaml and not there",)
