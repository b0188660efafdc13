# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Command line of the offline verbs: none of their logic here.

A verb stands in a module of its own, or beside verbs of its kind, with its parser; a new one is one more entry of
`VERBS`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import logging
import os
import shutil
import signal
import sys
import textwrap
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from fdi_ros import __version__
from fdi_ros.cli import STOPPED, Stop, heeded
from fdi_ros.cli.many import FLEET, MONTECARLO
from fdi_ros.cli.recording import CALIBRATE, CONVERT, INSPECT, SETUP
from fdi_ros.cli.replay import REPLAY, SWEEP
from fdi_ros.cli.settings import COMPILE, GEOMETRY, SHIPPED, WATCH
from fdi_ros.detectors import DETECTORS
from fdi_ros.errors import FdiError
from fdi_ros.system.installation import require, resolve
from fdi_ros.system.text import LINE, shown

VERBS = {
    "setup": SETUP,
    "replay": REPLAY,
    "inspect": INSPECT,
    "convert": CONVERT,
    "calibrate": CALIBRATE,
    "geometry": GEOMETRY,
    "montecarlo": MONTECARLO,
    "sweep": SWEEP,
    "fleet": FLEET,
    "watch": WATCH,
    "shipped": SHIPPED,
    "compile": COMPILE,
}
FIRST = ("inspect", "setup", "replay", "watch")  # what one needs first
DEFECT = 70  # EX_SOFTWARE of sysexits.h
EXIT_CODES = (
    "Exit codes: 0 done, and a verdict that is good; 1 a replay that does not meet its --check; 2 something asked for"
    " or read is wrong, said in one line; 3 a verdict that somebody must act on; 4 one that leaves something open;"
    f" {DEFECT} a defect of fdi itself, with a traceback to report; {STOPPED} stopped from outside."
)


class _PrintCompletion(argparse.Action):
    """Prints a completion script: made once, it costs nothing at each key, and the shell needs no Python for it."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,
        option_string: str | None = None,
    ) -> None:
        """Print it and end."""
        try:
            require("--print-completion", ("shtab",))
        except FdiError as error:
            parser.exit(2, f"fdi: {error}\n")
        import shtab

        if values not in shtab.SUPPORTED_SHELLS:
            parser.error(f"--print-completion {values!r}, expected one of: {', '.join(shtab.SUPPORTED_SHELLS)}")
        _complete(parser, shtab.FILE)
        print(shtab.complete(parser, shell=values))
        parser.exit()


def _complete(parser: argparse.ArgumentParser, files: Any) -> None:
    """Mark every argument that is a path or a detector, of the verbs too; the parser serves nothing else then."""
    for action in parser._actions:
        if action.type in (Path, resolve) or action.dest == "paths":
            vars(action)["complete"] = files  # shtab's own attribute
        if action.metavar == "NAME" and action.dest in ("detector", "compare"):
            action.choices = DETECTORS
        if isinstance(action, argparse._SubParsersAction):
            action.help = None  # what is hidden from the help would be from the completion
            for verb in action.choices.values():
                _complete(verb, files)


class _Parser(argparse.ArgumentParser):
    """Quotes what it refuses as it may be shown; parsers of verbs are of its kind."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong, and end."""
        super().error(shown(message, LINE))


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb; a known error is one line and exit code 2, a defect a traceback and exit code 70."""
    stop = Stop()
    before = {}
    with contextlib.suppress(ValueError):
        # Ended from outside is ended as by the keyboard: half-written outputs are removed. Main thread only.
        before = {number: signal.signal(number, stop) for number in heeded()}
    try:
        return _run(argv, stop)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(argv: Sequence[str] | None, stop: Stop) -> int:
    """Run a verb, and turn whatever ends it into an exit code."""
    try:
        code = _verb(argv)
        sys.stdout.flush()
        return code
    except SystemExit:
        # Of argparse: help, version, or a usage error.
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            _let_go_of_output()
        raise
    except KeyboardInterrupt:
        return STOPPED
    except BrokenPipeError:
        # The reader of the output has gone (fdi ... | head): nothing is left to say, not even at exit.
        _let_go_of_output()
        return 0
    except Exception as error:
        # What a signal breaks off may fail in any way.
        return STOPPED if stop.asked else _failure(error)


def _verb(argv: Sequence[str] | None) -> int:
    """Run a verb and return its exit code."""
    parser = _parser()
    given = parser.parse_args(argv)
    if given.verb is None:
        parser.print_help()
        return 0
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # What a terminal cannot show is escaped.
            stream.reconfigure(errors="backslashreplace")
    # That something has to be compiled is no error: with --quiet it is not logged.
    logging.getLogger("fdi_ros").setLevel(logging.ERROR if getattr(given, "quiet", False) else logging.NOTSET)
    verb = VERBS[given.verb]
    require(f"fdi {given.verb}", verb.libraries)
    with _compiling_shown(given):
        return verb.run(given)


def _failure(error: Exception) -> int:
    """Say what has ended a verb; return the exit code."""
    if isinstance(error, FdiError):
        return _refused(str(error))
    if isinstance(error, MemoryError):
        return _refused("there is not enough memory")
    if isinstance(error, OSError):
        where = f" {error.filename}" if error.filename else ""
        return _refused(f"cannot read or write{where}: {error.strerror or error}")
    with contextlib.suppress(OSError):
        traceback.print_exception(error)
        print(
            f"fdi: this is a defect of fdi {__version__}, not of what it was given: please report it, with the lines"
            " above and the command, to the maintainers named in its package.xml",
            file=sys.stderr,
        )
    return DEFECT


def _compiling_shown(given: argparse.Namespace) -> contextlib.AbstractContextManager[None]:
    """Show whatever a verb has to compile; what has no results, `fdi watch`, does not wait for the compiler."""
    if "quiet" not in given:
        return contextlib.nullcontext()
    from fdi_ros.cli.outputs import bar_of
    from fdi_ros.compiling.notice import announced

    return announced(bar_of(given))


def _refused(words: str) -> int:
    """Say what is wrong, in one line; return the exit code."""
    try:
        sys.stdout.flush()
    except OSError:
        _let_go_of_output()
    with contextlib.suppress(OSError):
        # An error quotes what it refuses, which may come from anywhere.
        print(f"fdi: {shown(words, LINE)}", file=sys.stderr)
    return 2


def _let_go_of_output() -> None:
    """Have what is left of standard output go nowhere: it would be tried once more at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _overview() -> str:
    """Say what there is: first what one needs first, with an example each."""
    width = max(40, min(shutil.get_terminal_size().columns, 110))
    wide = max(map(len, VERBS)) + 2

    def lines(name: str, example: bool) -> list[str]:
        text = textwrap.fill(
            VERBS[name].meaning, width, initial_indent=f"  {name:<{wide}}", subsequent_indent=" " * (wide + 2)
        )
        return [text, f"{' ' * (wide + 4)}{VERBS[name].examples[0]}"] if example else [text]

    rest = [name for name in VERBS if name not in FIRST]
    return "\n".join(
        (
            "Gyro fault detection and isolation, offline.",
            "\nfirst:",
            *(line for name in FIRST for line in lines(name, True)),
            "\nthen:",
            *(line for name in rest for line in lines(name, False)),
            "\nfdi VERB --help says more of each, with examples.",
        )
    )


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
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", prog="fdi", help=argparse.SUPPRESS)
    for name, verb in VERBS.items():
        description = textwrap.fill(f"{verb.meaning[0].upper()}{verb.meaning[1:]}.", 100)
        epilog = "\n".join(["examples:", *(f"  {example}" for example in verb.examples)])
        added = verbs.add_parser(name, help=verb.meaning, description=description, epilog=epilog, formatter_class=raw)
        verb.add_to(added)
    return parser


if __name__ == "__main__":
    sys.exit(main())
