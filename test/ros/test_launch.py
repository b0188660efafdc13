# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Launch files and the files beside them, read as their programs read them."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from inspect import Parameter, Signature
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from fdi_ros.cli.settings import made_for
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.model.samples import Block
from fdi_ros.monitor.diagnostics import InputStatus, Level, StatusLine, describe
from fdi_ros.monitor.pipeline import Pipeline

ROOT = Path(__file__).parents[2]
ANALYZERS = (ROOT / "config" / "diagnostics.yaml").read_text()


FILES = [*sorted((ROOT / "launch").glob("*.launch.py")), ROOT / "fdi_ros" / "ros" / "launching.py"]
NAMES = ROOT.parent / "shared" / "launch_names.json"
"""What the modules of launch and launch_ros hold: by module and name, the parameters of its constructor."""
FORWARD = {"Node": ("ExecuteProcess", "ExecuteLocal", "Action")}
"""To whose constructors further keywords of a class go; of all others to that of Action."""


@pytest.fixture(scope="module")
def names() -> dict[str, dict[str, list[str]]]:
    if not NAMES.is_file():
        pytest.skip(f"{NAMES.name} is not here: what launch and launch_ros hold")
    return json.loads(NAMES.read_text())


class Given:
    """Stands for a class of launch or launch_ros: takes the parameters that the class takes, and keeps them."""

    signature: Signature

    def __init__(self, *arguments, **keywords) -> None:
        self.given = self.signature.bind_partial(*arguments, **keywords).arguments

    def perform(self, context) -> str:
        return context.values[self.given["variable_name"]]


@pytest.fixture
def load(names, monkeypatch):
    """Load a launch file, and run its function with the defaults and some other values: its nodes by name."""
    classes: dict[str, type[Given]] = {}

    def parameters_of(name: str) -> dict[str, None]:
        own = next(held[name] for held in names.values() if held.get(name))
        further = FORWARD.get(name, ("Action",)) if "kwargs" in own else ()
        every = dict.fromkeys([*own, *(word for other in further for word in parameters_of(other))])
        return {word: None for word in every if word != "kwargs"}

    def stand_in(name: str) -> type:
        if not any(held.get(name) for held in names.values()):
            return object
        signature = Signature([Parameter(word, Parameter.POSITIONAL_OR_KEYWORD) for word in parameters_of(name)])
        return classes.setdefault(name, type(name, (Given,), {"signature": signature}))

    for module, held in names.items():
        made = ModuleType(module)
        vars(made).update({name: stand_in(name) for name in held})
        monkeypatch.setitem(sys.modules, module, made)
    monkeypatch.delitem(sys.modules, "fdi_ros.ros.launching", raising=False)

    def run(name: str, **given: str) -> dict[str, dict]:
        spec = importlib.util.spec_from_file_location(name, ROOT / "launch" / f"{name}.launch.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        (*declared, function) = module.generate_launch_description().given["initial_entities"]
        values = {one.given["name"]: one.given.get("default_value") for one in declared}
        assert given.keys() <= values.keys()
        values |= given
        assert all(values[one.given["name"]] in one.given["choices"] for one in declared if "choices" in one.given)
        context = SimpleNamespace(values=values, is_shutdown=False)
        return {node.given["name"]: node.given for node in function.given["function"](context)}

    yield run
    sys.modules.pop("fdi_ros.ros.launching", None)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.name)
def test_all_that_a_launch_file_imports_is_there(names, file: Path) -> None:
    for statement in ast.walk(ast.parse(file.read_text())):
        if isinstance(statement, ast.ImportFrom) and statement.module.split(".")[0] in ("launch", "launch_ros"):
            missing = {one.name for one in statement.names} - {*names.get(statement.module, ())}
            assert not missing, f"{statement.module} has no {missing}"


def parameters(node: dict) -> dict:
    """Values that a node is given beside its file."""
    return {key: value for given in node["parameters"][1:] for key, value in given.items()}


def test_a_launch_file_starts_its_nodes_with_a_file_that_is_shipped(load, flight: Path) -> None:
    nodes = load("replay", bag=str(flight), config="three_imus.yaml", faults="channel=imu_1.x kind=bias size=1")
    assert list(nodes) == ["injector_node", "fdi_node", "player_node"]
    assert ("/imu_3/data_raw", "/imu_3/data_raw_faulty") in nodes["fdi_node"]["remappings"]
    # With a namespace its clock is not that of others.
    assert all(("/clock", "clock") in node["remappings"] for node in nodes.values())
    assert parameters(nodes["injector_node"])["enabled"]
    assert {"rate", "loop", "bag", "wait"} <= parameters(nodes["player_node"]).keys()
    assert all(node["on_exit"].__name__ == "end" for node in nodes.values())
    nodes |= load("mavlink") | load("fdi")
    assert all(Path(node["parameters"][0]).is_file() for node in nodes.values())
    assert nodes["mavlink_node"]["on_exit"].__name__ == "end"
    assert {"url", "system_id", "signing_key", "named_values", "failover"} == parameters(nodes["mavlink_node"]).keys()
    for name in ("fdi", "mavlink", "replay"):
        bag = {"bag": str(flight)} if name == "replay" else {}
        with pytest.raises(RuntimeError, match=r"cannot read config /nowhere\.yaml"):
            load(name, config="/nowhere.yaml", **bag)
    with pytest.raises(RuntimeError, match="no recording at /nowhere"):
        load("replay", bag="/nowhere")


def test_the_clock_of_a_launch_file_around_it_is_not_overridden(load) -> None:
    assert "use_sim_time" not in parameters(load("fdi")["fdi_node"])
    assert "use_sim_time" in parameters(load("fdi", use_sim_time="false")["fdi_node"])


def test_a_node_that_ends_ends_the_launch_and_one_that_fails_fails_it(load) -> None:
    end = load("mavlink")["mavlink_node"]["on_exit"]
    with pytest.raises(RuntimeError, match="mavlink_node has failed: exit code 2"):
        end(SimpleNamespace(process_name="mavlink_node", returncode=2), SimpleNamespace(is_shutdown=False))
    (shutdown,) = end(SimpleNamespace(process_name="player_node", returncode=0), SimpleNamespace(is_shutdown=False))
    assert shutdown.given == {"reason": "player_node has ended"}
    assert end(SimpleNamespace(process_name="fdi_node", returncode=2), SimpleNamespace(is_shutdown=True)) == []


@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("launch_ros", "ros2launch")),
    reason="launch_ros and ros2launch are not here: they come with a full ROS 2, not from PyPI",
)
class TestLaunch:
    """The launch files as ros2 launch runs them."""

    def launch(self, root: Path, name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        words = [sys.executable, "-c", "from ros2cli.cli import main; raise SystemExit(main())", "launch"]
        command = [*words, str(root / "launch" / f"{name}.launch.py"), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env={**os.environ})

    @pytest.mark.parametrize("name", ["fdi", "mavlink", "replay"])
    def test_a_config_that_is_not_there_starts_nothing(self, root: Path, flight: Path, name: str) -> None:
        bag = [f"bag:={flight}"] if name == "replay" else []
        done = self.launch(root, name, "config:=/nowhere.yaml", *bag)
        assert done.returncode != 0
        assert "cannot read config /nowhere.yaml" in done.stdout + done.stderr
        assert "process started" not in done.stdout + done.stderr

    def test_a_replay_ends_with_the_bag(self, root: Path, flight: Path) -> None:
        done = self.launch(root, "replay", f"bag:={flight}", "rate:=20.0", f"config:={root}/config/two_imus.yaml")
        assert "process has finished cleanly" in done.stdout + done.stderr
        assert "process has died" not in done.stdout + done.stderr
        assert done.returncode == 0

    def test_a_node_that_fails_fails_the_launch(self, root: Path, flight: Path) -> None:
        done = self.launch(root, "mavlink", "url:=nonsense")
        assert done.returncode != 0
        assert "url is 'nonsense'" in done.stdout + done.stderr
        arguments = [f"bag:={flight}", f"config:={root}/config/two_imus.yaml"]
        done = self.launch(root, "replay", *arguments, "faults:=channel=nobody kind=bias size=1")
        assert done.returncode != 0
        assert "unknown channel 'nobody'" in done.stdout + done.stderr


class Analyzer:
    """diagnostic_aggregator's GenericAnalyzer by its rules, of what config/diagnostics.yaml uses.

    Items are kept by name; one not heard of for `timeout` is stale, and forgotten with `discard_stale`. The level is
    the highest, STALE if all items are, or if there are none, ERROR if only some are. `num_items` 0: none are OK;
    more: another number is at least an ERROR.
    """

    KNOWN = frozenset(("type", "path", "contains", "regex", "timeout", "num_items", "discard_stale"))

    def __init__(self, settings: dict) -> None:
        assert settings.keys() <= self.KNOWN
        assert settings["type"] == "diagnostic_aggregator/GenericAnalyzer"
        self.settings = settings
        self.items: dict[str, tuple[float, int]] = {}

    def takes(self, name: str) -> bool:
        own = self.settings
        regex = any(re.fullmatch(pattern, name) for pattern in own.get("regex", ()))
        return regex or any(part in name for part in own.get("contains", ()))

    def level(self, now: float) -> int:
        own = self.settings
        fresh = {name: item for name, item in self.items.items() if now - item[0] <= own["timeout"]}
        if own.get("discard_stale"):
            self.items = fresh
        levels = [self.items[name][1] if name in fresh else 3 for name in self.items]
        if not levels and own.get("num_items") == 0:
            return 0
        level = 3 if all(one == 3 for one in levels) else min(max(levels), 2)
        return max(2, level) if 0 < own.get("num_items", -1) != len(levels) else level


def analyzed(text: str) -> dict[str, Analyzer]:
    """Analyzers of a parameter file."""
    group = yaml.safe_load(text)["analyzers"]["ros__parameters"]["gyros"]["analyzers"]
    return {name: Analyzer(settings) for name, settings in group.items()}


def hear(analyzers: dict[str, Analyzer], lines, at: float) -> None:
    """Give lines to the analyzers, each to one at most."""
    for line in lines:
        for analyzer in [one for one in analyzers.values() if one.takes(line.name)]:
            analyzer.items[line.name] = (at, int(line.level))


def whole(analyzers: dict[str, Analyzer], now: float) -> int:
    """An AnalyzerGroup: the highest level, ERROR where some are STALE and others not."""
    levels = [analyzer.level(now) for analyzer in analyzers.values()]
    return 2 if max(levels) == 3 and min(levels) < 3 else max(levels)


@pytest.fixture(scope="module")
def reports():
    """Lines of a monitor by its prefix: healthy, and without a rate."""
    config = Config.from_file(ROOT / "config" / "two_imus.yaml").replaced({"bias.startup_bias_duration": 0.0})
    pipeline = Pipeline.from_config(config)
    pipeline.process(Block(10**18 + 10**7 * np.arange(300), np.random.default_rng(0).normal(0, 0.003, (300, 6))))
    status = pipeline.status()
    inputs = [InputStatus(name, f"/{name}", 300, 100.0, 0.01, True) for name in config.imu_names]

    def lines(name: str, well: bool = True) -> list[StatusLine]:
        said = status if well else replace(status, has_rate=False)
        return describe(said, prefix=f"{name.lstrip('/')}: ", inputs=inputs)

    return lines


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ((), ("fdi_node",)),
        ((), ("/a/fdi_node", "/b/c/fdi_node", "fdi_node")),
        (("/drone/monitor",), ("/drone/monitor",)),
        (("/a/fdi_node", "/b/left"), ("/a/fdi_node", "/b/left")),
    ],
)
def test_the_aggregator_is_green_when_all_is_well_and_red_when_not(reports, given, names) -> None:
    analyzers = analyzed(made_for(given, ANALYZERS) if given else ANALYZERS)
    for line in [line for name in names for line in reports(name)]:
        assert sum(analyzer.takes(line.name) for analyzer in analyzers.values()) == 1, line.name

    def all_say(at: float, but: str = "", well: bool = True) -> None:
        for name in [name for name in names if name != but]:
            hear(analyzers, reports(name, well), at)

    assert whole(analyzers, 0.0) == 2
    all_say(0.0)
    # An injector that comes, and ends.
    hear(analyzers, [StatusLine(Level.OK, "drone/injector_node: injector", "off")], 0.0)
    assert whole(analyzers, 1.0) == 0
    all_say(4.0)
    assert whole(analyzers, 5.0) == 0
    # A link to an autopilot that comes, loses the autopilot, and has it again.
    for level, expected in ((Level.OK, 0), (Level.STALE, 2), (Level.OK, 0)):
        hear(analyzers, [StatusLine(level, f"mavlink_node: {what}", "") for what in ("link", "unit imu_1")], 4.0)
        assert whole(analyzers, 5.0) == expected
    for well in (False, True):
        all_say(5.0, well=well)
        assert whole(analyzers, 5.0) == (0 if well else 2)
    # The node of the link is gone.
    all_say(8.0)
    assert whole(analyzers, 8.0) == 2
    analyzers["link"].items.clear()
    assert whole(analyzers, 8.0) == 0
    # One of the monitors is gone; then all are.
    all_say(12.0, but=names[-1])
    assert whole(analyzers, 12.5) == 2
    assert whole(analyzers, 16.0) == 2


def test_a_monitor_that_never_came_is_red_where_it_was_named(reports) -> None:
    analyzers = analyzed(made_for(["/a/fdi_node", "/b/fdi_node"], ANALYZERS))
    hear(analyzers, reports("/a/fdi_node"), 0.0)
    assert analyzers["monitor"].level(1.0) == 2
    # Another node of a similar name is none of these.
    assert not any(analyzer.takes("c/a/fdi_node: monitor") for analyzer in analyzers.values())


def test_names_of_nodes_are_checked() -> None:
    for wrong in ("a b", "/a//b", "", "/", "/1a", "a/", "fdi_node: monitor"):
        with pytest.raises(ConfigError, match="is no full name of a node"):
            made_for([wrong], ANALYZERS)
    with pytest.raises(ConfigError, match="twice"):
        made_for(["/a/b", "a/b"], ANALYZERS)


def test_layouts_are_well_formed(root: Path) -> None:
    layout = json.loads((root / "config" / "foxglove.json").read_text())
    used = json.dumps(layout["layout"])
    assert all(panel in used for panel in layout["configById"])
    ElementTree.parse(root / "config" / "plotjuggler.xml")


# The policy for SROS2 ----------------------------------------------------------------------------------------------

GRAPH = """
import sys, rclpy
from fdi_ros.ros.mavlink_node import AutopilotNode
from fdi_ros.ros.injector_node import InjectorNode
from fdi_ros.ros.monitor_node import MonitorNode
from fdi_ros.ros.player_node import PlayerNode
bag = ["-p", f"player_node:bag:={sys.argv[2]}", "-p", "use_sim_time:=true"]
link = ["-p", "mavlink_node:failover:=ardupilot", "-p", f"mavlink_node:failover_file:={sys.argv[3]}/out.json"]
rclpy.init(args=["--ros-args", "--params-file", sys.argv[1], *bag, *link])
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


def test_the_policy_names_what_each_node_has_and_nothing_else(root: Path, quiet_domain: None, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="the node needs ROS 2")
    files = [root / "config" / "two_imus.yaml", root / "bags" / "cone_flight", tmp_path]
    command = [sys.executable, "-c", GRAPH, *map(str, files)]
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
