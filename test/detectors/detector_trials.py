# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples and figures that the tests of several detectors share."""

import math

import numpy as np

from fdi_ros import Geometry
from fdi_ros.detectors import DETECTORS

VARIANTS = [
    *((name, {}) for name in sorted(DETECTORS)),
    ("mean_abs_residual", {"tolerance": "paper"}),
    ("rate_deviation", {"tolerance": "paper"}),
    ("max_residual", {"tolerance": "paper"}),
    ("projector", {"norm": "l1"}),
    ("projector", {"construction": "qr"}),
    ("determinant", {"criterion": "condition_number"}),
]
"""Detectors by name, and their ways to work."""

FIVE = np.array(
    [
        [0.97204, -0.60075, 0, 0, -0.60075],
        [0, 0.77653, -0.47992, 0.47992, -0.77653],
        [0.23482, 0.18997, -0.87731, -0.87731, 0.18997],
    ]
).T
"""The five axes of the paper on identification of faults."""
FIVE_RATE = np.array([1.0, 2.0, 3.0])


def usual_geometry(name):
    """Axes that a detector works on."""
    return Geometry.cone(5) if name == "determinant" else Geometry.two_triad_cone()


def random_axes(rng, n):
    """Gaussian rows, normalised."""
    axes = rng.standard_normal((n, 3))
    return Geometry(axes / np.linalg.norm(axes, axis=1, keepdims=True))


def lopsided(rng, n):
    """Random axes of random lengths, at times with two parallel or three in one plane."""
    while True:
        axes = rng.standard_normal((n, 3))
        if rng.random() < 0.2:
            axes[1] = -axes[0]
        if rng.random() < 0.2:
            axes[2] = axes[3] + 0.5 * axes[0]
        axes *= rng.uniform(0.6, 1.9, (n, 1)) / np.linalg.norm(axes, axis=1, keepdims=True)
        if np.linalg.svd(axes, compute_uv=False)[-1] > 0.1:
            return Geometry(axes)


def sound(rng, geometry, noise, rows):
    """Samples of healthy channels in motion, as the noise model describes them, and the angular acceleration."""
    n = geometry.n
    model = noise.for_channels(n)
    rate, acceleration = rng.uniform(-2, 2, (rows, 3)), rng.uniform(-20, 20, (rows, 3))
    along = rate @ geometry.axes.T
    z = along + rng.standard_normal((rows, n)) * model.noise_std
    if not noise.constant:
        z += along * rng.standard_normal((rows, n)) * model.scale_std
        z += (acceleration @ geometry.axes.T) * rng.standard_normal((rows, n)) * model.timing_std
    return z, acceleration


def alarms(detector, noise, rows, seed):
    """Number of alarms among samples of healthy channels."""
    rng, total = np.random.default_rng(seed), 0
    for start in range(0, rows, 100_000):
        z, acceleration = sound(rng, detector.geometry, noise, min(100_000, rows - start))
        total += int(detector.detect(z, None if noise.constant else acceleration).alarm.sum())
    return total


def within_standard_errors(count, rows, probability, errors=3.0):
    """Whether a number of alarms fits a probability."""
    return abs(count - rows * probability) <= errors * math.sqrt(rows * probability * (1 - probability))


def paper_trials(rng, trials, amplitude=0.1):
    """Samples (trials, 5, 5) of the five-channel example, [k, i] with a fault of 1 in channel i, and their noise."""
    noise = rng.uniform(-amplitude, amplitude, (trials, 5))
    return FIVE @ FIVE_RATE + noise[:, None, :] + np.eye(5), noise


TABLE_2 = np.array(
    [
        [0.0814, 0.6730, 1.0075, 0.9572, 0.5413],
        [0.4245, 0.1671, 0.6949, 0.9572, 0.8539],
        [0.7371, 0.3388, 0.1890, 0.6446, 0.8539],
        [0.8999, 0.9857, 0.6949, 0.1387, 0.4705],
        [0.5873, 0.9857, 1.0075, 0.6446, 0.0354],
    ]
)
"""Table 2 of the paper: [i, j] is d_j with a fault of 1 in channel i."""


def table_noise():
    """Noise (5,) of least size behind Table 2: it is not printed, but its parity follows from the entries.

    Off the diagonal the fault outweighs the noise, so its sign is that of the determinant: the entries are linear in
    the noise there. The diagonal, where the sign is not known, is left for the test.
    """
    struck = np.array([[signed_determinant(channel, j) for channel in np.eye(5)] for j in range(5)])
    clean = struck.T
    off = ~np.eye(5, dtype=bool)
    rows = np.broadcast_to(struck, (5, 5, 5))[off]
    left = (np.sign(clean) * TABLE_2 - clean)[off]
    return np.linalg.lstsq(rows, left, rcond=None)[0]


def signed_determinant(z, j):
    """Determinant of [A z] without row j."""
    return float(np.linalg.det(np.delete(np.column_stack([FIVE, z]), j, axis=0)))
