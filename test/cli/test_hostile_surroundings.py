# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that are no files, names that a terminal obeys, signals at any moment, what killed runs leave."""

import fcntl
import os
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest

from fdi_ros.errors import FdiError
from fdi_ros.fleet.tables import Tables
from fdi_ros.mavlink.signing import read_key
from fdi_ros.system.files import (
    JUST_MADE,
    replacing,
    scratch_folder,
    write_json,
)

LIMIT = 60
"""s, within which none of these waits for anything."""


@pytest.fixture(autouse=True)
def in_time():
    """A wait for a pipe fails instead of lasting for ever."""

    def fail(*_):
        raise TimeoutError("it waits for what never comes")

    before = signal.signal(signal.SIGALRM, fail)
    signal.alarm(LIMIT)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.fixture
def config(root):
    return root / "config" / "two_imus.yaml"


@pytest.fixture(params=["pipe", "socket", "device"])
def no_file(request, tmp_path, monkeypatch):
    path = tmp_path / "other.yaml"
    if request.param == "device":
        path.symlink_to("/dev/zero")
    elif request.param == "pipe":
        os.mkfifo(path)
    else:
        with monkeypatch.context() as inside:
            # The name of a socket may not be long.
            inside.chdir(tmp_path)
            socket.socket(socket.AF_UNIX).bind(path.name)
    return path


@pytest.mark.parametrize(
    "words",
    [
        ["replay", "FLIGHT", "--config", "FILE"],
        ["replay", "FLIGHT", "--config", "CONFIG", "--scenario", "FILE"],
        ["sweep", "FLIGHT", "--config", "CONFIG", "--compare", "FILE"],
        ["fleet", "FLIGHT", "--config", "FILE", "--output", "OUT"],
        ["montecarlo", "FILE"],
        ["geometry", "FILE"],
    ],
)
def test_what_is_no_regular_file_is_never_read(
    words, no_file, flight, config, tmp_path, refused
):
    meant = {
        "FLIGHT": flight,
        "CONFIG": config,
        "FILE": no_file,
        "OUT": tmp_path / "out",
    }
    said = refused(*(meant.get(word, word) for word in words))
    assert "other.yaml: it is no regular file" in said
    assert not (tmp_path / "out").exists()


def test_metadata_keys_and_recordings_that_are_no_files(no_file, flight, tmp_path, fdi):
    bag = tmp_path / "bag"
    shutil.copytree(flight, bag)
    no_file.replace(bag / "metadata.yaml")
    done = fdi("inspect", bag)
    # The units of this flight are turned against each other.
    assert done.code == 4
    assert "metadata.yaml is damaged" in done.out
    with pytest.raises(FdiError, match="it is no regular file"):
        read_key(str(bag / "metadata.yaml"))
    for name in (
        "metadata.yaml",
        "a.mcap",
        "a.db3",
        "a.bin",
        "a.ulg",
        "a.tlog",
        "a.mcap.zstd",
    ):
        next(path for path in bag.iterdir() if not path.is_file()).rename(bag / name)
        assert fdi("inspect", bag / name).code == 2


def test_a_fleet_waits_for_no_pipe_and_one_given_up_leaves_nothing(
    flight, tmp_path, refused
):
    os.mkfifo(tmp_path / ".lock")
    os.mkfifo(tmp_path / "flights.parquet")
    assert "it is no regular file" in refused("fleet", flight, "--output", tmp_path)
    Tables(tmp_path / "out", {}).give_up()
    assert not (tmp_path / "out").exists()


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path):
    """But not what is young, of another result, or held by a run that goes on."""
    names = (
        ".a.json.01234567",
        ".a.json.89abcdef",
        ".b.json.01234567",
        ".a.json.fedcba98",
    )
    left, young, other, held = (tmp_path / name for name in names)
    for folder in (left, young, other, held):
        folder.mkdir()
        (folder / "a.json").write_text("half")
        if folder != young:
            os.utime(folder, (time.time() - 2 * JUST_MADE,) * 2)
    writer = os.open(held, os.O_RDONLY)
    fcntl.flock(writer, fcntl.LOCK_EX)
    write_json(tmp_path / "a.json", {"x": 1})
    os.close(writer)
    assert {path.name for path in tmp_path.iterdir()} == {
        "a.json",
        young.name,
        other.name,
        held.name,
    }


KILLED = """
import os, signal, sys
from pathlib import Path
from fdi_ros.system.files import replacing
with replacing(Path(sys.argv[1])) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_file_half_written_by_a_killed_process_goes_with_the_next(tmp_path):
    """As a state file is written; what another process writes at the moment stays."""
    state = tmp_path / "state.json"
    code = subprocess.run([sys.executable, "-c", KILLED, state], check=False).returncode
    assert code == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    os.utime(left, (time.time() - 2 * JUST_MADE,) * 2)
    with replacing(state) as file:
        # Another writer of the same file begins and ends meanwhile.
        with replacing(state) as other:
            other.write(b"other")
        file.write(b"whole")
    assert [path.name for path in tmp_path.iterdir()] == ["state.json"]
    assert state.read_bytes() == b"whole"


def test_a_full_disk_is_one_line_and_leaves_nothing(flight, config, tmp_path):
    """RLIMIT_FSIZE stands for it: the kernel refuses to write on in the same way."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    words = ["replay", flight, "--config", config, "--csv", tmp_path / "samples.csv"]
    words = [sys.executable, "-m", "fdi_ros.cli", *map(str, words), "--quiet"]
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        timeout=LIMIT,
        check=False,
        preexec_fn=limit,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert (
        done.stderr == f"fdi: cannot write {tmp_path / 'samples.csv'}: File too large\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_unpacked_files_of_a_killed_run_go_with_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    left = tmp_path / ".fdi_bag.0123abcd"
    left.mkdir()
    (left / "bag.mcap").write_bytes(bytes(1000))
    os.utime(left, (time.time() - 2 * JUST_MADE,) * 2)
    with scratch_folder("fdi_bag") as folder:
        assert [path.name for path in tmp_path.iterdir()] == [folder.name]
    assert list(tmp_path.iterdir()) == []


INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
for one in (signal.SIGTERM, signal.SIGHUP):
    signal.signal(one, signal.SIG_DFL)
from fdi_ros.cli.__main__ import fdi
class Importer:
    def find_spec(name, path, target=None):
        if name == moment:
            os.kill(os.getpid(), number)
moment, number = sys.argv.pop(), int(sys.argv.pop())
sys.meta_path.insert(0, Importer)
sys.exit(fdi())
"""


@pytest.mark.parametrize(
    ("moment", "number"),
    [
        ("fdi_ros.cli.command_line", signal.SIGTERM),
        ("argparse", signal.SIGINT),
        ("numpy", signal.SIGHUP),
        ("numba", signal.SIGTERM),
        ("fdi_ros.replay.run", signal.SIGINT),
    ],
)
def test_a_signal_while_it_is_loaded_is_no_traceback(moment, number, flight, config):
    words = [
        sys.executable,
        "-c",
        INTERRUPTED,
        "replay",
        flight,
        "--config",
        config,
        int(number),
        moment,
    ]
    done = subprocess.run(
        [*map(str, words)], capture_output=True, text=True, timeout=LIMIT, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
