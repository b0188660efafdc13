# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Metadata, dependencies and installed files; one tree for pip and for colcon (ament_python)."""

import os
import shlex
import subprocess
import sys
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup
from setuptools.command.build_py import build_py

NAME = "fdi_ros"
# The wheels exist for this platform alone; elsewhere ROS 2 Jazzy comes from its own packages.
ROS_WHEELS = 'platform_system == "Linux" and platform_machine == "x86_64"'

SHIP = f"""
import sys
from pathlib import Path
from {NAME}.cli.command_line import main
from {NAME}.compiling.cache import ship

status = main(["compile"])
if status == 0:
    ship(Path(sys.argv[1]))
sys.exit(status)
"""


class BuildCompiled(build_py):
    """Copy the modules, and compile them as C++ packages are, so that no start of a program has to.

    Without Numba and the other libraries that this needs, the package is built without compiled code, and compiles at
    its first start. So does an editable installation.
    """

    def run(self):
        """Build."""
        super().run()
        if self.editable_mode:
            return
        # Results are kept from one build to the next: only what changed is compiled.
        kept = Path(self.get_finalized_command("build").build_temp) / "compiled"
        command = [sys.executable, "-c", SHIP, NAME]
        environment = {"NUMBA_CACHE_DIR": str(kept.absolute()), **os.environ}
        # There the copy hides any other fdi_ros.
        done = subprocess.run(command, cwd=self.build_lib, env=environment, check=False)
        if done.returncode != 0:
            self.warn(f"built without compiled code: {shlex.join(command[:2])} failed")

    def get_outputs(self, include_bytecode=True):
        """Name all files that the build has made."""
        shipped = Path(self.build_lib, NAME, "prebuilt").rglob("*.nb?")
        return [*super().get_outputs(include_bytecode), *map(str, shipped)]


setup(
    name=NAME,
    version="0.4.0",
    cmdclass={"build_py": BuildCompiled},
    description="Online gyro fault detection and isolation for ROS 2",
    author="fdi_ros maintainers",
    maintainer="fdi_ros maintainers",
    maintainer_email="fdi-ros@example.org",
    license="Apache-2.0",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    # Said for --editable: it then puts this folder on the path. The finder it would install instead comes after the
    # path, where a folder of the clone's name, beside a script or in the working directory, hides the package.
    package_dir={"": "."},
    package_data={f"{NAME}.report": ["*.html", "*.css", "*.js"]},
    python_requires=">=3.10",
    install_requires=[
        "numpy>=1.26",
        "numba>=0.58,<0.69",
        "mcap>=1.2",
        "rosbags>=0.11",
        "lz4>=4.0",
        "zstandard>=0.20",
        "PyYAML>=6.0",
        "tqdm>=4.60",
        "joblib>=1.3",
    ],
    extras_require={
        "ros": [
            f"ros-jazzy-rclpy[fastrtps]==7.1.6; {ROS_WHEELS}",
            f"ros-jazzy-common-interfaces==5.3.6; {ROS_WHEELS}",
        ],
        "watch": ["rich>=13.0"],
        "calibrate": ["scipy>=1.11"],
        "completion": ["shtab>=1.6"],
        "fleet": ["pyarrow>=14", "scipy>=1.11"],
        "logs": ["pyulog>=1.3", "pymavlink>=2.4.40"],
        "mavlink": ["pymavlink>=2.4.40", "pyserial>=3.5"],
        "cluster": ["dask>=2024.1", "distributed>=2024.1"],
        "docs": [
            "sphinx>=7.3",
            "furo>=2024.1",
            "myst-parser>=3.0",
            "sphinx-copybutton>=0.5",
        ],
        "notebook": ["pandas>=2.0", "matplotlib>=3.8", "ipykernel>=6.29"],
        "test": [
            "pytest>=8.0",
            "pytest-xdist>=3.5",
            "selenium>=4.20",
            "hypothesis>=6.100",
            "shtab>=1.6",
            "scipy>=1.11",
            "rich>=13.0",
            # They read flight logs, and pymavlink is compared with the reader of ArduPilot's.
            "pymavlink>=2.4.40",
            "pyulog>=1.3",
            "pyserial>=3.5",
            "pyarrow>=14",
            "pandas>=2.0",
            # What runs the example notebook as a reader would.
            "nbclient>=0.10",
            "ipykernel>=6.29",
            "matplotlib>=3.8",
            "duckdb>=1.0",
            # Pinned: a newer release may judge the same code differently.
            "ruff==0.17.5",
            "mypy==2.4.1",
            "types-tqdm",
            # What test_package.py needs to build the package, by pip and the way a ROS workspace does.
            "setuptools>=64",
            "wheel",
            "colcon-core>=0.18",
            "colcon-ros",
            "colcon-recursive-crawl",
            "colcon-package-selection",
            "colcon-library-path",
            "colcon-bash",
            "colcon-test-result",
            "colcon-package-information",
        ],
    },
    entry_points={
        "console_scripts": [
            "fdi = fdi_ros.cli.__main__:fdi",
            "fdi_node = fdi_ros.ros.process:fdi_node",
            "injector_node = fdi_ros.ros.process:injector_node",
            "mavlink_node = fdi_ros.ros.process:mavlink_node",
            "player_node = fdi_ros.ros.process:player_node",
        ],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", sorted(glob("launch/*.launch.py"))),
        (f"share/{NAME}/config", sorted(glob("config/*.*"))),
        (f"share/{NAME}/config/scenarios", sorted(glob("config/scenarios/*.yaml"))),
        (f"share/{NAME}/config/studies", sorted(glob("config/studies/*.yaml"))),
    ],
    zip_safe=False,
)
