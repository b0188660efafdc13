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

from bag.recordings import flight, write_config, write_mcap
from fleet.runs import run, table

from fdi_ros.fleet.findings import Fleet, clustered_share, short_names
from fdi_ros.fleet.flights import Flight
from fdi_ros.replay.outcomes import share

CHANNELS = ("imu_1.x", "imu_1.y", "imu_2.x", "imu_2.y")


def row(number: int, **values: Any) -> dict[str, Any]:
    """A flight in which nothing happened, but for what is given."""
    calm = {
        "flight": str(number),
        "path": f"/kite/{number}.mcap",
        "vehicle": "/kite",
        "measured": True,
        "start": number,
        "date": f"2024-01-{number + 1:02d}T00:00:00Z",
        "axes": ("x", "y") * 2,
        "difference": (0.0,) * 4,
        "duration": 60.0,
        "judged": 1.0,
        "judged_time": 57.0,
        "watched": 50.0,
        **dict.fromkeys(("malformed", "gaps", "episodes", "declared", "sets", "suspected"), 0),
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
    return [(look.row["flight"], look.why) for look in Fleet(rows).looks]


def test_flights_without_a_date_stand_where_their_names_say() -> None:
    """Behind the dated one before them; 10 comes behind 9."""
    named = {"9.bin": "", "10.bin": "", "2.bin": "2024-05-01T00:00:00Z", "3.bin": "2024-04-01T00:00:00Z", "1.bin": ""}
    rows = [
        row(k, path=f"/kite/{name}", date=date, start=int(date[5:7] or 0) * 10**9 if date else k)
        for k, (name, date) in enumerate(named.items())
    ]
    # 3.bin is of an earlier day than 2.bin, by its GPS; 9 and 10 follow it by name.
    names = [one["path"].removeprefix("/kite/") for one in Fleet(rows).flights]
    assert names == ["1.bin", "3.bin", "9.bin", "10.bin", "2.bin"]


def test_vehicles_are_called_by_what_tells_them_apart() -> None:
    names = short_names(["/a/kite/logs", "/a/heron/logs", "/b/gull", "/logs"])
    assert names == {"/a/kite/logs": "kite/logs", "/a/heron/logs": "heron/logs", "/b/gull": "gull", "/logs": "/logs"}


def test_a_bias_that_is_not_the_usual_one_is_worth_a_look() -> None:
    """Of nine flights the bias of one channel has moved in one; three flights say too little of what is usual."""
    biases = [0.0101, 0.0099, 0.0102, 0.0098, 0.0100, 0.0300, 0.0101, 0.0100, 0.0099]
    rows = [row(k, bias=(bias, 0.5, 0.0, 0.0)) for k, bias in enumerate(biases)]
    events = [{"vehicle": "/kite", "channel": "imu_1.x", "after": "SUSPECT", "declares": False}]
    line = Fleet(rows, events=events).channels[0]
    assert (line.name, line.flights, line.suspected) == ("imu_1.x", 9, 1)
    assert line.biases.tolist() == biases
    assert line.bias_spread == pytest.approx(0.0202)
    assert np.isnan(line.drift)
    assert looks(rows) == [("5", ("imu_1.x: bias 0.02 rad/s from that of the other flights",))]
    assert looks(rows[3:6]) == []


def test_a_bias_that_drifts_from_flight_to_flight_is_told_also_where_it_was_refused() -> None:
    """Where no bias could be learned the mean at the quietest says what it is."""
    drift = [0.0, 0.01, 0.03, 0.04, 0.06, 0.07, 0.1, 0.12, 0.14]
    unchecked = {"state": ("UNCHECKED", "OK", "OK", "OK"), "reason": ("bias not learned yet", "", "", "")}
    refused = {**unchecked, "bias_state": "refused, not at rest: imu_1.x had mean 0.1 rad/s (at most 0.05)"}
    rows = [row(k, bias=(value, 0.0, 0.0, 0.0)) for k, value in enumerate(drift[:7])]
    for k in (7, 8):
        means = (drift[k], 0.0, 0.0, 0.0)
        rows.append(row(k, bias=(None, 0.0, 0.0, 0.0), mean_rest=means, **refused))
    fleet = Fleet(rows)
    line = fleet.channels[0]
    assert line.bias_spread == pytest.approx(0.14)
    assert line.drift == pytest.approx(0.14, abs=0.02)
    assert fleet.units[0].largest_bias == pytest.approx(0.14)
    words = "at the end: imu_1.x UNCHECKED (bias not learned yet); biases refused, not at rest: imu_1.x had mean 0.1"
    assert [(number, why[0][: len(words)]) for number, why in looks(rows)] == [("7", words), ("8", words)]


@pytest.mark.parametrize("count", [3, 5, 7, 10, 40])
def test_of_sound_fleets_hardly_any_flight_is_worth_a_look(count: int) -> None:
    """Biases that only scatter from flight to flight, however few flights say by how much."""
    random = np.random.default_rng(count)
    noted = drifting = 0
    for _ in range(40):
        rows = [row(k, bias=tuple(random.normal(0, 0.01, 4))) for k in range(count)]
        fleet = Fleet(rows)
        noted += len(fleet.looks)
        drifting += any(np.isfinite(line.drift) for line in fleet.channels)
    # One in 2500 by the one rule and one in 50 fleets by the other, at most.
    assert noted <= 1
    assert drifting <= 4


def test_a_unit_is_noisy_in_flight_beside_the_others_not_where_all_of_them_shake() -> None:
    rows = [row(k) for k in range(4)]
    rows += [row(4, noise_motion=(0.1,) * 4), row(5, noise_motion=(0.01, 0.01, 0.05, 0.05))]
    # A flight of other units has another usual.
    rows.append(row(6, noise_motion=(0.5, 0.01, 0.1, 0.1), channels=("imu_1.x", "imu_3.x", "imu_4.x", "imu_4.y")))
    # Begun in the air.
    rows.append(row(7, noise_rest=(0.02,) * 4))
    assert looks(rows) == [("5", ("imu_2: noise in motion 5.0 times what is usual beside the other units",))]


def test_a_unit_that_repeats_its_values_is_said_to() -> None:
    rows = [row(k, noise_rest=(0.0,) * 4, noise_motion=(None,) * 4) for k in range(3)] + [row(3)]
    assert looks(rows) == [(str(k), ("imu_1: repeats its values", "imu_2: repeats its values")) for k in range(3)]


def test_settings_that_were_not_measured_and_calibrations_of_others_are_said() -> None:
    rows = [
        row(0, measured=False, declared=1, episodes=1),
        row(1, calibration="on a", declared=1, episodes=1),
        row(2, calibration="on a", declared=1, path="/kite/a"),
    ]
    assert [why[-1] for _, why in looks(rows)] == [
        "or the settings are wrong: mounts and axes were not measured (--config, --calibrate)",
        "or it is another vehicle than that calibrated on a",
        # That one is the vehicle itself.
        "1 channel declared faulty",
    ]
    whole = Fleet(rows[:2])
    assert (whole.unmeasured, whole.declarations.count, whole.hours) == (1, 2, pytest.approx(2 * 57 / 3600))
    # What stands declared cannot be declared.
    assert whole.declarations.hours == pytest.approx(2 * 50 / 3600)


@pytest.mark.parametrize("flights", [5, 10, 30])
@pytest.mark.parametrize("alike", [0.0, 0.3, 1.0])
def test_shares_hold_the_truth_however_alike_the_faults_of_a_flight_are(flights: int, alike: float) -> None:
    """Coverage of the 95 % interval by simulation: each flight has a share of its own, of mean 0.9."""
    random = np.random.default_rng([flights, int(10 * alike)])
    held, trials = 0, 400
    for _ in range(trials):
        if alike == 1.0:
            own = (random.random(flights) < 0.9).astype(float)
        else:
            # Beta-binomial: so much of the variance lies between the flights.
            total = (1 - alike) / alike if alike else 1e9
            own = random.beta(0.9 * total, 0.1 * total, flights)
        found = clustered_share([(int(random.binomial(18, p)), 18) for p in own])
        assert found is not None
        held += found.low <= 0.9 <= found.high
    assert held / trials > 0.9


def test_shares_of_one_flight_and_of_flights_that_agree() -> None:
    assert clustered_share([(3, 7)]) is None
    # Each flight counts as one where all say the same; four degrees of freedom.
    found = clustered_share([(18, 18)] * 5)
    assert found is not None
    assert found.high == 1.0
    assert found.low == pytest.approx(share(5, 5, 2.7764).low, abs=1e-4)


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
    config = write_config(tmp_path / "config.yaml")
    run(tmp_path / "o", tmp_path, "--config", config, "--json", tmp_path / "all.json")
    gap, short = table(tmp_path / "o")
    assert gap["duration"] > 3600
    assert gap["judged_time"] < 10
    assert short["judged"] == 1.0
    said = capsys.readouterr().out
    assert "short.mcap" not in said
    figures = json.loads((tmp_path / "all.json").read_text())
    assert figures["hours"] == pytest.approx((gap["judged_time"] + short["judged_time"]) / 3600)
