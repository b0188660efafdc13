# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibration from motion alone: what a flight without rest shows, and what it does not.

Delays and axes come from the band in which all units see one motion (`band`), biases relative to each other from means
over the flight, noise from the disagreement of one sample, vibration included. What all channels have in common as a
bias is a constant rotation to them, and stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.agreement import check_faulty_share, checked_geometry
from fdi_ros.calibration.axes import AxisSamples, all_axes, derivative, fit_axes, of_channels
from fdi_ros.calibration.band import Band, confined, find_band, shifted, without_slow
from fdi_ros.calibration.bias import Bias, relative_bias
from fdi_ros.calibration.data import Array, Data, Mask
from fdi_ros.calibration.estimate import Estimate, Task, uncertainty
from fdi_ros.calibration.faults import Faults, find_faults, no_faults
from fdi_ros.calibration.motion import Motion, motion_of
from fdi_ros.calibration.noise import NoiseFit, channel_noise, coherent_term, shared_noise
from fdi_ros.calibration.requirements import LEAST_REST, axis_words
from fdi_ros.calibration.rest import Rest
from fdi_ros.errors import CalibrationError
from fdi_ros.model.geometry import Geometry

HELD_ERROR = 0.01
"""Part of an axis that the motion leaves more uncertain than this is kept as configured: 1 % of scale, 0.6 deg."""
SETTLED = 1e-5
"""Delays are taken off again until they change by less, s."""
ITERATIONS = 3
"""Of axes, biases, noise and faults in turn."""
DELAY_ITERATIONS = 4
"""At most."""
FIRST_NOISE = 0.01
"""Of every channel in the band, before it is known, rad/s: all alike."""
UNKNOWN_SCALE = 0.01
"""Share by which an axis kept as configured may be off."""
STANDS_OUT = 2.0
"""Standard errors from which a coherent error is no chance."""
BLOCK = 2.0
"""Length of the spans in which errors are compared with the motion, s."""
LEAST_ROWS = 50
"""With fewer rows of motion nothing is fitted."""
LARGEST_DELAY = 0.1
"""What imus.delays may be at most, s."""
SMALLEST_SHARE = 0.05
"""A channel that alone decides the rate shows nothing of its own error."""


def from_motion(task: Task, rest: Rest) -> Estimate:
    """Iterate over delays and axes, biases, noise and faults: each makes the next one better.

    Raises
    ------
    CalibrationError
        If the units share no motion, or a channel disagrees for most of it.
    """
    faults = no_faults(task.data)
    estimate, noise = _iterate(task, rest, faults, np.full(task.nominal.n, FIRST_NOISE))
    for _ in range(ITERATIONS - 1):
        faults = find_faults(task.data, rest, estimate.motion, estimate.geometry, estimate.noise)
        check_faulty_share(task.nominal.channel_names, rest, faults)
        estimate, noise = _iterate(task, rest, faults, noise)
    return estimate


def _iterate(task: Task, rest: Rest, faults: Faults, noise: Array) -> tuple[Estimate, Array]:
    """Estimate once more, from the noise (n,) of the channels in the band, rad/s; and return that noise anew."""
    data = task.data
    good, spiky = data.complete & ~faults.bad_rows(data), faults.outliers.any(axis=1)
    moving = ~rest.window[data.window]
    band = find_band(data, good, moving, task.units)
    if band is None or band.rows.sum() < LEAST_ROWS:
        raise CalibrationError(
            "the units show no rotation in common to calibrate on: turn the vehicle about x, y and z of"
            f" {task.config.body_frame}, on the ground or in flight, and check that all units are on it"
        )
    fit = fit_motion(task, band, noise)
    if fit.held.all():
        raise CalibrationError(
            f"the recording shows no rotation to calibrate on: {fit.rms.max():.3f} rad/s rms at most below"
            f" {band.cutoff:.1f} Hz: turn the vehicle about x, y and z of {task.config.body_frame}"
        )
    geometry = checked_geometry(fit.axes, task.nominal)
    noise = band_noise(data, band, fit, geometry)
    bias = relative_bias(data, fit.together, geometry, _rest_bias(rest))
    usual = data.complete & ~spiky
    sample_noise, motion = _sample_noise(task, band, fit, geometry, bias, noise, good & moving, usual)
    notes = _notes(task, band, fit, sample_noise, rest)
    estimate = Estimate(
        rest, faults, bias, geometry, fit.covariance, fit.late, fit.late_error, sample_noise, motion, notes
    )
    return estimate, noise


def _sample_noise(
    task: Task, band: Band, fit: MotionFit, geometry: Geometry, bias: Bias, in_band: Array, rows: Mask, usual: Mask
) -> tuple[NoiseFit, Motion]:
    """Noise of one sample in motion, vibration included, from rows (N,), and the motion in all that is usual (N,)."""
    data = task.data
    # Samples with faults stay in: the next iteration must find them again.
    spans, low = confined(data, usual, band.cutoff)
    # The delays are taken off where the units see one motion. Above, nothing is shared that could be aligned, and a
    # line between two samples would make the noise of one sample less than it is.
    z = data.z - low + shifted(data, low, spans, fit.late) - bias.at(data.seconds)
    rows = rows & np.isfinite(z).all(axis=1)
    # Samples that are left out between these leave steps behind, too few to matter.
    high = (data.z - low)[rows]
    std = channel_noise(z[rows] @ geometry.parity.T, geometry, high.std(axis=0))
    std = shared_noise(std, high, geometry.axes)
    values, errors = coherent_terms(data, band, fit, geometry, in_band)
    unknown = uncertainty(fit.covariance, fit.late_error, task.others)
    terms = np.hypot(np.where(values > STANDS_OUT * errors, values, 0.0), unknown)
    if fit.held.any():
        terms[0] = max(terms[0], UNKNOWN_SCALE)
    noise = NoiseFit(
        std, std / np.sqrt(2 * rows.sum()), float(terms[0]), float(errors[0]), float(terms[1]), float(errors[1])
    )
    return noise, motion_of(data.stamp, z, geometry, std, task.config.noise.acceleration_window)


def _notes(task: Task, band: Band, fit: MotionFit, noise: NoiseFit, rest: Rest) -> tuple[str, ...]:
    """List what the recording does not show, and what is taken instead, one line each."""
    notes = [
        f"axes and delays are from the motion that all units share, below {band.cutoff:.1f} Hz",
        f"noise_std is of one sample in flight, with vibration: {noise.std.min():.2g} to {noise.std.max():.2g} rad/s",
    ]
    if rest.seconds < LEAST_REST:
        notes.append(
            f"at rest for {rest.seconds:.1f} s: biases are relative to each other; what all units have in common"
            " looks like a rotation and is left 0"
        )
    for k in np.flatnonzero(fit.held.any(axis=0)):
        held = [task.nominal.channel_names[task.others[i]] for i in np.flatnonzero(fit.held[:, k])]
        who = "all other channels" if len(held) == len(task.others) else ", ".join(held)
        notes.append(
            f"the rotation about {axis_words(fit.directions[:, k], task.config.body_frame)} ({fit.rms[k]:.3f} rad/s"
            f" rms) shows the axes of {who} no better than to {HELD_ERROR:.0%}: kept as configured there"
        )
    names, groups = task.nominal.channel_names, [g for g in task.nominal.groups if len(g) > 1]
    if groups:
        alike = "; ".join(" and ".join(names[i] for i in group) for group in groups)
        notes.append(f"whose noise is whose cannot be told between {alike}: taken to share as their vibration does")
    return tuple(notes)


def _rest_bias(rest: Rest) -> Array | None:
    """Bias (n,) rad/s of the channels where there is rest enough, spikes and odd windows aside."""
    if rest.seconds < LEAST_REST:
        return None
    return np.asarray(np.nanmedian(np.where(rest.fits, rest.mean, np.nan)[rest.window], axis=0))


@dataclass(frozen=True)
class MotionFit:
    """Axes and delays from the band.

    Attributes
    ----------
    directions
        (3, 3) columns: directions of the body, by increasing rotation.
    rms
        (3,) rotation about them, rad/s.
    held
        (m, 3) parts of the other channels' axes kept as configured.
    late
        (n,) by how much the stamps of each channel are late against those of the reference, s.
    late_error
        (n,) s; infinite: the motion does not show it.
    axes, covariance
        (n, 3) and (n, 3, 3) of all channels.
    together
        (N, n) band-limited channels with the delays taken off, rad/s.
    """

    directions: Array
    rms: Array
    held: Mask
    late: Array
    late_error: Array
    axes: Array
    covariance: Array
    together: Array


def fit_motion(task: Task, band: Band, noise: Array) -> MotionFit:
    """Fit axes and delays in the band, delays again until they are all taken off.

    Parameters
    ----------
    task
        Its nominal axes of the reference stay as they are.
    band
        The motion that all units share.
    noise
        (n,) of each channel in the band, rad/s.
    """
    nominal, others, m = task.nominal, task.others, len(task.others)
    late = np.zeros(nominal.n)
    square, directions = _directions(task, band)
    expected = nominal.axes[others] @ directions
    held = np.zeros((m, 3), dtype=bool)
    for _ in range(DELAY_ITERATIONS):
        together = shifted(task.data, band.low, band.spans, late)
        samples = _samples(task, band, without_slow(task.data, together), directions, noise)
        fit = fit_axes(samples, task.groups, held=held, nominal=expected)
        error = np.sqrt(np.maximum(np.diag(fit.covariance)[: 3 * m].reshape(m, 3), 0))
        more = (error > HELD_ERROR) & ~held
        late[others] -= of_channels(task.groups, fit.delay)
        late = np.clip(late, -LARGEST_DELAY, LARGEST_DELAY)
        if not more.any() and np.abs(fit.delay).max(initial=0.0) < SETTLED:
            break
        held |= more
    late_error = np.zeros(nominal.n)
    late_error[others] = of_channels(task.groups, np.sqrt(np.maximum(np.diag(fit.covariance)[3 * m :], 0)))
    axes, covariance = all_axes(fit, directions.T, task.reference)
    axes[task.reference] = nominal.axes[task.reference]
    return MotionFit(directions, np.sqrt(np.maximum(square, 0)), held, late, late_error, axes, covariance, together)


def _directions(task: Task, band: Band) -> tuple[Array, Array]:
    """Mean square of the rotation (3,), (rad/s)^2, and the directions of the body about which it is, (3, 3) columns.

    By how much the body turns about them, increasing: each direction that it hardly turns about is held by itself.
    """
    to_body: Array = np.asarray(np.linalg.inv(task.nominal.axes[task.reference]), dtype=np.float64)
    steady = without_slow(task.data, band.low)[band.rows]
    value, vectors = np.linalg.eigh(to_body @ np.cov(steady[:, task.reference].T) @ to_body.T)
    return value, np.asarray(vectors, dtype=np.float64)


def _samples(task: Task, band: Band, z: Array, directions: Array, noise: Array) -> AxisSamples:
    """Rows of the band of channels z (N, n), rad/s, with the reference as rates about the directions."""
    data, reference, others = task.data, task.reference, task.others
    turn = np.linalg.inv(task.nominal.axes[reference]).T @ directions
    x = z[:, reference] @ turn
    a = derivative(data.seconds, x, data.step)
    rows = band.rows & np.isfinite(z).all(axis=1) & np.isfinite(a).all(axis=1)
    count = int(rows.sum())
    variance_x = noise[reference] ** 2 @ turn**2
    block = np.unique(data.seconds[rows].astype(np.int64), return_inverse=True)[1].astype(np.int64)
    return AxisSamples(
        x[rows],
        a[rows],
        z[rows][:, others],
        np.tile(variance_x, (count, 1)),
        np.tile(noise[others] ** 2, (count, 1)),
        block,
    )


def band_noise(data: Data, band: Band, fit: MotionFit, geometry: Geometry) -> Array:
    """Noise (n,) of each channel in the band, rad/s."""
    steady = without_slow(data, fit.together)
    rows = band.rows & np.isfinite(steady).all(axis=1)
    return channel_noise(steady[rows] @ geometry.parity.T, geometry)


def coherent_terms(data: Data, band: Band, fit: MotionFit, geometry: Geometry, noise: Array) -> tuple[Array, Array]:
    """Scale and timing terms (2,) that are coherent with the motion, and their standard errors (2,).

    Channels count by their noise (n,) in the band, rad/s, in the rate as in the mean over them.
    """
    steady = without_slow(data, fit.together)
    weight = 1 / noise**2
    gain = np.linalg.solve((geometry.axes.T * weight) @ geometry.axes, geometry.axes.T * weight)
    rate = steady @ gain.T
    turning = derivative(data.seconds, rate, data.step)
    rows = band.rows & np.isfinite(steady).all(axis=1) & np.isfinite(turning).all(axis=1)
    # A residual shows this share of its channel's own error.
    share = np.maximum(1 - np.einsum("ia,ai->i", geometry.axes, gain), SMALLEST_SHARE)
    residual = (steady[rows] - rate[rows] @ geometry.axes.T) / np.sqrt(share) / noise
    block = (data.seconds[rows] / BLOCK).astype(np.int64)
    terms = [coherent_term(residual, motion[rows] @ geometry.axes.T / noise, block) for motion in (rate, turning)]
    return np.array([value for value, _ in terms]), np.array([error for _, error in terms])
