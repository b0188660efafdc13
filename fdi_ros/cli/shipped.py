# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi shipped``: where the files are that come with the package."""

from __future__ import annotations

import argparse
import difflib

from fdi_ros import shipped
from fdi_ros.cli.console import say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.errors import ConfigError
from fdi_ros.monitor.diagnostics import analyzers
from fdi_ros.result_file import write_json

MADE = "diagnostics.yaml"
"""The file that can be made for nodes."""


def run(arguments: argparse.Namespace) -> int:
    """Print the path of every shipped file, or of those of one name; with nodes, the file made for them.

    Raises
    ------
    ConfigError
        If no shipped file has that name, or it is not made for nodes.
    """
    if arguments.node and arguments.name != MADE:
        raise ConfigError(f"--node makes {MADE} for the node, not {arguments.name or 'a list of files'}")
    files = shipped.files()
    if not files:
        raise ConfigError("fdi_ros was installed without its config folder")
    if arguments.name:
        names = [path.name for path in files]
        files = [path for path in files if path.name == arguments.name]
        if not files:
            close = difflib.get_close_matches(arguments.name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"expected one of: {', '.join(names)}"
            raise ConfigError(f"no shipped file {arguments.name!r}, {hint}")
    outputs = [(arguments.json, Kind.JSON)]
    check_targets(outputs, arguments.force, files)
    text = analyzers(arguments.node) if arguments.node else "".join(f"{path}\n" for path in files)
    write_json(arguments.json, {"text": text} if arguments.node else {"files": list(map(str, files))})
    say(arguments, text)
    wrote(arguments, outputs)
    return 0
