"""fdi watch: what it finds, says and draws of a real monitor in a namespace."""

from __future__ import annotations

import io
import math
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from ros.harness import ROOT, TWO_IMUS, Process, listening, parameter_file, sound, wait
from std_srvs.srv import Trigger

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import Level
from fdi_ros.monitor.output import ChannelState
from fdi_ros.ros.watch_node import Watcher
from fdi_ros.ros.watch_view import Change, Input, Picture, Teller, draw

WORDS = "disagrees with the others by 0.1488 rad/s for 12 s; isolated and left out"


@pytest.fixture
def picture() -> Picture:
    """Twelve channels, one of them faulty."""
    names = tuple(f"imu_{unit}.{axis}" for unit in (1, 2, 3, 4) for axis in "xyz")
    seen = Picture("/drone/fdi_node", "", names=names, statistic=3.1, threshold=19.7, rate=(0.5, -1.25, 0.0))
    seen.take_states([ChannelState.OK] * 12)
    seen.take_states([ChannelState.FAULTY if name == "imu_2.y" else ChannelState.OK for name in names])
    seen.words = {name: (state.name, WORDS) for name, state in zip(names, seen.states, strict=True)}
    seen.residuals = dict.fromkeys(names, 0.001) | {"imu_2.y": -0.149}
    seen.whole, seen.whole_level = "11 of 12 channels healthy; any further fault would be seen and isolated", Level.WARN
    seen.level = (0.01, 0.02, 0.03)
    seen.inputs = [Input("imu_3", Level.STALE, "silent for 1.2 s", "0.0")]
    seen.find_words()
    # Fresh, however long this machine takes to draw it.
    seen.heard = dict.fromkeys(("integrity", "fused", "diagnostics"), math.inf)
    return seen


@pytest.mark.parametrize("width", [40, 60, 80, 120])
def test_no_line_is_wider_than_the_terminal_and_no_word_is_cut(picture: Picture, width: int) -> None:
    console = pytest.importorskip("rich.console", reason="the extra 'watch' is not installed")
    out = io.StringIO()
    console.Console(file=out, width=width).print(draw(picture, width, 40))
    lines = out.getvalue().splitlines()
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).split())
    assert picture.whole in text
    assert f"imu_2.y OK -> FAULTY: {WORDS}" in text
    assert "input imu_3: silent for 1.2 s" in text
    (row,) = [line for line in lines if line.startswith("imu_2.y")]
    assert "FAULTY" in row
    assert row.split()[-1] == "-0.1490"
    # The bar ends at 0.2 rad/s.
    assert 0.6 < row.count("█") / (row.count("█") + row.count("·")) < 0.9


def test_what_is_no_longer_said_is_not_shown_as_what_is(picture: Picture) -> None:
    console = pytest.importorskip("rich.console", reason="the extra 'watch' is not installed")
    picture.heard = {}
    out = io.StringIO()
    console.Console(file=out, width=80).print(draw(picture, 80, 40))
    assert "healthy" not in out.getvalue()
    assert "no rate" in out.getvalue()
    rows = [line for line in out.getvalue().splitlines() if line.startswith("imu_")]
    assert len(rows) == 12
    assert all(row.split()[1] == "?" and row.split()[-1] == "none" for row in rows)


def test_a_change_is_told_once_with_its_words(picture: Picture) -> None:
    teller = Teller()
    said = teller.lines(picture)
    assert [line.split("  ", 1)[1] for line in said[:2]] == ["all  OK", f"imu_2.y  OK -> FAULTY: {WORDS}"]
    assert picture.whole in said[2]
    assert teller.lines(picture) == []
    # Its words come with the next diagnostics.
    picture.changes.append(Change(time.time(), ("imu_1.x",), ChannelState.OK, ChannelState.SUSPECT))
    assert teller.lines(picture) == []
    picture.words["imu_1.x"] = ("SUSPECT", "disagrees")
    picture.find_words()
    assert teller.lines(picture)[0].endswith("imu_1.x  OK -> SUSPECT: disagrees")


def test_a_monitor_in_a_namespace_is_waited_for_told_and_missed(tmp_path) -> None:
    path = tmp_path / "said"
    with path.open("w") as out, listening(tuple(f"/drone/{topic}" for topic in TWO_IMUS.topics)) as listener:
        command = [sys.executable, "-m", "fdi_ros.cli", "watch"]
        watch = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT)
        assert wait(lambda: "waiting for a monitor (fdi_node) on ROS_DOMAIN_ID" in path.read_text()), path.read_text()
        file = str(parameter_file(TWO_IMUS, tmp_path))
        monitor = Process("fdi_node", "--ros-args", "-r", "__ns:=/drone", "-r", "fused:=rate", "--params-file", file)
        try:
            z = sound(50)[1]
            # The node starts within this time, too.
            assert wait(lambda: listener.play(z) is not None and "6 of 6 channels healthy" in path.read_text(), 240)
            assert "| fused rate +" in path.read_text()
            z[:, 4] += 0.3
            assert wait(lambda: listener.play(z) is not None and "imu_2.y isolated" in told(path.read_text()))
            # Another one: which is meant must be said.
            listener.create_service(Trigger, "/other/relearn_bias", lambda _, answer: answer)
            watcher = Watcher()
            with pytest.raises(FdiError, match=r"2 monitors are running.*/drone/fdi_node, /other"):
                wait(watcher.look)
            watcher.destroy_node()
        finally:
            assert monitor.end() == 0, monitor.said()
        assert wait(lambda: "/drone/fdi_node is gone: waiting for it to come back" in path.read_text())
        watch.send_signal(signal.SIGINT)
        assert watch.wait(60) == 0
    assert "Traceback" not in path.read_text()


def told(text: str) -> str:
    """Channels that are said to be isolated, in words."""
    return " ".join(f"{line.split()[1]} isolated" for line in text.splitlines() if "-> FAULTY: disagrees" in line)
