# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings in Python, in one line each: `fdi_ros.read` and `fdi_ros.replay`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import Fault, fault_from, parse_fault
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import build_geometry
from fdi_ros.replay.run import Request
from fdi_ros.replay.run import replay as run_replay
from fdi_ros.replay.summary import Summary
from fdi_ros.setup.starting_config import assumed_config, starting_config_of

Source = str | PathLike[str]
ConfigSource = Config | str | PathLike[str] | None
"""Settings, or a parameter file; None: what ``fdi inspect`` writes for the recording."""
Injected = Fault | str | Mapping[str, Any]  # a fault, or its words, or a mapping with the same keys


def read(path: Source, config: ConfigSource = None, start: float = 0.0, end: float = math.inf) -> Iterator[Block]:
    """Read a recording block by block, aligned as the node aligns its messages.

    Parameters
    ----------
    path
        rosbag2 folder, or one .mcap, .db3, .bag, .csv, .bin, .ulg or .tlog file.
    config
        Settings, or a ROS 2 parameter file; None: what ``fdi inspect`` writes for this recording.
    start, end
        Part to be read, s from the first message.

    Returns
    -------
    Blocks of consecutive samples: stamps (N,) ns, values (N, n) rad/s, as `Pipeline.process` takes them.

    Raises
    ------
    FdiError
        If there is no such recording, or it lacks a topic of the settings.
    """
    bag = Path(path)
    if config is None:
        settings = Config.from_parameters(starting_config_of(bag, f"{bag}: no settings for it").parameters)
    else:
        settings = Config.of(config)
    # Refused now, not with the first block.
    recording = Recording(bag)
    return _blocks(recording, Samples(recording, settings, build_geometry(settings).n, start, end))


def replay(
    path: Source,
    config: ConfigSource = None,
    faults: Sequence[Injected] = (),
    start: float = 0.0,
    end: float = math.inf,
) -> Summary:
    """Replay a recording as ``fdi replay`` does.

    Parameters
    ----------
    path, start, end
        As of `read`.
    config
        Settings, or a ROS 2 parameter file; None: what ``fdi inspect`` writes for this recording, if its units are
        mounted alike.
    faults
        To be injected, each in words or as a mapping: ``"channel=imu_2.y kind=bias size=0.2 start=30"`` or
        ``{"channel": "imu_2.y", "kind": "bias", "size": 0.2, "start": 30}``.

    Returns
    -------
    What was declared, what became of the faults, and the state of the monitor at the end.

    Raises
    ------
    FdiError
        If recording, settings or faults do not fit, or there are no settings and none can be assumed.
    """
    bag = Path(path)
    settings = assumed_config(bag)[0] if config is None else Config.of(config)
    return run_replay(Request(bag, settings, tuple(map(_fault, faults)), start, end))


def _fault(given: Injected) -> Fault:
    if isinstance(given, Fault):
        return given
    return parse_fault(given) if isinstance(given, str) else fault_from(given)


def _blocks(recording: Recording, samples: Samples) -> Iterator[Block]:
    with recording:
        yield from samples.blocks()
