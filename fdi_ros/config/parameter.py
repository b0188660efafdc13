# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""ROS 2 parameter files: which parameters in one are the monitor's."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fdi_ros.errors import ConfigError
from fdi_ros.yaml_file import read_yaml

ROS_PARAMETERS = (
    "use_sim_time",
    "start_type_description_service",
    "autostart",
    "executor",
    "state_file",
    "state_max_age",
)
"""Parameters of the node itself: they may stand in the file, and are no settings of the pipeline."""


def read_parameter_file(path: str | Path) -> dict[str, Any]:
    """Parameters of the monitor in a ROS 2 parameter file, as ``{"section.field": value}``.

    Sections ``/**`` and then those of a node named fdi_node, in whatever namespace, are taken.

    Raises
    ------
    ConfigError
        If the file is missing or is no parameter file.
    """
    return parameters_in(read_yaml(path, "config", ConfigError), f"config {path}")


def parameters_in(document: Any, called: str) -> dict[str, Any]:
    """Parameters of the monitor in what a ROS 2 parameter file holds, as `read_parameter_file` returns them.

    Raises
    ------
    ConfigError
        If it is no parameter file; called is its name there.
    """
    if not isinstance(document, dict):
        raise ConfigError(f"{called} is no ROS 2 parameter file: expected a node name, then ros__parameters")
    flat: dict[str, Any] = {}
    found = False
    for node in sorted(document, key=lambda name: name != "/**"):
        if node != "/**" and str(node).rpartition("/")[2] != "fdi_node":
            continue
        body = document[node]
        if not isinstance(body, dict) or not isinstance(body.get("ros__parameters"), dict):
            raise ConfigError(f"{called}: {node} has no ros__parameters")
        found = True
        _flatten(body["ros__parameters"], "", flat)
    if not found:
        names = ", ".join(map(str, document))
        raise ConfigError(f"{called} has no parameters for /** or fdi_node, only for: {names}")
    return {name: value for name, value in flat.items() if not is_ros_parameter(name)}


def is_ros_parameter(name: str) -> bool:
    """Whether a parameter belongs to ROS or the node itself and not to the monitor."""
    return name in ROS_PARAMETERS or name.startswith("qos_overrides.")


def _flatten(tree: Mapping[Any, Any], prefix: str, flat: dict[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, dict):
            _flatten(value, f"{prefix}{key}.", flat)
        else:
            flat[f"{prefix}{key}"] = value
