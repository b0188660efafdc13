# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Biases and declarations that outlive the process: taken over only if they fit, never half written."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from monitor.streams import SIGMA, START, config, parallel, run, stream, struck

from fdi_ros import Config, Geometry
from fdi_ros.core.decision import WHY
from fdi_ros.errors import ConfigError
from fdi_ros.estimator.error_states import ERROR_KINDS, places_of
from fdi_ros.model.samples import Block
from fdi_ros.monitor.output import ChannelState, Reason
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.monitor.state_file import StateFile

LEARNING = {"bias__startup_bias_duration": 1.0, "detector__name": "sequential"}
OFFSET = 0.01
COUNT = sum(
    len(places) for kind in ERROR_KINDS for places in places_of(kind.name, 6, 2)
)
"""Error states of six channels in two units."""
NOTHING = {
    "value": [0.0] * COUNT,
    "covariance": [0.0] * (COUNT * (COUNT + 1) // 2),
    "late": [0.0, 0.0],
}
NAMES = [f"g{k}" for k in range(1, 7)]
TURN = (Geometry.two_triad_cone().axes @ [0.15, 0.0, 0.0]).tolist()


def rest(pipeline, samples=300, seed=0):
    z = np.random.default_rng(seed).normal(
        OFFSET, SIGMA, (samples, pipeline.geometry.n)
    )
    return Block(START + np.arange(samples, dtype=np.int64) * 10_000_000, z)


def flown(**changes):
    """A monitor that has learned its bias and declared g4."""
    pipeline = Pipeline(config(**{**LEARNING, **changes}))
    pipeline.process(
        struck(rest(pipeline), ["channel=g4 kind=bias size=0.5 start=2"], NAMES)
    )
    assert pipeline.status().channels[3].state == ChannelState.FAULTY
    return pipeline


@pytest.fixture
def path(tmp_path):
    return tmp_path / "state.json"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """What that monitor writes."""
    path = tmp_path_factory.mktemp("written") / "state.json"
    assert StateFile(path, 60.0).save(flown())
    return path.read_text()


def left(path, pipeline):
    """What is said of a state that is not taken."""
    file, untouched = StateFile(path, 60.0), pipeline.core.tobytes()
    assert not file.restore(pipeline)
    assert pipeline.core.tobytes() == untouched
    assert "\n" not in file.words
    return file


def test_a_restarted_monitor_goes_on_where_it_was(path):
    before, after, file = flown(), Pipeline(config(**LEARNING)), StateFile(path, 60.0)
    assert StateFile(path, 60.0).save(before)
    assert file.restore(after)
    assert "biases, g4 FAULTY" in file.words
    assert after.status().bias == pytest.approx(before.status().bias, abs=1e-10)
    assert after.status().bias_state == "restored from the state file"
    output = after.process(stream(after.geometry, 100))
    assert output.valid.all(), (
        "it need not learn the bias again, and so gives a rate at once, in motion too"
    )
    assert (output.state[:, 3] == ChannelState.FAULTY).all()
    assert (
        after.status().channels[3].reason
        == before.status().channels[3].reason
        == Reason.DISAGREES
    )


def test_written_once_for_each_change(path):
    file, pipeline = StateFile(path, 60.0), Pipeline(config())
    healthy = rest(pipeline, 400)
    # Settings that allow for no bias.
    healthy = Block(healthy.stamp, healthy.z - OFFSET)
    block = struck(healthy, ["channel=g2 kind=bias size=0.5 start=1"], NAMES)
    tried = []
    for k in range(0, 400, 20):
        pipeline.process(block[k : k + 20])
        tried.append((file.save(pipeline), json.loads(path.read_text())["declared"]))
    declared = [kept["faulty"] for _, kept in tried]
    assert declared == 5 * [{}] + 15 * [{"g2": "disagrees"}]
    assert sum(saved for saved, _ in tried) < 6, "also what is known much better"
    pipeline.reset()
    assert file.save(pipeline)
    assert json.loads(path.read_text())["declared"]["faulty"] == {}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"saved": 0.0}, "expected at most 60 s"),
        ({"saved": 4e9}, "s ahead of the clock, which was set back"),
        ({"format": 7}, "format 7, expected 3"),
        ({"bias": {"g1": 0.0}}, "damaged"),
        ({"errors": {"value": [0.0], "covariance": [1.0], "late": []}}, "damaged"),
        ({"errors": {**NOTHING, "value": [math.nan] * COUNT}}, "damaged"),
        (
            {"errors": {**NOTHING, "covariance": [-1.0] * (COUNT * (COUNT + 1) // 2)}},
            "damaged",
        ),
        (
            {"errors": {**NOTHING, "value": [0.0] * 10 + [0.5] + [0.0] * (COUNT - 11)}},
            "error state 11 is 0.5",
        ),
        (
            {"bias": {f"g{k}": 0.5 for k in range(1, 7)}},
            "at most 0.1 (bias.max_rest_rate)",
        ),
        ({"bias": dict(zip(NAMES, TURN, strict=True))}, "pass for a turn of 0.15"),
        ({"bias": {f"g{k}": float("nan") for k in range(1, 7)}}, "damaged"),
        ({"known": ["g9"]}, "damaged"),
        ({"declared": {"faulty": {"g1": "moods"}, "ambiguous": []}}, "damaged"),
        ({"declared": []}, "damaged"),
        ({"saved": float("nan")}, "damaged"),
        ({"declared": {"faulty": {"g1": "stuck"}, "ambiguous": ["g1"]}}, "damaged"),
    ],
)
def test_what_does_not_fit_is_left_and_said(path, written, change, words):
    path.write_text(json.dumps({**json.loads(written), **change}))
    pipeline, before = Pipeline(config(**LEARNING)), path.read_bytes()
    file = left(path, pipeline)
    assert words in file.words
    # And kept.
    assert file.is_rejected
    assert file.save(pipeline)
    assert path.with_suffix(".json.old").read_bytes() == before
    assert StateFile(path, 60.0).restore(pipeline)
    assert not file.is_rejected


@pytest.mark.parametrize(
    "content",
    [b"", b'{"format": 2', b'{\n "format": "\xff', b'{"format":' + b"[" * 100_000],
)
def test_damaged_files_are_said_to_be(path, content):
    path.write_bytes(content)
    assert "damaged" in left(path, Pipeline(config())).words


@pytest.mark.parametrize(
    "content",
    [
        b"[]",
        b"null",
        b"{",
        b"\xff\xfe",
        b"1" * 5000,
        b"/**:\n  ros__parameters: {}",
        b'{"name": "x"}',
    ],
)
def test_what_is_no_state_is_never_replaced(path, content):
    pipeline, old = Pipeline(config()), path.with_suffix(".json.old")
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="holds no state of a monitor"):
        StateFile(path, 60.0).restore(pipeline)
    path.rename(old)
    with pytest.raises(
        ConfigError, match=r"state.json.old' holds no state of a monitor"
    ):
        StateFile(path, 60.0).restore(pipeline)
    assert old.read_bytes() == content


def test_a_state_that_somebody_else_may_have_written_is_left_alone_and_kept(
    path, written
):
    pipeline, elsewhere, old = (
        Pipeline(config(**LEARNING)),
        path.with_name("elsewhere"),
        path.with_suffix(".json.old"),
    )
    elsewhere.write_text(written)

    def link() -> None:
        path.unlink()
        path.symlink_to(elsewhere)

    changes = {
        "others can write it (mode 666)": lambda: path.chmod(0o666),
        "it is a link": link,
    }
    if os.geteuid() == 0:
        changes["it belongs to another user (54321)"] = lambda: os.chown(path, 54321, 0)
    for words, change in changes.items():
        path.unlink(missing_ok=True)
        path.write_text(written)
        change()
        file = left(path, pipeline)
        assert (
            f"no state taken from {path}: {words}; it is kept as state.json.old"
            == file.words
        )
        assert file.save(pipeline)
        assert old.read_text() == elsewhere.read_text() == written
        assert StateFile(path, 60.0).restore(pipeline)
        assert not path.is_symlink()
    # Nor is what lies at any name that a state might be written under.
    assert sorted(one.name for one in path.parent.iterdir()) == [
        "elsewhere",
        "state.json",
        "state.json.old",
    ]


def test_another_geometry_is_another_configuration(path, written):
    path.write_text(written)
    assert (
        "another configuration"
        in left(
            path, Pipeline(config(geometry__preset="dodecahedron", **LEARNING))
        ).words
    )


def test_no_file_yet_and_no_folder(tmp_path, path):
    assert "there is none yet" in left(path, Pipeline(config())).words
    for where, age, words in (
        (tmp_path / "nowhere" / "state.json", 60.0, "there is no folder"),
        (tmp_path, 60.0, "a folder, expected a file"),
        (Path("/"), 60.0, "a folder, expected a file"),
        (path, 0.0, "state_max_age is 0 s"),
    ):
        with pytest.raises(ConfigError, match=words):
            StateFile(where, age)
    os.mkfifo(path)
    with pytest.raises(ConfigError, match="is no regular file"):
        StateFile(path, 60.0).restore(Pipeline(config()))


def test_what_cannot_be_written_is_said_and_leaves_the_former_state(path):
    pipeline, file = flown(), StateFile(path, 60.0)
    file.save(pipeline)
    kept = path.read_bytes()
    file.path = Path("/proc/state.json")
    pipeline.reset()
    assert file.save(pipeline)
    assert "cannot be saved to /proc/state.json" in file.words
    assert file.failed
    assert path.read_bytes() == kept
    assert list(path.parent.iterdir()) == [path]
    file.path, file._not_before = path, 0.0
    assert file.save(pipeline), "what could not be saved is tried again"
    assert not file.failed
    assert path.read_bytes() != kept


@pytest.mark.parametrize("name", ["px4", "ardupilot", "three_imus"])
def test_a_state_of_before_the_first_sample_is_taken_over(path, root, name):
    settings = Config.from_file(
        root / "config" / f"{name}.yaml", {"bias.startup_bias_duration": 0.0}
    )
    assert StateFile(path, 3600.0).save(Pipeline.from_config(settings))
    file = StateFile(path, 3600.0)
    assert file.restore(Pipeline.from_config(settings))
    assert "taken from" in file.words


def test_a_set_and_a_drift_outlive_a_restart(path):
    settings = parallel(2, detector__name="sequential")
    pipeline, again, file = (
        Pipeline(settings),
        Pipeline(settings),
        StateFile(path, 3600.0),
    )
    block, _ = run(pipeline, 400, "channel=imu_2.y kind=bias size=0.3 start=2")
    pipeline.core[0]["decision"]["faulty"] |= 1
    pipeline.core[0]["decision"]["why"][0] = WHY.index("drifted")
    file.restore(pipeline)
    file.save(pipeline)
    StateFile(path, 3600.0).restore(again)
    again.process(Block(block.stamp[300:301] + 10**12, block.z[300:301]))
    channel = again.status().channels[0]
    assert channel.error == channel.drift != 0.0
    output = again.process(Block(block.stamp[301:320] + 10**12, block.z[301:320]))
    assert (output.state[:, [1, 4]] == ChannelState.AMBIGUOUS).all()
    assert again.status().channels[0].reason == Reason.DRIFTED


def test_a_restored_bias_is_as_old_as_the_walk_of_its_own_channel(path):
    walk = [1e-4, 2e-4, 3e-4, 1e-3, 2e-3, 3e-3]
    settings = config(**LEARNING, noise__bias_walk=walk)
    before, after = Pipeline(settings), Pipeline(settings)
    before.process(rest(before))
    StateFile(path, 3600.0).save(before)
    saved = json.loads(path.read_text())
    path.write_text(json.dumps({**saved, "saved": saved["saved"] - 900.0}))
    assert StateFile(path, 3600.0).restore(after)
    known = after.core["sample"]["bias_std"][0, :6]
    start = before.core["settings"]["learned"][0, :6]
    assert known == pytest.approx(np.hypot(start, 30.0 * np.array(walk)), rel=0.01)


def test_a_delay_that_vibration_may_have_taught_is_as_uncertain_after_a_restart(path):
    settings = parallel(2, detector__name="sequential")
    pipeline, again = Pipeline(settings), Pipeline(settings)
    z = np.random.default_rng(0).normal(0.0, SIGMA, (400, pipeline.geometry.n))
    stamps = START + 10_000_000 * np.arange(400, dtype=np.int64)
    pipeline.process(Block(stamps, z))
    pipeline.guard.states[0]["estimator"]["taught_delay"][1] = 0.01
    before = pipeline.status().units[1].delay_std
    assert before > 0.01
    StateFile(path, 3600.0).save(pipeline)
    assert StateFile(path, 3600.0).restore(again)
    estimator = again.guard.states[0]["estimator"]
    (place,) = places_of("delay", again.geometry.n, 2)[0]
    assert np.sqrt(estimator["states"]["p"][place, place]) >= 0.999 * before
