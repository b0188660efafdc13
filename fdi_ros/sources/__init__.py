# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What arrives: one kind of input a file, named in a row of `fdi_ros.config.settings.INPUTS`."""

from __future__ import annotations

import pkgutil

from fdi_ros.config.config import Config
from fdi_ros.config.settings import INPUTS
from fdi_ros.sources.source import Source

SOURCES: dict[str, type[Source]] = {
    name: pkgutil.resolve_name(f"{__name__}.{row.source}") for name, row in INPUTS.items()
}
"""By the value of the parameter ``input``."""


def source_of(config: Config) -> Source:
    """Return the source of a configuration."""
    return SOURCES[config.input](config)


def input_of(kind: type[Source]) -> str:
    """Return the value of the parameter ``input`` for a kind."""
    return next(name for name, one in SOURCES.items() if one is kind)


def source_of_type(message_type: str) -> type[Source] | None:
    """Return the kind of input of a message type, ``sensor_msgs/msg/Imu``; None: no gyros are read from it."""
    return next((kind for kind in SOURCES.values() if kind.type == message_type), None)


__all__ = ["SOURCES", "Source", "input_of", "source_of", "source_of_type"]
