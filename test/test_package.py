# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The package as a ROS workspace sees it: found, built and installed where ros2 run and ros2 launch look."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from test_layers import ROS, imports

import fdi_ros

pytest.importorskip("colcon_ros", reason="colcon is not installed: pip install -e '.[test]'")


NO_CACHE = shutil.ignore_patterns("__pycache__")


def colcon(root: Path, workspace: Path, *words: str) -> str:
    run = "import sys; from colcon_core.command import main; sys.exit(main())"
    command = [sys.executable, "-c", run, "--log-base", str(workspace / "log"), *words]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def install(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Install space of the package built by colcon."""
    workspace = tmp_path_factory.mktemp("workspace")
    colcon(
        Path(__file__).parents[1],
        workspace,
        "build",
        "--base-paths",
        ".",
        "--build-base",
        str(workspace / "build"),
        "--install-base",
        str(workspace / "install"),
    )
    return workspace / "install" / "fdi_ros"


def test_colcon_sees_an_ament_python_package(root: Path, tmp_path: Path) -> None:
    listed = colcon(root, tmp_path, "list", "--base-paths", ".").split("\n")[0]
    assert listed.split() == ["fdi_ros", ".", "(ros.ament_python)"]


def test_ros2_run_finds_the_executables(install: Path) -> None:
    names = {path.name for path in (install / "lib" / "fdi_ros").iterdir() if os.access(path, os.X_OK)}
    assert {"fdi", "fdi_node"} <= names


def test_every_executable_has_something_to_run(install: Path) -> None:
    (entry_points,) = install.glob("lib/python*/site-packages/fdi_ros*/entry_points.txt")
    targets = re.findall(r"= (fdi_ros\.[\w.]+):(\w+)", entry_points.read_text())
    assert targets
    for module, function in targets:
        source = next(install.glob("lib/python*/site-packages")) / f"{module.replace('.', '/')}.py"
        defined = {node.name for node in ast.parse(source.read_text()).body if isinstance(node, ast.FunctionDef)}
        assert function in defined


def test_the_index_the_manifest_and_all_settings_are_installed(root: Path, install: Path) -> None:
    share = install / "share"
    assert (share / "ament_index/resource_index/packages/fdi_ros").exists()
    assert (share / "fdi_ros/package.xml").exists()
    for folder, pattern in (("config", "*.yaml"), ("launch", "*.launch.py")):
        sources = {path.relative_to(root / folder) for path in (root / folder).rglob(pattern)}
        installed = share / "fdi_ros" / folder
        assert sources <= {path.relative_to(installed) for path in installed.rglob(pattern)}


def test_the_installed_command_runs_and_finds_its_files_without_a_clone(install: Path, tmp_path: Path) -> None:
    setup, fdi = install.parent / "local_setup.bash", install / "lib" / "fdi_ros" / "fdi"
    script = f". {setup} && {fdi} shipped two_imus.yaml && exec {fdi} geometry config/two_imus.yaml"
    command = ["bash", "-c", script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
    shipped = install / "share" / "fdi_ros" / "config" / "two_imus.yaml"
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{shipped}\n6 channels")
    assert done.stderr == f"fdi: no config/two_imus.yaml here, taking {shipped}\n"


def test_an_editable_install_is_imported_beside_a_clone_of_its_name(root: Path, tmp_path: Path) -> None:
    """The clone's folder has the package's name: a folder on the path must not come before the install."""
    clone = tmp_path / "fdi_ros"
    clone.mkdir()
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "resource", "fdi_ros", "launch", "config"):
        copy = shutil.copytree if (root / name).is_dir() else shutil.copy
        copy(root / name, clone / name, **({"ignore": NO_CACHE} if copy is shutil.copytree else {}))
    # Without the network that the isolation of a build needs.
    words = ["install", "-qq", "--no-deps", "--no-build-isolation", "--disable-pip-version-check", "--prefix", tmp_path]
    command = [sys.executable, "-m", "pip", *map(str, words), "--ignore-installed", "--editable", str(clone)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    (site,) = tmp_path.glob("lib/python3*/site-packages")
    # Only this install, and the folder that the clone lies in.
    code = f"import site; site.addsitedir({str(site)!r}); import fdi_ros; print(fdi_ros.__version__, fdi_ros.__file__)"
    told = subprocess.run(
        [sys.executable, "-S", "-E", "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert told.stderr == ""
    assert told.stdout.split() == [fdi_ros.__version__, str(clone / "fdi_ros" / "__init__.py")]


def test_one_version_everywhere(root: Path) -> None:
    manifest = ElementTree.parse(root / "package.xml").getroot()
    assert manifest.findtext("version") == fdi_ros.__version__
    assert f'version="{fdi_ros.__version__}"' in (root / "setup.py").read_text()


def test_the_changelog_is_one_that_bloom_reads(root: Path) -> None:
    """REP-132; what is not released yet stands under Forthcoming, which the release replaces by version and date."""
    catkin = pytest.importorskip("catkin_pkg.changelog")
    text = (root / "CHANGELOG.rst").read_text()
    released = f"{fdi_ros.__version__} (2000-01-01)"
    changelog = catkin.Changelog("fdi_ros")
    catkin.populate_changelog_from_rst(
        changelog, re.sub(r"^Forthcoming\n-+$", f"{released}\n{'-' * 30}", text, flags=re.M)
    )
    assert changelog.get_content_of_version(fdi_ros.__version__)


def test_every_source_file_has_copyright_and_licence(root: Path) -> None:
    command = [sys.executable, str(root / "tools" / "license_headers.py"), "--check"]
    lacking = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert lacking.stdout == ""


def test_the_manifest_names_every_ros_package_in_use(root: Path) -> None:
    manifest = ElementTree.parse(root / "package.xml").getroot()
    named = {str(element.text) for element in manifest.iter("exec_depend")}
    used = {
        name.partition(".")[0]
        for folder in ("fdi_ros", "launch")
        for path in (root / folder).rglob("*.py")
        for name in imports(ast.parse(path.read_text()))
    } & ROS
    assert used <= named


def test_make_help_lists_every_target(root: Path) -> None:
    said = subprocess.run(["make", "-s", "help"], cwd=root, capture_output=True, text=True, timeout=60, check=True)
    (targets,) = re.findall(r"^\.PHONY: (.*)$", (root / "Makefile").read_text(), flags=re.MULTILINE)
    listed = [re.fullmatch(r"make (\w+) +\S.*", line) for line in said.stdout.splitlines()]
    assert sorted(match[1] for match in listed if match) == sorted(targets.split())
