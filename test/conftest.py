# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What all tests share: the ROS environment, hypothesis without deadlines, the recording and the bundled bag."""

import fcntl
import gc
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).parents[1]
#: Files whose tests mostly wait for processes that they start, the longest first.
WAITING = (
    "test_own_node.py",
    "test_bench.py",
    "test_mavlink.py",
    "test_node.py",
    "test_readme.py",
    "test_montecarlo.py",
    "test_watch.py",
    "test_package.py",
    "test_storm.py",
    "test_accelerometer_array.py",
)
#: processes that run the tests side by side
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
RECORDING = ROOT.parent / "shared" / "data" / "mimu_exp1"


class Said(NamedTuple):
    """How a command ended and what it said."""

    code: int
    out: str
    err: str


def take_domain():
    """Take a ROS domain that no other run of the tests on this machine has, until the lock is closed."""
    # Domains above 101 collide with the ports that Linux gives to other programs.
    for k in range(100):
        domain = str(1 + (os.getpid() + k) % 100)
        lock = (
            Path(tempfile.gettempdir()) / f"fdi_ros_domain_{domain}_{os.getuid()}.lock"
        ).open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        return domain, lock
    raise RuntimeError(
        "all of the ROS domains 1 to 100 are in use by other runs of the tests"
    )


# Before the first import of NumPy. The matrices are small: more threads wait for each other, and for other tests.
for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

# Before the first import of rclpy.
os.environ["ROS_DOMAIN_ID"], DOMAIN_LOCK = take_domain()
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
os.environ["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="fdi_ros_log_")

# The same examples in every run: a failure of the suite is one that the next run shows again.
settings.register_profile(
    "suite",
    deadline=None,
    derandomize=True,
    max_examples=50,
    # A deadline by another name: the first examples may take no longer than 30 s.
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("suite")


def pytest_unconfigure():
    """Leave no logs behind."""
    shutil.rmtree(os.environ["ROS_LOG_DIR"], ignore_errors=True)


def pytest_collectstart():
    """Collect no garbage while tests are collected: all that is made then stays until the end."""
    gc.disable()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """Let each process collect the tests from another folder on.

    In a fresh clone, and after a change, what one process has compiled the others then find.
    Side by side all of them would compile the same files at the same time.
    """
    report = yield
    if WORKERS > 1 and collector.path == ROOT / "test":
        sizes = [
            sum(file.stat().st_size for file in (one.path, *one.path.rglob("*.py")))
            for one in report.result
        ]
        worker = int(os.environ["PYTEST_XDIST_WORKER"].removeprefix("gw"))
        first, before = 0, 0
        while first < len(sizes) and before < sum(sizes) * worker / WORKERS:
            before += sizes[first]
            first += 1
        report.result = report.result[first:] + report.result[:first]
    return report


def pytest_collection_modifyitems(items):
    """Begin with the tests that wait, in every second process: the others compute meanwhile.

    The scheduler gives each process an equal share of consecutive tests, and moves tests
    from the end of a share to a process that has done its own.
    """
    if WORKERS > 1:
        # All processes must have one order, and each has collected in its own.
        items.sort(key=lambda item: item.path)
    waiters = (WORKERS + 1) // 2
    waiting = [[] for _ in range(waiters)]
    others = []
    for item in items:
        name = item.path.name
        if name in WAITING:
            waiting[WAITING.index(name) % waiters].append(item)
        else:
            others.append(item)
    for part in waiting:
        part.sort(key=lambda item: WAITING.index(item.path.name))
    left = len(items)
    items.clear()
    for worker in range(WORKERS):
        share = left // (WORKERS - worker)
        left -= share
        begin = waiting[worker // 2] if worker % 2 == 0 else []
        count = max(0, share - len(begin))
        items += begin + others[:count]
        del others[:count]
    items += others


def pytest_collection_finish():
    """Let the garbage collector pass over modules and tests, which stay until the end."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture
def quiet_domain(monkeypatch):
    """Give the processes that a test starts a ROS domain in which nobody else speaks."""
    domain, lock = take_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    yield
    lock.close()


@pytest.fixture(scope="session")
def compiled(tmp_path_factory):
    """All compiled code is there: no process that a test starts has to wait for it, or says that it compiles."""
    # Once in all the processes of a run: they share the folder above their own.
    shared = tmp_path_factory.getbasetemp()
    done = (
        shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared
    ) / "compiled"
    with done.open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.stat().st_size:
            # With this module come all functions that may be missing.
            from fdi_ros.cli.settings import missing

            if missing():
                subprocess.run(
                    [sys.executable, "-m", "fdi_ros.cli", "compile"],
                    cwd=ROOT,
                    stdout=subprocess.DEVNULL,
                    check=True,
                )
            lock.write("done")


@pytest.fixture(scope="session")
def root():
    """Folder of the package's sources."""
    return ROOT


@pytest.fixture(scope="session")
def recording():
    """Rosbag2 folder of three real IMUs."""
    if not RECORDING.exists():
        pytest.skip(f"the recording of three real IMUs is not here: {RECORDING}")
    return RECORDING


@pytest.fixture(scope="session")
def flight():
    """Rosbag2 folder of the bundled simulated flight."""
    return ROOT / "bags" / "cone_flight"


@pytest.fixture
def fdi(capsys, monkeypatch):
    """Run a command of `fdi` in this process, which says nothing of its progress."""
    from fdi_ros.cli import outputs
    from fdi_ros.cli.command_line import main

    # On a busy machine there would be lines of it.
    monkeypatch.setattr(outputs, "SAID_EVERY", 3600.0)

    def run(*words):
        return Said(main([str(word) for word in words]), *capsys.readouterr())

    return run


@pytest.fixture
def refused(fdi):
    """Run a command of `fdi` that is refused: the one line that it says."""

    def run(*words):
        code, out, err = fdi(*words)
        assert (code, out) == (2, "")
        assert err.startswith("fdi: ")
        assert err.count("\n") == 1
        return err

    return run
