"""Launch files and the files beside them, read as their programs read them."""

from __future__ import annotations

import ast
import importlib.util
import json
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from fdi_ros.config import Config


@pytest.mark.parametrize("name", ["fdi", "replay"])
def test_every_argument_that_a_launch_file_uses_is_declared(root: Path, name: str) -> None:
    tree = ast.parse((root / "launch" / f"{name}.launch.py").read_text())
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    texts = {
        kind: {a.value for c in calls if c.func.id == kind for a in c.args[:1] if isinstance(a, ast.Constant)}
        for kind in ("DeclareLaunchArgument", "LaunchConfiguration")
    }
    assert texts["LaunchConfiguration"] <= texts["DeclareLaunchArgument"]
    assert {"config", "log_level"} <= texts["DeclareLaunchArgument"]


@pytest.mark.skipif(importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not installed")
@pytest.mark.parametrize("name", ["fdi", "replay"])
def test_launch_files_describe_a_launch(root: Path, name: str) -> None:
    spec = importlib.util.spec_from_file_location(name, root / "launch" / f"{name}.launch.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert module.generate_launch_description().entities


def test_the_aggregator_takes_every_status_of_the_monitor(root: Path) -> None:
    document = yaml.safe_load((root / "config" / "diagnostics.yaml").read_text())
    group = document["analyzers"]["ros__parameters"]["gyros"]["analyzers"]
    starts = tuple(start for analyzer in group.values() for start in analyzer["startswith"])
    channels = Config.from_file(root / "config" / "two_imus.yaml").channel_names
    names = ["fdi_ros: monitor", "fdi_ros: injector", *(f"fdi_ros: {c}" for c in (*channels, "g1"))]
    assert all(name.startswith(starts) for name in [*names, "fdi_ros: input imu_1"])


def test_layouts_and_policy_are_well_formed_and_speak_of_the_topics(root: Path) -> None:
    layout = json.loads((root / "config" / "foxglove.json").read_text())
    used = json.dumps(layout["layout"])
    assert all(panel in used for panel in layout["configById"])
    ElementTree.parse(root / "config" / "plotjuggler.xml")
    policy = ElementTree.parse(root / "config" / "sros2_policy.xml")
    topics = {topic.text for topic in policy.iter("topic")}
    assert {
        "fused",
        "~/integrity",
        "/diagnostics",
        *Config.from_file(root / "config" / "two_imus.yaml").topics,
    } <= topics
