# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Samples and figures that the tests of several detectors share."""

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
        axes *= rng.uniform(0.6, 1.9, (n, 1)) / np.linalg.norm(
            axes, axis=1, keepdims=True
        )
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
        z += (
            (acceleration @ geometry.axes.T)
            * rng.standard_normal((rows, n))
            * model.timing_std
        )
    return z, acceleration


def alarms(detector, noise, rows, seed):
    """Number of alarms among samples of healthy channels."""
    rng, total = np.random.default_rng(seed), 0
    for start in range(0, rows, 100_000):
        z, acceleration = sound(
            rng, detector.geometry, noise, min(100_000, rows - start)
        )
        total += int(
            detector.detect(z, None if noise.constant else acceleration).alarm.sum()
        )
    return total


def log_density(x, covariance):
    """Logarithm of the density of a normal distribution about zero at x (n,)."""
    _, log_det = np.linalg.slogdet(2.0 * np.pi * covariance)
    return -0.5 * float(log_det + x @ np.linalg.solve(covariance, x))
