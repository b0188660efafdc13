# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi convert``: a flight log, or any other recording, as an MCAP bag of its gyro topics."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from fdi_ros.bag.convert import convert
from fdi_ros.bag.reader import Recording
from fdi_ros.cli.console import Progress, say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.errors import ConfigError
from fdi_ros.result_file import whole_folder, write_json
from fdi_ros.text import shown


def run(arguments: argparse.Namespace) -> int:
    """Convert, and say how much was written."""
    if (arguments.output is None) == (arguments.folder is None):
        raise ConfigError("convert needs one folder to write: --output DIR")
    target: Path = arguments.folder if arguments.output is None else arguments.output
    outputs = [(target, Kind.FOLDER), (arguments.json, Kind.JSON)]
    check_targets(outputs, arguments.force, [arguments.bag])
    with Recording(arguments.bag) as recording:
        with Progress(sys.stderr, arguments.quiet) as progress, whole_folder(target) as path:
            counts = convert(recording, path, progress.show)
        damage = recording.damage.report()
    write_json(arguments.json, {"bag": str(target), "messages": counts, "damage": list(damage)})
    say(arguments, "".join(f"{shown(topic)}: {count} messages\n" for topic, count in counts.items()))
    say(arguments, "".join(f"note: damaged recording: {line}\n" for line in damage))
    wrote(arguments, outputs)
    return 0
