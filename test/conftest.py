"""What all tests share: the ROS environment, hypothesis without deadlines, the recording and the bundled bag."""

import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).parents[1]
RECORDING = ROOT.parent / "shared" / "data" / "mimu_exp1"

# Before the first import of rclpy. Domains above 101 collide with the ports Linux gives to other programs.
os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="fdi_ros_log_")

# The same examples in every run: a failure of the suite is one that the next run shows again.
settings.register_profile("suite", deadline=None, derandomize=True)
settings.load_profile("suite")


@pytest.fixture
def root() -> Path:
    """Folder of the package's sources."""
    return ROOT


@pytest.fixture
def recording() -> Path:
    """Rosbag2 folder of three real IMUs."""
    if not RECORDING.exists():
        pytest.skip(f"the recording of three real IMUs is not here: {RECORDING}")
    return RECORDING


@pytest.fixture
def flight() -> Path:
    """Rosbag2 folder of the bundled simulated flight."""
    return ROOT / "bags" / "cone_flight"
