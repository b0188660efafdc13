# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A parameter file for diagnostic_aggregator that fits what monitors and links say: green if all is well, else red."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence

from fdi_ros.errors import ConfigError
from fdi_ros.monitor.diagnostics import INPUT, WHOLE

_NODE = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
"""Full name of a node."""
_ANY = "(.*/)?fdi_node"
"""Regular expression of the default name, in any namespace."""
_FILE = """\
# Analyzers for diagnostic_aggregator: the statuses of {who}, in one group.
#   ros2 run diagnostic_aggregator aggregator_node --ros-args --params-file diagnostics.yaml
# Made by `fdi shipped diagnostics.yaml{words}`; for monitors of other names: --node /drone/fdi_node, once for each.
analyzers:
  ros__parameters:
    path: Vehicle
    gyros:
      type: diagnostic_aggregator/AnalyzerGroup
      path: Gyros
      analyzers:
        monitor:
          type: diagnostic_aggregator/GenericAnalyzer
          path: Monitor
          regex: {whole}
          # A monitor reports once a second; silence of a monitor itself is an error.
          timeout: 3.0
{count}\
        inputs:
          type: diagnostic_aggregator/GenericAnalyzer
          path: Inputs
          regex: {inputs}
          timeout: 3.0
        channels:
          type: diagnostic_aggregator/GenericAnalyzer
          path: Channels
          # All else that a monitor says is about its channels, whatever their names.
          regex: {channels}
          timeout: 3.0
        link:
          type: diagnostic_aggregator/GenericAnalyzer
          path: Link
          regex: ["(.*/)?mavlink_node: .*"]
          timeout: 3.0
          # Without a link to an autopilot all is well: an analyzer without items is stale otherwise. One that was there
          # and is silent is an error.
          num_items: 0
        injector:
          type: diagnostic_aggregator/GenericAnalyzer
          path: Injector
          contains: ["injector_node: injector"]
          timeout: 3.0
          # Without an injector, or 3 s after it has ended, all is well.
          num_items: 0
          discard_stale: true
"""


def analyzers(nodes: Sequence[str] = ()) -> str:
    """Return the text of a parameter file for monitors.

    Parameters
    ----------
    nodes
        Full name of each; none: any number of the default name, in any namespaces.

    Raises
    ------
    ConfigError
        If one is no name of a node, or given twice.
    """
    for name in nodes:
        if not _NODE.fullmatch(name):
            raise ConfigError(f"--node {name!r} is no full name of a node, such as /drone/fdi_node")
    names = [name.lstrip("/") for name in nodes]
    if len(set(names)) < len(names):
        raise ConfigError(f"--node names a node twice: {', '.join(nodes)}")
    patterns = names or [_ANY]
    # Without names nobody knows how many there are to be: none at all is stale all the same.
    count = f"          num_items: {len(names)} # of monitors; each has one such status\n" if names else ""
    return _FILE.format(
        who=" and ".join(nodes) or "all monitors called fdi_node, in any namespaces",
        words="".join(f" --node {name}" for name in nodes),
        whole=json.dumps([f"{one}: {WHOLE}" for one in patterns]),
        count=count,
        inputs=json.dumps([f"{one}: {INPUT}.*" for one in patterns]),
        channels=json.dumps([f"{one}: (?!{WHOLE}$|{INPUT}).*" for one in patterns]),
    )
