# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a fleet shows: the flights that a person should look at, units, channels, rates and shares."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra: fleet)")
pytest.importorskip("scipy", reason="SciPy is not installed (extra: fleet)")

import pyarrow.parquet as parquet
from bag.recordings import PARAMETERS, flight, write_mcap

from fdi_ros.cli.command_line import main
from fdi_ros.experiments.tally import share
from fdi_ros.fleet.rows import Flight
from fdi_ros.fleet.summary import channel_lines, clustered_share, to_look_at, totals, unit_lines

CHANNELS = ("imu_1.x", "imu_1.y", "imu_2.x", "imu_2.y")


def row(number: int, **values: Any) -> dict[str, Any]:
    """A flight in which nothing happened, but for what is given."""
    calm = {
        "flight": str(number),
        "path": f"/kite/{number}.mcap",
        "vehicle": "/kite",
        "measured": True,
        "start": number,
        "duration": 60.0,
        "judged": 1.0,
        "judged_time": 57.0,
        "malformed": 0,
        "gaps": 0,
        "episodes": 0,
        "declared": 0,
        "sets": 0,
        "suspected": 0,
        "largest": 0.1,
        "channels": CHANNELS,
        "state": ("OK",) * 4,
        "reason": ("",) * 4,
        "noise_rest": (0.002,) * 4,
        "noise_motion": (0.01,) * 4,
        "vibration": (0.009,) * 4,
        "mean_rest": (0.0,) * 4,
        "bias": (0.0,) * 4,
        "bias_state": "learned",
    }
    return {**asdict(Flight(flight="", path="")), **calm, **values}


def looks(rows: Sequence[dict[str, Any]]) -> list[tuple[str, tuple[str, ...]]]:
    found = to_look_at(rows, unit_lines(rows, ()), channel_lines(rows, ()))
    return [(look.row["flight"], look.why) for look in found]


def test_a_bias_that_is_not_the_usual_one_is_worth_a_look() -> None:
    """Of seven flights the bias of one channel has moved in one; three flights say too little of what is usual."""
    biases = [0.0101, 0.0099, 0.0102, 0.0098, 0.0100, 0.0300, 0.0101]
    rows = [row(k, bias=(bias, 0.5, 0.0, 0.0)) for k, bias in enumerate(biases)]
    line = channel_lines(rows, [{"vehicle": "/kite", "channel": "imu_1.x", "after": "SUSPECT", "declares": False}])[0]
    assert (line.channel, line.flights, line.suspected) == ("imu_1.x", 7, 1)
    assert (line.bias, line.bias_spread) == pytest.approx((0.0101, 0.0202))
    assert line.bias_usual == pytest.approx(1.4826 * 0.0001)
    assert np.isnan(line.drift)
    assert looks(rows) == [("5", ("imu_1.x: bias 0.02 rad/s from the usual",))]
    assert looks(rows[3:6]) == []


def test_a_bias_that_drifts_from_flight_to_flight_is_told_also_where_it_was_refused() -> None:
    """Where no bias could be learned the mean at the quietest says what it is."""
    drift = [0.0, 0.02, 0.05, 0.1, 0.2]
    unchecked = {"state": ("UNCHECKED", "OK", "OK", "OK"), "reason": ("bias not learned yet", "", "", "")}
    refused = {**unchecked, "bias_state": "refused, not at rest: imu_1.x had mean 0.2 rad/s (at most 0.05)"}
    rows = [row(k, bias=(value, 0.0, 0.0, 0.0)) for k, value in enumerate(drift[:3])]
    for k in (3, 4):
        means = (drift[k], 0.0, 0.0, 0.0)
        rows.append(row(k, bias=(None, 0.0, 0.0, 0.0), mean_rest=means, **refused))
    line = channel_lines(rows, ())[0]
    assert line.bias_spread == pytest.approx(0.2)
    assert line.drift == pytest.approx(0.2, abs=0.06)
    assert unit_lines(rows, ())[0].bias == pytest.approx(0.2)
    words = "at the end: imu_1.x UNCHECKED (bias not learned yet); biases refused, not at rest: imu_1.x had mean 0.2"
    assert [(number, why[0][: len(words)]) for number, why in looks(rows)] == [("3", words), ("4", words)]
    # What only scatters does not drift.
    random = np.random.default_rng(1)
    rows = [row(k, bias=(random.normal(0, 0.01), *[0.0] * 3)) for k in range(40)]
    assert np.isnan(channel_lines(rows, ())[0].drift)


def test_a_unit_is_noisy_in_flight_beside_the_others_not_where_all_of_them_shake() -> None:
    rows = [row(k) for k in range(4)]
    rows += [row(4, noise_motion=(0.1,) * 4), row(5, noise_motion=(0.01, 0.01, 0.05, 0.05))]
    assert looks(rows) == [("5", ("imu_2: noise in motion 5.0 times what is usual beside the other units",))]


def test_a_unit_that_repeats_its_values_is_said_to() -> None:
    rows = [row(k, noise_rest=(0.0,) * 4, noise_motion=(None,) * 4) for k in range(3)] + [row(3)]
    assert looks(rows) == [(str(k), ("imu_2: repeats its values", "imu_1: repeats its values")) for k in range(3)]


def test_settings_that_were_not_measured_and_calibrations_of_others_are_said() -> None:
    rows = [row(0, measured=False, declared=1, episodes=1), row(1, calibration="on a", declared=1, episodes=1)]
    assert [why[-1] for _, why in looks(rows)] == [
        "or the settings are wrong: mounts and axes were not measured (--config, --calibrate)",
        "or it is another vehicle than that calibrated on a",
    ]
    whole = totals(rows)
    assert (whole.unmeasured, whole.declarations.count, whole.hours) == (1, 2, pytest.approx(2 * 57 / 3600))


def test_shares_count_in_that_faults_of_one_flight_are_alike() -> None:
    """Of alike flights the interval is Wilson's; of ten in which all faults share their fate, that of ten."""
    alike = clustered_share([(50, 100)] * 10)
    assert alike is not None
    assert (alike.low, alike.high) == pytest.approx((share(500, 1000).low, share(500, 1000).high))
    fates = clustered_share([(100, 100)] * 5 + [(0, 100)] * 5)
    assert fates is not None
    # Ten flights, with Bessel's correction.
    assert (fates.low, fates.high) == pytest.approx((share(4.5, 9).low, share(4.5, 9).high))
    assert clustered_share([(3, 7)]) is None


def test_hours_are_those_judged_and_an_episode_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An hour without samples is none; a short flight is judged but for its start-up; a fault is one declaration."""
    messages = flight(1000)[0]
    hour = 3600 * 10**9
    for k in range(len(messages) // 2, len(messages)):
        topic, log_time, data = messages[k]
        at = int.from_bytes(data[4:8], "little") + 3600
        messages[k] = topic, log_time + hour, data[:4] + at.to_bytes(4, "little") + data[8:]
    write_mcap(tmp_path / "gap.mcap", messages)
    write_mcap(tmp_path / "short.mcap", flight(700)[0])
    (tmp_path / "config.yaml").write_text(json.dumps({"/**": {"ros__parameters": PARAMETERS}}))
    words = ["fleet", str(tmp_path), "--config", str(tmp_path / "config.yaml"), "--output", str(tmp_path / "o")]
    assert main([*words, "--workers", "1", "--json", str(tmp_path / "all.json")]) == 0
    gap, short = parquet.read_table(tmp_path / "o" / "flights.parquet").to_pylist()
    assert gap["duration"] > 3600
    assert gap["judged_time"] < 10
    assert short["judged"] == 1.0
    said = capsys.readouterr().out
    assert "short.mcap" not in said
    figures = json.loads((tmp_path / "all.json").read_text())
    assert figures["hours"] == pytest.approx((gap["judged_time"] + short["judged_time"]) / 3600)
