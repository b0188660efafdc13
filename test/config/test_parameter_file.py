# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Parameter files: what is written is read as the same, whatever it is; later files win; errors say where they are."""

from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from fdi_ros.config.config import (
    PARAMETERS,
    WIDTH,
    Config,
    parameter_file,
    parameters_of,
    read_parameter_file,
    with_parameters,
)
from fdi_ros.errors import ConfigError

CONFIG = Path(__file__).parents[2] / "config"
SHIPPED = ("two_imus", "three_imus", "two_triads", "px4", "ardupilot")

ONE = {
    "bool": lambda field: st.booleans(),
    "int": lambda field: st.integers(int(field.low), int(field.high)),
    "float": lambda field: st.floats(
        field.low, field.high, allow_nan=False, allow_infinity=False
    ),
    "text": lambda field: (
        st.sampled_from(field.choices) if field.choices else st.text(max_size=40)
    ),
}
VALUES = {
    name: st.lists(
        ONE["float" if field.kind == "numbers" else "text"](field), max_size=12
    ).map(tuple)
    if field.kind in ("numbers", "texts")
    else ONE[field.kind](field)
    for name, field in PARAMETERS.items()
}


@settings(deadline=None, max_examples=50)
@given(st.data())
def test_what_is_written_is_read_as_the_same(data):
    names = data.draw(
        st.lists(st.sampled_from(list(PARAMETERS)), unique=True, max_size=12)
    )
    values = {name: data.draw(VALUES[name]) for name in names}
    read = parameters_of(
        parameter_file(values, "made of\nthese", dict.fromkeys(names, "a remark"))
    )
    assert {
        name: tuple(v) if isinstance(v, list) else v for name, v in read.items()
    } == values


@pytest.mark.parametrize(
    "text",
    [
        "y",
        "No",
        "on",
        "1",
        "1e5",
        ".inf",
        "nan",
        "",
        "a: b",
        "# a",
        "[a",
        "~",
        "a\nb",
        "\u2028",
    ],
)
def test_a_text_that_yaml_or_ros_would_take_for_something_else_is_in_quotes(text):
    line = next(
        line
        for line in parameter_file({"hardware_id": text}, "").splitlines()
        if "hardware_id: " in line
    )
    assert line.startswith('    hardware_id: "')
    assert parameters_of(parameter_file({"hardware_id": text}, "")) == {
        "hardware_id": text
    }


@pytest.mark.parametrize("name", SHIPPED)
def test_all_else_is_carried_over_by_value(name):
    source = CONFIG / f"{name}.yaml"
    before = yaml.safe_load(source.read_text())
    changes = {
        "noise.noise_std": [0.5, 1e-5],
        "bias.fixed": [0.25],
        "detector.false_alarms_per_hour": 1.0,
    }
    text = with_parameters([source], changes, "made here", {}, ["imus.mounts"])
    expected = {
        key: value
        for key, value in read_parameter_file(source).items()
        if key != "imus.mounts"
    }
    assert parameters_of(text) == {**expected, **changes}
    assert text.startswith("# made here\n/**:\n")
    after = yaml.safe_load(text)
    assert {node: after[node] for node in after if node != "/**"} == {
        node: before[node] for node in before if node != "/**"
    }, "other nodes"
    assert (
        max(len(line) for line in text.splitlines() if line.lstrip().startswith("#"))
        <= WIDTH
    )


def test_unit_and_meaning_of_every_parameter_stand_in_the_file():
    text = " ".join(parameter_file(Config().parameters(), "").replace("#", " ").split())
    for field in PARAMETERS.values():
        assert f"{field.unit}: {field.description}".removeprefix(": ") in text


FIRST = """\
/**:
  ros__parameters:
    use_sim_time: true
    noise: {noise_std: [1e-3], scale_std: [0.1]}
    decision.latch: false
drone:
  mavlink_node:
    ros__parameters: {url: "tcp:a:1", system_id: 3}
"""
SECOND = """\
/drone/fdi_node:
  ros__parameters:
    noise.scale_std: 0.2
    qos_overrides./imu.subscription.depth: 7
drone: {mavlink_node: {ros__parameters: {system_id: 4}}}
"""


def test_of_several_files_later_ones_win(tmp_path):
    files = [tmp_path / "first.yaml", tmp_path / "second.yaml"]
    for file, text in zip(files, (FIRST, SECOND), strict=True):
        file.write_text(text)
    config = Config.from_file(files)
    assert config.changed == {
        "noise.noise_std": (0.001,),
        "noise.scale_std": (0.2,),
        "decision.latch": False,
    }
    assert Config.from_file(files, {"noise.scale_std": [0.3]}).noise.scale_std == (0.3,)
    assert Config.from_file(files[::-1]).noise.scale_std == (0.1,)
    text = with_parameters(files, {}, "made here", {})
    assert Config.from_parameters(parameters_of(text)) == config
    found = yaml.safe_load(text)
    assert found["drone"]["mavlink_node"]["ros__parameters"] == {
        "url": "tcp:a:1",
        "system_id": 4,
    }
    ros = found["/**"]["ros__parameters"]
    assert (ros["use_sim_time"], ros["qos_overrides./imu.subscription.depth"]) == (
        True,
        7,
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "a:\n  b: [1, 2\nc: 3\n",
            "line 3, column 2: while parsing a flow sequence, did not find",
        ),
        (
            "a: 'x\n",
            "line 2, column 1: while scanning a quoted scalar, found unexpected end",
        ),
        ("/**:\n\tx: 1\n", "line 2, column 1"),
        (
            "a: !!python/object x\n",
            "line 1, column 4: could not determine a constructor for the tag",
        ),
    ],
)
def test_an_error_says_where_it_is_in_one_line(tmp_path, text, words):
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError) as refused:
        Config.from_file(tmp_path / "bad.yaml")
    said = str(refused.value)
    assert said.startswith(f"config {tmp_path / 'bad.yaml'} is not YAML: ")
    assert words in said
    assert "unicode string" not in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (["/front/imu", "/rear/imu"], ("front", "rear")),
        (["imu_0/data", "imu_1/data"], ("imu_0", "imu_1")),
    ],
)
def test_units_without_names_are_named_after_their_topics(topics, names, tmp_path):
    path = tmp_path / "two.yaml"
    given = {"input": "imus", "imus": {"topics": topics}}
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": given}}))
    config = Config.from_file(path)
    assert config.imu_names == names
    assert config.channel_names[0] == f"{names[0]}.x"
