"""Calibration from motion alone: what a flight without rest shows, and what it does not.

Delays and axes come from the band in which all units see one motion (`calibration_band`), biases relative to each
other from means over the flight, noise from the disagreement of one sample, vibration included. What all channels have
in common as a bias is a constant rotation to them, and stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.calibration.axes import Fit, Sample, derivative, fit_axes, sound_axes
from fdi_ros.calibration.band import bridged, low_pass, motion_band, runs, shifted, without_slow
from fdi_ros.calibration.bias import Bias
from fdi_ros.calibration.data import Array, Data, Index, Mask, Rest
from fdi_ros.calibration.estimate import Estimate, Task, checked_geometry, refuse_faulty, uncertainty
from fdi_ros.calibration.faults import Faults, find_faults, no_faults
from fdi_ros.calibration.noise import NoiseFit, View, view
from fdi_ros.calibration.requirements import LEAST_REST, axis_words, rest_seconds
from fdi_ros.calibration.spread import channel_noise, coherent_term, shared_noise
from fdi_ros.calibration.walk import find_walk
from fdi_ros.errors import CalibrationError
from fdi_ros.model.geometry import Geometry

HELD_ERROR = 0.01
"""Part of an axis that the motion leaves more uncertain than this is kept as configured: 1 % of scale, 0.6 deg."""
OVERSAMPLED = 4.0
"""Rows used a period of the fastest motion."""
SETTLED = 1e-5
"""Delays are taken off again until they change by less, s."""
ROUNDS = 3
"""Of axes, biases, noise and faults in turn."""
DELAY_ROUNDS = 4
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
"""Fewer rows of motion fit nothing."""
MOST_ROWS = 8000
"""More add nothing but time."""
LARGEST_DELAY = 0.1
"""What imus.delays may be at most, s."""
SMALLEST_SHARE = 0.05
"""A channel that alone decides the rate shows nothing of its own error."""


def from_motion(task: Task, rest: Rest) -> Estimate:
    """Run rounds of delays and axes, biases, noise and faults: each makes the next one better.

    Raises
    ------
    CalibrationError
        If the units share no motion, or a channel disagrees for most of it.
    """
    faults = no_faults(task.data)
    estimate, noise = _round(task, rest, faults, np.full(task.nominal.n, FIRST_NOISE))
    for _ in range(ROUNDS - 1):
        faults = find_faults(task.data, rest, estimate.seen, estimate.geometry, estimate.noise)
        refuse_faulty(task.nominal.channel_names, rest, faults)
        estimate, noise = _round(task, rest, faults, noise)
    return estimate


def _round(task: Task, rest: Rest, faults: Faults, noise: Array) -> tuple[Estimate, Array]:
    """One round, and the noise (n,) of the channels in the band that the next one begins with, rad/s."""
    data = task.data
    good, spiky = data.complete & ~faults.bad_rows(data), faults.outliers.any(axis=1)
    moving = ~rest.window[data.window]
    band = find_band(data, good, moving, task.units)
    if band is None or band.rows.sum() < LEAST_ROWS:
        raise CalibrationError(
            "the units show no rotation in common to calibrate on: turn the vehicle about x, y and z of"
            f" {task.config.body_frame}, on the ground or in flight, and check that all units are on it"
        )
    found = fit_motion(data, band, task.nominal, task.reference, task.groups, noise)
    if found.held.all():
        raise CalibrationError(
            f"the recording shows no rotation to calibrate on: {found.rms.max():.3f} rad/s rms at most below"
            f" {band.cutoff:.1f} Hz: turn the vehicle about x, y and z of {task.config.body_frame}"
        )
    geometry = checked_geometry(found.axes, task.nominal)
    noise = band_noise(data, band, found, geometry)
    bias = relative_bias(data, found, geometry, _rest_bias(rest))
    usual = data.complete & ~spiky
    sample, seen = _noise(task, band, found, geometry, bias, noise, good & moving, usual)
    notes = _notes(task, band, found, sample, rest)
    estimate = Estimate(
        rest, faults, bias, geometry, found.covariance, found.late, found.late_error, sample, seen, notes
    )
    return estimate, noise


def _noise(
    task: Task, band: Band, found: MotionFit, geometry: Geometry, bias: Bias, in_band: Array, rows: Mask, usual: Mask
) -> tuple[NoiseFit, View]:
    """Noise of one sample in motion, vibration included, from rows (N,), and the view of all that is usual (N,)."""
    data = task.data
    # Faults are in sight, too: the next round must find them again.
    spans, low = confined(data, usual, band.cutoff)
    # The delays are taken off where the units see one motion. Above, nothing is shared that could be aligned, and a
    # line between two samples would make the noise of one sample less than it is.
    z = data.z - low + shifted(data, low, spans, found.late) - bias.at(data.seconds)
    rows = rows & np.isfinite(z).all(axis=1)
    # Samples that are left out between these leave steps behind, too few to matter.
    high = (data.z - low)[rows]
    std = channel_noise(z[rows] @ geometry.parity.T, geometry, high.std(axis=0))
    std = shared_noise(std, high, geometry.axes)
    values, errors = coherent_terms(data, band, found, geometry, in_band)
    unknown = uncertainty(found.covariance, found.late_error, task.others)
    terms = np.hypot(np.where(values > STANDS_OUT * errors, values, 0.0), unknown)
    if found.held.any():
        terms[0] = max(terms[0], UNKNOWN_SCALE)
    noise = NoiseFit(
        std, std / np.sqrt(2 * rows.sum()), float(terms[0]), float(errors[0]), float(terms[1]), float(errors[1])
    )
    return noise, view(data.stamp, z, geometry, std, task.config.noise.acceleration_window)


def _notes(task: Task, band: Band, found: MotionFit, noise: NoiseFit, rest: Rest) -> tuple[str, ...]:
    """Say what the recording does not show, and what stands in its place, a line each."""
    notes = [
        f"axes and delays are from the motion that all units share, below {band.cutoff:.1f} Hz",
        f"noise_std is of one sample in flight, with vibration: {noise.std.min():.2g} to {noise.std.max():.2g} rad/s",
    ]
    if rest_seconds(rest) < LEAST_REST:
        notes.append(
            f"at rest for {rest_seconds(rest):.1f} s: biases are relative to each other; what all units have in common"
            " looks like a rotation and is left 0"
        )
    for k in np.flatnonzero(found.held.any(axis=0)):
        held = [task.nominal.channel_names[task.others[i]] for i in np.flatnonzero(found.held[:, k])]
        who = "all other channels" if len(held) == len(task.others) else ", ".join(held)
        notes.append(
            f"the rotation about {axis_words(found.directions[:, k], task.config.body_frame)} ({found.rms[k]:.3f} rad/s"
            f" rms) shows the axes of {who} no better than to {HELD_ERROR:.0%}: kept as configured there"
        )
    names, groups = task.nominal.channel_names, [g for g in task.nominal.groups if len(g) > 1]
    if groups:
        alike = "; ".join(" and ".join(names[i] for i in group) for group in groups)
        notes.append(f"whose noise is whose cannot be told between {alike}: taken to share as their vibration does")
    return tuple(notes)


def _rest_bias(rest: Rest) -> Array | None:
    """Bias (n,) rad/s of the channels where there is rest enough, spikes and odd windows aside."""
    if rest_seconds(rest) < LEAST_REST:
        return None
    return np.asarray(np.nanmedian(np.where(rest.fits, rest.mean, np.nan)[rest.window], axis=0))


@dataclass(frozen=True)
class Band:
    """The channels confined to the motion that they share.

    Attributes
    ----------
    cutoff
        Its upper end, Hz.
    spans
        Without gaps.
    low
        (N, n) channels below the cut-off, rad/s; NaN where there are none.
    rows
        (N,) samples that are fitted to: in motion, and no more of them than the band has independent ones.
    """

    cutoff: float
    spans: list[slice]
    low: Array
    rows: Mask


@dataclass(frozen=True)
class MotionFit:
    """Axes and delays from the band.

    Attributes
    ----------
    fit
        Gain in the directions of the body below.
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

    fit: Fit
    directions: Array
    rms: Array
    held: Mask
    late: Array
    late_error: Array
    axes: Array
    covariance: Array
    together: Array


def find_band(data: Data, good: Mask, moving: Mask, units: list[list[int]]) -> Band | None:
    """Confine the channels to the motion that they share; None where they share none.

    Parameters
    ----------
    data
        The recording.
    good
        (N,) complete samples without a known fault.
    moving
        (N,) samples in motion.
    units
        Channels of each unit.
    """
    spans = runs(data, good)
    full = bridged(data, data.z, good, spans)
    cutoff = motion_band(data, full, spans, moving, units)
    if not cutoff:
        return None
    spans, low = confined(data, good, cutoff)
    sparse = np.zeros(len(good), dtype=bool)
    sparse[:: max(int(1 / (OVERSAMPLED * cutoff * data.step)), len(good) // MOST_ROWS, 1)] = True
    return Band(cutoff, spans, low, sparse & moving & np.isfinite(low).all(axis=1))


def confined(data: Data, good: Mask, cutoff: float) -> tuple[list[slice], Array]:
    """Spans without a gap of good samples (N,), and the channels (N, n) in them below a frequency, Hz."""
    spans = runs(data, good)
    return spans, low_pass(data, bridged(data, data.z, good, spans), spans, cutoff)


def fit_motion(
    data: Data, band: Band, nominal: Geometry, reference: list[int], groups: Index, noise: Array
) -> MotionFit:
    """Fit axes and delays in the band, delays again until they are all taken off.

    Parameters
    ----------
    data, band
        The recording, and what is shared of it.
    nominal
        Axes as configured; those of the reference stay.
    reference, groups
        The reference channels, and for the others which are sampled together, -1: with the reference.
    noise
        (n,) of each channel in the band, rad/s.
    """
    others = [i for i in range(nominal.n) if i not in reference]
    late = np.zeros(nominal.n)
    to_body: Array = np.asarray(np.linalg.inv(nominal.axes[reference]), dtype=np.float64)
    # Directions by how much the body turns about them: what is not turned about is held by itself.
    steady = without_slow(data, band.low)[band.rows]
    square = to_body @ np.cov(steady[:, reference].T) @ to_body.T
    value, vectors = np.linalg.eigh(square)
    directions = np.asarray(vectors, dtype=np.float64)
    expected = nominal.axes[others] @ directions
    held = np.zeros((len(others), 3), dtype=bool)
    for _ in range(DELAY_ROUNDS):
        together = shifted(data, band.low, band.spans, late)
        sample = _sample(data, band, without_slow(data, together), to_body, directions, reference, others, noise)
        fit = fit_axes(sample, groups, held=held, nominal=expected)
        m = len(others)
        error = np.sqrt(np.maximum(np.diag(fit.covariance)[: 3 * m].reshape(m, 3), 0))
        more = (error > HELD_ERROR) & ~held
        late[others] -= np.where(groups >= 0, np.append(fit.delay, 0.0)[groups], 0.0)
        late = np.clip(late, -LARGEST_DELAY, LARGEST_DELAY)
        if not more.any() and np.abs(fit.delay).max(initial=0.0) < SETTLED:
            break
        held |= more
    error_of = np.append(np.sqrt(np.maximum(np.diag(fit.covariance)[3 * m :], 0)), 0.0)
    late_error = np.zeros(nominal.n)
    late_error[others] = np.where(groups >= 0, error_of[groups], 0.0)
    axes, covariance = sound_axes(fit, directions.T, reference)
    axes[reference] = nominal.axes[reference]
    return MotionFit(fit, directions, np.sqrt(np.maximum(value, 0)), held, late, late_error, axes, covariance, together)


def _sample(
    data: Data,
    band: Band,
    z: Array,
    to_body: Array,
    directions: Array,
    reference: list[int],
    others: list[int],
    noise: Array,
) -> Sample:
    """Rows of the band with the reference as rates about the directions."""
    turn = to_body.T @ directions
    x = z[:, reference] @ turn
    a = derivative(data.seconds, x, data.step)
    rows = band.rows & np.isfinite(z).all(axis=1) & np.isfinite(a).all(axis=1)
    count = int(rows.sum())
    variance_x = noise[reference] ** 2 @ turn**2
    block = np.unique(data.seconds[rows].astype(np.int64), return_inverse=True)[1].astype(np.int64)
    return Sample(
        x[rows],
        a[rows],
        z[rows][:, others],
        np.tile(variance_x, (count, 1)),
        np.tile(noise[others] ** 2, (count, 1)),
        block,
    )


def band_noise(data: Data, band: Band, found: MotionFit, geometry: Geometry) -> Array:
    """Noise (n,) of each channel in the band, rad/s."""
    steady = without_slow(data, found.together)
    rows = band.rows & np.isfinite(steady).all(axis=1)
    return channel_noise(steady[rows] @ geometry.parity.T, geometry)


def relative_bias(data: Data, found: MotionFit, geometry: Geometry, common: Array | None) -> Bias:
    """Bias of the channels relative to each other, its course and its walk.

    Parameters
    ----------
    data, found
        The recording, and what is known of it.
    geometry
        Calibrated axes.
    common
        (n,) biases at rest, rad/s, that fix what all have in common; None: left zero.
    """
    V = geometry.parity
    rows = np.isfinite(found.together).all(axis=1)
    walk = find_walk(data.seconds[rows], found.together[rows] @ V.T, data.duration)
    # Of all biases with these disagreements the smallest: the rest is a rotation of the whole.
    base = np.zeros(geometry.n) if common is None else geometry.axes @ (geometry.least_squares @ common)
    course = walk.course @ V + base
    error = np.sqrt(np.maximum((V**2).T @ walk.std**2, 0))
    each = np.full(geometry.n, walk.walk)
    return Bias(course.mean(axis=0), error, each, walk.time, course, walk.walk > 0, walk.possible)


def coherent_terms(data: Data, band: Band, found: MotionFit, geometry: Geometry, noise: Array) -> tuple[Array, Array]:
    """Scale and timing terms (2,) that are coherent with the motion, and their standard errors (2,).

    Channels count by their noise (n,) in the band, rad/s, in the rate as in the mean over them.
    """
    steady = without_slow(data, found.together)
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
