"""Calibration from a recording with rest and motion by hand: biases at rest, then axes, delays and noise in motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdi_ros.calibration.agreement import check_response
from fdi_ros.calibration.axes import Fit, fit_axes, make_sample, sound_axes, undelayed
from fdi_ros.calibration.band import aligned
from fdi_ros.calibration.bias import estimate_bias
from fdi_ros.calibration.data import Array, Mask, Rest
from fdi_ros.calibration.estimate import Estimate, Task, checked_geometry, refuse_faulty, skew, uncertainty
from fdi_ros.calibration.faults import Faults, find_faults, no_faults
from fdi_ros.calibration.noise import DEGREES, NoiseFit, fit_noise, rest_noise, view
from fdi_ros.calibration.requirements import check_excitation, check_rest

START_NOISE = (0.003, 0.0003)
"""Scale and timing terms, s, that weigh the samples before they are fitted."""
ROUNDS = 3
"""Of axes, noise and faults in turn."""


def from_rest(task: Task, rest: Rest) -> Estimate:
    """Run rounds of axes, noise and faults: each makes the next one better."""
    check_rest(rest, task.nominal.channel_names)
    # Where a mean at rest is not what it is otherwise, nothing needs to be fitted to know it.
    faults = replace(no_faults(task.data), windows=rest.differs)
    estimate = _round(task, rest, faults, None)
    for _ in range(ROUNDS - 1):
        faults = find_faults(task.data, rest, estimate.seen, estimate.geometry, estimate.noise)
        refuse_faulty(task.nominal.channel_names, rest, faults)
        estimate = _round(task, rest, faults, estimate)
    return estimate


def _round(task: Task, rest: Rest, faults: Faults, before: Estimate | None) -> Estimate:
    data = task.data
    good = Rest(rest.window, rest.fits & ~faults.windows, rest.differs, rest.mean, rest.std, rest.level)
    check_rest(good, task.nominal.channel_names)
    bias = estimate_bias(data, good, rest.level)
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
    axes, covariance = sound_axes(fit, task.nominal.axes[task.reference], task.reference)
    geometry = checked_geometry(axes, task.nominal)
    together = undelayed(data, steady, axes, fit, task.groups, task.reference)
    seen = view(data.stamp, together, geometry, rest.level, task.config.noise.acceleration_window)
    at_rest = rest_noise(together, rows & still, geometry, rest.level)
    noise = fit_noise(data, seen, moving, geometry, at_rest, DEGREES)
    late, late_error = np.zeros(task.nominal.n), np.zeros(task.nominal.n)
    errors = np.sqrt(np.maximum(np.diag(fit.covariance)[3 * len(fit.gain) :], 0))
    late[task.others] = -np.where(task.groups >= 0, np.append(fit.delay, 0.0)[task.groups], 0.0)
    late_error[task.others] = np.where(task.groups >= 0, np.append(errors, 0.0)[task.groups], 0.0)
    return Estimate(rest, faults, bias, geometry, covariance, late, late_error, noise, seen)


def _fit(task: Task, steady: Array, moving: Mask, level: Array, before: Estimate | None) -> Fit:
    data, reference = task.data, task.reference
    terms = START_NOISE if before is None else (before.noise.scale, before.noise.timing)
    axes = task.nominal.axes
    # Nominal axes may be wrong by anything; until the first fit the reference speaks for itself.
    gain = np.linalg.pinv(axes[reference]) if before is None else before.geometry.least_squares
    source = steady[:, reference] if before is None else steady
    rate = source @ gain.T
    turning = np.zeros_like(rate) if before is None else before.seen.acceleration
    H = axes if before is None else before.geometry.axes
    variance = level**2 + (terms[0] * (rate @ H.T)) ** 2 + (terms[1] * (turning @ H.T)) ** 2
    sample = make_sample(data, steady, moving, reference, variance, rate @ axes[reference].T)
    return fit_axes(sample, task.groups)


def pipeline_noise(task: Task, estimate: Estimate, late: Array) -> NoiseFit:
    """Noise as the pipeline meets it: constant biases, delays (n,) s taken off as it does, plain second moments."""
    data, geometry, rest = task.data, estimate.geometry, estimate.rest
    z = aligned(data, data.z, late, skew(task, late)) - estimate.bias.mean
    rows = np.isfinite(z).all(axis=1) & ~estimate.faults.bad_rows(data)
    still = rest.window[data.window]
    seen = view(data.stamp, z, geometry, estimate.noise.std, task.config.noise.acceleration_window)
    # At rest delays show nothing, and a line between two samples has less noise than one.
    at_rest = rest_noise(data.z - estimate.bias.mean, rows & still, geometry, rest.level)
    noise = fit_noise(data, seen, rows & ~still, geometry, at_rest)
    scale, timing = np.hypot(
        [noise.scale, noise.timing], uncertainty(estimate.covariance, estimate.late_error, task.others)
    )
    return replace(noise, scale=float(scale), timing=float(timing))
