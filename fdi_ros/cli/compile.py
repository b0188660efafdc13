# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi compile``: all that is compiled when it is first used, compiled now."""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace

from fdi_ros.cli.arguments import Verb, add_results, detector_names
from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.errors import FdiError


def _add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--detector",
        nargs="+",
        metavar="NAME",
        help=f"for these detectors; default: for all: {detector_names()}",
    )
    add_results(parser)


def _run(arguments: Namespace) -> int:
    """Compile, and say how long it took and where the results are kept."""
    from fdi_ros.cli.ahead import bar_of, compile_now
    from fdi_ros.cli.outputs import Outputs
    from fdi_ros.compiling.compiled import INTERPRETED, folder

    if INTERPRETED:
        raise FdiError("NUMBA_DISABLE_JIT is set: nothing is compiled")
    names = arguments.detector or list(DETECTORS)
    for name in names:
        detector_class(name)
    outputs = Outputs(arguments, ("json",))
    begun = time.perf_counter()
    new = compile_now(names, bar_of(arguments))
    took = time.perf_counter() - begun
    what = f"compiled in {took:.1f} s, kept in" if new else "nothing to do: all is there, in"
    figures = {"detectors": names, "compiled": new, "seconds": took, "folder": str(folder())}
    return outputs.finish(f"{what} {folder()}\n", figures)


COMPILE = Verb(
    "compile now what else is compiled when it is first used, for images and CI",
    ("fdi compile", "fdi compile --detector sequential"),
    _add_arguments,
    _run,
)
