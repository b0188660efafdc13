# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Hostile recordings and files, made by what they are made of, through the real verbs: `make fuzz N=20000`.

Each case is drawn from its number alone. A case passes if the verb ends by itself, in time and memory, in success or
in one clear line, prints nothing that a terminal obeys, and leaves whole outputs or none.
"""

import io
import itertools
import json
import math
import os
import random
import re
import resource
import shutil
import sqlite3
import struct
import tempfile
import time
import traceback
import warnings
import zlib
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import lz4.frame
import zstandard
from bag import logs
from bag.recordings import (
    ARRAY,
    IMU,
    PARAMETERS,
    START,
    STEP,
    TOPICS,
    Ros1Writer,
    array,
    imu,
    write_ros1,
)

from fdi_ros.cli import command_line
from fdi_ros.config.config import Config
from fdi_ros.errors import FdiError

MOST_SECONDS, MOST_GROWTH = 20.0, 700 << 20
NUMBERS = (
    0,
    1,
    255,
    2**15,
    2**16 - 1,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**62,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
VALUES = (
    0.0,
    -0.0,
    1e-320,
    1e-8,
    0.5,
    1e6,
    1e154,
    1.7e308,
    -1.7e308,
    math.inf,
    -math.inf,
    math.nan,
)
NAMES = (
    "/imu\n/**:\n  ros__parameters: {input: x}", "/\x1b[2J\x1b]0;owned\x07", "/a\u202eb\u2066c", "", "/" + "n" * 300,
    "/a/b/c", "true", "/\ud7ff\u2028x", "/~{x}", "fused", "/[a, b]: {", "/a//b", "/1", "/%s%n",
)  # fmt: skip
SCALARS = (
    "2020-01-01", "!!int zz", "9" * 5000, "!!timestamp 1", "!!python/object/apply:os.system [x]", ".nan", "-.inf",
    "1e400", "0x" + "f" * 30, "1:2:3", "~", "''", "[]", "{}", "*a", "&a [*a]", "&b {c: *b}", "[[[[1]]]]", "!!bool zz",
    "[" * 200, "{a: " * 90, '"\\x1b[2J"', '"\\n"', "18446744073709551615", "-9223372036854775808", "1e-320", "true",
    "[.nan, 1.0]", "[a, 1, null]", "{<<: 3}", "'" + "x" * 3000 + "'", "!!binary xx", "!!float zz", "? [a]\n: b", "- a",
    "cone_99999999999", "[[1, 0, 0]]", "1e308", "-1", "0", "3", "1000000000", "\x07", "\u0085", "0o17", "1_000",
)  # fmt: skip
PLAIN = "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
UNTYPED = "CREATE TABLE messages(id, topic_id, timestamp, data)"
ENDLESS = "WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c)"
COMPUTED = {
    "computed": "CREATE TABLE messages(id, topic_id, timestamp, data AS (zeroblob(900000000)))",
    "view": f"CREATE VIEW messages AS {ENDLESS}"
    " SELECT x AS id, 1 AS topic_id, x AS timestamp, zeroblob(1000) AS data FROM c",
    "virtual": "CREATE VIRTUAL TABLE messages USING fts5(id, topic_id, timestamp, data)",
}
"""Tables of messages that another program has made to compute."""
SCENARIO = """\
faults:
  - {channel: imu_1.y, kind: bias, size: 0.2, start: 0.1, stop: 0.4}
  - {channel: imu_2, kind: triad_loss, start: 0.2}
"""


class Draw(random.Random):
    """Choices of one case; some share of what it makes is odd."""

    def __init__(self, seed):
        super().__init__(seed)
        self.oddness = self.choice((0.0, 0.002, 0.02, 0.1))

    def odd(self):
        return self.random() < self.oddness

    def number(self, value, width=8):
        return self.choice(NUMBERS) % 256**width if self.odd() else value

    def pack(self, form, *values):
        widths = {"B": 1, "H": 2, "I": 4, "Q": 8}
        return struct.pack(
            f"<{form}",
            *(self.number(v, widths[c]) for c, v in zip(form, values, strict=True)),
        )

    def text(self, text):
        data = (self.choice(NAMES) if self.odd() else text).encode(
            "utf-8", "surrogatepass"
        )
        data += b"\xff\xfe" if self.odd() else b""
        return self.pack("I", len(data)) + data

    def corrupted(self, data):
        """Odd bytes lie in it, at its begin more than elsewhere; and it is damaged."""
        data = bytearray(data)
        for _ in range(self.choice((0, 1, 3, 30)) if self.oddness else 0):
            at = self.randrange(min(len(data), self.choice((700, 1500, len(data)))))
            odd = (
                self.randbytes(1),
                b"\xff",
                b"\0",
                b"9" * 9,
                bytes(data[:200]),
                b"[65535]",
            )
            data[at : at + 1] = self.choice(odd)
        return self.damaged(bytes(data))

    def damaged(self, data):
        """Flip, cut, repeat or insert bytes; mostly nothing."""
        if self.random() > 3 * self.oddness + 0.03 or not data:
            return data
        at, end = sorted((self.randrange(len(data)), self.randrange(len(data))))
        return self.choice(
            (
                lambda: data[:end],
                lambda: data[:at] + data[end:],
                lambda: data[:end] + data[at:],
                lambda: (
                    data[:at] + self.randbytes(self.choice((1, 8, 300))) + data[at:]
                ),
                lambda: (
                    data[:at]
                    + bytes([data[at] ^ 1 << self.randrange(8)])
                    + data[at + 1 :]
                ),
            )
        )()


class Sound(Draw):
    """Makes nothing odd and damages nothing."""

    def __init__(self):
        super().__init__("sound")
        self.oddness = 0.0

    def damaged(self, data):
        return data


SOUND = Sound()


# Recordings ----------------------------------------------------------------------------------------------------------


def messages(draw):
    """Topics (name, type), and messages (topic, time, bytes) in one of many patterns."""
    topics = [(name, IMU) for name in TOPICS]
    topics += [
        (draw.choice(NAMES), draw.choice((IMU, ARRAY, "std_msgs/msg/String", "")))
    ] * (draw.random() < 0.4)
    topics += [("/gyros", ARRAY)] * (draw.random() < 0.3)
    topics += [(f"/t{k}", IMU) for k in range(draw.choice((*[0] * 20, 5000)))]
    step = draw.choice((STEP, STEP, STEP, 0, 1, -STEP, 10**12))
    value = draw.choice((None, None, None, *VALUES))
    stamp_step = step if draw.random() < 0.8 else draw.choice((0, STEP, -STEP, 10**13))
    first = draw.choice((START, START, START, 0, 5, 2**62, 2**63 - 3 * 10**9))
    found = []
    for k in range(draw.choice((0, 1, 2, 5, 40, 40, 200))):
        for topic, (_, kind) in enumerate(topics[:4]):
            rates = [draw.gauss(0, 0.01) if value is None else value for _ in range(6)]
            begin = draw.choice((first, START)) if draw.odd() else first
            stamp = min(
                max(min(begin, 2**31 * 10**9 - 1) + k * stamp_step, 0),
                2**31 * 10**9 - 1,
            )
            data = (
                array(rates[: draw.choice((6, 6, 6, 4, 0))])
                if kind == ARRAY
                else imu(stamp, rates[:3])
            )
            found.append((topic, (first + k * step) % 2**64, draw.damaged(data)))
    if draw.random() < 0.1:
        draw.shuffle(found)
    return topics, found


def record(draw, opcode, content):
    return draw.pack("BQ", opcode, len(content)) + content


def mcap(draw):
    """An MCAP file of records, chunks and indexes, some of them odd."""
    topics, sent = messages(draw)
    about = b""
    for number, (name, kind) in enumerate(topics):
        schema = (
            draw.pack("H", number + 1)
            + draw.text(kind)
            + draw.text("ros2msg")
            + draw.text("# none")
        )
        about += record(draw, 3, schema)
        channel = (
            draw.pack("HH", number, number + 1)
            + draw.text(name)
            + draw.text("cdr")
            + draw.pack("I", 0)
        )
        about += record(draw, 4, channel)
    parts = [about]
    out = b"\x89MCAP0\r\n" + record(draw, 1, draw.text("ros2") + draw.text("fuzz"))
    for k, (topic, at, data) in enumerate(sent):
        if draw.odd():
            parts.append(
                record(
                    draw,
                    draw.choice((2, 6, 7, 8, 11, 15, 200)),
                    draw.randbytes(draw.choice((0, 9, 60))),
                )
            )
        parts.append(record(draw, 5, draw.pack("HIQQ", topic, k, at, at) + data))
    kind = "none at all" if draw.odd() else draw.choice(("", "zstd", "lz4", "plain"))
    size = draw.choice((1, 7, 100, 1000))
    for k in range(0, len(parts), size):
        inside = b"".join(parts[k : k + size])
        out += inside if kind == "plain" else chunk(draw, inside, kind, sent, k)
        out += record(draw, 7, draw.pack("HI", 0, 0)) if draw.random() < 0.3 else b""
    if draw.random() < 0.7:
        counts = draw.choice((struct.pack("<IHQ", 10, 0, len(sent)), bytes(4)))
        out += record(draw, 15, draw.pack("I", 0))
        out += about if draw.random() < 0.5 else b""
        out += record(
            draw,
            11,
            draw.pack("QHIIIIQQ", len(sent), 1, 1, 0, 0, 1, START, START) + counts,
        )
        out += record(draw, 2, draw.pack("QQI", 0, 0, 0)) + b"\x89MCAP0\r\n"
    return draw.damaged(out)


def chunk(draw, inside, kind, sent, k):
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(kind, bytes)(
        inside
    )
    start = sent[min(k, len(sent) - 1)][1] if sent else 0
    crc = zlib.crc32(inside) * draw.choice((0, 1))
    head = (
        draw.pack("QQQI", start, start, len(inside), crc)
        + draw.text(kind)
        + draw.pack("Q", len(packed))
    )
    return record(draw, 6, head + draw.damaged(packed))


def database(draw, path):
    """A rosbag2 database with odd tables and values."""
    topics, sent = messages(draw)
    base = sqlite3.connect(path)
    base.execute(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
    )
    for number, (name, kind) in enumerate(topics[:50]):
        odd = draw.choice((None, 3, b"\xff\xfe", 1e308, name)) if draw.odd() else name
        base.execute(
            "INSERT INTO topics VALUES(?, ?, ?, ?)", (number, odd, kind, "cdr")
        )
    if draw.odd():
        base.execute("UPDATE topics SET name = CAST(x'fffe2f00' AS TEXT)")
    form = draw.choice((*["plain"] * 6, "zeroblob", "untyped", *COMPUTED))
    base.execute({"untyped": UNTYPED, **COMPUTED}.get(form, PLAIN))
    if form in ("plain", "untyped", "zeroblob"):
        packed = draw.random() < 0.2
        rows = []
        for topic, at, data in sent:
            data = zstandard.compress(data) if packed else data
            at = (
                draw.choice(("x", 1.5, None, -5))
                if draw.odd()
                else at - 2**64 * (at >= 2**63)
            )
            rows.append(
                (topic, at, draw.choice((3, "text", None, b"")) if draw.odd() else data)
            )
        rows += [(0, START, zstandard.compress(bytes(1 << 24)))] * draw.choice(
            (0, 0, 0, 30)
        )
        base.executemany(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows
        )
        if form == "zeroblob":
            base.execute("UPDATE messages SET data = zeroblob(30000000) WHERE id < 3")
    base.commit()
    base.close()
    if form != "zeroblob":
        path.write_bytes(draw.damaged(path.read_bytes()))


def recording(draw, folder):
    """A bare file, or a folder with metadata.yaml."""
    if draw.random() < 0.15:
        return flight_log(draw, folder / "bag")
    if draw.random() < 0.6:
        return storage(draw, folder / "bag")
    bag = folder / "bag"
    bag.mkdir()
    files = [storage(draw, bag / f"bag_{k}") for k in range(draw.choice((1, 1, 2)))]
    names = [file.name for file in files] * draw.choice((1, 1, 1, 2000))
    odd = ("../config.yaml", "/dev/zero", "\x00", "../bag/bag_0.mcap", "x" * 5000, ".")
    names += draw.choices(odd, k=draw.random() < 0.75)
    about = {
        "version": 9,
        "relative_file_paths": names,
        "topics_with_message_count": [],
    }
    if draw.random() < 0.9:
        write(
            bag / "metadata.yaml",
            odd_yaml(
                draw, json.dumps({"rosbag2_bagfile_information": about}, indent=1)
            ),
        )
    return bag


def flight_log(draw, stem):
    """A log of a flight stack; where it is odd, odd bytes lie in it, in its descriptions more than elsewhere."""
    made = logs.units(
        draw.choice((1, 2, 3, 3)),
        draw.choice((1.0, 5.0)),
        draw.choice((2.0, 100.0, 100.0, 400.0)),
    )
    dataflash = ("IMU", "IMU2", "GYR", "IMT", "TimeMS", "GYR1")
    kind = draw.choice(
        (
            *dataflash,
            "sensor_gyro",
            "vehicle_imu",
            "sensor_gyro_fifo",
            "tlog",
            *["csv"] * 4,
        )
    )
    for unit in made:
        if draw.odd() or draw.odd():
            unit.stamp[draw.randrange(len(unit.stamp)) :] += draw.choice(
                (-(10**7), 10**12, 2**62)
            )
            unit.rate[draw.randrange(len(unit.rate))] = draw.choice(
                (math.nan, math.inf, 1e30)
            )
    if kind == "csv":
        path = table(draw, stem.with_name(f"{stem.name}.csv"), made)
    elif kind == "tlog":
        path = logs.write_tlog(
            stem.with_name(f"{stem.name}.tlog"), draw.choice((1.0, 5.0))
        )
    else:
        suffix, write_log = (
            ("bin", logs.write_dataflash)
            if kind in dataflash
            else ("ulg", logs.write_ulog)
        )
        path = write_log(
            stem.with_name(f"{stem.name}.{suffix}"), made, kind, draw.random() < 0.7
        )
    path.write_bytes(draw.corrupted(path.read_bytes()))
    return path


def table(draw, path, made):
    """A table of text, with odd names and cells, and now and then a file that says what they are."""
    names = ["t", *(f"imu_{k}.{axis}" for k in range(len(made)) for axis in "xyz")]
    about = {
        "time": "t",
        "time_unit": "s",
        "imus": [["imu_0.x", "imu_0.y", "imu_0.z"]] * draw.choice((1, 2, 900)),
    }
    if draw.odd() or draw.odd():
        path.with_name("columns.yaml").write_text(
            odd_yaml(draw, json.dumps(about, indent=1)), errors="replace"
        )
    names = [
        draw.choice((*NAMES, "t", '"', "gyro_x [\x1b[2J]")) if draw.odd() else name
        for name in names
    ]
    rows = [names]
    for k in range(min(len(made[0].stamp), draw.choice((0, 30, 300)))):
        cells = [
            made[0].stamp[k] * 1e-6,
            *(value for unit in made for value in unit.rate[k]),
        ]
        rows.append(
            [
                draw.choice(("", '"', "x" * 200_000, *SCALARS))
                if draw.odd()
                else repr(float(c))
                for c in cells
            ]
        )
    text = draw.choice(("\n", "\r\n")).join(
        draw.choice((",", ",", ";", "\t")).join(row) for row in rows
    )
    path.write_text(text + "\n" * (draw.random() < 0.8), errors="replace")
    return path


def storage(draw, stem):
    kind = draw.choice(
        (*[".db3"] * 3, *[".bag"] * (stem.name == "bag"), *[".mcap"] * 6)
    )
    path = stem.with_name(f"{stem.name}{kind}")
    if kind == ".db3":
        database(draw, path)
    elif kind == ".bag":
        topics, sent = messages(draw)
        named = [
            (topics[k][0], at % 2**61, data) for k, at, data in sent if topics[k][0]
        ]
        packing = draw.choice(
            (None, Ros1Writer.CompressionFormat.BZ2, Ros1Writer.CompressionFormat.LZ4)
        )
        path.write_bytes(
            draw.corrupted(
                write_ros1(path, named, packing, dict(topics[:2])).read_bytes()
            )
        )
    else:
        path.write_bytes(mcap(draw))
    if draw.random() < 0.1:
        packer = zstandard.ZstdCompressor().compressobj()
        data = packer.compress(path.read_bytes())
        data += b"".join(
            packer.compress(bytes(1 << 20))
            for _ in range(draw.choice((0, 0, 0, 0, 0, 512)))
        )
        path.unlink()
        path = path.with_name(f"{path.name}.zstd")
        path.write_bytes(draw.damaged(data + packer.flush()))
    return path


# Text ----------------------------------------------------------------------------------------------------------------


def odd_yaml(draw, text):
    """Put odd values in place of some of a YAML text."""
    lines = text.split("\n")
    for k, line in enumerate(lines):
        if draw.odd() or draw.odd():
            head, colon, _ = line.rpartition(": ")
            lines[k] = f"{head}{colon}{draw.choice(SCALARS)}"
    if draw.odd():
        lines.insert(
            0,
            draw.choice(
                (
                    "a: &a [1,1,1,1,1,1,1,1,1]",
                    "%YAML 9.9",
                    "\ufeff",
                    "--- 1",
                    "---",
                    "...",
                )
            ),
        )
    if draw.odd():
        lines += [
            f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]"
            for a, b in itertools.pairwise("abcdefgh")
        ]
    return "\n".join(lines)


def parameters(draw):
    settings = dict(PARAMETERS)
    if draw is not SOUND and draw.random() < 0.2:
        settings = {
            "input": "channels",
            "channels.topic": "/gyros",
            "geometry.preset": "two_triad_cone",
        }
    if draw.odd() or draw.odd():
        settings[draw.choice(list(Config().parameters()))] = draw.choice(
            (1.0, -1, "x", [0.1], 10**9)
        )
    lines = [f"    {name}: {json.dumps(value)}" for name, value in settings.items()]
    return odd_yaml(draw, "\n".join(["/**:", "  ros__parameters:", *lines]))


def words_of(draw, folder):
    """Make the files of a case, and the command line that reads them."""
    verb = draw.choice(
        (
            *["replay"] * 27,
            *["inspect"] * 18,
            *["calibrate"] * 2,
            *["convert"] * 2,
            "geometry",
        )
    )
    source = recording(draw, folder) if verb != "geometry" else Path()
    of_config = parameters(draw if verb == "geometry" or draw.random() < 0.2 else SOUND)
    if source.suffix in (".bin", ".csv", ".tlog", ".ulg"):
        of_config = of_config.replace(TOPICS[0], "/imu_0").replace(TOPICS[1], "/imu_1")
    write(folder / "config.yaml", of_config)
    if verb == "geometry":
        return [verb, str(folder / "config.yaml")]
    words = [verb, str(source)]
    if verb == "convert":
        return [*words, "--output", str(folder / "out" / "bag")]
    if verb == "inspect":
        return words + ["--write", str(folder / "out" / "made.yaml")] * (
            draw.random() < 0.7
        )
    words += ["--config", str(folder / "config.yaml")]
    for option, values, share in (
        ("--start", ("0.1", "1e30", "-1", "nan", "1e-300"), 0.2),
        ("--end", ("0.3", "1e30", "nan", "inf", "1e-9"), 0.1),
    ):
        words += [f"{option}={draw.choice(values)}"] * (draw.random() < share)
    if verb == "calibrate":
        return [*words, "--output", str(folder / "out" / "made.yaml")]
    return words + replay_words(draw, folder)


def replay_words(draw, folder):
    words = []
    for option, name in (("--json", "s.json"), ("--csv", "s.csv"), ("--output", "bag")):
        words += [option, str(folder / "out" / name)] * (draw.random() < 0.3)
    if draw.random() < 0.2:
        size, start = (
            draw.choice(("0.2", "1e308", "nan", "-5")),
            draw.choice(("0.1", "1e30", "0", "inf")),
        )
        kind = draw.choice(("bias", "drift", "stuck"))
        words += ["--fault", f"channel=imu_1.y kind={kind} size={size} start={start}"]
    if draw.random() < 0.1:
        write(folder / "scenario.yaml", odd_yaml(draw, SCENARIO))
        words += ["--scenario", str(folder / "scenario.yaml")]
    return words


def write(path, text):
    path.write_bytes(text.encode("utf-8", "surrogatepass"))


# Cases ---------------------------------------------------------------------------------------------------------------


def run_case(number):
    """Make a case, run it, and look at what it leaves: the command line and what is wrong, empty if nothing."""
    folder = Path(tempfile.mkdtemp(prefix="fdi_fuzz_"))
    try:
        (folder / "out").mkdir()
        words = words_of(Draw(f"fdi {number}"), folder)
        given = inputs(folder)
        out, err = (
            io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)
            for _ in range(2)
        )
        begun, before = time.process_time(), peak()
        with (
            warnings.catch_warnings(record=True) as warned,
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            warnings.simplefilter("always")
            try:
                code, wrong = command_line.main(words), ""
            except BaseException:
                code, wrong = -1, traceback.format_exc()
        seconds, growth = time.process_time() - begun, peak() - before
        said, errors = (stream.buffer.getvalue().decode() for stream in (out, err))
        return words, (
            wrong
            or "".join(
                f"{w.category.__name__}: {w.message} in {w.filename}:{w.lineno}\n"
                for w in warned
            )
            or look(folder, code, said, errors)
            or (
                ""
                if inputs(folder) == given
                else f"changed what it read: {given}, now {inputs(folder)}"
            )
            or (
                f"took {seconds:.1f} s of the processor"
                if seconds > MOST_SECONDS
                else ""
            )
            or (f"took {growth >> 20} MB of memory" if growth > MOST_GROWTH else "")
        )
    finally:
        shutil.rmtree(folder)


def inputs(folder):
    """Size and time of all files of a case, but for its outputs."""
    files = {
        path: path.lstat()
        for path in folder.rglob("*")
        if (folder / "out") not in (path, *path.parents)
    }
    return {
        str(path): (about.st_size, about.st_mtime_ns) for path, about in files.items()
    }


def peak():
    """Memory of this process at its largest so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def look(folder, code, said, errors):
    """What is wrong with what a case said and left; empty if nothing."""
    made = sorted(os.listdir(folder / "out"))
    # A loaded machine makes a verb report how far it is.
    errors = re.sub(
        r"^fdi: .*(so far|s left|after [0-9]+ s)\n", "", errors, flags=re.MULTILINE
    )
    one_line = errors.startswith("fdi: ") and errors.count("\n") == 1
    for text, well in (
        (f"exit code {code}: {errors}", code in (0, 2, 3, 4)),
        (f"refused in other than one line: {errors!r}", code != 2 or one_line),
        (f"success with words of trouble: {errors!r}", code != 0 or not errors),
        (
            f"prints what a terminal obeys: {said + errors!r}",
            (said + errors).replace("\n", "").isprintable(),
        ),
        (f"refused, and left {made}", code != 2 or not made),
    ):
        if not well:
            return text
    try:
        for name in made:
            if name == "s.json":
                json.loads(
                    (folder / "out" / name).read_text(),
                    parse_constant=lambda text: 1 / 0,
                )
            if name == "made.yaml":
                Config.from_file(folder / "out" / name)
    except (FdiError, ValueError, ZeroDivisionError) as error:
        return f"wrote a {name} that cannot be read: {error}"
    return ""
