# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What arrives: one kind of input a file, one line a registry entry."""

from __future__ import annotations

from fdi_ros.config.config import Config
from fdi_ros.sources.channels import ChannelsSource
from fdi_ros.sources.imus import ImuSource
from fdi_ros.sources.source import Source

SOURCES: dict[str, type[Source]] = {
    "channels": ChannelsSource,
    "imus": ImuSource,
}
"""By the value of the parameter ``input``; the settings that each reads: `fdi_ros.config.settings.INPUTS`."""


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
