"""``fdi replay``: arguments, files, and the words for a terminal."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from fdi_ros.bag.replay import Request, replay
from fdi_ros.bag.tables import summary_text
from fdi_ros.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.study.faults import load_scenario, parse_fault


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Say what the verb takes."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder, or one .mcap or .db3 file")
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="ROS 2 parameter file")
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="'KEY=VALUE ...'",
        help="inject a fault: 'channel=imu_2.y kind=bias size=0.2 start=30 stop=60'; may be repeated",
    )
    parser.add_argument("--scenario", type=Path, metavar="FILE", help="inject the faults of a scenario file")
    parser.add_argument("--detector", metavar="NAME", help="use this detector instead of the configured one")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="from here, seconds from the start")
    parser.add_argument("--end", type=float, default=float("inf"), metavar="S", help="up to here")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the summary")
    parser.add_argument("--force", action="store_true", help="overwrite files that exist")


def request_of(arguments: argparse.Namespace) -> Request:
    """Build what is to be replayed from the arguments."""
    changes = {"detector.name": arguments.detector} if arguments.detector else {}
    config = Config.from_file(arguments.config, changes)
    faults = tuple(parse_fault(text) for text in arguments.fault)
    if arguments.scenario is not None:
        faults += load_scenario(arguments.scenario)
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end")
    return Request(arguments.bag, config, faults, arguments.start, arguments.end)


def run(arguments: argparse.Namespace) -> int:
    """Replay, print a table, write what was asked for."""
    summary = replay(request_of(arguments))
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    sys.stdout.write(summary_text(summary))
    return 0
