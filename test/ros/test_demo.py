"""The demo in a process of its own, as make demo starts it: a short flight, in a pipe."""

import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="the demo needs ROS 2")
pytestmark = pytest.mark.usefixtures("quiet_domain")


def demo(root: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "fdi_ros.ros.demo", *words]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=90, check=False)


def test_the_fault_is_found_shown_and_summed_up(root: Path) -> None:
    begin = time.monotonic()
    done = demo(root, "--seconds", "9.5", "--fault", "channel=imu_1.z kind=bias size=-0.2 start=8.5")
    assert done.returncode == 0, done.stdout + done.stderr
    assert time.monotonic() - begin < 40
    lines = done.stdout.splitlines()
    states = [line.split(maxsplit=4)[4:] for line in lines if line.startswith("t = ") and "imu_1.z" in line]
    words = " ".join(" ".join(part) for part in states)
    assert re.search(r"OK -> SUSPECT.*SUSPECT -> FAULTY", words), done.stdout
    # What diagnostics says is in time that the flight knows: nothing lasts longer than it.
    assert "all       /diagnostics: bias not learned yet since the start" in done.stdout, done.stdout
    assert "isolated    imu_1.z" in done.stdout
    assert "others      none declared" in done.stdout
    with_, without = map(float, re.findall(r"([\d.]+) rad/s", lines[-1]))
    # Leaving a channel out costs noise, 0.003 rad/s; keeping this one in costs 0.2 rad/s times its gain.
    assert with_ < 0.006
    assert without > 0.08


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("channel=imu_3.x kind=bias size=1 start=5", "imu_3.x"),
        ("channel=imu_1.x kind=bias size=1 start=500", "starts at 500 s, expected less than 8.99 s"),
        ("channel=imu_1.x kind=biased size=1", "unknown fault kind 'biased'"),
    ],
)
def test_a_wrong_fault_is_one_line(root: Path, fault: str, words: str) -> None:
    done = demo(root, "--seconds", "9", "--fault", fault)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count("\n") == 1
