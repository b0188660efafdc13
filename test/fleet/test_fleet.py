# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Many recordings: found, judged, kept through stops and full disks, read back by other programs."""

from __future__ import annotations

import json
import resource
import shutil
import signal
import struct
import subprocess
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra: fleet)")

import pyarrow.parquet as parquet
from bag import logs
from bag.recordings import PARAMETERS, TOPICS, flight, write_bag, write_config, write_mcap
from fleet.runs import run, table

from fdi_ros.config.config import Config
from fdi_ros.errors import BagError, FaultError
from fdi_ros.fleet.dataset import Dataset
from fdi_ros.fleet.findings import Fleet, Rate
from fdi_ros.fleet.flights import TABLES, Recordings, find_recordings, schema_of, vehicle_of
from fdi_ros.fleet.judging import Settings, Vehicle, judge, load_injection
from fdi_ros.fleet.report import replay_command


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two vehicles: four flights, one with a fault, and one file that is no recording."""
    root = tmp_path_factory.mktemp("fleet")
    for vehicle in ("heron", "kite"):
        (root / vehicle).mkdir()
    write_mcap(root / "heron" / "a.mcap", flight(700)[0])
    write_bag(root / "heron" / "b", flight(700, seed=1)[0])
    write_mcap(root / "kite" / "c.mcap", flight(700, seed=2)[0])
    sound = (root / "kite" / "c.mcap").read_bytes()
    (root / "kite" / "d.mcap").write_bytes(sound[: len(sound) // 2])
    (root / "kite" / "e.mcap").write_bytes(b"no recording at all")
    (root / "kite" / "notes.md").write_text("not a recording either")
    write_config(root / "config.yaml")
    return root


@pytest.fixture(scope="module")
def judged(fleet: Path) -> Path:
    """The dataset of all of them, with faults injected."""
    (fleet / "study.yaml").write_text("faults: ['kind=bias size=0.3']\ntimes: 1\nwithin: 1\n")
    words = (fleet / "kite", "--config", fleet / "config.yaml", "--inject", fleet / "study.yaml")
    return run(fleet / "out", fleet / "heron", *words)


def test_recordings_are_found_in_folders_patterns_and_lists(fleet: Path, tmp_path: Path) -> None:
    found = find_recordings([str(fleet)]).paths
    assert [path.name for path in found] == ["a.mcap", "b", "c.mcap", "d.mcap", "e.mcap"]
    assert [vehicle_of(path) for path in found] == [
        str(fleet / name) for name in ("heron", "heron", "kite", "kite", "kite")
    ]
    assert find_recordings([f"{fleet}/*/[ab]*", str(fleet / "heron" / "a.mcap")]).paths == found[:2]
    (fleet / "some.txt").write_text("# two\nheron/b\nkite/*.mcap # and all of these\n")
    assert find_recordings([str(fleet / "some.txt")]).paths == found[1:]
    (fleet / "some.txt").write_text("# one that was moved\nheron/b\nheron/z\n")
    with pytest.raises(BagError, match=r"some.txt, line 3: there is no .*heron/z"):
        find_recordings([str(fleet / "some.txt")])
    with pytest.raises(BagError, match=r"there is no .*nowhere"):
        find_recordings([str(tmp_path / "nowhere")])
    with pytest.raises(BagError, match="no recording in"):
        find_recordings([str(tmp_path)])


def test_a_recording_is_one_by_whatever_name_it_is_found(fleet: Path, tmp_path: Path) -> None:
    """A pattern that meets the files of a bag, a hard link, both given; and what is no recording at all."""
    shutil.copytree(fleet / "heron", tmp_path / "heron")
    (tmp_path / "heron" / "hard.mcap").hardlink_to(tmp_path / "heron" / "a.mcap")
    (tmp_path / "heron" / "firmware.bin").write_bytes(b"\x7fELF")
    (tmp_path / "heron" / "notes.md").touch()
    both = tuple(tmp_path / "heron" / name for name in ("a.mcap", "b"))
    assert find_recordings([f"{tmp_path}/**"]).paths == both
    assert find_recordings([f"{tmp_path}/**/*.mcap"]).paths == both
    inside = next((tmp_path / "heron" / "b").glob("*.mcap"))
    assert find_recordings([str(tmp_path / "heron" / "b"), str(inside)]).paths == both[1:]
    found = find_recordings([str(tmp_path)])
    assert found == Recordings(both, (f"{tmp_path / 'heron' / 'firmware.bin'} is no flight log",))
    (tmp_path / "other.txt").write_text("\ufeffheron/a.mcap\n")
    assert find_recordings([str(tmp_path / "other.txt")]).paths == both[:1]
    (tmp_path / "list.txt").write_text("other.txt\n")
    with pytest.raises(BagError, match=r"line 1: other.txt is a list itself"):
        find_recordings([str(tmp_path / "list.txt")])


def test_recordings_behind_links_and_beside_other_metadata_are_found(
    fleet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links in circles, a foreign metadata.yaml, a log in the folder of a bag, a folder that may not be read."""
    inside = tmp_path / "of_another_program"
    (inside / "below").mkdir(parents=True)
    (inside / "metadata.yaml").write_text("author: me\n")
    (inside / "below" / "a_link").symlink_to(fleet / "heron")
    (inside / "below" / "back").symlink_to(inside)
    shutil.copytree(fleet / "heron" / "b", inside / "bag")
    (inside / "bag" / "FLIGHT.BIN").touch()
    (inside / "bag" / "of_the_same_day").mkdir()
    (inside / "bag" / "of_the_same_day" / "f.mcap").touch()
    (inside / "lost").mkdir()
    shutil.copy(fleet / "heron" / "b" / "metadata.yaml", inside / "lost")
    (inside / "secret").mkdir()

    def children(folder: Path, listed: Callable[[Path], Iterator[Path]] = Path.iterdir) -> Iterator[Path]:
        if folder.name == "secret":
            raise PermissionError(13, "Permission denied")
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", children)
    found = find_recordings([str(tmp_path)])
    names = ["bag", "bag/FLIGHT.BIN", "bag/of_the_same_day/f.mcap"]
    names += ["below/a_link/a.mcap", "below/a_link/b", "lost"]
    assert [str(path.relative_to(inside)) for path in found.paths] == names
    assert found.unread == (f"cannot read {inside / 'secret'}: Permission denied",)


def test_other_programs_read_the_tables(judged: Path) -> None:
    pandas, duckdb = pytest.importorskip("pandas"), pytest.importorskip("duckdb")
    flights = pandas.read_parquet(judged / "flights.parquet")
    assert flights.error.map(bool).tolist() == [False, False, False, False, True]
    assert flights.damage.map(bool).tolist() == [False, False, False, True, False]
    assert flights.samples[:3].tolist() == [700, 700, 700]
    assert flights.samples[3] < 700
    names, rest = (
        duckdb.sql(f"SELECT {what} FROM '{judged}/flights.parquet' WHERE error = ''").fetchall()
        for what in ("channels[6]", "list_avg(noise_rest)")
    )
    assert set(names) == {("imu_2.z",)}
    # The simulated noise is 0.002 rad/s.
    assert np.allclose(np.array(rest), 0.002, rtol=0.2)
    faults = pandas.read_parquet(judged / "faults.parquet")
    assert faults.groupby("flight").size().tolist() == [6] * 4
    assert set(faults.outcome) == {"named"}
    for name, row in TABLES.items():
        schema, made = parquet.read_schema(judged / f"{name}.parquet"), schema_of(name)
        assert [str(one.type).replace("element", "item") for one in schema] == [str(one.type) for one in made]
        assert schema.metadata[b"columns"] == b"2"
        assert [(one.name, one.metadata) for one in schema] == [(one.name, one.metadata) for one in made]
        assert schema.names == [one.name for one in fields(row)]
        assert all(one.metadata[b"meaning"] for one in schema)
    page = (judged / "fleet.html").read_text()
    assert "<h2>Not judged</h2>" in page
    assert "e.mcap" in page


def test_what_is_there_is_not_judged_again(fleet: Path, judged: Path, tmp_path: Path) -> None:
    """A run in two steps gives the same bytes; what has changed is judged again; other settings are not mixed in."""
    given = (fleet / "heron", "--config", fleet / "config.yaml", "--quiet")
    first = Dataset(tmp_path / "o", {"config": (fleet / "config.yaml").read_text(), "calibrate": "none", "inject": ""})
    settings = Settings((fleet / "config.yaml").read_text())
    vehicle = Vehicle(settings.parameters, str(fleet / "config.yaml"), "")
    path = fleet / "heron" / "a.mcap"
    # Marked: judging it again would take the mark away.
    made = judge(first.key_of(path), path, settings, vehicle)
    object.__setattr__(made.flight, "note", "of the first step")
    with first:
        first.add(made)
    # What a killed run leaves of a part.
    left = tmp_path / "o" / "parts" / ".1-2-3.0123abcd" / "1-2-3"
    left.mkdir(parents=True)
    (left / "flights.parquet").write_bytes(b"half")
    with pytest.raises(BagError, match="another fdi fleet writes"):
        Dataset(tmp_path / "o", {})
    first.close()
    rows = table(run(tmp_path / "o", *given))
    assert [row["note"] for row in rows] == ["of the first step", ""]
    assert not (tmp_path / "o" / "parts").exists()
    assert table(run(tmp_path / "o", *given)) == rows
    path.touch()
    assert [row["note"] for row in table(run(tmp_path / "o", *given))] == ["", ""]
    with pytest.raises(BagError, match="holds a run with other settings"):
        Dataset(tmp_path / "o", {"config": "other"})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years")
    with pytest.raises(BagError, match="holds no run of fdi fleet"):
        Dataset(tmp_path / "mine", {}, force=True)
    with pytest.raises(BagError, match=r"cannot write to .*thesis.tex: Not a directory$"):
        Dataset(tmp_path / "mine" / "thesis.tex", {})


def test_what_a_person_should_look_at(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A unit that falls silent, a recording that is mended, and one that is not among the recordings any more."""
    for name in ("dies", "broken"):
        (tmp_path / name).mkdir()
    messages = flight(900)[0]
    rest = [message for message in messages[900:] if message[0] == TOPICS[0]]
    write_mcap(tmp_path / "dies" / "a.mcap", [*messages[:900], *rest])
    (tmp_path / "broken" / "b.mcap").write_bytes(b"")
    words = ("--config", fleet / "config.yaml")
    run(tmp_path / "o", tmp_path / "dies", tmp_path / "broken", *words)
    said = capsys.readouterr().out
    assert "imu_2.x, imu_2.y, imu_2.z STALE (gives no data)" in said, said.splitlines()
    assert "Not judged, 1 recording: is empty: b.mcap." in said
    write_mcap(tmp_path / "broken" / "b.mcap", messages)
    run(tmp_path / "o", tmp_path / "broken", *words)
    said = capsys.readouterr().out
    assert "No flight needs to be looked at." in said
    run(tmp_path / "o", tmp_path / "broken", *words, "--force", "--json", tmp_path / "o" / "fleet.json", code=2)
    assert "it lies in" in capsys.readouterr().err


def test_a_full_disk_is_one_line_and_loses_nothing(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, words = tmp_path / "o", (fleet / "kite", "--config", fleet / "config.yaml")
    before, handler = resource.getrlimit(resource.RLIMIT_FSIZE), signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    # As much as the description of the run takes, and less than a table.
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        run(out, *words, code=2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"fdi: cannot write {out}/")
    assert "goes on from there" in said
    run(out, *words, "--quiet", "--json", tmp_path / "all.json")
    figures = json.loads((tmp_path / "all.json").read_text())
    assert (figures["flights"], figures["failed"], len(figures["to_look_at"])) == (3, 1, 1)
    assert [len(one["paths"]) for one in figures["not_judged"]] == [1]
    assert len(table(out)) == 3


def test_a_vehicle_is_calibrated_on_the_first_recording_that_allows_it(root: Path, tmp_path: Path) -> None:
    """Two vehicles whose folders have one name stay two; of one the first recording cannot be read."""
    for drone in ("drone_1", "drone_2"):
        (tmp_path / drone / "logs").mkdir(parents=True)
    (tmp_path / "drone_1" / "logs" / "a.mcap").write_bytes(b"no recording")
    shutil.copytree(root / "bags" / "cone_flight", tmp_path / "drone_1" / "logs" / "b")
    (tmp_path / "drone_2" / "logs" / "c.mcap").write_bytes(b"no recording")
    given = (tmp_path, "--config", root / "config" / "two_imus.yaml", "--calibrate", "first")
    rows = table(run(tmp_path / "o", *given))
    assert [row["calibration"].partition(":")[0] for row in rows] == ["on b", "on b", "refused on c.mcap"]
    assert len({row["vehicle"] for row in rows}) == 2
    assert "made by fdi calibrate from b" in Path(rows[1]["config"]).read_text()
    assert rows[2]["config"] == str(root / "config" / "two_imus.yaml")
    # What is added is judged as the others were, by whatever name; another vehicle among them is not judged.
    shutil.copytree(root / "bags" / "cone_flight", tmp_path / "drone_1" / "logs" / "a_new")
    write_mcap(tmp_path / "drone_1" / "logs" / "other.mcap", flight(700, rate=50.0)[0])
    names = {Path(row["path"]).name: row for row in table(run(tmp_path / "o", *given))}
    assert names["a_new"]["config"] == names["b"]["config"]
    assert "the vehicle is calibrated on b at 100 Hz, and this has 50 Hz: another" in names["other.mcap"]["error"]


def test_settings_that_do_not_fit_are_doubted(fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = write_config(tmp_path / "other.yaml", {**PARAMETERS, "sample_rate": 3 * PARAMETERS["sample_rate"]})
    run(tmp_path / "o", fleet / "heron" / "a.mcap", "--config", other)
    assert "a.mcap: sample_rate is 300 Hz in the config, the recording has 100 Hz" in capsys.readouterr().out


def test_the_command_to_see_a_flight_is_one_that_a_shell_takes() -> None:
    path = "/logs/o'neil's \n \x1b[1m \\ été.mcap"
    row = {"error": "", "path": path, "config": "of it.yaml"}
    command = replay_command(row)
    assert command.isprintable()
    done = subprocess.run(
        ["bash", "-c", command.replace("fdi", "printf '%s|'", 1)],
        env={"LC_ALL": "C.UTF-8"},
        capture_output=True,
        check=True,
    )
    assert done.stdout.decode().split("|")[:4] == ["replay", path, "--config", "of it.yaml"]


def test_what_could_not_be_calibrated_is_judged_again_when_its_vehicle_is(root: Path, tmp_path: Path) -> None:
    """The result is that of a run over all at once; also where the sample rate in the config is not the true one."""
    text = (root / "config" / "two_imus.yaml").read_text()
    assert "sample_rate: 100.0" in text
    (tmp_path / "config.yaml").write_text(text.replace("sample_rate: 100.0", "sample_rate: 130.0"))
    (tmp_path / "kite").mkdir()
    write_mcap(tmp_path / "kite" / "a.mcap", flight(300)[0])

    def judged(out: str) -> list[dict[str, Any]]:
        words = ("--config", tmp_path / "config.yaml", "--calibrate", "first")
        return table(run(tmp_path / out, tmp_path / "kite", *words))

    assert judged("o")[0]["calibration"].startswith("refused on a.mcap: ")
    shutil.copytree(root / "bags" / "cone_flight", tmp_path / "kite" / "b")
    apart = [{**row, "config": ""} for row in judged("o")]
    assert [row["calibration"] for row in apart] == ["on b", "on b"]
    assert apart == [{**row, "config": ""} for row in judged("at_once")]
    # What is damaged in the choice that is kept is made anew, and nothing else.
    kept = tmp_path / "o" / "configs" / "vehicles.json"
    choice = json.loads(kept.read_text())
    for damaged in (json.dumps({**choice, "/other": [None, 5]}), "[" * 10**5):
        kept.write_text(damaged)
        (tmp_path / "kite" / "a.mcap").touch()
        assert [row["calibration"] for row in judged("o")] == ["on b", "on b"]
        assert choice.items() <= json.loads(kept.read_text()).items()


def test_a_config_is_not_taken_away_with_the_run_that_it_is_of(
    fleet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (row,) = table(run(tmp_path / "o", fleet / "heron" / "a.mcap"))
    assert row["error"] == ""
    assert Config.from_file(row["config"]).topics == ("/imu_1/data_raw", "/imu_2/data_raw"), "the recording's own"
    own = Path(shutil.copy(fleet / "config.yaml", tmp_path / "o" / "mine.yaml"))
    run(tmp_path / "o", fleet / "heron" / "a.mcap", "--config", own, "--force", code=2)
    assert f"{own} lies in {tmp_path / 'o'}, which --force begins anew: copy it elsewhere" in capsys.readouterr().err
    assert own.exists()


def test_rates_and_units_are_those_of_the_rows(judged: Path) -> None:
    flights, events = table(judged), table(judged, "events")
    # Of no event in an hour 3.689 an hour cannot be excluded at 97.5 % (Garwood 1936).
    assert Rate(0, 1.0).interval == pytest.approx((0.0, 3.6889), abs=1e-4)
    assert Rate(10, 2.0).interval == pytest.approx((10 * 0.47954 / 2, 18.3904 / 2), rel=1e-4)
    whole = Fleet(flights, events=events)
    assert (len(whole.flights), whole.failed, len(whole.names)) == (5, 1, 2)
    alone = sum(event["after"] == "FAULTY" for event in events)
    sets = {(event["flight"], event["stamp"], *event["group"]) for event in events if event["after"] == "AMBIGUOUS"}
    assert whole.declarations.count == alone + len(sets)
    assert [(line.vehicle, line.name, line.flights) for line in whole.units] == [
        (whole_path, unit, 2)
        for whole_path in sorted({row["vehicle"] for row in flights})
        for unit in ("imu_1", "imu_2")
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("faults: bias", "faults is no list"),
        ("times: 0", "times is 0, expected 1 to 1000"),
        ("seed: true", "seed is True"),
        ("kinds: []", "unknown key 'kinds'"),
        ("[]", "expected keys and values"),
        ("faults: ['kind=bias size=0.1 start=3']", "start is chosen by the sweep"),
    ],
)
def test_a_wrong_study_of_faults_is_refused(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "study.yaml").write_text(text)
    with pytest.raises(FaultError, match=words):
        load_injection(tmp_path / "study.yaml")


def slow_fleet(folder: Path) -> None:
    """Logs of two vehicles with dates over months, one of them with a fault; one without dates; and slow ones."""
    for name, count, dated in (("kite", 4, True), ("heron", 11, False), ("slow", 5, True)):
        (folder / name).mkdir(parents=True)
        for k in range(count):
            made = logs.units(3, seconds=20.0, rate=8.0 + k if name == "slow" else 50.0, seed=k)
            if (name, k) == ("kite", 2):
                made[1].rate[600:, 1] += 0.3
            path = folder / name / f"log {k + 1}.bin"
            week = struct.pack("<H", logs.WEEK + 4 * k)
            data = logs.write_dataflash(path, made, gps=dated).read_bytes()
            path.write_bytes(data.replace(struct.pack("<IH", logs.MS, logs.WEEK), struct.pack("<I", logs.MS) + week))


def test_a_fleet_of_logs_says_when_what_happened_and_what_could_not_be_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    slow_fleet(tmp_path / "logs")
    run(tmp_path / "o", tmp_path / "logs", "--json", tmp_path / "all.json")
    said, figures = capsys.readouterr().out, json.loads((tmp_path / "all.json").read_text())
    (slow,) = figures["not_judged"]
    assert len(slow["paths"]) == 5
    assert "Not judged, 5 recordings: has IMU of 3 IMUs at 8 Hz; needed: each IMU by itself at 20 Hz" in said
    assert "LOG_BITMASK bit 18, Fast IMU" in said
    (told,) = figures["episodes"]
    assert (told["channels"], told["axes"], told["state"]) == (["imu_1.y"], ["y"], "FAULTY")
    # In FRD it was +0.3 rad/s.
    assert told["size"] == pytest.approx(-0.3, abs=0.02)
    assert 12.0 <= told["start"] < 12.5
    assert told["date"].startswith("2022-05-04T23:59:5")
    assert "kite/log 3.bin: imu_1.y FAULTY from 12." in said
    rows = {row["path"].rpartition("logs/")[2]: row for row in table(tmp_path / "o")}
    assert [rows[f"kite/log {k}.bin"]["date"][:10] for k in (1, 2)] == ["2022-03-09", "2022-04-06"]
    assert {row["date"] for path, row in rows.items() if path.startswith("heron")} == {""}
    page = (tmp_path / "o" / "fleet.html").read_text()
    assert "1970" not in page.partition("<script")[0]
    data = json.loads(page.partition('<script id="data" type="application/json">')[2].partition("</script>")[0])
    axes = [figure["layout"]["xaxis"] for figure in data["figures"] if not figure["layout"]["xaxis"].get("hidden")]
    assert {"date, UTC", "flight, in the order of file names"} < {axis["title"]["text"] for axis in axes}
    (names,) = (axis["names"] for axis in axes if "names" in axis)
    assert names == [f"log {k}.bin" for k in range(1, 12)]
    marks = [
        mark["label"] for figure in data["figures"] for mark in figure["layout"].get("marks", ()) if "label" in mark
    ]
    assert marks == ["imu_1.y FAULTY"]


def test_differences_are_those_of_the_units_over_the_flight(tmp_path: Path) -> None:
    """Of three parallel units: each less the mean of the other two."""
    made = logs.units(3, seconds=40.0, rate=50.0)
    made[1].rate[1000:, 1] += 0.02
    path = logs.write_dataflash(tmp_path / "a.bin", made)
    row = judge("k", path, Settings(""), Vehicle("", "", "")).flight
    assert row.axes == ("x", "y", "z") * 3
    course = np.array(row.difference_course).reshape(9, -1)
    z = np.stack([unit.rate * [1, -1, -1] for unit in made])
    expected = (z - (z.sum(axis=0) - z) / 2)[:, 1:, :]
    assert course.shape[1] == 120
    half = course.shape[1] // 2
    for k in range(9):
        values = expected[k // 3, :, k % 3]
        assert row.difference[k] == pytest.approx(values.mean(), abs=2e-5)
        assert row.difference_std[k] == pytest.approx(values.std(), rel=0.02)
        for part, own in ((course[k, : half - 1], values[:980]), (course[k, half + 1 :], values[1020:])):
            assert part.mean() == pytest.approx(own.mean(), abs=2e-4)


def test_memory_does_not_grow_with_the_length_of_a_flight(tmp_path: Path) -> None:
    def peak(minutes: float) -> int:
        path = logs.write_dataflash(tmp_path / f"{minutes}.bin", logs.units(3, seconds=60 * minutes, rate=400.0))
        settings = Settings((tmp_path / "config.yaml").read_text())
        tracemalloc.start()
        row = judge("k", path, settings, Vehicle(settings.parameters, "", "")).flight
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert row.error == ""
        assert row.samples == round(minutes * 60 * 400)
        return most

    imus = {"topics": [f"/imu_{k}" for k in range(3)], "mounts": 3 * np.eye(3).ravel().tolist()}
    config = {"input": "imus", "sample_rate": 400.0, "imus": imus, "noise": {"noise_std": [0.003]}}
    write_config(tmp_path / "config.yaml", config)
    short = peak(4.0)
    # The values of nine channels for that time alone would be twice as much.
    # Of 9 minutes not all intervals are kept.
    assert peak(9.0) < short + 5 * 60 * 400 * 9 * 8 / 2
