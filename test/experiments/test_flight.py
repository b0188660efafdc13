# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Simulated flights: the motion is possible for a vehicle, and the gyros are off by what was asked for."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fdi_ros.bag.samples import read_block
from fdi_ros.config.config import Config
from fdi_ros.experiments.flight import GyroErrors, Motion, regular_stamps, vehicle_motion
from fdi_ros.model.geometry import Geometry

ERRORS = ("noise_std", "bias_std", "bias_walk", "scale_std", "misalignment_std", "delay_std", "resolution")
PERFECT = GyroErrors(**dict.fromkeys(ERRORS, 0), max_rate=np.inf)
CONE = Geometry.two_triad_cone()


def acceleration(motion, t):
    return (motion.rate_at(t + 1e-4) - motion.rate_at(t - 1e-4)) / 2e-4


@given(seed=st.integers(0, 2**32 - 1), max_rate=st.floats(0.1, 10), max_acceleration=st.floats(1, 100))
def test_motion_keeps_its_bounds(seed, max_rate, max_acceleration):
    motion = vehicle_motion(
        30.0, np.random.default_rng(seed), rest=5.0, max_rate=max_rate, max_acceleration=max_acceleration
    )
    t = np.linspace(-1, motion.time[-1] + 1, 4000)
    assert np.abs(motion.rate_at(t)).max() <= max_rate * (1 + 1e-12)
    assert np.abs(acceleration(motion, t)).max() <= max_acceleration * (1 + 1e-6)
    assert not motion.rate_at(t[t <= 5.0]).any()
    assert not motion.rate_at(motion.time[-1:] + 1).any()


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ({"noise_std": 0.01}, lambda t: np.full_like(t, 0.01)),
        ({"bias_std": 0.02}, lambda t: np.full_like(t, 0.02)),
        ({"bias_walk": 0.003}, lambda t: 0.003 * np.sqrt(t)),
    ],
)
def test_errors_at_rest_have_the_deviation_asked_for(errors, expected):
    still = Motion(np.array([0.0, 1.0]), np.zeros((2, 3)))
    stamps = regular_stamps(16.0, 10.0)
    rng = np.random.default_rng(11)
    made = (replace(PERFECT, **errors).draw(CONE, rng) for _ in range(400))
    z = np.stack([gyros.measure(still, stamps, rng).z for gyros in made])
    measured = z.std(axis=(0, 2))[1:]
    # 2400 draws: the deviation is known to 1.4 %.
    np.testing.assert_allclose(measured, expected((stamps[1:]) * 1e-9), rtol=0.07)


def test_scale_and_misalignment_turn_and_stretch_the_axes():
    rng = np.random.default_rng(5)
    axes = np.stack([replace(PERFECT, scale_std=0.01, misalignment_std=0.02).draw(CONE, rng).axes for _ in range(2000)])
    along = np.sum(axes * CONE.axes, axis=2)
    across = np.linalg.norm(axes - along[..., None] * CONE.axes, axis=2)
    assert np.std(along) == pytest.approx(0.01, rel=0.05)
    assert np.sqrt(np.mean(across**2) / 2) == pytest.approx(0.02, rel=0.05)


def test_sampling_skew_is_acceleration_times_delay_and_one_a_chip():
    ramp = Motion(np.array([0.0, 10.0]), np.array([[0.0, 0, 0], [3.0, -2.0, 1.0]]))
    stamps = regular_stamps(10.0, 100.0)
    gyros = replace(PERFECT, delay_std=1e-3).draw(CONE, np.random.default_rng(6))
    assert len(np.unique(gyros.delay)) == 2
    t = stamps * 1e-9
    off = gyros.measure(ramp, stamps, np.random.default_rng(0)).z - ramp.rate_at(t) @ CONE.axes.T
    np.testing.assert_allclose(off, acceleration(ramp, t) @ CONE.axes.T * gyros.delay, atol=1e-6)


def test_the_converter_rounds_and_saturates():
    fast = Motion(np.array([0.0, 1.0]), np.array([[0.0, 0, 0], [50.0, -50.0, 20.0]]))
    errors = replace(PERFECT, resolution=0.5, max_rate=30.0)
    z = errors.draw(CONE, np.random.default_rng(0)).measure(fast, regular_stamps(1, 100), np.random.default_rng(0)).z
    np.testing.assert_array_equal(z, np.round(z * 2) / 2)
    assert np.abs(z).max() == 30.0


def test_the_bundled_bag_is_what_its_script_makes(flight, root, monkeypatch):
    """Channels and both Imu topics of the bag against the simulation run again."""
    monkeypatch.syspath_prepend(str(root / "bags"))
    import make_bags

    made = make_bags.fly()
    channels, imus = (
        read_block(flight, Config.from_file(root / "config" / name)) for name in ("two_triads.yaml", "two_imus.yaml")
    )
    # A last-bit difference of the machine's arithmetic may move a value over the edge of a step, no further.
    assert np.abs(channels.z - made.z).max() <= 1.001 * GyroErrors().resolution
    along = np.sum(np.vstack([mount.T for mount in make_bags.mounts()[:2]]) * CONE.axes, axis=1)
    np.testing.assert_allclose(np.abs(along), 1, atol=1e-12)
    np.testing.assert_array_equal(imus.z, channels.z * np.sign(along))
    for read in (channels, imus):
        np.testing.assert_array_equal(read.stamp, made.stamp)
