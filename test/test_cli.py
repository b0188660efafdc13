"""The command line: what a user types, what it says, and how it fails."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fdi_ros import cli

pytestmark = pytest.mark.usefixtures("compiled")


def run(capsys, *words):
    """Exit code, output, errors."""
    code = cli.main([str(word) for word in words])
    said = capsys.readouterr()
    return code, said.out, said.err


@pytest.fixture
def config(root):
    return root / "config" / "two_triads.yaml"


FAULT = "channel=g2 kind=bias size=0.2 start=20"


def test_replay_prints_a_table_and_writes_the_summary(capsys, flight, config, tmp_path):
    code, out, err = run(capsys, "replay", flight, "--config", config, "--fault", FAULT, "--json", tmp_path / "s.json")
    assert (code, err) == (0, "")
    assert out.startswith("1 of 1 injected fault detected, 1 isolated.\nbias on g2: detected after 10 ms, isolated.")
    assert "declarations that no injected fault explains: none" in out
    summary = json.loads((tmp_path / "s.json").read_text())
    assert summary["faults"][0]["declared_channels"] == ["g2"]
    assert os.listdir(tmp_path) == ["s.json"]


def test_scenario_and_fault_add_up(capsys, flight, config, root, tmp_path):
    scenario = root / "config" / "scenarios" / "two_at_once.yaml"
    words = ("replay", flight, "--config", config, "--scenario", scenario, "--json", tmp_path / "s.json")
    run(capsys, *words, "--fault", "channel=g1 kind=noise size=0.2 start=50 seed=4")
    faults = json.loads((tmp_path / "s.json").read_text())["faults"]
    assert [fault["kind"] for fault in faults] == ["noise", "bias", "drift"]


def test_csv_has_a_line_for_every_sample(capsys, flight, config, tmp_path):
    run(capsys, "replay", flight, "--config", config, "--csv", tmp_path / "s.csv", "--end", 10, "--fault", FAULT)
    with (tmp_path / "s.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1000
    assert rows[0]["rate_x"] == ""
    assert rows[0]["g1.state"] == "UNCHECKED"
    assert abs(float(rows[-1]["g1"])) < 4
    assert rows[-1]["g1.state"] == "OK"


def test_compare_lists_every_detector(capsys, flight, config):
    code, out, _ = run(capsys, "replay", flight, "--config", config, "--compare", "--end", 24, "--fault", FAULT)
    assert code == 0
    for name in ("mean_abs_residual", "likelihood_ratio", "guaranteed"):
        assert any(line.split()[:4] == [name, "1", "of", "1"] for line in out.splitlines())
    assert "determinant cannot run here: determinant has 6 channels, expected 5" in out


def test_inspect_prints_a_config_that_works(capsys, flight, tmp_path):
    code, out, _ = run(capsys, "inspect", flight, "--write", tmp_path / "start.yaml")
    assert code == 0
    assert "/gyro_channels   std_msgs/msg/Float64MultiArray  6001      100.0 Hz  0     10.0 ms" in out
    assert (tmp_path / "start.yaml").read_text() in out
    code, out, err = run(capsys, "replay", flight, "--config", tmp_path / "start.yaml", "--end", 5)
    assert (code, err) == (0, "")


def test_compile_leaves_nothing_to_compile(capsys, flight, config, root, tmp_path):
    words = ["compile", "--detector", "max_residual", "guaranteed"]
    code, out, err = run(capsys, *words)
    assert (code, err) == (0, "")
    said, _, folder = out.rstrip("\n").rpartition(" in ")
    assert said == "nothing to do: all is there,"
    before = sorted(Path(folder).rglob("*.nbc"))
    used = [[flight, "--config", config, "--compare", "--end", "20", "--fault", FAULT]]
    used += [[flight, "--config", root / "config" / "two_imus.yaml", "--output", tmp_path / "bag"]]
    for words in used:
        done = subprocess.run([sys.executable, "-m", "fdi_ros.cli", "replay", *words], capture_output=True, check=True)
        assert done.stderr == b""
    assert sorted(Path(folder).rglob("*.nbc")) == before
    assert run(capsys, "compile", "--detector", "magic")[0] == 2


def test_nothing_is_overwritten_unasked(capsys, flight, config, tmp_path):
    there = tmp_path / "s.json"
    there.write_text("mine")
    words = ("replay", flight, "--config", config, "--end", 1, "--json", there)
    assert run(capsys, *words)[0::2] == (2, f"fdi: {there} exists already; --force overwrites it\n")
    assert there.read_text() == "mine"
    assert run(capsys, *words, "--force")[0] == 0
    assert json.loads(there.read_text())["samples"] == 100


def test_a_folder_that_holds_more_than_a_recording_is_never_replaced(capsys, flight, config, tmp_path):
    folder = tmp_path / "home"
    folder.mkdir()
    (folder / "diary.txt").write_text("mine")
    words = ("replay", flight, "--config", config, "--end", 1, "--output", folder, "--force")
    code, _, err = run(capsys, *words)
    assert code == 2
    assert "holds more than a recording" in err
    assert (folder / "diary.txt").read_text() == "mine"


def test_an_output_bag_replaces_one_by_force(capsys, flight, config, tmp_path):
    words = ("replay", flight, "--config", config, "--end", 1, "--output", tmp_path / "out")
    assert run(capsys, *words)[0] == 0
    assert run(capsys, *words)[0] == 2
    assert run(capsys, *words, "--force")[0] == 0
    assert sorted(os.listdir(tmp_path / "out")) == ["metadata.yaml", "out.mcap"]
    assert os.listdir(tmp_path) == ["out"]


def test_the_recording_that_is_read_is_never_written_to(capsys, flight, config):
    for target in (flight, flight / "metadata.yaml", flight.parent):
        code, _, err = run(capsys, "replay", flight, "--config", config, "--output", target, "--force")
        assert code == 2
        assert f"belongs to {flight}, which is read" in err


def test_outputs_of_a_replay_that_fails_are_not_there(capsys, flight, config, tmp_path):
    broken = tmp_path / "in.mcap"
    data = next(flight.glob("*.mcap")).read_bytes()
    broken.write_bytes(data[:200])
    out = tmp_path / "out"
    out.mkdir()
    words = ("--output", out / "bag", "--csv", out / "s.csv", "--json", out / "s.json")
    code, _, err = run(capsys, "replay", broken, "--config", config, *words)
    assert code == 2
    assert err.count("\n") == 1
    assert os.listdir(out) == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["replay", "none", "--config", "CONFIG"], "no recording at none"),
        (["replay", "EMPTY", "--config", "CONFIG"], "empty.mcap is empty"),
        (["replay", "FLIGHT", "--config", "none.yaml"], "cannot read config none.yaml: No such file or directory"),
        (["replay", "FLIGHT", "--config", "THREE"], "has no topic '/imu_3/data_raw', it has: /gyro_channels (std_msgs"),
        (
            ["replay", "FLIGHT", "--config", "CONFIG", "--detector", "magic"],
            "unknown detector 'magic', expected one of",
        ),
        (["replay", "FLIGHT", "--config", "CONFIG", "--fault", "channel=g9 kind=bias size=1"], "unknown channel 'g9'"),
        (["replay", "FLIGHT", "--config", "CONFIG", "--fault", "kind=bias"], "fault needs channel"),
        (["replay", "FLIGHT", "--config", "CONFIG", "--scenario", "none.yaml"], "cannot read scenario none.yaml"),
        (["replay", "FLIGHT", "--config", "CONFIG", "--start", "9", "--end", "3"], "expected 0 <= start < end"),
        (["replay", "FLIGHT", "--config", "CONFIG", "--start", "900"], "has no usable message"),
        (["replay", "FLIGHT", "--config", "CONFIG", "--json", "none/s.json"], "there is no folder"),
        (["replay", "FLIGHT", "--config", "CONFIG", "--compare", "--csv", "s.csv"], "--compare gives one table"),
        (["replay", "FLIGHT", "--config", "FIVE"], "malformed, expected 5 values in each"),
        (
            ["replay", "FLIGHT", "--config", "TYPO"],
            "unknown parameter 'nosie.noise_std', did you mean 'noise.noise_std'",
        ),
        (["replay", "FLIGHT", "--config", "FLAT"], "do not span three dimensions"),
        (["replay", "FLIGHT", "--config", "LONG"], "norm"),
        (["inspect", "none"], "no recording at none"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(words, said, capsys, flight, config, root, tmp_path, monkeypatch):
    (tmp_path / "empty.mcap").touch()
    axes = "      axes: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, {}, 1.0, 0.0, 1.0, -1.0, 0.0]\n"
    head = "/**:\n  ros__parameters:\n"
    geometry = f"{head}    geometry:\n      preset: axes\n"
    (tmp_path / "five.yaml").write_text(f"{head}    geometry: {{preset: cone, cone_channels: 5}}\n")
    (tmp_path / "typo.yaml").write_text(f"{head}    nosie: {{noise_std: [1.0]}}\n")
    (tmp_path / "flat.yaml").write_text(geometry + axes.format("1.0"))
    (tmp_path / "long.yaml").write_text(geometry + "      axes: [1.0,0.0,0.0, 0.0,1.0,0.0, 0.0,0.0,1.0, 2.0,2.0,1.0]\n")
    places = {
        "FLIGHT": flight,
        "CONFIG": config,
        "THREE": root / "config" / "three_imus.yaml",
        "EMPTY": tmp_path / "empty.mcap",
        **{name.upper(): tmp_path / f"{name}.yaml" for name in ("five", "typo", "flat", "long")},
    }
    monkeypatch.chdir(tmp_path)
    code, out, err = run(capsys, *(places.get(word, word) for word in words))
    assert (code, out) == (2, "")
    assert err.startswith("fdi: ")
    assert err.count("\n") == 1
    assert said in err


def test_a_pipe_gets_no_progress_bar_and_may_close(flight, config):
    words = [sys.executable, "-m", "fdi_ros.cli", "replay", str(flight), "--config", str(config), "--end", "3"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=240, check=True)
    assert done.stderr == ""
    assert "\r" not in done.stdout
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(240) == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_replay_that_is_stopped_leaves_nothing_behind(number, flight, config, tmp_path):
    words = [sys.executable, "-m", "fdi_ros.cli", "replay", str(flight), "--config", str(config)]
    words += ["--output", str(tmp_path / "out"), "--csv", str(tmp_path / "s.csv")]

    def hear_it() -> None:
        # A shell lets what it starts in the background ignore SIGINT, and these tests may have been started so.
        signal.signal(signal.SIGINT, signal.default_int_handler)

    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=hear_it) as process:
        # Both outputs have been begun.
        while len(os.listdir(tmp_path)) < 2:
            assert process.poll() is None
            time.sleep(0.001)
        process.send_signal(number)
        assert process.wait(240) == 130
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "words", [["--help"], ["--version"], [], ["replay", "--help"], ["replay", "x"], ["fly"], ["inspect", "--no"]]
)
def test_help_and_usage_errors_wait_for_no_compiler(words):
    code = "import sys; from fdi_ros import cli\ntry: cli.main(sys.argv[1:])\nexcept SystemExit: print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=240, check=True)
    loaded = done.stdout.splitlines()[-1].split()
    assert "fdi_ros.cli" in loaded
    assert set(loaded).isdisjoint({"numba", "numpy", "yaml"})


def test_help_and_version(capsys):
    for words in (["--help"], ["replay", "--help"], ["inspect", "--help"], ["--version"]):
        with pytest.raises(SystemExit) as ended:
            cli.main(words)
        assert ended.value.code == 0
    assert "fdi_ros" in capsys.readouterr().out


def test_outputs_never_take_the_place_of_inputs_or_of_each_other(tmp_path, root, capsys):
    config = tmp_path / "c.yaml"
    config.write_bytes((root / "config" / "two_imus.yaml").read_bytes())
    study = tmp_path / "s.yaml"
    study.write_bytes((root / "config" / "studies" / "roc.yaml").read_bytes())
    bag = str(root / "bags" / "cone_flight")
    one = str(tmp_path / "one")
    for words, said in (
        (["replay", bag, "--config", str(config), "--json", str(config), "--force"], "which is read"),
        (["geometry", str(config), "--report", str(config), "--force"], "which is read"),
        (["montecarlo", str(study), "--json", str(study), "--force"], "which is read"),
        (["replay", bag, "--config", str(config), "--json", one, "--csv", one], "two outputs"),
        (["montecarlo", str(study), "--report", str(tmp_path / "no" / "r.html")], "there is no folder"),
        (["montecarlo", str(study), "--json", str(config)], "exists already"),
    ):
        assert cli.main(words) == 2
        assert said in capsys.readouterr().err
    assert config.read_bytes() == (root / "config" / "two_imus.yaml").read_bytes()
