# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a recording of the channels to the settings of the monitor: axes, biases, noise, and their standard errors.

`calibrate` takes samples; ``fdi calibrate`` reads them from a bag and writes the settings. Method and formulas are in
docs/calibration.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fdi_ros.calibration.agreement import check_units
from fdi_ros.calibration.band import aligned
from fdi_ros.calibration.data import Array, prepare_channels
from fdi_ros.calibration.estimate import Estimate, Task, skew
from fdi_ros.calibration.from_motion import from_motion
from fdi_ros.calibration.from_rest import from_rest, pipeline_noise
from fdi_ros.calibration.noise import NoiseFit
from fdi_ros.calibration.plausibility import warnings_of
from fdi_ros.calibration.requirements import LEAST_REST, check_duration, vibrates
from fdi_ros.calibration.rest import find_rest
from fdi_ros.calibration.result import Calibration, Delay, Seconds, Unusable
from fdi_ros.calibration.self_check import check
from fdi_ros.calibration.settings import settings
from fdi_ros.config.config import Config
from fdi_ros.errors import CalibrationError
from fdi_ros.model.block import Block
from fdi_ros.model.geometry import Geometry, spans_space
from fdi_ros.monitor.build import build_geometry
from fdi_ros.sources import source_of

LARGEST_SCALE, LARGEST_TIMING = 0.02, 0.002
"""Scale error and, in s, timing error that calibrated units may show in motion; what is beyond is vibration."""


def calibrate(block: Block, config: Config, reference: str = "") -> Calibration:
    """Calibrate all channels that are not excluded.

    Parameters
    ----------
    block
        The recording: some rotation about every axis, by hand with some rest, or a flight.
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
    try:
        return _calibrated(block, config, reference)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(f"the recording leaves the fit undetermined ({error})") from error


def _calibrated(block: Block, config: Config, reference: str) -> Calibration:
    nominal = build_geometry(config)
    active = [i for i, name in enumerate(nominal.channel_names) if name not in config.excluded_channels]
    chosen = _reference(config, nominal, active, reference)
    task = _task(block, config, nominal, active, chosen)
    check_duration(task.data, task.nominal.channel_names)
    if source_of(config).units:
        check_units(task.data, task.units, task.nominal.channel_names)
    rest = find_rest(task.data, config.bias.max_rest_rate)
    if rest.seconds < LEAST_REST or vibrates(task.data, rest, task.reference):
        estimate = from_motion(task, rest)
        return _result(task, estimate, estimate.noise, active, block)
    estimate = from_rest(task, rest)
    noise = pipeline_noise(task, estimate, delays_taken_off(task, estimate))
    if noise.scale > LARGEST_SCALE or noise.timing > LARGEST_TIMING:
        # Calibrated units do not have errors as large as that: in spite of the rest, the frame is shaken.
        estimate = from_motion(task, rest)
        noise = estimate.noise
    return _result(task, estimate, noise, active, block)


def _reference(config: Config, nominal: Geometry, active: list[int], name: str) -> list[int]:
    """Return the numbers of the reference channels among all channels."""
    names, units = nominal.channel_names, source_of(config).units
    if name:
        wanted = [part.strip() for part in name.split(",")]
        if units and len(wanted) == 1:
            wanted = [f"{name}.{axis}" for axis in "xyz"]
        unknown = [part for part in wanted if part not in names]
        if unknown or len(wanted) != 3:
            triads = f"one of {', '.join(units)}, or " if units else ""
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
    if source_of(config).units:
        return [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(nominal.n // 3)]
    n = nominal.n
    every = [[i, j, k] for i in range(n) for j in range(i + 1, n) for k in range(j + 1, n)]
    return [triple for triple in every if spans_space(nominal.axes[triple])]


def _task(block: Block, config: Config, nominal: Geometry, active: list[int], reference: list[int]) -> Task:
    mask = np.zeros(nominal.n, dtype=bool)
    mask[active] = True
    data = prepare_channels(block, config, active)
    source = source_of(config)
    others = [i for i in active if i not in reference]
    # Channels of one message have one stamp, but which of them share a chip is not known.
    chips = [source.chip_of(i) for i in others]
    own = {source.chip_of(i) for i in reference}
    numbers = sorted(set(chips) - own)
    groups = np.array([numbers.index(chip) if chip in numbers else -1 for chip in chips], dtype=np.int64)
    place = {channel: k for k, channel in enumerate(active)}
    if source.units:
        units = [[place[i] for i in active if source.chip_of(i) == u] for u in range(nominal.n // 3)]
    else:
        units = [[place[i] for i in reference], [place[i] for i in others]]
    chosen = [place[i] for i in reference]
    return Task(config, data, nominal.subset(mask), chosen, groups, [unit for unit in units if unit])


def _result(task: Task, estimate: Estimate, noise: NoiseFit, active: list[int], block: Block) -> Calibration:
    data, late = task.data, delays_taken_off(task, estimate)
    changed = settings(task, active, estimate, noise, late)
    sound = data.complete & ~estimate.faults.faulty_windows[data.window]
    still = estimate.rest.window[data.window]
    before = check(task.config, block, _spread(data.z, active, block), still, sound)
    # The samples as they are once the delays are taken off.
    z = _spread(aligned(data, data.z, late, skew(task, late)), active, block)
    tried = Config.from_parameters({**task.config.parameters(), **changed})
    whole = np.isfinite(z[:, active]).all(axis=1)
    after = check(
        tried, Block(block.stamp, np.where(np.isfinite(z), z, block.z), block.received), z, still, sound & whole
    )
    result = Calibration(
        names=task.nominal.channel_names,
        channels=tuple(active),
        reference=tuple(task.reference),
        nominal=task.nominal.axes,
        axes=estimate.geometry.axes,
        axes_covariance=estimate.covariance,
        bias=estimate.bias,
        noise=noise,
        delays=tuple(_delay(task, estimate, k) for k in range(int(task.groups.max(initial=-1)) + 1)),
        faults=estimate.faults,
        unusable=Unusable(
            *(data.missing, data.non_finite, data.out_of_range, data.repeated, estimate.faults.outliers.sum(axis=0))
        ),
        seconds=Seconds(
            all=data.duration,
            rest=float(still.sum()) * data.step,
            motion=float((sound & ~still).sum()) * data.step,
        ),
        settings=changed,
        before=before,
        after=after,
        notes=estimate.notes,
    )
    return replace(result, warnings=warnings_of(result))


def delays_taken_off(task: Task, estimate: Estimate) -> Array:
    """Return the delays (n,) against the reference that go into the settings, s: an array has one stamp for all."""
    return estimate.late_shown if source_of(task.config).stamped else np.zeros(task.nominal.n)


def _delay(task: Task, estimate: Estimate, group: int) -> Delay:
    channels = [task.others[i] for i in np.flatnonzero(task.groups == group)]
    return Delay(tuple(channels), float(estimate.late[channels[0]]), float(estimate.late_error[channels[0]]))


def _spread(z: Array, active: list[int], block: Block) -> Array:
    """Channels in use (N, k) among all, NaN in the others."""
    full = np.full(block.z.shape, np.nan)
    full[:, active] = z
    return full
