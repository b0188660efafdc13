# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""fdi watch: what it finds, says and draws of a real monitor in a namespace."""

import io
import math
import re
import signal
import subprocess
import sys
from functools import partial

import pytest

pytest.importorskip("rclpy", reason="the node needs ROS 2")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from ros.harness import TWO_IMUS, healthy, listening
from ros.processes import ROOT, parameter_file, running, wait
from std_srvs.srv import Trigger

from fdi_ros.errors import FdiError
from fdi_ros.monitor.diagnostics import Level, StatusLine
from fdi_ros.ros.watch import CHANGES, LineReport, Picture, Watcher, draw

WORDS = "disagrees with the others by 0.1488 rad/s for 12 s; isolated and left out"


def channel(
    name: str, state: str, level: Level = Level.OK, words: str = "", **values: float
) -> StatusLine:
    keys = {
        "residual": "residual (rad/s)",
        "bias": "bias (rad/s)",
        "std": "bias known to (rad/s)",
    }
    pairs = tuple((keys[key], str(value)) for key, value in values.items())
    return StatusLine(level, name, words, values=(("state", state), *pairs))


def whole(message: str, **more: str) -> StatusLine:
    figures = {
        "verdict": "FAULTY",
        "statistic": "3.1",
        "threshold": "19.7",
        "protection level (rad/s)": "0.01 0.02 0.03",
        **more,
    }
    return StatusLine(Level.WARN, "monitor", message, values=tuple(figures.items()))


@pytest.fixture
def picture() -> Picture:
    """Twelve channels, one of them faulty."""
    names = [f"imu_{unit}.{axis}" for unit in (1, 2, 3, 4) for axis in "xyz"]
    seen = Picture("/drone/fdi_node", "", "", rate=(0.5, -1.25, 0.0))
    healthy = {
        name: channel(name, "OK", words="agrees", residual=0.001) for name in names
    }
    seen.update_channels(healthy)
    faulty = channel(
        "imu_2.y",
        "FAULTY",
        Level.ERROR,
        WORDS,
        residual=-0.149,
        bias=0.0021,
        std=0.0003,
    )
    seen.update_channels(healthy | {"imu_2.y": faulty})
    seen.whole = whole("11 of 12 channels healthy; a further fault would be isolated")
    seen.inputs = [StatusLine(Level.STALE, "imu_3", "silent for 1.2 s")]
    # Fresh, however long this machine takes to draw it.
    seen.heard = dict.fromkeys(("fused", "diagnostics"), math.inf)
    return seen


def drawn(picture: Picture, width: int) -> list[str]:
    """Lines that are shown in a terminal."""
    console = pytest.importorskip(
        "rich.console", reason="the extra 'watch' is not installed"
    )
    out = io.StringIO()
    console.Console(file=out, width=width).print(draw(picture, width))
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [40, 80, 120])
def test_no_line_is_wider_than_the_terminal_and_no_word_is_cut(
    picture: Picture, width: int
) -> None:
    lines = drawn(picture, width)
    assert max(map(len, lines)) <= width
    text = " ".join(" ".join(lines).split())
    assert f"FAULTY: {picture.whole.message}" in text
    assert f"imu_2.y OK -> FAULTY: {WORDS}" in text
    assert "input imu_3: silent for 1.2 s" in text
    (row,) = [line for line in lines if line.startswith("imu_2.y")]
    assert "FAULTY" in row
    assert row.split("-0.1490")[1].split() == (
        ["+0.0021", "+-", "0.0003"] if width > 90 else []
    )
    (evidence,) = [line for line in lines if line.startswith("evidence")]
    assert "3.1 of 19.7" in evidence
    # The bar ends at 0.2 rad/s, and where the names of states and the figures begin.
    room = row.index("-0.1490") - len("imu_2.y FAULTY    ") - 1
    assert 0.6 * room < row.count("█") + 1 < 0.9 * room + 1


def test_accelerometers_have_a_scale_and_figures_in_their_own_unit(
    picture: Picture,
) -> None:
    values = (("state", "OK"), ("residual (m/s^2)", "1.5"), ("bias (m/s^2)", "0.25"))
    force = StatusLine(Level.OK, "imu_1.accel_x", "agrees", values=values)
    picture.update_channels({**picture.channels, "imu_1.accel_x": force})
    lines = drawn(picture, 120)
    (gyros, forces) = [line for line in lines if line.startswith("channel")]
    assert "residual, to 0.2 rad/s" in gyros
    assert "residual, to 2 m/s^2" in forces
    assert "bias, m/s^2" in forces
    (row,) = [line for line in lines if line.startswith("imu_1.accel_x")]
    assert row.split("+1.5000")[1].split() == ["+0.2500"]
    assert lines.index(forces) > max(
        k for k, line in enumerate(lines) if line.startswith("imu_4.z")
    )
    # The rows of the gyros are as they were without accelerometers.
    (faulty,) = [line for line in lines if line.startswith("imu_2.y")]
    assert "-0.1490" in faulty


def test_what_is_no_longer_said_is_not_shown_as_what_is(picture: Picture) -> None:
    picture.heard = {}
    lines = drawn(picture, 80)
    assert not [line for line in lines if "healthy" in line]
    assert [line for line in lines if "no rate" in line]
    rows = [line for line in lines if line.startswith("imu_")]
    assert len(rows) == 12
    assert all(row.split()[1:] == ["?", "none"] for row in rows)


def test_each_change_is_reported_once_and_the_whole_when_it_is_new(
    picture: Picture,
) -> None:
    report = LineReport(picture)
    said = [line.split("  ", 1)[1] for line in report.lines()]
    assert said[:2] == ["all  OK", f"imu_2.y  OK -> FAULTY: {WORDS}"]
    assert picture.whole.message in said[2]
    assert report.lines() == []
    # Alike with the same words: in one line.
    doubtful = channel("imu_1.x", "SUSPECT", Level.WARN, "disagrees", residual=0.1)
    picture.update_channels(
        {**picture.channels, "imu_1.x": doubtful, "imu_1.y": doubtful}
    )
    picture.whole = whole("9 of 12")
    said = [line.split("  ", 1)[1] for line in report.lines()]
    assert said[0] == "imu_1.x, imu_1.y  OK -> SUSPECT: disagrees"
    assert said[1].startswith(
        "FAULTY: 9 of 12 | fused rate +0.500 -1.250 +0.000 rad/s | evidence 3.1 of 19.7"
    )
    # More than is remembered: those that are.
    for _ in range(2 * CHANGES.kept):
        before = {**picture.channels}
        picture.update_channels(before | {"imu_1.x": channel("imu_1.x", "OK")})
        picture.update_channels(before)
    assert len(report.lines()) == CHANGES.kept


EVIL = "\x1b[31mEVIL\x1b]0;pwned\x07[/red][bold]"


def test_text_from_outside_is_not_obeyed(picture: Picture) -> None:
    evil = channel(EVIL, "SUSPECT", Level.WARN, EVIL, residual=0.1, bias=0.0, std=0.0)
    picture.update_channels({EVIL: evil} | {**picture.channels})
    keys = (
        "sample rate (Hz)",
        "latency p50 (ms)",
        "latency p99 (ms)",
        "detector",
        "protection level (rad/s)",
    )
    picture.whole = whole(EVIL, **dict.fromkeys(keys, EVIL))
    picture.waiting = picture.monitor = picture.caption = EVIL
    report = LineReport(picture)
    said = report.lines()
    picture.waiting = ""
    said += report.lines()
    for level in (Level.OK, Level.WARN):
        picture.inputs = [StatusLine(level, EVIL, EVIL, values=(("rate (Hz)", EVIL),))]
        said += drawn(picture, 500)
    assert all(line.isprintable() for line in said), [
        line for line in said if not line.isprintable()
    ]
    assert len([line for line in said if "[/red][bold]" in line]) >= 12


def test_a_monitor_in_a_namespace_is_waited_for_told_and_missed(tmp_path) -> None:
    path, file = tmp_path / "said", parameter_file(TWO_IMUS, tmp_path)
    with (
        path.open("w") as out,
        listening(tuple(f"/drone/{topic}" for topic in TWO_IMUS.topics)) as listener,
    ):
        command = [sys.executable, "-m", "fdi_ros.cli", "watch"]
        # A suite in the background may have been told to ignore the signal that ends this.
        obeys = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
        watch = subprocess.Popen(
            command, stdout=out, stderr=subprocess.STDOUT, cwd=ROOT, preexec_fn=obeys
        )
        assert wait(
            lambda: (
                "waiting for a monitor (fdi_node) on ROS_DOMAIN_ID" in path.read_text()
            )
        ), path.read_text()
        with running("fdi_node", file, "__ns:=/drone", "fused:=rate") as monitor:
            z = healthy(50)[1]
            # The node starts within this time, too.
            assert wait(
                lambda: (
                    listener.play(z) is not None
                    and "6 of 6 channels healthy" in path.read_text()
                ),
                240,
            )
            assert "| fused rate +" in path.read_text()
            z[:, 4] += 0.3
            named = re.compile("  imu_2.y  .*-> FAULTY: disagrees")
            assert wait(
                lambda: listener.play(z) is not None and named.search(path.read_text())
            )
            # Another one: which is meant must be said.
            listener.create_service(
                Trigger, "/other/relearn_bias", lambda _, answer: answer
            )
            watcher = Watcher()
            with pytest.raises(
                FdiError, match=r"2 monitors are running.*/drone/fdi_node, /other"
            ):
                wait(watcher.look)
            watcher.destroy_node()
            # What no monitor says is left aside.
            odd = listener.create_publisher(DiagnosticArray, "/diagnostics", 10)
            assert wait(lambda: odd.get_subscription_count() > 1)
            for state, level in (("WELL", 0), ("OK", 9)):
                values = [KeyValue(key="state", value=state)]
                status = DiagnosticStatus(
                    level=bytes([level]), name="drone/fdi_node: imu_1.x", values=values
                )
                odd.publish(DiagnosticArray(status=[status]))
            # One that hangs is missed as one that was killed: DDS keeps both.
            monitor.popen.send_signal(signal.SIGSTOP)
            assert wait(
                lambda: (
                    "/drone/fdi_node is silent: it was killed or hangs"
                    in path.read_text()
                )
            )
            monitor.popen.send_signal(signal.SIGCONT)
        assert wait(
            lambda: (
                "/drone/fdi_node is gone: waiting for it to come back"
                in path.read_text()
            )
        )
        known, z = len(path.read_text()), healthy(50)[1]
        with running("fdi_node", file, "__ns:=/drone", "/diagnostics:=/x/diagnostics"):
            assert wait(
                lambda: (
                    listener.play(z) is not None
                    and "6 of 6 channels" in path.read_text()[known:]
                )
            )
        watch.send_signal(signal.SIGINT)
        assert watch.wait(60) == 0
    assert "Traceback" not in path.read_text()
