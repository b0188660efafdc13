# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the operator is told: never more than is known, in words and figures that can be acted on."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from monitor.streams import config, parallel, run

from fdi_ros.monitor.diagnostics import PREFIX, WHOLE, InputStatus, Level, StatusLine, describe
from fdi_ros.monitor.output import ChannelState, Reason
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.status import ChannelStatus, Status
from fdi_ros.monitor.watchdog import SampleRateCheck
from fdi_ros.text import plus_minus

SECOND = 10**9
CHANNEL = ChannelStatus("imu_1.x", ChannelState.OK, Reason.NONE, SECOND, (), 0.0, 0.001, SECOND, 100, 0, 0, 0, 0)
INPUT = InputStatus("imu_1", "imu_1/data_raw", 100, 100.0, 0.01, True, max_lag=0.002)


def status_of(pipeline: Pipeline, *faults: str, samples: int = 600) -> Status:
    run(pipeline, samples, *faults)
    return pipeline.status()


def by_name(lines: list[StatusLine]) -> dict[str, StatusLine]:
    return {line.name.removeprefix("fdi_node: "): line for line in lines}


def test_all_well() -> None:
    lines = by_name(describe(status_of(Pipeline(config())), "unit 7"))
    assert {line.level for line in lines.values()} == {Level.OK}
    assert {line.hardware_id for line in lines.values()} == {"unit 7"}
    assert lines["monitor"].message == "6 of 6 channels healthy; any further fault would be seen and isolated"


def test_an_isolated_fault_by_how_much_and_since_when() -> None:
    lines = by_name(describe(status_of(Pipeline(parallel(3)), "channel=imu_2.y kind=bias size=0.21 start=2")))
    line = lines["imu_2.y"]
    assert line.level == Level.ERROR
    error, seconds = line.message.removeprefix("disagrees with the others by ").split(" rad/s for ")
    assert float(error) == pytest.approx(0.21, abs=0.01)
    assert seconds.endswith(" s; isolated and left out")
    assert float(seconds.split()[0]) == pytest.approx(4.0, abs=0.15)
    values = dict(line.values)
    assert values["state"] == "FAULTY"
    assert abs(float(values["residual (rad/s)"])) == pytest.approx(0.21, abs=0.02)
    assert lines["monitor"].level == Level.WARN
    assert lines["monitor"].message.startswith("8 of 9 channels healthy; any further fault would be seen")


@pytest.mark.parametrize("detector", ["sequential", "likelihood_ratio"])
@pytest.mark.parametrize("size", [0.03, -0.3])
def test_of_two_parallel_units_the_axis_is_named_and_by_how_much_they_are_apart(detector: str, size: float) -> None:
    pipeline = Pipeline(parallel(2, detector__name=detector))
    status = status_of(pipeline, f"channel=imu_2.y kind=bias size={size} start=2")
    lines, pair = by_name(describe(status)), status.apart
    assert pair is not None
    assert pair.channels == ("imu_1.y", "imu_2.y")
    assert "no further fault would be isolated" in lines["monitor"].message
    if detector == "sequential":
        assert abs(pair.size - abs(size)) < 4 * pair.std < 0.02
    else:
        assert pair.size == pytest.approx(abs(size), abs=0.01)
    apart = f"the y axis of imu_1 or imu_2, {plus_minus(pair.size, pair.std)} rad/s apart"
    assert apart in lines["monitor"].message
    for name in ("imu_1.y", "imu_2.y"):
        assert lines[name].level == Level.ERROR
        words = f"{apart}: one of the two is faulty, the evidence cannot tell which; for "
        assert lines[name].message.startswith(words)
        assert dict(lines[name].values)["apart (rad/s)"] in apart


def test_of_three_parallel_units_no_pair_is_apart() -> None:
    assert status_of(Pipeline(parallel(3)), "channel=imu_2.y kind=bias size=0.3 start=2").apart is None


def test_no_data_and_taken_out_are_two_words() -> None:
    pipeline = Pipeline(config(excluded_channels=("g1",)))
    lines = by_name(describe(status_of(pipeline, "channel=g2 kind=dropout missing=1 start=2")))
    assert (lines["g1"].level, lines["g2"].level) == (Level.WARN, Level.STALE)
    assert lines["g1"].message.startswith("taken out by the operator")
    assert lines["g2"].message.startswith("gives no data")


def test_without_rate_it_is_an_error() -> None:
    faults = [f"channel=g{k} kind=dropout start=2" for k in (1, 2, 3, 4)]
    line = by_name(describe(status_of(Pipeline(config()), *faults)))["monitor"]
    assert line.level == Level.ERROR
    assert line.message.startswith("no fused rate")


def test_why_there_is_no_rate_is_the_message_itself() -> None:
    learning = status_of(Pipeline(config(bias__startup_bias_duration=3.0)), samples=100)
    turning = replace(learning, bias_state="refused, not at rest: g1 had mean 0.5 rad/s (at most 0.09)")
    words = [by_name(describe(status))["monitor"].message for status in (learning, turning)]
    assert words[0].startswith("no fused rate: the biases are being learned, at rest; 0 of 6")
    assert words[1].startswith("no fused rate: biases not learned: refused, not at rest: g1 had mean 0.5")


def test_redundancy_gone_is_an_error_though_there_is_a_rate() -> None:
    faults = [f"channel=g{k} kind=dropout start={k}" for k in (1, 2, 3)]
    status = status_of(Pipeline(config()), *faults)
    line = by_name(describe(status))["monitor"]
    assert status.has_rate
    assert line.level == Level.ERROR
    assert "no further fault would be seen" in line.message


def test_silence_makes_all_stale_whatever_was_known_before() -> None:
    status = status_of(Pipeline(config()))
    lines = describe(status, silent=12.4)
    assert {line.level for line in lines} == {Level.STALE}
    assert {line.message for line in lines} == {"no sample for 12.4 s"}
    fresh = Pipeline(config()).status()
    assert {line.message for line in describe(fresh, silent=0.0)} == {"no sample yet"}


def test_what_has_just_come_has_not_lasted_for_no_time() -> None:
    status = replace(nothing_yet(), stamp=SECOND, samples=5)
    for since, words in ((SECOND, "from this sample on"), (SECOND // 2, "for 0.5 s"), (0, "since the start")):
        channel = replace(CHANNEL, state=ChannelState.FAULTY, reason=Reason.STUCK, since=since)
        assert f"{words}; isolated" in describe(replace(status, channels=(channel,)))[1].message


@functools.cache
def nothing_yet() -> Status:
    return Pipeline(config()).status()


@given(
    st.sampled_from(ChannelState),
    st.sampled_from(Reason),
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(0, 2**62),
)
def test_only_ok_is_ok_and_every_word_is_there(state, reason, error, residual, since) -> None:
    status = nothing_yet()
    channel = replace(
        CHANNEL, state=state, reason=reason, error=error, residual=residual, since=since, group=("a", "b")
    )
    status = replace(status, channels=(channel,), stamp=2 * SECOND, samples=5, has_rate=True)
    whole, line = describe(status)
    assert (line.level == Level.OK) == (state == ChannelState.OK)
    assert whole.level != Level.OK or state == ChannelState.OK
    for text in (whole.message, line.message, *(value for pair in (*whole.values, *line.values) for value in pair)):
        assert isinstance(text, str)
        assert "nan" not in text.split()
        assert "\n" not in text
    assert line.message


@pytest.mark.parametrize(
    ("change", "level", "words"),
    [
        ({}, Level.OK, "delivers"),
        ({"silent": None, "live": False, "received": 0}, Level.STALE, "no message yet on imu_1/data_raw"),
        ({"silent": 3.2, "live": False}, Level.STALE, "silent for 3.2 s"),
        ({"lag": 0.045}, Level.WARN, "stamps stay 45.0 ms behind the other inputs'"),
        ({"lag": 0.0015}, Level.OK, "delivers"),
        ({"offset": 3600.0}, Level.WARN, "stamps are 60 min behind the clock"),
        ({"offset": -5.0}, Level.WARN, "stamps are 5.0 s ahead of the clock"),
        (
            {"offset": 45_333_180.0},
            Level.WARN,
            "stamps are 525 days behind the clock (of a recording? then use_sim_time, ",
        ),
        ({"recent": {"backward": 3}}, Level.WARN, "stamps going back (3)"),
        ({"recent": {"malformed": 2}, "error": "array has 5 values"}, Level.WARN, "malformed messages (2)"),
        ({"recent": {"interpolated": 9}}, Level.OK, "delivers"),
        (
            {"live": False, "arrives": True, "recent": {"late": 50}},
            Level.STALE,
            "gives nothing that can be used; messages too late",
        ),
    ],
)
def test_inputs(change, level, words) -> None:
    line = describe(Pipeline(config()).status(), inputs=[replace(INPUT, **change)])[-1]
    assert line.name == "fdi_node: input imu_1"
    assert line.level == level
    assert words in line.message
    if "error" in change:
        assert dict(line.values)["last malformed"] == change["error"]


def test_figures_of_the_whole_come_with_their_units() -> None:
    pipeline = Pipeline(config(detector__name="likelihood_ratio"))
    whole = describe(status_of(pipeline), figures=[("latency p99 (ms)", "0.4")])[0]
    values = dict(whole.values)
    assert whole.name == PREFIX + WHOLE
    assert values["latency p99 (ms)"] == "0.4"
    assert values["detector"] == "likelihood_ratio"
    assert math.isfinite(float(values["statistic"]))
    assert float(values["threshold"]) > 3
    assert np.isin(["g1", "g6"], values["faults isolated on"].split(", ")).all()


def test_a_wrong_sample_rate_is_told_once_it_is_measured():
    sampling, count, stamp = SampleRateCheck(10.0), 0, 10**18
    for k, (samples, ms) in enumerate([(100, 1000), (30, 1000), (100, 1000), (99, 1000), (101, 1000), (100, 1000)]):
        assert not sampling.words, k
        sampling.check(count := count + samples, stamp := stamp + ms * 1_000_000)
    assert sampling.words.startswith("samples come at 100 Hz, sample_rate is 10 Hz")
    line = describe(Pipeline(config()).status(), warning=sampling.words)[0]
    assert line.level >= Level.WARN
    assert sampling.words in line.message
    right = SampleRateCheck(100.0)
    for k in range(9):
        right.check(100 * k, 10**9 * (k + 1))
    assert not right.words
