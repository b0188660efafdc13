# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The package as a ROS workspace and the Dockerfile build it: installed where ros2 run and ros2 launch look."""

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from test_layers import ROS, imports

import fdi_ros
from fdi_ros.compiling.cache import folder
from fdi_ros.system import BAGS

pytest.importorskip(
    "colcon_ros", reason="colcon is not installed: pip install -e '.[test]'"
)


pytestmark = pytest.mark.usefixtures("compiled")

NO_CACHE = shutil.ignore_patterns("__pycache__")
SOURCED = ". /opt/ros/jazzy/setup.sh && "
USER = 54321
INIT = ["tini", "--", "/ros_entrypoint.sh"]
"""Of the entry of the image."""


def steps(root):
    """Instructions of the Dockerfile and what they are given."""
    text = re.sub(
        r"\\\n\s*",
        "",
        re.sub(r"^#.*\n", "", (root / "Dockerfile").read_text(), flags=re.MULTILINE),
    )
    return [
        (word, rest)
        for word, _, rest in (line.partition(" ") for line in text.splitlines())
        if word
    ]


def run(command, folder, **options):
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
        **options,
    )
    assert done.returncode == 0, (command, done.stdout, done.stderr)
    return done


def colcon():
    return shutil.which("colcon") or f"{Path(sys.executable).parent}/colcon"


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """The workspace as the RUN instructions of the Dockerfile leave it, from the build on; no image is built."""
    root, place = Path(__file__).parents[1], tmp_path_factory.mktemp("fdi_ws")
    (place / "src").mkdir()
    (place / "src" / "fdi_ros").symlink_to(root)
    # The build finds what the clone has compiled, as it would find its own former results.
    shutil.copytree(folder().parent, place / "kept" / "fdi_ros")
    found = {**os.environ, "NUMBA_CACHE_DIR": str(place / "kept")}
    for command in (rest for word, rest in steps(root) if word == "RUN"):
        if "apt-get" in command or "useradd" in command:
            continue
        here = (
            command if Path("/opt/ros/jazzy").exists() else command.replace(SOURCED, "")
        )
        here = here.replace("colcon build", f"{colcon()} build")
        run(here, place, shell=True, env=found)
    yield place
    shutil.rmtree(place, ignore_errors=True)


@pytest.fixture(scope="module")
def install(workspace):
    """Install space of the package."""
    return workspace / "install" / "fdi_ros"


def test_every_executable_has_something_to_run_and_all_settings_are_installed(
    root, install
):
    names = {
        path.name
        for path in (install / "lib" / "fdi_ros").iterdir()
        if os.access(path, os.X_OK)
    }
    assert {"fdi", "fdi_node"} <= names
    (entry_points,) = install.glob(
        "lib/python*/site-packages/fdi_ros*/entry_points.txt"
    )
    targets = re.findall(r"= (fdi_ros\.[\w.]+):(\w+)", entry_points.read_text())
    assert targets
    for module, function in targets:
        source = (
            next(install.glob("lib/python*/site-packages"))
            / f"{module.replace('.', '/')}.py"
        )
        assert source.is_file()
        assert callable(getattr(importlib.import_module(module), function))
    share = install / "share"
    assert (share / "ament_index/resource_index/packages/fdi_ros").exists()
    assert (share / "fdi_ros/package.xml").exists()
    for kind, pattern in (("config", "*.yaml"), ("launch", "*.launch.py")):
        sources = {
            path.relative_to(root / kind) for path in (root / kind).rglob(pattern)
        }
        installed = share / "fdi_ros" / kind
        assert sources <= {
            path.relative_to(installed) for path in installed.rglob(pattern)
        }


def test_the_installed_command_runs_and_finds_its_files_without_a_clone(
    install, tmp_path
):
    setup, fdi = (
        install.parent / "local_setup.bash",
        install / "lib" / "fdi_ros" / "fdi",
    )
    script = f". {setup} && {fdi} shipped two_imus.yaml && exec {fdi} geometry config/two_imus.yaml"
    done = run(["bash", "-c", script], tmp_path)
    shipped = install / "share" / "fdi_ros" / "config" / "two_imus.yaml"
    assert done.stdout.startswith(f"{shipped}\n6 channels")
    assert done.stderr == (
        f"fdi: there is no config/two_imus.yaml here: taking the shipped {shipped}\n"
    )


REFUSES = """
from fdi_ros.compiling.notice import refused
from fdi_ros.monitor.receiver import warm_path

with refused("it compiles"):
    warm_path()
"""
COMPILES = """
from fdi_ros.cli.settings import warm_detector, warm_path, warm_verbs
from fdi_ros.compiling import cache, compiled

warm_path()
warm_detector("sequential")
warm_verbs()
print(cache.PACKAGE, compiled.compilations(), len(compiled.missing()))
"""


@pytest.fixture
def moved(install, tmp_path):
    """The installed modules at another path, with other times, beside an empty home."""
    (installed,) = install.glob("lib/python*/site-packages/fdi_ros")
    place = tmp_path / "elsewhere" / "fdi_ros"
    shutil.copytree(installed, place, ignore=NO_CACHE)
    for path in place.rglob("*"):
        os.utime(path, (1_000_000_000, 1_000_000_000))
    (tmp_path / "home").mkdir()
    return place


def first_start(moved, script, **environment):
    """Run a script with these modules, for the first time on a machine."""
    environment = {
        **{name: v for name, v in os.environ.items() if not name.startswith("NUMBA_")},
        "HOME": str(moved.parents[1] / "home"),
        "PYTHONPATH": str(moved.parent),
        **environment,
    }
    return subprocess.run(
        [sys.executable, "-B", "-c", script],
        cwd=moved.parents[1],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def test_what_is_built_compiles_nothing_at_any_path(moved):
    nothing = (f"{moved} 0 0\n", "")
    done = first_start(moved, COMPILES)
    assert (done.stdout, done.stderr) == nothing
    # Where no file can be made among the modules, which others can write, too.
    shutil.rmtree(moved / "__pycache__")
    (moved / "__pycache__").write_text("")
    for path in (moved, *moved.rglob("*")):
        path.chmod(path.stat().st_mode | 0o020)
    done = first_start(moved, COMPILES)
    assert (done.stdout, done.stderr) == nothing


@pytest.mark.parametrize("what", ["other sources", "other target", "open files"])
def test_compiled_code_that_does_not_fit_or_may_be_a_strangers_is_not_taken(
    moved, what
):
    environment = {}
    if what == "other sources":
        source = moved / "core" / "records.py"
        source.write_text(source.read_text() + "\n# changed\n")
    if what == "other target":
        environment["NUMBA_CPU_NAME"] = "generic"
    if what == "open files":
        for path in (moved / "prebuilt").rglob("*.nb?"):
            path.chmod(0o666)
    done = first_start(moved, REFUSES, **environment)
    assert done.stderr.endswith("FdiError: it compiles\n"), done.stderr
    assert ("others can write it" in done.stderr) == (what == "open files")


def test_one_version_everywhere_and_a_changelog_that_bloom_reads(root):
    """REP-132; what is not released yet stands under Forthcoming, which the release replaces by version and date."""
    manifest = ElementTree.parse(root / "package.xml").getroot()
    assert manifest.findtext("version") == fdi_ros.__version__
    assert f'version="{fdi_ros.__version__}"' in (root / "setup.py").read_text()
    catkin = pytest.importorskip("catkin_pkg.changelog")
    released = f"{fdi_ros.__version__} (2000-01-01)\n{'-' * 30}"
    text, changelog = (root / "CHANGELOG.rst").read_text(), catkin.Changelog("fdi_ros")
    catkin.populate_changelog_from_rst(
        changelog, re.sub(r"^Forthcoming\n-+$", released, text, flags=re.M)
    )
    assert changelog.get_content_of_version(fdi_ros.__version__)


def test_every_source_file_has_copyright_and_licence(root):
    assert (
        run([sys.executable, "tools/license_headers.py", "--check"], root).stdout == ""
    )


def test_the_manifest_names_every_ros_package_in_use(root):
    manifest = ElementTree.parse(root / "package.xml").getroot()
    named = {str(element.text) for element in manifest.iter("exec_depend")}
    used = {
        name.partition(".")[0]
        for folder in ("fdi_ros", "launch")
        for path in (root / folder).rglob("*.py")
        for name in imports(path)
    } & ROS
    assert used <= named


def test_the_image_has_what_reads_recordings_and_runs_under_an_init_as_a_user(root):
    order = steps(root)
    runs, words = (
        [rest for word, rest in order if word == "RUN"],
        [word for word, _ in order if word != "ENV"],
    )
    assert "rosdep install --rosdistro jazzy --from-paths src" in runs[0]
    # By pip what no distribution of ROS has.
    assert {"tini", "pymavlink", "pyserial", *BAGS} <= set(runs[1].split())
    assert words[-4:] == ["RUN", "USER", "ENTRYPOINT", "CMD"]
    assert json.loads(dict(order)["ENTRYPOINT"])[: len(INIT)] == INIT
    assert {".git", "**/__pycache__", ".venv*"} <= set(
        (root / ".dockerignore").read_text().split()
    )


def test_the_steps_build_it_and_a_user_runs_it_without_compiling(
    workspace, root, quiet_domain
):
    pytest.importorskip("rclpy", reason="the node needs ROS 2")
    if os.geteuid() != 0 or not shutil.which("setpriv"):
        pytest.skip("only root can start it as another user")
    entry, given = (
        json.loads(rest) for word, rest in steps(root) if word in ("ENTRYPOINT", "CMD")
    )
    assert given[-1] == "/config.yaml"
    # Of the image: its init, and the ROS in it.
    start = entry[len(INIT) :]
    command = [*start, *given[:-1], "config/two_imus.yaml"]
    home = workspace / "home"
    home.mkdir()
    os.chown(home, USER, -1)
    os.chown(workspace, 0, -1)
    # Where the tests run may be closed to others; reading is all that this user may do there.
    only = "-all,+dac_read_search"
    become = ["setpriv", "--reuid", str(USER), "--regid", str(USER), "--clear-groups"]
    become += [
        "--inh-caps",
        only,
        "--ambient-caps",
        "+dac_read_search",
        "--bounding-set",
        only,
    ]
    env = {
        **os.environ,
        "HOME": str(home),
        "ROS_LOG_DIR": str(home / "log"),
        "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4",
    }
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    said = []
    with subprocess.Popen([*become, *command], cwd=workspace, env=env, **pipes) as node:
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
