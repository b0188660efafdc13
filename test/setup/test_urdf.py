# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""`fdi inspect --urdf` writes the mounts that the URDF states, or refuses in one line."""

import numpy as np
import pytest
from bag.recordings import START, STEP, STORE, TOPICS, imu, write_mcap
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.inspection.starting_config import starting_config_of
from fdi_ros.inspection.urdf import read_urdf

TEXT = "std_msgs/msg/String"
FRAMES = ("left_imu", "right_imu")
ANGLES = {"plate": (0.1, -0.2, 2.5), "left": (0.3, 0.4, -0.5), "right": (3.0, 1.2, 0.7)}
LINKS = "its links: base, arm, plate, left_imu, right_imu"
ANGLE = st.floats(-4.0, 4.0)


def joint(name, parent, child, rpy=None, kind="fixed"):
    origin = "" if rpy is None else f'<origin rpy="{" ".join(map(repr, rpy))}"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{origin}</joint>'


def urdf(kind="fixed", angles=ANGLES):
    """The left unit on the base; the right one on a plate on an arm on the base."""
    links = "".join(f'<link name="{n}"/>' for n in ("base", "arm", "plate", *FRAMES))
    return f"""<robot name="r">{links}
{joint("to_left", "base", "left_imu", angles["left"])}
{joint("to_arm", "base", "arm", kind=kind)}
{joint("to_plate", "arm", "plate", angles["plate"])}
{joint("to_right", "plate", "right_imu", angles["right"])}
<transmission name="t"><joint name="to_arm"/></transmission></robot>"""


def expected(angles):
    turns = {
        name: Rotation.from_euler("xyz", rpy).as_matrix()
        for name, rpy in angles.items()
    }
    return turns["left"].T @ turns["plate"] @ turns["right"]


@pytest.fixture
def bag(tmp_path):
    return recording(tmp_path / "bag.mcap")


def recording(path, frames=FRAMES, change=False, described=""):
    """Two units; on request the second one changes its frame, and a topic has a URDF."""
    random = np.random.default_rng(0)
    messages = []
    for k in range(300):
        at = START + k * STEP
        for topic, frame in zip(TOPICS, frames, strict=True):
            name = "other_imu" if change and k == 200 and topic == TOPICS[1] else frame
            messages.append((topic, at, imu(at, random.normal(0, 0.01, 3), name)))
    if described:
        text = STORE.types[TEXT](described)
        message = bytes(STORE.serialize_cdr(text, TEXT))
        messages.append(("/robot_description", START, message))
    return write_mcap(path, messages, types={"/robot_description": TEXT})


def read(path):
    return read_urdf(path, path.parent)


def written(tmp_path, text):
    path = tmp_path / "robot.urdf"
    path.write_text(text)
    return path


def test_the_mounts_are_those_of_a_chain_of_fixed_joints(tmp_path, bag, fdi):
    robot = written(tmp_path, urdf())
    target = tmp_path / "start.yaml"
    said = fdi("inspect", bag, "--urdf", robot, "--output", target)
    assert said.err == ""
    mounts = np.reshape(Config.from_file(target).imus.mounts, (2, 3, 3))
    np.testing.assert_allclose(mounts[0], np.eye(3), rtol=0, atol=1e-15)
    np.testing.assert_allclose(mounts[1], expected(ANGLES), rtol=0, atol=1e-9)
    source = "hose of the URDF robot.urdf (imu_1 is link left_imu"
    assert source in said.out
    text = target.read_text()
    assert "mounts are from a URDF" in text
    comments = " ".join(text.replace("#", " ").split())
    assert source in comments
    assert "mounts are not" not in text
    assert "NOT MEASURED" not in text
    # Without a URDF, the config still states that nobody measured them.
    assumed = starting_config_of(bag, "no")
    assert assumed.parameters["imus.mounts"] == np.tile(np.eye(3).ravel(), 2).tolist()
    assert "mounts are not" in assumed.text


def test_a_recording_may_hold_the_urdf(tmp_path, fdi, refused):
    bag = recording(tmp_path / "bag.mcap", described=urdf())
    target = tmp_path / "start.yaml"
    for name in ("robot_description", "/robot_description"):
        said = fdi("inspect", bag, "--urdf", name, "--output", target, "--force")
        assert f"URDF {name} (imu_1 is link left_imu" in said.out
        mounts = np.reshape(Config.from_file(target).imus.mounts, (2, 3, 3))
        np.testing.assert_allclose(mounts[1], expected(ANGLES), rtol=0, atol=1e-9)
    assert "no file description, and bag.mcap has" in refused(
        "inspect", bag, "--urdf", "description"
    )
    bag = recording(tmp_path / "empty.mcap", described=" ")
    line = refused("inspect", bag, "--urdf", "robot_description")
    assert "robot_description is no URDF: no element found" in line


@given(*[st.tuples(ANGLE, ANGLE, ANGLE)] * 3)
def test_rotations_are_those_of_scipy(tmp_path_factory, plate, left, right):
    angles = {"plate": plate, "left": left, "right": right}
    robot = written(tmp_path_factory.getbasetemp(), urdf(angles=angles))
    first, second = read(robot).mounts(FRAMES)
    np.testing.assert_allclose(first, np.eye(3), rtol=0, atol=1e-11)
    np.testing.assert_allclose(second, expected(angles), rtol=0, atol=1e-9)


def test_units_on_one_moving_body_have_mounts(tmp_path):
    robot = read(written(tmp_path, urdf(kind="revolute")))
    _, right = robot.mounts(("plate", "right_imu"))
    turn = Rotation.from_euler("xyz", ANGLES["right"]).as_matrix()
    np.testing.assert_allclose(right, turn, rtol=0, atol=1e-9)


def test_a_frame_that_is_missing_or_moves_is_one_line(tmp_path, bag, refused):
    robot = written(tmp_path, urdf(kind="revolute"))
    line = refused("inspect", bag, "--urdf", robot)
    assert "link right_imu moves against left_imu by to_arm (revolute)" in line
    assert "to_left" not in line
    assert LINKS in line
    missing = recording(tmp_path / "missing.mcap", ("left_imu", "imu_link"))
    target = tmp_path / "start.yaml"
    line = refused("inspect", missing, "--urdf", robot, "--output", target)
    assert "has no link imu_link" in line
    assert LINKS in line
    assert not target.exists()


def test_messages_without_a_frame_or_with_several_are_refused(tmp_path, refused):
    robot = written(tmp_path, urdf())
    none = recording(tmp_path / "none.mcap", ("left_imu", ""))
    assert "have no frame_id" in refused("inspect", none, "--urdf", robot)
    several = recording(tmp_path / "several.mcap", change=True)
    assert "change their frame_id" in refused("inspect", several, "--urdf", robot)


BOMB = """<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>
<robot name="r"><link name="&b;"/></robot>"""
OUTSIDE = """<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/passwd">]>
<robot name="r"><link name="l"/>&x;</robot>"""
TWO = '<link name="a"/><link name="b"/>'


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (BOMB, "entities are refused"),
        (OUTSIDE, "entities are refused"),
        ("", "no element"),
        ("imus: {topics: []}", "syntax error"),
        ('<?xml version="1.0" encoding="klingon"?><robot/>', "encoding"),
        ("<robot>\0</robot>", "not well-formed"),
        ("<robot", "unclosed"),
        ("<a>" * 100_000, "no element found"),
        ("<sdf/>", "must be <robot>"),
        ("<robot/>", "links without a joint above: none"),
        (f"<robot>{TWO}</robot>", "links without a joint above: a, b; must be one"),
        ('<robot xmlns:xacro="u"><xacro:imu/></robot>', "xacro"),
        (f"<robot>{TWO}{joint('j', 'a', 'c')}</robot>", "joint j is c, not a link"),
        (f'<robot>{TWO}<joint name="j"/></robot>', "child of joint j is None"),
        (f"<robot>{TWO}{joint('j', 'a', 'b', (1, 2))}</robot>", "three numbers"),
        (f"<robot>{TWO}{joint('j', 'a', 'b', (1, 2, np.nan))}</robot>", "three"),
        (f"<robot>{TWO}{joint('j', 'a', 'b') * 2}</robot>", "two joints above"),
        (
            f"<robot>{TWO}{joint('j', 'a', 'b', ()).replace('rpy', 'quat_xyzw')}</robot>",
            "only rpy",
        ),
        (" " * (1 << 22) + "<robot/>", "more than"),
    ],
)
def test_a_file_that_is_no_urdf_is_refused(tmp_path, text, why):
    with pytest.raises(ConfigError, match="is no URDF") as error:
        read(written(tmp_path, text))
    assert why in str(error.value)
    assert len(str(error.value)) < 400


def test_joints_in_a_circle_are_refused(tmp_path):
    joints = joint("j", "b", "c") + joint("k", "c", "b")
    text = f'<robot>{TWO}<link name="c"/>{joints}</robot>'
    robot = read(written(tmp_path, text))
    with pytest.raises(ConfigError, match="circle"):
        robot.mounts(["a", "b"])


def test_only_a_regular_file_is_read(tmp_path, bag, refused):
    line = refused("inspect", bag, "--urdf", tmp_path / "none.urdf")
    assert "there is no file" in line
    assert "cannot read" in refused("inspect", bag, "--urdf", "/dev/zero")
    robot = written(tmp_path, BOMB)
    assert "is no URDF" in refused("inspect", bag, "--urdf", robot)
