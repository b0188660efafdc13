# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What replays are given and what comes of them, for the tests: every kind of fault once, outputs, summaries."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fdi_ros.faults.fault import load_scenario
from fdi_ros.monitor.output import Output
from fdi_ros.replay.run import Sink
from fdi_ros.replay.summary import (
    BiasResult,
    MonitorResult,
    ProtectionLevel,
    SampleRate,
    StreamResult,
    Summary,
)

SCENARIO = Path(__file__).parents[2] / "config" / "scenarios" / "every_kind.yaml"
"""Every kind of fault once."""


def examples(channel, unit, start, stop):
    """A fault of each kind by its name; kinds that strike a whole unit strike that one."""
    return {
        fault.kind.name: replace(
            fault,
            channel=unit if fault.kind.whole_unit else channel,
            start=start,
            stop=stop,
        )
        for fault in load_scenario(SCENARIO)
    }


class Keep(Sink):
    """Keeps all that passes."""

    def __init__(self):
        self.outputs, self.blocks = [], []

    def add(self, block, output, pipeline):
        self.blocks.append(block.z)
        self.outputs.append(output)

    @property
    def z(self):
        """What the monitor was given, (N, n) rad/s."""
        return np.concatenate(self.blocks)

    @property
    def output(self):
        """All that it said."""
        rows = np.concatenate([output.rows for output in self.outputs])
        return Output(
            rows,
            self.outputs[0].n,
            [event for output in self.outputs for event in output.events],
        )


def summary_of(scores, bag="bag"):
    """The summary of a replay of which nothing but the scores matters."""
    levels = ProtectionLevel((None,) * 3, (None,) * 3)
    monitor = MonitorResult((), (), (), BiasResult("fixed", ()), "", levels, 1.0)
    stream = StreamResult(SampleRate(100.0, 100.0), None, 0, {}, 0, {}, ())
    return Summary("sequential", scores, monitor, bag=bag, stream=stream, seconds=1.0)
