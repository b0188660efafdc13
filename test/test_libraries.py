# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What an installation needs: a live node what a distribution has, everything else asked for by one line."""

import re
from xml.etree import ElementTree

import numba
import pytest
import yaml
from test_layers import PACKAGE, python

from fdi_ros import system

WITHOUT_BAGS = f"import sys; sys.modules.update(dict.fromkeys({list(system.BAGS)!r}))\n"
"""As if some libraries were not installed; where they are not, this changes nothing."""


def test_a_build_farm_has_all_that_the_manifest_names(root):
    known = yaml.safe_load((root / "test" / "rosdep_keys.yaml").read_text())
    assert not any(key.endswith("-pip") for key in known["rosdep"])
    elements = ElementTree.parse(root / "package.xml").getroot()
    named = {element.text for element in elements if element.tag.endswith("depend")}
    assert {"rclpy", "python3-numba", "python3-pytest"} <= named
    assert named <= {*known["rosdep"], *known["jazzy"]}


def test_the_versions_of_the_distribution_are_new_enough_and_are_those_tested(root):
    known = yaml.safe_load((root / "test" / "rosdep_keys.yaml").read_text())["rosdep"]
    asked = dict(
        re.findall(
            r'"(numpy|numba|PyYAML|tqdm|joblib|scipy)>=([0-9.]+)(?:,<[0-9.]+)?"',
            (root / "setup.py").read_text(),
        )
    )
    tested = dict(
        re.findall(
            r"(numpy|numba|PyYAML)==([0-9.]+)",
            (root / "tools" / "ubuntu.sh").read_text(),
        )
    )
    assert set(asked) == {"numpy", "numba", "PyYAML", "tqdm", "joblib", "scipy"}
    for name, least in asked.items():
        there = known[f"python3-{name.lower().removeprefix('py')}"]["version"]
        assert tuple(map(int, least.split("."))) <= tuple(map(int, there.split(".")))
        assert tested.get(name, there) == there
    assert set(tested) == {"numpy", "numba", "PyYAML"}


def test_numba_is_bounded_by_the_version_that_is_tested_here(root):
    """How results are kept rests on names of its own that a next version may change."""
    (bound,) = re.findall(
        r'"numba>=[0-9.]+,<([0-9.]+)"', (root / "setup.py").read_text()
    )
    assert tuple(map(int, numba.__version__.split(".")[:2])) < tuple(
        map(int, bound.split("."))
    )


def test_libraries_named_as_required_are_those_of_setup_py(root):
    (required,) = re.findall(
        r"install_requires=\[(.*?)\]", (root / "setup.py").read_text(), flags=re.DOTALL
    )
    names = set(re.findall(r'"(\w+)>=', required))
    assert names == {*system.REQUIREMENTS, "numpy", "numba", "PyYAML"}


VERBS_WITHOUT = """
import sys
from fdi_ros.cli.command_line import main
for words, lacking in eval(sys.argv[1]):
    sys.modules.update(dict.fromkeys(lacking))
    print(main(words))
    for name in lacking:
        del sys.modules[name]
"""


def test_without_a_library_a_verb_says_what_brings_it(tmp_path):
    """Also as after `make demo`, which installs no more than it needs."""
    config, out = (
        ["--config", PACKAGE.parent / "config" / "two_imus.yaml"],
        ["--output", tmp_path / "out"],
    )
    more = {
        "replay": config,
        "sweep": config,
        "calibrate": [*config, *out],
        "convert": out,
        "setup": out,
    }
    more |= {"fleet": out, "inspect": []}
    lacking = {
        "setup": ["scipy"],
        "calibrate": ["scipy"],
        "fleet": ["pyarrow", "scipy"],
    }
    if not all(map(system.there, (*system.BAGS, "scipy", "pyarrow"))):
        lacking = {}
    bag = PACKAGE.parent / "bags" / "cone_flight"
    commands = {verb: [verb, *map(str, (bag, *words))] for verb, words in more.items()}
    asked = [(words, system.BAGS) for words in commands.values()]
    asked += [(commands[verb], names) for verb, names in lacking.items()]
    done = python(VERBS_WITHOUT, asked)
    assert done.stdout == "2\n" * len(asked), done.stderr
    lines = done.stderr.splitlines()
    pip = re.escape(f"{system._pip()} mcap rosbags lz4 zstandard")
    for verb, line in zip(more, lines[: len(more)], strict=True):
        assert re.fullmatch(
            rf"fdi: fdi {verb} needs mcap, rosbags, lz4(,| and) zstandard.*: {pip}.*",
            line,
        ), line
    assert lines[len(more) :] == [
        f"fdi: fdi {verb} needs {' and '.join(names)}: {system._pip()} {' '.join(names)}"
        for verb, names in lacking.items()
    ]


def test_without_what_reads_recordings_the_player_says_what_brings_it():
    pytest.importorskip("rclpy", reason="the node needs ROS 2")
    done = python(
        WITHOUT_BAGS
        + "from fdi_ros.ros.process import run; sys.exit(run('player_node', []))"
    )
    assert done.returncode == 2
    words = "reading recordings needs mcap, rosbags, lz4 and zstandard"
    pip = f"{system._pip()} mcap rosbags lz4 zstandard"
    assert done.stderr == f"player_node: {words}: {pip}\n"
