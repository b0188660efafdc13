# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The policy for SROS2 allows each node what it has, and nothing else."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from ros.harness import ROOT

GRAPH = """
import sys, rclpy
from fdi_ros.ros.mavlink_node import AutopilotNode
from fdi_ros.ros.injector_node import InjectorNode
from fdi_ros.ros.monitor_node import MonitorNode
from fdi_ros.ros.player_node import PlayerNode
bag = ["-p", f"player_node:bag:={sys.argv[2]}", "-p", "use_sim_time:=true"]
rclpy.init(args=["--ros-args", "--params-file", sys.argv[1], *bag])
said = {}
for kind in (MonitorNode, AutopilotNode, InjectorNode, PlayerNode):
    node = kind()
    if kind is MonitorNode:
        node.start()
    told = {}
    for what in ("publisher", "subscriber", "service", "client"):
        ask = getattr(node, f"get_{what}_names_and_types_by_node")
        told[what] = sorted(name for name, _ in ask(node.get_name(), node.get_namespace()))
    said[node.get_name()] = told
    node.destroy_node()
rclpy.shutdown()
print(said)
"""
ROLES = {"publisher": "topics[@publish='ALLOW']/topic", "subscriber": "topics[@subscribe='ALLOW']/topic"}
ROLES |= {"service": "services[@reply='ALLOW']/service", "client": "services[@request='ALLOW']/service"}


def full(name: str, node: str) -> str:
    """Full name of a topic or service that a policy names as ROS does, for a node without a namespace."""
    if name.startswith("~/"):
        return f"/{node}/{name[2:]}"
    return name if name.startswith("/") else f"/{name}"


def test_the_policy_names_what_each_node_has_and_nothing_else(root: Path, quiet_domain: None) -> None:
    command = [sys.executable, "-c", GRAPH, str(root / "config" / "two_imus.yaml"), str(root / "bags" / "cone_flight")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    has = ast.literal_eval(done.stdout.strip().splitlines()[-1])
    policy = ElementTree.parse(root / "config" / "sros2_policy.xml")
    profiles = {profile.attrib["node"]: profile for profile in policy.iter("profile")}
    assert profiles.keys() == has.keys()
    for node, profile in profiles.items():
        for role, path in ROLES.items():
            allowed = sorted(full(str(element.text), node) for element in profile.findall(path))
            # The injector subscribes to a topic once somebody listens behind it, which nobody does here.
            late = node == "injector_node" and role == "subscriber"
            assert set(allowed) >= set(has[node][role]), (node, role)
            assert late or allowed == has[node][role], (node, role)
        assert not [rule for rule in profile if {*rule.attrib.values()} != {"ALLOW"}]
    # What a vehicle's keystore is made of can inject nothing.
    enclaves = {
        one.attrib["path"]: [profile.attrib["node"] for profile in one.iter("profile")]
        for one in policy.iter("enclave")
    }
    assert enclaves == {
        "/fdi": ["fdi_node"],
        "/fdi_link": ["mavlink_node"],
        "/fdi_bench": ["injector_node", "player_node"],
    }
