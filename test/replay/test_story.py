# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a replay says of a recording as a user brings it: a fault that nobody injected, two units, several armings."""

import html
import json
import re
import struct

import numpy as np
import pytest
from bag import logs
from bag.recordings import imu_messages, write_bag

from fdi_ros.bag.reader import Recording
from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.errors import FaultError
from fdi_ros.faults.fault import Injector, parse_fault
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.conditions import failures, parse_check
from fdi_ros.replay.run import replay
from fdi_ros.replay.summary import as_json
from fdi_ros.replay.sweep import Plan, Subject, parse_swept, sweep
from fdi_ros.replay.words import summary_text

JUDGEMENT = re.compile(
    r"\b(false|right|wrong name|missed|detected|explains? it away|injected fault)\b",
    re.I,
)
"""Words that only an injected fault makes true."""
ARMINGS = (30.0, 100.0)
"""Seconds of each arming, and when the second begins."""


@pytest.fixture(scope="module")
def faulty(tmp_path_factory, root, recording):
    """Three real units, one axis of which drifts from 55 s on, as a bag that says nothing of it."""
    path = tmp_path_factory.mktemp("story") / "flight"
    config = Config.from_file(root / "config" / "three_imus.yaml")
    block = read_block(recording, config)[:5000]
    fault = parse_fault("channel=imu_2.y kind=drift size=0.0035 start=55")
    block = Injector(
        [fault], Geometry.from_triads([np.eye(3)] * 3).channel_names
    ).apply(block)
    return write_bag(
        path, imu_messages(block.stamp, block.z, config.imus.topics, apart=1000)
    )


def test_a_fault_that_nobody_injected_is_told_of_and_nothing_is_scored(
    fdi, tmp_path, faulty, root
):
    page, told = (tmp_path / name for name in ("page.html", "told.json"))
    words = ("replay", faulty, "--config", root / "config" / "three_imus.yaml")
    code, out, _ = fdi(*words, "--report", page, "--json", told)
    assert code == 3
    size = r"[+]0\.0\d+"
    for line in (
        r"\AFAULTY: imu_2\.y from 5\d\.\d s\. Its error grows from 0\.0\d+ to 0\.0[789]\d* rad/s\.",
        r"\n       axis: -x of the body\n",
        rf"\n       size: imu_2\.y growing by [+]0\.003(?:49|5)\d* rad/s per second, from {size} to [+]0\.0[789]",
        r"\n       alternative: no other single channel explains the evidence\n",
        r"\n       fused rate: published throughout, mean standard deviation 0\.0",
    ):
        assert re.search(line, out), line
    for text in (out, visible(page)):
        assert not JUDGEMENT.search(text), JUDGEMENT.search(text)
    first = out.splitlines()[0]
    assert first[:-1] in visible(page)
    summary = json.loads(told.read_text())
    (episode,) = summary["episodes"]
    assert (episode["state"], episode["channels"], episode["stretch"]) == (
        "FAULTY",
        ["imu_2.y"],
        1,
    )
    assert summary["verdict"] == {
        "severity": "bad",
        "word": "FAULTY",
        "words": first,
        "channels": ["imu_2.y"],
    }
    assert {
        "samples",
        "duration_s",
        "seconds",
        "faults",
        "declared",
        "events",
        "fault_effect_rad_s",
    } <= set(summary)
    assert "imu_2.y" in {one["channel"] for one in summary["declared"]}


@pytest.fixture(scope="module")
def told(faulty, root):
    """The summary of its replay."""
    return replay(faulty, Config.from_file(root / "config" / "three_imus.yaml"))


def visible(path):
    text = re.sub(r"<(script|style).*?</\1>", " ", path.read_text(), flags=re.S)
    # A number and its unit are held together.
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", text)))


@pytest.mark.parametrize(
    ("check", "unmet"),
    [
        ("imu_2.y faulty", ""),
        ("declared=1 isolated imu_1.x ok", ""),
        ("declared=0", "declared=0: 1 episode: imu_2.y FAULTY from "),
        ("imu_2 faulty", "imu_2 faulty: imu_2.x: nothing was declared"),
        ("imu_2.y ok,judged>0.5", "imu_2.y ok: imu_2.y: imu_2.y FAULTY from "),
    ],
)
def test_a_check_works_without_an_injected_fault(check, unmet, told):
    found = failures(
        parse_check(check, 0, Geometry.from_triads([np.eye(3)] * 3).channel_names), told
    )
    assert found[0].startswith(unmet) if unmet else found == [], found


def two_armings(path, write, *, faulty=True):
    """Three units, disarmed for 70 s in between; 5 s into the second arming imu_2.y is off by 0.08 rad/s."""
    units = logs.units(3, seconds=ARMINGS[0], start=10.0)
    for unit, later in zip(
        units, logs.units(3, seconds=ARMINGS[0], start=110.0, seed=1), strict=True
    ):
        for name, values in vars(later).items():
            setattr(unit, name, np.concatenate([getattr(unit, name), values]))
    units[2].rate[3500:, 1] += np.float32(0.08 * faulty)
    return write(path, units)


@pytest.fixture
def armings(tmp_path, fdi):
    log = two_armings(tmp_path / "log.ulg", logs.write_ulog)
    assert fdi("inspect", log, "--write", tmp_path / "config.yaml", "--quiet")[0] == 0
    return log, Config.from_file(tmp_path / "config.yaml")


def test_two_armings_are_judged_and_counted_each_for_itself(armings):
    summary = replay(*armings)
    text = summary_text(summary)
    assert not re.search(r"\bor  |one of [\w.]+ is", text), text
    assert "note: the stamps of all units jumped together, once: a gap" in text
    (one,) = summary.story.episodes
    assert (one.stretch, one.state, one.channels) == (2, "FAULTY", ("imu_2.y",))
    assert one.start_s == pytest.approx(105.0, abs=0.5)
    assert re.match(
        r"FAULTY: imu_2\.y from 105\.\d s\. It is off by 0\.0[78]",
        summary.verdict.sentence,
    )
    assert (
        "\nnote: stretch 1: 0.000 s to 29.990 s, 90 % judged, nothing declared\n"
        in text
    )
    assert (
        "\nnote: stretch 2: 100.000 s to 129.990 s, 100 % judged, 1 episode\n" in text
    )
    assert [round(one["start_s"]) for one in as_json(summary)["stretches"]] == [0, 100]
    # What stood at the end of the first is no evidence in the second.
    early = parse_fault("channel=imu_1.x kind=bias size=0.1 start=20 stop=50")
    first, second = replay(*armings, (early,)).story.episodes
    assert (first.stretch, first.channels, first.injected) == (
        1,
        ("imu_1.x",),
        ("bias on imu_1.x",),
    )
    assert (second.stretch, second.channels, second.injected) == (2, ("imu_2.y",), ())
    late = parse_fault("channel=imu_1.x kind=bias size=0.1 start=60")
    with pytest.raises(
        FaultError, match=r"starts at 60 s, expected at most 29\.99 s or at least"
    ):
        replay(*armings, (late,))


def test_a_sweep_tries_no_fault_in_a_gap(tmp_path, armings):
    topics = ["/imu_1", "/imu_2", "/imu_3"]
    config = armings[1].replaced({"imus.topics": topics})
    block = read_block(
        two_armings(tmp_path / "sound.bin", logs.write_dataflash, faulty=False), config
    )
    plan = Plan(parse_swept("kind=bias size=0.2"), times=6, within=5.0)
    (tried,) = sweep([Subject("all", config, block)], plan)
    assert len(tried.times) == 6
    assert tried.skipped == ()
    first, second = (
        [at for at in tried.times if (at > 50) == late] for late in (False, True)
    )
    assert min(len(first), len(second)) >= 2
    assert max(first) + 5 <= ARMINGS[0] < ARMINGS[1] <= min(second)
    assert {trial.scored.outcome.value for trial in tried.trials} == {"named"}
    with pytest.raises(
        FaultError,
        match="in no piece of it without a gap long enough to watch a fault for 40 s",
    ):
        sweep([Subject("all", config, block)], Plan(plan.faults, times=2, within=40.0))


# What an autopilot says of itself stands beside it, whatever log it is in ---------------------------------------------


def test_errors_and_words_of_a_log_are_told_at_their_times(tmp_path, fdi):
    """Three IMUs from 10 s on; a switch of the lane at 12 s, an error that is over at 13 s, words at 11 s."""
    extra = logs.format_record(5, "ERR", "QBB", "TimeUS,Subsys,ECode")
    for second, subsystem, code in ((12, 24, 1), (13, 16, 0)):
        extra += logs.HEAD + struct.pack(
            "<BQBB", 5, second * 1_000_000, subsystem, code
        )
    extra += logs.HEAD + struct.pack(
        "<BQ64s", 66, 11_000_000, b"EKF3 IMU0 is using GPS\r\n"
    )
    log = logs.write_dataflash(
        tmp_path / "log.bin", logs.units(3, seconds=6.0, start=10.0), extra=extra
    )
    config, page = tmp_path / "config.yaml", tmp_path / "page.html"
    fdi("inspect", log, "--output", config, "--quiet")
    told = json.loads(
        fdi(
            "replay",
            log,
            "--config",
            config,
            "--json",
            "-",
            "--report",
            page,
            "--quiet",
        ).out
    )
    assert [
        (round(one["at_s"], 2), one["kind"], one["text"]) for one in told["autopilot"]
    ] == [
        (1.0, "MSG", "EKF3 IMU0 is using GPS"),
        (2.0, "ERR", "EKF lane switched to 1"),
        (3.0, "ERR", "EKF check: resolved"),
    ]
    # Once over the plots of the gyros, of the accelerometers, and of the states.
    words = "autopilot at 2.000 s: EKF lane switched to 1"
    assert page.read_text().count(words) == 3


def test_messages_that_px4_logs_are_told(tmp_path):
    message = logs.ulog_message(
        b"L", struct.pack("<cQ", b"4", 12_000_000) + b"EKF2 0 lost"
    )
    log = logs.write_ulog(
        tmp_path / "log.ulg", logs.units(2, seconds=4.0, start=10.0), gps=False
    )
    log.write_bytes(log.read_bytes() + message)
    with Recording(log) as recording:
        (one,) = recording.texts
    assert (one.stamp, one.kind, one.text) == (12_000_000_000, "WARNING", "EKF2 0 lost")


def test_status_texts_of_a_telemetry_log_are_told(root):
    log = root.parent / "shared" / "data" / "sitl" / "biases.tlog"
    if not log.exists():
        pytest.skip("the shared recordings are not there")
    with Recording(log) as recording:
        texts = [one.text for one in recording.texts]
    assert {"AHRS: EKF3 active", "EKF3 IMU1 is using GPS"} <= set(texts)


def test_a_condition_on_a_unit_is_about_its_gyros_or_its_accelerometers():
    names = [f"imu_1.{one}" for one in ("x", "y", "z", "accel_x", "accel_y", "accel_z")]
    (gyros,) = parse_check("imu_1 faulty", 0, names)
    (forces,) = parse_check("imu_1.accel ok", 0, names)
    (one,) = parse_check("imu_1.accel_y stale", 0, names)
    assert gyros.channels == tuple(names[:3])
    assert forces.channels == tuple(names[3:])
    assert one.channels == ("imu_1.accel_y",)
