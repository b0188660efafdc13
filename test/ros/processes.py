# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nodes of ours in processes of their own, and how long something of them is waited for."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import yaml

from fdi_ros.config.config import Config

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0
"""How long something that must come is waited for, s: a machine that is busy with other things makes no test fail."""


def wait(until: Callable[[], object], seconds: float = PATIENCE) -> bool:
    """Wait for something; whether it came."""
    end = time.monotonic() + seconds
    while not until():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def rest(count: Callable[[], int]) -> None:
    """Wait until nothing more comes."""
    before = -1
    while before != (before := count()):
        time.sleep(0.3)


def parameter_file(config: Config, folder: Path, **more: object) -> Path:
    """Write all settings as a ROS 2 parameter file."""
    flat = {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in config.parameters().items()
    }
    flat = {name: value for name, value in flat.items() if value != []}
    path = folder / "parameters.yaml"
    path.write_text(yaml.safe_dump({"/**": {"ros__parameters": {**flat, **more}}}))
    return path


class Process:
    """A node of ours in a process of its own; in names of parameters two underscores stand for a dot."""

    def __init__(
        self, name: str, file: Path, *remaps: str, **parameters: object
    ) -> None:
        self.output = Path(
            tempfile.mkstemp(prefix="fdi_ros_node_", dir=os.environ["ROS_LOG_DIR"])[1]
        )
        words = [
            "-m",
            "fdi_ros.ros.process",
            name,
            "--ros-args",
            "--params-file",
            str(file),
        ]
        words += [word for remap in remaps for word in ("-r", remap)]
        for key, value in parameters.items():
            words += ["-p", f"{key.replace('__', '.')}:={value}"]
        with self.output.open("w") as output:
            self.popen = subprocess.Popen(
                [sys.executable, *words],
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=ROOT,
            )

    def said(self) -> str:
        return self.output.read_text()

    def end(self, number: int = signal.SIGINT) -> int:
        """Send a signal and return the exit code."""
        if self.popen.poll() is None:
            self.popen.send_signal(number)
        try:
            return self.popen.wait(PATIENCE)
        finally:
            self.popen.kill()

    def memory(self) -> float:
        """Resident memory, MB."""
        pages = int(Path(f"/proc/{self.popen.pid}/statm").read_text().split()[1])
        return pages * 4096 / 1e6


@contextlib.contextmanager
def running(
    name: str, file: Path, *remaps: str, **parameters: object
) -> Iterator[Process]:
    """A node of ours that must end well when it is asked to."""
    process = Process(name, file, *remaps, **parameters)
    try:
        yield process
    finally:
        code = process.end()
    assert code == 0, f"exit code {code}: {process.said()}"
    assert "Traceback" not in process.said()


def assert_refused(name: str, starts: dict[str, str], *first: str) -> None:
    """Each of some starts of a node, all in one process, is refused in one line with some words in it."""
    code = f"""
import sys
from fdi_ros.ros.process import run
for arguments in {[[*first, *words.split()] for words in starts]!r}:
    print("=====", run({name!r}, arguments), file=sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    # rcl itself has a line to say of a file that it cannot read.
    said = [line for line in done.stderr.splitlines() if "[rcl]" not in line]
    assert said[1::2] == ["===== 2"] * len(starts), done.stderr
    for line, words in zip(said[::2], starts.values(), strict=True):
        assert line.startswith(f"{name}: ")
        assert words in line
