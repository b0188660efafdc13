# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Declares the verbs of the command line with their arguments, runs one, and returns its exit code.

Neither NumPy nor Numba is imported before a verb runs, so that usage errors and help come at once.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import math
import os
import pkgutil
import shutil
import sys
import textwrap
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from fdi_ros import __version__
from fdi_ros.cli import ExitCode
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError
from fdi_ros.system import BAGS, POOL, PROGRESS, require, resolve, shipped_files
from fdi_ros.system.text import LINE, did_you_mean, shown

# Verbs

Options = Mapping[str, Any]
"""Keyword arguments of argparse for one argument. Those in `SHARED_ARGUMENTS` need not be repeated."""


class Verb(NamedTuple):
    """One verb."""

    meaning: str
    """What the verb does, for the help."""
    examples: Sequence[str]
    """Examples for the help, the simplest first."""
    arguments: Mapping[str, Options]
    """Arguments by name. Spaces separate several names of one argument."""
    run: str
    """Module of this folder and function, which returns the exit code."""
    libraries: Sequence[str] = ()
    """Libraries that the verb needs, but a live node does not."""


def takes(words: str, **options: Any) -> Options:
    """Return the options of an argument, its help first."""
    return {"help": words, **options}


def takes_path(words: str = "", **options: Any) -> Options:
    """Return the options of a path."""
    return {"type": Path, "metavar": "FILE", "help": words, **options}


def shipped(kind: str) -> str:
    """Return the names of the shipped files of a kind, for the help."""
    return ", ".join(path.name for path in shipped_files() if path.parent.name == kind)


_CONFIG = "ROS 2 parameter file{}. The name alone gives a shipped one. May be repeated, later ones win"
DETECTOR_NAMES = ", ".join(reversed(DETECTORS))
"""Names of the detectors for the help, the default first."""
SHARED_ARGUMENTS: Mapping[str, Options] = {
    "bag": takes_path(
        "rosbag2 folder, or one .mcap, .db3, .bag, .csv, .tsv, .bin, .ulg or .tlog file",
        metavar="BAG",
    ),
    "--config": takes_path(
        _CONFIG.format(""), type=resolve, action="append", required=True
    ),
    "--start": takes(
        "start of the part to use, s from the first message",
        type=float,
        default=0.0,
        metavar="S",
    ),
    "--end": takes(
        "end of the part to use, s from the first message",
        type=float,
        default=math.inf,
        metavar="S",
    ),
    "--fault": {"action": "append", "default": [], "metavar": "'KEY=VALUE ...'"},
    "--detector": takes(
        f"use this detector instead of the configured one: {DETECTOR_NAMES}",
        metavar="NAME",
    ),
    "--csv": takes_path(),
    "--report": takes_path("write a page with tables and plots", metavar="FILE.html"),
    "--json": takes_path(
        "write all figures as JSON, in SI units; - writes to standard output, and tables to standard error"
    ),
    "--force": takes(
        "overwrite earlier results of fdi, and no other file", action="store_true"
    ),
    "--quiet": takes("print errors only, and no progress", action="store_true"),
    "--degrees": takes(
        "print angular rates in deg/s; files stay in rad/s",
        action="store_true",
    ),
    "--workers": takes(
        "number of processes; default: one for each core", type=int, metavar="N"
    ),
    "--scheduler": takes(
        "Dask scheduler to run the work on, instead of local processes: tls://host:port (certificates:"
        " see Dask's configuration), or tcp://host:port in a network that nobody else reaches",
        metavar="ADDRESS",
    ),
}
"""Arguments that several verbs share."""
PART: Mapping[str, Options] = {"--start": {}, "--end": {}}
WORKERS: Mapping[str, Options] = {"--workers": {}, "--scheduler": {}}
RESULT_ARGUMENTS: Mapping[str, Options] = {"--json": {}, "--force": {}, "--quiet": {}}
"""Arguments of every verb with results."""
_SETTINGS: Mapping[str, Options] = {
    "--output": takes_path("parameter file to write", required=True),
    **PART,
    "--reference": takes(
        "keep the configured axes of this unit, or of three channels 'a,b,c', and fit"
        " the others to them; default: all units move equally",
        default="",
        metavar="NAME",
    ),
    "--proof": takes_path(
        "test the settings on this recording; default: on the last quarter of BAG, which is then not used for fitting",
        type=resolve,
        metavar="RECORDING",
    ),
}
"""Arguments of the verbs that make settings."""
VERBS = {
    "setup": Verb(
        "make a config from a recording: topics, mounts, delays, biases, noise; with a page of the results",
        (
            "fdi setup my_flight --output my_gyros.yaml",
            "fdi setup flight.bin --end 120 --output my_gyros.yaml --report found.html",
        ),
        {
            "bag": {},
            **_SETTINGS,
            "--report": takes(
                "page with the results; default: beside the parameter file"
            ),
            **RESULT_ARGUMENTS,
            "--degrees": {},
        },
        "recording:run_setup",
        (*BAGS, *POOL, "scipy"),
    ),
    "replay": Verb(
        "pass a recording through the monitor, with or without injected faults",
        (
            "fdi replay my_log.bin",
            "fdi replay my_flight --config my_gyros.yaml",
            "fdi replay bags/cone_flight --config two_imus.yaml --fault 'channel=imu_2.y kind=bias size=0.15 start=28'",
            "fdi replay my_flight --config my_gyros.yaml --report replay.html --check 'delay<1 isolated false=0'",
            "fdi replay flight_8 --beside flight_7 --report both.html",
        ),
        {
            "bag": {},
            "--config": takes(
                _CONFIG.format(
                    "; default: the config that fdi inspect writes, if all units are mounted alike"
                ),
                required=False,
                default=[],
            ),
            "--fault": takes(
                "inject a fault: 'channel=imu_2.y kind=bias size=0.2 start=30 stop=60'; may be repeated"
            ),
            "--scenario": takes_path(
                f"inject the faults of a scenario file; shipped: {shipped('scenarios')}",
                type=resolve,
            ),
            "--detector": {},
            **PART,
            "--beside": takes_path(
                "replay this recording too, as recorded, and show both side by side in the report;"
                " the exit code is that of the worse verdict",
                metavar="BAG",
            ),
            "--check": takes(
                "exit with 1 and the reasons unless all conditions hold. For every injected fault: detected, delay<S,"
                " isolated, isolated<S (S in s). Number of declarations without an injected fault: false=N, false<N."
                " Number of episodes: declared=N, declared<N. State of a channel: 'CHANNEL faulty' (or ambiguous,"
                " stale, ok). Share of judged samples: judged>SHARE (default 0.5). Number of channels that end STALE or"
                " UNCHECKED: unchecked=N, unchecked<N (default 0). <= and >= also work. Examples:"
                " 'delay<1 isolated false=0'; without injected faults 'declared=0' or 'imu_2.y faulty'",
                metavar="'TERM ...'",
            ),
            "--csv": takes("write a line for every sample"),
            "--report": takes("write a page with tables and plots"),
            "--output": takes_path(
                "write a bag with the messages that the node would have published",
                metavar="DIR",
            ),
            **RESULT_ARGUMENTS,
            "--force": takes("overwrite earlier results of fdi, and no other file"),
            "--degrees": {},
        },
        "replay:run_replay",
        (*BAGS, *PROGRESS),
    ),
    "inspect": Verb(
        "list the content of a recording, and write a config to start from",
        ("fdi inspect my_flight", "fdi inspect flight.ulg --output my_gyros.yaml"),
        {
            "bag": {},
            "--output --write": takes_path("write the config to this file"),
            "--urdf": takes_path(
                "take the mounts of the units from this URDF, by the frame_id of their messages:"
                " a file, or a topic of the recording such as robot_description"
            ),
            **RESULT_ARGUMENTS,
            "--degrees": {},
        },
        "recording:run_inspect",
        (*BAGS, *PROGRESS),
    ),
    "convert": Verb(
        "write the gyro topics of a flight log, or of any recording, as an MCAP bag",
        ("fdi convert flight.bin --output flight_bag",),
        {
            "bag": {},
            "--output": takes_path(
                "rosbag2 folder to write, with one MCAP file",
                metavar="DIR",
                required=True,
            ),
            **RESULT_ARGUMENTS,
            "--force": takes("overwrite a bag made by fdi"),
        },
        "recording:run_convert",
        (*BAGS, *PROGRESS),
    ),
    "calibrate": Verb(
        "fit axes, biases and noise to a recording and write a config",
        (
            "fdi calibrate my_flight --config my_gyros.yaml --output calibrated.yaml --report calibration.html",
        ),
        {
            "bag": {},
            "--config": takes(_CONFIG.format(" to start from")),
            **_SETTINGS,
            "--report": {},
            **RESULT_ARGUMENTS,
            "--degrees": {},
        },
        "recording:run_calibrate",
        (*BAGS, *POOL, "scipy"),
    ),
    "geometry": Verb(
        "state which faults a mounting can detect and isolate, before it flies",
        (
            "fdi geometry two_triads.yaml",
            "fdi geometry my_gyros.yaml --degrees --report mounting.html",
        ),
        {
            "config": takes_path(
                "ROS 2 parameter file; of several, later ones win",
                type=resolve,
                nargs="+",
                metavar="CONFIG",
            ),
            "--report": takes("write a page with tables and a picture"),
            **RESULT_ARGUMENTS,
            "--degrees": {},
        },
        "settings:run_geometry",
    ),
    "montecarlo": Verb(
        "compare detectors over many simulated trials",
        ("fdi montecarlo power.yaml --trials 200 --report power.html",),
        {
            "study": takes_path(
                f"study to run; shipped: {shipped('studies')}",
                type=resolve,
                metavar="STUDY.yaml",
            ),
            "--trials": takes(
                "trials per cell; default: the number in the file",
                type=int,
                metavar="N",
            ),
            "--seed": takes(
                "seed; default: the one in the file", type=int, metavar="S"
            ),
            **WORKERS,
            "--report": takes("write curves and tables as one page"),
            **RESULT_ARGUMENTS,
        },
        "settings:run_montecarlo",
        POOL,
    ),
    "sweep": Verb(
        "inject faults of many sizes into every channel of a recording, and state which are detected, and how soon",
        (
            "fdi sweep my_flight --config my_gyros.yaml --report sweep.html",
            "fdi sweep my_flight --config my_gyros.yaml --fault 'kind=bias size=0.05,0.1'"
            " --compare likelihood_ratio cusum",
        ),
        {
            "bag": {},
            "--config": {},
            "--fault": takes(
                "kind and sizes to try: 'kind=bias size=0.05,0.1,0.3', of accelerometers in m/s^2"
                " 'channel=accelerometers kind=bias size=1,3'; may be repeated; default: bias, drift, noise, scale,"
                " stuck, dropout of both"
            ),
            "--times": takes(
                "number of start times per channel and fault; default 10",
                type=int,
                default=10,
                metavar="N",
            ),
            "--within": takes(
                "time to detect a fault, s; default 5",
                type=float,
                default=5.0,
                metavar="S",
            ),
            "--detector": {},
            "--compare": takes(
                "detectors or parameter files to compare with",
                nargs="+",
                default=[],
                metavar="NAME",
            ),
            "--seed": takes(
                "seed for the signs and the random faults; default 1",
                type=int,
                default=1,
                metavar="S",
            ),
            "--workers": takes("number of processes; default 1", default=1),
            **PART,
            "--csv": takes("write a line for every fault"),
            "--report": {},
            **RESULT_ARGUMENTS,
        },
        "replay:run_sweep",
        (*BAGS, *POOL),
    ),
    "fleet": Verb(
        "pass many recordings through the monitor: tables of flights and episodes, and a page of the"
        " flights that need attention",
        (
            "fdi fleet logs --output fleet",
            "fdi fleet logs bags/2026 --calibrate each --workers 4 --output fleet",
        ),
        {
            "paths": takes(
                "recordings, and folders with recordings", nargs="+", metavar="PATH"
            ),
            "--config": takes(
                _CONFIG.format(
                    "; default: the config that fdi inspect writes for each recording"
                ),
                required=False,
                default=[],
            ),
            "--output": takes_path(
                "folder for the tables and the page", metavar="DIR", required=True
            ),
            "--reports": takes(
                "also write the page of each replay, linked from the page of the fleet",
                action="store_true",
            ),
            "--calibrate": takes(
                "each: calibrate each recording on itself, if possible; default: none",
                choices=("none", "each"),
                default="none",
            ),
            **WORKERS,
            **RESULT_ARGUMENTS,
            "--force": takes(
                "start over if the folder holds a run with other settings"
            ),
        },
        "replay:run_fleet",
        (*BAGS, *POOL, "pyarrow", "scipy"),
    ),
    "watch": Verb(
        "show a running monitor: residuals, states, rates and events",
        ("fdi watch", "fdi watch --node /drone/fdi_node --plain"),
        {
            "--node": takes(
                "full name of the monitor; default: the only one that runs",
                default="",
                metavar="/NS/NAME",
            ),
            "--plain": takes("print line by line, as in a file", action="store_true"),
        },
        "command_line:run_watch",
    ),
    "shipped": Verb(
        "list the files that come with fdi_ros: parameters, scenarios, studies, layouts",
        ("fdi shipped", "fdi shipped two_imus.yaml"),
        {
            "name": takes(
                "list only this file, for example two_imus.yaml",
                nargs="?",
                default="",
                metavar="NAME",
            ),
            "--node": takes(
                "print diagnostics.yaml for a monitor with this full name, for example"
                " /drone/fdi_node; may be repeated",
                action="append",
                default=[],
                metavar="NAME",
            ),
            **RESULT_ARGUMENTS,
        },
        "settings:run_shipped",
    ),
    "compile": Verb(
        "compile the code now instead of at first use (for images and CI)",
        ("fdi compile", "fdi compile --detector sequential"),
        {
            "--detector": takes(
                f"detectors to compile; default: all: {DETECTOR_NAMES}", nargs="+"
            ),
            **RESULT_ARGUMENTS,
        },
        "settings:run_compile",
    ),
}
FIRST = ("inspect", "setup", "replay", "watch")
"""Verbs that a new user needs first."""

# A run

EXIT_CODES = (
    "Exit codes: 0 done, and the verdict is good; 1 a replay does not meet its --check; 2 wrong arguments or input"
    " (one line on standard error); 3 a verdict that needs action; 4 a verdict that leaves a question open;"
    f" {ExitCode.DEFECT:d} a defect of fdi itself (please report the traceback);"
    f" {ExitCode.STOPPED:d} stopped by a signal."
)


def main(
    argv: Sequence[str] | None = None, stopped: Callable[[], bool] = lambda: False
) -> int:
    """Run a verb and return its exit code.

    A known error is one line and exit code 2, a defect a traceback and exit code 70.

    Parameters
    ----------
    argv
        Arguments of the command. None: those of the process.
    stopped
        Returns whether a signal has arrived. The interrupted work may then fail in any way.
    """
    try:
        code = _run(argv)
        sys.stdout.flush()
        return code
    except SystemExit:
        # argparse exits after help, version and usage errors.
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            _let_go_of_output()
        raise
    except KeyboardInterrupt:
        return ExitCode.STOPPED
    except BrokenPipeError:
        # The reader of the output has gone (fdi ... | head): no error, and no output at exit.
        _let_go_of_output()
        return ExitCode.DONE
    except Exception as error:
        return ExitCode.STOPPED if stopped() else _failure(error)


def _run(argv: Sequence[str] | None) -> int:
    """Run a verb and return its exit code."""
    parser = _parser()
    given, unknown = parser.parse_known_args(argv)
    _refuse(parser, given.verb, unknown)
    if given.verb is None:
        parser.print_help()
        return ExitCode.DONE
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Escape characters that the terminal cannot show.
            stream.reconfigure(errors="backslashreplace")
    # With --quiet only errors are logged, and compiling is none.
    logging.getLogger("fdi_ros").setLevel(
        logging.ERROR if getattr(given, "quiet", False) else logging.NOTSET
    )
    verb = VERBS[given.verb]
    require(f"fdi {given.verb}", verb.libraries)
    run: Callable[[argparse.Namespace], int] = pkgutil.resolve_name(
        f"fdi_ros.cli.{verb.run}"
    )
    if "quiet" not in given:
        # `fdi watch` has no results and does not wait for the compiler.
        return run(given)
    from fdi_ros.compiling.notice import announced

    with announced():
        return run(given)


def run_watch(arguments: argparse.Namespace) -> int:
    """Show a running monitor until interrupted, without the imports of the other verbs."""
    from fdi_ros.ros.process import NO_ROS

    try:
        from fdi_ros.ros.watch import watch
    except ImportError as error:
        raise FdiError(f"watch {NO_ROS} ({error})") from error
    return watch(arguments.node, arguments.plain)


def _failure(error: Exception) -> int:
    """Print the error that ended a verb, in one line or as a defect and return the exit code."""
    if isinstance(error, FdiError):
        words = str(error)
    elif isinstance(error, MemoryError):
        words = "there is not enough memory"
    elif isinstance(error, OSError):
        where = f" {error.filename}" if error.filename else ""
        words = f"cannot read or write{where}: {error.strerror or error}"
    else:
        with contextlib.suppress(OSError):
            traceback.print_exception(error)
            print(
                f"fdi: this is a defect of fdi {__version__}, not of your input: please report the command and the"
                " lines above to the maintainers named in its package.xml",
                file=sys.stderr,
            )
        return ExitCode.DEFECT
    try:
        sys.stdout.flush()
    except OSError:
        _let_go_of_output()
    with contextlib.suppress(OSError):
        # An error quotes its input, which may be hostile.
        print(f"fdi: {shown(words, LINE)}", file=sys.stderr)
    return ExitCode.REFUSED


def _let_go_of_output() -> None:
    """Discard the rest of standard output, which Python would try to write again at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


# Parser


class _Parser(argparse.ArgumentParser):
    """Parser whose errors are safe to show in a terminal. The parsers of verbs derive from it."""

    def error(self, message: str) -> NoReturn:
        """Print an error and exit."""
        super().error(shown(message, LINE))

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse an unknown verb or choice, and suggest the closest one."""
        choices = tuple(action.choices or ())
        if choices and value not in choices:
            name = str(action.metavar or action.option_strings[0])
            hint = did_you_mean(str(value), choices)
            raise argparse.ArgumentError(None, f"no such {name}: {value!r}, {hint}")


def _refuse(parser: argparse.ArgumentParser, verb: str, words: Sequence[str]) -> None:
    """Refuse unknown arguments of a verb, and suggest the closest option for the first one."""
    if not words:
        return
    unknown = next((word for word in words if word.startswith("-")), "")
    if verb and unknown:
        options = [
            option
            for names in VERBS[verb].arguments
            for option in names.split()
            if option.startswith("-")
        ]
        hint = did_you_mean(unknown.partition("=")[0], [*options, "--help"])
        parser.usage = f"fdi {verb} [OPTION ...]"
        parser.error(f"fdi {verb} has no option {unknown!r}, {hint}")
    is_cut = any("=" in word for word in words)
    hint = ". Write a value with blanks in quotes" if is_cut else ""
    parser.error(f"unrecognized arguments: {' '.join(words)}{hint}")


class _PrintCompletion(argparse.Action):
    """Prints a completion script, which the shell can run without Python."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: Any,
        values: Any,
        option_string: Any = None,
    ) -> None:
        """Print the script and exit."""
        try:
            require("--print-completion", ("shtab",))
        except FdiError as error:
            parser.exit(ExitCode.REFUSED, f"fdi: {error}\n")
        import shtab

        if values not in shtab.SUPPORTED_SHELLS:
            parser.error(
                f"--print-completion {values!r}, expected one of: {', '.join(shtab.SUPPORTED_SHELLS)}"
            )
        _complete(parser, shtab.FILE)
        print(shtab.complete(parser, shell=values))
        parser.exit()


def _complete(parser: argparse.ArgumentParser, files: Any) -> None:
    """Mark all paths and detectors among the arguments of a parser and its verbs, for shtab."""
    for action in parser._actions:
        if action.type in (Path, resolve) or action.dest == "paths":
            vars(action)["complete"] = files  # attribute of shtab
        if action.metavar == "NAME" and action.dest in ("detector", "compare"):
            action.choices = DETECTORS
        if isinstance(action, argparse._SubParsersAction):
            # shtab would hide from the completion whatever the help hides.
            action.help = None
            for verb in action.choices.values():
                _complete(verb, files)


class _FaultKinds:
    """Kinds of faults, looked up only when the help is printed, because this needs NumPy."""

    def __str__(self) -> str:
        from fdi_ros.faults.kinds import FAULT_KINDS

        return ", ".join(FAULT_KINDS)


def _parser() -> argparse.ArgumentParser:
    raw = argparse.RawDescriptionHelpFormatter
    parser = _Parser(
        prog="fdi",
        usage="fdi VERB ...",
        description=_overview(),
        epilog=textwrap.fill(EXIT_CODES, 100),
        formatter_class=raw,
    )
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        metavar="SHELL",
        help="print a completion script for bash, zsh, tcsh or fish; needs the extra 'completion'",
    )
    parser.add_argument("--version", action="version", version=f"fdi_ros {__version__}")
    verbs = parser.add_subparsers(
        dest="verb", metavar="VERB", prog="fdi", help=argparse.SUPPRESS
    )
    for name, verb in VERBS.items():
        description = textwrap.fill(
            f"{verb.meaning[0].upper()}{verb.meaning[1:]}.", 100
        )
        epilog = "\n".join(
            ["examples:", *(f"  {example}" for example in verb.examples)]
        )
        added = verbs.add_parser(
            name,
            help=verb.meaning,
            description=description,
            epilog=epilog,
            formatter_class=raw,
        )
        for names, own in verb.arguments.items():
            action = added.add_argument(
                *names.split(), **{**SHARED_ARGUMENTS.get(names, {}), **own}
            )
            if names == "--fault":
                action.help = f"{action.help}; kinds: %(kinds)s"
                vars(action)["kinds"] = _FaultKinds()
    return parser


def _overview() -> str:
    """Return the list of verbs. Those that a new user needs first have an example."""
    width = max(40, min(shutil.get_terminal_size().columns, 110))
    wide = max(map(len, VERBS)) + 2

    def line(name: str) -> str:
        first = f"  {name:<{wide}}"
        others = " " * (wide + 2)
        return textwrap.fill(
            VERBS[name].meaning, width, initial_indent=first, subsequent_indent=others
        )

    lines = [
        "Detects and isolates faults of redundant gyros and accelerometers.",
        "\nfirst:",
    ]
    for name in FIRST:
        lines += [line(name), f"{' ' * (wide + 4)}{VERBS[name].examples[0]}"]
    lines += ["\nthen:", *(line(name) for name in VERBS if name not in FIRST)]
    return "\n".join([*lines, "\nfdi VERB --help describes a verb, with examples."])
