# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The demo in a process of its own, as make demo starts it: a short flight, in a pipe."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="the demo needs ROS 2")
pytestmark = pytest.mark.usefixtures("quiet_domain")


def demo(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "examples/demo.py", *words]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=240, check=False)


def test_the_fault_is_found_shown_and_summed_up(root: Path) -> None:
    done = demo(root, "--seconds", "6.0", "--fault", "channel=imu_1.z kind=bias size=-0.2 start=5.0")
    assert done.returncode == 0, done.stdout + done.stderr
    # A machine that is busy may deliver both changes at once.
    assert re.search(r"^[\d:.]+  imu_1\.z  (OK|SUSPECT|AMBIGUOUS) -> FAULTY", done.stdout, re.MULTILINE), done.stdout
    assert re.search(r"  all  UNCHECKED: no sample yet|  all  UNCHECKED -> OK", done.stdout), done.stdout
    # What is to come is said until it is there, and then what has come.
    before, begins, after = done.stdout.partition("fault now: channel=imu_1.z")
    assert begins
    assert "fault to come 5 s after the start: channel=imu_1.z" in before
    assert "to come" not in after
    assert "isolated    imu_1.z" in done.stdout
    assert "others      none declared" in done.stdout


def test_a_wrong_fault_is_one_line(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from examples import demo

    # It keeps itself out of other programs' way; that is for the process that it is.
    monkeypatch.setattr(os, "environ", dict(os.environ))
    for fault, words in (
        ("channel=imu_3.x kind=bias size=1 start=5", "imu_3.x"),
        ("channel=imu_1.x kind=bias size=1 start=500", "starts at 500 s, expected less than 8.99 s"),
        ("channel=imu_1.x kind=biased size=1", "unknown fault kind 'biased'"),
    ):
        assert demo.main(["--seconds", "9", "--fault", fault]) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert words in said.err
        assert said.err.count("\n") == 1
