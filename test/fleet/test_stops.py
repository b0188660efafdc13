# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Runs that stop anywhere, and go on: nothing is lost, nothing counts twice."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra: fleet)")

import pyarrow.parquet as parquet
from bag.recordings import flight, write_bag, write_config, write_mcap
from fleet.runs import run, table

from fdi_ros.errors import BagError
from fdi_ros.fleet import dataset
from fdi_ros.fleet.dataset import Dataset
from fdi_ros.fleet.flights import TABLES, Flight, FlightEvent, Judged

Stop = Callable[[pytest.MonkeyPatch], None]


class Stopped(BaseException):
    """Stands for SIGKILL: nothing is cleaned up after it."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two flights, one of them with a fault, and the tables of a run that was not stopped."""
    root = tmp_path_factory.mktemp("fleet")
    (root / "kite").mkdir()
    messages = flight(600)[0]
    write_mcap(root / "kite" / "a.mcap", messages[:600] + [one for one in messages[600:] if one[0] == messages[0][0]])
    write_mcap(root / "kite" / "b.mcap", flight(600, seed=1)[0])
    write_config(root / "config.yaml")
    (root / "study.yaml").write_text("faults: ['kind=bias size=0.3']\ntimes: 1\nwithin: 1\n")
    judge(root, root / "whole")
    assert min(sizes(root / "whole").values()) > 0
    return root


def judge(fleet: Path, out: Path, *more: object) -> None:
    run(out, fleet / "kite", "--config", fleet / "config.yaml", "--inject", fleet / "study.yaml", "--quiet", *more)


def sizes(out: Path) -> dict[str, int]:
    return {name: parquet.read_metadata(out / f"{name}.parquet").num_rows for name in TABLES}


def tables(out: Path) -> list[bytes]:
    return [(out / f"{name}.parquet").read_bytes() for name in TABLES]


def before(name: str, wanted: Callable[[Any], bool], owner: Any = dataset) -> Stop:
    """Stop before a function that the dataset calls does what is wanted."""

    def patch(monkeypatch: pytest.MonkeyPatch) -> None:
        real = getattr(owner, name)

        def stop(*given: Any, **named: Any) -> Any:
            if wanted(given[0]):
                raise Stopped
            return real(*given, **named)

        monkeypatch.setattr(owner, name, stop)

    return patch


STOPS = {
    "before it is known whose folder it is": before("write_text", lambda path: path.name == "fleet.json"),
    "within a part": before("_save", lambda table: "named_after" in table.column_names),
    "between two tables": before("whole_file", lambda path: path.name == "events.parquet"),
    "before the last table": before("whole_file", lambda path: path.name == "flights.parquet"),
    "before parts are taken away": before("rename", lambda path: path.name == "parts", Path),
    "while they are": before("rmtree", lambda path: path.name.startswith(".parts."), shutil),
}


@pytest.mark.parametrize("stop", STOPS.values(), ids=STOPS.keys())
def test_a_run_stopped_anywhere_goes_on(fleet: Path, tmp_path: Path, stop: Stop) -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        stop(monkeypatch)
        with pytest.raises(Stopped):
            judge(fleet, tmp_path / "o")
    judge(fleet, tmp_path / "o")
    assert tables(tmp_path / "o") == tables(fleet / "whole")


def test_a_table_that_was_taken_away_is_made_again(fleet: Path, tmp_path: Path) -> None:
    shutil.copytree(fleet / "whole", tmp_path / "o")
    (tmp_path / "o" / "events.parquet").unlink()
    judge(fleet, tmp_path / "o")
    assert tables(tmp_path / "o") == tables(fleet / "whole")


def test_recordings_that_are_not_given_again_stay_in_the_tables(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a path is given in another form."""
    shutil.copytree(fleet / "whole", tmp_path / "o")
    monkeypatch.chdir(fleet / "kite")
    run(tmp_path / "o", "a.mcap", "--config", "../config.yaml", "--inject", "../study.yaml")
    said = capsys.readouterr().out
    assert said.startswith("1 flight of 1 vehicle")
    assert "The tables have 1 more, of other runs: not among these recordings, not counted here." in said
    assert tables(tmp_path / "o") == tables(fleet / "whole")


def test_a_row_without_an_error_counts_whatever_came_later(tmp_path: Path) -> None:
    """Of two parts that name one flight; and of each flight the events beside the row that counts."""
    out = Dataset(tmp_path, {})
    event = FlightEvent("k", "/a", "/", 1.0, 1, "g1", "OK", "SUSPECT", False, ("g1",), "disagrees", 0.1)
    for error in ("there was no disk", "", "there was no disk again"):
        out.add(Judged(Flight(flight="k", path="/a", error=error), events=() if error else (event,)))
        out.flush()
    assert out.done().keys() == {"k"}
    assert out.finish({"k"}) == 0
    assert [row["error"] for row in out.read("flights", {"k"})] == [""]
    assert len(out.read("events", {"k"})) == 1
    # One that has changed takes the place of its former self.
    out.add(Judged(Flight(flight="l", path="/a")))
    assert out.finish({"l"}) == 0
    assert out.read("flights", {"k"}) == out.read("events", {"k"}) == []
    out.close()


def test_a_path_has_one_row_and_rows_of_other_runs_outlive_a_lost_table(tmp_path: Path) -> None:
    out = Dataset(tmp_path, {})
    for key, path in (("a1", "/a"), ("b1", "/b")):
        out.add(Judged(Flight(flight=key, path=path)))
    assert out.finish({"a1", "b1"}) == 0
    # Changed, and stopped before the end; then another run that is not given it.
    out.add(Judged(Flight(flight="a2", path="/a")))
    out.flush()
    assert out.finish({"b1"}) == 1
    assert {row["flight"] for row in out.read("flights", {"a1", "a2", "b1"})} == {"a2", "b1"}
    (tmp_path / "faults.parquet").unlink()
    assert out.done() == {}
    out.add(Judged(Flight(flight="b1", path="/b")))
    assert out.finish({"b1"}) == 1
    assert {row["flight"] for row in out.read("flights", {"a2", "b1"})} == {"a2", "b1"}
    out.close()


def test_other_settings_leave_all_as_it_was_until_a_flight_is_judged(fleet: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(fleet / "whole", tmp_path / "o"))
    other = Dataset(out, {"other": 1}, force=True)
    assert other.done() == {}
    other.write("configs/of_a_vehicle.yaml", "text")
    other.close()
    assert not (out / "configs").exists()
    judge(fleet, out)
    assert tables(out) == tables(fleet / "whole")
    (out / "configs").mkdir()
    (out / "configs" / "of_before.yaml").touch()
    other = Dataset(out, {"other": 1}, force=True)
    other.write("configs/of_a_vehicle.yaml", "text")
    other.add(Judged(Flight(flight="k", path="/a")))
    assert other.finish({"k"}) == 0
    other.close()
    assert (out / "configs" / "of_a_vehicle.yaml").read_text() == "text"
    names = {str(path.relative_to(out)) for path in out.rglob("*")}
    assert names == {"fleet.json", ".lock", "configs", "configs/of_a_vehicle.yaml"} | {f"{t}.parquet" for t in TABLES}
    assert sizes(out) == {"flights": 1, "events": 0, "faults": 0, "episodes": 0}


def test_what_cannot_be_written_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = Dataset(tmp_path, {})
    out.add(Judged(Flight(flight="k", path="/a")))
    with monkeypatch.context() as full:
        full.setattr(dataset, "whole_folder", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        with pytest.raises(BagError, match="No space left on device; what was judged before is kept"):
            out.flush()
    out.flush()
    assert out.done().keys() == {"k"}
    out.close()


def test_the_key_of_a_bag_is_of_its_own_files(tmp_path: Path) -> None:
    """The output may lie in the folder of a bag."""
    write_bag(tmp_path / "b", flight(10)[0])
    out = Dataset(tmp_path / "b" / "o", {})
    key = out.key_of(tmp_path / "b")
    out.add(Judged(Flight(flight="k", path="/a")))
    out.flush()
    assert out.key_of(tmp_path / "b") == key
    next((tmp_path / "b").glob("*.mcap")).touch()
    assert out.key_of(tmp_path / "b") != key
    out.close()


def test_names_that_are_no_unicode_cost_nothing(fleet: Path, tmp_path: Path) -> None:
    for number in (b"\xff", b"\xfe"):
        (tmp_path / "kite").mkdir(exist_ok=True)
        broken = tmp_path / "kite" / (b"broken" + number + b".mcap").decode("utf-8", "surrogateescape")
        broken.write_bytes(b"")
    shutil.copy(fleet / "kite" / "b.mcap", tmp_path / "kite")
    shutil.copy(fleet / "config.yaml", tmp_path)
    shutil.copy(fleet / "study.yaml", tmp_path)
    out = tmp_path / b"o\xff".decode("utf-8", "surrogateescape")
    judge(tmp_path, out, "--calibrate", "first")
    rows = table(out)
    assert [bool(row["error"]) for row in rows] == [False, True, True]
    assert len({row["path"] for row in rows}) == 3


def test_where_nothing_could_be_judged_that_is_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a.mcap").write_bytes(b"")
    run(tmp_path / "o", tmp_path, code=2)
    said = capsys.readouterr()
    assert "Nothing was judged." in said.out
    assert f"none of the 1 recordings could be judged: {tmp_path / 'o' / 'fleet.html'} says why" in said.err
    assert (tmp_path / "o" / "flights.parquet").exists()


def test_a_signal_is_answered_in_words(fleet: Path, tmp_path: Path) -> None:
    words = ["--config", str(fleet / "config.yaml"), "--output", str(tmp_path / "o"), "--workers", "1", "--quiet"]
    command = [sys.executable, "-m", "fdi_ros.cli", "fleet", str(fleet / "kite"), *words]
    # As plain Python it takes so long that it cannot be done before the signal comes.
    slow = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    started = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=slow)
    # The folder is there before anything is judged.
    while not (tmp_path / "o" / "parts").exists() and started.poll() is None:
        time.sleep(0.001)
    started.send_signal(signal.SIGTERM)
    said = started.communicate(timeout=60)[1]
    assert (started.returncode, said) == (
        130,
        "fdi: stopped; what was judged is kept, the same command goes on from there\n",
    )
