"""Command line of the offline verbs: one module a verb, none of their logic here.

A verb's module has ``add_arguments(parser)`` and ``run(arguments) -> int``; a new verb is one line in `VERBS`.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import signal
import sys
from collections.abc import Sequence

from fdi_ros import __version__
from fdi_ros.errors import FdiError

VERBS = {
    "replay": ("fdi_ros.bag.replay_verb", "pass a recording through the monitor, with or without injected faults"),
    "inspect": ("fdi_ros.bag.inspect_verb", "say what is in a recording and print a starting config for it"),
    "calibrate": ("fdi_ros.bag.calibrate_verb", "fit axes, biases and noise to a recording and write a config"),
    "geometry": ("fdi_ros.bag.geometry_verb", "say what a mounting can detect and isolate, before it flies"),
    "montecarlo": ("fdi_ros.bag.montecarlo_verb", "compare detectors over many simulated trials"),
}
"""Module and help of every verb."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a verb; a known error is one line and exit code 2."""
    words = list(sys.argv[1:] if argv is None else argv)
    arguments = _parser(words).parse_args(words)
    with contextlib.suppress(ValueError):
        # Ended from outside is ended as by the keyboard: half-written outputs are removed. Main thread only.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = int(importlib.import_module(VERBS[arguments.verb][0]).run(arguments))
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


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="fdi", description="Gyro fault detection and isolation, offline.")
    parser.add_argument("--version", action="version", version=f"fdi_ros {__version__}")
    parser.set_defaults(version=__version__)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, (module, meaning) in VERBS.items():
        verb = verbs.add_parser(name, help=meaning, description=f"{meaning[0].upper()}{meaning[1:]}.")
        # Only the verb asked for is imported: the others may need packages that are not installed.
        if name in words:
            importlib.import_module(module).add_arguments(verb)
    return parser


if __name__ == "__main__":
    sys.exit(main())
