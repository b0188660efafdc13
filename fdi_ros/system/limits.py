# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""How large what is read may be: every limit on files, in one place. `docs/security.md` says what happens beyond each.

They are far above what gyros need, and such that nothing read takes 1 GB of memory or runs on without end.
"""

from __future__ import annotations

CHUNK_BYTES = 1 << 26  # of one chunk or message of a recording, decompressed
PORTION_BYTES = 1 << 24  # messages of a database are handed on when they hold so much
FREE_BYTES, FREE_RATIO = 1 << 28, 50  # a recording may unpack to so many bytes, and so many times its own size more
RECORDS, RECORD_BYTES = 300_000, 4096
"""An MCAP file may hold so many records outside chunks, and one for each so many of its bytes more."""
CHANNELS = 4096  # topics of one recording, and descriptions of topics and of types in one file
DESCRIPTION_BYTES = 1 << 20  # of the description of a topic or a type
NAME = 255  # characters of the name of a topic or a type, as in DDS
FILES = 800  # files of one recording; they are open together
LATEST = 2**31 * 10**9 - 1  # ns: times of recording lie between 0 and this, in 2038: what a stamp of ROS 2 can say
EARLIEST = 946_684_800 * 10**9
"""ns: a time before this, the year 2000, is no date: it counts from a start (of an autopilot, of a simulation)."""
LOG_SPAN = 10**13
"""us: times of a flight log lie between 0, the start of the autopilot, and this, 115 days; or they are dates."""
ULOG_BYTES, TLOG_BYTES = 1 << 28, 1 << 27
"""Of a log that a library reads whole: PX4's, hours of it, and that of a ground station, a day of it."""
ULOG_FIELDS, ULOG_OTHER_BYTES, ULOG_MESSAGE_COST, ULOG_TOPIC_COST = 1000, 1 << 26, 1 << 8, 1 << 16
"""Of PX4's: fields of a message; bytes of messages that are no samples, each counted as so many more, for a library
makes an object of each, and of a topic one for each field."""
ROS1_INDEX_BYTES = 48 << 20
"""Of the index of a bag of ROS 1, 12 for each message of any topic: an hour at 1100 messages a second."""
CSV_LINE_BYTES = 1 << 20  # of the line of names of a table of text
STEPS, STEPS_PER_BYTE = 10_000_000, 20
"""A query of a database may take so many steps of SQLite, and so many for each byte of the file more."""

YAML_BYTES = 1 << 20
YAML_NODES = 50_000  # values of a YAML file, those behind aliases counted each time
YAML_DEPTH = 50
YAML_DIGITS = 64  # characters of a number

WORD, LINE = 120, 4000  # characters of a text from a file, and of a whole line with such texts, that are shown


def max_unpacked_bytes(size: int) -> int:
    """Bytes that a recording of so many bytes may unpack to."""
    return FREE_BYTES + FREE_RATIO * size
