# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Plausibility of a calibration: what to look at before trusting it, as warnings.

Where all other units disagree with the reference in the same way, it is the reference that is wrong.
"""

from __future__ import annotations

import numpy as np

from fdi_ros.calibration.data import Array
from fdi_ros.calibration.result import Calibration, deviations
from fdi_ros.calibration.self_check import HIGH, LOW

LARGE_ANGLE = np.radians(5.0)
"""A calibrated axis farther from its nominal one is worth a warning, rad."""
LARGE_SCALE = 0.05
"""So is a scale factor farther from 1."""
ODD = 5.0
"""Any channel this many times noisier than the usual one is worth a warning."""
NOISY = 2.5
"""A reference channel this many times noisier than the usual one is worth a warning."""
LARGE_ERROR = 0.005
"""Standard error of an axis worth a warning: 0.5 % or 0.3 deg."""
LARGE_BIAS = 0.1
"""rad/s."""
LARGE_SWING = 5e-4
"""Within a recording a bias moves by less, rad/s: 0.03 deg/s."""
SPANNING = 0.1
"""Determinant of three axes that are a unit of their own."""


def warnings_of(result: Calibration) -> tuple[str, ...]:
    """Return what to look at before trusting a calibration, one line each."""
    return (
        *_of_repeats(result),
        *_of_faults(result),
        *_of_mounting(result),
        *_of_accuracy(result),
        *_of_swing(result),
        *_of_check(result),
    )


def _of_repeats(result: Calibration) -> list[str]:
    counts = result.unusable.repeated
    return [
        f"{name} repeats one value exactly for long, {counts[i]} samples in all: they were left out as neither rest"
        " nor data"
        for i, name in enumerate(result.names)
        if counts[i]
    ]


def _of_faults(result: Calibration) -> list[str]:
    return [
        f"{' or '.join(result.names[i] for i in span.channels)} disagrees with the others from {span.start:.1f} s to"
        f" {span.end:.1f} s by {span.size:.3g} rad/s: that time was left out"
        for span in result.faults.spans
    ]


def _of_mounting(result: Calibration) -> list[str]:
    reference = list(result.reference)
    found, explained = _reference_warnings(result)
    found += _mount_warnings(result.axes, result.nominal, result.names, [*reference, *explained])
    return [*found, *_noise_warnings(result.noise.std, reference, result.names)]


def _of_accuracy(result: Calibration) -> list[str]:
    found = []
    for i, name in enumerate(result.names):
        if max(result.scale_error[i], result.angle_error[i]) > LARGE_ERROR:
            found.append(
                f"axis of {name} is uncertain by {np.degrees(result.angle_error[i]):.2f} deg and"
                f" {result.scale_error[i]:.2%}: record more rotation"
            )
        if abs(result.bias.mean[i]) > LARGE_BIAS:
            found.append(f"{name} has a bias of {result.bias.mean[i]:.3f} rad/s")
    return found


def _of_swing(result: Calibration) -> list[str]:
    swing = np.ptp(result.bias.curve, axis=0)
    moving = [name for name, size in zip(result.names, swing, strict=True) if size > LARGE_SWING]
    if not moving:
        return []
    most = float(swing.max())
    who = "every channel" if len(moving) == len(result.names) else ", ".join(moving)
    return [
        f"bias of {who} moved within the recording, by up to {most:.2g} rad/s"
        f" ({np.degrees(most):.2g} deg/s): bias.fixed is its mean"
    ]


def _of_check(result: Calibration) -> list[str]:
    found = [
        f"normalised residuals are {c.overall:.2f} in {c.name} motion, expected {LOW} to {HIGH}"
        for c in result.after.classes
        if c.samples > 100 and not _lowest(result) <= c.overall <= HIGH
    ]
    found += [f"with these settings the monitor declares at {at:.1f} s: {text}" for at, text in result.after.declared]
    return found


def _lowest(result: Calibration) -> float:
    """Least normalised residual that is no surprise: where noise is that of flight, rest and aligning lower it."""
    return 0.0 if result.notes else LOW


def _other_units(result: Calibration) -> list[list[int]]:
    """Channels of the triads that are whole, in use, and not the reference."""
    place = {channel: k for k, channel in enumerate(result.channels)}
    whole = [[3 * u, 3 * u + 1, 3 * u + 2] for u in range(max(result.channels) // 3 + 1)]
    units = [[place[i] for i in unit] for unit in whole if all(i in place for i in unit)]
    spanning = [unit for unit in units if abs(np.linalg.det(result.nominal[unit])) > SPANNING]
    return [unit for unit in spanning if not set(unit) & set(result.reference)]


def _mount_warnings(axes: Array, nominal: Array, names: tuple[str, ...], skip: list[int]) -> list[str]:
    """Name channels other than those in `skip` whose nominal axis is far from the calibrated one."""
    angle, scale = deviations(axes, nominal)
    found = []
    for i in (i for i in range(len(names)) if i not in skip):
        if angle[i] > np.pi - 2 * LARGE_ANGLE:
            found.append(f"{names[i]} points opposite to its nominal axis: sign or mount in the configuration is wrong")
        elif angle[i] > LARGE_ANGLE:
            found.append(f"{names[i]} is {np.degrees(angle[i]):.1f} deg away from its nominal axis")
        if abs(scale[i] - 1) > LARGE_SCALE:
            found.append(f"{names[i]} has the scale factor {scale[i]:.3f} against the reference")
    return found


def _reference_warnings(result: Calibration) -> tuple[list[str], list[int]]:
    """Warn where all other units disagree with the reference in the same way: then it is the reference that is wrong.

    With ``z_reference = D H_reference omega`` and D taken for 1, every other unit gets the axes
    ``M inv(H_reference) inv(D) H_reference``, M its nominal ones: the same inv(D) in all of them.

    Returns
    -------
    The warnings, and the channels whose deviation they explain.
    """
    nominal, reference, names, units = result.nominal, list(result.reference), result.names, _other_units(result)
    H = nominal[reference]
    inverses = [H @ np.linalg.inv(nominal[unit]) @ result.axes[unit] @ np.linalg.inv(H) for unit in units]
    if not inverses:
        return [], []
    common = np.mean(inverses, axis=0)
    apart = np.max([np.abs(one - common).max() for one in inverses]) if len(inverses) > 1 else 0.0
    excess = np.abs(common - np.eye(3))
    limit = np.where(np.eye(3) > 0, LARGE_SCALE, np.sin(LARGE_ANGLE))
    if (excess < limit).all() or apart > 0.5 * excess.max():
        return [], []
    found = _reference_channels(common, reference, names)
    if not found:
        who = names[reference[0]].rpartition(".")[0] or "the reference"
        others = "all other units are turned alike" if len(units) > 1 else "the other unit is turned"
        found.append(
            f"{others} against {who} otherwise than configured: written as measured, in the frame of {who}, whose mount"
            " is probably wrong"
        )
    if len(units) == 1:
        found = [f"{text}; with one other unit it may as well be that one that is wrong" for text in found]
    return found, [i for unit in units for i in unit]


def _reference_channels(common: Array, reference: list[int], names: tuple[str, ...]) -> list[str]:
    """Name reference channels that by themselves explain ``inv(D)`` (3, 3): no rotation off its diagonal."""
    found = []
    for k, i in enumerate(reference):
        if np.abs(np.delete(common[k], k)).max() >= np.sin(LARGE_ANGLE):
            continue
        if common[k, k] < -0.5:
            found.append(f"{names[i]} of the reference points the other way than all other units say")
        elif abs(common[k, k] - 1) > LARGE_SCALE:
            found.append(f"{names[i]} of the reference reads {1 / common[k, k]:.3f} of what all other units say")
    return found


def _noise_warnings(noise: Array, reference: list[int], names: tuple[str, ...]) -> list[str]:
    """Name channels that are far noisier than the rest, and those of the reference that are noisier."""
    times = noise / float(np.median(noise))
    found = [
        f"{names[i]} is {times[i]:.1f} times noisier than the usual channel: loose, badly isolated or faulty;"
        " its noise_std keeps it from counting for much"
        for i in np.flatnonzero(times > ODD)
    ]
    found += [
        f"{names[i]} of the reference is {times[i]:.1f} times noisier than the usual channel: another reference would"
        " serve better (--reference)"
        for i in reference
        if times[i] > NOISY
    ]
    return found
