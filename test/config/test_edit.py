# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A parameter file is changed in place: every other character of it stays; and what is said of one that is no YAML."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from fdi_ros.config.config import Config, read_parameter_file
from fdi_ros.config.edit import with_parameters
from fdi_ros.errors import ConfigError
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.setup.calibrate import REPLACED
from fdi_ros.setup.inspect import candidates, inspect
from fdi_ros.setup.starting_config import config_text

CONFIG = Path(__file__).parents[2] / "config"

COMMENTED = """\
# my vehicle
/**:
  ros__parameters:
    input: imus   # two of them
    imus:
      topics: [a,   b] # odd spacing stays
    noise:
      noise_std: [0.003] # from the data sheet

      # about scale
      scale_std: [0.002]
    detector: {name: projector}
"""


DASHED = """\
/**:
  ros__parameters:
    input: imus
    imus:
      topics:
      - a
      # the new one
      - b
    noise:
      noise_std:
        # of the old kind
        - 0.003   # by the data sheet
        # of the new kind
        - 0.004   # measured
      # about scale
      scale_std: &shared
        - 0.002
      timing_std: *shared
    detector: {name: projector}
"""


@pytest.mark.parametrize("values", [[0.001], [0.001, 0.002], [0.001, 0.002, 0.005, 0.006, 0.007, 0.008]])
def test_lists_with_dashes_keep_their_comments(values: list[float], tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_text(DASHED)
    changes = {"noise.noise_std": values, "noise.timing_std": [0.5], "imus.delays": [0.0, 0.1]}
    text = with_parameters(source, changes, "note")
    # Only the lines of the values differ; those of items that are no more are gone.
    gone = {"        - 0.003   # by the data sheet", "        - 0.004   # measured", "      timing_std: *shared"}
    assert [line for line in DASHED.splitlines() if line not in text.splitlines()] == [
        line for line in DASHED.splitlines() if line in gone
    ]
    assert f"        - {values[0]!r}   # by the data sheet" in text.splitlines()
    parameters = yaml.safe_load(text)["/**"]["ros__parameters"]
    assert parameters["noise"] == {"noise_std": values, "scale_std": [0.002], "timing_std": [0.5]}
    assert parameters["imus"] == {"topics": ["a", "b"], "delays": [0.0, 0.1]}


def test_a_list_with_dashes_goes_whole(tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_text(DASHED.replace("noise_std:", "bias_walk:"))
    text = with_parameters(source, {"noise.noise_std": [0.1]}, "note", ["noise.bias_walk"])
    assert yaml.safe_load(text)["/**"]["ros__parameters"]["noise"] == {
        "noise_std": [0.1], "scale_std": [0.002], "timing_std": [0.002],
    }  # fmt: skip
    assert "# about scale" in text


def test_a_value_that_others_take_is_not_changed(tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_text(DASHED)
    with pytest.raises(ConfigError, match=r"noise.scale_std has an anchor, &shared, and others take its value"):
        with_parameters(source, {"noise.scale_std": [0.1]}, "note")


HEAD = """\
/**:
  ros__parameters:
    input: imus
    imus:
      topics: [a, b]
"""
STD = "    noise:\n      noise_std: [0.003]\n"


CHANGES = {
    "noise.noise_std": [0.5, 1e-5],
    "noise.scale_std": [0.25],
    "bias.fixed": [0.5],
    "bias.startup_bias_duration": 0.0,
    "detector.false_alarms_per_hour": 1.0,
}


@pytest.mark.parametrize(
    "text",
    [
        COMMENTED,
        HEAD + STD,
        "\ufeff" + HEAD + STD,
        (HEAD + "    bias:\n      turn_on_std: 0.1 # mine\n" + STD).replace("\n", "\r\n"),
        HEAD + "    noise:\n      noise_std:\t[0.003]\t# per channel\n",
        HEAD + "    bias: {turn_on_std: 0.1,}\n" + STD,
        HEAD + "    bias: {turn_on_std: 0.1 # keep\n    }\n" + STD,
        HEAD + STD + "...\n",
        HEAD + STD + '    hardware_id: "a\n\n# Calibrated: no\n\n      b"\n# inspect: of my own\n',
        HEAD + "    noise.noise_std: [0.003]\n",
        HEAD.replace("/**", "other_node") + HEAD.replace("/**", "/a/fdi_node") + STD,
        *((CONFIG / f"{name}.yaml").read_text() for name in ("two_imus", "three_imus", "two_triads")),
    ],
)
def test_a_file_in_any_style_gets_the_parameters_and_keeps_its_other_lines(text: str, tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_bytes(text.encode())
    before, changed = read_parameter_file(source), with_parameters(source, CHANGES, "note")
    words = [f"{name.rpartition('.')[2]}:" for name in CHANGES] + ["bias: {", "detector: {"]
    kept = [
        line
        for line in text.removeprefix("\ufeff").split("\n")
        if line.strip("} \r") and not any(word in line for word in words)
    ]
    assert [line for line in changed.removeprefix("\ufeff").split("\n") if line in kept] == kept
    # What is said of a value that is changed stays as well.
    assert changed.count("#") >= text.count("#")
    source.write_bytes(changed.encode())
    assert read_parameter_file(source) == {**before, **CHANGES}
    assert with_parameters(source, CHANGES, "note") == changed


@pytest.mark.parametrize(
    "text",
    [
        "defaults: &noise {noise_std: [0.003], scale_std: [0.01]}\n" + HEAD + "    noise: *noise\n",
        "defaults: &noise {noise_std: [0.003]}\n" + HEAD + "    noise:\n      <<: *noise\n",
        HEAD + "    noise:\n      noise_std: [0.001]\n    noise.noise_std: [0.003]\n",
        HEAD + "    noise:\n      noise_std:\n      - &v 0.003\n      - *v\n",
    ],
)
def test_what_cannot_be_changed_by_itself_is_refused_by_name(text: str, tmp_path: Path) -> None:
    source = tmp_path / "mine.yaml"
    source.write_text(text)
    with pytest.raises(ConfigError, match=r"mine.yaml is written in a way in which \S+ cannot be changed in place"):
        with_parameters(source, {"noise.noise_std": [0.5, 0.5]}, "note")


def test_what_inspect_said_of_a_value_goes_with_the_value(tmp_path: Path) -> None:
    source = tmp_path / "start.yaml"
    source.write_text(COMMENTED.replace("# from the data sheet", "# inspect: rad/s, a guess"))
    assert "a guess" in with_parameters(source, {"noise.scale_std": [0.001]}, "note")
    assert "a guess" not in with_parameters(source, {"noise.noise_std": [0.001]}, "note")


@pytest.mark.parametrize("name", ["two_imus", "three_imus", "inspected"])
def test_mounts_that_the_axes_replace_are_gone_with_what_was_said_of_them(
    name: str, root: Path, tmp_path: Path
) -> None:
    source = CONFIG / f"{name}.yaml"
    if name == "inspected":
        source = tmp_path / "inspected.yaml"
        bag = root / "bags" / "cone_flight"
        source.write_text(config_text(candidates(inspect(bag)[0]), bag))
    n = Pipeline(Config.from_file(source)).geometry.n
    axes = np.tile(np.eye(3), (n // 3, 1)).ravel().tolist()
    changes = {"geometry.preset": "axes", "geometry.axes": axes, "imus.delays": [0.0] * (n // 3)}
    text = with_parameters(source, changes, "note", REPLACED)
    assert "mounts:" not in text
    assert "Mount rotation" not in text
    assert "inspect:" not in text.partition("noise:")[0]
    (tmp_path / "new.yaml").write_text(text)
    before, after = Config.from_file(source).parameters(), Config.from_file(tmp_path / "new.yaml").parameters()
    kept = set(before) - set(changes) - {"imus.mounts"}
    assert {k: after[k] for k in kept} == {k: before[k] for k in kept}
    assert after["imus.mounts"] == ()


def test_what_has_no_lines_of_its_own_stays(tmp_path: Path) -> None:
    source = tmp_path / "flow.yaml"
    source.write_text("/**:\n  ros__parameters:\n    input: imus\n    imus: {topics: [a, b], mounts: []}\n")
    assert "mounts: []" in with_parameters(source, {"imus.timeout": 0.2}, "note", REPLACED)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a:\n  b: [1, 2\nc: 3\n", "line 3, column 2: while parsing a flow sequence, did not find"),
        ("a: 'x\n", "line 2, column 1: while scanning a quoted scalar, found unexpected end"),
        ("/**:\n\tx: 1\n", "line 2, column 1"),
        ("a: !!python/object x\n", "line 1, column 4: could not determine a constructor for the tag"),
    ],
)
def test_an_error_says_where_it_is_in_one_line(tmp_path, text, words) -> None:
    (tmp_path / "bad.yaml").write_text(text)
    with pytest.raises(ConfigError) as refused:
        Config.from_file(tmp_path / "bad.yaml")
    said = str(refused.value)
    assert said.startswith(f"config {tmp_path / 'bad.yaml'} is not YAML: ")
    assert words in said
    assert "unicode string" not in said
    assert "\n" not in said
