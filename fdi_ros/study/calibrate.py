"""From a recording of the channels to the settings of the monitor: axes, biases, noise, and how sure they are.

`calibrate` takes samples; ``fdi calibrate`` reads them from a bag and writes the settings. Method and formulas are in
docs/calibration.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fdi_ros.config import Config
from fdi_ros.errors import CalibrationError
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.monitor.build import build_geometry
from fdi_ros.study.calibration_axes import Fit, fit_axes, make_sample, sound_axes, undelayed
from fdi_ros.study.calibration_bias import Bias, estimate_bias
from fdi_ros.study.calibration_check import check
from fdi_ros.study.calibration_data import Array, Data, Index, Mask, Rest, find_rest, prepare
from fdi_ros.study.calibration_excitation import check_duration, check_excitation, check_response, check_rest
from fdi_ros.study.calibration_faults import Faults, find_faults, no_faults
from fdi_ros.study.calibration_noise import DEGREES, NoiseFit, View, fit_noise, rest_noise, view
from fdi_ros.study.calibration_result import Calibration, Delay, Unusable
from fdi_ros.study.calibration_settings import settings

MOST_FAULTY = 0.35
"""Share of the windows in which a channel may be faulty; with more, it cannot be said who is right."""
START_NOISE = (0.003, 0.0003)
"""Scale and timing terms, s, that weigh the samples before they are fitted."""
ROUNDS = 3
"""Of axes, noise and faults in turn."""


@dataclass(frozen=True)
class _Task:
    """The channels in use, and what the configuration says of them."""

    config: Config
    data: Data
    nominal: Geometry
    reference: list[int]
    groups: Index
    """(m,) for every other channel which of them it is sampled together with; -1: with the reference."""


@dataclass(frozen=True)
class _Estimate:
    """What is known of the channels after some rounds."""

    rest: Rest
    faults: Faults
    bias: Bias
    fit: Fit
    geometry: Geometry
    covariance: Array
    noise: NoiseFit
    seen: View


def calibrate(block: Block, config: Config, reference: str = "") -> Calibration:
    """Calibrate all channels that are not excluded.

    Parameters
    ----------
    block
        The recording: some rest, and some rotation about every axis.
    config
        Nominal mounting, range of the gyros, excluded channels, and what else the monitor needs.
    reference
        Name of the triad that fixes the body frame and the scale, or of three channels with commas between;
        empty: the first triad, or the first three channels that span space.

    Raises
    ------
    FdiError
        If the recording does not show what is needed, naming what.
    """
    nominal = build_geometry(config)
    active = [i for i, name in enumerate(nominal.channel_names) if name not in config.excluded_channels]
    chosen = _reference(config, nominal, active, reference)
    task = _task(block, config, nominal, active, chosen)
    check_duration(task.data, task.nominal.channel_names)
    estimate = _estimate(task)
    return _result(task, estimate, active, block)


def _reference(config: Config, nominal: Geometry, active: list[int], name: str) -> list[int]:
    """Return the numbers of the reference channels among all channels."""
    names = nominal.channel_names
    if name:
        wanted = [part.strip() for part in name.split(",")]
        if config.input == "imus" and len(wanted) == 1:
            wanted = [f"{name}.{axis}" for axis in "xyz"]
        unknown = [part for part in wanted if part not in names]
        if unknown or len(wanted) != 3:
            triads = f"one of {', '.join(config.imu_names)}, or " if config.input == "imus" else ""
            raise CalibrationError(f"reference is {name!r}, expected {triads}three of: {', '.join(names)}")
        chosen = [names.index(part) for part in wanted]
    else:
        chosen = next((c for c in _triples(config, nominal) if set(c) <= set(active)), [])
    if len(set(chosen)) != 3 or not set(chosen) <= set(active) or not spans_space(nominal.axes[chosen]):
        raise CalibrationError(
            f"reference {name or 'of three channels'}: expected three channels in use that span space"
        )
    return chosen


def _triples(config: Config, nominal: Geometry) -> list[list[int]]:
    if config.input == "imus":
        return [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(nominal.n // 3)]
    n = nominal.n
    every = [[i, j, k] for i in range(n) for j in range(i + 1, n) for k in range(j + 1, n)]
    return [triple for triple in every if spans_space(nominal.axes[triple])]


def _task(block: Block, config: Config, nominal: Geometry, active: list[int], reference: list[int]) -> _Task:
    mask = np.zeros(nominal.n, dtype=bool)
    mask[active] = True
    received = None if block.received is None else block.received[:, active]
    rates = np.broadcast_to(np.array(config.health.max_rate), nominal.n)
    data = prepare(Block(block.stamp, block.z[:, active], received), rates[active])
    others = [i for i in active if i not in reference]
    # Channels of one message have one stamp, but nobody knows which of them share a chip.
    chips = [i // 3 if config.input == "imus" else i for i in others]
    own = {i // 3 for i in reference} if config.input == "imus" else set()
    numbers = sorted(set(chips) - own)
    groups = np.array([numbers.index(chip) if chip in numbers else -1 for chip in chips], dtype=np.int64)
    return _Task(config, data, nominal.subset(mask), [active.index(i) for i in reference], groups)


def _estimate(task: _Task) -> _Estimate:
    """Run rounds of axes, noise and faults: each makes the next one better."""
    rest = find_rest(task.data, task.config.bias.max_rest_rate)
    check_rest(rest, task.nominal.channel_names)
    faults = no_faults(task.data)
    estimate = _round(task, rest, faults, None)
    for _ in range(ROUNDS - 1):
        faults = find_faults(task.data, rest, estimate.seen, estimate.geometry, estimate.noise)
        _refuse_faulty(task, rest, faults)
        estimate = _round(task, rest, faults, estimate)
    return estimate


def _round(task: _Task, rest: Rest, faults: Faults, before: _Estimate | None) -> _Estimate:
    data = task.data
    good = Rest(rest.window, rest.fits & ~faults.windows, rest.mean, rest.std, rest.level)
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
    geometry = _checked_geometry(axes, task.nominal)
    together = undelayed(data, steady, axes, fit, task.groups, task.reference)
    seen = view(data.stamp, together, geometry, rest.level, task.config.noise.acceleration_window)
    at_rest = rest_noise(together, rows & still, geometry, rest.level)
    noise = fit_noise(data, seen, moving, geometry, at_rest, DEGREES)
    return _Estimate(rest, faults, bias, fit, geometry, covariance, noise, seen)


def _pipeline_noise(task: _Task, estimate: _Estimate) -> NoiseFit:
    """Noise as the pipeline meets it: constant biases, delays not taken out, second moments as they are."""
    data, geometry, rest = task.data, estimate.geometry, estimate.rest
    z = data.z - estimate.bias.mean
    rows = data.complete & ~estimate.faults.bad_rows(data)
    still = rest.window[data.window]
    seen = view(data.stamp, z, geometry, estimate.noise.std, task.config.noise.acceleration_window)
    at_rest = rest_noise(z, rows & still, geometry, rest.level)
    return fit_noise(data, seen, rows & ~still, geometry, at_rest)


def _fit(task: _Task, steady: Array, moving: Mask, level: Array, before: _Estimate | None) -> Fit:
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


def _checked_geometry(axes: Array, nominal: Geometry) -> Geometry:
    """Geometry of the calibrated axes; one that no gyro can have is a channel that does not work."""
    norms = np.linalg.norm(axes, axis=1)
    for i, name in enumerate(nominal.channel_names):
        if not 0.5 <= norms[i] <= 2.0:
            raise CalibrationError(
                f"{name} has the scale factor {norms[i]:.3g} against the reference, expected 0.5 to 2:"
                " it, or the reference, does not work; mend it or name it in excluded_channels"
            )
    return Geometry(axes, nominal.channel_names)


def _refuse_faulty(task: _Task, rest: Rest, faults: Faults) -> None:
    """Refuse where one channel is faulty so long that the others cannot be sure of each other.

    Raises
    ------
    CalibrationError
        Naming it.
    """
    for span_of in (np.ones_like(rest.window), ~rest.window):
        share = faults.windows[span_of].mean(axis=0)
        if share.max() > MOST_FAULTY:
            group = [task.nominal.channel_names[i] for i in np.flatnonzero(share > MOST_FAULTY)]
            spans = [s for s in faults.spans if int(share.argmax()) in s.channels]
            where = "the recording" if span_of.all() else "the motion"
            raise CalibrationError(
                f"{' or '.join(group)} disagrees with the others in {share.max():.0%} of {where} (from"
                f" {spans[0].start:.1f} s to {spans[-1].end:.1f} s, by {max(s.size for s in spans):.3g} rad/s):"
                " faulty; mend it, cut it out with --start and --end, or name it in excluded_channels"
            )


def _result(task: _Task, estimate: _Estimate, active: list[int], block: Block) -> Calibration:
    data, fit = task.data, estimate.fit
    others = np.array([i for i in range(data.z.shape[1]) if i not in task.reference])
    errors = np.sqrt(np.maximum(np.diag(fit.covariance)[3 * len(fit.gain) :], 0))
    noise = _pipeline_noise(task, estimate)
    changed = settings(task.config, active, estimate.geometry.axes, estimate.bias.mean, noise)
    sound = data.complete & ~estimate.faults.faulty_windows[data.window]
    still = estimate.rest.window[data.window]
    z = np.full(block.z.shape, np.nan)
    z[:, active] = data.z
    tried = (task.config, Config.from_parameters({**task.config.parameters(), **changed}))
    before, after = (check(config, block, z, still, sound) for config in tried)
    return Calibration(
        names=task.nominal.channel_names,
        channels=tuple(active),
        reference=tuple(task.reference),
        nominal=task.nominal.axes,
        axes=estimate.geometry.axes,
        axes_covariance=estimate.covariance,
        bias=estimate.bias,
        noise=noise,
        noise_undelayed=estimate.noise,
        delays=tuple(
            Delay(tuple(others[task.groups == k].tolist()), float(value), float(errors[k]))
            for k, value in enumerate(fit.delay)
        ),
        faults=estimate.faults,
        unusable=Unusable(data.missing, data.non_finite, data.out_of_range, estimate.faults.outliers.sum(axis=0)),
        seconds={
            "all": data.duration,
            "rest": float(still.sum()) * data.step,
            "motion": float((sound & ~still).sum()) * data.step,
        },
        settings=changed,
        before=before,
        after=after,
    )
