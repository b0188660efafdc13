# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The end of a move of all biases: its evidence against an independent likelihood, and the states after it."""

import numpy as np
import pytest
from detectors.detector_trials import log_density

from fdi_ros import Geometry, NoiseModel
from fdi_ros.compiling.compiled import allocate
from fdi_ros.detectors.naming import Inference
from fdi_ros.detectors.returning import (
    References,
    find_returned,
    keep_reference,
    log_evidence,
    return_biases,
    suppose_returned,
)
from fdi_ros.detectors.sequential import Sequential
from fdi_ros.estimator.error_states import fill_signals, project
from fdi_ros.estimator.estimator import Estimator

CONE = Geometry.two_triad_cone()
N = CONE.n
MOVE, WALK = 0.0012, 5e-5  # rad/s, rad/s/sqrt(s)
PASSED = 5.0  # s since the reference
SHIFT = 0.02 * np.array([1.0, -0.5, 0.3, -1.2, 0.8, 0.1])  # rad/s


class Flight:
    """States whose biases have moved by `SHIFT` since a reference was kept, and a mean of values."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        detector = Sequential(CONE, NoiseModel(0.003), bias_move=MOVE, bias_walk=WALK)
        self.params = detector.constants[0]
        self.layout = self.params["layout"]
        self.count = int(self.layout["count"])
        self.rates = int(np.flatnonzero(self.layout["feeds"][: self.count] == 0)[0])
        # A compiled function changes the records of an array, not copies of them.
        self.rooms = allocate(Estimator), allocate(Inference), allocate(References)
        self.kf, self.inference, self.references = (room[0] for room in self.rooms)
        self.states = self.kf["states"]
        self.fill_states(rng, 1e-4)
        self.before = self.states.copy()
        keep_reference(self.params, self.kf, self.states, self.references)
        self.kf["seconds"] = PASSED
        self.fill_states(rng, 5e-3)
        self.states["x"][:N] = self.before["x"][:N] + SHIFT
        rate = rng.normal(0.0, 1.0, 3)
        at = self.inference["at"]
        fill_signals(self.layout, rate, np.zeros(N), at["signals"])
        project(self.layout, self.states, at)
        self.noise = np.diag(rng.uniform(1e-7, 1e-6, N))
        self.inference["mask"] = (1 << N) - 1
        self.covariance[:] = at["covariance"][:N, :N] + self.noise

    def fill_states(self, rng, bias_std):
        std = np.concatenate([np.full(N, bias_std), np.full(self.count - N, 1e-3)])
        std[self.rates : self.rates + N] = 1e-5
        root = rng.standard_normal((self.count, self.count)) / np.sqrt(self.count)
        self.states["x"][: self.count] = std * rng.standard_normal(self.count)
        self.states["p"][: self.count, : self.count] = (root @ root.T) * np.outer(
            std, std
        )

    @property
    def y(self):
        return self.inference["y"][:N]

    @property
    def covariance(self):
        return self.inference["covariance"][:N, :N]

    @property
    def returned_covariance(self):
        """Covariance (N, N) of the biases of the reference, now."""
        p, rates = self.before["p"], slice(self.rates, self.rates + N)
        mixed = p[:N, rates]
        total = p[:N, :N] + PASSED * (mixed + mixed.T) + PASSED**2 * p[rates, rates]
        return total + (PASSED * WALK**2 + MOVE**2) * np.eye(N)

    def show(self, biases):
        """Set the mean to what these biases (N,) show, less the estimated ones."""
        self.y[:] = biases - self.states["x"][:N]

    def find(self, least=10.0):
        return find_returned(
            self.params, self.kf, self.references, self.inference, least
        )


def likelihood(y, covariance):
    parity = CONE.parity
    spread = parity @ covariance @ parity.T
    return log_density(parity @ y, spread)


@pytest.mark.parametrize("seed", range(3))
def test_the_evidence_is_a_likelihood_of_the_parity(seed):
    flight = Flight(seed)
    flight.show(flight.before["x"][:N])
    y = flight.y.copy()
    now = log_evidence(flight.params, flight.inference)
    expected = -likelihood(y, flight.covariance)
    states = slice(N, flight.count)
    signals = flight.inference["at"]["signals"]
    rows = np.zeros((N, flight.count))
    place = flight.layout["place"][:N]
    for i, k in np.argwhere(place >= 0):
        rows[i, place[i, k]] = signals[i, k]
    others = (
        rows[:, states]
        @ flight.states["p"][states, states][: flight.count - N, : flight.count - N]
    )
    others = others @ rows[:, states].T
    suppose_returned(
        flight.params, flight.kf, flight.inference, flight.references["kept"][0], 1.0
    )
    covariance = others + flight.returned_covariance + flight.noise
    np.testing.assert_allclose(flight.covariance, covariance, rtol=1e-9, atol=1e-18)
    drift = PASSED * flight.before["x"][flight.rates : flight.rates + N]
    np.testing.assert_allclose(flight.y, -drift, atol=1e-12)
    expected += likelihood(flight.y, covariance)
    gained = log_evidence(flight.params, flight.inference) - now
    assert gained == pytest.approx(expected, abs=1e-6)


def test_what_is_supposed_is_taken_back():
    flight = Flight(1)
    flight.show(flight.before["x"][:N])
    before = flight.y.copy(), flight.covariance.copy()
    flight.find()
    np.testing.assert_allclose(flight.y, before[0], atol=1e-15)
    np.testing.assert_allclose(flight.covariance, before[1], atol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_only_the_biases_from_before_the_move_are_found(seed):
    flight = Flight(seed)
    drift = PASSED * flight.before["x"][flight.rates : flight.rates + N]
    flight.show(flight.states["x"][:N])
    assert [flight.find() for _ in range(20)] == [-1] * 20
    flight.show(flight.before["x"][:N] + drift)
    found = [flight.find() for _ in range(8)]
    assert found[-1] == 0, "the evidence of several means adds up"
    assert flight.find(1e9) == -1
    one_is_off = flight.before["x"][:N] + drift + 0.1 * np.eye(N)[seed]
    flight.show(one_is_off)
    assert [flight.find() for _ in range(20)] == [-1] * 20


def test_the_states_after_the_move_are_those_before_it():
    flight = Flight(2)
    later = flight.kf["snapshots"][3]
    later["seconds"] = 3.0
    earlier = flight.kf["snapshots"][4]
    earlier["seconds"] = -1.0
    others = slice(N, flight.rates)
    p = flight.states["p"][others, others].copy()
    return_biases(flight.params, flight.kf, flight.references, 0, (1 << N) - 1)
    drift = flight.before["x"][flight.rates : flight.rates + N]
    biases = flight.before["x"][:N]
    np.testing.assert_allclose(flight.states["x"][:N], biases + PASSED * drift)
    np.testing.assert_allclose(later["states"]["x"][:N], biases + 3.0 * drift)
    assert not earlier["states"]["x"].any()
    np.testing.assert_allclose(
        flight.states["p"][:N, :N], flight.returned_covariance, atol=1e-18
    )
    np.testing.assert_array_equal(flight.states["p"][others, others], p)
    whole = flight.states["p"][: flight.count, : flight.count]
    np.testing.assert_array_equal(whole, whole.T)
    assert (
        np.linalg.eigvalsh(whole / np.sqrt(np.outer(*[np.diag(whole)] * 2))).min()
        > -1e-9
    )


def test_a_channel_that_was_silent_keeps_its_bias_and_variance() -> None:
    """It may come back with another bias than it had before the move."""
    flight = Flight(0)
    silent = 5
    p, x, n = flight.states["p"], flight.states["x"], flight.rates + N
    kept = x[silent], p[silent, silent]
    mask = (1 << N) - 1 - (1 << silent)
    return_biases(flight.params, flight.kf, flight.references, 0, mask)
    assert (x[silent], p[silent, silent]) == kept
    assert p[0, silent] == p[silent, 0] == 0.0
    assert np.linalg.eigvalsh(p[:n, :n]).min() > -1e-12
    assert p[0, 0] < kept[1]


@pytest.mark.parametrize(("age", "is_taken"), [(250.0, True), (350.0, False)])
def test_biases_from_long_ago_are_not_taken_again(age: float, is_taken: bool) -> None:
    flight = Flight(0)
    flight.references["kept"][0]["seconds"] = flight.kf["seconds"] - age
    drift = age * flight.before["x"][flight.rates : flight.rates + N]
    flight.show(flight.before["x"][:N] + drift)
    found = [flight.find() for _ in range(20)]
    assert (0 in found) == is_taken
