# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The command line: what a user types, what it says, and how it fails."""

import csv
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from bag import logs

from fdi_ros.cli import ExitCode, command_line
from fdi_ros.cli.command_line import main
from fdi_ros.cli.outputs import progress
from fdi_ros.cli.settings import compile_now, warm_detector, warm_path
from fdi_ros.config.config import Config
from fdi_ros.detectors import DETECTORS
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.inspection.fitness import not_configured
from fdi_ros.monitor.building import GUARD
from fdi_ros.signals import STOPPING
from fdi_ros.system import shipped_files

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture
def config(root):
    return root / "config" / "two_triads.yaml"


@pytest.fixture
def replay(fdi, flight, config):
    """Replay the bundled flight with more words: exit code, output, errors."""
    return lambda *words: fdi("replay", flight, "--config", config, *words)


UNTOLD = 4
"""Exit code of a replay of so few samples that nothing was judged."""
FAULT = "channel=g2 kind=bias size=0.2 start=20"


def test_replay_prints_a_table_and_writes_the_summary_and_a_line_for_every_sample(
    tmp_path, replay
):
    code, out, err = replay(
        "--fault", FAULT, "--json", tmp_path / "s.json", "--csv", tmp_path / "s.csv"
    )
    assert (code, err) == (0, "")
    assert "\r" not in out
    assert out.startswith(
        "1 of 1 injected fault detected, 1 isolated.\nbias on g2: detected after 10 ms, isolated"
    )
    assert re.search(
        r"^  1\. g2 FAULTY from 20\.[01]\d\d s \([+]0\.20", out, re.MULTILINE
    )
    assert "\n       injected faults: bias on g2\n" in out
    assert json.loads((tmp_path / "s.json").read_text())["faults"][0][
        "declared_channels"
    ] == ["g2"]
    rows = list(csv.DictReader((tmp_path / "s.csv").read_text().splitlines()))
    assert len(rows) == 6001
    assert (rows[0]["rate_x"], rows[0]["g1.state"], rows[999]["g1.state"]) == (
        "",
        "UNCHECKED",
        "OK",
    )
    assert abs(float(rows[999]["g1"])) < 4
    assert sorted(os.listdir(tmp_path)) == ["s.csv", "s.json"]


def test_a_check_that_is_not_met_is_exit_code_1_with_the_reasons(tmp_path, replay):
    sound = tmp_path / "s.json"
    words = ("--end", 24, "--fault", FAULT, "--json", sound)
    code, out, err = replay(
        *words, "--check", "delay<1 isolated, false = 0 judged>=0.8"
    )
    assert (code, err) == (0, "")
    assert out.endswith("check met: delay<1 isolated, false = 0 judged>=0.8\n")
    delay = json.loads(sound.read_text())["faults"][0]["delay_s"]
    code, out, err = replay(
        *words,
        "--force",
        "--quiet",
        "--check",
        "delay<0.001 detected isolated<=0.01 judged>0.99",
    )
    assert (code, out) == (1, "")
    assert (
        f"fdi: check not met: delay<0.001: bias on g2: detected after {delay:.3f} s\n"
        in err
    )
    assert "judged>0.99: 2100 of 2400 samples were judged, 0.8750" in err
    told = json.loads(sound.read_text())["check"]
    assert told["required"] == [
        "delay<0.001",
        "detected",
        "isolated<=0.01",
        "judged>0.99",
    ]
    assert [f"fdi: check not met: {line}" for line in told["unmet"]] == err.splitlines()


def test_a_missed_fault_and_a_false_declaration_fail_the_check(
    fdi, flight, config, tmp_path, replay
):
    words = ("--end", 30, "--check", "detected isolated<9 false=0")
    code, _, err = replay(*words, "--fault", "channel=g2 kind=bias size=1e-5 start=20")
    assert code == 1
    unmet = [
        f"fdi: check not met: {one}: bias on g2: not detected"
        for one in ("detected", "isolated<9")
    ]
    assert err.splitlines() == unmet
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(
        config.read_text().replace("preset: two_triad_cone", "preset: dodecahedron")
    )
    code, _, err = fdi(
        "replay", flight, "--config", wrong, "--end", 30, "--check", "false<1"
    )
    assert code == 1
    assert re.match(
        r"fdi: check not met: false<1: \d+ declarations: g\d [A-Z]+ at ",
        err,
    )


def test_figures_go_to_standard_output_and_nothing_else_does(fdi, flight, config, root):
    def figures(*words, code=0):
        done = fdi(*words, "--json", "-", "--quiet")
        assert (done.code, done.err) == (code, "")
        return json.loads(done.out, parse_constant=pytest.fail)

    # Faults of a scenario and of the command line add up.
    scenario = root / "config" / "scenarios" / "two_at_once.yaml"
    both = (
        "--scenario",
        scenario,
        "--fault",
        "channel=g1 kind=noise size=0.2 start=50 seed=4",
    )
    found = figures("replay", flight, "--config", config, *both)
    assert [fault["kind"] for fault in found["faults"]] == ["noise", "bias", "drift"]
    # In 5 s the biases are still being learned: what the gyros are cannot be told.
    figures("replay", flight, "--config", config, "--end", 5, code=UNTOLD)
    # Its units are turned against each other.
    found = figures("inspect", flight, code=UNTOLD)
    assert found["duration_s"] == pytest.approx(60, abs=0.02)
    assert (found["start_ns"], found["start"]) == (
        1750000000000000000,
        "2025-06-15T15:06:40+00:00",
    )
    assert found["size_bytes"] == sum(path.stat().st_size for path in flight.iterdir())
    assert [topic["messages"] for topic in found["topics"]] == [6001] * 3
    assert figures("shipped", config.name)["files"] == [str(config)]
    found = figures("geometry", root / "config" / "two_imus.yaml")["smallest_within"]
    (at_rest,) = (one for one in found if one["condition"] == "at rest")
    assert len(at_rest["rad_s"]["imu_1.x"]) == len(at_rest["within_s"])


@pytest.mark.parametrize("verb", ["replay", "sweep", "calibrate", "geometry", "fleet"])
def test_of_several_configs_the_later_wins_and_shipped_ones_go_by_name(
    verb, fdi, root, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.yaml").write_text(
        "/**: {ros__parameters: {noise: {noise_std: [-1.0]}}}"
    )
    (tmp_path / "good.yaml").write_text(
        "/**: {ros__parameters: {noise: {noise_std: [0.002]}}}"
    )
    bag = root / "bags" / "cone_flight"
    words = {
        "replay": ("--end", 5),
        "sweep": ("--fault", "kind=bias size=0.1", "--times", 1, "--end", 30),
        "calibrate": ("--output", "new.yaml", "--end", 40),
        "geometry": (),
        "fleet": ("--output", "fleet", "--workers", 1),
    }[verb]

    def called(*files):
        given = (
            files
            if verb == "geometry"
            else (bag, *(word for file in files for word in ("--config", file)))
        )
        return fdi(verb, *given, *words, "--quiet")

    taken = f"fdi: there is no two_imus.yaml here: taking the shipped {root / 'config' / 'two_imus.yaml'}\n"
    code, _, said = called("two_imus.yaml", "good.yaml", "bad.yaml")
    assert (code, said) == (
        2,
        f"{taken}fdi: noise.noise_std is -1 rad/s, expected 1e-09 to 10 rad/s\n",
    )
    code, _, said = called("two_imus.yaml", "bad.yaml", "good.yaml")
    assert (code, said) == (4 if verb == "replay" else 0, taken)


def test_rates_are_printed_in_degrees_where_asked_for(fdi, flight, config, replay):
    words = ("--end", 21, "--fault", FAULT)
    assert "0.2 rad/s" in replay(*words).out
    out = replay(*words, "--degrees").out
    assert "11.4592 deg/s" in out
    assert re.search(r"without a monitor +5\.729578 deg/s\n", out)
    assert "rad/s" not in out
    assert "3 gyros, up to 176 deg/s" in fdi("inspect", flight, "--degrees").out
    assert "noise deg/s" in fdi("geometry", config, "--degrees").out


@pytest.mark.parametrize("configured", [10.0, 78.0, 130.0, 1000.0, 115.0])
def test_a_sample_rate_that_is_far_from_the_recordings_is_refused_and_a_near_one_said(
    fdi, refused, flight, config, tmp_path, configured
):
    wrong = tmp_path / "c.yaml"
    wrong.write_text(
        config.read_text().replace("sample_rate: 100.0", f"sample_rate: {configured}")
    )
    said = f"sample_rate is {configured:g} Hz in the config and 100 Hz in the recording"
    if configured == 115.0:
        words = ("replay", flight, "--config", wrong, "--end", 1)
        assert f"note: {said}" in fdi(*words).out
        code, out, err = fdi(*words, "--quiet", "--check", "judged>=0 unchecked<=6")
        assert (code, out, err.count("\n")) == (0, "", 1)
        assert err.startswith(f"fdi: warning: {said}")
        return
    for words in (
        ["replay"],
        ["sweep"],
        ["calibrate", "--output", tmp_path / "out.yaml"],
    ):
        assert f"{said}: set sample_rate to 100" in refused(
            words[0], flight, "--config", wrong, *words[1:]
        )


COMPLETED = {
    "fdi replay --che": "--check",
    "fdi insp": "inspect",
    "fdi replay fli": "flight.mcap",
    "fdi replay x --config my": "my.yaml",
    "fdi geometry my": "my.yaml",
    "fdi fleet fli": "flight.mcap",
    "fdi replay x --detector cu": "cusum",
    "fdi compile --detector seq": "sequential",
    "fdi sweep x --compare li": "likelihood_ratio",
}
AT_EACH_KEY = "COMP_CWORD=$((${#COMP_WORDS[@]} - 1)); _shtab_fdi; echo ${COMPREPLY[*]}"


def test_bash_completes_verbs_options_files_and_detectors(capsys, tmp_path):
    with pytest.raises(SystemExit, match="0"):
        command_line.main(["--print-completion", "bash"])
    for name, text in (
        ("_fdi", capsys.readouterr().out),
        ("flight.mcap", ""),
        ("my.yaml", ""),
    ):
        (tmp_path / name).write_text(text)
    command = [
        "bash",
        "-c",
        f"source ./_fdi; while read -ra COMP_WORDS; do {AT_EACH_KEY}; done",
    ]
    typed = "".join(f"{words}\n" for words in COMPLETED)
    done = subprocess.run(
        command, input=typed, capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert done.stdout.splitlines() == list(COMPLETED.values())


def test_fdi_alone_shows_what_one_needs_first(capsys, fdi):
    code, out, err = fdi()
    assert (code, err) == (0, "")
    first, _, rest = out.partition("then:")
    for name in command_line.FIRST:
        assert command_line.VERBS[name].examples[0] in first
    assert all(
        (f"  {name} " in rest) != (name in command_line.FIRST)
        for name in command_line.VERBS
    )
    for words, code, begin in (
        (["--help"], 0, "usage: fdi VERB"),
        (["--version"], 0, "fdi_ros "),
        (["--print-completion", "cmd"], 2, ""),
    ):
        with pytest.raises(SystemExit) as ended:
            command_line.main(words)
        assert (ended.value.code, capsys.readouterr().out[: len(begin)]) == (
            code,
            begin,
        )


CHOICES = {
    "replay": [*DETECTORS, *FAULT_KINDS, "two_at_once.yaml"],
    "sweep": [*DETECTORS, *FAULT_KINDS],
    "compile": DETECTORS,
    "montecarlo": [
        path.name for path in shipped_files() if path.parent.name == "studies"
    ],
    "fleet": ["none", "each"],
}


@pytest.mark.parametrize("verb", command_line.VERBS)
def test_every_help_has_examples_that_can_be_typed_and_all_choices(capsys, verb):
    with pytest.raises(SystemExit) as ended:
        command_line.main([verb, "--help"])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    for example in command_line.VERBS[verb].examples:
        assert f"\n  {example}\n" in said
        program, *words = shlex.split(example)
        assert program == "fdi"
        assert command_line._parser().parse_args(words).verb == verb
    said = " ".join(said.split())
    assert not [choice for choice in CHOICES.get(verb, ()) if choice not in said]


def test_compile_leaves_nothing_to_compile(fdi, refused):
    code, out, err = fdi(
        "compile", "--detector", "max_residual", "guaranteed", "--json", "-"
    )
    said, _, folder = err.rstrip("\n").rpartition(" in ")
    assert (code, said) == (0, "nothing to compile: all results are")
    figures = json.loads(out)
    assert (figures["compiled"], figures["folder"]) == (0, folder)
    assert figures["detectors"] == ["max_residual", "guaranteed"]
    refused("compile", "--detector", "magic")


def test_no_two_processes_compile_the_same(monkeypatch):
    """Every monitor has the guard, which is compiled with what takes samples through it."""
    handed_out = []

    class Pool:
        def __init__(self, *_):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def map(self, work, parts):
            handed_out.extend(parts)
            return [0 for _ in parts]

    monkeypatch.setattr("fdi_ros.cli.settings.ProcessPoolExecutor", Pool)
    compile_now([GUARD, "cusum"])
    detectors = [part[1:] for part in handed_out if part[0] is warm_detector]
    assert detectors == [("cusum",)]
    assert (warm_path,) in handed_out


PATH_ALONE = """
from fdi_ros.compiling import compiled
from fdi_ros.monitor.receiver import warm_path

warm_path()
print({one.function.__module__ for one in compiled._callbacks if one.compiled})
"""


def test_what_samples_pass_through_is_compiled_with_the_guard_alone():
    """The first start waits for no method that only comparisons use."""
    done = subprocess.run(
        [sys.executable, "-c", PATH_ALONE], capture_output=True, text=True, check=True
    )
    assert done.stdout == "{'fdi_ros.detectors.sequential'}\n"


NEW_FORMS = """
import sys
from fdi_ros.cli.command_line import main
from fdi_ros.cli.settings import warm_path, warm_verbs
from fdi_ros.compiling import compiled
from fdi_ros.detectors import DETECTORS
from fdi_ros.monitor.building import GUARD
from fdi_ros.monitor.receiver import warm_detector

warm_path()
for name in DETECTORS:
    if name != GUARD:
        warm_detector(name)
warm_verbs()
forms = lambda: {(one.py_func.__qualname__, form) for one in compiled._dispatchers for form in one.signatures}
before = forms()
for words in eval(sys.argv[1]):
    assert main(words) in (0, 4), words
print({name for name, _ in forms() - before})
"""
"""Compiled functions that verbs call with other types than `fdi compile` does."""


def test_verbs_need_no_more_than_is_compiled_ahead(flight, config, root, tmp_path):
    units, out = root / "config" / "two_imus.yaml", tmp_path / "out.yaml"
    # Of five channels, and the bundled flight has six.
    here = [name for name in DETECTORS if name != "determinant"]
    used = [
        ["replay", flight, "--config", config, "--end", 21, "--fault", FAULT],
        *(
            ["replay", flight, "--config", config, "--end", 4, "--detector", name]
            for name in here
        ),
        [
            "replay",
            flight,
            "--config",
            units,
            "--end",
            21,
            "--output",
            tmp_path / "bag",
        ],
        ["setup", flight, "--end", 40, "--output", out],
        ["inspect", flight],
        ["geometry", out],
        [
            "sweep",
            flight,
            "--config",
            units,
            "--fault",
            "kind=bias size=0.1",
            "--times",
            1,
            "--end",
            25,
        ],
        ["convert", flight, "--output", tmp_path / "converted"],
        ["inspect", logs.write_dataflash(tmp_path / "log.bin", logs.units())],
        ["inspect", logs.write_ulog(tmp_path / "log.ulg", logs.units())],
        ["inspect", logs.write_tlog(tmp_path / "log.tlog")],
    ]
    commands = repr([[str(word) for word in [*words, "--quiet"]] for words in used])
    done = subprocess.run(
        [sys.executable, "-c", NEW_FORMS, commands],
        capture_output=True,
        text=True,
        check=True,
    )
    assert (done.stdout, done.stderr) == ("set()\n", "")


def test_results_are_replaced_if_asked_for(tmp_path, refused, flight, config):
    there, bag, link = tmp_path / "s.json", tmp_path / "out", tmp_path / "link.json"
    there.write_text('{"generator": "fdi_ros"}')
    link.symlink_to(there)
    words = (
        "replay",
        flight,
        "--config",
        config,
        "--end",
        1,
        "--json",
        link,
        "--output",
        bag,
    )
    assert refused(*words) == f"fdi: {link} exists already; --force overwrites it\n"
    assert there.read_text() == '{"generator": "fdi_ros"}'
    for _ in range(2):
        assert command_line.main([*map(str, words), "--force"]) == UNTOLD
        # A link is followed: what it leads to is replaced, not the link.
        assert link.is_symlink()
        assert json.loads(there.read_text())["samples"] == 100
        assert sorted(os.listdir(bag)) == ["metadata.yaml", "out.mcap"]
        assert sorted(os.listdir(tmp_path)) == ["link.json", "out", "s.json"]


REPLAY = "replay FLIGHT --config CONFIG"
SIGN = f"{REPLAY} --fault 'channel=g1 kind=sign"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("replay none --config CONFIG", "no recording at none"),
        ("replay empty.mcap --config CONFIG", "empty.mcap is empty"),
        (
            "replay FLIGHT --config none.yaml",
            "cannot read config none.yaml: No such file or directory",
        ),
        ("replay FLIGHT --config three_imu", "did you mean 'three_imus.yaml'?"),
        ("montecarlo refrence.yaml", "did you mean 'reference.yaml'?"),
        (
            "replay FLIGHT --config THREE",
            "no topic '/imu_3/data_raw', it has: /gyro_channels (std_msgs/msg/Float64",
        ),
        (
            "replay FLIGHT --config FIVE",
            "no usable message on: gyro_channels (6001 malformed, expected 5 values in",
        ),
        (
            "replay FLIGHT --config TYPO",
            "unknown parameter 'nosie.noise_std', did you mean 'noise.noise_std'",
        ),
        ("replay FLIGHT --config FLAT", "do not span three dimensions"),
        ("replay FLIGHT --config LONG", "norm"),
        (f"{REPLAY} --detector sequental", "did you mean 'sequential'?"),
        (f"{REPLAY} --fault 'channel=g1 kind=bais size=1'", "did you mean 'bias'?"),
        (f"{REPLAY} --fault 'channel=g_1 kind=bias size=1'", "did you mean 'g1'?"),
        (f"{REPLAY} --detector magic", "unknown detector 'magic', expected one of"),
        (f"{REPLAY} --fault kind=bias", "fault needs channel"),
        (f"{REPLAY} --start 9 --end 3", "expected 0 <= start < end"),
        (f"{REPLAY} --start 900", "has no usable message"),
        (f"{REPLAY} --json none/s.json", "there is no folder"),
        (
            f"{SIGN} start=2'",
            "sign on g1 starts at 2 s, expected at least 3 s: the start-up biases are measured until then",
        ),
        (
            f"{SIGN} start=32.5' --start 30",
            "fault sign on g1 starts at 32.5 s, expected at least 33 s: the start-up biases",
        ),
        (
            f"{SIGN} start=9' --end 9",
            "sign on g1 starts at 9 s, expected at most 8.99 s: that is the last sample",
        ),
        (
            f"{REPLAY} --check 'false=0 dlay<1'",
            "unknown condition 'dlay<1', did you mean 'delay'?",
        ),
        (
            f"{REPLAY} --check 'delay>1'",
            "expected delay<NUMBER or delay<=NUMBER, not 'delay>1'",
        ),
        (f"{REPLAY} --check detected=1", "expected detected, not 'detected=1'"),
        (f"{REPLAY} --check false", "--check: expected false<NUMBER or"),
        (
            f"{REPLAY} --check 'judged > x'",
            "'judged>x' has the bound 'x', expected a number",
        ),
        (f"{REPLAY} --check detected", "'detected' is about injected faults"),
        (
            f"{REPLAY} --check 'g9 faulty'",
            "'g9 faulty' names no channel, expected one of: g1, g2",
        ),
        (f"{REPLAY} --check ' '", "--check is empty, expected conditions on: detected"),
        *(
            (f"{REPLAY} --check '{one}'", f"'{one}' can never hold")
            for one in ("judged>1", "false<0", "unchecked=0.5")
        ),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    words, said, refused, flight, config, root, tmp_path, monkeypatch
):
    (tmp_path / "empty.mcap").touch()
    axes = "{preset: axes, axes: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, %s]}"
    places = {
        "FLIGHT": flight,
        "CONFIG": config,
        "THREE": root / "config" / "three_imus.yaml",
    }
    for name, settings in (
        ("five", "geometry: {preset: cone, cone_channels: 5}"),
        ("typo", "nosie: {noise_std: [1.0]}"),
        ("flat", f"geometry: {axes % '1.0, 1.0, 0.0, 1.0, -1.0, 0.0'}"),
        ("long", f"geometry: {axes % '0.0, 0.0, 1.0, 2.0, 2.0, 1.0'}"),
    ):
        places[name.upper()] = tmp_path / f"{name}.yaml"
        places[name.upper()].write_text(f"/**:\n  ros__parameters:\n    {settings}\n")
    monkeypatch.chdir(tmp_path)
    assert said in refused(*(places.get(word, word) for word in shlex.split(words)))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "replay x --fault channel=g1 kind=bias",
            "kind=bias. Write a value with blanks in quotes",
        ),
        ("replya x", "no such VERB: 'replya', did you mean 'replay'?"),
        ("replay x --confg y", "has no option '--confg', did you mean '--config'?"),
        ("replay x --topics y", "has no option '--topics', expected one of: --config"),
        ("fleet x --output y --calibrate eech", "did you mean 'each'?"),
    ],
)
def test_a_mistyped_word_of_the_command_line_is_answered_by_the_closest(
    words, said, capsys
):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    printed = capsys.readouterr().err
    assert said in printed
    if "has no option" in said:
        assert printed.startswith("usage: fdi replay ")


def test_a_folder_of_flight_logs_leads_to_fleet(refused, root, tmp_path):
    shutil.copy(root / "bags" / "copter_crash.tlog", tmp_path)
    assert "run fdi fleet on it" in refused("replay", tmp_path)


def test_gyros_that_the_config_leaves_out_are_named(flight):
    topics = ["/imu_1/data_raw", "/imu_2/data_raw"]
    for configured, named in ((topics, 0), ([topics[0], "/other"], 1)):
        parameters = {"input": "imus", "imus.topics": configured}
        lines = not_configured(flight, Config.from_parameters(parameters))
        assert len(lines) == named
        assert all(line.startswith("/imu_2/data_raw carries gyros") for line in lines)


@pytest.mark.parametrize("words", [["shipped"], ["--help"]])
def test_a_pipe_may_close(words):
    words = [sys.executable, "-m", "fdi_ros.cli", *words]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        process.stdout.close()
        assert (process.stderr.read(), process.wait(240)) == (b"", 0)


@pytest.mark.parametrize("closed", [">&-", ">&- 2>&-"])
def test_outputs_may_be_closed_from_the_start(closed):
    shell = [
        "sh",
        "-c",
        f'exec "$@" {closed}',
        "sh",
        sys.executable,
        "-m",
        "fdi_ros.cli",
        "shipped",
    ]
    done = subprocess.run(
        shell, capture_output=True, text=True, timeout=240, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_a_replay_that_is_stopped_leaves_nothing_behind(flight, config, tmp_path):
    words = [
        sys.executable,
        "-m",
        "fdi_ros.cli",
        "replay",
        str(flight),
        "--config",
        str(config),
    ]
    words += ["--output", str(tmp_path / "out"), "--csv", str(tmp_path / "s.csv")]

    def hear_it():
        # A shell lets what it starts in the background ignore SIGINT, and these tests may have been started so.
        for one in STOPPING:
            signal.signal(one, signal.SIG_DFL)

    # As plain Python it takes so long that it cannot be done before the signal comes.
    slow = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    with subprocess.Popen(
        words,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=hear_it,
        env=slow,
    ) as process:
        # Both outputs have been begun.
        while len(os.listdir(tmp_path)) < 2:
            assert process.poll() is None
            time.sleep(0.001)
        # A second one, as of somebody impatient, does not disturb what removes them.
        process.send_signal(signal.SIGTERM)
        time.sleep(0.03)
        process.send_signal(signal.SIGTERM)
        assert process.stderr.read() == b""
        assert process.wait(240) == 130
    assert os.listdir(tmp_path) == []


NO_COMPILER = """
import sys
from fdi_ros.cli import ExitCode, command_line
for words in ("--help", "--version", "replay", "compile --help", "fly", "inspect --no", "replay --help"):
    if words == "replay --help":
        # It lists the kinds of faults.
        assert "numpy" not in sys.modules
    try:
        command_line.main(words.split())
    except SystemExit:
        print("\\nended", words)
print(*sys.modules)
"""


def test_help_and_usage_errors_wait_for_no_compiler():
    done = subprocess.run(
        [sys.executable, "-c", NO_COMPILER],
        capture_output=True,
        text=True,
        timeout=240,
        check=True,
    )
    assert done.stdout.count("\nended ") == 7
    loaded = done.stdout.splitlines()[-1].split()
    assert "fdi_ros.cli.command_line" in loaded
    assert set(loaded).isdisjoint({"numba", "yaml"})


def test_devices_pipes_and_open_files_are_written_through_and_results_confirmed(
    capsysbinary, flight, config, tmp_path
):
    words = ["replay", str(flight), "--config", str(config), "--end", "1"]
    assert (
        command_line.main([*words, "--json", "/dev/null", "--csv", "/dev/null"])
        == UNTOLD
    )
    assert Path("/dev/null").is_char_device()
    said = capsysbinary.readouterr()
    assert said.out.endswith(b"\nwrote /dev/null\nwrote /dev/null\n")

    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with ThreadPoolExecutor() as pool:
        read = pool.submit(pipe.read_text)
        assert command_line.main([*words, "--json", str(pipe)]) == UNTOLD
        assert json.loads(read.result(60))["samples"] == 100
    assert pipe.is_fifo()
    with (tmp_path / "figures.json").open("wb") as file:
        assert (
            command_line.main([*words, "--json", f"/proc/self/fd/{file.fileno()}"])
            == UNTOLD
        )
    assert json.loads((tmp_path / "figures.json").read_text())["samples"] == 100
    capsysbinary.readouterr()

    assert (
        command_line.main([*words, "--json", "-", "--csv", str(tmp_path / "s.csv")])
        == UNTOLD
    )
    said = capsysbinary.readouterr()
    assert json.loads(said.out)["samples"] == 100
    assert said.err.decode().endswith(f"wrote {tmp_path / 's.csv'}\n")
    assert not Path("-").exists()
    assert command_line.main([*words, "--json", "-", "--csv", "-"]) == 2
    assert command_line.main([*words, "--output", "-"]) == 2
    assert command_line.main([*words, "--json", "/dev/full"]) == 2
    errors = capsysbinary.readouterr().err.decode().splitlines()
    assert ["two outputs" in errors[0], "a recording is a folder" in errors[1]] == [
        True,
        True,
    ]
    assert errors[2:] == ["fdi: cannot write /dev/full: No space left on device"]


REPLACED = [
    ("REPLAY --output HOME", "holds more than a recording made by fdi"),
    ("REPLAY --output RECORDED", "holds more than a recording made by fdi"),
    ("REPLAY --output FILE", "is no folder"),
    ("REPLAY --json FILE", "is no result of fdi"),
    ("REPLAY --json RECORDED", "is a folder"),
    ("REPLAY --json PACKAGE", "is no result of fdi"),
    ("REPLAY --csv PACKAGE", "is no result of fdi"),
    ("REPLAY --report PAGE", "is no result of fdi"),
    ("REPLAY --json one --csv one", "two outputs"),
    # What was read, also by another name.
    *(
        (f"REPLAY --json {name}", "which is read")
        for name in ("CONFIG", "/proc/self/cwd/config", "/dev/fd/../cwd/config")
    ),
    *(
        (f"REPLAY --output {name}", "which is read")
        for name in ("FLIGHT", "FLIGHT/metadata.yaml", "FLIGHT/..")
    ),
    ("geometry CONFIG --report CONFIG --force", "which is read"),
    ("montecarlo STUDY --json STUDY --force", "which is read"),
    ("montecarlo STUDY --json CONFIG", "exists already"),
    (
        "replay broken.mcap --config CONFIG --output bag --csv s.csv --json s.json",
        "broken.mcap",
    ),
    ("geometry CONFIG --json CONFIG --force", ""),
    # A recording that lies outside its folder: named so, or linked.
    ("replay NAMED --config CONFIG --force --json OUTSIDE", ""),
    ("replay LINKED --config CONFIG --force --json OUTSIDE", ""),
]


@pytest.fixture
def places(flight, root, tmp_path, monkeypatch):
    """Files and folders that no output may replace, by the words that stand for them."""
    monkeypatch.chdir(tmp_path)
    found = {
        "FLIGHT": Path("of", "flight"),
        **{name.upper(): Path(name) for name in ("recorded", "named", "linked")},
    }
    for path in found.values():
        shutil.copytree(flight, path)
    for name, content in (
        ("home/settings.yaml", b"mine: 1"),
        ("file", b"\x89MCAP0\r\n"),
        ("package", b'{"name": "mine"}'),
        ("broken.mcap", next(flight.glob("*.mcap")).read_bytes()[:200]),
        ("page", b"<!DOCTYPE html>\n<html>mine</html>"),
        ("config", (root / "config" / "two_imus.yaml").read_bytes()),
        ("study", (root / "config" / "studies" / "roc.yaml").read_bytes()),
        (
            "named/metadata.yaml",
            (flight / "metadata.yaml")
            .read_bytes()
            .replace(b"cone_flight.mcap", b"../outside"),
        ),
    ):
        path = Path(name)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        found[path.parts[0].upper()] = Path(path.parts[0])
    (found["NAMED"] / "cone_flight.mcap").rename("outside")
    (found["LINKED"] / "cone_flight.mcap").unlink()
    (found["LINKED"] / "cone_flight.mcap").symlink_to(tmp_path / "outside")
    return found | {"OUTSIDE": Path("outside")}


def under(folder):
    """Name and content of all that lies in a folder."""
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


@pytest.mark.parametrize(("words", "said"), REPLACED)
def test_only_a_former_result_is_replaced_and_nothing_else_is_touched(
    words, said, refused, places, tmp_path
):
    words = words.replace("REPLAY", "replay FLIGHT --config CONFIG --end 1 --force")
    given = [
        re.sub(r"^[A-Z]+", lambda found: str(places[found[0]]), word)
        for word in words.split()
    ]
    before = under(tmp_path)
    assert said in refused(*given)
    assert under(tmp_path) == before


def test_a_defect_of_ours_is_told_from_a_check_that_is_not_met(fdi, monkeypatch):
    monkeypatch.setattr("fdi_ros.cli.settings.shipped_files", lambda: 1 / 0)
    code, out, err = fdi("shipped")
    assert (code, out) == (ExitCode.DEFECT, "")
    assert err.startswith("Traceback")
    assert "ZeroDivisionError" in err
    assert err.splitlines()[-1].startswith("fdi: this is a defect of fdi")
    assert f"{ExitCode.DEFECT:d} a defect" in command_line.EXIT_CODES


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_how_much_is_done_is_a_bar_on_a_terminal_and_elsewhere_a_line_now_and_then(
    monkeypatch,
):
    monkeypatch.setattr("fdi_ros.cli.outputs.SAID_EVERY", 0.01)
    for stream, said in (
        (Terminal(), r" 50 %\|.* \r$"),
        (io.StringIO(), r"(?m)^fdi: power, 50 % done after 0 s, about 0 s left$"),
    ):
        for quiet in (True, False):
            with progress(stream, quiet, "power") as show:
                show(0.25)
                time.sleep(0.11)
                show(0.5)
                time.sleep(0.11)
            assert bool(re.search(said, stream.getvalue())) != quiet
            # While nothing more is done, how long it takes is not known.
            lines = re.findall("50 % done.*s left", stream.getvalue())
            assert len(lines) <= 1
            assert not quiet or stream.getvalue() == ""
