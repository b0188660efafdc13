"""What the calibrated axes say about the nominal ones, and about the reference itself."""

from __future__ import annotations

import numpy as np

from fdi_ros.calibration.data import Array

LARGE_ANGLE = np.radians(5.0)
"""A calibrated axis farther from its nominal one is worth a warning, rad."""
LARGE_SCALE = 0.05
"""So is a scale factor farther from 1."""
ODD = 5.0
"""Any channel this many times noisier than the usual one is worth a warning."""
NOISY = 2.5
"""A reference channel this many times noisier than the usual one is worth a warning."""


def deviations(axes: Array, nominal: Array) -> tuple[Array, Array]:
    """Angle (n,) rad between calibrated and nominal axes, and scale factor (n,) relative to nominal."""
    norm, nominal_norm = np.linalg.norm(axes, axis=1), np.linalg.norm(nominal, axis=1)
    sine = np.linalg.norm(np.cross(axes, nominal), axis=1)
    return np.arctan2(sine, (axes * nominal).sum(axis=1)), norm / nominal_norm


def mount_warnings(axes: Array, nominal: Array, names: tuple[str, ...], skip: list[int]) -> list[str]:
    """Channels other than those in `skip` whose nominal axis is far from the calibrated one."""
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


def reference_warnings(
    axes: Array, nominal: Array, units: list[list[int]], reference: list[int], names: tuple[str, ...]
) -> tuple[list[str], list[int]]:
    """Whether all other units disagree with the reference in the same way: then the reference is what is wrong.

    With ``z_reference = D H_reference omega`` and D taken for 1, every other unit gets the axes
    ``M inv(H_reference) inv(D) H_reference``, M its nominal ones: the same inv(D) in all of them.

    Parameters
    ----------
    axes, nominal
        (n, 3) calibrated and nominal.
    units
        Channels of each other unit of three axes.
    reference
        The three reference channels.
    names
        Of all channels.

    Returns
    -------
    The warnings, and the channels whose deviation they explain.
    """
    H = nominal[reference]
    seen = [H @ np.linalg.inv(nominal[unit]) @ axes[unit] @ np.linalg.inv(H) for unit in units]
    if not seen:
        return [], []
    common = np.mean(seen, axis=0)
    apart = np.max([np.abs(one - common).max() for one in seen]) if len(seen) > 1 else 0.0
    excess = np.abs(common - np.eye(3))
    limit = np.where(np.eye(3) > 0, LARGE_SCALE, np.sin(LARGE_ANGLE))
    if (excess < limit).all() or apart > 0.5 * excess.max():
        return [], []
    found = _blamed(common, reference, names)
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


def _blamed(common: Array, reference: list[int], names: tuple[str, ...]) -> list[str]:
    """Name reference channels that by themselves explain ``inv(D)`` (3, 3): off its diagonal they show nothing."""
    found = []
    for k, i in enumerate(reference):
        if np.abs(np.delete(common[k], k)).max() >= np.sin(LARGE_ANGLE):
            continue
        if common[k, k] < -0.5:
            found.append(f"{names[i]} of the reference points the other way than all other units say")
        elif abs(common[k, k] - 1) > LARGE_SCALE:
            found.append(f"{names[i]} of the reference reads {1 / common[k, k]:.3f} of what all other units say")
    return found


def noise_warnings(noise: Array, reference: list[int], names: tuple[str, ...]) -> list[str]:
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
