# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a monitor publishes as bytes: one encoder for the live node and for the output bag."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from fdi_ros.core.messages import LAST_STAMP, ChannelsTemplate, ImuTemplate, fill_imu, fill_integrity
from fdi_ros.monitor.diagnostics import StatusLine
from fdi_ros.monitor.output import Output

Template = ImuTemplate | ChannelsTemplate


class Topic(NamedTuple):
    """One topic that a monitor publishes."""

    name: str
    """As the node publishes it, before it is remapped."""
    type: str
    """Of its messages: ``sensor_msgs/msg/Imu``."""


@dataclass(frozen=True, eq=False)
class SampleOutput:
    """What is said of each sample on a topic of its own."""

    topic: Topic
    make: Callable[[str, int], Template]
    """Makes a message to be filled, from the frame_id of the rate and the number of channels n."""
    fill: Callable[[Template, Any, int, int], None]
    """Fills it from an `fdi_ros.core.records.OutputRow`, n, and what is to be taken off its stamp, ns."""
    needs_rate: bool = False
    """Whether it is of samples with a fused rate alone."""
    on_demand: bool = False
    """Whether the node leaves it out while nobody subscribes."""
    by_path: bool = False
    """Whether the live sample path fills it, by the same function."""


def _fill_fused(out: Template, row: Any, n: int, shift: int) -> None:
    fill_imu(out.bytes, out.at, int(row["instant"]) - shift, row["rate"], row["covariance"])


def _fill_integrity(out: Template, row: Any, n: int, shift: int) -> None:
    fill_integrity(out.bytes, out.at, row, n)


FUSED = SampleOutput(
    Topic("fused", "sensor_msgs/msg/Imu"),
    lambda frame_id, n: ImuTemplate(frame_id),
    _fill_fused,
    needs_rate=True,
    by_path=True,
)
"""Fused rate and its covariance."""
INTEGRITY = SampleOutput(
    Topic("~/integrity", "std_msgs/msg/Float64MultiArray"),
    lambda frame_id, n: ChannelsTemplate(n + 5),
    _fill_integrity,
    on_demand=True,
    by_path=True,
)
"""Statistic, threshold, states of the channels, protection level."""
OUTPUTS = (FUSED, INTEGRITY)
"""All that is said of samples, live and in an output bag."""
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")


class Message(NamedTuple):
    """One message to be published or recorded."""

    topic: Topic
    stamp: int
    """Of what it is about, ns."""
    data: bytes
    """Serialised."""


class Encoder:
    """Makes messages of the output of a monitor.

    Parameters
    ----------
    frame_id
        Of the fused rate.
    n
        Number of channels.
    """

    def __init__(self, frame_id: str, n: int) -> None:
        self.n = n
        self.templates = {output: output.make(frame_id, n) for output in OUTPUTS}

    def fill(self, output: SampleOutput, row: Any, shift: int = 0) -> None:
        """Write what is said of one sample, a record `fdi_ros.core.records.OutputRow`, in place."""
        output.fill(self.templates[output], row, self.n, shift)

    def encode(self, results: Output, shift: int = 0) -> Iterator[Message]:
        """Encode what is said of samples: of each its fused rate, if there is one, and all else.

        Parameters
        ----------
        results
            Of the samples.
        shift
            To be taken off their stamps to have those of the messages, ns.
        """
        for row in results.rows:
            for output, template in self.templates.items():
                if row["valid"] or not output.needs_rate:
                    self.fill(output, row, shift)
                    yield Message(output.topic, int(row["stamp"]), template.bytes.tobytes())


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
