# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The table of verbs: what each does, takes and needs; without NumPy and Numba, so that help does not wait for them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fdi_ros.installation import BAGS, PROGRESS, WORKERS, resolve, shipped_files

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


class Argument(NamedTuple):
    """One argument of a verb, as `argparse.ArgumentParser.add_argument` takes it."""

    names: tuple[str, ...]
    settings: dict[str, Any]


class Verb(NamedTuple):
    """One verb."""

    module: str
    meaning: str
    examples: Sequence[str]
    """The first is the one to begin with."""
    arguments: Sequence[Argument]
    libraries: Sequence[str] = ()
    """That the verb needs and a live node does not."""
    extra: str = ""
    """Of setup.py, that installs the libraries."""
    function: str = "run"
    """Of the module: ``(arguments) -> int``, the exit code."""


def _argument(*names: str, **settings: Any) -> Argument:
    return Argument(names, settings)


def _flag(name: str, meaning: str) -> Argument:
    return _argument(name, action="store_true", help=meaning)


def _file(name: str, meaning: str, metavar: str = "FILE", **settings: Any) -> Argument:
    return _argument(name, type=Path, metavar=metavar, help=meaning, **settings)


def _config(purpose: str = "") -> Argument:
    meaning = f"ROS 2 parameter file{purpose}"
    return _argument("--config", type=resolve, required=True, metavar="FILE", help=meaning)


def _fault(meaning: str) -> Argument:
    return _argument("--fault", action="append", default=[], metavar="'KEY=VALUE ...'", help=meaning)


def _report(meaning: str) -> Argument:
    return _file("--report", meaning, "FILE.html")


def _json() -> Argument:
    return _file(
        "--json", "write all figures as JSON, in SI units; - is standard output, tables then go to standard error"
    )


def _force(meaning: str = "overwrite files that exist") -> Argument:
    return _flag("--force", meaning)


def _shipped(kind: str) -> str:
    return ", ".join(f"config/{kind}/{path.name}" for path in shipped_files() if path.parent.name == kind)


_BAG = _argument("bag", type=Path, metavar="BAG", help="rosbag2 folder, or one .mcap, .db3, .bin, .ulg or .tlog file")
_PART = (
    _argument("--start", type=float, default=0.0, metavar="S", help="from here, seconds from the start"),
    _argument("--end", type=float, default=math.inf, metavar="S", help="up to here"),
)
_DETECTOR = _argument(
    "--detector", metavar="NAME", help=f"use this detector instead of the configured one: {', '.join(DETECTORS)}"
)
_REFERENCE = _argument(
    "--reference",
    default="",
    metavar="NAME",
    help="triad that is taken for as configured, or three channels 'a,b,c'; default: all are alike",
)
_PROOF = _argument(
    "--proof",
    type=resolve,
    metavar="RECORDING",
    help="prove the settings on this one; default: on the last quarter of the recording, which is kept aside",
)
_PARAMETERS = _file("--output", "parameter file to write", required=True)
_WORKERS = _argument("--workers", type=int, metavar="N", help="processes; default: as many as there are cores")
_SCHEDULER = (
    _argument(
        "--scheduler",
        metavar="ADDRESS",
        help="Dask scheduler to work instead: tls://host:port, or where nobody else reaches it tcp://host:port",
    ),
    _file("--tls-ca-file", "certificate that the scheduler's is known by; default: Dask's configuration"),
    _file("--tls-cert", "certificate to be known by; default: Dask's configuration"),
    _file("--tls-key", "key of that certificate; default: Dask's configuration"),
)
_QUIET = _flag("--quiet", "print nothing but errors; no progress")
_DEGREES = _flag("--degrees", "print angular rates in deg/s; what is read and written stays in rad/s")
_RESULTS = (_json(), _force(), _QUIET)
"""What every verb takes that has results."""

VERBS = {
    "setup": Verb(
        "fdi_ros.cli.recording",
        "from a recording to a config in one go: topics, mounts, delays, biases, noise, with a page of what was found",
        (
            "fdi setup my_flight --output my_gyros.yaml",
            "fdi setup flight.bin --end 120 --output my_gyros.yaml --report found.html",
        ),
        (
            _BAG,
            _PARAMETERS,
            *_PART,
            _REFERENCE,
            _PROOF,
            _report("page of what was found; default: beside the parameter file"),
            *_RESULTS,
        ),
        (*BAGS, *PROGRESS, "scipy"),
        "calibrate",
        function="setup",
    ),
    "replay": Verb(
        "fdi_ros.cli.replay",
        "pass a recording through the monitor, with or without injected faults",
        (
            "fdi replay my_flight --config my_gyros.yaml",
            "fdi replay bags/cone_flight --config config/two_imus.yaml"
            " --fault 'channel=imu_2.y kind=bias size=0.15 start=28'",
            "fdi replay my_flight --config my_gyros.yaml --report replay.html --check 'delay<1 isolated false=0'",
        ),
        (
            _BAG,
            _config(),
            _fault(f"inject a fault: 'channel=imu_2.y kind=bias size=0.2 start=30 stop=60'; may be repeated; {_KINDS}"),
            _argument(
                "--scenario",
                type=resolve,
                metavar="FILE",
                help=f"inject the faults of a scenario file; shipped: {_shipped('scenarios')}",
            ),
            _DETECTOR,
            *_PART,
            _argument(
                "--check",
                metavar="'TERM ...'",
                help="exit 1 with the reasons unless all hold: detected, delay<S, isolated, isolated<S (every fault;"
                " S in s), false=N, false<N (declarations that no fault explains), declared=N, declared<N (episodes),"
                " 'CHANNEL faulty' (or ambiguous, stale, ok), judged>SHARE (else 0.5),"
                " unchecked=N, unchecked<N (channels that end STALE or UNCHECKED, else 0); <= and >= too;"
                " for example 'delay<1 isolated false=0', without injected faults 'declared=0' or 'imu_2.y faulty'",
            ),
            _json(),
            _file("--csv", "write a line for every sample"),
            _report("write a report to be looked at"),
            _file("--output", "write a bag of what the node would have published", "DIR"),
            _force("overwrite outputs that exist"),
            _QUIET,
            _DEGREES,
        ),
        (*BAGS, *PROGRESS),
    ),
    "inspect": Verb(
        "fdi_ros.cli.recording",
        "say what is in a recording and print a starting config for it",
        ("fdi inspect my_flight", "fdi inspect flight.ulg --output my_gyros.yaml"),
        (
            _BAG,
            _argument("--output", "--write", type=Path, metavar="FILE", help="write the config to a file, too"),
            *_RESULTS,
            _DEGREES,
        ),
        (*BAGS, *PROGRESS),
        function="inspect",
    ),
    "convert": Verb(
        "fdi_ros.cli.recording",
        "write the gyro topics of a flight log, or of any recording, as an MCAP bag",
        ("fdi convert flight.bin --output flight_bag",),
        (
            _BAG,
            _file("--output", "rosbag2 folder to write, with one MCAP file", "DIR"),
            # As it was given before there was --output.
            _argument("folder", nargs="?", type=Path, help=argparse.SUPPRESS),
            _json(),
            _force("overwrite a bag made by fdi"),
            _QUIET,
        ),
        (*BAGS, *PROGRESS),
        function="convert",
    ),
    "calibrate": Verb(
        "fdi_ros.cli.recording",
        "fit axes, biases and noise to a recording and write a config",
        ("fdi calibrate my_flight --config my_gyros.yaml --output calibrated.yaml --report calibration.html",),
        (
            _BAG,
            _config(" to start from"),
            _PARAMETERS,
            *_PART,
            _REFERENCE,
            _PROOF,
            _report("write a page with tables and plots"),
            *_RESULTS,
            _DEGREES,
        ),
        (*BAGS, *PROGRESS, "scipy"),
        "calibrate",
        function="calibrate",
    ),
    "geometry": Verb(
        "fdi_ros.cli.settings",
        "say what a mounting can detect and isolate, before it flies",
        ("fdi geometry config/two_triads.yaml", "fdi geometry my_gyros.yaml --degrees --report mounting.html"),
        (
            _argument("config", type=resolve, metavar="CONFIG", help="ROS 2 parameter file"),
            _argument(
                "--freedom",
                type=float,
                default=10.0,
                metavar="DEG",
                help="angle by which the second of two triads may be turned, deg; default 10",
            ),
            _report("write a page with tables and a picture"),
            *_RESULTS,
            _DEGREES,
        ),
        function="geometry",
    ),
    "montecarlo": Verb(
        "fdi_ros.cli.montecarlo",
        "compare detectors over many simulated trials",
        ("fdi montecarlo config/studies/power.yaml --trials 200 --report power.html",),
        (
            _argument("study", type=resolve, metavar="STUDY.yaml", help=f"what to run; shipped: {_shipped('studies')}"),
            _argument("--trials", type=int, metavar="N", help="trials per cell, instead of the file's"),
            _argument("--seed", type=int, metavar="S", help="seed, instead of the file's"),
            _WORKERS,
            *_SCHEDULER,
            _report("write curves and tables as one page"),
            _json(),
            _force(),
            _QUIET,
        ),
        WORKERS,
    ),
    "sweep": Verb(
        "fdi_ros.cli.sweep",
        "inject faults of many sizes into every channel of a recording and say which are detected, and how soon",
        (
            "fdi sweep my_flight --config my_gyros.yaml --report sweep.html",
            "fdi sweep my_flight --config my_gyros.yaml --fault 'kind=bias size=0.05,0.1'"
            " --compare likelihood_ratio cusum",
        ),
        (
            _BAG,
            _config(),
            _fault(
                "kind and sizes to try: 'kind=bias size=0.05,0.1,0.3'; may be repeated; default: biases, drifts, noise,"
                f" scale factors, stuck, dropout; {_KINDS}"
            ),
            _argument("--times", type=int, default=10, metavar="N", help="times per channel and fault; default 10"),
            _argument("--within", type=float, default=5.0, metavar="S", help="watch a fault for so long; default 5"),
            _DETECTOR,
            _argument(
                "--compare",
                nargs="+",
                default=[],
                metavar="NAME",
                help="other detectors (as of --detector) or parameter files beside it",
            ),
            _argument("--seed", type=int, default=1, metavar="S", help="of signs and random faults; default 1"),
            _argument("--workers", type=int, default=1, metavar="N", help="processes; default 1"),
            *_PART,
            _json(),
            _file("--csv", "write a line for every fault"),
            _report("write a page with tables and plots"),
            _force(),
            _QUIET,
        ),
        (*BAGS, *WORKERS),
    ),
    "fleet": Verb(
        "fdi_ros.cli.fleet",
        "judge many recordings: tables of flights and episodes, and a page of what needs a person",
        ("fdi fleet logs --output fleet", "fdi fleet logs bags/2026 --calibrate each --workers 4 --output fleet"),
        (
            _argument(
                "paths",
                nargs="+",
                metavar="PATH",
                help="recordings, and folders with recordings",
            ),
            _argument(
                "--config",
                type=resolve,
                metavar="FILE",
                help="ROS 2 parameter file; default: of each recording what fdi inspect writes for it",
            ),
            _file("--output", "folder for the tables and the page", "DIR", required=True),
            _argument(
                "--calibrate",
                choices=("none", "each"),
                default="none",
                help="each: calibrate each recording on itself, where it allows that; default none",
            ),
            _WORKERS,
            *_SCHEDULER,
            _json(),
            _force("begin anew where the folder holds a run with other settings"),
            _QUIET,
        ),
        (*BAGS, *WORKERS, "pyarrow", "scipy"),
        "fleet",
    ),
    "watch": Verb(
        "fdi_ros.ros.watch",
        "show a running monitor: residuals, states, rates and events as they come",
        ("fdi watch", "fdi watch --node /drone/fdi_node --plain"),
        (
            _argument("--node", default="", metavar="/NS/NAME", help="the monitor; default: the only one running"),
            _flag("--plain", "line by line, as where the output is no terminal"),
        ),
    ),
    "shipped": Verb(
        "fdi_ros.cli.settings",
        "say where the files are that come with fdi_ros: parameters, scenarios, studies, layouts",
        ("fdi shipped", "fdi shipped two_imus.yaml"),
        (
            _argument("name", nargs="?", default="", metavar="NAME", help="only this file, such as two_imus.yaml"),
            _argument(
                "--node",
                action="append",
                default=[],
                metavar="NAME",
                help="print diagnostics.yaml made for a monitor of this name, such as /drone/fdi_node; may be repeated",
            ),
            *_RESULTS,
        ),
        function="shipped",
    ),
    "compile": Verb(
        "fdi_ros.cli.compile",
        "compile now what else is compiled when it is first used, for images and CI",
        ("fdi compile", "fdi compile --detector sequential"),
        (
            _argument(
                "--detector",
                nargs="+",
                metavar="NAME",
                help=f"for these detectors; default: for all: {', '.join(DETECTORS)}",
            ),
            *_RESULTS,
        ),
    ),
}
