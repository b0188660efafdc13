# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration: simulated vehicles with known truth, what it refuses and says, and the real recordings."""

import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from vehicles import KINDS, NOISE, vehicle

from fdi_ros.bag.samples import read_block
from fdi_ros.cli.outputs import Kind, check_target
from fdi_ros.config.config import Config
from fdi_ros.errors import CalibrationError
from fdi_ros.inspection.findings import Role, lines_of
from fdi_ros.model.samples import Block
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.setup.blocks import prepare
from fdi_ros.setup.calibrate import StampDelay, calibrate
from fdi_ros.setup.report import _delay_words, calibration_findings

CONFIG = Path(__file__).parents[2] / "config"


@cache
def made(seed, kind, units=3):
    one = vehicle(seed, kind, units)
    return one, calibrate(one.block, one.config)


def said(result, role):
    return lines_of(calibration_findings(result, "base_link"), role)


def hand():
    return made(0, "rest and turns")[0]


def seconds(block):
    return (block.stamp - block.stamp[0]) * 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_stated_errors_are_the_actual_ones(kind):
    # Some hundred figures of each; `benchmark/estimator.py calibration` has many vehicles.
    axes, biases, delays, noise = [], [], [], []
    for seed, units in ((0, 3), (1, 2), (2, 3)):
        one, result = made(seed, kind, units)
        axes.append(((result.axes - one.axes) / result.axes_std).ravel())
        biases.append((result.estimate.bias - one.bias) / result.bias_std)
        late, std = result.estimate.delay[::3], result.estimate.delay_std[::3]
        delays.append(((late - one.late) / np.maximum(std, 1e-9))[1:])
        noise.append(result.settings["noise.noise_std"])
    assert 0.7 < np.sqrt(np.mean(np.concatenate(axes) ** 2)) < 1.3
    assert 0.5 < np.sqrt(np.mean(np.concatenate(biases) ** 2)) < 1.5
    assert np.abs(np.concatenate(delays)).max() < 4.5
    # No motion is put into the noise, whatever part of a sample a unit is late by.
    assert all(max(one) < 1.15 * min(one) for one in noise)


def test_stated_errors_grow_where_the_model_does_not_fit():
    """Gyros whose scale differs by 2 % between the directions of turn: no linear model fits them."""
    one, linear = made(0, "rest and turns")
    z = one.block.z.copy()
    for channel, share in ((1, -0.02), (4, 0.02)):
        size = np.abs(z[:, channel])
        z[:, channel] *= 1.0 + share * size / size.max()
    bent = calibrate(Block(one.block.stamp, z, one.block.received), one.config)
    # Two of nine channels by 2 %, a third of which no channel contradicts.
    assert 0.006 < bent.settings["noise.nonlinearity_std"][0] < 0.013
    assert bent.estimate.nonlinearity.is_measured
    assert linear.settings["noise.nonlinearity_std"] == [0.002], "as configured"
    assert linear.estimate.nonlinearity.value < 0.001
    grown = bent.axes_std / linear.axes_std
    assert 1.15 < np.median(grown) < 3.0
    assert np.abs((bent.axes - one.axes) / bent.axes_std).max() < 4.0


def slow_units(block):
    """The second unit at half the rate of the first, the third at a quarter, between each other."""
    k, z = np.arange(len(block)), block.z.copy()
    for first, every, at in ((3, 2, 0), (6, 4, 1)):
        z[np.ix_(k % every != at, range(first, first + 3))] = np.nan
    return Block(block.stamp, z, np.isfinite(z))


def armed_thrice(block):
    """With two gaps."""
    part = seconds(block) / seconds(block)[-1]
    kept = ~((part > 0.35) & (part < 0.45) | (part > 0.7) & (part < 0.75))
    return Block(block.stamp[kept], block.z[kept])


@pytest.mark.parametrize(
    ("rate", "change"),
    [(10.0, None), (25.0, None), (100.0, slow_units), (100.0, armed_thrice)],
)
@pytest.mark.parametrize("kind", KINDS)
def test_any_recording_gives_settings_with_errors_as_stated(kind, rate, change):
    one = vehicle(7, kind, 3, rate)
    result = calibrate(one.block if change is None else change(one.block), one.config)
    assert np.abs((result.axes - one.axes) / result.axes_std).max() < 4.0
    assert np.abs((result.estimate.bias - one.bias) / result.bias_std).max() < 4.0
    assert (
        np.abs(
            (result.estimate.delay[::3] - one.late)[1:]
            / result.estimate.delay_std[3::3]
        ).max()
        < 4.0
    )
    assert result.estimate.delay_std.max() < (1e-3 if rate > 10.0 else 2e-3)
    assert result.scale[0] < (2e-3 if rate > 10.0 else 3e-3)
    assert not result.faults


def test_without_rest_the_common_part_of_the_biases_is_said_to_be_unknown():
    one, result = made(0, "flight alone")
    assert result.bias_std.min() > 0.005
    assert "never at rest" in said(result, Role.UNKNOWN)[0]
    # Between channels they are known all the same.
    apart = np.eye(9) - one.axes @ np.linalg.pinv(one.axes)
    assert np.abs(apart @ (result.estimate.bias - one.bias)).max() < 0.002


def test_an_axis_never_turned_is_named_and_stays_as_configured():
    one = hand()
    bias = one.block.z[:500].mean(axis=0)
    rate = (one.block.z - bias) @ np.linalg.pinv(one.axes).T
    still = Block(one.block.stamp, one.block.z - np.outer(rate[:, 2], one.axes[:, 2]))
    result = calibrate(still, one.config)
    (line,) = (
        line
        for line in said(result, Role.UNKNOWN)
        if "rotation" in line or "turns" in line
    )
    assert line.startswith("scale factors along z: not measured (no turns about z")
    assert not result.measured.all()
    assert np.abs(result.axes - one.nominal.axes)[:, 2].max() < 0.015


@pytest.mark.parametrize("response", [0.05, 0.15, 0.4])
def test_vibration_that_units_see_differently_teaches_no_scale_factor(response):
    """A hover: lines of the body, also folded down, that each channel sees with gains and phases of its own."""
    rng, one = np.random.default_rng(5), hand()
    t = seconds(one.block)
    z = NOISE * rng.standard_normal((len(t), 9))
    for frequency in (3.0, 7.7, 12.7, 43.0):
        gain = (
            one.nominal.axes
            @ rng.uniform(0.02, 0.06, 3)
            * (1.0 + response * rng.uniform(-1.0, 1.0, 9))
        )
        phase = rng.uniform(0.0, 6.0) + response * rng.uniform(-1.0, 1.0, 9)
        z += np.where(
            t[:, None] > 20.0,
            gain * np.sin(2.0 * np.pi * frequency * t[:, None] + phase),
            0.0,
        )
    result = calibrate(Block(one.block.stamp, z), one.config)
    assert "scale factors: not measured (no turns" in " ".join(
        said(result, Role.UNKNOWN)
    )
    assert (np.abs(result.factor - 1.0) < 3.0 * result.factor_error).all()
    assert np.abs(result.factor - 1.0).max() < 0.02


def test_bad_values_are_left_out_and_counted():
    one, z = hand(), hand().block.z.copy()
    rng = np.random.default_rng(5)
    for value in (np.nan, np.inf, 34.95):
        z[rng.integers(len(z), size=60), rng.integers(9, size=60)] = value
    z[rng.integers(len(z), size=40), rng.integers(9, size=40)] += 1.0
    z[-200:] = z[-201]
    result = calibrate(Block(one.block.stamp, z), one.config)
    np.testing.assert_allclose(result.axes, one.axes, atol=0.03)
    assert np.abs(result.estimate.delay[::3] - one.late).max() < 1e-3
    assert result.unusable["not_finite"].sum() > 100
    assert result.unusable["out_of_range"].sum() > 50
    (lost,) = [one for one in said(result, Role.WARNING) if "values not used" in one]
    assert re.search(r"\d+ that repeat one value \(every channel\)", lost)
    assert len(said(result, Role.WARNING)) <= 6


def test_a_channel_that_fails_is_named_with_its_times_and_left_out():
    one, at = hand(), seconds(hand().block)
    z = one.block.z.copy()
    z[(at > 5) & (at < 9), 4] += 0.1
    result = calibrate(Block(one.block.stamp, z), one.config)
    span = next(span for span in result.faults if span.channels == (4,))
    assert abs(span.start - 5) < 1
    assert "imu_2.y" in said(result, Role.WARNING)[0]
    assert np.abs((result.estimate.bias - one.bias) / result.bias_std).max() < 5


def test_contradictions_are_refused_and_named():
    one = hand()
    z, stamp = one.block.z, one.block.stamp
    wide = one.config.replaced({"health.max_rate": [2000.0]})

    def refused(words, columns, values, config=wide, rows=np.s_[:]):
        change = z.copy()
        change[rows, columns] = values
        with pytest.raises(CalibrationError, match=words):
            calibrate(Block(stamp, change), config)

    refused(
        r"imu_2 measures 5\d.\d times the rotation of imu_1 and imu_3",
        np.s_[3:6],
        57.3 * z[:, 3:6],
    )
    refused(
        r"imu_2 shows a roll to the right as one to the left, unlike imu_1 and imu_3: correct",
        3,
        -z[:, 3],
    )
    swapped = "imu_3 has swapped axes: its channels x, y, z are y, z, x of its mount as configured, unlike imu_1 and"
    refused(swapped, [6, 7, 8], z[:, [7, 8, 6]])
    noise = 0.01 + 0.0025 * np.random.default_rng(1).standard_normal(len(z))
    refused("imu_2", 5, noise, one.config)
    off = r"imu_2.y disagrees with the others in \d\d % of the recording \(from \d+\.\d s\): faulty; repair it"
    late = np.s_[len(z) // 4 :]
    refused(off, 4, z[late, 4] + 0.1, rows=late)
    for words, block in (
        (
            r"1\.0 s long, a calibration needs at least 10 s",
            Block(stamp[:100], z[:100]),
        ),
        (
            r"^the recording has \d\d samples, a calibration needs at least 100$",
            Block(stamp[::100], z[::100]),
        ),
        (
            r"^the recording has a sample every 10 s, a calibration needs one every 1 s$",
            Block(stamp[0] + 100 * (stamp[::10] - stamp[0]), z[::10]),
        ),
    ):
        with pytest.raises(CalibrationError, match=words):
            calibrate(block, wide)
    dead = z.copy()
    dead[:, 5] = noise
    result = calibrate(
        Block(stamp, dead), one.config.replaced({"excluded_channels": ["imu_2.z"]})
    )
    assert len(result.names) == 8
    assert len(result.settings["geometry.axes"]) == 27


def test_the_monitor_waits_for_units_that_are_late():
    one, late = hand(), hand().block.z.copy()
    late[:, 3:6] = np.roll(late[:, 3:6], 9, axis=0)
    result = calibrate(Block(one.block.stamp, late)[20:], one.config)
    assert (
        result.settings["imus.timeout"]
        > 2 * np.ptp(result.settings["imus.delays"])
        > 0.15
    )


def test_no_second_beside_motion_is_rest_and_all_before_is():
    """Noise may hide how a motion begins."""
    one, result = made(0, "rest and turns")
    found = result.estimate
    begins = one.motion.time[1] - np.abs(one.late).max()
    ends = found.blocks.time + 0.5
    assert found.rest[ends < begins - 1.1].all()
    assert not found.rest[(ends > begins - 0.1) & (ends < begins + 3.0)].any()


def test_a_noisy_channel_hides_no_rest():
    one, z = (
        made(0, "flight with rest")[0],
        made(0, "flight with rest")[0].block.z.copy(),
    )
    z[:, 8] += 0.05 * np.random.default_rng(8).standard_normal(len(z))
    result = calibrate(Block(one.block.stamp, z), one.config)
    np.testing.assert_allclose(result.estimate.floor.std[:8], NOISE, rtol=0.15)
    assert result.estimate.rest_seconds > 10.0


def test_a_reference_is_believed():
    one = hand()
    result = calibrate(one.block, one.config, "imu_2")
    np.testing.assert_allclose(result.axes[3:6], one.nominal.axes[3:6], atol=1e-4)


def test_axes_of_an_array_are_found_from_those_of_its_first_three():
    one, array = (
        hand(),
        {"input": "channels", "channels.topic": "/gyros", "geometry.preset": "cone"},
    )
    config = Config.from_parameters(
        {**array, "geometry.cone_channels": 6, "sample_rate": one.config.sample_rate}
    )
    result = calibrate(Block(one.block.stamp, one.block.z[:, :6]), config)
    np.testing.assert_allclose(result.axes[:3], result.nominal[:3], atol=1e-5)
    true = one.axes[:6] @ np.linalg.solve(one.axes[:3], result.nominal[:3])
    assert np.abs(true - result.nominal).max() > 0.5
    assert (np.abs(result.axes - true) < 4.0 * result.axes_std + 1e-5).all()


def test_exact_repeats_are_not_data():
    stamp, z, coarse = (
        hand().block.stamp,
        hand().block.z.copy(),
        np.round(hand().block.z, 2),
    )
    z[-600:] = 0.0
    # So coarse that at rest hardly any value changes: that is rest.
    coarse[:1000] = coarse[0]
    coarse[np.arange(0, 1000, 60), 2] += 0.01
    for values, repeated in ((z, 600), (coarse, 0)):
        assert (
            prepare(Block(stamp, values), np.full(9, 35.0)).unusable["repeated"]
            == repeated
        ).all()


def test_units_20_to_40_ms_apart_in_a_real_flight(root):
    folder = root.parent / "shared" / "data" / "phantom4"
    if not folder.exists():
        pytest.skip(f"the recordings of a real flight are not here: {folder}")
    config = Config.from_parameters(
        {
            "input": "imus",
            "imus.topics": [f"/imu_{k}/data_raw" for k in (1, 2, 3, 4)],
            "sample_rate": 120.0,
        }
    )
    result = calibrate(read_block(folder / "h20", config), config)
    assert result.settings["imus.delays"] == [
        0.0,
        *(pytest.approx(d, abs=0.006) for d in (-0.026, -0.030, 0.014)),
    ]
    assert result.scale[0] < 0.005
    assert not result.faults


def test_verb_writes_a_config_that_works(recording, tmp_path, fdi, refused):
    output, report = tmp_path / "new.yaml", tmp_path / "report.html"
    words = (
        "calibrate",
        recording,
        "--config",
        CONFIG / "three_imus.yaml",
        "--end",
        90,
    )
    code, out, _ = fdi(*words, "--output", output, "--report", report)
    assert code == 0
    assert "(not used for fitting)" in out
    assert re.search(r"^new +nothing +99.93 % +18 of 18", out, re.MULTILINE)
    Pipeline.from_config(Config.from_file(output))
    assert "<h2>Proof</h2>" in report.read_text()
    assert re.search(r"noise_std 0.0018 to 0.004\d* rad/s", out)
    assert "mounts:" not in output.read_text()
    assert "exists already" in refused(*words, "--output", output)
    # A former result is replaced where it is asked for, a file that a person wrote never is.
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "# Calibrated: last week\n" + (CONFIG / "three_imus.yaml").read_text()
    )
    assert "mine.yaml is no result of fdi" in refused(
        *words, "--output", mine, "--force"
    )
    check_target(output, Kind.PARAMETERS, force=True)
    check_target(report, Kind.PAGE, force=True)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (
            0.4e-4,
            "stamps 0.04 +- 0.03 ms late .*, not corrected: the delay may be zero",
        ),
        (-4e-4, r"stamps 0.40 \+- 0.03 ms early .*, corrected"),
        (0.1e-4, r"delay relative to the first unit: zero within \+-0.03 ms"),
    ],
)
def test_the_words_on_a_delay_say_what_may_be_zero(value, words):
    said = _delay_words(StampDelay((3, 4, 5), value, 3e-5), corrected=True)
    assert re.fullmatch(words.replace(" +- ", r" \+- "), said)
