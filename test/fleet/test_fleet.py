# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Many recordings: found, judged, kept through stops and full disks, read back by other programs."""

import json
import os
import re
import resource
import shutil
import signal
import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra: fleet)")

import pyarrow.parquet as parquet
from bag import logs
from bag.recordings import (
    START,
    STEP,
    TOPICS,
    flight,
    imu_messages,
    write_bag,
    write_config,
    write_mcap,
)

from fdi_ros.cli.command_line import main
from fdi_ros.config.config import Config
from fdi_ros.errors import BagError
from fdi_ros.fleet import judge, tables
from fdi_ros.fleet.judge import find_recordings
from fdi_ros.fleet.tables import Flight, Tables


class Stopped(BaseException):
    """Stands for SIGKILL: nothing is cleaned up after it."""


def run(out, *given, codes=(0, 3, 4)):
    """Judge what is given; return the folder of the tables."""
    assert (
        main(["fleet", *map(str, given), "--output", str(out), "--workers", "1"])
        in codes
    )
    return out


def rows(out, name="flights"):
    with (out / f"{name}.parquet").open("rb") as file:
        return parquet.read_table(file).to_pylist()


def both(out):
    return [(out / f"{name}.parquet").read_bytes() for name in ("flights", "episodes")]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Two vehicles: five flights, one with a fault and one cut off, and one file that is no recording."""
    root = tmp_path_factory.mktemp("fleet")
    for vehicle in ("heron", "kite"):
        (root / vehicle).mkdir()
    messages, z = flight(900)
    write_mcap(root / "heron" / "a.mcap", messages)
    write_bag(root / "heron" / "b", flight(700, seed=1)[0])
    z[500:, 4] += 0.5
    write_mcap(
        root / "kite" / "c.mcap",
        imu_messages(START + STEP * np.arange(900), z, apart=1000),
    )
    write_mcap(root / "kite" / "d.mcap", messages, chunk_size=1 << 12)
    whole = (root / "kite" / "d.mcap").read_bytes()
    (root / "kite" / "d.mcap").write_bytes(whole[: len(whole) * 9 // 10])
    (root / "kite" / "e.mcap").write_bytes(b"no recording at all")
    (root / "kite" / "notes.md").write_text("not a recording either")
    write_config(root / "config.yaml")
    return root


@pytest.fixture(scope="module")
def judged(fleet):
    """The folder of a run over all of them that was not stopped."""
    return run(
        fleet / "out",
        fleet / "heron",
        fleet / "kite",
        "--config",
        fleet / "config.yaml",
    )


# Which recordings -----------------------------------------------------------------------------------------------------


def test_recordings_are_found_each_once_by_whatever_name(fleet, tmp_path):
    """In folders, given twice, as a file of a bag, by a link; and what is no recording at all."""
    found, unread = find_recordings([str(fleet), str(fleet / "heron" / "a.mcap")])
    assert [path.name for path in found] == [
        "a.mcap",
        "b",
        "c.mcap",
        "d.mcap",
        "e.mcap",
    ]
    assert unread == []
    heron = Path(shutil.copytree(fleet / "heron", tmp_path / "heron"))
    (heron / "again.mcap").symlink_to(heron / "a.mcap")
    (heron / "firmware.bin").write_bytes(b"\x7fELF")
    two = [heron / "a.mcap", heron / "b"]
    assert find_recordings([str(tmp_path)]) == (
        two,
        [f"{heron / 'firmware.bin'} is no flight log"],
    )
    assert find_recordings([str(next((heron / "b").glob("*.mcap"))), str(two[1])]) == (
        two[1:],
        [],
    )
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("nowhere", r"there is no .*nowhere"),
        ("empty", "no recording in"),
    ):
        with pytest.raises(BagError, match=words):
            find_recordings([str(tmp_path / name)])


def test_tables_of_one_imu_each_may_be_of_different_flights(tmp_path):
    for name in ("flight_1.csv", "flight_2.csv"):
        columns = [f"gyro_{axis}" for axis in "xyz"]
        (tmp_path / name).write_text(",".join(["time", *columns]) + "\n")
    (tmp_path / "places.csv").write_text("time,lat,lon,height\n")
    found, _ = find_recordings([str(tmp_path)])
    assert [path.name for path in found] == ["flight_1.csv", "flight_2.csv"]


def test_recordings_behind_links_and_beside_other_metadata_are_found(
    fleet, tmp_path, monkeypatch
):
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
    listed = os.scandir

    def scan(folder):
        if str(folder).endswith("secret"):
            raise PermissionError(13, "Permission denied", folder)
        return listed(folder)

    monkeypatch.setattr(os, "scandir", scan)
    found, unread = find_recordings([str(tmp_path)])
    names = ["bag", "bag/FLIGHT.BIN", "bag/of_the_same_day/f.mcap"]
    names += ["below/a_link/a.mcap", "below/a_link/b", "lost"]
    assert [str(path.relative_to(inside)) for path in found] == names
    assert unread == [f"cannot read {inside / 'secret'}: Permission denied"]


# What is said of them -------------------------------------------------------------------------------------------------


def test_tables_say_what_became_of_each_flight_and_what_their_columns_mean(judged):
    flights = rows(judged)
    assert [bool(row["error"]) for row in flights] == [False, False, False, False, True]
    assert [bool(row["damage"]) for row in flights] == [
        False,
        False,
        False,
        True,
        False,
    ]
    # One declaration, by name.
    assert [(row["declared"], row["sets"]) for row in flights[:4]] == [
        (0, 0),
        (0, 0),
        (1, 0),
        (0, 0),
    ]
    # The simulated noise is 0.002 rad/s.
    assert np.allclose([np.mean(row["noise"]) for row in flights[:2]], 0.002, rtol=0.2)
    for name in ("flights", "episodes"):
        schema = parquet.read_schema(judged / f"{name}.parquet")
        assert schema.metadata[b"columns"] == b"5"
        assert all(one.metadata[b"meaning"] for one in schema)


def test_first_stands_what_needs_a_person(fleet, tmp_path, capsys):
    """A fault, what could not be read, what was hardly checked; not how recordings end when the power goes."""
    run(
        fleet / "again",
        fleet,
        "--config",
        fleet / "config.yaml",
        "--json",
        tmp_path / "all.json",
    )
    said = capsys.readouterr().out.splitlines()
    assert (
        said[0]
        == "LOOK AT 2 of 5 flights: 1 FAULTY, 1 not judged. The other 3 are HEALTHY."
    )
    assert said[1].startswith(
        "2 vehicles; 1 fault declared, in 1 flight; 0.01 hours judged"
    )
    assert said[2] == "1 recording could not be read whole: d.mcap."
    assert f"{fleet}/kite/c.mcap: FAULTY: imu_2.y from 5." in said[3]
    assert said[4].startswith(f"{fleet}/kite/e.mcap: could not be judged: ")
    figures = json.loads((tmp_path / "all.json").read_text())
    assert [one["path"][-6:] for one in figures["need_a_person"]] == [
        "c.mcap",
        "e.mcap",
    ]
    page = (fleet / "again" / "fleet.html").read_text()
    assert (
        page.index(">c.mcap<")
        < page.index(">e.mcap<")
        < page.index("<h2>All other flights (3)</h2>")
    )
    command = f"fdi replay {fleet}/kite/c.mcap --config {rows(fleet / 'again')[2]['config']} --report flight.html"
    assert command in page

    messages = flight(900)[0]
    for name, last in (("dies", 400), ("power_off", 860)):
        rest = [message for message in messages[2 * last :] if message[0] == TOPICS[0]]
        write_mcap(tmp_path / f"{name}.mcap", [*messages[: 2 * last], *rest])
    run(tmp_path / "o", tmp_path, "--config", fleet / "config.yaml")
    first, second = capsys.readouterr().out.splitlines()[:2]
    assert first == "LOOK AT 1 of 2 flights: 1 FAULTY. The other 1 is HEALTHY."
    assert "0 faults declared; in 1 flight a unit fell silent for good;" in second
    dies, _ = rows(tmp_path / "o")
    assert re.fullmatch(
        r"FAULTY: imu_2 gives no data from 4\.\d s\. Do not fly before imu_2 is checked or"
        r" replaced\.",
        dies["why"][0],
    )
    assert [one["state"] for one in rows(tmp_path / "o", "episodes")] == ["STALE"]


def test_a_file_that_is_passed_over_is_named_on_the_page_too(fleet, tmp_path, capsys):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "a.mcap").symlink_to(fleet / "heron" / "a.mcap")
    (tmp_path / "in" / "no_log.bin").write_bytes(b"\x7fELF")
    out = run(tmp_path / "out", tmp_path / "in", "--config", fleet / "config.yaml")
    note = f"Not searched: {tmp_path}/in/no_log.bin is no flight log."
    assert note in capsys.readouterr().out
    assert note in (out / "fleet.html").read_text()


def test_a_flight_is_said_to_be_what_its_replay_says_and_leads_to_its_page(
    fleet, tmp_path, fdi
):
    out = run(
        tmp_path / "o", fleet / "kite", "--config", fleet / "config.yaml", "--reports"
    )
    page = (out / "fleet.html").read_text()
    for row in rows(out)[:2]:
        told = tmp_path / "told.json"
        given = ("--config", fleet / "config.yaml", "--json", told, "--force")
        fdi("replay", row["path"], *given)
        verdict = json.loads(told.read_text())["verdict"]
        assert row["why"][:1] == (
            [] if verdict["word"] == "HEALTHY" else [verdict["words"]]
        )
        assert f'<a href="{row["report"]}">' in page
        assert Path(row["path"]).name in (out / row["report"]).read_text()
    assert rows(out)[2]["report"] == ""
    # Pages are written later, too, of what was judged before.
    (out / rows(out)[0]["report"]).unlink()
    run(out, fleet / "kite", "--config", fleet / "config.yaml", "--reports")
    assert (out / rows(out)[0]["report"]).is_file()


def test_a_vehicle_is_what_its_log_names_or_else_its_folder(root, tmp_path):
    shutil.copy(root / "bags" / "copter_crash.tlog", tmp_path / "one.tlog")
    board = "003A0029 3137510C 35333731"
    said = logs.records(
        logs.MESSAGES["MSG"], TimeUS=2_000_000, Message=f"CubeOrange {board}"
    )
    for name, extra in (("two.bin", said), ("three.bin", b"")):
        logs.write_dataflash(tmp_path / name, logs.units(), extra=extra)
    judged = rows(run(tmp_path / "o", tmp_path))
    found = {Path(row["path"]).name: row["vehicle"] for row in judged}
    assert found["two.bin"] == board
    assert found["three.bin"] == found["one.tlog"] == str(tmp_path)


def test_one_sensor_on_two_topics_needs_a_look(tmp_path):
    z = flight(900)[1]
    stamp, topics = START + STEP * np.arange(900), (*TOPICS, "/third")
    three = write_mcap(
        tmp_path / "three.mcap", imu_messages(stamp, np.hstack([z, z[:, :3]]), topics)
    )
    given = {"input": "imus", "sample_rate": 100.0, "imus.topics": list(topics)}
    for parameters in ("", json.dumps({"/**": {"ros__parameters": given}})):
        row = judge.judge(three, Flight(str(three), "", ""), parameters, False)[0]
        assert re.search(
            r"/third is left out: it gives the values of .*/imu_1/data_raw"
            r"|third repeats the values of imu_1_data_raw .*/imu_1/data_raw",
            " ".join(row.why),
        ), row
    two = write_mcap(
        tmp_path / "two.mcap", imu_messages(stamp, np.hstack([z[:, :3], z[:, :3]]))
    )
    row = judge.judge(two, Flight(str(two), "", ""), "", False)[0]
    assert (
        f"{TOPICS[1]}: it gives the values of {TOPICS[0]}: one sensor on two topics"
        in row.why[0]
    )


def test_units_mounted_otherwise_are_not_judged_without_a_config(root):
    path = root / "bags" / "cone_flight"
    row = judge.judge(path, Flight(str(path), "", ""), "", False)[0]
    assert row.error.startswith("imu_2 is turned by 109 deg against imu_1: give")
    assert "could not be judged" in row.why[0]


def test_without_a_config_that_of_inspect_is_taken_and_said(
    fleet, root, tmp_path, capsys
):
    """Calibrated on itself, or with the reason why not."""
    (row,) = rows(run(tmp_path / "o", fleet / "heron" / "a.mcap"))
    assert (row["error"], row["measured"]) == ("", False)
    assert Config.from_file(row["config"]).topics == TOPICS
    assert (
        "For 1 flight the mounts and axes are assumed, not measured"
        in capsys.readouterr().out
    )
    given = (
        fleet / "heron" / "a.mcap",
        root / "bags" / "cone_flight",
        "--config",
        root / "config" / "two_imus.yaml",
    )
    found = rows(run(tmp_path / "each", *given, "--calibrate", "each"))
    refused, calibrated = sorted(
        found, key=lambda row: row["calibration"] == "on itself"
    )
    assert calibrated["calibration"] == "on itself"
    assert (
        "made by fdi calibrate from cone_flight"
        in Path(calibrated["config"]).read_text()
    )
    assert refused["calibration"].startswith("refused: ")


def test_the_questions_of_the_docs_are_answered(root, tmp_path, monkeypatch):
    """Six flights, four weeks apart: of imu_1.y the bias grows by 0.01 rad/s each, one is noisy, one has a fault."""
    duckdb = pytest.importorskip("duckdb")
    (tmp_path / "logs").mkdir()
    for k in range(6):
        made = logs.units(3, seconds=20.0, rate=50.0, seed=k)
        made[1].rate[:, 1] += np.float32(0.01 * k)
        if k == 2:
            made[2].rate[600:, 0] += np.float32(0.5)
        if k == 4:
            made[0].rate[:, 2] += (
                np.random.default_rng(k).normal(0, 0.02, 1000).astype("f4")
            )
        data = logs.write_dataflash(tmp_path / "logs" / f"{k}.bin", made).read_bytes()
        week = struct.pack("<IH", logs.MS, logs.WEEK + 4 * k)
        (tmp_path / "logs" / f"{k}.bin").write_bytes(
            data.replace(struct.pack("<IH", logs.MS, logs.WEEK), week)
        )
    run(tmp_path / "fleet", tmp_path / "logs")
    assert rows(tmp_path / "fleet")[1]["date"].startswith("2022-04-06T23:59:")
    monkeypatch.chdir(tmp_path)
    found = re.findall(
        r"```sql\n(.*?)```", (root / "docs" / "fleet.md").read_text(), re.DOTALL
    )
    failing, drifting, noisy = (duckdb.sql(query).fetchall() for query in found)
    assert [(channel, flights) for _, channel, flights, _ in failing] == [
        ("imu_3.x", 1)
    ]
    assert failing[0][3] == pytest.approx(0.5, rel=0.1)
    assert drifting[0][1] == "imu_2.y"
    # The axes of dataflash are turned into those of the body of ROS.
    assert drifting[0][2:] == pytest.approx((-0.01 * 30 / 28, 1.0), rel=0.05)
    assert [(Path(path).name, channel) for path, channel, _ in noisy] == [
        ("4.bin", "imu_1.z")
    ]


def test_names_that_are_no_unicode_cost_nothing(fleet, tmp_path):
    (tmp_path / "kite").mkdir()
    for number in (b"\xff", b"\xfe"):
        (
            tmp_path
            / "kite"
            / (b"broken" + number + b".mcap").decode("utf-8", "surrogateescape")
        ).write_bytes(b"")
    shutil.copy(fleet / "heron" / "a.mcap", tmp_path / "kite")
    out = run(tmp_path / b"o\xff".decode("utf-8", "surrogateescape"), tmp_path / "kite")
    assert [bool(row["error"]) for row in rows(out)] == [False, True, True]


# Runs that stop, and go on --------------------------------------------------------------------------------------------


def test_what_is_there_is_not_judged_again(fleet, tmp_path, monkeypatch):
    """But for what has changed; and rows of recordings that are not given again stay."""
    shutil.copytree(fleet / "heron", tmp_path / "heron")
    given = (tmp_path / "heron", "--config", fleet / "config.yaml", "--quiet")
    run(tmp_path / "o", *given)
    before = both(tmp_path / "o")

    def none(*_, **__):
        raise AssertionError("judged again")

    with monkeypatch.context() as patched:
        patched.setattr(judge, "replay", none)
        run(tmp_path / "o", *given)
        assert both(tmp_path / "o") == before
        next((tmp_path / "heron" / "b").glob("*.mcap")).touch()
        run(tmp_path / "o", *given)
        assert ["judged again" in row["error"] for row in rows(tmp_path / "o")] == [
            False,
            True,
        ]
    # What could not be judged is tried again.
    run(tmp_path / "o", *given)
    assert [row["error"] for row in rows(tmp_path / "o")] == ["", ""]
    shutil.rmtree(tmp_path / "heron" / "b")
    run(tmp_path / "o", *given)
    assert len(rows(tmp_path / "o")) == 2


@pytest.mark.parametrize("name", ["episodes", "flights"])
def test_a_run_that_is_killed_anywhere_goes_on(fleet, judged, tmp_path, name):
    """Before a table is written the second time."""
    words = (
        fleet / "heron",
        fleet / "kite",
        "--config",
        fleet / "config.yaml",
        "--quiet",
    )
    times, real = [], tables.whole

    def stop(path):
        times.append(path.name)
        if times.count(f"{name}.parquet") > 1:
            raise Stopped
        return real(path)

    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(tables, "WRITE_AFTER", 0.0)
        monkeypatch.setattr(tables, "WRITE_SHARE", 1e9)
        monkeypatch.setattr(tables, "whole", stop)
        with pytest.raises(Stopped):
            run(tmp_path / "o", *words)
    assert len(rows(tmp_path / "o")) == 1
    run(tmp_path / "o", *words)
    for table in ("flights", "episodes"):
        one, other = (
            [{**row, "config": ""} for row in rows(out, table)]
            for out in (tmp_path / "o", judged)
        )
        assert one == other


def test_a_folder_of_something_else_is_left_alone(fleet, judged, tmp_path, capsys):
    """Of other settings, unless that is asked for; of another run at the same time; of another program."""
    out = Path(shutil.copytree(judged, tmp_path / "o"))
    run(out, fleet / "heron", codes=[2])
    assert (
        "is of other settings or of another version; --force begins anew"
        in capsys.readouterr().err
    )
    assert both(out) == both(judged)
    other = Tables(out, {}, force=True)
    with pytest.raises(BagError, match="another fdi fleet writes"):
        Tables(out, {}, force=True)
    del other
    run(out, fleet / "heron", "--force")
    assert len(rows(out)) == 2
    (out / "flights.parquet").write_bytes(b"half")
    run(out, fleet / "heron", codes=[2])
    assert "flights.parquet is damaged" in capsys.readouterr().err
    parquet.write_table(
        parquet.read_table(judged / "flights.parquet").replace_schema_metadata(),
        out / "flights.parquet",
    )
    run(out, fleet / "heron", "--force", codes=[2])
    assert "flights.parquet is no table of fdi fleet" in capsys.readouterr().err
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "fleet.html").write_text("years")
    run(tmp_path / "mine", fleet / "heron", "--force", codes=[2])
    assert (tmp_path / "mine" / "fleet.html").read_text() == "years"
    run(tmp_path / "mine" / "fleet.html" / "o", fleet / "heron", codes=[2])
    assert (
        capsys.readouterr()
        .err.splitlines()[-1]
        .endswith("fleet.html/o: Not a directory")
    )


def test_a_full_disk_is_one_line_and_loses_nothing(fleet, judged, tmp_path, capsys):
    out = Path(shutil.copytree(judged, tmp_path / "o"))
    limit, handler = (
        resource.getrlimit(resource.RLIMIT_FSIZE),
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
    )
    # As much as a parameter file takes, and less than a table.
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limit[1]))
    try:
        run(out, fleet / "kite", "--config", fleet / "config.yaml", codes=[2])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        signal.signal(signal.SIGXFSZ, handler)
    assert capsys.readouterr().err.strip().startswith(f"fdi: cannot write {out}/")
    assert both(out) == both(judged)


def test_where_nothing_could_be_judged_that_is_the_end(tmp_path, capsys):
    (tmp_path / "a.mcap").write_bytes(b"")
    run(tmp_path / "o", tmp_path, codes=[2])
    assert (
        f"no recording could be judged: {tmp_path / 'o' / 'fleet.html'}"
        in capsys.readouterr().err
    )
    assert (tmp_path / "o" / "flights.parquet").exists()
