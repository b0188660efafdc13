# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration from a recording with rest and motion by hand: biases at rest, then axes, delays and noise in motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdi_ros.calibration.agreement import check_faulty_share, check_response, checked_geometry
from fdi_ros.calibration.axes import Fit, all_axes, fit_axes, make_samples, of_channels, undelayed
from fdi_ros.calibration.band import aligned
from fdi_ros.calibration.bias import bias_at_rest
from fdi_ros.calibration.data import Array, Mask
from fdi_ros.calibration.estimate import Estimate, Task, skew, uncertainty
from fdi_ros.calibration.faults import Faults, find_faults, no_faults
from fdi_ros.calibration.motion import motion_of
from fdi_ros.calibration.noise import DEGREES, NoiseFit, fit_noise, rest_noise
from fdi_ros.calibration.requirements import check_excitation, check_rest
from fdi_ros.calibration.rest import Rest

START_NOISE = (0.003, 0.0003)
"""Scale and timing terms, s, that weigh the samples before they are fitted."""
ITERATIONS = 3
"""Of axes, noise and faults in turn."""


def from_rest(task: Task, rest: Rest) -> Estimate:
    """Iterate over axes, noise and faults: each makes the next one better."""
    check_rest(rest, task.nominal.channel_names)
    # A mean at rest that is not what it is at other times is a fault that is found without any fit.
    faults = replace(no_faults(task.data), windows=rest.differs)
    estimate = _iterate(task, rest, faults, None)
    for _ in range(ITERATIONS - 1):
        faults = find_faults(task.data, rest, estimate.motion, estimate.geometry, estimate.noise)
        check_faulty_share(task.nominal.channel_names, rest, faults)
        estimate = _iterate(task, rest, faults, estimate)
    return estimate


def _iterate(task: Task, rest: Rest, faults: Faults, before: Estimate | None) -> Estimate:
    data = task.data
    good = replace(rest, fits=rest.fits & ~faults.windows)
    check_rest(good, task.nominal.channel_names)
    bias = bias_at_rest(data, good, rest.level)
    steady = data.z - bias.at(data.seconds)
    rows = data.complete & ~faults.bad_rows(data)
    still = rest.window[data.window]
    moving = rows & ~still
    if before is None:
        check_excitation(
            steady[moving][:, task.reference], task.nominal.axes[task.reference], rest.level, task.config.body_frame
        )
        check_response(steady, moving, task.nominal)
    fit = _fit(task, steady, moving, rest.level, before)
    axes, covariance = all_axes(fit, task.nominal.axes[task.reference], task.reference)
    geometry = checked_geometry(axes, task.nominal)
    together = undelayed(data, steady, axes, fit, task.groups, task.reference)
    motion = motion_of(data.stamp, together, geometry, rest.level, task.config.noise.acceleration_window)
    at_rest = rest_noise(together, rows & still, geometry, rest.level)
    noise = fit_noise(data, motion, moving, geometry, at_rest, DEGREES)
    late, late_error = np.zeros(task.nominal.n), np.zeros(task.nominal.n)
    errors = np.sqrt(np.maximum(np.diag(fit.covariance)[3 * len(fit.gain) :], 0))
    late[task.others] = -of_channels(task.groups, fit.delay)
    late_error[task.others] = of_channels(task.groups, errors)
    return Estimate(rest, faults, bias, geometry, covariance, late, late_error, noise, motion)


def _fit(task: Task, steady: Array, moving: Mask, level: Array, before: Estimate | None) -> Fit:
    data, reference = task.data, task.reference
    terms = START_NOISE if before is None else (before.noise.scale, before.noise.timing)
    axes = task.nominal.axes
    # Nominal axes may be wrong by anything; until the first fit only the reference gives the rate.
    gain = np.linalg.pinv(axes[reference]) if before is None else before.geometry.least_squares
    source = steady[:, reference] if before is None else steady
    rate = source @ gain.T
    turning = np.zeros_like(rate) if before is None else before.motion.acceleration
    H = axes if before is None else before.geometry.axes
    variance = level**2 + (terms[0] * (rate @ H.T)) ** 2 + (terms[1] * (turning @ H.T)) ** 2
    samples = make_samples(data, steady, moving, reference, variance, rate @ axes[reference].T)
    return fit_axes(samples, task.groups)


def pipeline_noise(task: Task, estimate: Estimate, late: Array) -> NoiseFit:
    """Fit the noise as the pipeline meets it: constant biases, its way of taking delays off, plain second moments.

    Parameters
    ----------
    task, estimate
        The recording, and all else that was calibrated.
    late
        (n,) delays that are taken off, s.
    """
    data, geometry, rest = task.data, estimate.geometry, estimate.rest
    z = aligned(data, data.z, late, skew(task, late)) - estimate.bias.mean
    rows = np.isfinite(z).all(axis=1) & ~estimate.faults.bad_rows(data)
    still = rest.window[data.window]
    motion = motion_of(data.stamp, z, geometry, estimate.noise.std, task.config.noise.acceleration_window)
    # At rest delays show nothing, and a line between two samples has less noise than one.
    at_rest = rest_noise(data.z - estimate.bias.mean, rows & still, geometry, rest.level)
    noise = fit_noise(data, motion, rows & ~still, geometry, at_rest)
    scale, timing = np.hypot(
        [noise.scale, noise.timing], uncertainty(estimate.covariance, estimate.late_error, task.others)
    )
    return replace(noise, scale=float(scale), timing=float(timing))
