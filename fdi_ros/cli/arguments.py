# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a verb is, and the arguments that several verbs take.

This module, and each verb's own until the verb runs, import no NumPy and no Numba: usage errors come at once, and help
without the compiler.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fdi_ros.detectors import DETECTORS
from fdi_ros.system.installation import resolve, shipped_files


class Verb(NamedTuple):
    """One verb."""

    meaning: str
    examples: Sequence[str]
    """The first is the one to begin with."""
    add_arguments: Callable[[ArgumentParser], None]
    run: Callable[[Namespace], int]
    """Returns the exit code; what needs NumPy is imported in it."""
    libraries: Sequence[str] = ()
    """That the verb needs and a live node does not."""


def add_bag(parser: ArgumentParser) -> None:
    """Take a recording."""
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help="rosbag2 folder, or one .mcap, .db3, .bag, .csv, .bin, .ulg or .tlog file"
    )


def add_config(parser: ArgumentParser, purpose: str = "", **options: Any) -> None:
    """Take parameter files."""
    parser.add_argument(
        "--config",
        type=resolve,
        action="append",
        metavar="FILE",
        help=f"ROS 2 parameter file{purpose}, a shipped one by its name alone; may be repeated, later ones win",
        **{"required": True, **options},
    )


def add_part(parser: ArgumentParser) -> None:
    """Take a part of the recording."""
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="from here, seconds from the start")
    parser.add_argument("--end", type=float, default=math.inf, metavar="S", help="up to here")


def add_fault(parser: ArgumentParser, meaning: str) -> None:
    """Take faults; their kinds, which need NumPy, are looked up when the help is printed."""
    added = parser.add_argument("--fault", action="append", default=[], metavar="'KEY=VALUE ...'")
    added.help = f"{meaning}; kinds: %(kinds)s"
    vars(added)["kinds"] = _FaultKinds()


class _FaultKinds:
    def __str__(self) -> str:
        from fdi_ros.faults.kinds import FAULT_KINDS

        return ", ".join(FAULT_KINDS)


def detector_names() -> str:
    """List the detectors for a help, the one that flies first."""
    return ", ".join(reversed(DETECTORS))


def add_detector(parser: ArgumentParser) -> None:
    """Take a detector."""
    parser.add_argument(
        "--detector", metavar="NAME", help=f"use this detector instead of the configured one: {detector_names()}"
    )


def add_file(parser: ArgumentParser, name: str, meaning: str, metavar: str = "FILE", **options: Any) -> None:
    """Take a file to be written."""
    parser.add_argument(name, type=Path, metavar=metavar, help=meaning, **options)


def add_flag(parser: ArgumentParser, name: str, meaning: str) -> None:
    """Take a flag."""
    parser.add_argument(name, action="store_true", help=meaning)


def add_report(parser: ArgumentParser, meaning: str = "write a page with tables and plots") -> None:
    """Take a page to be written."""
    add_file(parser, "--report", meaning, "FILE.html")


def add_results(parser: ArgumentParser, force: str = "overwrite files that exist") -> None:
    """Take what every verb takes that has results; force: what that does."""
    meaning = "write all figures as JSON, in SI units; - is standard output, tables then go to standard error"
    add_file(parser, "--json", meaning)
    add_flag(parser, "--force", force)
    add_flag(parser, "--quiet", "print nothing but errors; no progress")


def add_degrees(parser: ArgumentParser) -> None:
    """Take the unit of what is printed."""
    add_flag(parser, "--degrees", "print angular rates in deg/s; what is read and written stays in rad/s")


def add_workers(parser: ArgumentParser) -> None:
    """Take who does the work."""
    parser.add_argument("--workers", type=int, metavar="N", help="processes; default: as many as there are cores")
    parser.add_argument(
        "--scheduler",
        metavar="ADDRESS",
        help="Dask scheduler to work instead: tls://host:port (certificates: Dask's configuration), or where nobody"
        " else reaches it tcp://host:port",
    )


def shipped(kind: str) -> str:
    """List the shipped files of a kind, for a help."""
    return ", ".join(path.name for path in shipped_files() if path.parent.name == kind)
