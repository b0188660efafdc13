# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration: simulated units with known truth, what it refuses and warns of, and the real recording."""

import json
import re
import runpy
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import butter, lfilter, sosfiltfilt

from fdi_ros.bag.samples import read_block
from fdi_ros.calibration.calibrate import calibrate
from fdi_ros.calibration.data import prepare
from fdi_ros.calibration.plausibility import warnings_of
from fdi_ros.calibration.report import calibration_page
from fdi_ros.calibration.rest import find_rest
from fdi_ros.calibration.result import Calibration
from fdi_ros.calibration.time_series import TimeSeries, time_series
from fdi_ros.calibration.trial import Trial, Unit, run_trial, simulated_unit
from fdi_ros.cli.command_line import main
from fdi_ros.cli.outputs import Kind, check_target
from fdi_ros.config.config import Config
from fdi_ros.errors import CalibrationError
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.pipeline import Pipeline

CONFIG = Path(__file__).parents[2] / "config"


@cache
def trial(seed: int) -> Trial:
    return run_trial(seed, duration=60.0)


@cache
def three() -> Unit:
    """Three triads of 40 s; single faults can be named."""
    return simulated_unit(11, duration=40.0, triads=3)


def changed(unit: Unit, change: np.ndarray) -> Block:
    return Block(unit.block.stamp, unit.block.z + change)


def seconds(block: Block) -> np.ndarray:
    return (block.stamp - block.stamp[0]) * 1e-9


def rms(values: list[np.ndarray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2)))


def test_calibrations_are_as_right_as_they_say() -> None:
    trials = [trial(seed) for seed in range(6)]
    assert np.degrees(rms([t.angle for t in trials])) < 0.1
    assert rms([t.scale for t in trials]) < 0.001
    # 54 axis components and 36 biases: their rms is within 20 % of 1 but for 3 % of seeds; the benchmark has 50 units.
    assert 0.75 < rms([t.axes_in_errors for t in trials]) < 1.3
    assert 0.75 < rms([t.bias_in_errors for t in trials]) < 1.3
    assert np.abs(np.concatenate([t.bias_in_errors for t in trials])).max() < 4
    assert np.abs(np.concatenate([t.delay_in_errors for t in trials])).max() < 4
    assert all(d.error < 3e-5 for t in trials for d in t.calibration.delays)
    for one in trials:
        for kind in ("rest", "slow", "fast"):
            assert 0.9 < one.calibration.after.of(kind).overall < 1.1
        assert not one.calibration.after.declared
    quantised = np.hypot(0.0025, np.radians(1 / 16.4) / np.sqrt(12))
    std = np.concatenate([t.calibration.noise.std for t in trials])
    assert np.abs(std / quantised - 1).max() < 0.07


def test_any_triad_may_be_the_reference() -> None:
    unit = three()
    result = calibrate(unit.block, unit.config, "imu_2")
    truth = unit.axes @ np.linalg.inv(unit.axes[3:6]) @ result.nominal[3:6]
    assert np.abs(result.axes - truth).max() < 0.001
    assert np.allclose(result.axes[3:6], result.nominal[3:6])


def test_unknown_reference_is_refused_with_those_there_are() -> None:
    with pytest.raises(CalibrationError, match=r"imu_9.*imu_1, imu_2, imu_3"):
        calibrate(three().block, three().config, "imu_9")


def test_bad_values_are_left_out() -> None:
    unit = three()
    rng = np.random.default_rng(5)
    z = unit.block.z.copy()
    for value in (np.nan, np.inf, 34.9):
        z[rng.integers(len(z), size=60), rng.integers(9, size=60)] = value
    spikes = rng.integers(len(z), size=60), rng.integers(9, size=60)
    z[spikes] += rng.choice([-1.0, 1.0], 60)
    z[-200:] = unit.block.z[-200]
    result = calibrate(Block(unit.block.stamp, z), unit.config)
    assert np.abs(result.axes - unit.axes).max() < 0.001
    assert np.abs((result.bias.mean - unit.bias) / result.bias.std).max() < 4
    assert result.unusable.non_finite.sum() > 100
    assert result.unusable.out_of_range.sum() > 50
    assert (result.unusable.repeated == 200).all()
    assert sum("repeats one value exactly for long, 200 samples" in line for line in result.warnings) == 9
    assert not result.faults.spans


def test_faulty_channel_is_named_and_left_out() -> None:
    unit, bad = three(), 4
    at = seconds(unit.block)
    change = np.zeros_like(unit.block.z)
    change[(at > 20) & (at < 30), bad] = 0.1
    result = calibrate(changed(unit, change), unit.config)
    assert [span.channels for span in result.faults.spans] == [(bad,)]
    span = result.faults.spans[0]
    assert abs(span.start - 20) < 1
    assert abs(span.end - 30) < 1
    assert abs(span.size - 0.1) < 0.01
    assert any("imu_2.y disagrees with the others" in line for line in result.warnings)
    assert np.abs(result.axes - unit.axes).max() < 0.002
    assert np.abs((result.bias.mean - unit.bias) / result.bias.std).max() < 4


def test_channel_faulty_for_long_is_refused() -> None:
    unit = three()
    at = seconds(unit.block)
    change = np.zeros_like(unit.block.z)
    change[:, 7] = np.where(at > 8, 0.3 * np.sin(2 * at), 0.0)
    with pytest.raises(CalibrationError, match=r"imu_3\.y .*excluded_channels"):
        calibrate(changed(unit, change), unit.config)


def test_dead_channel_is_refused_and_may_be_excluded() -> None:
    unit = three()
    z = unit.block.z.copy()
    z[:, 5] = 0.01 + 0.0025 * np.random.default_rng(1).standard_normal(len(z))
    with pytest.raises(CalibrationError, match=r"imu_2\.z does not follow the rotation"):
        calibrate(Block(unit.block.stamp, z), unit.config)
    result = calibrate(Block(unit.block.stamp, z), replace(unit.config, excluded_channels=("imu_2.z",)))
    kept = [0, 1, 2, 3, 4, 6, 7, 8]
    assert np.abs(result.axes - unit.axes[kept]).max() < 0.001
    axes = np.reshape(result.settings["geometry.axes"], (-1, 3))
    assert np.allclose(axes[5], Pipeline(unit.config).geometry.axes[5], atol=1e-6)


def test_who_is_on_another_scale_is_named_by_the_majority() -> None:
    unit, two = three(), simulated_unit(11, duration=40.0)
    wide = {"health.max_rate": [2000.0]}
    for one, channels, factor, said in (
        (unit, [3, 4, 5], 57.3, r"imu_2 shows 5\d.\d times (deg/s?) the rotation that imu_1 and imu_3 show"),
        (
            unit,
            [0, 1, 2],
            1 / 57.3,
            "imu_1 shows 0.017[45]\\d* times (are the others in deg/s?) the rotation that imu_2",
        ),
        (unit, [0], 57.3, r"^imu_1.x does not follow the rotation: it shows 5\d.\d* times"),
        (two, [3, 4, 5], 57.3, "imu_1 and imu_2 do not show one rotation, and nothing decides which is right"),
    ):
        z = one.block.z.copy()
        z[:, channels] *= factor
        config = Config.from_parameters({**one.config.parameters(), **wide})
        with pytest.raises(CalibrationError, match=said.replace("(", r"\(").replace("?)", r"\?\)")):
            calibrate(Block(one.block.stamp, z), config)
    # Of two channels on one axis none is believed more than the other.
    parallel = Config.from_parameters({**two.config.parameters(), **wide, "imus.mounts": [*np.eye(3).ravel()] * 2})
    z = np.hstack(
        [two.block.z[:, :3], two.block.z[:, :3] + 0.002 * np.random.default_rng(2).standard_normal((4001, 3))]
    )
    z[:, 3] /= 57.3
    with pytest.raises(CalibrationError, match=r"nothing decides which of imu_1.x, imu_2.x is right"):
        calibrate(Block(two.block.stamp, z), parallel)


def test_exact_repeats_are_neither_rest_nor_data() -> None:
    unit = three()
    z, still = unit.block.z.copy(), []
    for _ in range(2):
        data = prepare(Block(unit.block.stamp, z), np.full(9, 35.0))
        still.append(find_rest(data, 0.1).window[data.window].sum())
        z[-600:] = 0.0
    assert (data.repeated == 600).all()
    assert still[1] <= still[0]
    # So coarse that at rest hardly any value changes: that is rest.
    coarse = np.round(unit.block.z, 2)
    coarse[:1000] = coarse[0]
    coarse[np.arange(0, 1000, 60), 2] += 0.01
    assert not prepare(Block(unit.block.stamp, coarse), np.full(9, 35.0)).repeated.any()


def test_silent_channel_is_refused() -> None:
    unit = three()
    z = unit.block.z.copy()
    z[len(z) // 2 :, 2] = np.nan
    with pytest.raises(CalibrationError, match=r"imu_1\.z gives a usable value in 50%"):
        calibrate(Block(unit.block.stamp, z), unit.config)


def test_one_second_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"1\.0 s long, a calibration needs at least 10 s"):
        calibrate(three().block[:100], three().config)


def test_without_rotation_is_refused() -> None:
    unit = three()
    noise = 0.0025 * np.random.default_rng(3).standard_normal((3000, 9)) + unit.bias
    with pytest.raises(CalibrationError, match="no rotation to calibrate on"):
        calibrate(Block(unit.block.stamp[:3000], noise), unit.config)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_never_turned_is_named(axis: int) -> None:
    unit = three()
    steady = unit.block.z - unit.bias
    rate = steady @ np.linalg.pinv(unit.axes).T
    still = changed(unit, -np.outer(rate[:, axis], unit.axes[:, axis]))
    with pytest.raises(CalibrationError, match=f"too little rotation about {'xyz'[axis]} of base_link"):
        calibrate(still, unit.config)


def test_reversed_axis_is_found_and_named() -> None:
    unit = three()
    z = unit.block.z.copy()
    z[:, 3] *= -1
    result = calibrate(Block(unit.block.stamp, z), unit.config)
    assert np.abs(result.axes[3] + unit.axes[3]).max() < 0.002
    assert any("imu_2.x points opposite" in line for line in result.warnings)


def test_reversed_axis_of_the_reference_is_blamed_on_the_reference() -> None:
    unit = three()
    z = unit.block.z.copy()
    z[:, 1] *= -1
    warnings = calibrate(Block(unit.block.stamp, z), unit.config).warnings
    assert any("imu_1.y of the reference points the other way" in line for line in warnings)
    assert not any("imu_2" in line or "imu_3" in line for line in warnings)


def test_wrong_scale_of_the_reference_is_blamed_on_the_reference() -> None:
    unit = three()
    z = unit.block.z.copy()
    z[:, 0] *= 1.2
    warnings = calibrate(Block(unit.block.stamp, z), unit.config).warnings
    assert any(re.search(r"imu_1\.x of the reference reads 1\.[12]\d* of what all other", line) for line in warnings)


def test_large_offset_in_time_is_shown() -> None:
    unit = simulated_unit(21, duration=60.0)
    late = unit.block.z.copy()
    late[:-1, 3:] = late[1:, 3:]  # the second triad samples one period later than its stamp: the stamp is early
    result = calibrate(Block(unit.block.stamp, late), unit.config)
    delay = result.delays[0]
    assert delay.shown
    assert abs(delay.value - (unit.delay[0] - 0.01)) < 1e-3
    assert result.settings["imus.delays"] == [0.0, pytest.approx(delay.value, abs=1e-6)]


def test_coloured_noise_is_no_fault() -> None:
    # AR(1) 0.9: a quarter of a second holds three independent samples, not 25.
    unit = simulated_unit(8, duration=30.0, triads=3)
    colour = lfilter(
        [np.sqrt(1 - 0.9**2)], [1, -0.9], np.random.default_rng(8).standard_normal(unit.block.z.shape), axis=0
    )
    result = calibrate(changed(unit, 0.01 * colour), unit.config)
    assert not result.faults.spans
    assert np.abs((result.bias.mean - unit.bias - 0.01 * colour.mean(axis=0)) / result.bias.std).max() < 4


# Flights: no rest, vibration.


@dataclass(frozen=True)
class Flight:
    config: Config
    block: Block
    axes: np.ndarray
    bias: np.ndarray
    late: tuple[float, ...]
    noise: np.ndarray
    """(n,) of one sample, vibration included."""


def flown(
    seed: int,
    duration: float = 30.0,
    late: tuple[float, ...] = (0.0, 0.003, -0.002),
    rate: tuple[float, float, float] = (1.0, 0.6, 0.3),
    walk: float = 0.0,
) -> Flight:
    """Parallel units on a vehicle that turns below 3 Hz and vibrates at 30 to 45 Hz, each unit in its own way."""
    rng, fs, over = np.random.default_rng([11, seed]), 100, 10
    count, channels = int(duration * fs), 3 * len(late)
    turns = sosfiltfilt(butter(2, 3.0, fs=fs * over, output="sos"), rng.standard_normal((count * over, 3)), axis=0)
    turns *= np.array(rate) / turns.std(axis=0)
    nominal = np.tile(np.eye(3), (len(late), 1))
    axes = nominal + 0.01 * rng.standard_normal(nominal.shape)
    axes[:3] = np.eye(3)
    at, fine = np.arange(count) / fs, np.arange(count * over) / (fs * over)
    z = np.column_stack([np.interp(at - late[i // 3], fine, turns @ axes[i]) for i in range(channels)])
    shake = sosfiltfilt(butter(2, [30, 45], "band", fs=fs, output="sos"), rng.standard_normal(z.shape), axis=0)
    shake *= rng.uniform(0.03, 0.06, channels) / shake.std(axis=0)
    bias = 0.02 * rng.standard_normal(channels)
    wander = np.cumsum(walk / np.sqrt(fs) * rng.standard_normal(z.shape), axis=0)
    z += bias + wander + shake + 0.003 * rng.standard_normal(z.shape)
    config = Config.from_parameters(
        {"input": "imus", "imus.topics": [f"u{k}" for k in range(len(late))], "sample_rate": float(fs)}
    )
    stamp = (at * 1e9).round().astype(np.int64)
    return Flight(config, Block(stamp, z), axes, bias, late, np.hypot(shake.std(axis=0), 0.003))


@cache
def flight_calibration(seed: int) -> tuple[Flight, Calibration]:
    flight = flown(seed)
    return flight, calibrate(flight.block, flight.config)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_flight_without_rest_gives_axes_delays_and_noise(seed: int) -> None:
    flight, result = flight_calibration(seed)
    assert np.abs(result.axes - flight.axes).max() < 0.003
    np.testing.assert_allclose([d.value for d in result.delays], flight.late[1:], atol=1e-4)
    np.testing.assert_allclose(result.settings["imus.delays"], flight.late, atol=1e-4)
    np.testing.assert_allclose(result.noise.std, flight.noise, rtol=0.1)
    assert not result.faults.spans


def test_vibration_goes_into_the_noise_and_not_into_scale_or_timing() -> None:
    _, result = flight_calibration(0)
    assert result.noise.scale < 0.002
    assert result.noise.timing < 0.1e-3


def test_biases_of_a_flight_are_relative_and_said_to_be() -> None:
    flight, result = flight_calibration(0)
    V = Geometry(result.axes).parity
    assert np.abs(V @ (result.bias.mean - flight.bias)).max() < 5e-4
    assert np.abs(np.linalg.pinv(result.axes) @ result.bias.mean).max() < 1e-6
    assert "what all units have in common looks like a rotation and is left 0" in " ".join(result.notes)
    assert result.settings["bias.turn_on_std"] > 0
    assert "noise.bias_walk" not in result.settings


def test_the_walk_of_a_flight_is_found_and_written() -> None:
    flight = flown(3, duration=60.0, walk=1e-3)
    result = calibrate(flight.block, flight.config)
    assert 5e-4 < result.settings["noise.bias_walk"][0] < 2e-3


def test_axes_that_the_flight_does_not_show_are_kept_and_named() -> None:
    flight = flown(4, rate=(0.6, 0.3, 0.001))
    result = calibrate(flight.block, flight.config)
    assert np.abs(result.axes[:, :2] - flight.axes[:, :2]).max() < 0.005
    np.testing.assert_allclose(result.axes[:, 2], np.tile([0, 0, 1], 3), atol=0.002)
    assert any("about z of base_link" in line and "kept as configured" in line for line in result.notes)


def test_a_fault_in_flight_is_named_and_left_out() -> None:
    flight, bad = flown(5), 7
    z = flight.block.z.copy()
    z[1500:1900, bad] += 0.3
    result = calibrate(Block(flight.block.stamp, z), flight.config)
    assert [span.channels for span in result.faults.spans] == [(bad,)]
    assert abs(result.faults.spans[0].start - 15) < 0.6
    assert abs(result.faults.spans[0].end - 19) < 0.6
    assert np.abs(result.axes - flight.axes).max() < 0.004


def test_parallel_twins_share_their_noise_and_it_is_said() -> None:
    flight = flown(6, late=(0.0, 0.004))
    result = calibrate(flight.block, flight.config)
    np.testing.assert_allclose(result.noise.std, flight.noise, rtol=0.1)
    assert any("imu_1.x and imu_2.x" in line and "cannot be told" in line for line in result.notes)


def test_vibration_without_rotation_is_refused() -> None:
    flight = flown(7, rate=(1e-6, 1e-6, 1e-6))
    with pytest.raises(CalibrationError, match="no rotation"):
        calibrate(flight.block, flight.config)


def test_real_flights_of_one_vehicle_agree(root: Path) -> None:
    folder = root.parent / "shared" / "data" / "phantom4"
    if not folder.exists():
        pytest.skip(f"the recordings of a real flight are not here: {folder}")
    config = Config.from_parameters(
        {"input": "imus", "imus.topics": [f"/imu_{k}/data_raw" for k in (1, 2, 3, 4)], "sample_rate": 120.0}
    )
    first, other = (calibrate(read_block(folder / name, config, 5.0, 20.0), config) for name in ("h04", "h05"))
    assert np.abs(first.axes - other.axes).max() < 0.005
    assert np.abs(Geometry(first.axes).parity @ (first.bias.mean - other.bias.mean)).max() < 0.001
    np.testing.assert_allclose([d.value for d in first.delays], [d.value for d in other.delays], atol=1e-4)
    assert max(first.noise.scale, other.noise.scale) < 0.003
    assert max(first.noise.timing, other.noise.timing) < 1e-4


# The real recording.


@pytest.fixture
def real(recording: Path) -> tuple[Block, Config, Calibration]:
    return calibrated(recording)


@cache
def calibrated(recording: Path) -> tuple[Block, Config, Calibration]:
    config = Config.from_file(CONFIG / "three_imus.yaml")
    block = read_block(recording, config)
    result = calibrate(block[: int(180 * 62.5)], config)
    return block, Config.from_parameters({**config.parameters(), **result.settings}), result


def test_real_gyros_residuals(real: tuple[Block, Config, Calibration]) -> None:
    after = real[2].after
    rest = after.of("rest")
    assert np.degrees(np.sqrt(np.mean(rest.residual**2))) <= 0.15
    assert 0.95 < rest.overall < 1.05
    assert 0.8 < after.of("slow").overall < 1.25
    assert 0.8 < after.of("fast").overall < 1.25
    assert not after.declared
    assert after.implied < 10 * after.configured


def test_real_gyros_saturation_is_out_of_range(real: tuple[Block, Config, Calibration]) -> None:
    block, config, _ = real
    pipeline = Pipeline.from_config(config)
    output = pipeline.process(block)
    assert not any(event.declares for event in output.events)
    counted = [channel.out_of_range for channel in pipeline.status().channels]
    assert counted == (np.abs(block.z) >= 34.8).sum(axis=0).tolist()


@pytest.mark.parametrize("channel", range(9))
def test_real_gyros_bias_is_isolated_at_rest(real: tuple[Block, Config, Calibration], channel: int) -> None:
    block, config, _ = real
    at = int(10 * 62.5)
    z = block.z[: at + 62].copy()
    z[at:, channel] += 0.05
    pipeline = Pipeline.from_config(config)
    output = pipeline.process(Block(block.stamp[: len(z)], z))
    declared = [(e.channel, (e.stamp - block.stamp[at]) * 1e-9) for e in output.events if e.after.name == "FAULTY"]
    assert [name for name, _ in declared] == [channel]
    assert declared[0][1] < 0.4


def test_real_gyros_drift_is_isolated(real: tuple[Block, Config, Calibration]) -> None:
    block, config, _ = real
    at, end = int(20 * 62.5), int(40 * 62.5)
    for channel in range(9):
        z = block.z[:end].copy()
        z[at:, channel] += 0.002 * (block.stamp[at:end] - block.stamp[at]) * 1e-9
        output = Pipeline.from_config(config).process(Block(block.stamp[:end], z))
        declared = [(e.channel, (e.stamp - block.stamp[at]) * 1e-9) for e in output.events if e.after.name == "FAULTY"]
        assert [name for name, _ in declared] == [channel]
        assert declared[0][1] < 15


def shown(block: Block, config: Config, result: Calibration) -> tuple[TimeSeries, str]:
    series = time_series(block, config, result)
    return series, calibration_page(result, "a recording", series)


def test_page_shows_rest_residuals_and_noise() -> None:
    unit, result = simulated_unit(0, duration=60.0), trial(0).calibration
    series, text = shown(unit.block, unit.config, result)
    assert sum(last - first for first, last in series.rest) == pytest.approx(result.seconds.rest, rel=0.05)
    assert np.nanstd(series.after) < 0.7 * np.nanstd(series.before)
    # Over one sample at rest: the noise of the gyros, quantised.
    assert series.still.deviation[0] == pytest.approx(result.noise.std, rel=0.1)
    for title in ("Motion", "Residuals before and after", "Allan deviation at rest", "Spectrum in motion"):
        assert f"<h2>{title}</h2>" in text
    assert "Nothing to warn of." in text


def test_page_of_a_flight_without_rest() -> None:
    flight, result = flight_calibration(0)
    series, text = shown(flight.block, flight.config, result)
    assert "Nowhere at rest." in text
    assert "Allan deviation at rest" not in text
    assert "<h2>Spectrum in motion</h2>" in text
    assert len(series.moving.frequency) > 30


def test_a_bias_that_moves_is_warned_of() -> None:
    result = trial(0).calibration
    assert not any(line.startswith("bias of") for line in result.warnings)
    curve = result.bias.curve.copy()
    curve[:, 4] += 0.0008 * np.sin(result.bias.time / 10)
    warnings = warnings_of(replace(result, bias=replace(result.bias, curve=curve)))
    (line,) = (line for line in warnings if line.startswith("bias of"))
    assert re.fullmatch(r"bias of imu_2.y moved within the recording, by up to 0.0016 rad/s \(0.09\d? deg/s\).*", line)


def test_verb_writes_a_config_that_works(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output, report = tmp_path / "new.yaml", tmp_path / "report.html"
    words = ["calibrate", str(recording), "--config", str(CONFIG / "three_imus.yaml"), "--end", "180"]
    assert main([*words, "--output", str(output), "--report", str(report)]) == 0
    assert "self-check" in capsys.readouterr().out
    Pipeline.from_config(Config.from_file(output))
    assert "<h2>Self-check</h2>" in report.read_text()
    assert "imu_1.x, imu_1.z, imu_2.z moved within the recording" in report.read_text()
    assert main([*words, "--output", str(output)]) == 2
    assert "exists already" in capsys.readouterr().err
    # A former result is replaced where it is asked for, a file that a person wrote never is.
    mine = tmp_path / "mine.yaml"
    mine.write_text("# Calibrated: last week\n" + (CONFIG / "three_imus.yaml").read_text())
    assert main([*words, "--output", str(mine), "--force"]) == 2
    assert "mine.yaml is no result of fdi" in capsys.readouterr().err
    check_target(output, Kind.PARAMETERS, force=True)
    check_target(report, Kind.PAGE, force=True)


def test_tutorial_recording(root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = runpy.run_path(str(root / "examples" / "make_tutorial_bag.py"))
    script["write"](script["record"](), tmp_path / "bracket")
    (tmp_path / "bracket.yaml").write_text(script["CONFIG"])
    bag, output = str(tmp_path / "bracket"), tmp_path / "calibrated.yaml"
    words = ["calibrate", bag, "--config", str(tmp_path / "bracket.yaml"), "--output", str(output)]
    assert main([*words, "--json", "-", "--degrees"]) == 0
    out, err = capsys.readouterr()
    said = re.search(r"rear\.z: stamps ([\d.]+) \+- ([\d.]+) ms early .*: taken off by imus.delays", err)
    assert said is not None
    assert "bias deg/s" in err
    assert "bias.startup_bias_duration 0.0 (was 3.0)" in err
    figures = json.loads(out)
    assert figures["settings"]["imus.delays"] == [0.0, pytest.approx(-1e-3 * float(said[1]), abs=1e-6)]
    assert [channel["name"] for channel in figures["channels"]][:2] == ["front.x", "front.y"]
    assert "mounts:" not in output.read_text()
    assert "none is learned at the start" in output.read_text()
    assert abs(float(said[1]) - 0.4) < 4 * float(said[2])
    block = read_block(tmp_path / "bracket", Config.from_file(output))
    calibrated = Pipeline.from_config(Config.from_file(output)).process(block)
    assert not any(event.declares for event in calibrated.events)
