# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The outputs of the monitor as comma-separated values, one line per sample."""

from __future__ import annotations

import csv
from typing import TextIO

import numpy as np

from fdi_ros.core.states import ChannelState
from fdi_ros.model.block import Block
from fdi_ros.monitor.output import Output
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.run import Sink

_STATES = np.array([state.name for state in ChannelState])


class CsvFile(Sink):
    """A table of all samples.

    The columns: stamp, ns; fused rate and its standard deviation, rad/s; statistic, threshold, alarm; then of every
    channel what came in, rad/s, its residual, rad/s, and its state. Empty where there is nothing.

    Parameters
    ----------
    file
        Open for writing text.
    names
        Of the channels.
    """

    def __init__(self, file: TextIO, names: tuple[str, ...]) -> None:
        self._writer = csv.writer(file)
        head = ["stamp", "rate_x", "rate_y", "rate_z", "std_x", "std_y", "std_z", "statistic", "threshold", "alarm"]
        self._writer.writerow(head + [f"{name}{what}" for name in names for what in ("", ".residual", ".state")])

    def add(self, block: Block, output: Output, pipeline: Pipeline) -> None:
        """Write the next samples."""
        variance = np.diagonal(output.covariance, axis1=1, axis2=2)
        numbers = np.column_stack([output.rate, np.sqrt(variance), output.statistic, output.threshold])
        channels = np.stack([block.z, output.residual], axis=2).tolist()
        states = _STATES[output.state].tolist()
        rows = zip(output.stamp.tolist(), numbers.tolist(), output.alarm.tolist(), channels, states, strict=True)
        for stamp, figures, alarm, values, names in rows:
            line = [stamp, *map(_text, figures), int(alarm)]
            for pair, state in zip(values, names, strict=True):
                line += [_text(pair[0]), _text(pair[1]), state]
            self._writer.writerow(line)


def _text(value: float) -> str:
    return "" if value != value else repr(value)
