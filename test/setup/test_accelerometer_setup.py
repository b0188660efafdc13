# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration of accelerometers: simulated vehicles with known truth, what no recording shows, what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from monitor.streams import SIGMA
from monitor.test_accelerometers import CONE, NOISE, array_settings
from vehicles import START, forces_of, vehicle

from fdi_ros.config.config import Config
from fdi_ros.errors import ConfigError
from fdi_ros.inspection.findings import Role, lines_of
from fdi_ros.model.quantity import FORCE
from fdi_ros.model.samples import Block
from fdi_ros.monitor.accelerometers import accelerometer_config
from fdi_ros.monitor.building import build_geometry
from fdi_ros.monitor.output import ChannelState
from fdi_ros.monitor.pipeline import Pipeline
from fdi_ros.setup.calibrate import calibrate
from fdi_ros.setup.noise import projector
from fdi_ros.setup.report import calibration_figures, calibration_findings

pytestmark = pytest.mark.usefixtures("compiled")
ARMS = np.array([[0.0, 0.0, 0.0], [0.1, -0.05, 0.02], [0.0, 0.0, -0.03]])


def lines(result, role):
    return lines_of(list(calibration_findings(result, "base_link")), role)


@pytest.mark.parametrize("kind", ["rest and turns", "flight with rest", "flight alone"])
def test_errors_against_each_other_are_within_three_standard_errors(kind):
    one = vehicle(1, kind)
    truth = forces_of(one, ARMS, noise=0.3, seed=1)
    fit = calibrate(truth.block, one.config).accelerometers
    apart = projector(fit.axes)
    bias = (fit.estimate.bias - apart @ truth.bias) / fit.bias_std
    of_axes = fit.axes - (fit.nominal + apart @ (truth.axes - fit.nominal))
    for ratio in (bias, of_axes / fit.axes_std):
        assert np.abs(ratio).max() < 3.5
        assert 0.3 < np.sqrt(np.mean(ratio**2)) < 1.7
    # Errors are useful, too: a quarter of the biases of 0.2 m/s^2 and scales of 0.5 %.
    assert fit.bias_std.max() < 0.06
    assert fit.axis_errors.max() < 0.006
    np.testing.assert_allclose(fit.estimate.floor.std, 0.3, rtol=0.1)


def test_what_is_written_is_taken_by_the_monitor_and_nothing_healthy_is_declared():
    one = vehicle(2, "flight with rest")
    truth = forces_of(one, ARMS)
    result = calibrate(truth.block, one.config)
    config = Config.from_parameters(one.config.replaced(result.settings).parameters())
    own = config.accelerometers
    derived = accelerometer_config(config, (0, 1, 2))
    apart = projector(result.accelerometers.axes)
    np.testing.assert_allclose(
        apart @ np.array(derived.bias.fixed) * FORCE.natural,
        apart @ truth.bias,
        atol=0.01,
    )
    axes = build_geometry(derived).axes
    np.testing.assert_allclose(apart @ axes, apart @ truth.axes, atol=0.002)
    assert min(own.noise_std) >= 0.2
    assert 0.002 <= min(own.scale_std) < 0.005
    pipeline = Pipeline(config)
    output = pipeline.process(truth.block)
    states = output.state[:, 9:]
    assert not np.isin(states, (ChannelState.FAULTY, ChannelState.AMBIGUOUS)).any()
    assert (states[len(states) // 4 :] == ChannelState.OK).mean() > 0.9
    # A unit whose accelerometers are excluded leaves the settings of the others in place.
    two = accelerometer_config(config, (0, 2))
    assert two.bias.fixed == derived.bias.fixed[:3] + derived.bias.fixed[6:]
    np.testing.assert_array_equal(build_geometry(two).axes, axes[[0, 1, 2, 6, 7, 8]])


def test_an_array_of_accelerometers_is_calibrated_beside_its_gyros():
    """Six and six on one cone, with errors of 0.2 m/s^2 and 0.5 %."""
    one = vehicle(1, "flight with rest")
    random = np.random.default_rng(3)
    block = forces_of(one, np.zeros((1, 3))).block
    axes = CONE + random.normal(0.0, 0.005, CONE.shape)
    bias = random.normal(0.0, 0.2, 6)
    truth = block.acceleration.z @ np.linalg.inv(one.axes[:3]).T
    rate = one.motion.rate_at((block.stamp - START) * 1e-9)
    samples = (len(block), 6)
    block = Block(
        block.stamp,
        rate @ CONE.T + random.normal(0.0, SIGMA, samples),
        None,
        Block(block.stamp, truth @ axes.T + bias + random.normal(0.0, NOISE, samples)),
    )
    config = array_settings()
    result = calibrate(block, config)
    fit = result.accelerometers
    assert fit.names == ("a1", "a2", "a3", "a4", "a5", "a6")
    apart = projector(fit.axes)
    ratio = (fit.estimate.bias - apart @ bias) / fit.bias_std
    assert np.abs(ratio).max() < 4.0
    assert fit.bias_std.max() < 0.05
    of_axes = fit.axes - (fit.nominal + apart @ (axes - fit.nominal))
    assert np.abs(of_axes / fit.axes_std).max() < 4.0
    np.testing.assert_allclose(fit.estimate.floor.std, NOISE, rtol=0.1)
    pipeline = Pipeline(config.replaced(result.settings))
    assert not [one for one in pipeline.process(block).events if one.declares]


def test_a_common_error_is_not_seen_and_the_report_states_that():
    one = vehicle(1, "flight with rest")
    block = forces_of(one, ARMS).block
    axes = np.array([row / np.linalg.norm(row) for row in one.nominal.axes])
    shared = block.acceleration.z + axes @ [0.5, -0.5, 0.5]
    moved = replace(block, acceleration=Block(block.stamp, shared))
    before, result = (calibrate(b, one.config) for b in (block, moved))
    np.testing.assert_allclose(
        before.accelerometers.estimate.bias,
        result.accelerometers.estimate.bias,
        atol=0.02,
    )
    assert any("all have in common" in line for line in lines(result, Role.UNKNOWN))
    figures = calibration_figures(result)["accelerometers"]
    assert len(figures["channels"]) == 9
    assert figures["channels"][0]["noise_std"] == pytest.approx(0.05, rel=0.1)


def test_in_one_attitude_scale_factors_are_not_measured():
    one = vehicle(0, "rest and turns")
    result = calibrate(forces_of(one, ARMS).block[:1450], one.config)
    unknown = lines(result, Role.UNKNOWN)
    assert any("on each of its six sides" in line for line in unknown)
    assert not result.accelerometers.measured.any()


@pytest.mark.parametrize(
    ("columns", "change", "words"),
    [
        (slice(3, 6), lambda z: z / 9.81, "times the specific force of the others"),
        (slice(3, 6), lambda z: -z, "swapped or reversed"),
        (slice(0, 9), lambda z: z / 9.81, "they are in g"),
        (
            slice(4, 5),
            lambda z: z * np.nan,
            "gives a usable value in 0 % of the samples",
        ),
    ],
)
def test_accelerometers_that_contradict_each_other_leave_the_gyros_calibrated(
    columns, change, words
):
    one = vehicle(1, "rest and turns")
    block = forces_of(one, ARMS).block
    z = block.acceleration.z.copy()
    z[:, columns] = change(z[:, columns])
    result = calibrate(replace(block, acceleration=Block(block.stamp, z)), one.config)
    assert words in result.refused
    assert result.accelerometers is None
    assert "bias.fixed" in result.settings
    assert not [name for name in result.settings if name == "accelerometers.bias"]
    assert any("not calibrated" in line for line in lines(result, Role.UNKNOWN))


def test_a_fault_of_an_accelerometer_is_left_out_of_the_fit():
    one = vehicle(3, "flight with rest")
    truth = forces_of(one, ARMS)
    z = truth.block.acceleration.z.copy()
    z[4000:4500, 4] += 1.0
    block = replace(truth.block, acceleration=Block(truth.block.stamp, z))
    result = calibrate(block, one.config)
    assert not result.refused
    fit = result.accelerometers
    named = {span.channels for span in fit.faults if len(span.channels) == 1}
    assert [fit.names[i] for (i,) in named] == ["imu_2.accel_y"]
    apart = projector(fit.axes)
    assert np.abs(fit.estimate.bias - apart @ truth.bias).max() < 0.02
    assert not result.faults
    assert any("imu_2.accel_y" in line for line in lines(result, Role.WARNING))


def test_axes_of_another_number_of_units_are_refused():
    with pytest.raises(ConfigError, match="has 9 numbers, expected 27"):
        vehicle(0, "rest and turns").config.replaced(
            {"accelerometers.axes": tuple(np.eye(3).ravel())}
        )
