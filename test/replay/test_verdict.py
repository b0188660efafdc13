# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording is called healthy only if everything delivered, was checked and agreed."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from bag.recordings import START, imu, imu_messages, write_mcap
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from monitor.streams import RATE, body_rate, parallel, stream, swing
from replay.summaries import summary_of
from replay.test_recurring import episode

from fdi_ros.bag.samples import StepBack
from fdi_ros.config.config import Config
from fdi_ros.config.unit_names import short_names, unit_names
from fdi_ros.core.states import Reason
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.inspection.values import Values
from fdi_ros.model.geometry import Geometry
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.soundness import (
    ChannelHealth,
    RateHealth,
    UnitHealth,
    Word,
    advice_on,
    concerns_of,
    own_noise,
    word_of,
)
from fdi_ros.replay.episodes import Story, join_halves
from fdi_ros.replay.health import WINDOWS, Deliveries, Holes
from fdi_ros.replay.outcomes import FaultEffect, Scores
from fdi_ros.replay.run import Judge, _frozen_when, replay
from fdi_ros.replay.summary import BiasResult, ChannelResult, FarBias
from fdi_ros.replay.verdict import (
    _other_names,
    _without_brief_sets,
    unjudged_words,
    verdict_of,
)
from fdi_ros.replay.words import sentences

CASES = ROOT.parent / "shared" / "data" / "cases"
LOGS = ROOT.parent / "shared" / "data" / "logs"
SITL = ROOT.parent / "shared" / "data" / "sitl"
UNITS = [f"imu_{k}.{axis}" for k in range(3) for axis in "xyz"]
TRIADS = Geometry.from_triads([np.eye(3)] * 3)

needs_cases = pytest.mark.skipif(
    not CASES.is_dir(), reason="../shared/data/cases is not there"
)
needs_sitl = pytest.mark.skipif(
    not SITL.is_dir(), reason="../shared/data/sitl is not there"
)


def test_the_advice_on_unchecked_channels_is_about_the_cause():
    def advice(**first):
        channels = [
            ChannelHealth(name="a.x", unit="a", **first),
            ChannelHealth(name="b.x", unit="b", checked=0.3),
        ]
        (one, *_) = concerns_of(channels)
        assert one.who[-1] == "b.x"
        return one.advice

    assert advice(saturated_s=5.2) == "choose a larger range for a"
    assert "before the values repeat" in advice(checked=0.2, repeated=0.6)
    assert "less vibration" in advice(checked=0.2, repeated=0.02, saturated_s=0.2)


@pytest.mark.parametrize(
    ("began", "lasted", "words"),
    [
        (-19.0, 18.8, "has noise 10 times as large as usual, for 19 s now"),
        (-40.0, 18.8, "had noise 10 times as large as usual for 18.8 s, 40 s ago"),
        (7.0, 18.8, "had noise 10 times as large as usual for 18.8 s, from 7.0 s"),
    ],
)
def test_noise_that_lasts_is_not_some_time_ago(began, lasted, words):
    noisy = ChannelHealth(
        name="a.x", unit="a", noisy_s=lasted, noisy_from_s=began, noisy_times=10.0
    )
    (one,) = concerns_of([noisy, ChannelHealth(name="b.x", unit="b")])
    assert one.words == words


@needs_cases
def test_a_unit_that_slows_to_a_third_is_checked_no_better_than_the_others():
    """The unchecked start is a larger part of its values."""
    channels = replay(CASES / "unit_slows_to_a_third.csv").monitor.channels
    slow = [one.checked for one in channels if one.unit == "imu_1"]
    others = [one.checked for one in channels if one.unit != "imu_1"]
    assert max(slow) < min(others) - 0.02


@needs_cases
@pytest.mark.parametrize(
    ("file", "code", "sentence"),
    [
        (
            CASES / "names_topic1_faulty.mcap",
            3,
            r"FAULTY: imu_1\.y from 15\.\d s\. It is off by 0\.30\d* rad/s\.",
        ),
        (
            CASES / "five_units_fifth_faulty.csv",
            4,
            r"LOOK: .*/imu_4 is left out: .* at most 4 units. What to do: to judge /imu_4 too,"
            r" list the units to judge in a config",
        ),
        (
            CASES / "unit_slows_to_a_third.csv",
            4,
            r"LOOK: .*imu_1 delivered 6\d % of its messages \(from 1[67] s to the end at 16\.7 instead of 50 Hz\)",
        ),
        (
            CASES / "all_saturate_2000dps.csv",
            4,
            r"LOOK: .*imu_0\.z, imu_1\.z and imu_2\.z reached the end of the range for 1\.8 s; .* What to do:"
            r" choose a larger range for imu_0, imu_1 and imu_2;",
        ),
        (
            CASES / "stamps_in_bursts.csv",
            4,
            r"LOOK: no fault .*/imu_1 is left out: its stamps come in bursts of about 5",
        ),
        (
            CASES / "unit_times_eight.csv",
            3,
            r"FAULTY: imu_1, all axes, from \d+\.\d s\. .* First seen at 15\.0 s\.",
        ),
        (
            CASES / "offset_then_other_drops_out.csv",
            3,
            r"FAULTY: imu_1, all axes, from \d+\.\d s\. .* First seen at 15\.0 s\.",
        ),
        (
            CASES / "loose_unit.csv",
            3,
            r"FAULTY: imu_1 from 15\.[01] s\. imu_1 had up to \d+ times the noise of the other"
            r" units, from 1[67]\.\d s on\. .* checked for a loose mounting or replaced\.",
        ),
        (CASES / "mcap_message_zstd", 0, r"HEALTHY: .*9 channels"),
        (CASES / "clean.csv", 0, r"HEALTHY: "),
        (
            LOGS / "quad_25mm_cut_hover.bin",
            0,
            r"HEALTHY: .* 18 channels, each checked in 5\d % of the samples or more\.",
        ),
    ],
    ids=lambda value: value.stem if hasattr(value, "stem") else "",
)
def test_the_first_line_of_a_case(file, code, sentence, fdi, tmp_path):
    told = tmp_path / "told.json"
    said = fdi("replay", file, "--json", told)
    first = said.out.splitlines()[0]
    assert re.match(sentence, first), first
    assert said.code == code
    verdict = json.loads(told.read_text())["verdict"]
    assert (verdict["words"], verdict["word"]) == (first, first.partition(":")[0])


@needs_cases
def test_a_loose_unit_is_one_episode_to_the_end():
    (one,) = replay(CASES / "loose_unit.csv").story.declared
    assert (one.who, one.stands) == ("imu_1", True)
    assert one.channels == ("imu_1.x", "imu_1.y", "imu_1.z")
    assert (one.start_s, one.end_s) == pytest.approx((15.1, 40.0), abs=0.1)


@needs_cases
@pytest.mark.parametrize(
    ("file", "words"),
    [
        (
            CASES / "all_saturate_2000dps.csv",
            "/imu_0 z, /imu_1 z and /imu_2 z reached the end of the range for 1.8 s."
            " What to do: choose a larger range for /imu_0, /imu_1 and /imu_2",
        ),
        (
            CASES / "spikes_5_every_1s.csv",
            "/imu_1 has spikes: 24 in y."
            " What to do: check wiring and power supply of /imu_1",
        ),
        (
            SITL / "calm.tlog",
            "/imu_1, /imu_2 and /imu_3 repeat one value for long, in 67 % of the messages."
            " What to do: check the driver of /imu_1, /imu_2 and /imu_3 if the vehicle moved"
            " meanwhile; at rest, coarse values repeat by themselves",
        ),
    ],
)
def test_inspect_asks_for_a_look_where_a_replay_will(file, words, fdi):
    if not file.exists():
        pytest.skip(f"needs {file}, which is not here")
    result = fdi("inspect", file)
    assert result.out.splitlines()[0] == f"READY, BUT LOOK: {words}"
    assert result.code == 4


@needs_cases
def test_setup_says_once_what_messages_and_its_own_replay_show(fdi, tmp_path):
    case = CASES / "all_saturate_2000dps.csv"
    first = fdi("setup", case, "--output", tmp_path / "a.yaml").out.splitlines()[0]
    assert first.count("reached the end of the range") == 1
    assert first.count("choose a larger range") == 1


@needs_cases
def test_spikes_are_counted_on_their_channel_alone(fdi, tmp_path):
    file, told = CASES / "spikes_5_every_1s.csv", tmp_path / "told.json"
    settings = CASES / "clean_settings.yaml"
    assert fdi("replay", file, "--config", settings, "--json", told).code == 4
    summary = json.loads(told.read_text())
    spikes = {one["name"]: one["spikes"] for one in summary["channels"]}
    assert summary["verdict"]["channels"] == ["imu_1.y"]
    assert 24 <= spikes.pop("imu_1.y") <= 25
    assert set(spikes.values()) == {0}


@needs_cases
def test_injected_spikes_are_said_of_their_channel_alone(fdi):
    settings = CASES / "clean_settings.yaml"
    fault = "channel=imu_1.y kind=spike size=5 rate=1 start=12"
    words = ("--config", settings, "--fault", fault)
    said = fdi("replay", CASES / "clean.csv", *words).out
    lines = said.splitlines()
    assert "No other channel was declared faulty." in lines
    assert re.fullmatch(r"imu_1\.y has \d\d spikes\.", lines[3])
    assert "noisier" not in said


@pytest.mark.parametrize(
    ("topics", "faulty"),
    [
        (["/robot2/imu3/data", "/robot2/imu5/data", "/robot2/imu7/data"], "imu_5"),
        (["/arm/bno055", "/arm/icm42688", "/arm/mpu6050"], "icm42688"),
    ],
)
def test_the_faulty_unit_is_named_after_its_topic(topics, faulty, fdi, tmp_path):
    """The second topic is off by 0.3 rad/s from 12 s on, about y."""
    time = np.arange(0, 20, 0.02)
    random = np.random.default_rng(8)
    turn = 0.4 * np.clip(time - 6, 0, 1)[:, None] * np.sin(np.outer(time, (0.7, 1, 2)))
    messages = []
    for k, topic in enumerate(topics):
        rates = turn + random.normal(0, 0.003, turn.shape)
        rates[(time >= 12) & (k == 1), 1] += 0.3
        for at, rate in zip((time * 1e9).astype(int).tolist(), rates, strict=True):
            messages.append((topic, START + at, imu(START + at, rate)))
    messages.sort(key=lambda one: one[1])
    write_mcap(tmp_path / "bag.mcap", messages)
    said = fdi("replay", tmp_path / "bag.mcap")
    first, second, *_ = said.out.splitlines()
    assert first.startswith(f"FAULTY: {faulty}.y from 12.")
    assert f"{faulty} is {topics[1]}" in second
    assert said.code == 3


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        (
            "kind=stuck start=12",
            "Reason: stuck: repeats one value while the others move.",
        ),
        ("kind=dropout start=12 stop=13", "Reason: not a finite number."),
        ("kind=scale size=-1 start=12", "It does not follow the true rate."),
        ("kind=scale size=0.2 start=12", "It reads 20 % too much."),
        ("kind=scale size=7 start=12", "It reads 8 times the true rate."),
        ("kind=sign start=12", "It reads -1 times the true rate."),
    ],
)
def test_a_fault_is_one_plain_sentence(fault, sentence, fdi, tmp_path):
    """Neither the size of an error that says nothing, nor a power of ten."""
    time = np.arange(0, 24, 0.02)
    random = np.random.default_rng(8)
    turn = 0.8 * np.clip(time - 6, 0, 1)[:, None] * np.sin(np.outer(time, (0.7, 1, 2)))
    injector = Injector([parse_fault(f"channel=imu_1.y {fault}")], UNITS)
    rates = np.hstack([turn + random.normal(0, 0.003, turn.shape) for _ in range(3)])
    struck = injector.apply(Block((time * 1e9).astype(np.int64), rates))
    table = np.column_stack([time, struck.z])
    head = ",".join(["time", *(name.replace(".", "_") for name in UNITS)])
    path = tmp_path / "three.csv"
    np.savetxt(path, table, "%.7f", delimiter=",", header=head, comments="")
    first = fdi("replay", path).out.splitlines()[0]
    assert re.match(r"FAULTY: imu_1\.y .*from 1[2-9]\.\d s", first), first
    size = first.partition(" s. ")[2]
    size, _, advice = size.partition(" Do not fly ")
    assert size.partition(" First seen")[0] == sentence
    assert advice == "before imu_1 is checked or replaced."


def test_the_time_between_the_parts_of_a_recording_counts_as_none(fdi, tmp_path):
    """All clocks are set a day ahead, or two flights are in one recording."""
    time = np.arange(0, 20, 0.02)
    time[500:] += 86400.0
    random = np.random.default_rng(8)
    turn = 0.5 * np.sin(np.outer(np.arange(0, 20, 0.02), (0.7, 1, 2)))
    rates = [turn + random.normal(0, 0.003, turn.shape) for _ in range(3)]
    head = ",".join(["time", *(name.replace(".", "_") for name in UNITS)])
    path = tmp_path / "day.csv"
    table = np.column_stack([time, *rates])
    np.savetxt(path, table, "%.7f", delimiter=",", header=head, comments="")
    first = fdi("replay", path).out.splitlines()[0]
    assert " in 20.0 s (in 2 parts, with 86400.0 s between them)" in first


def residuals(noise, axes):
    """Differences of 4000 samples with some noise from the least-squares rate."""
    random = np.random.default_rng(6)
    errors = random.normal(0.0, 1.0, (4000, len(noise))) * noise
    return errors - errors @ np.linalg.pinv(axes).T @ axes.T


THREE_UNITS = np.tile(np.eye(3), (3, 1))


def test_own_noise_is_that_of_the_channel_and_not_of_its_weight():
    """A loose unit spoils the residuals of all channels, and its own noise alone is large."""
    noise = np.array([0.003] * 3 + [0.28, 0.14, 0.05] + [0.003] * 3)
    found = residuals(noise, THREE_UNITS)
    assert found.std(axis=0).min() > 4 * noise.min()
    assert own_noise(found, THREE_UNITS) == pytest.approx(noise, rel=0.06)
    found[:, 4] = np.nan
    measured = np.isfinite(own_noise(found, THREE_UNITS))
    assert measured.tolist() == [k != 4 for k in range(9)]
    found[:, 1:] = np.nan
    assert np.isnan(own_noise(found, THREE_UNITS)).all()
    still = np.full((50, 9), 1e-160)
    assert np.isnan(own_noise(still, THREE_UNITS)).all()


def test_no_channel_is_free_of_noise_because_the_others_err_alike():
    noise = np.full(9, 0.01)
    common = np.random.default_rng(1).normal(0.0, 0.05, (4000, 3))
    found = residuals(noise, THREE_UNITS)
    found[:, :6] += np.tile(common, 2) / 3
    found[:, 6:] -= common * 2 / 3
    assert own_noise(found, THREE_UNITS).min() > 0.005


def test_of_two_units_neither_is_the_noisy_one():
    axes = THREE_UNITS[:6]
    found = own_noise(residuals(np.repeat([0.01, 0.1], 3), axes), axes)
    assert found[:3] == pytest.approx(found[3:], rel=1e-6)


@needs_cases
def test_one_noise_of_a_loose_unit_whoever_is_asked(fdi, tmp_path):
    """imu_1 shakes by 0.28 rad/s from 15 s to 40 s, the others scatter by 0.0032."""
    loose = CASES / "loose_unit.csv"
    made = tmp_path / "made.yaml"
    outputs = [
        fdi("replay", loose).out,
        fdi("setup", loose, "--output", made).out,
        fdi("replay", loose, "--config", made).out,
        fdi("fleet", loose, "--output", tmp_path / "fleet", "--workers", 1).out,
    ]
    words = r"imu_1 had up to (\d+) times the noise of the other units"
    ratios = [int(one) for out in outputs for one in re.findall(words, out)]
    assert len(ratios) >= 4
    assert all(78 <= ratio <= 95 for ratio in ratios), ratios
    assert re.search(r"imu_0 .* 0\.003\d? ", outputs[0])


def three_units(path, strike):
    """A table of three units that turn, the second one struck: `strike(time, its rates)`."""
    time = np.arange(0, 30, 0.01)
    random = np.random.default_rng(5)
    turn = 0.5 * np.clip(time - 6, 0, 1)[:, None] * np.sin(np.outer(time, (0.7, 1, 2)))
    rates = [turn + random.normal(0, 0.003, turn.shape) for _ in range(3)]
    strike(time, rates[1])
    head = ",".join(["time", *(name.replace(".", "_") for name in UNITS)])
    table = np.column_stack([time, *rates])
    np.savetxt(path, table, "%.7f", delimiter=",", header=head, comments="")
    return path


def freeze(time, rates):
    rates[time > 15] = rates[1500]


def lose_values(time, rates):
    rates[np.random.default_rng(0).random(len(time)) < 0.2, 1] = np.nan


def oscillate(time, rates):
    rates[:, 0] += np.where(time > 15, 0.5 * np.sin(2 * np.pi * 9 * time), 0.0)


@pytest.mark.parametrize(
    ("strike", "sentence"),
    [
        (
            freeze,
            r"FAULTY: imu_1, all axes, from (15|16|17|18|19)\.\d s\. Reason: frozen: has repeated one"
            r" .* At the end, a fault of imu_0 or imu_2 would be seen, but not isolated\."
            r" Do not fly before imu_1 is checked or replaced\.$",
        ),
        (
            lose_values,
            r"FAULTY: imu_1\.y from .*s\. Reason: values come and go\. Do not fly before",
        ),
        (
            oscillate,
            r"FAULTY: .* from 15.* ms\b.* imu_1\.x had \d+ times the noise of the other units, from 1\d\.\d s on\."
            r" Do not fly before imu_1 is checked for a loose mounting or replaced\.$",
        ),
    ],
)
def test_the_verdict_names_what_is_wrong_and_not_what_was_doubted(
    strike, sentence, fdi, tmp_path
):
    out = fdi("replay", three_units(tmp_path / "three.csv", strike)).out
    assert re.match(sentence, out.splitlines()[0]), out


def channel_result(name, **changes):
    """A channel at the end that is fine, but for some changes."""
    fine = ChannelResult(
        name=name,
        unit=name.partition(".")[0],
        measured_in="m/s^2" if "accel" in name else "rad/s",
        state="OK",
        since_s=None,
        reason="",
        residual_rms_rad_s=None,
        noise=None,
        unchecked=0.0,
    )
    return replace(fine, **changes)


def judged(channels, *episodes):
    """The summary of 60 s with some channels and episodes."""
    scores = Scores(6000, 60.0, (), (), FaultEffect(), 0.0, 6000, 6000, 0, ())
    summary = summary_of(scores)
    return replace(
        summary,
        monitor=replace(summary.monitor, channels=tuple(channels)),
        story=Story((), episodes),
    )


NOISY = ("b.x", "b.y", "b.z")


@pytest.mark.parametrize(
    ("candidates", "seconds", "began", "noise", "sentence"),
    [
        (
            ["a.z", "b.z"],
            0.08,
            None,
            10.0,
            "LOOK: no fault lasted in 60.0 s, but b had up to 10 times the noise of the other units."
            " A fault of a set was suspected from 5.0 s, for 80 ms: such noise causes that."
            " What to do: check b for a loose mounting.",
        ),
        (
            ["a.z", "b.z"],
            0.08,
            5.1,
            10.0,
            "FAULTY: a set (undecided) from 5.0 s, for 80 ms. b had up to 10 times the noise of the"
            " other units, from 5.1 s on. Do not fly before b is checked for a loose mounting or replaced.",
        ),
        (
            ["a.z", "c.z"],
            0.08,
            None,
            10.0,
            "FAULTY: a set (undecided) from 5.0 s, for 80 ms. b had up to 10 times the noise of the"
            " other units. Do not fly before a and c are compared at rest and in turns: at least one is faulty.",
        ),
        (
            ["a.z", "b.z"],
            0.08,
            None,
            1.0,  # its settings foresee this noise
            "FAULTY: a set (undecided) from 5.0 s, for 80 ms. b had up to 10 times the noise of the"
            " other units. Do not fly before b is checked for a loose mounting or replaced.",
        ),
        (
            ["a.z", "b.z"],
            2.0,
            None,
            10.0,
            "FAULTY: a set (undecided) from 5.0 s to 7.0 s. Do not fly before a and b are compared"
            " at rest and in turns: at least one is faulty.",
        ),
    ],
)
def test_noise_throughout_explains_brief_sets_of_its_unit(
    candidates, seconds, began, noise, sentence
):
    """No unit beside it is named, and noise that begins is a fault."""
    channels = [
        channel_result(
            f"{unit}.{axis}",
            own_noise_rad_s=0.03 if unit == "b" else 0.003,
            noise=noise if unit == "b" else 1.0,
            noisy_s=20.0 if began and unit == "b" else 0.0,
            noisy_from_s=began or 0.0,
        )
        for unit in "abc"
        for axis in "xyz"
    ]
    summary = judged(channels, episode(5.0, tuple(candidates), seconds))
    assert verdict_of(summary).sentence == sentence


@pytest.mark.parametrize(
    ("frozen", "who"),
    [
        ("accel_", "a, all accelerometers,"),
        ("", "a, all gyros,"),
        (None, "a, all axes,"),
    ],
)
def test_only_the_frozen_sensors_of_a_unit_are_named(frozen, who):
    """Gyros and accelerometers of a unit are often two chips, or two registers of one."""
    names = [
        f"{unit}.{half}{axis}"
        for unit in "abc"
        for half in ("", "accel_")
        for axis in "xyz"
    ]
    struck = [
        name
        for name in names
        if name[0] == "a" and (frozen is None or ("accel" in name) == bool(frozen))
    ]
    why = Reason.FROZEN.value
    channels = [
        channel_result(name, reason=why if name in struck else "") for name in names
    ]
    halves = [
        episode(22.0, own, stands=True)
        for own in (
            tuple(name for name in struck if ("accel" in name) == is_force)
            for is_force in (False, True)
        )
        if own
    ]
    unit_of = {name: name[0] for name in names}
    (one,) = join_halves(halves, unit_of)
    first = verdict_of(judged(channels, one)).sentence
    assert first == (
        f"FAULTY: {who} from 22.0 s. Reason: {why}. Do not fly before a is checked or replaced."
    )


@pytest.mark.parametrize("cut", [1, 7, 5000])
@pytest.mark.parametrize("rate", [2.0, 50.0])
def test_times_without_samples_are_found_however_blocks_are_cut(rate, cut):
    time = np.arange(0.0, 60.0, 1 / rate)
    time = time[((time < 20.0) | (time > 29.3)) & ((time < 40.0) | (time > 40.4))]
    stamp = START + np.round(time * 1e9).astype(np.int64)
    found = Holes()
    for first in range(0, len(stamp), cut):
        found.add(stamp[first : first + cut])
    ((begin, end),) = found.found
    assert (begin - START) * 1e-9 == pytest.approx(20.0, abs=1 / rate + 1e-6)
    assert (end - START) * 1e-9 == pytest.approx(29.3, abs=1 / rate + 1e-6)


@pytest.mark.parametrize(
    ("stream", "said"),
    [
        ({}, []),
        ({"holes": ((20.0, 32.0),)}, []),
        (
            {"holes": ((20.0, 29.3),)},
            ["the recording lacks 9.3 s of all units, from 20.0 s to 29.3 s"],
        ),
        (
            {"lost": True, "holes": ((20.0, 32.0), (40.0, 41.5))},
            [
                "the recording is damaged and lacks 13.5 s of all units, in 2 parts, the first"
                " from 20.0 s to 32.0 s"
            ],
        ),
        (
            {"lost": True},
            [
                "the recording is damaged: some messages are missing, at its end or between"
            ],
        ),
        ({"cut_off": True}, []),
    ],
)
def test_a_recording_that_is_not_whole_is_not_healthy(stream, said):
    """What no unit delivered was not checked, and hides no fault."""
    summary = judged([channel_result("a.x")])
    summary = replace(summary, stream=replace(summary.stream, **stream))
    assert list(map(str, summary.concerns)) == said
    word, sentence, _ = verdict_of(summary)
    assert word == ("LOOK" if said else "HEALTHY")
    cut_off = "no fault was found in 60.0 s, where the recording is cut off; 1 channel"
    assert (cut_off in sentence) == ("cut_off" in stream)


def test_values_that_repeat_for_long_are_said_as_inspect_says_them():
    """What repeats is not checked, also if more than half of the flight was."""
    repeats = [channel_result(f"{unit}.accel_x", repeated=0.24) for unit in "ab"]
    fine = [channel_result("c.accel_x", repeated=0.09), channel_result("a.x")]
    verdict = verdict_of(judged([*repeats, *fine]))
    assert verdict.word == "LOOK"
    assert (
        "a.accel_x and b.accel_x repeated one value for long, in 24 % of the samples."
        " What to do: check the driver of a and b if the vehicle moved meanwhile"
    ) in verdict.sentence
    set_of_them = episode(5.0, ("a.accel_x", "b.accel_x"), stands=True)
    assert not judged([*repeats, *fine], set_of_them).concerns


COUNTERS = ("received", "duplicate", "backward", "jumped", "late", "missing")


@pytest.mark.parametrize(
    ("counts", "back", "said"),
    [
        ({}, None, ""),
        ({"jumped": 10}, None, ""),
        ({"received": 4000, "missing": 2000}, None, ""),
        (
            {"jumped": 3000, "missing": 3000},
            None,
            "has stamps far ahead of those of the other units in 50 % of its messages: these were not used",
        ),
        (
            {"duplicate": 3000},
            None,
            "repeats old stamps in 50 % of its messages: these were not used",
        ),
        (
            {"duplicate": 1, "backward": 1},
            (18.0, 0.04),
            "has stamps that go back by 0.04 s at 18.0 s, as if its clock was set",
        ),
        (
            {"missing": 730},
            None,
            "has stamps so irregular that 12 % of the samples lack its value, though its messages came",
        ),
    ],
)
def test_wrong_stamps_of_a_unit_are_its_trouble_and_not_connection_or_mounting(
    counts, back, said
):
    counters = {
        f"/{unit}": {**dict.fromkeys(COUNTERS, 0), "received": 6000} for unit in "abc"
    }
    counters["/b"] |= counts
    channels = [
        channel_result(
            f"{unit}.{axis}",
            delivered=0.5 if unit == "b" else 1.0,
            own_noise_rad_s=0.03 if unit == "b" else 0.003,
        )
        for unit in "abc"
        for axis in "xyz"
    ]
    loose = replace(episode(18.0, NOISY, stands=True), sets=5)
    any_of_them = episode(18.0, ("a.x", "b.x", "c.x"), stands=True)
    for episodes in ((), (loose,), (any_of_them,)):
        summary = judged(channels, *episodes)
        units = tuple(UnitHealth(name=unit, topic=f"/{unit}") for unit in "abc")
        stream = replace(
            summary.stream,
            alignment=counters,
            steps_back={} if back is None else {"/b": back},
        )
        monitor = replace(summary.monitor, units=units)
        found = verdict_of(replace(summary, monitor=monitor, stream=stream)).sentence
        if said:
            assert f"b {said}" in found
            assert "connection" not in found
            assert "loose" not in found.replace("only then check it for a loose", "")
            work = "before b is checked, first the stamps of its driver, or replaced"
            assert (work in found) == bool(episodes)
        else:
            assert ("connection" in found) == (not episodes)
            assert ("loose" in found) == (any_of_them not in episodes)


def test_stamps_of_all_units_that_repeat_are_the_reason_for_no_verdict():
    """Not too short a recording: none of its stamps is a time."""
    units = tuple(UnitHealth(name=unit, topic=f"/{unit}") for unit in "ab")
    counters = dict.fromkeys(COUNTERS, 0) | {"received": 2000, "duplicate": 1999}
    summary = judged([channel_result("a.x"), channel_result("b.x")])
    bias = replace(summary.monitor.bias, state="learning")
    summary = replace(
        summary,
        scores=replace(summary.scores, samples=1, samples_judged=0),
        monitor=replace(summary.monitor, units=units, bias=bias),
        stream=replace(summary.stream, alignment={"/a": counters, "/b": counters}),
    )
    assert verdict_of(summary).sentence == (
        "CANNOT TELL: none of 1 samples was judged. a and b repeat old stamps in 99.95 % of their"
        " messages: these were not used. What to do: check the driver of a and b: every message"
        " needs the time of its measurement."
    )


def late(delay, std=0.004):
    return UnitHealth(
        name="b", topic="/b", delay_s=delay, delay_std_s=std, delay_to="a"
    )


@pytest.mark.parametrize(
    ("delay", "words"),
    [
        (0.067, "its stamps are 67 ms late against those of a, which looks like noise"),
        (-0.034, "its stamps are 34 ms early against those of a"),
        (0.002, ""),
        (0.011, ""),
    ],
)
def test_noise_of_a_late_unit_is_by_its_delay(delay, words):
    noise = {"a": 0.003, "b": 0.03, "c": 0.003}
    some = [
        ChannelHealth(name=f"{unit}.x", unit=unit, own_noise_rad_s=one)
        for unit, one in noise.items()
    ]
    (one,) = concerns_of(some, [late(delay)])
    assert words in str(one)
    assert ("delay" in one.advice) == bool(words)


@pytest.mark.parametrize("cut", [1, 3, 1000])
@pytest.mark.parametrize(
    ("stamp", "back"),
    [
        (np.arange(0, 400, 20), 0),
        # A clock is set back; messages come twice; one is overtaken.
        (np.r_[0:400:20, 360:800:20], 20),
        (np.r_[0:400:20, 40:800:20], 340),
        (np.repeat(np.arange(0, 400, 20), 2), 0),
        (np.repeat(np.arange(0, 400, 20), 3), 0),
        (np.r_[0:200:20, 220, 200, 240:400:20], 0),
    ],
)
def test_a_clock_that_is_set_back_is_no_message_that_was_overtaken(stamp, back, cut):
    found = StepBack()
    for first in range(0, len(stamp), cut):
        found.add(stamp[first : first + cut])
    assert found.largest == back
    assert found.first == (380 if back else None)


def test_inspect_says_that_a_recording_is_damaged(fdi, tmp_path):
    time = np.arange(0.0, 14.0, 0.02)
    rates = np.random.default_rng(2).normal(0.0, 0.003, (len(time), 6))
    stamp = START + np.round(time * 1e9).astype(np.int64)
    bag = write_mcap(tmp_path / "bag.mcap", imu_messages(stamp, rates))
    data = bytearray(bag.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 4000] = bytes(4000)
    bag.write_bytes(data)
    first = fdi("inspect", bag).out.splitlines()[0]
    assert first.startswith("READY, BUT LOOK: the recording is damaged")


def test_other_faults_are_told_apart_though_their_words_have_commas():
    gyros = "one of the gyros (all but imu_1.x, imu_2.y and imu_3.y)"
    axis = "the z axis of imu_1, imu_2 or imu_3"
    assert _other_names(["imu_1.x"]) == "imu_1.x"
    assert _other_names([gyros, axis]) == f"{gyros} and {axis}"
    assert _other_names(["imu_1.x", axis, "imu_4"]) == f"imu_1.x; {axis}; imu_4"
    assert _other_names(["imu_1.x", "imu_2.x", "imu_4"]) == "imu_1.x, imu_2.x, imu_4"


def test_a_brief_set_asks_for_nothing_beside_a_fault_that_lasts():
    def episode(state, seconds, stands):
        return SimpleNamespace(
            state=state, since_s=5.0, end_s=5 + seconds, stands=stands
        )

    brief = episode("AMBIGUOUS", 0.02, False)
    lasting = [
        episode("FAULTY", 9.0, True),
        episode("AMBIGUOUS", 0.5, True),
        episode("AMBIGUOUS", 2.0, False),
        episode("FAULTY", 0.1, False),
    ]
    for one in lasting:
        assert _without_brief_sets([one, brief]) == [one]
    assert _without_brief_sets([brief, brief]) == [brief, brief]


def test_delays_in_the_table_and_in_the_notes_have_one_reference(fdi, tmp_path):
    """The stamps of the first unit are 20 ms late, so both refer to another one."""
    table = np.loadtxt(
        three_units(tmp_path / "three.csv", lambda time, rates: None),
        delimiter=",",
        skiprows=1,
    )
    table[2:, 1:4] = table[:-2, 1:4]
    head = ",".join(["time", *(name.replace(".", "_") for name in UNITS)])
    late = tmp_path / "late.csv"
    np.savetxt(late, table, "%.7f", delimiter=",", header=head, comments="")
    out = fdi("replay", late).out
    (reference,) = re.findall(r"delay to (imu_\d)", out)
    noted = re.findall(
        r"(imu_\d) as a whole: its stamps are .* late against (.*)'s", out
    )
    assert ("imu_0", reference) in noted
    row = next(line for line in out.splitlines() if line.startswith("  imu_0 "))
    late_ms = re.search(r"(-?[\d.]+) ms", row)
    assert late_ms is not None
    assert float(late_ms[1]) == pytest.approx(20.0, abs=2.0)


@pytest.mark.parametrize(("faulty", "word"), [(False, "LOOK"), (True, "FAULTY")])
@pytest.mark.parametrize("log_too", [False, True])
def test_the_first_line_says_that_clocks_were_set(log_too, faulty, word, fdi, tmp_path):
    """Messages have two times: of recording, which orders them, and the stamp inside."""
    time = np.arange(0, 30, 0.02)
    random = np.random.default_rng(3)
    turn = 0.5 * np.clip(time - 6, 0, 1)[:, None] * np.sin(np.outer(time, (0.7, 1, 2)))
    rates = [turn + random.normal(0, 0.003, turn.shape) for _ in range(3)]
    if faulty:
        rates[1][time > 22, 1] += 0.5
    recorded = START + np.round(time * 1e9).astype(np.int64)
    stamp = np.where(time > 15, recorded - 5 * 10**9, recorded)
    topics = [f"/imu_{k}/data_raw" for k in range(3)]
    messages = imu_messages(stamp, np.hstack(rates), topics)
    if not log_too:
        times = np.repeat(recorded, 3).tolist()
        messages = [
            (topic, at, data)
            for at, (topic, _, data) in zip(times, messages, strict=True)
        ]
    bag = write_mcap(tmp_path / "bag.mcap", messages)
    first = fdi("replay", bag).out.splitlines()[0]
    words = "the clocks of all units were set back by 4.98 s during the recording"
    assert first.startswith(f"{word}: ")
    assert words in first.replace("The", "the")
    inspected = fdi("inspect", bag).out.splitlines()[0]
    assert "go back by up to 4.98 s: a clock was set" in inspected


# Deliveries and values


def tapped(times, topics, width=1.0):
    """The deliveries of topics whose messages come at times (s)."""
    deliveries = Deliveries(topics)
    order = np.argsort(np.concatenate(times), kind="stable")
    stamp = (np.concatenate(times)[order] * 1e9).astype(np.int64)
    topic = np.repeat(np.arange(topics), [len(one) for one in times])[order]
    for rows in np.array_split(np.arange(len(stamp)), 7):
        batch = SimpleNamespace(log_time=stamp[rows], topic=topic[rows])
        deliveries.tap(batch, np.arange(len(rows)))
    return deliveries.result()


def test_a_topic_whose_messages_come_only_at_the_end_delivered_nothing():
    steady = np.arange(0.0, 60.4, 0.02)
    _, late = tapped([steady, np.array([60.3, 60.35])], 2)
    assert late.share == 0.0


@given(st.sampled_from([20.0, 50.0, 200.0]), st.integers(0, 99), st.floats(0.75, 1.0))
def test_times_of_arrival_about_the_edges_of_windows_lose_no_message(rate, seed, part):
    """The windows begin with the first message, and so do those of a rate in whole Hz."""
    random = np.random.default_rng(seed)
    steady = np.arange(0.0, 40.0, 1 / rate) + 0.001
    times = [steady + np.abs(random.normal(0.0, 3e-4, len(steady))) for _ in range(3)]
    times.append(times[0][random.uniform(size=len(steady)) < part])
    *whole, some = tapped(times, 4)
    assert min(one.share for one in whole) > 0.99
    assert some.share == pytest.approx(part, abs=0.05)


@given(st.floats(10.0, 400.0), st.floats(0.0, 0.45), st.integers(20, 50))
def test_a_unit_that_slows_down_is_seen_and_the_others_are_not(rate, left, after):
    steady = np.arange(0.0, 90.0, 1 / rate)
    slow = steady[(steady < after) | (np.arange(len(steady)) * left % 1.0 < left)]
    whole, part = tapped([steady, slow], 2)
    assert whole.share > 0.95
    assert whole.slow_from is None
    assert part.share == pytest.approx(len(slow) / len(steady), abs=0.08)
    assert part.slow_from == pytest.approx(after, abs=40 / rate + 2.0)
    assert part.slow_rate == pytest.approx(left * rate, abs=0.1 * rate)


@given(st.floats(20.0, 200.0), st.floats(0.3, 1.0))
def test_what_the_recorder_loses_of_all_units_is_no_fault_of_one(rate, ratio):
    """Units of different rates, a hole in both, and a start and an end apart."""
    times = [np.arange(0.0, 60.0, 1 / rate), np.arange(3.0, 59.5, 1 / (ratio * rate))]
    times = [one[(one < 20.0) | (one > 31.0)] for one in times]
    for delivery in tapped(times, 2):
        assert delivery.share > 0.9
        assert delivery.slow_from is None


@given(st.floats(20.0, 400.0), st.floats(0.0, 0.4), st.integers(0, 9))
def test_messages_lost_at_random_are_missing(rate, lost, seed):
    """No second has them all, so counts alone do not show the usual rate."""
    steady = np.arange(0.0, 60.0, 1 / rate)
    left = steady[np.random.default_rng(seed).random(len(steady)) >= lost]
    whole, part = tapped([steady, left], 2)
    assert whole.share > 0.95
    assert part.share == pytest.approx(len(left) / len(steady), abs=0.04)
    assert part.rate == pytest.approx(rate, rel=0.05)


@given(st.floats(20.0, 200.0), st.floats(0.0, 3.0), st.integers(0, 9))
def test_messages_that_arrive_irregularly_are_all_there(rate, spread, seed):
    """Delays of up to some intervals shorten half of the intervals, and lose nothing."""
    steady = np.arange(0.0, 60.0, 1 / rate)
    delay = np.random.default_rng(seed).exponential(spread / rate, len(steady))
    whole, late = tapped([steady, np.sort(steady + delay)], 2)
    assert whole.share > 0.9
    assert late.share > 0.9


def test_memory_of_deliveries_does_not_grow_with_the_recording():
    long = np.arange(0.0, 3.0 * WINDOWS.most, 0.5)
    (delivery,) = tapped([long], 1)
    assert delivery.share > 0.99
    assert delivery.rate == pytest.approx(2.0, rel=0.01)


@pytest.mark.parametrize("cut", [1, 7, 5000])
def test_the_end_of_a_range_is_counted_however_blocks_are_cut(cut):
    random = np.random.default_rng(4)
    time = np.arange(5000) * 0.01
    body = 0.7 * np.sin(time[:, None] * [1.0, 1.3, 0.4])
    z = np.tile(body, 3) + random.normal(0.0, 0.003, (5000, 9))
    z[1000:1200, 0] = 8.0
    values = Values(TRIADS.n)
    for first in range(0, 5000, cut):
        values.add(z[first : first + cut])
    assert values.saturated.tolist() == [200] + 8 * [0]


def test_concerns_name_what_is_wrong_and_nothing_else():
    fine = [ChannelHealth(name=f"a.{axis}", unit="a") for axis in "xyz"]
    assert concerns_of(fine, [UnitHealth(name="a", topic="/a")]) == []
    bad = ChannelHealth(name="b.x", checked=0.4, spikes=5)
    copy = UnitHealth(name="c", topic="/c", copy_of="a")
    assert [str(one) for one in concerns_of([*fine, bad], [copy])] == [
        "b.x could be checked in only 40 % of the samples",
        "c repeats the values of a: one sensor, no redundancy",
        "b.x has 5 spikes",
    ]
    never = ChannelHealth(name="b.x", checked=0.0)
    assert str(concerns_of([never])[0]) == "b.x could not be checked"


def test_a_fault_ends_with_its_last_wrong_value():
    """The monitor uses the channel again only some seconds later."""
    settings = {"detector__name": "sequential", "decision__latch": False}
    pipeline = Pipeline(parallel(3, **settings))
    block = stream(pipeline.geometry, 1800)
    block.z[800:1000, 4] = np.nan
    judge = Judge(pipeline, Injector((), pipeline.channel_names))
    judge.injector.start_stamp = int(block.stamp[0])
    judge.take(block)
    found = judge.judgement()
    (one,) = found.story.declared
    assert one.end_s > 12.0
    assert one.wrong_to_s == pytest.approx(10.0, abs=0.1)
    words = "FAULTY: imu_2.y from 8.1 s to 10.0 s. Reason: not a finite number."
    assert words in verdict_of(found).sentence


def test_a_rate_that_is_missing_says_that_all_units_repeated_one_value():
    channels = [ChannelHealth(name=name, unit=name[:5]) for name in UNITS]
    rate = RateHealth(missing_s=3.9, missing_from_s=8.1)
    monitor = SimpleNamespace(channels=channels, rate=rate)
    evidence = SimpleNamespace(reason=Reason.FROZEN.value)
    episodes = [
        SimpleNamespace(
            channels=tuple(UNITS[k : k + 3]), start_s=8.1, evidence=evidence
        )
        for k in (0, 3, 6)
    ]
    units = _frozen_when(monitor, SimpleNamespace(episodes=episodes))
    assert units == ("imu_0", "imu_1", "imu_2")
    assert _frozen_when(monitor, SimpleNamespace(episodes=episodes[1:])) == ()
    (missing,) = concerns_of([], rate=replace(rate, frozen=units))
    assert missing.words.endswith("when imu_0, imu_1 and imu_2 repeated one value")
    assert missing.advice.startswith("check the driver of imu_0, imu_1 and imu_2 if")
    # One that goes on measuring is another cause.
    (missing,) = concerns_of([], rate=rate)
    assert missing.advice.startswith("see in the report")


def test_the_advice_on_what_is_left_out_helps_against_its_reason():
    reasons = [
        ("/imu_4", "a config has at most 4 units"),
        ("the last 45 % of a.csv", "the time steps back before it"),
        ("/imu_2", "no message in which all values are finite and below 1000000 rad/s"),
    ]
    assert [one.advice for one in concerns_of([], unused=reasons)] == [
        "to judge /imu_4 too, list the units to judge in a config (--config)",
        "judge the last 45 % of a.csv as a file of its own, and let the logger begin a new file"
        " after a restart",
        "to judge /imu_2 too, mend the cause",
    ]


def test_a_bias_beyond_any_healthy_one_is_said_with_its_size_and_the_limit():
    far = [FarBias("a.y", 0.1103, 0.08, "rad/s"), FarBias("b.x", 0.0912, 0.08, "rad/s")]

    def words(*some):
        names = tuple(one.channel for one in some)
        scores = SimpleNamespace(samples=9, samples_judged=9)
        bias = BiasResult("learned", (), names, some)
        return unjudged_words(
            SimpleNamespace(scores=scores, monitor=SimpleNamespace(bias=bias))
        )

    assert words(far[0]).startswith(
        "a.y began with a bias of 0.11 rad/s, and 0.08 rad/s is the most for a healthy sensor"
    )
    assert "a.y and b.x began with biases of up to 0.11 rad/s" in words(*far)


@pytest.mark.parametrize(
    ("scales", "said"),
    [
        ((0.0, 0.0, 0.0), []),
        ((-0.06, 0.12, -0.06), ["b.x reads about 12 % too much"]),
        ((0.0, -0.08, 0.0), ["b.x reads about 8 % too little"]),
        ((0.05, -0.05, 0.0), ["a.x and b.x have scale factors that differ by 10 %"]),
    ],
)
def test_wrong_scale_factors_are_those_of_the_odd_one_or_of_two_that_differ(
    scales, said
):
    some = [
        ChannelHealth(name=f"{unit}.x", unit=unit, scale=scale)
        for unit, scale in zip("abc", scales, strict=True)
    ]
    assert [str(one) for one in concerns_of(some)] == said


def test_a_channel_that_the_operator_took_out_is_no_open_suspicion(tmp_path):
    config = tmp_path / "out.yaml"
    settings = (ROOT / "config" / "two_imus.yaml").read_text()
    out = "ros__parameters:\n    excluded_channels: [imu_2.y]\n"
    config.write_text(settings.replace("ros__parameters:\n", out))
    result = replay(ROOT / "bags" / "cone_flight", config)
    assert result.verdict.word == "LOOK"
    assert result.verdict.sentence.endswith(
        "imu_2.y remained left out: taken out by the operator. What to do: shorten"
        " excluded_channels to use all channels of imu_2."
    )


def test_what_to_do_is_said_once_for_each_kind_of_trouble():
    some = [
        ChannelHealth(name="a.x", unit="a", spikes=5),
        ChannelHealth(name="a.y", unit="a", spikes=7),
        ChannelHealth(name="b.accel_z", unit="b", saturated_s=2.0, spikes=4),
    ]
    assert advice_on(concerns_of(some)) == (
        "choose a larger range for b; check wiring and power supply of a and b"
    )


def test_gyros_whose_biases_move_far_are_named_though_nothing_is_declared():
    """A monitor follows what may be a change of all biases, and goes on without a declaration."""
    some = [
        ChannelHealth(name="a.x", unit="a", drift=-0.031),
        ChannelHealth(name="a.y", unit="a", drift=0.026),
        ChannelHealth(name="b.y", unit="b", drift=0.019),
        ChannelHealth(name="b.accel_z", unit="b", measured_in="m/s^2", drift=0.5),
    ]
    (one,) = concerns_of(some)
    assert str(one) == (
        "a.x and a.y have biases that moved by up to 0.031 rad/s since the start at rest"
    )
    assert word_of([one]) is Word.LOOK
    assert one.advice.startswith("let a warm up before the flight")


def test_the_gyros_that_drift_before_a_real_crash_are_named(fdi, tmp_path):
    """IMU 1 warms by 10 K and drifts to 26 and -31 mrad/s; the vehicle crashes at 75 s."""
    log = LOGS / "quad_imu0_warms_and_crashes.bin"
    if not log.exists():
        pytest.skip(f"the recorded data is not there: ../shared/data/logs/{log.name}")
    result = fdi("replay", log)
    first = result.out.splitlines()[0]
    assert first.startswith("FAULTY: imu_1, x and y, from 40")
    assert "imu_2" not in first
    assert "imu_3" not in first
    first = fdi("setup", log, "--output", tmp_path / "a.yaml").out.splitlines()[0]
    moved = re.search(r"bias of imu_1.x and imu_1.y moved by up to (\S+) rad/s", first)
    assert 0.025 < float(moved[1]) < 0.032


@pytest.mark.parametrize("word", [Word.LOOK, Word.CANNOT_TELL])
def test_a_verdict_that_is_not_clear_says_what_to_do(word, fdi, tmp_path):
    """A unit with a third of its messages; and a recording of two seconds."""
    time = np.arange(0, 30 if word is Word.LOOK else 2, 0.02)
    random = np.random.default_rng(8)
    turn = 0.4 * np.clip(time - 6, 0, 1)[:, None] * np.sin(np.outer(time, (0.7, 1, 2)))
    messages = []
    for k in range(3):
        rates = turn + random.normal(0, 0.003, turn.shape)
        for n, (at, rate) in enumerate(
            zip((time * 1e9).astype(int), rates, strict=True)
        ):
            if k != 1 or n < 600 or n % 3 == 0:
                stamp = START + int(at)
                messages.append((f"/imu_{k}", stamp, imu(stamp, rate)))
    messages.sort(key=lambda one: one[1])
    write_mcap(tmp_path / "bag.mcap", messages)
    said = fdi("replay", tmp_path / "bag.mcap")
    first = said.out.splitlines()[0]
    what = "check connection, driver and bus load of imu_1"
    if word is Word.CANNOT_TELL:
        what = "record for longer, with some seconds of rest at the start"
    assert first.startswith(f"{word.value}: ")
    assert first.endswith(f" What to do: {what}.")


BIASES = {
    105.0: "imu_3.z",
    129.2: "imu_2.y",
    153.3: "imu_2.z",
    177.4: "imu_3.x",
    201.5: "imu_1.y",
    225.5: "imu_2.x",
    249.5: "imu_3.y",
    273.6: "imu_1.z",
    297.7: "imu_2.x",
    321.9: "imu_1.x",
}
"""Onset, s from the first message, and channel of the simulated biases of 0.01 to 0.3 rad/s."""


@needs_sitl
def test_ten_biases_of_one_flight_are_named_and_no_other_channel():
    # A log has topics without /data_raw, and this one half the rate that the node asks for.
    topics = tuple(f"imu_{k}" for k in (1, 2, 3))
    changes = {"imus.topics": topics, "sample_rate": 25.0}
    config = Config.from_file(ROOT / "config" / "ardupilot.yaml", changes)
    story = replay(SITL / "biases.tlog", config).story
    named = [one.channels for one in story.episodes if one.state == "FAULTY"]
    assert named == [(channel,) for channel in BIASES.values()]
    assert len(story.episodes) == len(BIASES)
    for one, onset in zip(story.episodes, BIASES, strict=True):
        assert 0.0 <= one.since_s - onset < 3.0
        assert all(step.state != "FAULTY" for step in one.steps[:-1])


@needs_sitl
def test_a_log_in_which_all_values_repeat_for_long_is_not_healthy():
    result = replay(SITL / "calm.tlog", end=60.0)
    assert result.verdict.word == "CANNOT TELL"
    assert 33.0 < result.monitor.rate.missing_s < 35.0
    assert result.monitor.rate.missing_from_s == pytest.approx(10.0, abs=0.1)
    concerns = list(map(str, result.concerns))
    assert (
        "the fused rate was not published for 34 s, for the first time at 10.0 s, when imu_1,"
        " imu_2 and imu_3 repeated one value"
        in [re.sub(r"33\.\d|34\.\d", "34", one) for one in concerns]
    )
    assert any("imu_1 is SCALED_IMU" in line for line in sentences(result))
    assert result.context.modes[0].name == "STABILIZE"
    assert result.monitor.units[0].temperature_c == pytest.approx((25.0, 32.8), abs=0.1)


@pytest.mark.parametrize(
    ("missing", "share", "word"),
    [(0.9, 0.99, None), (34.0, 0.77, Word.LOOK), (34.0, 0.4, Word.CANNOT_TELL)],
)
def test_a_flight_without_a_rate_for_long_is_not_healthy(missing, share, word):
    fine = [ChannelHealth(name=f"a.{axis}", unit="a") for axis in "xyz"]
    concerns = concerns_of(fine, rate=RateHealth(missing, 10.0, share))
    if word is None:
        assert concerns == []
        return
    (one,) = concerns
    assert (one.word, word_of(concerns)) == (word, word)
    assert (
        str(one)
        == "the fused rate was not published for 34 s, for the first time at 10.0 s"
    )


def test_three_axes_of_a_sensor_have_one_name():
    names = [f"imu_0.{axis}" for axis in "xyz"] + ["imu_0.accel_x"]
    assert short_names(names) == ["imu_0", "imu_0.accel_x"]
    assert short_names(["imu_1.accel_x", "imu_1.accel_y", "imu_1.accel_z"]) == [
        "imu_1.accel"
    ]
    assert short_names(["g1", "g2", "g3", "imu_0.y"]) == ["g1", "g2", "g3", "imu_0.y"]


# Names


@pytest.mark.parametrize(
    ("topics", "names"),
    [
        (
            ["/imu_0/data_raw", "/imu_1/data_raw", "/imu_2/data_raw"],
            "imu_0 imu_1 imu_2",
        ),
        (["/imu2", "/imu3", "/imu7"], "imu_2 imu_3 imu_7"),
        (["/drone1/imu_4/data", "/drone1/imu_5/data"], "imu_4 imu_5"),
        (["/front/imu", "/rear/imu"], "front rear"),
        (["/front_imu_1", "/rear_imu_2"], "imu_1 imu_2"),
        (["/mavros1/imu", "/mavros3/imu"], "mavros1 mavros3"),
        (["/robot1/imu_4", "/robot2/imu_5"], "imu_4 imu_5"),
        (["/gyro_1", "/gyro_2"], "gyro_1 gyro_2"),
        (["/bno055/data", "/icm42688/data"], "bno055 icm42688"),
        (["/imu", "/imu/backup"], "imu backup"),
        (["/camera/imu", "/mavros/imu/data_raw"], "camera_imu mavros_imu_data_raw"),
    ],
)
def test_units_are_named_as_their_topics(topics, names):
    assert unit_names(topics) == names.split()


@given(
    st.lists(
        st.from_regex(r"(/[a-z][a-z0-9_]{0,6}){1,3}", fullmatch=True),
        min_size=2,
        max_size=4,
        unique=True,
    )
)
def test_names_are_unique_whatever_the_topics(topics):
    names = unit_names(topics)
    assert len(set(names)) == len(topics)
    assert all(re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) for name in names)


@pytest.mark.parametrize(
    ("units", "share", "place", "words"),
    [
        (3, 0.06, 4, "imu_2.y reads about 6 % too much"),
        (4, 0.12, 9, "imu_4.x reads about 12 % too much"),
        (2, 0.12, 4, "imu_1.y and imu_2.y have scale factors that differ by 12 %"),
        (3, 0.02, 4, ""),
    ],
)
def test_a_wrong_scale_factor_is_no_noise(units, share, place, words):
    """The estimator learns a small one, and takes a part of a larger one for noise."""
    settings = {"detector__name": "sequential", "noise__scale_std": 0.01}
    pipeline = Pipeline(parallel(units, **settings))
    block = stream(pipeline.geometry, 2500)
    motion = 0.6 * swing(np.arange(2500) / RATE)
    block.z[:] += (motion - body_rate(2500)) @ pipeline.geometry.axes.T
    block.z[:300] -= motion[:300] @ pipeline.geometry.axes.T
    block.z[:, place] *= 1.0 + share
    judge = Judge(pipeline, Injector((), pipeline.channel_names))
    judge.injector.start_stamp = int(block.stamp[0])
    judge.take(block)
    concerns = concerns_of(judge.judgement().monitor.channels)
    assert [str(one) for one in concerns] == [words] * bool(words)
