# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi geometry``: what a mounting can do, before it flies; ``fdi shipped``: where the shipped files are."""

from __future__ import annotations

import argparse
import difflib
import math

from fdi_ros.cli.outputs import Outputs
from fdi_ros.errors import ConfigError
from fdi_ros.installation import shipped_files

MADE = "diagnostics.yaml"
"""The file that can be made for nodes."""


def geometry(arguments: argparse.Namespace) -> int:
    """Assess the mounting, print the tables, write the page."""
    from fdi_ros.config.config import Config
    from fdi_ros.report.layout import unit_of
    from fdi_ros.setup.mounting import assess, mounting_figures, mounting_page, mounting_text

    if not 0 <= arguments.freedom <= 180:
        raise ConfigError(f"--freedom is {arguments.freedom:g} deg, expected 0 to 180")
    outputs = Outputs(arguments, ("report", "json"), [arguments.config])
    result = assess(Config.from_file(arguments.config), math.radians(arguments.freedom))
    text = mounting_text(result, unit_of(arguments.degrees))
    return outputs.finish(text, mounting_figures(result), lambda: mounting_page(result, arguments.config.name))


def shipped(arguments: argparse.Namespace) -> int:
    """Print the path of every shipped file, or of those of one name; with nodes, the file made for them.

    Raises
    ------
    ConfigError
        If no shipped file has that name, or it is not made for nodes.
    """
    from fdi_ros.monitor.diagnostics import analyzers

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
    text = analyzers(arguments.node)
    return outputs.finish(text, {"text": text})
