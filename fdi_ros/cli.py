"""Command line of the offline verbs: one module per verb, none of their logic here.

A verb's module has ``run(arguments) -> int`` and is imported when the verb runs; a new verb is one entry of `VERBS`.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Callable, Sequence
from typing import NamedTuple

from fdi_ros import __version__
from fdi_ros.bag import arguments
from fdi_ros.errors import FdiError


class Verb(NamedTuple):
    """One verb."""

    module: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    meaning: str


VERBS = {
    "replay": Verb(
        "fdi_ros.bag.replay_verb",
        arguments.add_replay,
        "pass a recording through the monitor, with or without injected faults",
    ),
    "inspect": Verb(
        "fdi_ros.bag.inspect_verb",
        arguments.add_inspect,
        "say what is in a recording and print a starting config for it",
    ),
    "calibrate": Verb(
        "fdi_ros.bag.calibrate_verb",
        arguments.add_calibrate,
        "fit axes, biases and noise to a recording and write a config",
    ),
    "geometry": Verb(
        "fdi_ros.bag.geometry_verb",
        arguments.add_geometry,
        "say what a mounting can detect and isolate, before it flies",
    ),
    "montecarlo": Verb(
        "fdi_ros.bag.montecarlo_verb",
        arguments.add_montecarlo,
        "compare detectors over many simulated trials",
    ),
    "watch": Verb(
        "fdi_ros.ros.watch",
        arguments.add_watch,
        "show a running monitor: residuals, states, rates and events as they come",
    ),
    "shipped": Verb(
        "fdi_ros.bag.shipped_verb",
        arguments.add_shipped,
        "say where the parameter files, scenarios and studies are that come with fdi_ros",
    ),
    "compile": Verb(
        "fdi_ros.bag.compile_verb",
        arguments.add_compile,
        "compile now what else is compiled when it is first used, for images and CI",
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb; a known error is one line and exit code 2."""
    given = _parser().parse_args(argv)
    with contextlib.suppress(ValueError):
        # Ended from outside is ended as by the keyboard: half-written outputs are removed. Main thread only.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = int(importlib.import_module(VERBS[given.verb].module).run(given))
        sys.stdout.flush()
        return code
    except FdiError as error:
        print(f"fdi: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # The reader of the output has gone (fdi ... | head): nothing is left to say, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="fdi", description="Gyro fault detection and isolation, offline.")
    parser.add_argument("--version", action="version", version=f"fdi_ros {__version__}")
    parser.set_defaults(version=__version__)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, (_, add_arguments, meaning) in VERBS.items():
        add_arguments(verbs.add_parser(name, help=meaning, description=f"{meaning[0].upper()}{meaning[1:]}."))
    return parser


if __name__ == "__main__":
    sys.exit(main())
