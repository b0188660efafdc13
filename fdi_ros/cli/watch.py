# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi watch``: a running monitor."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from fdi_ros.cli.arguments import Verb, add_flag


def _add_arguments(parser: ArgumentParser) -> None:
    parser.add_argument("--node", default="", metavar="/NS/NAME", help="the monitor; default: the only one running")
    add_flag(parser, "--plain", "line by line, as where the output is no terminal")


def _run(arguments: Namespace) -> int:
    """Show a monitor until interrupted."""
    from fdi_ros.ros.watch import watch

    return watch(arguments.node, arguments.plain)


WATCH = Verb(
    "show a running monitor: residuals, states, rates and events as they come",
    ("fdi watch", "fdi watch --node /drone/fdi_node --plain"),
    _add_arguments,
    _run,
)
