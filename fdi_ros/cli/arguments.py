# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Arguments of the verbs, apart from the verbs themselves: help and usage errors do not import NumPy and Numba."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from fdi_ros.errors import ConfigError
from fdi_ros.shipped import files, resolve

DETECTORS = (
    *("sequential", "likelihood_ratio", "cusum", "guaranteed", "recursive", "projector", "determinant"),
    *("max_residual", "rate_deviation", "mean_square_residual", "mean_abs_residual"),
)
"""Names of the detectors, as the registry has them: the one that flies first."""
KINDS = (
    *("bias", "drift", "scale", "stuck", "dropout", "intermittent", "noise", "spike", "saturation", "sign", "delay"),
    *("oscillation", "triad_loss"),
)
"""Kinds of faults, as the registry has them."""
_KINDS = f"kinds: {', '.join(KINDS)}"


def add_replay(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi replay`` takes."""
    _add_bag(parser)
    _add_config(parser)
    _add_fault(
        parser, f"inject a fault: 'channel=imu_2.y kind=bias size=0.2 start=30 stop=60'; may be repeated; {_KINDS}"
    )
    parser.add_argument(
        "--scenario",
        type=resolve,
        metavar="FILE",
        help=f"inject the faults of a scenario file; shipped: {_shipped('scenarios')}",
    )
    _add_detector(parser)
    _add_part(parser)
    parser.add_argument(
        "--check",
        metavar="'TERM ...'",
        help="exit 1 with the reasons unless all hold: detected, delay<S, isolated, isolated<S (every fault; S in s),"
        " false=N, false<N (declarations that no fault explains), declared=N, declared<N (episodes),"
        " 'CHANNEL faulty' (or ambiguous, stale, ok), judged>SHARE (else 0.5),"
        " unchecked=N, unchecked<N (channels that end STALE or UNCHECKED, else 0); <= and >= too;"
        " for example 'delay<1 isolated false=0', without injected faults 'declared=0' or 'imu_2.y faulty'",
    )
    _add_json(parser)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write a line for every sample")
    _add_report(parser, "write a report to be looked at")
    parser.add_argument("--output", type=Path, metavar="DIR", help="write a bag of what the node would have published")
    parser.add_argument("--compare", action="store_true", help="all detectors side by side, in one table")
    _add_force(parser, "overwrite outputs that exist")
    _add_quiet(parser)
    _add_degrees(parser)


def add_inspect(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi inspect`` takes."""
    _add_bag(parser)
    parser.add_argument("--output", "--write", type=Path, metavar="FILE", help="write the config to a file, too")
    _add_results(parser)
    _add_degrees(parser)


def add_convert(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi convert`` takes."""
    _add_bag(parser)
    parser.add_argument("--output", type=Path, metavar="DIR", help="rosbag2 folder to write, with one MCAP file")
    # As it was given before there was --output.
    parser.add_argument("folder", nargs="?", type=Path, help=argparse.SUPPRESS)
    _add_json(parser)
    _add_force(parser, "overwrite a bag made by fdi")
    _add_quiet(parser)


def add_calibrate(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi calibrate`` takes."""
    _add_bag(parser)
    _add_config(parser, " to start from")
    _add_output(parser)
    _add_part(parser)
    _add_reference(parser)
    _add_proof(parser)
    _add_report(parser, "write a page with tables and plots")
    _add_results(parser)
    _add_degrees(parser)


def add_geometry(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi geometry`` takes."""
    parser.add_argument("config", type=resolve, metavar="CONFIG", help="ROS 2 parameter file")
    parser.add_argument(
        "--freedom",
        type=float,
        default=10.0,
        metavar="DEG",
        help="angle by which the second of two triads may be turned, deg; default 10",
    )
    _add_report(parser, "write a page with tables and a picture")
    _add_results(parser)
    _add_degrees(parser)


def add_montecarlo(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi montecarlo`` takes."""
    parser.add_argument(
        "study", type=resolve, metavar="STUDY.yaml", help=f"what to run; shipped: {_shipped('studies')}"
    )
    parser.add_argument("--trials", type=int, metavar="N", help="trials per cell, instead of the file's")
    parser.add_argument("--seed", type=int, metavar="S", help="seed, instead of the file's")
    parser.add_argument("--workers", type=int, metavar="N", help="processes; default: as many as there are cores")
    _add_scheduler(parser)
    _add_report(parser, "write curves and tables as one page")
    _add_results(parser, "; a stopped study goes on from what is beside the file")


def add_watch(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi watch`` takes."""
    parser.add_argument("--node", default="", metavar="/NS/NAME", help="the monitor; default: the only one running")
    parser.add_argument("--plain", action="store_true", help="line by line, as where the output is no terminal")


def add_shipped(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi shipped`` takes."""
    parser.add_argument("name", nargs="?", default="", metavar="NAME", help="only this file, such as two_imus.yaml")
    parser.add_argument(
        "--node",
        action="append",
        default=[],
        metavar="NAME",
        help="print diagnostics.yaml made for a monitor of this name, such as /drone/fdi_node; may be repeated",
    )
    _add_results(parser)


def add_compile(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi compile`` takes."""
    meaning = f"for these detectors; default: for all: {', '.join(DETECTORS)}"
    parser.add_argument("--detector", nargs="+", metavar="NAME", help=meaning)
    _add_results(parser)


def add_setup(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi setup`` takes."""
    _add_bag(parser)
    _add_output(parser)
    _add_part(parser)
    _add_reference(parser)
    _add_proof(parser)
    _add_report(parser, "page of what was found; default: beside the parameter file")
    _add_results(parser)


def add_sweep(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi sweep`` takes."""
    _add_bag(parser)
    _add_config(parser)
    _add_fault(
        parser,
        "kind and sizes to try: 'kind=bias size=0.05,0.1,0.3'; may be repeated; default: biases, drifts, noise,"
        f" scale factors, stuck, dropout; {_KINDS}",
    )
    parser.add_argument("--times", type=int, default=10, metavar="N", help="times per channel and fault; default 10")
    parser.add_argument("--within", type=float, default=5.0, metavar="S", help="watch a fault for so long; default 5")
    _add_detector(parser)
    parser.add_argument(
        "--compare",
        nargs="+",
        default=[],
        metavar="NAME",
        help="other detectors (as of --detector) or parameter files beside it",
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of signs and random faults; default 1")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="processes; default 1")
    _add_part(parser)
    _add_json(parser)
    parser.add_argument("--csv", type=Path, metavar="FILE", help="write a line for every fault")
    _add_report(parser, "write a page with tables and plots")
    _add_force(parser)
    _add_quiet(parser)


def check_part(arguments: argparse.Namespace) -> None:
    """Refuse a part of a recording that is none.

    Raises
    ------
    ConfigError
        If the end is not after the start.
    """
    if not 0 <= arguments.start < arguments.end:
        raise ConfigError(f"--start {arguments.start:g} s and --end {arguments.end:g} s: expected 0 <= start < end")


def add_fleet(parser: argparse.ArgumentParser) -> None:
    """Say what ``fdi fleet`` takes."""
    parser.add_argument(
        "paths",
        nargs="+",
        metavar="PATH",
        help="recordings, folders with recordings, patterns, or .txt files that list them",
    )
    meaning = "ROS 2 parameter file; default: of each recording what fdi inspect writes for it"
    parser.add_argument("--config", type=resolve, metavar="FILE", help=meaning)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder for the dataset and the page")
    parser.add_argument(
        "--calibrate",
        choices=("none", "first", "each"),
        default="none",
        help="calibrate each vehicle (the folder of its recordings) on the first recording that allows it, or each"
        " recording on itself; default none",
    )
    parser.add_argument(
        "--inject",
        type=resolve,
        metavar="STUDY.yaml",
        help="inject these faults into every recording, as docs/fleet.md says",
    )
    parser.add_argument("--workers", type=int, metavar="N", help="processes; default: as many as there are cores")
    _add_scheduler(parser)
    _add_json(parser)
    _add_force(parser, "begin anew where the folder holds a run with other settings")
    _add_quiet(parser)


def _add_scheduler(parser: argparse.ArgumentParser) -> None:
    meaning = "Dask scheduler to work instead: tls://host:port, or where nobody else reaches it tcp://host:port"
    parser.add_argument("--scheduler", metavar="ADDRESS", help=meaning)
    for name, what in (
        ("--tls-ca-file", "certificate that the scheduler's is known by"),
        ("--tls-cert", "certificate to be known by"),
        ("--tls-key", "key of that certificate"),
    ):
        parser.add_argument(name, type=Path, metavar="FILE", help=f"{what}; default: Dask's configuration")


def _shipped(kind: str) -> str:
    return ", ".join(f"config/{kind}/{path.name}" for path in files() if path.parent.name == kind)


def _add_bag(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "bag", type=Path, metavar="BAG", help="rosbag2 folder, or one .mcap, .db3, .bin, .ulg or .tlog file"
    )


def _add_config(parser: argparse.ArgumentParser, purpose: str = "") -> None:
    meaning = f"ROS 2 parameter file{purpose}"
    parser.add_argument("--config", type=resolve, required=True, metavar="FILE", help=meaning)


def _add_part(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="from here, seconds from the start")
    parser.add_argument("--end", type=float, default=math.inf, metavar="S", help="up to here")


def _add_fault(parser: argparse.ArgumentParser, meaning: str) -> None:
    parser.add_argument("--fault", action="append", default=[], metavar="'KEY=VALUE ...'", help=meaning)


def _add_detector(parser: argparse.ArgumentParser) -> None:
    meaning = f"use this detector instead of the configured one: {', '.join(DETECTORS)}"
    parser.add_argument("--detector", metavar="NAME", help=meaning)


def _add_proof(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--proof",
        type=resolve,
        metavar="RECORDING",
        help="prove the settings on this one; default: on the last quarter of the recording, which is kept aside",
    )


def _add_reference(parser: argparse.ArgumentParser) -> None:
    meaning = "triad that is taken for as configured, or three channels 'a,b,c'; default: all are alike"
    parser.add_argument("--reference", default="", metavar="NAME", help=meaning)


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--output", type=Path, required=True, metavar="FILE", help="parameter file to write")


def _add_report(parser: argparse.ArgumentParser, meaning: str) -> None:
    parser.add_argument("--report", type=Path, metavar="FILE.html", help=meaning)


def _add_results(parser: argparse.ArgumentParser, more: str = "") -> None:
    """Add what every verb takes that has results: ``--json``, ``--force``, ``--quiet``."""
    _add_json(parser, more)
    _add_force(parser)
    _add_quiet(parser)


def _add_json(parser: argparse.ArgumentParser, more: str = "") -> None:
    meaning = f"write all figures as JSON, in SI units; - is standard output, tables then go to standard error{more}"
    parser.add_argument("--json", type=Path, metavar="FILE", help=meaning)


def _add_quiet(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors; no progress")


def _add_degrees(parser: argparse.ArgumentParser) -> None:
    meaning = "print angular rates in deg/s; what is read and written stays in rad/s"
    parser.add_argument("--degrees", action="store_true", help=meaning)


def _add_force(parser: argparse.ArgumentParser, meaning: str = "overwrite files that exist") -> None:
    parser.add_argument("--force", action="store_true", help=meaning)
