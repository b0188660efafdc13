# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Health of a running monitor: the verdict that a replay of the last minute would give."""

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from monitor.streams import RATE, SIGMA, parallel, stream, struck
from numpy.typing import NDArray

from fdi_ros.core.states import ChannelState
from fdi_ros.faults.fault import Injector
from fdi_ros.model.samples import Block
from fdi_ros.monitor.diagnostics import InputStatus, Level, StatusLine, describe
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.recent import RecentHealth
from fdi_ros.monitor.soundness import REPORTED, Word, live_word
from fdi_ros.replay.run import Judge

SECOND = round(RATE)


def reports(
    block: Block, received: NDArray[np.int64] | None = None
) -> Iterator[dict[str, StatusLine]]:
    """Yield the diagnostics of three units after each second of a stream.

    ``received`` (seconds, 3): messages of each unit so far; None: one a sample.
    """
    pipeline, health = (
        Pipeline(parallel(3, detector__name="sequential")),
        RecentHealth(),
    )
    for k in range(len(block) // SECOND):
        pipeline.process(block[k * SECOND : (k + 1) * SECOND])
        counts = [SECOND * (k + 1)] * 3 if received is None else received[k].tolist()
        inputs = [
            InputStatus(f"imu_{u + 1}", f"/imu_{u + 1}", count, RATE, 0.01, True)
            for u, count in enumerate(counts)
        ]
        health.add(pipeline.status(), inputs, float(k + 1))
        lines = describe(pipeline.status(), "", inputs=inputs, concerns=health.concerns)
        yield {line.name: line for line in lines}


def healthy(seconds: int) -> Block:
    return stream(Pipeline(parallel(3)).geometry, seconds * SECOND)


def test_a_healthy_monitor_is_healthy_at_every_report():
    for lines in reports(healthy(40)):
        assert lines["monitor"].value("verdict") == "HEALTHY"
        assert {line.level for line in lines.values()} == {Level.OK}


def test_spikes_are_named_for_a_minute_and_forgotten():
    block = healthy(90)
    block.z[5 * SECOND : 20 * SECOND : SECOND, 4] += 5.0
    *_, at_30 = list(reports(block[: 30 * SECOND]))
    assert at_30["monitor"].value("verdict") == "LOOK"
    assert "imu_2.y has 15 spikes" in at_30["monitor"].message
    assert at_30["monitor"].message.startswith("8 of 9 channels healthy")
    assert at_30["imu_2.y"].level == Level.WARN
    *_, last = reports(block)
    assert last["monitor"].value("verdict") == "HEALTHY"


def test_noise_is_reported_while_it_lasts_and_for_a_minute():
    block = healthy(100)
    random = np.random.default_rng(1)
    block.z[10 * SECOND : 20 * SECOND, 4] += random.normal(0.0, 0.025, 10 * SECOND)
    lines = [one["monitor"] for one in reports(block)]
    verdicts = [one.value("verdict") for one in lines]
    assert verdicts[:10] == ["HEALTHY"] * 10
    assert verdicts[16:75] == ["LOOK"] * 59
    assert verdicts[85:] == ["HEALTHY"] * 15
    assert re.search(
        r"imu_2.y had noise [\d.]+ times as large as usual for \d+\.\d s, \d+ s ago",
        lines[30].message,
    )


@pytest.mark.parametrize(("vibration", "noisy"), [(4.5, False), (12.0, True)])
def test_vibration_that_the_units_show_unequally_is_no_noise_of_one(vibration, noisy):
    """The usual noise of a flight is not that of the ground, where settings expect more than both."""
    pipeline = Pipeline(
        parallel(3, detector__name="sequential", noise__noise_std=5.0 * SIGMA)
    )
    block = stream(pipeline.geometry, 50 * SECOND, 0.3)
    more = SIGMA * np.sqrt(np.repeat([4.0, vibration**2, 4.0], 3) - 1.0)
    random = np.random.default_rng(0)
    block.z[25 * SECOND :] += random.normal(0.0, more, (25 * SECOND, 9))
    pipeline.process(block)
    longest = [one.longest_noisy.seconds for one in pipeline.status().channels]
    assert (max(longest) >= REPORTED.noisy_s) is noisy
    assert max(longest[:3] + longest[6:]) == 0.0


def test_a_slow_unit_is_named_with_both_rates_however_long_it_lasts():
    steps = np.full((300, 3), SECOND)
    steps[30:, 1] = SECOND // 3
    health, pipeline = RecentHealth(), Pipeline(parallel(3))
    pipeline.process(healthy(2))
    status = pipeline.status()
    for k, counts in enumerate(np.cumsum(steps, axis=0).tolist()):
        inputs = [
            InputStatus(f"imu_{u}", f"/imu_{u}", count, RATE, 0.01, True)
            for u, count in enumerate(counts)
        ]
        health.add(status, inputs, float(k))
        assert not health.concerns or k > 30
        assert health.concerns or k < 40
    (one,) = health.concerns
    assert str(one) == "imu_1 delivered 33 % of its messages (33 instead of 100 Hz)"


def test_a_unit_that_sent_nothing_has_no_rate_to_be_compared_with():
    health, pipeline = RecentHealth(), Pipeline(parallel(3))
    pipeline.process(healthy(2))
    status = pipeline.status()
    for k in range(20):
        inputs = [
            InputStatus(f"imu_{u}", f"/imu_{u}", SECOND * k * (u < 2), RATE, 0.01, True)
            for u in range(3)
        ]
        health.add(status, inputs, float(k))
    (one,) = health.concerns
    assert str(one) == "imu_2 delivered no message"


@pytest.mark.parametrize("readings", [1, 20])
@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            {"frame": "imu_2", "frame_now": "other_link"},
            "has a warning: frame_id changed from 'imu_2' to 'other_link': another sensor?",
        ),
        (
            {"sources": "2 publishers on /imu_2, expected one: /a, /b"},
            "has a warning: 2 publishers on /imu_2, expected one: /a, /b",
        ),
        ({"frame": "imu_2", "frame_now": "imu_2"}, ""),
    ],
)
def test_the_monitor_says_what_an_input_warns_of(given, words, readings):
    """Words and verdict of the monitor are those of its inputs too; the input says it once."""
    pipeline, health = Pipeline(parallel(3)), RecentHealth()
    pipeline.process(healthy(3))
    status = pipeline.status()
    for k in range(readings):
        inputs = [
            InputStatus(f"imu_{u}", f"/imu_{u}", 100 * k + 100, RATE, 0.01, True)
            for u in (1, 2, 3)
        ]
        inputs[1] = replace(inputs[1], **given)
        health.add(status, inputs, float(k))
    described = describe(status, "", inputs=inputs, concerns=health.concerns)
    lines = {line.name: line for line in described}
    whole, second = lines["monitor"], lines["input imu_2"]
    assert whole.level == second.level == (Level.WARN if words else Level.OK)
    assert whole.value("verdict") == ("LOOK" if words else "HEALTHY")
    assert words in whole.message
    assert second.message == (words.removeprefix("has a warning: ") or "delivers")
    assert whole.message.startswith(f"{6 if words else 9} of 9 channels healthy")


def test_at_the_start_a_channel_is_not_checked_yet():
    pipeline = Pipeline(parallel(3, detector__name="sequential"))
    pipeline.process(healthy(3)[:3])
    lines = describe(pipeline.status(), "")
    (words,) = {line.message for line in lines if line.name.startswith("imu_")}
    assert words in ("not checked yet", "not checked yet; used unchecked")


def test_a_declared_fault_is_faulty_and_what_is_unchecked_cannot_be_told():
    faults = ["channel=imu_2.y kind=bias size=0.3 start=3"]
    names = Pipeline(parallel(3)).channel_names
    *_, last = reports(struck(healthy(8), faults, names))
    assert last["monitor"].value("verdict") == "FAULTY"
    alone = healthy(8)
    alone.z[3 * SECOND :, 3:] = np.nan
    *_, last = reports(alone)
    assert last["monitor"].value("verdict") == "FAULTY"
    lines = describe(Pipeline(parallel(2)).status())
    assert dict(lines[0].values)["verdict"] == "CANNOT TELL"


@pytest.mark.parametrize(("units", "of_the_other"), [(2, 0.907), (3, 0.997)])
def test_live_and_replay_count_the_same_values_as_checked(units, of_the_other):
    """A unit lacks a tenth of its values: with two units, nothing checks the other one then."""
    pipeline = Pipeline(parallel(units, detector__name="sequential"))
    block = stream(pipeline.geometry, 50 * SECOND)
    block.z[5 * SECOND + 9 :: 10, 3:6] = np.nan
    injector = Injector((), pipeline.channel_names)
    injector.start_stamp = int(block.stamp[0])
    judge, health = Judge(pipeline, injector), RecentHealth()
    for k in range(50):
        judge.take(block[k * SECOND : (k + 1) * SECOND])
        health.add(pipeline.status(), [], float(k + 1))
    replayed = judge.judgement().monitor.channels
    checked = {one.name: one.checked for one in replayed}
    assert checked["imu_1.x"] == pytest.approx(of_the_other, abs=0.003)
    assert checked["imu_2.x"] == pytest.approx(0.997, abs=0.003)
    assert all(one.unchecked == 1.0 - one.checked for one in replayed)
    # The first reading comes after the first second.
    live = {one.name: one.checked for one in health.channels}
    assert live == pytest.approx(checked, abs=0.01)


@pytest.mark.parametrize("state", [ChannelState.FAULTY, ChannelState.AMBIGUOUS])
def test_a_declared_fault_stays_faulty_while_no_samples_arrive(state):
    pipeline = Pipeline(parallel(3))
    pipeline.process(healthy(2))
    status = pipeline.status()
    first, *others = status.channels
    declared = replace(status, channels=(replace(first, state=state), *others))
    for now, word in ((status, "CANNOT TELL"), (declared, "FAULTY")):
        whole, *_ = describe(now, silent=5.5)
        assert whole.message == "no sample for 5.5 s"
        assert dict(whole.values)["verdict"] == word


def test_a_channel_that_is_unchecked_now_is_not_called_healthy():
    pipeline = Pipeline(parallel(3))
    pipeline.process(healthy(2))
    status = pipeline.status()
    first, *others = status.channels
    words = {
        state: live_word(
            replace(status, channels=(replace(first, state=state), *others)), []
        )
        for state in (ChannelState.OK, ChannelState.UNCHECKED, ChannelState.FAULTY)
    }
    assert list(words.values()) == [Word.HEALTHY, Word.CANNOT_TELL, Word.FAULTY]
