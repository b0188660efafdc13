# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Recordings in Python, in one line each: `fdi_ros.read` and `fdi_ros.replay`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from os import PathLike
from pathlib import Path

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import Samples
from fdi_ros.config.config import Config
from fdi_ros.faults.fault import Fault, parse_fault
from fdi_ros.model.samples import Block
from fdi_ros.monitor.build import build_geometry
from fdi_ros.replay.run import Request
from fdi_ros.replay.run import replay as run_replay
from fdi_ros.replay.summary import Summary
from fdi_ros.setup.starting_config import starting_config_of

Source = str | PathLike[str]
Settings = Config | str | PathLike[str] | None
"""Settings, or a parameter file; None: what ``fdi inspect`` writes for the recording."""


def read(path: Source, config: Settings = None, start: float = 0.0, end: float = math.inf) -> Iterator[Block]:
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
    settings = _settings(config, bag)
    # Refused now, not with the first block.
    recording = Recording(bag)
    return _blocks(recording, Samples(recording, settings, build_geometry(settings).n, start, end))


def replay(
    path: Source,
    config: Settings = None,
    faults: Sequence[Fault | str] = (),
    start: float = 0.0,
    end: float = math.inf,
) -> Summary:
    """Replay a recording as ``fdi replay`` does.

    Parameters
    ----------
    path, config, start, end
        As of `read`.
    faults
        To be injected: ``"channel=imu_2.y kind=bias size=0.2 start=30"``.

    Returns
    -------
    What was declared, what became of the faults, and the state of the monitor at the end.

    Raises
    ------
    FdiError
        If recording, settings or faults do not fit.
    """
    bag = Path(path)
    injected = tuple(parse_fault(fault) if isinstance(fault, str) else fault for fault in faults)
    return run_replay(Request(bag, _settings(config, bag), injected, start, end))


def _settings(config: Settings, bag: Path) -> Config:
    if isinstance(config, Config):
        return config
    if config is not None:
        return Config.from_file(Path(config))
    return Config.from_parameters(starting_config_of(bag, f"{bag}: no settings for it").parameters)


def _blocks(recording: Recording, samples: Samples) -> Iterator[Block]:
    with recording:
        yield from samples.blocks()
