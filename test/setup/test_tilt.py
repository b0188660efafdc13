# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""All units in deg/s are found by the tilt of their accelerometers, and nothing healthy is refused for it."""

import math

import numpy as np
import pytest
from bag.recordings import START, imu, write_mcap

from fdi_ros.inspection.degrees import in_degrees
from fdi_ros.inspection.gravity import in_gravity
from fdi_ros.inspection.segments import NoiseSegments
from fdi_ros.inspection.tilt import sum_of, swings_of
from fdi_ros.inspection.topics import inspect

RATE = 50
DEGREES = math.degrees(1.0)
GRAVITY = np.array([0.0, 0.0, 9.81])


def swings(random, seconds, size, slowest=0.1, fastest=1.2, tones=5):
    """Smooth values (K, 3) with a root mean square."""
    time = np.arange(seconds * RATE) / RATE
    frequency = random.uniform(slowest, fastest, (3, tones, 1))
    phase = random.uniform(0.0, 6.3, (3, tones, 1))
    waves = np.sin(2.0 * np.pi * frequency * time + phase).sum(axis=1)
    return size * math.sqrt(2.0 / tones) * waves.T


def attitudes(rate):
    """Rotations (K, 3, 3) from the body to the world, from the rates (K, 3), rad/s."""
    found = np.empty((len(rate), 3, 3))
    now = np.eye(3)
    for k, turn in enumerate(rate / RATE):
        found[k] = now
        x, y, z = turn
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        now, _ = np.linalg.qr(now @ (np.eye(3) + cross + 0.5 * cross @ cross))
        now *= np.sign(np.sum(now * found[k], axis=0))
    return found


def felt(rate, acceleration):
    """Specific force in the body, m/s^2, of rates and accelerations in the world."""
    return np.einsum("kji,kj->ki", attitudes(rate), acceleration + GRAVITY)


def flown(random, rate, drag):
    """Specific force of a multicopter: thrust turns with the body, and the sensor is off its centre."""
    force = np.empty_like(rate)
    speed = np.zeros(3)
    for k, attitude in enumerate(attitudes(rate)):
        force[k] = GRAVITY - drag * (attitude.T @ speed)
        speed += (attitude @ force[k] - GRAVITY) / RATE
    arm = random.normal(0.0, 0.05, 3)
    turning = np.gradient(rate, 1.0 / RATE, axis=0)
    return force + np.cross(turning, arm) + np.cross(rate, np.cross(rate, arm))


def recording(random, path, rate, force, factor, noise=0.001, vibration=0.03):
    """Write a bag of three units with biases of 2 mrad/s, rates times a factor; its reports."""
    messages = []
    for k in range(3):
        values = rate + random.normal(0.0, 0.002, 3)
        values = factor * (values + random.normal(0.0, noise, rate.shape))
        forces = force + random.normal(0.0, vibration, force.shape)
        for i, (value, one) in enumerate(zip(values, forces, strict=True)):
            at = START + i * 10**9 // RATE + 1000 * k
            messages.append((f"/imu_{k}", at, imu(at, value, force=tuple(one))))
    messages.sort(key=lambda one: one[1])
    return write_mcap(path / "bag.mcap", messages)


def halves(random, rate, force, noise=0.001, vibration=0.03):
    """Segments of the gyros and of the accelerometers of a unit."""
    stamp = START + np.arange(len(rate)) * 10**9 // RATE
    gyros, forces = NoiseSegments(3), NoiseSegments(3)
    values = rate + random.normal(0.0, 0.01, 3) + random.normal(0.0, noise, rate.shape)
    gyros.add(values, stamp, RATE)
    forces.add(force + random.normal(0.0, vibration, force.shape), stamp, RATE)
    return gyros, forces


@pytest.mark.parametrize("seed", range(3))
def test_gentle_units_in_degrees_are_told_by_gravity(seed, tmp_path, fdi, refused):
    random = np.random.default_rng(seed)
    rate = swings(random, 30, 0.03)
    force = felt(rate, swings(random, 30, 0.03))
    path = recording(random, tmp_path, rate, force, DEGREES)
    said = fdi("inspect", path).out.splitlines()[0]
    words = (
        "/imu_0 and /imu_1 and /imu_2 are in deg/s, and show 57.3 times the tilt of the"
        " accelerometers"
    )
    assert said == f"NEEDS rad/s: {words}"
    if not seed:
        assert words in refused("setup", path, "--output", tmp_path / "a.yaml")
        assert words in refused("replay", path)
    path = recording(random, tmp_path, rate, force, 1.0)
    assert in_degrees(inspect(path).reports) == ""


@pytest.mark.parametrize("kind", ["hand", "turns", "copter", "no drag"])
@pytest.mark.parametrize("seed", range(6))
def test_healthy_rates_never_foretell_57_times_the_tilt(kind, seed):
    """Thrust turns with a multicopter, so the factor alone may come near by chance."""
    random = np.random.default_rng(seed)
    rate = swings(random, 40, 10 ** random.uniform(-2.0, 0.2))
    vibration = 10 ** random.uniform(-2.0, 0.7)
    if kind == "turns":
        rate += random.normal(0.0, 0.5, 3)
    if kind in ("hand", "turns"):
        force = felt(rate, swings(random, 40, 10 ** random.uniform(-1.0, 0.5)))
    else:
        force = flown(random, rate, 0.0 if kind == "no drag" else 0.3)
    noise = 0.1 * vibration
    found = sum_of(swings_of(*halves(random, rate, force, noise, vibration)))
    assert not (abs(found.factor / DEGREES - 1.0) < 0.3 and found.shared > 0.25)


def test_a_pendulum_with_its_sensor_off_the_centre_is_no_unit_in_degrees(tmp_path):
    """Gravity swings with it, and the lever arm shows a 57th of the swings, in phase."""
    random = np.random.default_rng(3)
    length = 2.0
    time = np.arange(30 * RATE) / RATE
    turn = math.sqrt(9.81 / length)
    angle = 0.6 * np.sin(turn * time)
    rate = np.column_stack([0.6 * turn * np.cos(turn * time), 0.0 * time, 0.0 * time])
    force = np.zeros_like(rate)
    force[:, 2] = 9.81 * np.cos(angle) + length * rate[:, 0] ** 2
    arm = np.array([0.0, 0.0, length / DEGREES])
    force += np.cross(np.gradient(rate, 1.0 / RATE, axis=0), arm)
    found = sum_of(swings_of(*halves(random, rate, force)))
    assert found.factor == pytest.approx(DEGREES, rel=0.2)
    assert found.shared > 0.5
    path = recording(random, tmp_path, rate, force, 1.0)
    assert in_degrees(inspect(path).reports) == ""


@pytest.mark.parametrize("factor", [1.0, DEGREES])
def test_the_factor_is_that_of_the_unit_of_the_rates(factor):
    random = np.random.default_rng(5)
    rate = swings(random, 60, 0.1)
    force = felt(rate, swings(random, 60, 0.05))
    gyros, forces = halves(random, factor * rate, force)
    found = sum_of(swings_of(gyros, forces))
    assert found.factor == pytest.approx(factor, rel=0.1)
    assert found.shared > 0.8
    # Constant accelerometers, of a simulator, show nothing.
    still = sum_of(swings_of(*halves(random, rate, np.tile(GRAVITY, (3000, 1)), 0, 0)))
    assert (still.factor, still.shared) == (0.0, 0.0)
    assert swings_of(gyros, NoiseSegments(3)) == []


@pytest.mark.parametrize(
    ("units", "words"),
    [
        ((1 / 9.81,) * 3, "/imu_0, /imu_1 and /imu_2 usually show"),
        ((1.0, 1000 / 9.81, 1.0), "/imu_1 usually show 993, as in mg"),
        ((1.0, 1.0, 1.0), ""),
        # Without gravity, as some drivers send it: 1 m/s^2 is no unit.
        ((0.0, 0.0, 0.0), ""),
    ],
)
def test_accelerometers_in_units_of_gravity_are_left_out(units, words, tmp_path, fdi):
    random = np.random.default_rng(4)
    messages = []
    motion = swings(random, 8, 0.6)
    for k, unit in enumerate(units):
        force = unit * GRAVITY + (unit or 1.0) * motion
        force = force + random.normal(0.0, 0.003, force.shape)
        for i, (rate, one) in enumerate(zip(0.3 * motion, force, strict=True)):
            at = START + i * 10**9 // RATE + 1000 * k
            values = rate + random.normal(0.0, 0.001, 3)
            messages.append((f"/imu_{k}", at, imu(at, values, force=tuple(one))))
    messages.sort(key=lambda one: one[1])
    path = write_mcap(tmp_path / "bag.mcap", messages)
    found = in_gravity(inspect(path).reports)
    assert words in found
    assert bool(found) == bool(words)
    if words:
        left_out = "the acceleration of all units is left out: the accelerometers of"
        assert f"READY, BUT LOOK: {left_out} {words}" in fdi("inspect", path).out
        # The gyros are judged all the same.
        replayed = fdi("replay", path)
        assert replayed.out.startswith("LOOK: no fault was found in")
        assert f"{left_out} {words}" in replayed.out
        assert " 9 channels" not in replayed.out
