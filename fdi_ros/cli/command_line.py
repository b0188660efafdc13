# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Command line of the offline verbs: one module per verb, none of their logic here.

A verb's module has ``run(arguments) -> int`` and is imported when the verb runs; a new verb is one entry of `VERBS`.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import logging
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fdi_ros import __version__
from fdi_ros.cli import arguments
from fdi_ros.errors import FdiError
from fdi_ros.libraries import BAGS, PROGRESS, WORKERS, require
from fdi_ros.limits import LINE
from fdi_ros.text import shown


class Verb(NamedTuple):
    """One verb."""

    module: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    meaning: str
    extra: str = ""
    """Of setup.py, that installs the libraries."""
    libraries: tuple[str, ...] = ()
    """That the verb needs and a live node does not."""


VERBS = {
    "setup": Verb(
        "fdi_ros.cli.setup",
        arguments.add_setup,
        "from a recording to a config in one go: topics, mounts, delays, biases, noise, with a page of what was found",
        "calibrate",
        (*BAGS, *PROGRESS, "scipy"),
    ),
    "replay": Verb(
        "fdi_ros.cli.replay",
        arguments.add_replay,
        "pass a recording through the monitor, with or without injected faults",
        libraries=(*BAGS, *PROGRESS),
    ),
    "inspect": Verb(
        "fdi_ros.cli.inspect",
        arguments.add_inspect,
        "say what is in a recording and print a starting config for it",
        libraries=(*BAGS, *PROGRESS),
    ),
    "convert": Verb(
        "fdi_ros.cli.convert",
        arguments.add_convert,
        "write the gyro topics of a flight log, or of any recording, as an MCAP bag",
        libraries=(*BAGS, *PROGRESS),
    ),
    "calibrate": Verb(
        "fdi_ros.cli.calibrate",
        arguments.add_calibrate,
        "fit axes, biases and noise to a recording and write a config",
        "calibrate",
        (*BAGS, *PROGRESS, "scipy"),
    ),
    "geometry": Verb(
        "fdi_ros.cli.geometry",
        arguments.add_geometry,
        "say what a mounting can detect and isolate, before it flies",
    ),
    "montecarlo": Verb(
        "fdi_ros.cli.montecarlo",
        arguments.add_montecarlo,
        "compare detectors over many simulated trials",
        libraries=WORKERS,
    ),
    "sweep": Verb(
        "fdi_ros.cli.sweep",
        arguments.add_sweep,
        "inject faults of many sizes into every channel of a recording and say which are found, and how soon",
        libraries=(*BAGS, *WORKERS),
    ),
    "fleet": Verb(
        "fdi_ros.cli.fleet",
        arguments.add_fleet,
        "judge many recordings: a dataset of flights and events, and a page of what to look at",
        "fleet",
        (*BAGS, *WORKERS, "pyarrow", "scipy"),
    ),
    "watch": Verb(
        "fdi_ros.ros.watch",
        arguments.add_watch,
        "show a running monitor: residuals, states, rates and events as they come",
    ),
    "shipped": Verb(
        "fdi_ros.cli.shipped",
        arguments.add_shipped,
        "say where the files are that come with fdi_ros: parameters, scenarios, studies, layouts",
    ),
    "compile": Verb(
        "fdi_ros.cli.compile",
        arguments.add_compile,
        "compile now what else is compiled when it is first used, for images and CI",
    ),
}


DEFECT = 70
"""EX_SOFTWARE of sysexits.h."""
EXIT_CODES = (
    "Exit codes: 0 done; 1 a replay that does not meet its --check; 2 something asked for or read is wrong, said in one"
    f" line; {DEFECT} a defect of fdi itself, with a traceback to report; 130 stopped from outside."
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
            import shtab
        except ImportError:
            parser.exit(2, "fdi: --print-completion needs shtab: pip install 'fdi_ros[completion]'\n")
        if values not in shtab.SUPPORTED_SHELLS:
            parser.error(f"--print-completion {values!r}, expected one of: {', '.join(shtab.SUPPORTED_SHELLS)}")
        _complete_files(parser, shtab.FILE)
        print(shtab.complete(parser, shell=values))
        parser.exit()


def _complete_files(parser: argparse.ArgumentParser, how: Any) -> None:
    """Mark every argument that is a path, of the verbs too."""
    for action in parser._actions:
        if action.type is Path:
            vars(action)["complete"] = how  # shtab's own attribute
        if isinstance(action, argparse._SubParsersAction):
            for verb in action.choices.values():
                _complete_files(verb, how)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb; a known error is one line and exit code 2, a defect a traceback and exit code 70."""
    given = _parser().parse_args(argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # What a terminal cannot show is escaped.
            stream.reconfigure(errors="backslashreplace")
    # That something has to be compiled is no error: with --quiet it is not logged.
    logging.getLogger("fdi_ros").setLevel(logging.ERROR if getattr(given, "quiet", False) else logging.NOTSET)
    with contextlib.suppress(ValueError):
        # Ended from outside is ended as by the keyboard: half-written outputs are removed. Main thread only.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        verb = VERBS[given.verb]
        # Before its module is imported, which may import them.
        require(f"fdi {given.verb}", verb.libraries, verb.extra)
        code = int(importlib.import_module(verb.module).run(given))
        sys.stdout.flush()
        return code
    except FdiError as error:
        return _refused(str(error))
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of the output has gone (fdi ... | head): nothing is left to say, not even at exit.
        _let_go_of_output()
        return 0
    except MemoryError:
        return _refused("there is not enough memory")
    except OSError as error:
        where = f" {error.filename}" if error.filename else ""
        return _refused(f"cannot read or write{where}: {error.strerror or error}")
    except Exception as error:
        return _failed(error)


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


def _failed(error: Exception) -> int:
    """Report a defect of ours: where it happened, then one line on what it is; return the exit code."""
    with contextlib.suppress(OSError):
        traceback.print_exception(error)
        print(
            f"fdi: this is a defect of fdi {__version__}, not of what it was given: please report it, with the lines"
            " above and the command, to the maintainers named in its package.xml",
            file=sys.stderr,
        )
    return DEFECT


def _let_go_of_output() -> None:
    """Have what is left of standard output go nowhere: it would be tried once more at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="fdi", description="Gyro fault detection and isolation, offline.", epilog=EXIT_CODES
    )
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        metavar="SHELL",
        help="print a completion script for bash, zsh, tcsh or fish; needs the extra 'completion'",
    )
    parser.add_argument("--version", action="version", version=f"fdi_ros {__version__}")
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, verb in VERBS.items():
        description = f"{verb.meaning[0].upper()}{verb.meaning[1:]}."
        verb.add_arguments(verbs.add_parser(name, help=verb.meaning, description=description))
    return parser


if __name__ == "__main__":
    sys.exit(main())
