# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a monitor publishes as bytes: one encoder for the live node and for the output bag."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from fdi_ros.core.messages import LAST_STAMP, ChannelsTemplate, ImuTemplate, fill_imu, fill_integrity
from fdi_ros.monitor.diagnostics import StatusLine
from fdi_ros.monitor.output import Output


@dataclass(frozen=True)
class OutputTopic:
    """One topic that a monitor publishes."""

    name: str
    """As the node publishes it, before it is remapped."""
    type: str
    """Of its messages: ``sensor_msgs/msg/Imu``."""


FUSED = OutputTopic("fused", "sensor_msgs/msg/Imu")
INTEGRITY = OutputTopic("~/integrity", "std_msgs/msg/Float64MultiArray")
DIAGNOSTICS = OutputTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
OUTPUTS = (FUSED, INTEGRITY, DIAGNOSTICS)
"""All that a node publishes and an output bag holds."""


class Message(NamedTuple):
    """One message to be published or recorded."""

    topic: OutputTopic
    stamp: int
    """Of what it is about, ns."""
    data: bytes
    """Serialised."""


class Encoder:
    """Makes messages of the output of a monitor.

    Live, compiled code fills `fused` and `integrity` in place by the same functions that are used here.

    Parameters
    ----------
    frame_id
        Of the fused rate.
    n
        Number of channels.
    """

    def __init__(self, frame_id: str, n: int) -> None:
        self.n = n
        self.fused = ImuTemplate(frame_id)
        """Fused rate and its covariance."""
        self.integrity = ChannelsTemplate(n + 5)
        """Statistic, threshold, states of the channels, protection level."""

    def fill_integrity(self, row: Any) -> None:
        """Write the integrity of one sample, a record `fdi_ros.core.records.OutputRow`, in place."""
        fill_integrity(self.integrity.bytes, self.integrity.at, row, self.n)

    def encode(self, output: Output, shift: int = 0) -> Iterator[Message]:
        """Encode what is said of samples: of each its fused rate, if there is one, and its integrity.

        Parameters
        ----------
        output
            Of the samples.
        shift
            To be taken off their stamps to have those of the messages, ns.
        """
        for row in output.rows:
            stamp = int(row["stamp"])
            if row["valid"]:
                fill_imu(self.fused.bytes, self.fused.at, int(row["instant"]) - shift, row["rate"], row["covariance"])
                yield Message(FUSED, stamp, self.fused.bytes.tobytes())
            self.fill_integrity(row)
            yield Message(INTEGRITY, stamp, self.integrity.bytes.tobytes())


def encode_diagnostics(lines: Sequence[StatusLine], now: int) -> Message:
    """Encode diagnostics, stamped at the clock time now, ns; what no header can hold is moved to its end."""
    # A simulator may say any time.
    stamp = min(max(now, 0), LAST_STAMP)
    out = bytearray(struct.pack("<4BiI", 0, 1, 0, 0, *divmod(stamp, 1_000_000_000)))
    _add_text(out, "")
    _add_count(out, len(lines))
    for line in lines:
        out.append(line.level)
        for text in (line.name, line.message, line.hardware_id):
            _add_text(out, text)
        _add_count(out, len(line.values))
        for pair in line.values:
            for text in pair:
                _add_text(out, text)
    return Message(DIAGNOSTICS, stamp, bytes(out))


def _add_text(out: bytearray, text: str) -> None:
    data = text.encode() + b"\0"
    _add_count(out, len(data))
    out += data


def _add_count(out: bytearray, count: int) -> None:
    # The 4 bytes of encapsulation do not change what is aligned to 4.
    out += bytes(-len(out) % 4) + struct.pack("<I", count)
