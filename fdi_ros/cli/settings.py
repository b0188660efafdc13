# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Without a recording: ``fdi geometry``, ``fdi shipped`` (files), ``fdi compile``, ``fdi watch`` (a live monitor)."""

from __future__ import annotations

import difflib
import json
import re
import time
from argparse import Namespace
from collections.abc import Sequence
from functools import partial

from fdi_ros.cli.arguments import DETECTOR_NAMES, FLAG, RESULTS, Verb, shared
from fdi_ros.detectors import DETECTORS, detector_class
from fdi_ros.errors import ConfigError, FdiError
from fdi_ros.system.installation import resolve, shipped_files

MADE = "diagnostics.yaml"  # the file that can be made for nodes
_NODE_NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)  # full name of a node
_ANY_NODE = re.compile(r'\["\(\.\*/\)\?fdi_node: (.*)"\]')
"""In the file, a regular expression of statuses of any monitor."""


def _geometry(arguments: Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    from fdi_ros.cli.outputs import Outputs, config_words
    from fdi_ros.config.config import Config
    from fdi_ros.report.layout import unit_of
    from fdi_ros.setup.mounting import assess, mounting_figures, mounting_page, mounting_text

    outputs = Outputs(arguments, ("report", "json"), arguments.config)
    result = assess(Config.from_file(arguments.config))
    unit, title = unit_of(arguments.degrees), config_words(arguments)
    page = partial(mounting_page, result, title, unit)
    return outputs.finish(mounting_text(result, unit), mounting_figures(result), page)


GEOMETRY = Verb(
    "say what a mounting can detect and isolate, before it flies",
    ("fdi geometry two_triads.yaml", "fdi geometry my_gyros.yaml --degrees --report mounting.html"),
    {
        "config": {
            "type": resolve,
            "nargs": "+",
            "metavar": "CONFIG",
            "help": "ROS 2 parameter file; of several, later ones win",
        },
        "--report": {"help": "write a page with tables and a picture"},
        **RESULTS,
        **shared("--degrees"),
    },
    _geometry,
)


def _shipped(arguments: Namespace) -> int:
    """Print the path of every shipped file, or of those of one name; with nodes, the file made for them.

    `ConfigError` if no shipped file has that name, or it is not made for nodes.
    """
    from fdi_ros.cli.outputs import Outputs

    if arguments.node and arguments.name != MADE:
        raise ConfigError(f"--node makes {MADE} for the node, not {arguments.name or 'a list of files'}")
    files = shipped_files()
    if not files:
        raise ConfigError("fdi_ros was installed without its config folder")
    if arguments.name:
        names = [path.name for path in files]
        files = [path for path in files if path.name == arguments.name]
        if not files:
            close = difflib.get_close_matches(arguments.name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of: {', '.join(names)}"
            raise ConfigError(f"no shipped file {arguments.name!r}, {hint}")
    outputs = Outputs(arguments, ("json",), files)
    if not arguments.node:
        return outputs.finish("".join(f"{path}\n" for path in files), {"files": list(map(str, files))})
    text = made_for(arguments.node, files[0].read_text())
    return outputs.finish(text, {"text": text})


def made_for(nodes: Sequence[str], text: str) -> str:
    """Return the parameters of diagnostic_aggregator for monitors of certain names.

    ``nodes``: full name of each. ``text``: the shipped file, for any number of monitors of the default name in any
    namespaces. `ConfigError` if one is no name of a node, or given twice.
    """
    for name in nodes:
        if not _NODE_NAME.fullmatch(name):
            raise ConfigError(f"--node {name!r} is no full name of a node, such as /drone/fdi_node")
    names = [name.lstrip("/") for name in nodes]
    if len(set(names)) < len(names):
        raise ConfigError(f"--node names a node twice: {', '.join(nodes)}")
    text = _ANY_NODE.sub(lambda what: json.dumps([f"{name}: {what[1]}" for name in names]), text)
    text = text.replace("all monitors called fdi_node, in any namespaces", " and ".join(nodes), 1)
    text = text.replace(f"shipped {MADE}", " ".join([f"shipped {MADE}", *(f"--node {name}" for name in nodes)]), 1)
    # The first is that of the monitors, each of which has one such status; without names nobody knows how many.
    timeout = "          timeout: 3.0\n"
    return text.replace(timeout, f"{timeout}          num_items: {len(names)}\n", 1)


SHIPPED = Verb(
    "say where the files are that come with fdi_ros: parameters, scenarios, studies, layouts",
    ("fdi shipped", "fdi shipped two_imus.yaml"),
    {
        "name": {"nargs": "?", "default": "", "metavar": "NAME", "help": "only this file, such as two_imus.yaml"},
        "--node": {
            "action": "append",
            "default": [],
            "metavar": "NAME",
            "help": "print diagnostics.yaml made for a monitor of this name, such as /drone/fdi_node; may be repeated",
        },
        **RESULTS,
    },
    _shipped,
)


def _compile(arguments: Namespace) -> int:
    """Compile, and say how long it took and where the results are kept."""
    from fdi_ros.cli.ahead import compile_now
    from fdi_ros.cli.outputs import Outputs, bar_of
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
    {"--detector": {"nargs": "+", "help": f"for these detectors; default: for all: {DETECTOR_NAMES}"}, **RESULTS},
    _compile,
)


def _watch(arguments: Namespace) -> int:
    """Show a monitor until interrupted."""
    from fdi_ros.ros.process import NO_ROS

    try:
        from fdi_ros.ros.watch import watch
    except ImportError as error:
        raise FdiError(f"watch {NO_ROS} ({error})") from error
    return watch(arguments.node, arguments.plain)


WATCH = Verb(
    "show a running monitor: residuals, states, rates and events as they come",
    ("fdi watch", "fdi watch --node /drone/fdi_node --plain"),
    {
        "--node": {"default": "", "metavar": "/NS/NAME", "help": "the monitor; default: the only one running"},
        "--plain": {**FLAG, "help": "line by line, as where the output is no terminal"},
    },
    _watch,
)
