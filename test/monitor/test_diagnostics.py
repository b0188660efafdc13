# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the operator is told: never more than is known, in words and figures that can be acted on."""

import json
import re
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag.recordings import STORE
from hypothesis import given, settings
from hypothesis import strategies as st
from monitor.streams import config, declarations, parallel, run, stream, told
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.model.samples import Block
from fdi_ros.monitor.diagnostics import (
    DIAGNOSTICS,
    PREFIX,
    InputStatus,
    Level,
    StatusLine,
    describe,
    encode_diagnostics,
)
from fdi_ros.monitor.output import ChannelState, Reason
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.receiver import SampleRateCheck
from fdi_ros.monitor.recent import RecentHealth
from fdi_ros.monitor.state_file import StateFile
from fdi_ros.monitor.status import ChannelStatus
from fdi_ros.system.text import plus_minus

SECOND = 10**9
INPUT = InputStatus("imu_1", "imu_1/data_raw", 100, 100.0, 0.01, True, max_lag=0.002)


def lost(*start: int) -> list[str]:
    return [f"channel=g{k} kind=dropout start={at}" for k, at in enumerate(start, 1)]


def of_unit(axes: str) -> list[str]:
    return [f"channel=imu_2.{axis} kind=bias size=0.3 start=2" for axis in axes]


WELL = "6 of 6 channels healthy; a fault would be isolated"
LEARNS = "no fused rate: the biases are being learned, at rest; 0"
UNITS = "one of imu_1, imu_2 is faulty, as a whole or in part: undecided"
GONE = ["channel=g2 kind=dropout missing=1 start=2"]
SEQUENTIAL = {"detector__name": "sequential"}


@pytest.mark.parametrize(
    ("monitor", "faults", "name", "level", "words"),
    [
        (config(hardware_id="7"), [], "monitor", Level.OK, WELL),
        (config(), lost(2, 2, 2, 2), "monitor", Level.ERROR, "no fused rate"),
        (
            config(),
            lost(1, 2, 3),
            "monitor",
            Level.ERROR,
            "0 of 6 channels healthy; no further fault would be detected",
        ),
        (config(bias__startup_bias_duration=9.0), [], "monitor", Level.ERROR, LEARNS),
        (
            config(excluded_channels=("g1",)),
            [],
            "g1",
            Level.WARN,
            "taken out by the operator",
        ),
        (config(), GONE, "g2", Level.STALE, "gives no data"),
        # A set of whole units is called by the units.
        (parallel(2, **SEQUENTIAL), of_unit("xyz"), "imu_2.y", Level.ERROR, UNITS),
    ],
)
def test_what_is_said(
    monitor: Config, faults: list[str], name: str, level: Level, words: str
) -> None:
    pipeline = Pipeline(monitor)
    run(pipeline, 600, *faults)
    lines, status = told(pipeline), pipeline.status()
    assert lines[name].level == level
    assert lines[name].message.startswith(words)
    assert status.has_rate == ("no fused rate" not in lines["monitor"].message)
    assert {line.hardware_id for line in lines.values()} == {monitor.hardware_id}
    assert lines["monitor"].level != Level.OK or {
        line.level for line in lines.values()
    } == {Level.OK}
    refused = replace(
        status,
        has_rate=False,
        withheld=False,
        bias_state="refused, not at rest: g1 had mean 0.5 rad/s",
    )
    assert describe(refused)[0].message.startswith(
        f"no fused rate: biases not learned: {refused.bias_state}"
    )
    silent = describe(status, silent=12.4)
    assert {(line.level, line.message) for line in silent} == {
        (Level.STALE, "no sample for 12.4 s")
    }


def test_an_isolated_fault_by_how_much_and_since_when() -> None:
    pipeline = Pipeline(parallel(3))
    run(pipeline, 600, "channel=imu_2.y kind=bias size=0.21 start=2")
    lines = told(pipeline)
    assert pipeline.status().apart is None, "of three units no pair is apart"
    line, values = lines["imu_2.y"], dict(lines["imu_2.y"].values)
    assert (line.level, values["state"]) == (Level.ERROR, "FAULTY")
    error, seconds = line.message.removeprefix("disagrees with the others by ").split(
        " rad/s, for "
    )
    assert float(error) == pytest.approx(0.21, abs=0.01)
    assert seconds.endswith(" s; isolated and left out")
    assert float(seconds.split()[0]) == pytest.approx(4.0, abs=0.15)
    assert abs(float(values["residual (rad/s)"])) == pytest.approx(0.21, abs=0.02)
    assert lines["monitor"].level == Level.WARN
    assert lines["monitor"].message.startswith(
        "8 of 9 channels healthy; a further fault would be"
    )


@pytest.mark.parametrize("detector", ["sequential", "likelihood_ratio"])
@pytest.mark.parametrize("size", [0.03, -0.3])
def test_of_two_parallel_units_the_axis_is_named_and_by_how_much_they_are_apart(
    detector: str, size: float
) -> None:
    pipeline = Pipeline(parallel(2, detector__name=detector))
    run(pipeline, 600, f"channel=imu_2.y kind=bias size={size} start=2")
    lines, pair = told(pipeline), pipeline.status().apart
    assert pair.channels == ("imu_1.y", "imu_2.y")
    assert "no further fault would be isolated" in lines["monitor"].message
    assert (
        abs(pair.size - abs(size))
        < (4 * pair.std if detector == "sequential" else 0.01)
        < 0.02
    )
    apart = (
        f"the y axis of imu_1 or imu_2, {plus_minus(pair.size, pair.std)} rad/s apart"
    )
    assert apart in lines["monitor"].message
    words = f"{apart}: one of the two is faulty, undecided, for "
    for name in pair.channels:
        assert lines[name].level == Level.ERROR
        assert lines[name].message.startswith(words)
        assert dict(lines[name].values)["apart (rad/s)"] in apart


NOTHING_YET = Pipeline(config()).status()


@given(
    st.sampled_from(ChannelState),
    st.sampled_from(Reason),
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(0, 2**62),
)
def test_only_ok_is_ok_and_every_word_is_there(
    state, reason, error, residual, since
) -> None:
    channel = ChannelStatus(
        "g1",
        state,
        reason,
        since,
        ("a", "b"),
        error,
        residual,
        SECOND,
        {"samples": 100},
    )
    status = replace(
        NOTHING_YET, channels=(channel,), stamp=2 * SECOND, samples=5, has_rate=True
    )
    whole, line = describe(status)
    assert (line.level == Level.OK) == (state == ChannelState.OK)
    assert whole.level != Level.OK or state == ChannelState.OK
    for text in (
        whole.message,
        line.message,
        *(value for pair in (*whole.values, *line.values) for value in pair),
    ):
        assert isinstance(text, str)
        assert "nan" not in text.split()
        assert "\n" not in text
    assert line.message


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        ({}, Level.OK, "delivers"),
        (
            {"silent": None, "live": False, "received": 0},
            Level.STALE,
            "no message yet on imu_1/data_raw",
        ),
        ({"silent": 3.2, "live": False}, Level.STALE, "silent for 3.2 s"),
        (
            {"lag": 0.045},
            Level.WARN,
            "stamps are 45.0 ms behind those of the other inputs",
        ),
        ({"lag": 0.0015}, Level.OK, "delivers"),
        ({"offset": 3600.0}, Level.WARN, "stamps are 60 min behind the clock"),
        ({"offset": -5.0}, Level.WARN, "stamps are 5.0 s ahead of the clock"),
        (
            {"offset": 45_333_180.0},
            Level.WARN,
            "525 days behind the clock (of a recording? then use_sim_time",
        ),
        ({"recent": {"backward": 3}}, Level.WARN, "stamps going back: 3"),
        (
            {"recent": {"malformed": 2}, "error": "array has 5 values"},
            Level.WARN,
            "malformed messages: 2; array has 5 values",
        ),
        (
            {"recent": {"ahead": 7}},
            Level.WARN,
            "stamps ahead of the clock, refused: 7",
        ),
        ({"recent": {"interpolated": 9}}, Level.OK, "delivers"),
        (
            {"live": False, "arrives": True, "recent": {"late": 50}},
            Level.STALE,
            "gives no usable message; messages too late",
        ),
    ],
)
def test_inputs(change, level, words) -> None:
    line = describe(NOTHING_YET, inputs=[replace(INPUT, **change)])[-1]
    assert (line.name, line.level) == ("fdi_node: input imu_1", level)
    assert words in line.message
    assert dict(line.values).get("last malformed") == change.get("error")


def test_a_wrong_sample_rate_is_told_once_it_is_measured():
    sampling, count, stamp = SampleRateCheck(10.0), 0, 10**18
    for k, (samples, ms) in enumerate(
        [(100, 1000), (30, 1000), (100, 1000), (99, 1000), (101, 1000), (100, 1000)]
    ):
        assert not sampling.words, k
        sampling.check(count := count + samples, stamp := stamp + ms * 1_000_000)
    assert sampling.words.startswith("samples come at 100 Hz, sample_rate is 10 Hz")
    line = describe(NOTHING_YET, warning=sampling.words)[0]
    assert line.level >= Level.WARN
    assert sampling.words in line.message
    right = SampleRateCheck(100.0)
    for k in range(9):
        right.check(100 * k, 10**9 * (k + 1))
    assert not right.words


CONFIG = Path(__file__).parents[2] / "config/two_imus.yaml"
NOISE = 0.003
BEGIN = 10**18
UNTIL_REST_ENDS = 4.0
LOOSE = {"noise.bias_walk": [2e-4], "bias.max_drift": 0.01}
SET = {"imus.delays": (0.0, 0.001)}
THREE = {
    "imus.topics": ["/a", "/b", "/c"],
    "imus.names": ["a", "b", "c"],
    "imus.mounts": (),
}


def made(**changes: Any) -> Pipeline:
    return Pipeline(
        Config.from_file(CONFIG, {"detector.name": "sequential", **changes})
    )


def rate(t: NDArray[np.float64], rest: float) -> NDArray[np.float64]:
    """Swift turns about all axes, (N, 3) rad/s, up to 10 rad/s^2; at rest before."""
    swing = np.column_stack(
        [np.sin(9 * t), 0.6 * np.cos(11 * t), 0.8 * np.sin(6 * t + 1)]
    )
    return swing * np.clip(t - rest, 0, 1)[:, None]


def flight(
    pipeline: Pipeline,
    seconds: float,
    late: tuple[float, ...] = (),
    rest: float = UNTIL_REST_ENDS,
) -> Block:
    """White noise on units of which each has its values stamped late by so much."""
    t = np.arange(round(100 * seconds)) * 0.01
    axes, late = pipeline.geometry.axes, late or (0.0,) * (pipeline.geometry.n // 3)
    z = np.hstack(
        [rate(t - late[u], rest) @ axes[3 * u : 3 * u + 3].T for u in range(len(late))]
    )
    z += np.random.default_rng(1).normal(0, NOISE, z.shape)
    return Block(BEGIN + np.arange(len(t), dtype=np.int64) * 10**7, z)


@pytest.mark.parametrize(
    ("changes", "late", "delays", "words"),
    [
        (
            {},
            (0.0, 0.004),
            (0.0, 0.004),
            "imu_2 as a whole: its stamps are 4.0 +- 0.2 ms late against imu_1's",
        ),
        (
            {},
            (0.0, -0.004),
            (0.0, -0.004),
            "imu_2 as a whole: its stamps are 4.0 +- 0.2 ms early against imu_1's",
        ),
        (
            SET,
            (0.0, 0.004),
            (0.0, 0.004),
            "imu_2 as a whole: its stamps are 4.0 +- 0.2 ms late against imu_1's",
        ),
        (
            THREE,
            (0.005, 0.0, 0.0),
            (0.0, -0.005, -0.005),
            "a as a whole: its stamps are 5.0 +- 0.1 ms late against",
        ),
        ({}, (0.0, 0.0), (0.0, 0.0), ""),
        (
            {**SET, "detector.name": "likelihood_ratio"},
            (0.0, 0.004),
            (0.0, 0.004),
            "imu_2 as a whole: its stamps are 4.0 +- 0.2 ms late against imu_1's",
        ),
    ],
)
def test_a_late_unit_is_told_with_the_setting_that_takes_it_off(
    changes, late, delays, words
):
    pipeline = made(**changes)
    output = pipeline.process(flight(pipeline, 12, late))
    status, lines = pipeline.status(), told(pipeline)
    message, values = lines["monitor"].message, dict(lines["monitor"].values)
    assert words in message
    assert message.count("stamps") == message.count("as a whole") == bool(words)
    assert status.delays == pytest.approx(delays, abs=3e-4)
    assert delays or values["imu_2: stamps late (ms)"] == "none"
    assert not declarations(pipeline, output) or not delays
    if words:
        assert abs(status.delays[1] - delays[1]) < 4 * status.delay_std[1]
        assert "; the monitor corrects this (to correct it from the start: " in message
        hint = json.loads(message.split("imus.delays: ")[1].rstrip(")"))
        assert hint == pytest.approx(
            np.add(late, changes.get("imus.delays", 0.0)), abs=3e-4
        )
        assert lines["monitor"].level == Level.WARN
        assert {lines[name].level for name in pipeline.channel_names} == {Level.OK}


def test_a_start_in_motion_is_followed_and_what_stays_unknown_is_said():
    pipeline = made()
    block = flight(pipeline, 14, rest=-2.0)
    offset = np.array([0.01, -0.01, 0.0, 0.01, 0.0, -0.005])
    output = pipeline.process(Block(block.stamp, block.z + offset))
    assert output.valid[400:].all(), (
        "it judges and gives a rate after the time of one average"
    )
    assert not declarations(pipeline, output)
    status, seen = pipeline.status(), pipeline.geometry.S @ offset
    assert "the common bias is unknown to 0.02 rad/s" in status.bias_state
    drift, std = (
        np.array([getattr(channel, name) for channel in status.channels])
        for name in ("drift", "bias_std")
    )
    assert np.abs(pipeline.geometry.S @ drift - seen).max() < 0.002, (
        "what the channels see of each other is learned"
    )
    assert status.bias == pytest.approx(drift)
    assert (std < 0.005).all()
    spread = np.sqrt(np.diag(output.covariance[-1]))
    assert (spread >= np.sqrt(np.diag(pipeline.geometry.covariance(0.02**2)))).all(), (
        "the rest is in the covariance"
    )
    value = dict(told(pipeline)["imu_1.x"].values)["of that followed in flight (rad/s)"]
    assert float(value) == pytest.approx(drift[0], rel=1e-3)


def test_a_noisy_channel_is_reported_and_stays_in_use():
    pipeline = made()
    block = flight(pipeline, 18)
    block.z[1200:, 1] += np.random.default_rng(2).normal(0, 8 * NOISE, 600)
    assert not declarations(pipeline, pipeline.process(block))
    status = pipeline.status()
    channel = status.channels[1]
    health = RecentHealth()
    health.add(status, [], 0.0)
    described = describe(status, concerns=health.concerns)
    lines = {line.name.removeprefix(PREFIX): line for line in described}
    warned = {
        name: line.level for name, line in lines.items() if line.level != Level.OK
    }
    assert warned == {"monitor": Level.WARN, "imu_1.y": Level.WARN}
    assert 4 < channel.noise < 9
    words = r"has noise [6-9]\.\d times as large as usual, for [4-6] s now"
    assert re.fullmatch(f"agrees with the others; {words}", lines["imu_1.y"].message)
    assert re.search(f"imu_1.y {words}", lines["monitor"].message)
    assert lines["monitor"].value("verdict") == "LOOK"
    assert channel.state == ChannelState.OK


def test_a_gyro_that_begins_far_off_is_used_and_told_as_it_may_be_faulty():
    learned = {"bias__startup_bias_duration": 1.0, "bias__turn_on_std": 0.01}
    for size, level in ((0.03, Level.OK), (0.08, Level.WARN)):
        pipeline = Pipeline(config(**learned))
        z = 1e-4 * np.random.default_rng(1).standard_normal((600, 6)) + size * (
            np.arange(6) == 1
        )
        pipeline.process(Block(np.arange(600) * SECOND // 100, z))
        lines = told(pipeline)
        assert lines["g2"].level == lines["monitor"].level == level
        assert ("bias of 0.08 rad/s at the start" in lines["g2"].message) == (
            level == Level.WARN
        )
        assert lines["g3"].level == Level.OK


def test_a_bias_that_wanders_off_is_told_before_it_is_a_fault_and_then_by_its_own_name():
    config = Config.from_file(
        CONFIG.with_name("three_imus.yaml"), LOOSE | {"noise.bias_walk": [2e-3]}
    )
    pipeline = Pipeline(config)
    block = flight(pipeline, 120, rest=1e9)
    block.z[500:, 0] += 1.2e-6 * np.arange(len(block.z) - 500)
    assert not declarations(pipeline, pipeline.process(block[:9000]))
    line = told(pipeline)["imu_1.x"]
    assert line.level == Level.WARN
    assert line.message.startswith("agrees with the others; bias has drifted by 0.0")
    assert line.message.endswith("a fault beyond 0.01 (bias.max_drift)")
    pipeline.process(block[9000:])
    status, line = pipeline.status(), told(pipeline)["imu_1.x"]
    assert [c.name for c in status.channels if c.state == ChannelState.FAULTY] == [
        "imu_1.x"
    ]
    assert status.channels[0].reason == Reason.DRIFTED
    assert line.message.startswith(
        "has drifted: its bias is beyond bias.max_drift (0.0"
    )
    assert line.level == Level.ERROR


@pytest.mark.parametrize("count", [2, 3])
def test_a_unit_that_gives_old_values_is_told_within_the_time_for_it(
    count: int,
) -> None:
    pipeline = Pipeline(parallel(count, **SEQUENTIAL))
    block = stream(pipeline.geometry, 1000)
    block.z[700:, 3:6] = block.z[699, 3:6]
    pipeline.process(block[:700])
    assert "frozen" not in str(told(pipeline))
    # After health.stuck_time, 0.2 s, and a quarter more.
    for part in (block[700:725], block[725:]):
        pipeline.process(part)
        lines, words = told(pipeline), "imu_2 frozen: all values have repeated for"
        says = {name for name, line in lines.items() if words in line.message}
        assert says == {"monitor", "imu_2.x", "imu_2.y", "imu_2.z"}
        assert all(lines[name].level >= Level.WARN for name in says)
        assert dict(lines["imu_2.z"].values)["repeats for (s)"]
        assert not dict(lines["imu_1.z"].values)["repeats for (s)"]


def test_what_withholds_the_rate_is_what_is_said() -> None:
    pipeline = Pipeline(parallel(2, **SEQUENTIAL))
    block = stream(pipeline.geometry, 1000)
    block.z[700:] = block.z[699]
    pipeline.process(block)
    line = told(pipeline)["monitor"]
    assert line.level == Level.ERROR
    assert line.message.startswith(
        "no fused rate: withheld, because all channels repeat their values in motion"
    )


def test_followed_biases_outlive_a_restart(tmp_path):
    before, file = made(), StateFile(tmp_path / "state.json", 60.0)
    block = flight(before, 30, rest=-2.0)
    block.z[:, 2] += 0.01
    saved = []
    for k in range(0, len(block.z), 10):
        before.process(block[k : k + 10])
        saved.append(file.save(before))
    assert sum(saved[:100]) > 1, "what was learned in the first seconds is saved"
    assert sum(saved[100:]) < 3, "small changes are not written again and again"
    file.save(before)
    after = made()
    assert StateFile(tmp_path / "state.json", 60.0).restore(after)
    after.process(flight(after, 0.1, rest=-2.0))
    now, then = after.status(), before.status()
    for one, other in zip(now.channels, then.channels, strict=True):
        assert abs(one.drift - other.drift) <= 4 * other.bias_std
    assert now.bias_state == then.bias_state, "the common bias is as unknown as before"
    block = flight(after, 0.1, rest=-2.0)
    output = after.process(Block(block.stamp + SECOND, block.z))
    assert output.valid.all()
    unknown = after.geometry.covariance(0.02**2)
    assert (np.diag(output.covariance[-1]) >= np.diag(unknown)).all(), (
        "and stands in the covariance"
    )


def test_the_walk_since_a_state_was_saved_is_in_what_is_restored(tmp_path):
    path, walk = tmp_path / "state.json", 1e-3
    before, after = (made(**{"noise.bias_walk": [walk]}) for _ in range(2))
    before.process(flight(before, 8))
    StateFile(path, 1e4).save(before)
    path.write_text(
        json.dumps({**json.loads(path.read_text()), "saved": time.time() - 400.0})
    )
    assert StateFile(path, 1e4).restore(after)
    saved, restored = (
        one.detector.states[0]["estimator"]["states"]["p"].diagonal()[:6]
        for one in (before, after)
    )
    assert (restored >= (saved + (walk * 20) ** 2) * (1 - 1e-6)).all()


@pytest.mark.parametrize(
    "copied",
    [
        lambda values: values,
        lambda values: (
            values @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T
        ),
        lambda values: 1.01 * values,
        lambda values: np.vstack([values[:3], values[:-3]]),
    ],
)
@pytest.mark.parametrize("count", [2, 3])
@pytest.mark.parametrize("detector", ["sequential", "likelihood_ratio"])
def test_of_two_topics_of_one_sensor_the_second_is_unchecked_within_five_seconds(
    copied, count, detector
) -> None:
    pipeline = Pipeline(parallel(count, detector__name=detector))
    block = stream(pipeline.geometry, 1500)
    # The sensor of both is off from the start: two against a healthy third.
    block.z[:, 0] += 0.3
    block.z[:, 3:6] = copied(block.z[:, :3])
    block.z[100:110, 4] = np.nan
    output = pipeline.process(block)
    assert (output.state[500:, 3:6] == ChannelState.UNCHECKED).all()
    assert not (output.state[500:, 6:] == ChannelState.FAULTY).any(), (
        "a sensor and its copy outvote no healthy unit"
    )
    if count == 2:
        assert np.isinf(output.level[500:]).all(), (
            "nothing checks the one sensor there is"
        )
    status, lines = pipeline.status(), told(pipeline)
    whole, line = lines["monitor"], lines["imu_2.x"]
    assert not {"imu_2.x", "imu_2.y", "imu_2.z"} & {
        *status.can_detect,
        *status.can_isolate,
    }
    assert whole.level >= Level.WARN
    assert "imu_1 (/imu_1) and imu_2 (/imu_2) give the same values" in whole.message
    assert "imu_3 (" not in whole.message
    assert line.message.startswith(
        "gives the values of another unit: one sensor, no redundancy"
    )
    assert "left out" in line.message


def lossy(z: NDArray[np.float64]) -> None:
    z[:, 6:9] = z[:, 0:3]
    z[np.random.default_rng(1).random(len(z)) < 0.05, 6:9] = np.nan


def impossible(z: NDArray[np.float64]) -> None:
    z[100:400:3, 1], z[50::7, 4], z[60::5, 2] = 1e300, -np.inf, np.nan


def coarse(z: NDArray[np.float64]) -> None:
    z[:] = np.round(z / 0.001) * 0.001


@pytest.mark.parametrize("size", [0.0, 1.0])
@pytest.mark.parametrize("change", [lossy, impossible, coarse, lambda z: None])
def test_copies_are_found_where_messages_are_lost_and_no_others(
    change, size: float
) -> None:
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 1500, size=size)
    change(block.z)
    pipeline.process(block)
    assert pipeline.status().copies == (
        (("imu_1 (/imu_1)", "imu_3 (/imu_3)"),) if change is lossy else ()
    )


def later(z: NDArray[np.float64]) -> None:
    z[3:, 0:3] = z[:-3, 3:6]


def loses(z: NDArray[np.float64]) -> None:
    z[:, 0:3] = z[:, 3:6]
    z[np.random.default_rng(1).random(len(z)) < 0.05, 0:3] = np.nan


@pytest.mark.parametrize("change", [later, loses])
def test_of_two_topics_of_one_sensor_the_later_or_worse_one_is_left_out(change) -> None:
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 600)
    change(block.z)
    output = pipeline.process(block)
    assert pipeline.status().copies == (("imu_2 (/imu_2)", "imu_1 (/imu_1)"),)
    assert not (output.state[400:, 3:] == ChannelState.UNCHECKED).any()


def test_two_units_that_agree_by_chance_now_and_then_are_no_copies() -> None:
    """The noise of both is equal for half a second, every four seconds."""
    pipeline = Pipeline(parallel(3, **SEQUENTIAL))
    block = stream(pipeline.geometry, 1500)
    for begin in range(90, 1500, 400):
        block.z[begin : begin + 50, 3:6] = block.z[begin : begin + 50, 0:3]
    pipeline.process(block)
    assert pipeline.status().copies == ()


TEXTS = st.text(
    st.characters(exclude_characters="\0", exclude_categories=("Cs",)), max_size=9
)
VALUES = st.lists(st.tuples(TEXTS, TEXTS), max_size=3).map(tuple)
LINES = st.builds(StatusLine, st.sampled_from(Level), TEXTS, TEXTS, TEXTS, VALUES)


@settings(max_examples=30)
@given(st.lists(LINES, max_size=3), st.integers(0, 2**31 * 10**9 - 10**9))
def test_diagnostics_are_the_bytes_of_rosbags(
    drawn: list[StatusLine], now: int
) -> None:
    data = encode_diagnostics(drawn, now)
    message = STORE.deserialize_cdr(data, DIAGNOSTICS.type)
    assert bytes(STORE.serialize_cdr(message, DIAGNOSTICS.type)) == data
    assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == now
    for line, read in zip(drawn, message.status, strict=True):
        values = tuple((pair.key, pair.value) for pair in read.values)
        assert line == StatusLine(
            read.level, read.name, read.message, read.hardware_id, values
        )
