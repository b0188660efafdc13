# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A sensor that is wrong from the first sample on looks like one with a large bias."""

import numpy as np
import pytest

from fdi_ros.compiling.compiled import allocate
from fdi_ros.config.config import Config
from fdi_ros.core.states import ChannelState
from fdi_ros.estimator.estimator import Constants, Estimator
from fdi_ros.estimator.start_bias import doubt_start
from fdi_ros.model.samples import Block
from fdi_ros.monitor.diagnostics import describe
from fdi_ros.monitor.pipeline import Output, Pipeline
from fdi_ros.monitor.soundness import Word, live_word
from fdi_ros.monitor.status import Status

INTERVAL = 0.01
SECONDS = 10.0
GRAVITY = 9.81


def fly(
    units: int,
    errors: dict[str, float],
    begin: float = 0.0,
    end: float = np.inf,
    seconds: float = SECONDS,
    hole: float = 0.0,
    seed: int = 1,
) -> tuple[Status, Output, np.ndarray]:
    """Return status and output after a gentle flight with constant errors, and the true force.

    hole: length of a hole in the stream each 20 s, s.
    """
    t = np.arange(0.0, seconds, INTERVAL)
    random = np.random.default_rng(seed)
    phase = random.uniform(0.0, 6.0, 3)
    rate = [0.4, 0.3, 0.2] * np.sin(np.outer(t, [0.9, 1.3, 0.5]) + phase)
    force = [1.5, 1.0, 0.8] * np.sin(np.outer(t, [1.1, 0.7, 1.7]) + phase)
    force[:, 2] += GRAVITY
    config = Config.from_parameters(
        {
            "input": "imus",
            "sample_rate": 1.0 / INTERVAL,
            "imus.topics": [f"/imu_{k + 1}" for k in range(units)],
        }
    )
    pipeline = Pipeline(config)
    gyros = np.tile(rate, (1, units)) + random.normal(0.0, 0.002, (len(t), 3 * units))
    healthy = random.normal(0.0, 0.1, 3 * units)
    forces = np.tile(force, (1, units)) + healthy
    forces += random.normal(0.0, 0.05, forces.shape)
    for name, error in errors.items():
        unit, channel = name.split(".")
        column = 3 * int(unit[-1]) - 3 + "xyz".index(channel[-1])
        half = forces if channel.startswith("accel") else gyros
        half[(t >= begin) & (t < end), column] += error
    stamp = 10**9 + (1e9 * (t + hole * (t // 20.0))).astype(np.int64)
    output = pipeline.process(Block(stamp, gyros, acceleration=Block(stamp, forces)))
    return pipeline.status(), output, force


def far(status: Status) -> list[str]:
    return [
        one.name for one in status.channels if status.has_implausible_start_bias(one)
    ]


def normalised_error(output: Output, force: np.ndarray) -> float:
    """Return the mean of NEES/3 of the fused force after 2 s."""
    fused = output.acceleration
    assert fused is not None
    rows = slice(round(2.0 / INTERVAL), None)
    error = (fused.rate - force)[rows]
    solved = np.linalg.solve(fused.covariance[rows], error[:, :, None])[:, :, 0]
    return float(np.mean(error * solved))


@pytest.mark.parametrize("size", [-2.7, 5.0, 7.5])
def test_an_accelerometer_that_is_wrong_from_the_start_is_doubted(size: float) -> None:
    status, output, force = fly(3, {"imu_2.accel_y": size})
    assert far(status) == ["imu_2.accel_y"]
    channel = next(one for one in status.channels if one.name == "imu_2.accel_y")
    assert channel.start_bias == pytest.approx(size, abs=0.5)
    assert live_word(status, ()) is Word.CANNOT_TELL
    assert 0.05 < normalised_error(output, force) < 1.0
    lines = {line.name: line.message for line in describe(status, "")}
    assert "8 of 9 accelerometers healthy" in lines["monitor"]
    assert (
        "m/s^2 at the start, far above accelerometers.turn_on_std (0.5)"
        in (lines["imu_2.accel_y"])
    )
    assert "times its prior" not in lines["imu_1.accel_y"]


def test_of_two_units_either_may_be_the_wrong_one() -> None:
    status, output, force = fly(2, {"imu_1.accel_z": 5.0})
    assert far(status) == ["imu_1.accel_z", "imu_2.accel_z"]
    assert 0.05 < normalised_error(output, force) < 1.0


def test_two_that_are_wrong_are_both_told() -> None:
    status, *_ = fly(4, {"imu_1.accel_z": 5.0, "imu_3.accel_x": -4.0})
    assert far(status) == ["imu_1.accel_z", "imu_3.accel_x"]


@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize("units", [2, 3])
def test_a_usual_bias_is_not_doubted(units: int, seed: int) -> None:
    """1.2 m/s^2 is 2.4 standard deviations: the covariance has room for it."""
    status, output, force = fly(units, {"imu_1.accel_x": 1.2}, seed=seed)
    assert not far(status)
    assert live_word(status, ()) is Word.HEALTHY
    assert normalised_error(output, force) < 2.0


def test_one_that_goes_wrong_later_is_declared() -> None:
    status, *_ = fly(3, {"imu_2.accel_y": 5.0}, begin=5.0)
    assert not far(status)
    states = {one.name: one.state for one in status.channels}
    assert states["imu_2.accel_y"] is ChannelState.FAULTY


@pytest.mark.parametrize("size", [0.15, -0.3])
def test_a_gyro_that_is_wrong_from_the_start_is_no_healthy_one(size: float) -> None:
    """Its biases are not learned at rest, but as given, so that the states take the error."""
    status, *_ = fly(3, {"imu_2.y": size})
    states = {one.name: one.state for one in status.channels}
    assert far(status) == ["imu_2.y"] or states["imu_2.y"] is ChannelState.FAULTY
    assert live_word(status, ()) in (Word.CANNOT_TELL, Word.FAULTY)


def stand_and_move(
    bias: float, turn: float, rested: bool, seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return NEES/3 of the rate before and after 30 s, in which biases or a turn do not change.

    All gyros of three units have the same bias, rad/s. Then the vehicle moves.
    """
    config = Config.from_file("ardupilot.yaml")
    t = np.arange(0.0, 50.0, 1.0 / config.sample_rate)
    random = np.random.default_rng(seed)
    rate = np.zeros((len(t), 3))
    rate[(t > 10.0) | ~np.full(len(t), rested)] = [0.0, 0.6 * turn, 0.8 * turn]
    moves = t > 40.0
    phase = np.outer(t[moves] - 40.0, [0.8, 1.1, 0.5])
    rate[moves] = [0.5, 0.4, 0.3] * np.sin(phase)
    z = np.tile(rate + bias * np.array([0.0, 0.6, 0.8]), (1, 3))
    z += random.normal(0.0, 0.002, z.shape)
    output = Pipeline(config).process(Block(10**9 + (1e9 * t).astype(np.int64), z))
    error = (output.rate - rate)[:, :, None]
    solved = np.linalg.solve(output.covariance, error)
    nees = np.sum(error * solved, axis=(1, 2)) / 3.0
    return nees[(t > 20.0) & ~moves], nees[t > 42.0]


@pytest.mark.parametrize("size", [5.0, 6.0, 10.0])
def test_standing_still_with_equal_biases_is_no_certain_turn(size: float) -> None:
    """ArduPilot's gyros after its calibration failed: their rates agree, and do not change."""
    for nees in stand_and_move(size * 0.005, 0.0, rested=False):
        assert 0.1 < nees.mean() < 2.0


@pytest.mark.parametrize(("turn", "rested"), [(0.04, True), (0.3, False)])
def test_a_steady_turn_stays_certain(turn: float, rested: bool) -> None:
    """After a rest the biases are known, and no biases explain a fast turn."""
    for nees in stand_and_move(0.0, turn, rested):
        assert 0.05 < nees.mean() < 2.0


@pytest.mark.parametrize("seconds", [60.0, 600.0])
def test_the_doubt_about_a_start_stays_while_the_error_does(seconds: float) -> None:
    status, output, force = fly(3, {"imu_2.accel_y": 2.9}, seconds=seconds)
    assert far(status) == ["imu_2.accel_y"]
    assert normalised_error(output, force) < 1.0


def test_the_doubt_about_a_start_ends_with_the_error() -> None:
    status, *_ = fly(3, {"imu_2.accel_y": 5.0}, end=30.0, seconds=120.0)
    assert not far(status)


@pytest.mark.parametrize("seed", range(1, 7))
def test_holes_in_the_stream_are_no_start(seed: int) -> None:
    """Biases may have moved in each, which widens their covariance."""
    status, *_ = fly(3, {}, seconds=120.0, hole=50.0, seed=seed)
    assert not far(status)


# The sizes themselves, in numbers of their own ----------------------------------------------


class States:
    """States of three orthogonal sensors whose biases have a prior of 1 rad/s."""

    def __init__(self, variance: float = 0.1) -> None:
        self.params, self.kf = allocate(Constants)[0], allocate(Estimator)[0]
        self.params["sensors"]["n"] = 3
        self.params["sensors"]["axes"][:3] = np.eye(3)
        self.params["turn_on_std"] = 1.0
        self.kf["fused"]["gain"][:, :3] = np.eye(3)
        #: Of the bias as estimated. The prior variance is 1, so it is known to 1 less this.
        self.kf["states"]["p"][:3, :3] = variance * np.eye(3)
        self.known = np.sqrt(1.0 - variance)

    def doubt(self, sigmas: float, seconds: float = 5.0) -> "States":
        """Judge the start where the first bias is at so many standard deviations."""
        self.kf["states"]["x"][0] = sigmas * self.known
        self.kf["seconds"] = seconds
        doubt_start(self.params, self.kf, True)
        return self

    @property
    def is_far(self) -> bool:
        return bool(self.kf["far_bias"][0] != 0.0)

    @property
    def error(self) -> float:
        return float(self.kf["bias_error"][0])


def test_a_start_bias_is_far_from_four_standard_deviations_on() -> None:
    assert not States().doubt(3.9).is_far
    assert States().doubt(4.1).is_far


def test_the_covariance_allows_for_a_start_bias_from_three_deviations_on() -> None:
    assert States().doubt(2.95).error == 0.0
    assert 0.0 < States().doubt(3.05).error < States().doubt(3.9).error
    full = States().doubt(4.1)
    # Without its prior the bias would be its value times the prior over what is known.
    assert full.error + full.kf["states"]["x"][0] == pytest.approx(
        full.kf["states"]["x"][0] / full.known**2
    )


def test_a_start_is_judged_for_ten_seconds() -> None:
    assert States().doubt(5.0, seconds=9.9).is_far
    assert not States().doubt(5.0, seconds=10.1).is_far


def test_a_bias_of_which_less_than_a_twentieth_is_known_is_not_doubted() -> None:
    assert not States(variance=0.955).doubt(5.0).is_far
    assert States(variance=0.945).doubt(5.0).is_far


@pytest.mark.parametrize(("left", "stays"), [(0.27, True), (0.23, False)])
def test_a_far_bias_is_forgotten_once_less_than_a_quarter_is_left(
    left: float, stays: bool
) -> None:
    """Of two units the states hold half of it: half of it is no healing."""
    states = States().doubt(5.0)
    states.kf["states"]["x"][0] = left * states.kf["far_bias"][0]
    states.kf["seconds"] = 20.0
    doubt_start(states.params, states.kf, True)
    assert states.is_far == stays
    assert bool(states.error) == stays


@pytest.mark.parametrize(
    ("rate", "known", "doubted"),
    [
        (11.9, 1.0, True),
        (12.1, 1.0, False),  # no biases explain so fast a turn
        (5.0, 0.26, True),
        (5.0, 0.24, False),  # a rest has shown the biases
    ],
)
def test_a_steady_rate_is_doubted_if_biases_that_no_rest_has_shown_explain_it(
    rate: float, known: float, doubted: bool
) -> None:
    """Known: variance of the rate by biases, of 1 before any rest."""
    states = States()
    states.kf["steady_rate"][0] = rate
    states.kf["known_variance"][:] = known
    states.doubt(0.0)
    assert bool(states.kf["alike_bias"][0]) == doubted
