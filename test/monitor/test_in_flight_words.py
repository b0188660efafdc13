# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is said of units as a whole, of biases that wander and of noise in flight, and what outlives a restart of it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from monitor.streams import parallel, stream, struck
from numpy.typing import NDArray

from fdi_ros.config.config import Config
from fdi_ros.model.block import Block
from fdi_ros.monitor.diagnostics import Level, StatusLine, describe
from fdi_ros.monitor.output import ChannelState, Output, Reason
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.state_file import StateFile

CONFIG = Path(__file__).parents[2] / "config/two_imus.yaml"
NOISE = 0.003
BEGIN = 10**18
UNTIL_REST_ENDS = 4.0
LOOSE = {"noise.bias_walk": [2e-4], "bias.max_drift": 0.01}


def made(**changes: Any) -> Pipeline:
    return Pipeline(Config.from_file(CONFIG, {"detector.name": "sequential", **changes}))


def rate(t: NDArray[np.float64], rest: float) -> NDArray[np.float64]:
    """Swift turns about all axes, (N, 3) rad/s, up to 10 rad/s^2; at rest before."""
    swing = np.column_stack([np.sin(9 * t), 0.6 * np.cos(11 * t), 0.8 * np.sin(6 * t + 1)])
    return swing * np.clip(t - rest, 0, 1)[:, None]


def flight(pipeline: Pipeline, seconds: float, late: tuple[float, ...] = (), rest: float = UNTIL_REST_ENDS) -> Block:
    """White noise on units of which each has its values stamped late by so much."""
    t = np.arange(round(100 * seconds)) * 0.01
    axes, late = pipeline.geometry.axes, late or (0.0,) * (pipeline.geometry.n // 3)
    z = np.hstack([rate(t - late[u], rest) @ axes[3 * u : 3 * u + 3].T for u in range(len(late))])
    z += np.random.default_rng(1).normal(0, NOISE, z.shape)
    return Block(BEGIN + np.arange(len(t), dtype=np.int64) * 10**7, z)


def later(block: Block, seconds: float) -> Block:
    return Block(block.stamp + round(1e9 * seconds), block.z)


def lines_of(pipeline: Pipeline) -> dict[str, StatusLine]:
    return {line.name.removeprefix("fdi_node: "): line for line in describe(pipeline.status())}


def declared(output: Output) -> bool:
    return bool(((output.state == ChannelState.FAULTY) | (output.state == ChannelState.AMBIGUOUS)).any())


@pytest.mark.parametrize(
    ("late", "set_before", "words"),
    [
        (0.004, (), "imu_2 as a whole: its stamps are 4.0 +- 0.1 ms late against imu_1's"),
        (-0.004, (), "imu_2 as a whole: its stamps are 4.0 +- 0.1 ms early against imu_1's"),
        (0.004, (0.0, 0.001), "imu_2 as a whole: its stamps are 4.0 +- 0.1 ms late against imu_1's"),
    ],
)
def test_a_late_unit_is_told_with_the_setting_that_takes_it_off(late, set_before, words):
    pipeline = made(**{"imus.delays": set_before})
    assert not declared(pipeline.process(flight(pipeline, 12, (0.0, late))))
    status, lines = pipeline.status(), lines_of(pipeline)
    assert status.delays == pytest.approx((0.0, late), abs=3e-4)
    assert status.delay_std[0] == 0.0
    assert abs(status.delays[1] - late) < 4 * status.delay_std[1]
    assert lines["monitor"].level == Level.WARN
    assert words in lines["monitor"].message
    hint = json.loads(lines["monitor"].message.split("imus.delays: ")[1].rstrip(")"))
    assert hint == pytest.approx([0.0, late + sum(set_before)], abs=3e-4)
    shown, std = dict(lines["monitor"].values)["imu_2: stamps late (ms)"].split(" +- ")
    assert float(shown) == pytest.approx(1e3 * late, abs=0.3)
    assert 0 < float(std) < 0.3
    assert {lines[name].level for name in pipeline.channel_names} == {Level.OK}


def test_of_three_units_the_odd_one_is_told_even_if_it_is_the_first():
    pipeline = made(**{"imus.topics": ["/a", "/b", "/c"], "imus.names": ["a", "b", "c"], "imus.mounts": ()})
    pipeline.process(flight(pipeline, 12, (0.005, 0.0, 0.0)))
    message = lines_of(pipeline)["monitor"].message
    assert "a as a whole: its stamps are 5.0 +- 0.1 ms late against" in message
    assert message.count("as a whole") == 1
    assert pipeline.status().delays == pytest.approx((0.0, -0.005, -0.005), abs=3e-4)


def test_no_words_of_delays_without_any_or_without_a_detector_that_measures_them():
    pipeline = made()
    pipeline.process(flight(pipeline, 12))
    assert lines_of(pipeline)["monitor"].level == Level.OK
    blind = made(**{"detector.name": "likelihood_ratio"})
    blind.process(flight(blind, 12, (0.0, 0.004)))
    assert blind.status().delays == ()
    assert dict(lines_of(blind)["monitor"].values)["imu_2: stamps late (ms)"] == "none"
    assert "stamps" not in lines_of(blind)["monitor"].message


def test_a_start_in_motion_is_followed_and_what_stays_unknown_is_said():
    pipeline = made()
    block = flight(pipeline, 14, rest=-2.0)
    offset = np.array([0.01, -0.01, 0.0, 0.01, 0.0, -0.005])
    output = pipeline.process(Block(block.stamp, block.z + offset))
    assert output.valid[400:].all(), "it judges and gives a rate after the time of one average"
    assert not declared(output)
    status, seen = pipeline.status(), pipeline.geometry.S @ offset
    assert "the common bias is unknown to 0.02 rad/s" in status.bias_state
    drift, std = (np.array([getattr(channel, name) for channel in status.channels]) for name in ("drift", "bias_std"))
    assert np.abs(pipeline.geometry.S @ drift - seen).max() < 0.002, "what the channels see of each other is learned"
    assert status.bias == pytest.approx(drift)
    assert (std < 0.005).all()
    spread = np.sqrt(np.diag(output.covariance[-1]))
    assert (spread >= np.sqrt(np.diag(pipeline.geometry.covariance(0.02**2)))).all(), "the rest is in the covariance"
    value = dict(lines_of(pipeline)["imu_1.x"].values)["of that followed in flight (rad/s)"]
    assert float(value) == pytest.approx(drift[0], rel=1e-3)


def test_a_noisy_channel_is_told_and_stays_in_use():
    pipeline = made()
    block = flight(pipeline, 12)
    block.z[600:, 1] += np.random.default_rng(2).normal(0, 8 * NOISE, 600)
    assert not declared(pipeline.process(block))
    lines = lines_of(pipeline)
    assert {name for name, line in lines.items() if line.level != Level.OK} == {"monitor", "imu_1.y"}
    assert lines["imu_1.y"].level == lines["monitor"].level == Level.WARN
    words = lines["imu_1.y"].message.removeprefix("agrees with the others; noise ")
    times, _, rest = words.partition(" ")
    assert 4 < float(times) < 9
    assert rest == "times noise_std and above the others'"
    assert "degraded: imu_1.y" in lines["monitor"].message
    assert pipeline.status().channels[1].noise == pytest.approx(float(times), abs=0.1)
    assert pipeline.status().channels[1].state == ChannelState.OK


def test_a_bias_that_wanders_off_is_told_before_it_is_a_fault_and_then_by_its_own_name():
    config = Config.from_file(CONFIG.with_name("three_imus.yaml"), LOOSE | {"noise.bias_walk": [2e-3]})
    pipeline = Pipeline(config)
    block = flight(pipeline, 120, rest=1e9)
    block.z[500:, 0] += 1.2e-6 * np.arange(len(block.z) - 500)
    told = declared(pipeline.process(block[:9000]))
    line = lines_of(pipeline)["imu_1.x"]
    assert not told
    assert line.level == Level.WARN
    assert line.message.startswith("agrees with the others; bias has drifted by 0.0")
    assert line.message.endswith("a fault beyond 0.01 (bias.max_drift)")
    output = pipeline.process(block[9000:])
    status, line = pipeline.status(), lines_of(pipeline)["imu_1.x"]
    assert [c.name for c in status.channels if c.state == ChannelState.FAULTY] == ["imu_1.x"]
    assert status.channels[0].reason == Reason.DRIFTED
    assert line.message.startswith("has drifted: its bias is beyond bias.max_drift by 0.0")
    assert line.level == Level.ERROR
    # The sample that declares it is fused without it already.
    at = 9000 + int(np.flatnonzero(output.state[:, 0] == ChannelState.FAULTY)[0])
    block.z[at, 0] += 0.002
    again = Pipeline(config).process(block[: at + 1])
    assert again.state[at, 0] == ChannelState.FAULTY
    np.testing.assert_allclose(again.rate[at], output.rate[at - 9000], rtol=0, atol=1e-5)


def test_a_set_of_whole_units_is_called_by_the_units():
    for name, words in (
        ("sequential", "one of imu_1, imu_2 is faulty as a whole or in part, the evidence cannot tell which"),
        ("likelihood_ratio", "the y axis of imu_1 or imu_2, 0.3"),
    ):
        pipeline = Pipeline(parallel(2, detector__name=name))
        struck_axes = "xyz" if name == "sequential" else "y"
        faults = [f"channel=imu_2.{axis} kind=bias size=0.3 start=2" for axis in struck_axes]
        pipeline.process(struck(stream(pipeline.geometry, 400), faults, pipeline.channel_names))
        line = lines_of(pipeline)["imu_2.y"]
        assert line.level == Level.ERROR
        assert line.message.startswith(words)


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
    output = after.process(later(flight(after, 0.1, rest=-2.0), 1.0))
    assert output.valid.all()
    unknown = after.geometry.covariance(0.02**2)
    assert (np.diag(output.covariance[-1]) >= np.diag(unknown)).all(), "and stands in the covariance"


def test_the_walk_since_a_state_was_saved_is_in_what_is_restored(tmp_path):
    path, walk = tmp_path / "state.json", 1e-3
    before = made(**{"noise.bias_walk": [walk]})
    before.process(flight(before, 8))
    StateFile(path, 1e4).save(before)
    state = json.loads(path.read_text())
    path.write_text(json.dumps({**state, "saved": time.time() - 400.0}))
    after = made(**{"noise.bias_walk": [walk]})
    assert StateFile(path, 1e4).restore(after)
    count = len(state["errors"]["value"])
    covariance = np.zeros((count, count))
    covariance[np.tril_indices(count)] = state["errors"]["covariance"]
    restored = after.detector.states[0]["estimator"]["states"]["p"].diagonal()[:6]
    assert (restored >= (covariance.diagonal()[:6] + (walk * 20) ** 2) * (1 - 1e-6)).all()
