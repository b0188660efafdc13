# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Launch files and the files beside them, read as their programs read them."""

import ast
import importlib.util
import json
import re
import runpy
import subprocess
import sys
from inspect import Parameter, Signature
from pathlib import Path
from types import ModuleType, SimpleNamespace
from xml.etree import ElementTree

import pytest
import yaml

from fdi_ros.cli.settings import made_for
from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.monitor.diagnostics import InputStatus, describe
from fdi_ros.monitor.pipeline import Pipeline

ROOT = Path(__file__).parents[2]
NAMES = ROOT.parent / "shared" / "launch_names.json"
"""What the modules of launch and launch_ros hold: by module and name, the parameters of its constructor."""
FORWARD = ("ExecuteProcess", "ExecuteLocal", "Action")
"""To whose constructors further keywords go."""


class Given:
    """Stands for a class of launch or launch_ros: takes the parameters that the class takes, and keeps them."""

    signature: Signature

    def __init__(self, *arguments, **keywords) -> None:
        self.given = self.signature.bind_partial(*arguments, **keywords).arguments

    def perform(self, context) -> str:
        return context.values[self.given["variable_name"]]


@pytest.fixture
def load(monkeypatch):
    """Load a launch file, and run its function with the defaults and some other values: its nodes by name.

    There is nothing to be imported but what launch and launch_ros hold.
    """
    if not NAMES.is_file():
        pytest.skip(f"{NAMES.name} is not here: what launch and launch_ros hold")
    names = json.loads(NAMES.read_text())
    constructors = {
        name: words for held in names.values() for name, words in held.items() if words
    }

    def stand_in(name: str) -> type:
        own = constructors.get(name, ())
        further = (
            [word for base in FORWARD for word in constructors[base]]
            if "kwargs" in own
            else []
        )
        words = [word for word in dict.fromkeys([*own, *further]) if word != "kwargs"]
        signature = Signature(
            [Parameter(word, Parameter.POSITIONAL_OR_KEYWORD) for word in words]
        )
        return type(name, (Given,), {"signature": signature})

    for module, held in names.items():
        made = ModuleType(module)
        vars(made).update({name: stand_in(name) for name in held})
        monkeypatch.setitem(sys.modules, module, made)
    monkeypatch.delitem(sys.modules, "fdi_ros.ros.launching", raising=False)

    def run(name: str, **given: str) -> dict[str, dict]:
        described = runpy.run_path(str(ROOT / "launch" / f"{name}.launch.py"))[
            "generate_launch_description"
        ]()
        (*declared, function) = described.given["initial_entities"]
        values = {one.given["name"]: one.given.get("default_value") for one in declared}
        assert given.keys() <= values.keys()
        values |= given
        assert all(
            values[one.given["name"]] in one.given["choices"]
            for one in declared
            if "choices" in one.given
        )
        context = SimpleNamespace(values=values, is_shutdown=False)
        return {
            node.given["name"]: node.given
            for node in function.given["function"](context)
        }

    yield run
    sys.modules.pop("fdi_ros.ros.launching", None)


def parameters(node: dict) -> dict:
    """Values that a node is given beside its file."""
    return {
        key: value for given in node["parameters"][1:] for key, value in given.items()
    }


def test_a_launch_file_starts_its_nodes_with_a_file_that_is_shipped(
    load, flight: Path
) -> None:
    nodes = load(
        "replay",
        bag=str(flight),
        config="three_imus.yaml",
        faults="channel=imu_1.x kind=bias size=1",
    )
    assert list(nodes) == ["injector_node", "fdi_node", "player_node"]
    assert ("/imu_3/data_raw", "/imu_3/data_raw_faulty") in nodes["fdi_node"][
        "remappings"
    ]
    # With a namespace its clock is not that of others.
    assert all(("/clock", "clock") in node["remappings"] for node in nodes.values())
    assert parameters(nodes["injector_node"])["enabled"]
    assert {"rate", "loop", "bag", "wait"} <= parameters(nodes["player_node"]).keys()
    assert all(node["on_exit"].__name__ == "end" for node in nodes.values())
    nodes |= load("mavlink") | load("fdi")
    assert all(Path(node["parameters"][0]).is_file() for node in nodes.values())
    assert nodes["mavlink_node"]["on_exit"].__name__ == "end"
    assert {
        "url",
        "system_id",
        "signing_key",
        "named_values",
        "failover",
    } == parameters(nodes["mavlink_node"]).keys()
    for name, bag in (("fdi", {}), ("mavlink", {}), ("replay", {"bag": str(flight)})):
        with pytest.raises(RuntimeError, match=r"cannot read config /nowhere\.yaml"):
            load(name, config="/nowhere.yaml", **bag)
    with pytest.raises(RuntimeError, match="no recording at /nowhere"):
        load("replay", bag="/nowhere")
    # The clock of a launch file around it is not overridden.
    assert "use_sim_time" not in parameters(load("fdi")["fdi_node"])
    assert "use_sim_time" in parameters(load("fdi", use_sim_time="false")["fdi_node"])


def test_a_node_that_ends_ends_the_launch_and_one_that_fails_fails_it(load) -> None:
    end = load("mavlink")["mavlink_node"]["on_exit"]
    with pytest.raises(RuntimeError, match="mavlink_node has failed: exit code 2"):
        end(
            SimpleNamespace(process_name="mavlink_node", returncode=2),
            SimpleNamespace(is_shutdown=False),
        )
    (shutdown,) = end(
        SimpleNamespace(process_name="player_node", returncode=0),
        SimpleNamespace(is_shutdown=False),
    )
    assert shutdown.given == {"reason": "player_node has ended"}
    assert (
        end(
            SimpleNamespace(process_name="fdi_node", returncode=2),
            SimpleNamespace(is_shutdown=True),
        )
        == []
    )


@pytest.mark.skipif(
    any(
        importlib.util.find_spec(name) is None for name in ("launch_ros", "ros2launch")
    ),
    reason="launch_ros and ros2launch are not here: they come with a full ROS 2, not from PyPI",
)
@pytest.mark.parametrize(
    ("name", "arguments", "words"),
    [
        ("fdi", "config:=/nowhere.yaml", "cannot read config /nowhere.yaml"),
        ("mavlink", "config:=/nowhere.yaml", "cannot read config /nowhere.yaml"),
        (
            "replay",
            "bag:=BAG|config:=/nowhere.yaml",
            "cannot read config /nowhere.yaml",
        ),
        ("mavlink", "url:=nonsense", "url is 'nonsense'"),
        (
            "replay",
            "bag:=BAG|faults:=channel=nobody kind=bias size=1",
            "unknown channel 'nobody'",
        ),
        ("replay", "bag:=BAG|rate:=20.0", "process has finished cleanly"),
    ],
)
def test_as_ros2_launch_runs_it(
    flight: Path, name: str, arguments: str, words: str
) -> None:
    code, file = (
        "from ros2cli.cli import main; raise SystemExit(main())",
        ROOT / "launch" / f"{name}.launch.py",
    )
    command = [
        sys.executable,
        "-c",
        code,
        "launch",
        str(file),
        *arguments.replace("BAG", str(flight)).split("|"),
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False
    )
    said = done.stdout + done.stderr
    assert words in said
    assert (done.returncode == 0) == ("finished" in words)
    if "nowhere" in words:
        assert "process started" not in said
    if done.returncode == 0:
        assert "process has died" not in said


@pytest.mark.parametrize(
    ("given", "names"),
    [
        ((), ("fdi_node", "/a/fdi_node", "/b/c/fdi_node")),
        (("/drone/monitor",), ("/drone/monitor",)),
        (("/a/fdi_node", "/b/left"), ("/a/fdi_node", "/b/left")),
    ],
)
def test_each_status_has_one_place_in_the_aggregator_and_what_is_missing_is_no_health(
    given, names
) -> None:
    """By the rules of diagnostic_aggregator's GenericAnalyzer, of what config/diagnostics.yaml uses.

    A status not heard of for ``timeout`` is stale, and forgotten with ``discard_stale``. An analyzer without statuses
    is stale, with ``num_items`` 0 well; with more any other number is an error. A monitor reports once a second.
    """
    text = (ROOT / "config" / "diagnostics.yaml").read_text()
    group = yaml.safe_load(made_for(given, text) if given else text)["analyzers"][
        "ros__parameters"
    ]["gyros"]
    places = group["analyzers"]
    assert {one["type"] for one in places.values()} == {
        "diagnostic_aggregator/GenericAnalyzer"
    }

    def takers(name: str) -> list[str]:
        return [
            place
            for place, one in places.items()
            if any(re.fullmatch(pattern, name) for pattern in one.get("regex", ()))
            or any(part in name for part in one.get("contains", ()))
        ]

    config = Config.from_file(ROOT / "config" / "two_imus.yaml")
    inputs = [
        InputStatus(name, f"/{name}", 300, 100.0, 0.01, True)
        for name in config.imu_names
    ]
    for name in names:
        lines = describe(
            Pipeline.from_config(config).status(),
            prefix=f"{name.lstrip('/')}: ",
            inputs=inputs,
        )
        assert [takers(line.name) for line in lines] == [
            ["monitor"],
            *[["channels"]] * 6,
            *[["inputs"]] * 2,
        ]
    assert takers("mavlink_node: unit imu_1") == ["link"]
    assert takers("drone/injector_node: injector") == ["injector"]
    # Another node of a similar name is none of those that were named.
    assert not given or takers(f"c{names[0]}: monitor") == []
    assert all(2.0 < one["timeout"] <= 3.0 for one in places.values())
    # Who names its monitors is told of one that never came; there may be no link and no injector, which may end.
    counts = {"link": 0, "injector": 0} | ({"monitor": len(given)} if given else {})
    assert {
        place: one["num_items"] for place, one in places.items() if "num_items" in one
    } == counts
    assert [place for place, one in places.items() if "discard_stale" in one] == [
        "injector"
    ]


def test_names_of_nodes_are_checked() -> None:
    for wrong in ("a b", "/a//b", "", "/", "/1a", "a/", "fdi_node: monitor"):
        with pytest.raises(ConfigError, match="is no full name of a node"):
            made_for([wrong], "")
    with pytest.raises(ConfigError, match="twice"):
        made_for(["/a/b", "a/b"], "")


def test_layouts_are_well_formed() -> None:
    layout = json.loads((ROOT / "config" / "foxglove.json").read_text())
    used = json.dumps(layout["layout"])
    assert all(panel in used for panel in layout["configById"])
    ElementTree.parse(ROOT / "config" / "plotjuggler.xml")


GRAPH = """
import sys, rclpy
from fdi_ros.ros.process import NODES, _make
bag = ["-p", f"player_node:bag:={sys.argv[2]}", "-p", "use_sim_time:=true"]
link = ["-p", "mavlink_node:failover:=ardupilot", "-p", f"mavlink_node:failover_file:={sys.argv[3]}/out.json"]
rclpy.init(args=["--ros-args", "--params-file", sys.argv[1], *bag, *link])
said = {}
for name in NODES:
    node = _make(name)
    if name == "fdi_node":
        node.start()
    kinds = ("publisher", "subscriber", "service", "client")
    asked = {kind: getattr(node, f"get_{kind}_names_and_types_by_node")(name, "/") for kind in kinds}
    said[name] = {kind: sorted(one for one, _ in found) for kind, found in asked.items()}
    node.destroy_node()
rclpy.shutdown()
print(said)
"""
ROLES = {
    "publisher": "topics[@publish='ALLOW']/topic",
    "subscriber": "topics[@subscribe='ALLOW']/topic",
}
ROLES |= {
    "service": "services[@reply='ALLOW']/service",
    "client": "services[@request='ALLOW']/service",
}


def full(name: str, node: str) -> str:
    """Full name of a topic or service that a policy names as ROS does, for a node without a namespace."""
    return name if name.startswith("/") else f"/{name.replace('~', node)}"


def test_the_policy_names_what_each_node_has_and_nothing_else(
    flight: Path, quiet_domain: None, tmp_path: Path
) -> None:
    pytest.importorskip("rclpy", reason="the node needs ROS 2")
    config = ROOT / "config" / "two_imus.yaml"
    command = [sys.executable, "-c", GRAPH, str(config), str(flight), str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    has = ast.literal_eval(done.stdout.strip().splitlines()[-1])
    # The injector subscribes to a topic once somebody listens behind it, which nobody does here.
    heard = has["injector_node"]["subscriber"]
    heard[:] = sorted(
        [*heard, *(f"/{topic}" for topic in Config.from_file(config).topics)]
    )
    policy = ElementTree.parse(ROOT / "config" / "sros2_policy.xml")
    profiles = {profile.attrib["node"]: profile for profile in policy.iter("profile")}
    assert has == {
        node: {
            role: sorted(full(str(one.text), node) for one in profile.findall(path))
            for role, path in ROLES.items()
        }
        for node, profile in profiles.items()
    }
    assert not [
        rule
        for profile in profiles.values()
        for rule in profile
        if {*rule.attrib.values()} != {"ALLOW"}
    ]
    # What a vehicle's keystore is made of can inject nothing.
    enclaves = policy.getroot()[0]
    inside = {
        place.attrib["path"]: [one.attrib["node"] for one in place.iter("profile")]
        for place in enclaves
    }
    bench = ["injector_node", "player_node"]
    assert inside == {
        "/fdi": ["fdi_node"],
        "/fdi_link": ["mavlink_node"],
        "/fdi_bench": bench,
    }
