# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The steps of the Dockerfile, one by one, as far as they can be run here: no image is built."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("colcon_ros", reason="colcon is not installed: pip install -e '.[test]'")

pytestmark = pytest.mark.usefixtures("compiled")

SOURCED = ". /opt/ros/jazzy/setup.sh && "
USER = 54321


def steps(root: Path) -> list[tuple[str, str]]:
    """Instructions of the Dockerfile and what they are given."""
    text = re.sub(r"\\\n\s*", "", re.sub(r"^#.*\n", "", (root / "Dockerfile").read_text(), flags=re.MULTILINE))
    return [(word, rest) for word, _, rest in (line.partition(" ") for line in text.splitlines()) if word]


def test_the_image_installs_what_the_manifest_names_and_runs_as_a_user(root: Path) -> None:
    order = steps(root)
    assert order[0] == ("FROM", "ros:jazzy-ros-base")
    runs = [rest for word, rest in order if word == "RUN"]
    assert "rosdep install --rosdistro jazzy --from-paths src" in runs[0]
    assert "pip" not in " ".join(runs)
    (user,) = [rest for word, rest in order if word == "USER"]
    assert f"useradd --create-home {user}" in runs[-1]
    words = [word for word, _ in order]
    last_run = len(words) - words[::-1].index("RUN")
    assert last_run <= words.index("USER") < words.index("CMD")
    ignored = (root / ".dockerignore").read_text().split()
    assert {".git", "**/__pycache__", ".venv*"} <= set(ignored)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The workspace as the RUN instructions from the build on leave it."""
    root, place = Path(__file__).parents[1], tmp_path_factory.mktemp("fdi_ws")
    (place / "src").mkdir()
    (place / "src" / "fdi_ros").symlink_to(root)
    for command in (rest for word, rest in steps(root) if word == "RUN"):
        if "apt-get" in command or "useradd" in command:
            continue
        here = command if Path("/opt/ros/jazzy").exists() else command.replace(SOURCED, "")
        here = with_compiled(here.replace("colcon build", f"{colcon()} build"), root)
        done = subprocess.run(here, shell=True, cwd=place, capture_output=True, text=True, timeout=600, check=False)
        assert done.returncode == 0, (here, done.stdout, done.stderr)
    yield place
    shutil.rmtree(place, ignore_errors=True)


def colcon() -> str:
    return shutil.which("colcon") or f"{Path(sys.executable).parent}/colcon"


def with_compiled(command: str, root: Path) -> str:
    """Have the programs that were installed run the modules of the clone, where all is compiled: it takes minutes."""
    return re.sub(r"(\. install/local_setup\.(ba)?sh)", rf"\1 && export PYTHONPATH={root}:$PYTHONPATH", command)


def test_the_steps_build_it_and_a_user_runs_it_without_compiling(
    workspace: Path, root: Path, quiet_domain: None
) -> None:
    pytest.importorskip("rclpy", reason="the node needs ROS 2")
    if os.geteuid() != 0 or not shutil.which("setpriv"):
        pytest.skip("only root can start it as another user")
    (command,) = [json.loads(rest) for word, rest in steps(root) if word == "CMD"]
    command[-1] = with_compiled(command[-1].replace("/config.yaml", str(root / "config" / "two_imus.yaml")), root)
    home = workspace / "home"
    home.mkdir()
    for path in (home, workspace):
        os.chown(path, USER if path == home else 0, -1)
    # Where the tests run may be closed to others; reading is all that this user may do there.
    caps = [
        "--inh-caps",
        "-all,+dac_read_search",
        "--ambient-caps",
        "+dac_read_search",
        "--bounding-set",
        "-all,+dac_read_search",
    ]
    become = ["setpriv", "--reuid", str(USER), "--regid", str(USER), "--clear-groups", *caps]
    env = {**os.environ, "HOME": str(home), "ROS_LOG_DIR": str(home / "log"), "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
    node = subprocess.Popen(
        [*become, *command], cwd=workspace, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    said = []
    assert node.stdout is not None
    try:
        for line in node.stdout:
            said.append(line)
            if " monitoring " in line:
                assert os.stat(f"/proc/{node.pid}").st_uid == USER
                break
    finally:
        node.send_signal(signal.SIGTERM)
        said.append(node.communicate(timeout=120)[0])
    assert node.returncode == 0, said
    assert any(" monitoring " in line for line in said), said
    assert "compil" not in "".join(said)
    assert (home / ".cache" / "fdi_ros").is_dir()
