# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A sweep: going on from a snapshot is the full replay, what came of each fault, and what the verb says and refuses."""

import csv
import json
import pickle
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from replay.summaries import SCENARIO

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Injector, load_scenario
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.replay.outcomes import OutcomeKind, TrialOutcome, score
from fdi_ros.replay.sweep import (
    Plan,
    Subject,
    judged_with,
    onsets_of,
    parse_swept,
    sweep,
    try_faults,
)
from fdi_ros.replay.sweep_report import (
    lines_of,
    smallest,
    sound_lines,
    sweep_page,
    sweep_text,
)

pytestmark = pytest.mark.usefixtures("compiled")

ROOT = Path(__file__).parents[2]
BAG, FILE = ROOT / "bags" / "cone_flight", ROOT / "config" / "two_triads.yaml"
EVERY = tuple(
    one
    for fault in load_scenario(SCENARIO)
    if not fault.kind.whole_unit
    for one in parse_swept(re.sub(r"(channel|start|stop|seed)=\S+", "", str(fault)))
)


@cache
def flown():
    """The bundled flight, one channel missing twice: the detector then judges by fewer channels."""
    block = read_block(BAG, Config.from_file(FILE))
    z = block.z.copy()
    z[1182:1189, 4] = z[2952:2959, 1] = np.nan
    return Block(block.stamp, z)


def swept(block, text="kind=bias size=0.02,0.2", **plan):
    asked = Plan(parse_swept(text), **{"times": 2, "within": 2.0, **plan})
    return sweep([Subject("own", Config.from_file(FILE), block)], asked)[0], asked


@pytest.mark.parametrize("detector", ["sequential", "cusum"])
def test_going_on_from_a_snapshot_is_the_full_replay_to_the_last_bit(detector):
    config = Config.from_file(FILE, {"detector.name": detector})
    pipeline, block = Pipeline(config), flown()
    onsets = list(onsets_of(pipeline, block, (11.9, 29.6), 1.5))
    compared = 0
    # The later one first: nothing of it may be left when the earlier one is gone on from.
    for onset in reversed(onsets):
        for k, kind in enumerate(EVERY):
            fault = kind.fault(pipeline.channel_names[k % 6], onset.at, -1.0, seed=k)
            found = judged_with(pipeline, onset, fault)
            end = int(np.searchsorted(block.stamp, onset.block.stamp[-1])) + 1
            full = Pipeline(config).process(
                Injector([fault], pipeline.channel_names).apply(block[:end])
            )
            first = end - len(found)
            assert block.stamp[first] == onset.block.stamp[onset.row] == found.stamp[0]
            for name in (
                "stamp",
                "rate",
                "covariance",
                "statistic",
                "alarm",
                "state",
                "residual",
                "level",
            ):
                np.testing.assert_array_equal(
                    getattr(found, name),
                    getattr(full, name)[first:],
                    err_msg=kind.words,
                )
            assert list(found.events) == [
                event for event in full.events if event.row >= first
            ]
            compared += bool(found.events)
    assert compared >= len(EVERY)


def test_nothing_of_a_fault_that_was_not_found_is_left_for_the_next():
    """Both go on by fewer channels for some samples, for which the method has sums of its own."""
    pipeline = Pipeline(Config.from_file(FILE, {"detector.name": "cusum"}))
    (onset,) = onsets_of(pipeline, flown(), (11.78,), 0.16)
    first, other, again = (
        judged_with(pipeline, onset, kind.fault(name, onset.at, sign, seed=0))
        for kind in parse_swept("kind=bias size=0.01")
        for name, sign in (("g1", 1.0), ("g2", -1.0), ("g1", 1.0))
    )
    assert not any(event.declares for event in first.events)
    assert (first.statistic != other.statistic).mean() > 0.9
    np.testing.assert_array_equal(first.statistic, again.statistic)


@pytest.mark.parametrize(
    ("alone", "among", "words", "named", "found"),
    [
        ({0: 1.0}, {}, "named", 1.0, 1.0),
        ({0: 1.5}, {0: 0.5, 1: 0.5}, "named", 1.5, 0.5),
        ({0: 4.0}, {0: 0.5, 1: 0.5}, "in a set", 4.0, 0.5),
        ({}, {1: 1.0, 2: 1.0}, "false set", np.inf, np.inf),
        ({}, {1: 4.0, 2: 4.0}, "silent", np.inf, np.inf),
        ({0: 1.0, 2: 4.5}, {}, "wrong", 1.0, 1.0),
    ],
)
def test_outcome_of_a_fault(alone, among, words, named, found):
    since = np.arange(50) * 0.1
    masks = [np.zeros((50, 3), dtype=bool) for _ in range(2)]
    for mask, told in zip(masks, (alone, among), strict=True):
        for channel, at in told.items():
            mask[since >= at - 1e-9, channel] = True
    assert score(*masks, 0, since, 2.0) == TrialOutcome(
        OutcomeKind(words), pytest.approx(named), pytest.approx(found)
    )


def test_larger_faults_are_found_sooner_and_a_job_gives_the_same_in_another_process():
    tried, plan = swept(flown(), "kind=bias size=0.3,0.02,0.001")
    lines = lines_of(tried, plan)
    assert [line.swept.size for line in lines] == [0.001, 0.02, 0.3]
    assert [line.trials for line in lines] == [12, 12, 12]
    assert [line.counts["named"] for line in lines] == [0, 12, 12]
    assert lines[0].named_after == (np.inf, np.inf)
    assert lines[2].named_after[0] < lines[1].named_after[0]
    assert smallest(lines, named=True) == {"bias": 0.02}
    # Signs and times are one fault's in all sizes; channels differ.
    sizes = {
        (t.channel, t.fault.start): {np.sign(t.fault.size) for t in tried.trials}
        for t in tried.trials
    }
    assert len(sizes) == 12
    assert all(
        len({np.sign(t.fault.size) for t in tried.trials[k : k + 3]}) == 1
        for k in range(0, 36, 3)
    )
    config = tried.config
    pipeline = Pipeline(config)
    onset = next(onsets_of(pipeline, flown(), tried.times, plan.within))
    assert try_faults(*pickle.loads(pickle.dumps((config, onset, 0, plan)))) == list(
        tried.trials[:3]
    )


def test_what_is_declared_without_a_fault_comes_first_and_is_left_out():
    block = flown()
    z = block.z.copy()
    z[4000:, 2] += 0.5
    tried, plan = swept(Block(block.stamp, z), times=4)
    assert {event.channel for event in tried.baseline.declared} == {"g3"}
    assert all(time < 40 for time in tried.times)
    assert [time > 38 for time in tried.skipped] == [True] * len(tried.skipped) != []
    words = sound_lines(tried)
    assert words[0].startswith("declared: g3 FAULTY from 40.0")
    assert "unreliable" in words[0]
    page = sweep_page([tried], plan, "bag", {})
    text = sweep_text([tried], plan, "bag")
    for told in (page, text):
        assert told.index("declared: g3 FAULTY") < told.index("bias 0.02 rad/s")


def test_figures_of_a_vehicle_at_rest_are_called_that():
    # The flight rests for its first 8 s.
    at_rest, plan = swept(flown()[:800], "kind=bias size=0.1", within=1.5)
    text = sweep_text([at_rest], plan, "bag")
    # Of a dozen faults the share is not 95 %, whatever came of them.
    assert (
        "bias: detected from 0.1 rad/s (12 of 12, 76 % to 100 %); isolated from 0.1 rad/s (12 of 12, 76 %"
        in text
    )
    assert "at 0 of the 2 start times: the vehicle was mostly AT REST" in text
    moving, plan = swept(flown(), "kind=bias size=0.1", within=1.0)
    assert "AT REST" not in sweep_page([moving], plan, "bag", {})


def test_a_monitor_that_judges_nothing_is_no_result():
    config = Config.from_file(FILE, {"bias.startup_bias_duration": 500.0})
    slow, own = (
        Subject("slow", config, flown()),
        Subject("own", Config.from_file(FILE), flown()),
    )
    words = "it judges nothing of this recording: it ends after 6001 samples, before the biases"
    with pytest.raises(FaultError, match=words):
        sweep([slow], Plan(parse_swept("kind=stuck")))
    with pytest.raises(
        FaultError, match="no fault can be tried: its topics have no time in common"
    ):
        swept(flown()[:0])
    with pytest.raises(FaultError, match="too short to watch a fault for 70 s"):
        swept(flown(), within=70.0)
    plan = Plan(parse_swept("kind=dropout"), times=1, within=1.0)
    nothing, six = sweep([slow, own], plan)
    assert not nothing.trials
    assert [trial.scored.outcome for trial in six.trials] == ["named"] * 6
    assert "judges nothing" in sweep_text([nothing, six], plan, "bag")


def test_excluded_channels_are_not_tried(fdi, tmp_path):
    words = [
        "sweep",
        BAG,
        "--config",
        FILE,
        "--times",
        2,
        "--within",
        2,
        "--fault",
        "kind=bias size=0.3",
    ]
    other = tmp_path / "other.yaml"
    other.write_text(
        FILE.read_text().replace(
            "body_frame:", "excluded_channels: [g2]\n    body_frame:"
        )
    )
    outputs = [tmp_path / name for name in ("s.json", "s.csv", "s.html")]
    words += [
        "--compare",
        other,
        "cusum",
        "--json",
        outputs[0],
        "--csv",
        outputs[1],
        "--report",
        outputs[2],
    ]
    code, out, _ = fdi(*words)
    assert code == 0
    assert "Side by side" in out
    assert "not tried, because excluded: g2" in out
    own, without, cusum = json.loads(outputs[0].read_text())["monitors"]
    assert (own["name"], without["name"], cusum["detector"]) == (
        "two_triads.yaml",
        str(other),
        "cusum",
    )
    assert list(own["channels"]) == [f"g{k}" for k in range(1, 7)]
    assert list(without["channels"]) == ["g1", "g3", "g4", "g5", "g6"]
    assert own["times_s"] == without["times_s"]
    (fault,) = own["faults"]
    assert (fault["kind"], fault["size"], fault["faults"]) == ("bias", 0.3, 12)
    assert fault["named"]["value"] == 1.0
    assert 0.7 < fault["named"]["low"] < 0.8
    with outputs[1].open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 12 + 10 + 12
    assert {abs(float(row["size"])) for row in rows} == {0.3}
    delays = sorted(float(row["named_after_s"]) for row in rows[:12])
    assert delays[5] == pytest.approx(fault["named_after_s"]["median"], abs=1e-6)
    assert outputs[2].read_text().index("without injected faults") < outputs[
        2
    ].read_text().index("Side by side")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--fault", "kind=bias size=-0.1"],
            "size is -0.1, expected more than 0: signs are drawn",
        ),
        (["--fault", "kind=bias size=0.1 start=3"], "start is chosen by the sweep"),
        (["--fault", "kind=triad_loss"], "strikes a whole unit"),
        (["--times", "0"], "--times is 0, expected 1 to 1000"),
        (["--within", "nan"], "--within is nan s, expected more than 0"),
        (["--workers", "0"], "workers is 0, expected 1 to 256"),
        (["--seed", "-1"], "--seed is -1"),
        (["--compare", "nothing"], "neither a file nor a detector"),
        (
            ["--compare", str(ROOT / "config" / "three_imus.yaml")],
            "its channels differ from those of",
        ),
    ],
)
def test_what_is_asked_wrongly_is_one_line(refused, words, said):
    assert said in refused("sweep", BAG, "--config", FILE, *words)
