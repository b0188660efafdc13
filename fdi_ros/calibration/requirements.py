# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What a recording must contain to be calibrated on: length, usable values, rest, rotation about every axis.

`vibrates` decides which of the two ways of calibration it is for; all else raises CalibrationError.
"""

from __future__ import annotations

import numpy as np

from fdi_ros.calibration.agreement import LEAST_ROTATION
from fdi_ros.calibration.data import WINDOW, Array, Data
from fdi_ros.calibration.rest import Rest
from fdi_ros.errors import CalibrationError

LEAST_DURATION = 10.0
"""s."""
LEAST_REST = 2.0
"""s."""
SAMPLES = 50
"""With fewer no noise is estimated."""
VIBRATES = 2.0
"""Disagreement from sample to sample in slow motion, over that at rest, from which it is vibration."""
LEAST_USABLE = 0.7
"""Share of its samples that a channel must give."""
LARGEST_ERROR = 0.004
"""Of the axes, along any direction: 0.4 % of scale, 0.23 deg."""


def check_duration(data: Data, names: tuple[str, ...]) -> None:
    """Refuse a recording that is too short, or in which a channel gives too little.

    Raises
    ------
    CalibrationError
        Saying which.
    """
    if len(data.stamp) < 2 or data.duration < LEAST_DURATION:
        raise CalibrationError(
            f"the recording is {data.duration if len(data.stamp) else 0:.1f} s long, a calibration needs at least"
            f" {LEAST_DURATION:g} s with some rest and some rotation about every axis"
        )
    for i, name in enumerate(names):
        share = float(np.isfinite(data.z[:, i]).mean())
        if share < LEAST_USABLE:
            raise CalibrationError(
                f"{name} gives a usable value in {share:.0%} of the samples, expected at least {LEAST_USABLE:.0%}"
                f" ({data.missing[i]} missing, {data.non_finite[i]} not finite, {data.out_of_range[i]} out of range,"
                f" {data.repeated[i]} frozen):"
                " mend it or name it in excluded_channels"
            )


def vibrates(data: Data, rest: Rest, reference: list[int]) -> bool:
    """Whether motion brings vibration with it: the channels disagree at high frequencies even where it is slow.

    The others' second differences are explained by those of the reference, by whatever axes suit them, so neither a
    smooth motion nor a wrong mount counts.
    """
    z, still = data.z, rest.window[data.window]
    rough = z[2:] - 2 * z[1:-1] + z[:-2]
    usable = np.isfinite(rough).all(axis=1) & (data.seconds[2:] - data.seconds[:-2] < 2.5 * data.step)
    moving, at_rest = usable & ~still[2:] & ~still[:-2], usable & still[2:] & still[:-2]
    if moving.sum() < SAMPLES or at_rest.sum() < SAMPLES:
        return False
    others = [i for i in range(z.shape[1]) if i not in reference]
    gain = np.linalg.lstsq(rough[moving][:, reference], rough[moving][:, others], rcond=None)[0]
    off = np.abs(rough[:, others] - rough[:, reference] @ gain)
    speed = np.abs(z[1:-1, reference]).max(axis=1)
    slow = moving & (speed <= np.median(speed[moving]))
    # Both levels are of quantised values: a step of the converter must not divide by zero.
    level = np.maximum(np.median(off[at_rest], axis=0), 1e-9)
    return bool(np.median(np.median(off[slow], axis=0) / level) > VIBRATES)


def check_rest(rest: Rest, names: tuple[str, ...]) -> None:
    """Refuse a recording without rest: biases could not be distinguished from rotation.

    Raises
    ------
    CalibrationError
        Saying how much rest there is.
    """
    seconds = rest.seconds
    if seconds < LEAST_REST:
        raise CalibrationError(
            f"the recording is at rest for {seconds:.1f} s, a calibration needs at least {LEAST_REST:g} s:"
            " let the vehicle stand still, motors off, at the beginning"
        )
    fitting = (rest.fits & rest.window[:, None]).sum(axis=0) * WINDOW
    for i, name in enumerate(names):
        if fitting[i] < LEAST_REST:
            raise CalibrationError(
                f"{name} is not at rest while all others are: quiet for {fitting[i]:.1f} s of {seconds:.1f} s,"
                f" expected at least {LEAST_REST:g} s; mend it or name it in excluded_channels"
            )


def check_excitation(x: Array, axes: Array, noise: Array, frame: str) -> None:
    """Refuse motion that leaves an axis of the body out, and name it.

    Parameters
    ----------
    x
        (K, 3) bias-free reference channels in motion, rad/s.
    axes
        (3, 3) axes of the reference channels.
    noise
        (n,) noise of all channels at rest, rad/s.
    frame
        Name of the body frame.

    Raises
    ------
    CalibrationError
        Naming the axis about which there is too little rotation.
    """
    direction, rms, error = _rotation(x, axes, noise)
    poor = (error > LARGEST_ERROR) | (rms < LEAST_ROTATION)
    if not poor.any():
        return
    if poor.all():
        raise CalibrationError(
            f"the recording shows no rotation to calibrate on ({len(x)} samples in motion, {rms.max():.3f} rad/s rms"
            f" at most): turn the vehicle about x, y and z of {frame}, some 0.5 rad/s back and forth"
        )
    words = " and ".join(axis_words(direction[:, k], frame) for k in np.flatnonzero(poor))
    k = int(np.flatnonzero(poor)[0])
    raise CalibrationError(
        f"the recording shows too little rotation about {words}: {rms[k]:.3f} rad/s rms while moving, expected"
        f" {LEAST_ROTATION:g}, and enough of it for axes good to {LARGEST_ERROR:.1%}; turn the vehicle about it, too"
    )


def _rotation(x: Array, axes: Array, noise: Array) -> tuple[Array, Array, Array]:
    """Directions of the body (3, 3) columns, rotation about them (3,) rad/s rms, and the error of axes along them."""
    rate = x @ np.linalg.inv(axes).T
    square = rate.T @ rate if len(rate) else np.zeros((3, 3))
    # What noise alone makes of a rate is no rotation.
    inverse = np.linalg.inv(axes)
    square -= len(rate) * (inverse * np.mean(noise**2)) @ inverse.T
    value, direction = np.linalg.eigh(square)
    typical = np.sqrt(2) * float(np.median(noise))
    error = typical / np.sqrt(np.maximum(value, 1e-30))
    return direction, np.sqrt(np.maximum(value, 0) / max(len(rate), 1)), error


def axis_words(direction: Array, frame: str) -> str:
    """Name a direction (3,) of the body."""
    largest = int(np.abs(direction).argmax())
    if abs(direction[largest]) > 0.9:
        return f"{'xyz'[largest]} of {frame}"
    vector = direction * np.sign(direction[largest])
    return f"the direction ({', '.join(f'{v:.2f}' for v in vector)}) of {frame}"
