# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording to a config: mounts from shared motion, and the verb on recordings that show much or little."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from bag.recordings import (
    ARRAY,
    START,
    STEP,
    TOPICS,
    array,
    flight,
    imu,
    imu_messages,
    write_config,
    write_mcap,
)
from scipy.spatial.transform import Rotation
from vehicles import vehicle

from fdi_ros.config.config import Config
from fdi_ros.inspection.findings import Finding, Role, lines_of, verdict_of
from fdi_ros.model.samples import Block
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.soundness import Concern, Trouble, Word
from fdi_ros.report.layout import RADIANS
from fdi_ros.setup.agreement import find_mounts
from fdi_ros.setup.blocks import prepare
from fdi_ros.setup.report import _looks_of_proof, _worth
from fdi_ros.setup.run import TEST_SIZES, Proof, Tried

pytestmark = pytest.mark.usefixtures("compiled")

ROOT = Path(__file__).parents[2]
CONE = ROOT / "bags" / "cone_flight"


def page_at(path):
    """The HTML of a page, with a space between a number and its unit, which hold together there."""
    return path.read_text().replace("&nbsp;", " ")


def ready(block):
    """A recording made ready, gyros of a range of 35 rad/s."""
    return prepare(block, np.full(block.z.shape[1], 35.0))


def test_mounts_are_found_and_taken_for_square_where_they_are():
    unit = vehicle(11, "rest and turns")
    mounts = find_mounts(ready(unit.block))
    left, _, right = np.linalg.svd(unit.axes[:3].T)
    first = (left @ right).T
    for mount, axes in zip(mounts, unit.axes.reshape(-1, 3, 3), strict=True):
        left, _, right = np.linalg.svd(axes.T)
        assert mount.rotation is not None
        off = Rotation.from_matrix(mount.rotation @ (first @ left @ right).T)
        assert off.magnitude() < np.radians(1.5)
        assert mount.error < np.radians(1.5)
    # The same units as if mounted otherwise: the second along the axes of the first, 3 degrees off, the third any way.
    square = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    off = Rotation.from_rotvec([0.0, np.radians(3.0), 0.0]).as_matrix()
    z = unit.block.z.copy()
    z[:, 3:6] = z[:, :3] @ off @ square
    # Damage and a shake beyond the range leave the rest of the recording as good as it was.
    z[1000:1100, 4], z[2000:2200] = np.nan, 40.0
    found = find_mounts(ready(Block(unit.block.stamp, z)))
    np.testing.assert_array_equal(found[1].rotation, square)
    assert np.degrees(found[1].off) == pytest.approx(3.0, abs=0.2)
    assert "body x is its z, y is its x, z is its y" in found[1].words


def test_a_mount_that_is_not_shown_is_not_known():
    unit = vehicle(11, "rest and turns")
    seconds = (unit.block.stamp - unit.block.stamp[0]) * 1e-9
    noise = np.random.default_rng(3).normal(0, 0.003, unit.block.z.shape)
    about_one = noise.copy()
    about_one[:, [0, 4, 6]] += np.sin(seconds)[:, None]
    apart = unit.block.z.copy()
    apart[:, 3:6] = np.roll(apart[:, 3:6], 700, axis=0)
    silent = unit.block.z.copy()
    silent[200:, 3:6] = np.nan
    for z, words in (
        (about_one, "too little about a second axis"),
        (noise, "it does not turn"),
        (apart, "does not measure the rotation of the first unit"),
        (silent, "all units give values together for only"),
    ):
        mount = find_mounts(ready(Block(unit.block.stamp, z)))[1]
        assert mount.rotation is None
        assert words in mount.words


def test_setup_makes_a_config_that_finds_faults(fdi, refused, tmp_path):
    file = tmp_path / "cone.yaml"
    code, out, _ = fdi(
        "setup", CONE, "--output", file, "--json", tmp_path / "cone.json", "--degrees"
    )
    assert code == 0
    assert "mounts: 1 of 1 measured relative to imu_1" in out
    assert re.search(r"^new +nothing", out, re.MULTILINE)
    # What is within its standard error is no figure, and has none.
    angles = re.findall(r"^imu_\d\.\w .* not measured +(\S+)", out, re.MULTILINE)
    assert set(angles) == {"-"}
    assert "imu_1 is assumed to be mounted along the body axes" in out
    names = ("cone.yaml", "cone.html", "cone.json")
    assert out.endswith("".join(f"wrote {tmp_path / name}\n" for name in names))
    config = Config.from_file(file)
    true = build_geometry(Config.from_file(ROOT / "config" / "two_imus.yaml")).axes
    relative = true @ np.linalg.inv(true[:3])
    found = build_geometry(config).axes
    np.testing.assert_allclose(
        found, relative / np.linalg.norm(relative, axis=1)[:, None], atol=0.02
    )
    assert config.imus.delays[1] == pytest.approx(0.0002, abs=2e-4)
    page = page_at(tmp_path / "cone.html")
    assert f"<li class=good>{out.splitlines()[0]}</li>" in page
    assert "<h2>Proof</h2>" in page
    assert "geometry:" in page
    assert re.match(
        r"USABLE: no false alarm in the last 15 s \(not used for fitting\)\. Of 36 test faults added there"
        r" \(1.72 to 17.2 deg/s\), \d+ were isolated\.",
        out,
    )
    assert "noise, deg/s" in page
    figures = json.loads((tmp_path / "cone.json").read_text())
    assert Config.from_parameters(figures["parameters"]) == config
    assert [mount["known"] for mount in figures["mounts"]] == [True, True]
    # Lines, for people, are those of the table.
    for role in ("found", "not_found", "warnings"):
        assert figures[role] == [
            one["words"] for one in figures["findings"] if one["role"] == role
        ]
    said = refused(
        "setup", CONE, "--output", tmp_path / "other.yaml", "--reference", "imu_3"
    )
    assert "--reference is 'imu_3', expected one of: imu_1, imu_2; or three of" in said
    # Nothing that exists is overwritten, and nothing is left half done.
    assert "exists already; --force overwrites it" in refused(
        "setup", CONE, "--output", file
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "cone.html",
        "cone.json",
        "cone.yaml",
    ]


def at_rest_then_turning(size):
    """Stamps and values of two parallel units, half of the time at rest; turns of a size, rad/s."""
    i = np.arange(1600)
    z = np.random.default_rng(3).normal(0.01, 0.002, (1600, 6))
    z[:, [2, 5]] += (size * np.sin(0.02 * i) * (i > 800))[:, None]
    return START + STEP * i, z


@pytest.mark.parametrize(
    ("in_degrees", "size", "words"),
    [
        ([0, 1], 0.3, "are in deg/s, no gyro at rest has a bias and noise of 0.1"),
        ([0, 1], 1.5, "are in deg/s, 8"),
        ([1], 0.3, f"{TOPICS[1]} is in deg/s, it shows 57."),
        ([0], 0.3, f"{TOPICS[0]} is in deg/s, it shows 57."),
        ([], 0.3, ""),
    ],
)
def test_degrees_are_refused(in_degrees, size, words, tmp_path, fdi, refused):
    stamp, z = at_rest_then_turning(size)
    for unit in in_degrees:
        z[:, 3 * unit : 3 * unit + 3] *= np.degrees(1.0)
    write_mcap(bag := tmp_path / "bag.mcap", imu_messages(stamp, z))
    config = write_config(
        tmp_path / "c.yaml",
        {"input": "imus", "sample_rate": 100.0, "imus.topics": list(TOPICS)},
    )
    made = tmp_path / "made.yaml"
    code, out, _ = fdi("inspect", bag)
    verbs = (
        ("setup", bag, "--output", made),
        ("calibrate", bag, "--config", config, "--output", made),
    )
    if not words:
        assert (code, out.partition(":")[0]) == (0, "READY")
        assert [
            fdi(*verb, "--force").code
            for verb in (*verbs, ("replay", bag, "--config", config))
        ] != [2, 2, 2]
        return
    assert (code, out.partition(":")[0]) == (3, "NEEDS rad/s")
    assert words in out.splitlines()[0]
    assert "sample_rate:" not in out
    for verb in (*verbs, ("replay", bag, "--config", config)):
        assert words in refused(*verb)
    code, _, said = fdi("inspect", bag, "--output", made)
    assert (code, words in said, made.exists()) == (2, True, False)


def gentle(seed, units, bias, turn):
    """Stamps and values of parallel units at 50 Hz: 6 s of rest, then gentle motion up to ``turn``, rad/s."""
    random = np.random.default_rng(seed)
    t = 0.02 * np.arange(1500)
    phase = random.uniform(0.0, 6.0, (3, 3))
    swings = np.sin(
        2.0 * np.pi * np.multiply.outer([0.23, 0.41, 0.77], t)[:, None]
        + phase[..., None]
    )
    rate = turn / 3.0 * (np.clip((t - 6.0) / 2.0, 0.0, 1.0) * swings.sum(axis=0)).T
    z = [
        rate + random.normal(0.0, bias, 3) + random.normal(0.0, 0.001, rate.shape)
        for _ in range(units)
    ]
    return START + np.round(1e9 * t).astype(np.int64), z


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("bias", [0.002, 0.01])
@pytest.mark.parametrize(
    ("units", "odd", "turn", "words"),
    [
        (2, [1], 0.05, "/imu_1 is in deg/s, it shows 57."),
        (3, [1], 0.05, "/imu_1 is in deg/s, it shows 57."),
        (3, [], 0.05, ""),
        (3, [], 0.0, ""),
    ],
)
def test_gentle_degrees_are_refused(bias, units, odd, turn, words, seed, tmp_path, fdi):
    stamp, z = gentle(seed, units, bias, turn)
    for unit in odd:
        z[unit] = np.degrees(z[unit])
    topics = [f"/imu_{k}" for k in range(units)]
    messages = imu_messages(stamp, np.hstack(z), topics)
    write_mcap(bag := tmp_path / "bag.mcap", messages)
    said = fdi("inspect", bag).out.splitlines()[0]
    assert words in said
    assert said.startswith("NEEDS rad/s" if words else ("READY", "USABLE"))


def test_half_a_second_of_a_long_flight_shows_degrees(tmp_path, fdi):
    t = 0.01 * np.arange(9000)
    turn = np.where((t > 50.0) & (t < 51.0), 0.7, 0.3 * np.sin(t))
    z = (
        np.random.default_rng(2).normal(0.0, 0.005, (len(t), 6))
        + np.tile([0.2, 0.5, 1.0], 2) * turn[:, None]
    )
    for factor, verdict in (
        (1.0, "READY"),
        (np.degrees(1.0), "NEEDS rad/s: /imu_1/data_raw and"),
    ):
        bag = write_mcap(
            tmp_path / f"{factor}.mcap",
            imu_messages(START + STEP * np.arange(len(t)), factor * z),
        )
        assert fdi("inspect", bag).out.startswith(verdict)


@pytest.mark.parametrize(
    ("of_one", "few", "size"), [(True, 4, 90.0), (False, 4, 90.0), (False, 40, 60.0)]
)
def test_shocks_and_noise_are_no_degrees(of_one, few, size, tmp_path, fdi):
    """Values beyond every range for a moment, and idling motors, are no other unit of measure."""
    stamp, z = at_rest_then_turning(0.3)
    z[1000 : 1000 + few] = size
    z[:, : 3 if of_one else 6] += np.random.default_rng(1).normal(
        0.0, 0.1, (1600, 3 if of_one else 6)
    )
    write_mcap(bag := tmp_path / "bag.mcap", imu_messages(stamp, z))
    assert fdi("inspect", bag).out.startswith("READY")


@pytest.mark.parametrize("ahead", [-1.5, 0.0, 3 * 86_400.0])
def test_clocks_that_share_no_instants_are_named(ahead, tmp_path, fdi, refused):
    off = {TOPICS[0]: 0, TOPICS[1]: round(ahead * 1e9)}
    steps = [START + i * STEP for i in range(1500)]
    rng = np.random.default_rng(4)
    messages = [
        (
            topic,
            at,
            imu(at + off[topic], rng.normal(0.0, 0.002, 3) + 0.5 * np.sin(at * 1e-9)),
        )
        for at in steps
        for topic in TOPICS
    ]
    write_mcap(tmp_path / "bag.mcap", messages)
    words = f"stamps are of other clocks than those of {TOPICS[0]}: {TOPICS[1]} {abs(ahead):.6g} s"
    assert (words in fdi("inspect", tmp_path / "bag.mcap").out) == (ahead != 0.0)
    made = (tmp_path / "bag.mcap", "--output", tmp_path / "made.yaml")
    if not ahead:
        # One axis alone turns: a fault of 0.1 rad/s is not found in 9 of 10.
        code, out, said = fdi("setup", *made)
        # On a slow machine, only how far it has come.
        assert (code, "other clocks" in said) == (4, False)
        # The warnings do not repeat the first line.
        assert out.count("no false alarm") == 1
        return
    assert words in refused("setup", *made)
    config = write_config(
        tmp_path / "two.yaml", {"input": "imus", "imus.topics": list(TOPICS)}
    )
    said = refused("calibrate", *made, "--config", config)
    assert words in said


@pytest.mark.parametrize("odd", [0, 2])
def test_a_mirrored_unit_is_named_whatever_its_mount(odd, tmp_path, fdi):
    one = vehicle(0, "rest and turns", 3)
    z = one.block.z.copy()
    z[:, 3 * odd] *= -1.0
    write_mcap(
        tmp_path / "bag.mcap", imu_messages(one.block.stamp, z, (*TOPICS, "/third"))
    )
    code, out, _ = fdi(
        "setup", tmp_path / "bag.mcap", "--output", tmp_path / "made.yaml"
    )
    assert code == 3
    # Units are named by the parts in which their topics differ.
    unit = ("imu_1_data_raw", "imu_2_data_raw", "third")[odd]
    assert out.startswith(
        f"DO NOT USE: {unit} is mirrored: one axis is reversed (a left turn reads as a right"
    )


def test_settings_are_never_worse_than_those_before():
    all_of_it = SimpleNamespace(judged=1.0, declared=[])
    before, fewer, chance = (
        Tried(all_of_it, "", {0.1: (isolated, 36)}) for isolated in (30, 28, 29)
    )
    nothing = Tried(None, "only three channels", {})
    for old, new, worse in (
        (before, fewer, "the new settings isolate 28 of 36 biases instead of 30"),
        (before, chance, ""),
        (fewer, before, ""),
        (before, nothing, "the new settings judge nothing: only three channels"),
        (nothing, before, ""),
    ):
        assert Proof("", True, 36.0, old, new).worse == worse


@pytest.mark.parametrize(
    ("now", "kept", "words"),
    [
        (
            36,
            "",
            "the new settings isolate 36 of 54 biases of accelerometers of 1 m/s^2 or more instead of 54",
        ),
        (53, "", ""),
        (36, "the new settings judge nothing", ""),
    ],
)
def test_settings_that_isolate_fewer_faults_of_accelerometers_are_to_be_looked_at(
    now, kept, words
):
    gyros = {0.1: (36, 36)}
    # Small biases do not count: those of healthy accelerometers move as far.
    before, after = (
        Tried(None, "", gyros, {0.3: (small, 54), 1.0: (n, 54)})
        for small, n in ((54, 54), (9, now))
    )
    proof = Proof("the last 117 s", True, 117.0, before, after)
    found = list(_looks_of_proof(SimpleNamespace(proof=proof, kept=kept), ()))
    assert [one.words for one in found] == [f"in the last 117 s, {words}"] * bool(words)
    assert {one.headline for one in found} <= {"USABLE, BUT LOOK"}


def test_what_the_next_replay_warns_of_is_a_warning_of_set_up_once():
    spiky = Concern(Word.LOOK, Trouble.SPIKES, ("imu_1.x",), "has 3 spikes")
    noisy = Concern(Word.LOOK, Trouble.NOISE, ("imu_2.y",), "is noisy")
    part, whole = (
        SimpleNamespace(judgement=SimpleNamespace(concerns=some))
        for some in ([noisy], [noisy, spiky])
    )
    proof = SimpleNamespace(
        source="the last 9 s", after=SimpleNamespace(baseline=part), worse_forces=""
    )
    config = Config.from_file(ROOT / "config" / "two_imus.yaml")
    found = SimpleNamespace(proof=proof, kept="", config=config, replayed=whole)
    assert [one.words for one in _looks_of_proof(found, ())] == [
        "in the last 9 s, imu_2.y is noisy",
        "in a replay of the whole recording, imu_1.x has 3 spikes",
    ]


def test_settings_that_are_worse_are_not_written(fdi, tmp_path, monkeypatch):
    config = ROOT / "config" / "two_imus.yaml"
    monkeypatch.setattr(Proof, "worse", "28 of 54 biases are isolated instead of 30")
    verb = (
        "calibrate",
        CONE,
        "--config",
        config,
        "--output",
        tmp_path / "made.yaml",
        "--json",
        tmp_path / "j",
    )
    code, out, _ = fdi(*verb)
    assert code == 4
    assert out.startswith(
        "NO BETTER THAN BEFORE: in the last 15 s, 28 of 54 biases are isolated"
    )
    assert "set: nothing" in out
    assert Config.from_file(tmp_path / "made.yaml") == Config.from_file(config)
    figures = json.loads((tmp_path / "j").read_text())
    assert figures["no_better"] == "28 of 54 biases are isolated instead of 30"
    # Its turns are too slow for it, so it is no result.
    nonlinearity = "nonlinearity: not measured; turn faster, both ways about every axis"
    assert nonlinearity in figures["not_found"]
    assert not any("not measured" in line for line in figures["found"])


@pytest.mark.parametrize("turns", [0.0, 1.0])
def test_settings_beside_a_unit_that_repeats_one_value_are_not_for_flight(
    turns, fdi, tmp_path
):
    """Of two units, the second one repeats one value from the first seconds on."""
    time = np.arange(0, 30, 0.01)
    random = np.random.default_rng(3)
    turn = 0.5 * np.clip(time - 6, 0, turns)[:, None]
    turn = turn * np.sin(np.outer(time, (0.7, 1, 2)))
    rates = [turn + random.normal(0, 0.003, turn.shape) for _ in range(2)]
    rates[1][time > 3] = rates[1][300]
    write_mcap(
        tmp_path / "bag.mcap",
        imu_messages(
            START + (time * 1e9).astype(np.int64), np.hstack(rates), TOPICS[:2]
        ),
    )
    made = fdi("setup", tmp_path / "bag.mcap", "--output", tmp_path / "a.yaml")
    assert made.code == 3
    first = made.out.splitlines()[0]
    assert re.match(
        rf"DO NOT USE: {TOPICS[1]} repeats one value for long, in 90 % of the messages, and"
        r" the other units do not\. What to do: check driver and bus, and record again",
        first,
    ), first


def test_the_verdict_names_the_unit_for_which_faults_are_not_found():
    """Without the messages of imu_1 no fault can be isolated."""
    proof = Finding(
        Role.WARNING, "proof", "Few.", headline="USABLE FOR LARGE FAULTS ONLY"
    )
    slow = Finding(
        Role.WARNING,
        "health",
        "imu_1 delivered 33 % of its messages",
        headline="USABLE, BUT LOOK",
        advice="check imu_1",
    )
    assert verdict_of([proof, slow]).words == (
        "USABLE FOR LARGE FAULTS ONLY: Few. Also: imu_1 delivered 33 % of its messages."
        " What to do: check imu_1"
    )
    assert lines_of([proof, slow], Role.WARNING)[1] == (
        "imu_1 delivered 33 % of its messages. What to do: check imu_1"
    )


def test_what_is_at_the_end_of_a_recording_is_learned_too(fdi, tmp_path):
    """In motion from the start, at rest in the last part: only there all biases show."""
    one = vehicle(3, "rest and turns")
    t = (one.block.stamp - one.block.stamp[0]) * 1e-9
    rest = one.block.z[t < 10.0]
    moving = one.block.z[t > 20.0]
    z = np.vstack([moving, rest, rest])
    write_mcap(
        tmp_path / "bag.mcap",
        imu_messages(START + STEP * np.arange(len(z)), z, (*TOPICS, "/third")),
    )
    assert (
        fdi("setup", tmp_path / "bag.mcap", "--output", tmp_path / "made.yaml").code
        == 0
    )
    found = Config.from_file(tmp_path / "made.yaml").bias.fixed
    np.testing.assert_allclose(found, rest.mean(axis=0), atol=5e-4)


UNSHOWN = {
    "short": ["NOT CALIBRATED: the recording is 6.0 s long", "mounts: 1 of 1"],
    "still": [
        "mount unknown, identity assumed: imu_2 (NOT KNOWN: it does not turn",
        "scale factors: not measured (no tu",
    ],
    "array": [
        "DO NOT USE: the axes of the array",
        "the config assumes a cone",
        r"/gy\n\x1b[2Jros",
    ],
    "factor": [
        "DO NOT USE: imu_1 and imu_2 measure different rotations",
        "times the rotation of imu_1",
        "which faults can be isolated is not known",
    ],
}


@pytest.mark.parametrize("shown", UNSHOWN)
def test_what_cannot_be_found_is_said_and_the_config_loads(fdi, tmp_path, shown):
    topics = None
    still = np.random.default_rng(5).normal([0.01, -0.01, 0.0] * 2, 0.002, (1200, 6))
    z = {"factor": flight(2000)[1] * [1, 1, 1, 10, 10, 10], "still": still}.get(
        shown, flight()[1]
    )
    stamp = START + STEP * np.arange(len(z))
    messages = imu_messages(stamp, z)
    if shown == "array":
        # A name that would write a line of its own into the config, or clear the screen.
        topics = {"/gyros": ARRAY, "/gy\n\x1b[2Jros": ARRAY}
        messages = [
            (name, at, array(values.tolist()))
            for at, values in zip(stamp.tolist(), z, strict=True)
            for name in topics
        ]
    bag, file = (
        write_mcap(tmp_path / "bag.mcap", messages, types=topics),
        tmp_path / "own.yaml",
    )
    code, out, _ = fdi("setup", bag, "--output", file)
    assert code == {"still": 0, "short": 4}.get(shown, 3)
    assert ("on the vehicle" in out) == (code != 3)
    assert ("own.yaml (NOT FOR FLIGHT)\n" in out) == (code == 3)
    contradicts = shown == "factor"
    assert ("not done: the channels contradict each other" in out) == contradicts
    page = page_at(tmp_path / "own.html")
    for words in UNSHOWN[shown]:
        assert words in out
        assert words in page
    reason = out.splitlines()[0].partition(": ")[2]
    assert reason not in out.partition("\nWarnings\n")[2].partition("\n\n")[0]
    assert "can be told from all others" not in page
    pipeline = Pipeline.from_config(Config.from_file(file))
    assert pipeline.geometry.n == 6
    assert "NOT KNOWN" in file.read_text()


@pytest.mark.parametrize("how", ["identical", "turned", "scaled", "later"])
def test_one_sensor_on_two_topics_is_no_redundancy(how, fdi, refused, tmp_path):
    z = flight(800)[1]
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    copy = {
        "identical": z[:, :3],
        "turned": z[:, :3] @ turn.T,
        "scaled": 1.01 * z[:, :3],
        "later": z[:, :3],
    }[how]
    copy = np.roll(copy, 4, axis=0) if how == "later" else copy
    stamp = START + STEP * np.arange(800)
    bag = write_mcap(
        tmp_path / "two.mcap", imu_messages(stamp, np.hstack([z[:, :3], copy]))
    )
    words = f"it gives the values of {TOPICS[0]}"
    # Of two topics nothing is left that checks: no settings.
    code, out, _ = fdi("inspect", bag)
    assert (code, out.startswith("NEEDS two Imu topics")) == (3, True)
    assert words in out.splitlines()[0]
    assert f"{TOPICS[1]}: {words}: one sensor on two topics" in refused(
        "setup", bag, "--output", tmp_path / "own.yaml"
    )
    config = write_config(
        tmp_path / "c.yaml",
        {"input": "imus", "sample_rate": 100.0, "imus.topics": list(TOPICS)},
    )
    said = refused(
        "calibrate", bag, "--config", config, "--output", tmp_path / "own.yaml"
    )
    assert (
        f"{TOPICS[1]} gives the values of {TOPICS[0]}: one sensor on two topics is no redundancy"
        in said
    )
    # Of three the copy is left out.
    bag = write_mcap(
        tmp_path / "three.mcap",
        imu_messages(stamp, np.hstack([z, copy]), (*TOPICS, "/third")),
    )
    code, out, _ = fdi("inspect", bag, "--output", tmp_path / "start.yaml")
    assert (code, out.partition(":")[0]) == (3, "NEEDS A LOOK")
    assert f"/third gives the values of {TOPICS[0]}" in out.splitlines()[0]
    assert Config.from_file(tmp_path / "start.yaml").imus.topics == TOPICS
    if how != "later":
        # Setup begins with what was just inspected: the one that is hardest to see stands for all.
        return
    code, out, _ = fdi("setup", bag, "--output", tmp_path / "own.yaml")
    assert code in (3, 4)
    assert f"/third gives the values of {TOPICS[0]}: one sensor on two topics" in out
    assert Config.from_file(tmp_path / "own.yaml").imus.topics == TOPICS


def test_settings_from_heavy_vibration_are_for_large_faults_only(root, tmp_path, fdi):
    """A tenth of a rad/s hides in it, and so do mounts, delays and scale factors."""
    log = root.parent / "shared" / "data" / "logs" / "quad_25mm_cut_hover.bin"
    if not log.exists():
        pytest.skip(f"needs {log}, which is not here")
    config = tmp_path / "made.yaml"
    code, out, _ = fdi("setup", log, "--end", 40, "--output", config)
    first = out.splitlines()[0]
    assert code == 4
    assert first.startswith("USABLE FOR LARGE FAULTS ONLY: no false alarm in the last")
    named = int(re.search(r"Of 18 with 0.1 rad/s, (\d+) were isolated", first)[1])
    assert named <= 16
    assert "mounts: 2 of 2" not in out
    pairs = re.findall(r"(-?[0-9.]+(?:e-?\d+)?) \+- ([0-9.]+(?:e-?\d+)?)", out)
    assert pairs
    assert [pair for pair in pairs if abs(float(pair[0])) < float(pair[1])] == []
    noisy = "times the noise of the other units"
    again = fdi("replay", log, "--config", config, "--end", 40)
    assert (noisy in out) >= (noisy in again.out)


def test_a_unit_that_may_be_the_cause_is_advised_on_alone() -> None:
    findings = [
        Finding(
            Role.WARNING,
            "proof",
            "few were isolated.",
            headline="USABLE FOR LARGE FAULTS ONLY",
            advice="reduce vibration",
        ),
        Finding(
            Role.WARNING,
            "health",
            "imu_1 lost messages",
            headline="USABLE, BUT LOOK",
            advice="check imu_1",
        ),
    ]
    assert verdict_of(findings).words == (
        "USABLE FOR LARGE FAULTS ONLY: few were isolated. Also: imu_1 lost messages."
        " What to do: check imu_1"
    )


def not_better(stuck):
    """New settings that are not kept, and the channels that they declare as stuck."""
    none = dict.fromkeys(TEST_SIZES, (0, 18))
    return SimpleNamespace(
        disagree=None,
        calibration=object(),
        config=Config.from_file(ROOT / "config" / "two_imus.yaml"),
        chosen=(),
        kept="the new settings judge 90 % of the samples instead of 92 %",
        proof=SimpleNamespace(
            source="the last 37 s",
            apart=True,
            before=SimpleNamespace(
                judged=1.0, declared={}, isolated=none, isolated_of=(0, 54)
            ),
            after=SimpleNamespace(stuck=stuck),
        ),
    )


def test_a_channel_that_only_the_new_settings_see_stuck_forbids_their_use():
    (found,) = _worth(not_better({"imu_1.y": 40.0}), RADIANS)
    assert found.headline == "DO NOT USE"
    assert found.words == (
        "imu_1.y repeats one value while the others move, in the last 37 s"
    )


def test_settings_no_better_than_before_do_not_hide_that_no_test_fault_was_isolated() -> (
    None
):
    (proof,) = _worth(not_better({}), RADIANS)
    assert proof.headline == "NO BETTER THAN BEFORE"
    assert proof.words.endswith(
        "Of 54 test faults added there (0.03 to 0.3 rad/s), none was isolated: a faulty"
        " gyro may be detected without being identified."
    )
