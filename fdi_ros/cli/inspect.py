# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""``fdi inspect``: a table of the topics and a config to start from."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from fdi_ros.cli.console import say, wrote
from fdi_ros.cli.outputs import Kind, check_targets
from fdi_ros.config.config import Config, parameters_in
from fdi_ros.errors import ConfigError
from fdi_ros.inspection.inspect import (
    TopicReport,
    candidates,
    inspect,
    missing,
    recording_figures,
    recording_text,
    topics_text,
)
from fdi_ros.inspection.starting_config import config_text
from fdi_ros.limits import LINE
from fdi_ros.report.text_table import unit_of
from fdi_ros.result_file import write_json, write_text
from fdi_ros.text import shown
from fdi_ros.yaml_file import parse_yaml


def run(arguments: argparse.Namespace) -> int:
    """Print what is there."""
    outputs = [(arguments.json, Kind.JSON), (arguments.output, Kind.PARAMETERS)]
    check_targets(outputs, arguments.force, [arguments.bag])
    reports, damage = inspect(arguments.bag)
    # All of it first: what is compiled for it is announced before the result, not within.
    topics = topics_text(reports, damage, unit_of(arguments.degrees))
    say(arguments, recording_text(reports, arguments.bag))
    say(arguments, topics)
    config, why = _config(reports, arguments.bag)
    write_json(arguments.json, {**recording_figures(reports, arguments.bag, damage), "config": config})
    if config is None:
        wrote(arguments, outputs[:1])
        if arguments.output is not None:
            raise ConfigError(f"{arguments.output} is not written: {why}")
        say(arguments, f"\n{why}\n")
        return 0
    say(arguments, f"\n{config}")
    if arguments.output is not None:
        write_text(arguments.output, config)
    wrote(arguments, outputs)
    return 0


def _config(reports: Sequence[TopicReport], bag: Path) -> tuple[str | None, str]:
    """Return a config to start from, or none and why."""
    chosen = candidates(reports)
    if not chosen:
        return None, f"no config: {missing(reports)}"
    config = config_text(chosen, bag)
    try:
        Config.from_parameters(parameters_in(parse_yaml(config, "config", ConfigError), "config"))
    except ConfigError as error:
        # A recording may say anything: what the node would refuse is not offered.
        return None, f"no config: {shown(error, LINE)}"
    return config, ""
