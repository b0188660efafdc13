# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that a replay writes: a table of all samples, and a bag with the messages of the node."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from fdi_ros import __version__
from fdi_ros.bag.raw import MADE_BY_FDI, Batch
from fdi_ros.bag.samples import Newest, Samples
from fdi_ros.config.config import Config
from fdi_ros.core.sources import source_of
from fdi_ros.core.states import ChannelState
from fdi_ros.model.samples import Block, Int
from fdi_ros.monitor.diagnostics import (
    DIAGNOSTICS,
    InputStatus,
    describe,
    encode_diagnostics,
)
from fdi_ros.monitor.output import OUTPUTS, Encoder, Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.recent import RecentHealth
from fdi_ros.replay.run import Sink
from fdi_ros.system.files import TIMES

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

_STATE_NAMES = np.array([state.name for state in ChannelState])


class CsvFile(Sink):
    """A table of all samples, in a file that is open for text.

    Columns: stamp, ns. Fused rate and its standard deviation, rad/s. Statistic, threshold, alarm.
    Then measured value, residual and state of each channel, in rad/s, or m/s^2 for accelerometers.
    Unknown values are empty.
    """

    def __init__(self, file: TextIO) -> None:
        self._writer = csv.writer(file)
        self._begun = False

    def _begin(self, names: Sequence[str]) -> None:
        """Write the head for channels with these names."""
        self._begun = True
        head = [
            "stamp",
            "rate_x",
            "rate_y",
            "rate_z",
            "std_x",
            "std_y",
            "std_z",
            "statistic",
            "threshold",
            "alarm",
        ]
        self._writer.writerow(
            head
            + [
                f"{name}{what}"
                for name in names
                for what in ("", ".residual", ".state")
            ]
        )

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Write the next samples."""
        if not self._begun:
            self._begin(pipeline.channel_names)
        variance = np.diagonal(output.covariance, axis1=1, axis2=2)
        numbers = np.column_stack(
            [output.rate, np.sqrt(variance), output.statistic, output.threshold]
        )
        values = np.hstack([half.z for half in block.halves])
        channels = np.stack([values, output.residual], axis=2).tolist()
        states = _STATE_NAMES[output.state].tolist()
        rows = zip(
            output.stamp.tolist(),
            numbers.tolist(),
            output.alarm.tolist(),
            channels,
            states,
            strict=True,
        )
        for stamp, figures, alarm, values, names in rows:
            line = [stamp, *map(_text, figures), int(alarm)]
            for pair, state in zip(values, names, strict=True):
                line += [_text(pair[0]), _text(pair[1]), state]
            self._writer.writerow(line)


def _text(value: float) -> str:
    return "" if value != value else repr(value)


NODE = "/fdi_node"
"""Default name of the node, which replaces ``~``."""


class OutputBag(Sink):
    """A rosbag2 folder with one MCAP file, as `ros2 bag record` writes beside a running node.

    The folder must not exist.
    """

    stops_at_events = True
    #: period of the regular diagnostics, ns
    period = 1_000_000_000

    def __init__(self, path: Path, config: Config) -> None:
        # The types of all releases of ROS 2, which most replays need not load.
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        # This mark allows a later run to replace the bag. Other recordings are never replaced.
        self._writer.set_custom_data(MADE_BY_FDI, __version__)
        self._frame = config.body_frame
        self._encoder: Encoder | None = None
        """Encoder of the messages. None: no sample yet."""
        self._source = source_of(config)
        self._before: list[tuple[Newest, dict[str, int]]] = [
            (Newest(), {}) for _ in config.topics
        ]
        self._health = RecentHealth()
        self._shift = 0
        """Stamp of a sample minus the stamp of its message, ns."""
        self._later = 0
        """Time of recording minus stamp, ns, so that outputs lie beside their inputs."""

    def __enter__(self) -> OutputBag:
        self._writer.open()
        self._inputs = [
            self._topic(name, self._source.type) for name in self._source.topics
        ]
        topics = (*(output.topic for output in OUTPUTS), DIAGNOSTICS)
        self._outputs = {topic: self._topic(topic.name, topic.type) for topic in topics}
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def tap(self, batch: Batch, rows: Int) -> None:
        """Copy the used messages."""
        for k in rows.tolist():
            self._writer.write(
                self._inputs[int(batch.topic[k])],
                int(batch.log_time[k]),
                batch.message(k),
            )

    def begin(self, samples: Samples) -> None:
        """Store the difference of stamps and times of recording."""
        newest = max(samples.newest, key=lambda topic: topic.log_time)
        self._shift = samples.alignment.shift
        self._later = newest.log_time - newest.stamp - self._shift

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Write the messages that the node would have published."""
        if self._encoder is None:
            names = pipeline.channel_names
            n = pipeline.geometry.n
            self._encoder = Encoder(self._frame, names, n)
        for topic, stamp, data in self._encoder.encode(output, self._shift):
            self._writer.write(self._outputs[topic], self._time(stamp), data)
        if output.events:
            self._diagnose(pipeline, self._time(int(output.stamp[-1])), ())

    def tick(self, samples: Samples, pipeline: Pipeline) -> None:
        """Write the regular diagnostics, once per second of the recording."""
        now = max(topic.log_time for topic in samples.newest)
        inputs = [
            self._input_status(k, samples, now) for k in range(len(samples.topics))
        ]
        self._health.add(pipeline.status(), inputs, now * 1e-9)
        self._diagnose(pipeline, now, inputs)

    def _input_status(self, k: int, samples: Samples, now: int) -> InputStatus:
        """Return the state of a topic after the messages so far, by the clock of the recorder."""
        source = self._source
        newest = samples.newest[k]
        topic = samples.topics[k]
        counts = {"malformed": samples.malformed[topic]}
        if source.stamped:
            counts |= samples.alignment.counters[k]
            del counts["received"]
        before, counted = self._before[k]
        self._before[k] = newest, counts
        silent = (now - newest.log_time) * 1e-9 if newest.received else None
        spent = (newest.log_time - before.log_time) * 1e-9
        return InputStatus(
            name=source.names[k],
            topic=topic,
            received=newest.received,
            rate=(newest.received - before.received) / spent
            if before.received and spent > 0
            else 0.0,
            silent=silent,
            live=silent is not None
            and silent <= source.timeout
            and (not source.stamped or samples.alignment.is_live(k)),
            lag=samples.alignment.lag[k] * 1e-9 if source.stamped else 0.0,
            max_lag=source.max_lag,
            offset=(newest.log_time - newest.stamp) * 1e-9
            if source.stamped and newest.received
            else None,
            counts=counts,
            recent={
                kind: count - counted.get(kind, 0) for kind, count in counts.items()
            },
        )

    def _time(self, stamp: int) -> int:
        """Return the time of recording for a sample, ns. Unlike stamps, it must be plausible."""
        return min(max(stamp + self._later, 0), TIMES.latest)

    def _topic(self, name: str, kind: str) -> Connection:
        """Add a topic with its name without remapping."""
        name = (
            name.replace("~", NODE, 1)
            if name.startswith("~")
            else f"/{name.lstrip('/')}"
        )
        return self._writer.add_connection(name, kind, typestore=self._store)

    def _diagnose(
        self, pipeline: Pipeline, now: int, inputs: Sequence[InputStatus]
    ) -> None:
        concerns = self._health.concerns
        lines = describe(pipeline.status(), inputs=inputs, concerns=concerns)
        self._writer.write(
            self._outputs[DIAGNOSTICS], now, encode_diagnostics(lines, now)
        )
