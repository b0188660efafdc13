# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files that are no files, names that a terminal obeys, signals at any moment, what killed runs leave."""

import fcntl
import os
import shutil
import signal
import socket
import subprocess
import sys
import time

import pyarrow as arrow
import pytest
from pyarrow import parquet

from fdi_ros.errors import FdiError
from fdi_ros.fleet.tables import Tables
from fdi_ros.mavlink.link import read_key
from fdi_ros.report.layout import Section, page
from fdi_ros.system.result_file import JUST_MADE, write_json

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
def no_file(request, tmp_path):
    path = tmp_path / "other.yaml"
    if request.param == "device":
        path.symlink_to("/dev/zero")
    elif request.param == "pipe":
        os.mkfifo(path)
    else:
        here = os.getcwd()
        os.chdir(tmp_path)
        try:
            # The name of a socket may not be long.
            socket.socket(socket.AF_UNIX).bind(path.name)
        finally:
            os.chdir(here)
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
def test_what_is_no_regular_file_is_never_read(words, no_file, flight, config, tmp_path, refused):
    meant = {"FLIGHT": flight, "CONFIG": config, "FILE": no_file, "OUT": tmp_path / "out"}
    said = refused(*(meant.get(word, word) for word in words))
    assert "other.yaml: it is no regular file" in said
    assert not (tmp_path / "out").exists()


def test_metadata_keys_and_recordings_that_are_no_files(no_file, flight, tmp_path, fdi):
    bag = tmp_path / "bag"
    shutil.copytree(flight, bag)
    (bag / "metadata.yaml").unlink()
    no_file.rename(bag / "metadata.yaml")
    done = fdi("inspect", bag)
    assert done.code == 0
    assert "metadata.yaml is damaged" in done.out
    with pytest.raises(FdiError, match="it is no regular file"):
        read_key(str(bag / "metadata.yaml"))
    for name in ("a.mcap", "a.db3", "a.bin", "a.ulg", "a.tlog", "a.mcap.zstd"):
        (bag / "metadata.yaml").rename(tmp_path / name)
        assert fdi("inspect", tmp_path / name).code == 2
        (tmp_path / name).rename(bag / "metadata.yaml")


def test_a_fleet_waits_for_no_pipe(flight, tmp_path, refused):
    os.mkfifo(tmp_path / ".lock")
    os.mkfifo(tmp_path / "flights.parquet")
    assert "it is no regular file" in refused("fleet", flight, "--output", tmp_path)


def test_a_fleet_that_is_refused_leaves_nothing(flight, tmp_path, refused):
    mine = tmp_path / "mine"
    mine.mkdir()
    parquet.write_table(arrow.table({"x": [1]}), mine / "flights.parquet")
    assert "is no table of fdi fleet" in refused("fleet", flight, "--output", mine, "--force")
    assert os.listdir(mine) == ["flights.parquet"]
    tables = Tables(tmp_path / "out", {})
    tables.give_up()
    assert not (tmp_path / "out").exists()


def test_what_a_killed_run_left_is_removed_by_the_next(tmp_path):
    left, young, other, held = (
        tmp_path / name for name in (".a.json.01234567", ".a.json.89abcdef", ".b.json.01234567", ".a.json.fedcba98")
    )
    for folder in (left, young, other, held):
        folder.mkdir()
        (folder / "a.json").write_text("half")
    for folder in (left, other, held):
        os.utime(folder, (time.time() - 2 * JUST_MADE,) * 2)
    writer = os.open(held, os.O_RDONLY)
    fcntl.flock(writer, fcntl.LOCK_EX)
    write_json(tmp_path / "a.json", {"x": 1})
    os.close(writer)
    assert {path.name for path in tmp_path.iterdir()} == {"a.json", young.name, other.name, held.name}


def test_a_killed_replay_leaves_no_more_than_the_next_removes(flight, config, tmp_path):
    words = [sys.executable, "-m", "fdi_ros.cli", "replay", str(flight), "--config", str(config), "--end", "1"]
    words += ["--csv", str(tmp_path / "s.csv")]
    slow = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=slow) as process:
        while not os.listdir(tmp_path):
            assert process.poll() is None
            time.sleep(0.001)
        process.kill()
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".s.csv.")
    os.utime(left, (time.time() - 2 * JUST_MADE,) * 2)
    done = subprocess.run(words, stdout=subprocess.DEVNULL, timeout=LIMIT, check=False)
    assert done.returncode == 4, "a second of a flight tells nothing"
    assert os.listdir(tmp_path) == ["s.csv"]


NAME = "a\x1b[2J\x07\u202egpj\u2066x"


def test_names_are_shown_and_not_obeyed(flight, config, tmp_path, fdi):
    bag, own, out = tmp_path / NAME, tmp_path / f"{NAME}.yaml", tmp_path / "out"
    shutil.copytree(flight, bag)
    shutil.copy(config, own)
    out.mkdir()
    some = ["--fault", "channel=imu_2.y kind=bias size=0.3 start=3", "--end", "6"]
    verbs = [
        ["inspect", bag],
        ["replay", bag, "--config", own, *some, "--report", out / "replay.html", "--csv", out / f"{NAME}.csv"],
        ["sweep", bag, "--config", own, "--times", "2", "--report", out / "sweep.html"],
        ["geometry", own],
        ["convert", bag, "--output", out / NAME],
        ["replay", bag / "nothing", "--config", own],
        ["replay", bag, "--config", tmp_path / f"{NAME}.txt"],
    ]
    with pytest.raises(SystemExit):
        fdi("replay", bag, "--config", own, NAME)
    for words in verbs:
        code, said, errors = fdi(*words)
        assert code == (2 if words[0] == "replay" and len(words) == 4 else 0), errors
        shown = [line for line in (said + errors).replace("\r", "\n").split("\n") if not line.isprintable()]
        assert not shown, words[0]
    pages = list(out.rglob("*.html"))
    assert len(pages) == 2
    for path in pages:
        text = path.read_text(encoding="utf-8")
        assert not {"\x1b", "\x07", "\u202e", "\u2066"} & set(text), path.name
        assert "\\u202egpj" in text, path.name


def test_texts_of_plots_are_shown_as_they_are():
    trace = {"type": "scatter", "x": [0.0], "y": [1.0], "name": NAME}
    text = page(NAME, [NAME], [Section(NAME, NAME, [NAME], [{"data": [trace], "layout": {"title": NAME}}])])
    # In a script, \\u202e would be that character again.
    assert "\\\\u202egpj" in text
    assert '"\\u202e' not in text.replace("\\\\u", "")
    assert not {"\x1b", "\u202e"} & set(text)


INTERRUPTED = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from fdi_ros.cli.__main__ import fdi
class Importer:
    def find_spec(name, path, target=None):
        if name == moment:
            os.kill(os.getpid(), signal.SIGINT)
moment = sys.argv.pop()
sys.meta_path.insert(0, Importer)
sys.exit(fdi())
"""


@pytest.mark.parametrize("moment", ["fdi_ros.cli.command_line", "argparse", "numpy", "numba", "fdi_ros.replay.run"])
def test_a_signal_while_it_is_loaded_is_no_traceback(moment, flight, config):
    words = [sys.executable, "-c", INTERRUPTED, "replay", flight, "--config", config, moment]
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=LIMIT, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
