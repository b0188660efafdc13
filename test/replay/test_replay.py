# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A recording through the monitor: what the summary says is what was injected and what the pipeline declared."""

import math
import re

import numpy as np
import pytest
from bag import recordings
from bag.recordings import PARAMETERS, START, STEP, TOPICS, write_mcap
from replay.summaries import Keep, examples

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.core.states import ChannelState
from fdi_ros.faults.fault import Injector, load_scenario, parse_fault
from fdi_ros.faults.kinds import FAULT_KINDS
from fdi_ros.model.samples import Block
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.conditions import failures, parse_check
from fdi_ros.replay.outcomes import GRACE
from fdi_ros.replay.run import replay
from fdi_ros.replay.sweep import judged_with, onsets_of
from fdi_ros.replay.words import sentences
from fdi_ros.report.layout import Severity

FIRST, BEGIN, STOP, END = 28.0, 30.0, 34.0, 35.0
"""In this part of the bundled flight every channel moves."""
UNCALIBRATED = {
    # It judges each sample by itself, whatever came before.
    "detector.name": "likelihood_ratio",
    "bias.startup_bias_duration": 0.0,
    "noise.noise_std": [0.012],
}
"""What fits a stream whose bias is not learned, because it does not begin at rest."""
CALM = Config.from_parameters({**PARAMETERS, "bias.startup_bias_duration": 0.0})
"""Two units that are in motion from the start."""


def cone(root, **changes):
    return Config.from_file(root / "config" / "two_triads.yaml", changes)


@pytest.fixture(scope="module")
def sound(root, flight):
    keep = Keep()
    replay(flight, cone(root, **UNCALIBRATED), start=FIRST, end=END, sinks=[keep])
    return keep


@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_truth_stream_and_summary_agree_for_every_kind(kind, root, flight, sound):
    """Times count from the first message, whatever part is replayed."""
    fault = examples("g5", "g4,g5,g6", BEGIN, STOP)[kind]
    config, faulty = cone(root, **UNCALIBRATED), Keep()
    summary = replay(flight, config, (fault,), start=FIRST, end=END, sinks=[faulty])
    stamp = faulty.output.stamp
    truth = Injector(
        [fault],
        build_geometry(config).channel_names,
        int(stamp[0]) - round(FIRST * 1e9),
    )
    np.testing.assert_array_equal(
        faulty.z[~truth.struck(stamp)], sound.z[~truth.struck(stamp)]
    )
    np.testing.assert_array_equal(faulty.z, truth.apply(Block(stamp, sound.z)).z)
    (found,) = summary.scores.faults
    assert summary.scores.start_s == pytest.approx(FIRST, abs=0.01)
    assert (found.channel, found.kind, found.start_s) == (fault.channel, kind, BEGIN)
    assert fault.start <= found.detected_at_s < fault.stop + GRACE
    assert found.delay_s == pytest.approx(found.detected_at_s - fault.start, abs=1e-9)
    assert set(found.declared_channels) & set(fault.channel.split(","))
    assert not found.isolated or set(fault.channel.split(",")) <= set(
        found.declared_channels
    )
    assert not found.isolated or found.isolated_at_s >= found.detected_at_s
    assert not summary.scores.declared


BIAS = "kind=bias size=0.2 start=20"


@pytest.fixture(scope="module")
def told(root, flight):
    """The flight with a bias on one channel."""
    return replay(flight, cone(root), (parse_fault(f"channel=g2 {BIAS}"),))


def written(folder, z, gone=10**9, apart=1000):
    """A recording of two units with these rates (N, 6), the second without the samples from one on."""
    messages = recordings.imu_messages(START + STEP * np.arange(len(z)), z, apart=apart)
    kept = [m for m in messages if m[0] == TOPICS[0] or m[1] < START + STEP * gone]
    return write_mcap(folder / "bag.mcap", kept)


def test_the_error_without_a_monitor_is_that_of_least_squares(told, root):
    rms = told.scores.fault_effect_rad_s
    column = build_geometry(cone(root)).least_squares[:, 1]
    assert rms.without_monitor == pytest.approx(0.2 * np.linalg.norm(column), rel=1e-9)
    assert rms.after_detection < 0.05 * rms.without_monitor
    assert rms.before_detection < rms.without_monitor


@pytest.mark.parametrize(
    ("file", "channel"), [("two_triads.yaml", "g2"), ("two_imus.yaml", "imu_1.y")]
)
def test_the_six_gyros_as_one_array_and_as_two_imus_say_the_same(
    file, channel, told, root, flight
):
    """Sound, no declaration; of a fault the same one at the same sample."""
    config = Config.from_file(root / "config" / file)
    summary = replay(flight, config)
    assert summary.scores.declared == ()
    severity, words = summary.verdict.severity, summary.verdict.sentence
    assert severity is Severity.GOOD
    assert re.fullmatch(
        r"HEALTHY: no fault was found in 60.0 s; 6 channels, each checked in 9\d % .* or more\.",
        words,
    )
    assert all(line.startswith("Topics: ") for line in sentences(summary))
    (fault,) = replay(
        flight, config, (parse_fault(f"channel={channel} {BIAS}"),)
    ).scores.faults
    assert fault.declared_channels == (channel,)
    assert fault.delay_s == pytest.approx(told.scores.faults[0].delay_s, abs=0.0101)


def test_channels_that_die_are_named_and_fail_the_check(tmp_path):
    z, keep = recordings.flight(600)[1], Keep()
    summary = replay(written(tmp_path, z, gone=400), CALM, sinks=[keep])
    assert keep.output.valid[-1]
    assert summary.stream.alignment[TOPICS[1]]["missing"] == 200
    assert summary.scores.samples_judged > 0.5 * summary.scores.samples
    severity, words = summary.verdict.severity, summary.verdict.sentence
    assert severity is Severity.BAD
    first, _, advice = words.partition(" Do not fly ")
    assert re.fullmatch(r"FAULTY: imu_2 gives no data from 4\.\d s\.", first)
    assert advice == "before imu_2 is checked or replaced."
    second, *others = sentences(summary)
    assert re.fullmatch(
        r"Not checked at the end: imu_1 UNCHECKED from 4\.\d s on \(most recent samples could not be checked\)\.",
        second,
    )
    # The verdict alone states that the unit is silent.
    assert not any("STALE" in one or "delivered" in one for one in others)
    assert (
        "only 3 channels are left: a fault of one would not be detected, 4 are needed"
        in summary.monitor.note
    )
    for check, met in (
        ("false=0", False),
        ("false=0 unchecked<=6", True),
        ("unchecked<6", False),
    ):
        assert (failures(parse_check(check, 0), summary) == []) == met
    # A fault injected up to the end is no surprise; one that ends before is no reason.
    whole = written(tmp_path, z)
    for stop, expected in ((" stop=5.5", 0), ("", 0)):
        fault = parse_fault(f"channel=imu_2.y kind=dropout start=4{stop}")
        assert (
            len(failures(parse_check("false=0", 1), replay(whole, CALM, (fault,))))
            == expected
        )


def test_the_end_is_that_of_the_last_sample_which_all_units_have(tmp_path):
    """A unit whose delay is taken off lacks the last samples: so the recording ends, and no channel is at fault."""
    config = CALM.replaced({"imus.delays": [0.0, 0.07]})
    summary = replay(written(tmp_path, recordings.flight(600)[1]), config)
    assert summary.scores.events[-1].state == "UNCHECKED"
    assert {one.state for one in summary.monitor.channels} == {"OK"}
    assert failures(parse_check("declared=0", 0), summary) == []
    assert summary.verdict.severity is Severity.GOOD
    assert summary.story.episodes == ()


@pytest.mark.parametrize(("noise", "channels"), [(0.0, []), (0.02, ["imu_2.y"])])
def test_channels_much_noisier_than_the_others_are_told_of(tmp_path, noise, channels):
    z = recordings.flight(2000)[1]
    z[:, 4] += np.random.default_rng(3).normal(0, noise, len(z))
    summary = replay(written(tmp_path, z), CALM)
    assert [name for one in summary.concerns for name in one.who] == channels
    assert summary.verdict.word == ("LOOK" if channels else "HEALTHY")
    assert summary.verdict.channels == tuple(channels)
    assert all(
        re.search(r"had [\d.]+ times the noise of the other units", str(one))
        for one in summary.concerns
    )


def test_a_recording_in_which_nothing_was_checked_is_not_called_sound(tmp_path):
    learning = {"detector.name": "likelihood_ratio", "bias.startup_bias_duration": 9.0}
    config = Config.from_parameters({**PARAMETERS, **learning})
    summary = replay(written(tmp_path, recordings.flight(200)[1]), config)
    assert summary.scores.samples_judged == 0
    severity, words = summary.verdict.severity, summary.verdict.sentence
    assert severity is Severity.UNKNOWN
    assert words.startswith(
        "CANNOT TELL: none of 200 samples was judged, because the biases were still being"
    )
    assert (
        failures(parse_check("false=0", 0), summary)[0]
        == "judged>=0.5: 0 of 200 samples were judged, 0.0000"
    )
    assert failures(parse_check("false=0 judged>=0 unchecked<=6", 0), summary) == []


# The real recording of three IMUs, as they come: nothing declared, every fault named ----------------------------------


@pytest.fixture(scope="module")
def units(root):
    """Settings of the three real units."""
    return Config.from_file(root / "config" / "three_imus.yaml")


@pytest.fixture(scope="module")
def block(recording, units):
    return read_block(recording, units, end=180.0)


@pytest.fixture(scope="module")
def calm(block, units):
    """What the monitor says of it as it is."""
    return Pipeline(units).process(block)


def declared(pipeline, output):
    return [
        (pipeline.channel_names[e.channel], e.after.name, e.stamp)
        for e in output.events
        if e.declares
    ]


def test_shaken_to_saturation_it_declares_no_sound_channel(recording, units):
    """The last 30 s reach the gyros' limit of 2000 deg/s, with nominal axes and scale factors."""
    whole = read_block(recording, units)
    assert len(whole) == 13_125
    pipeline = Pipeline(units)
    output = pipeline.process(whole)
    assert declared(pipeline, output) == []
    # 3 s at rest for the bias, then a rate for every sample up to there.
    assert output.valid[188:11_251].all()
    assert pipeline.status().bias_state == "learned"
    counted = sum(
        channel.counts["out of range"] for channel in pipeline.status().channels
    )
    assert counted == (np.abs(whole.z) >= 34.8).sum() > 100


@pytest.fixture(scope="module")
def onsets(block, units, calm):
    """A monitor, and its memory 60 s into the rest and at the fastest turn, each with the 20 s that follow."""
    seconds = (block.stamp - block.stamp[0]) / 1e9
    speed = np.linalg.norm(calm.rate, axis=1)
    rows = {
        "rest": int(np.searchsorted(seconds, 60.0)),
        "motion": int(np.nanargmax(speed)),
    }
    assert speed[rows["rest"]] < 0.02
    assert speed[rows["motion"]] > 2.0
    pipeline, names = Pipeline(units), sorted(rows, key=rows.__getitem__)
    found = onsets_of(pipeline, block, [seconds[rows[name]] for name in names], 20.0)
    return pipeline, dict(zip(names, found, strict=True))


@pytest.mark.parametrize("when", ["rest", "motion"])
@pytest.mark.parametrize(
    "channel", [f"imu_{k}.{axis}" for k in (1, 2, 3) for axis in "xyz"]
)
def test_a_bias_on_any_one_channel_is_isolated(onsets, channel, when):
    pipeline, onset = onsets[0], onsets[1][when]
    fault = parse_fault(f"channel={channel} kind=bias size=0.2 start={onset.at:.9f}")
    output = judged_with(pipeline, onset, fault)
    # In motion a unit that is wrong as a whole may explain it as well for a moment: then a set is declared first.
    named = [d for d in declared(pipeline, output) if d[1] == "FAULTY"]
    assert [d[0] for d in named] == [channel]
    assert not (output.state[-1] == ChannelState.AMBIGUOUS).any()
    delay = (named[0][2] - onset.block.stamp[onset.row]) / 1e9
    assert 0.0 <= delay <= (0.3 if when == "rest" else 1.0)
    assert output.valid.all()


def test_faults_in_a_recording_of_real_units_are_found(root, recording, units):
    faults = load_scenario(root / "config" / "scenarios" / "imu_lost_then_bias.yaml")
    summary = replay(recording, units, faults, end=180.0)
    assert [fault.isolated for fault in summary.scores.faults] == [True, True]
    assert summary.scores.declared == ()
    assert summary.stream.messages == 3 * summary.scores.samples
    assert all(math.isfinite(value) for value in summary.monitor.bias.value)
